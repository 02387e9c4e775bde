/* The reference of one joint: cubic from the present reference to the host's next point, so that a host of any rate
 * moves it smoothly; position and speed are continuous. All functions: tick context. Positions rad, speeds rad/s. */
#ifndef ARMSIGHT_SETPOINT_H
#define ARMSIGHT_SETPOINT_H

#include <stdbool.h>

#include "types.h"

/* Stand still at position_rad. */
void setpoint_hold(setpoint_state *setpoint, float position_rad);

/* Aim at (to_rad, to_rad_s) in the given ticks (1 or more), or later where speed_limit_rad_s (above 0) asks for it.
 * |to_rad_s| and the present speed must be within the limit. Returns whether it takes longer than asked for. */
bool setpoint_aim(setpoint_state *setpoint, float to_rad, float to_rad_s, uint32_t ticks, float speed_limit_rad_s);

/* Advance by one tick: along the cubic, and beyond its end straight on at its last speed. Returns the acceleration
 * (rad/s^2) with which it passes the new point. */
float setpoint_advance(setpoint_state *setpoint);

/* Advance by one tick while slowing down by deceleration_rad_s2. Returns whether it has come to rest. */
bool setpoint_slow(setpoint_state *setpoint, float deceleration_rad_s2);

/* Hold the present reference within [low_rad, high_rad], at rest where it would leave. Returns whether it would. */
bool setpoint_clamp(setpoint_state *setpoint, float low_rad, float high_rad);

#endif
