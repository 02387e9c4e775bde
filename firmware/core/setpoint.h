/* The reference of one joint: cubic from the present reference to the host's next point, so that a host of any rate
 * moves it smoothly; position and speed are continuous. All functions: tick context. Positions rad, speeds rad/s. */
#ifndef ARMSIGHT_SETPOINT_H
#define ARMSIGHT_SETPOINT_H

#include <stdbool.h>

#include "number.h"
#include "types.h"

/* Stand still at position_rad. */
void setpoint_hold(setpoint_state *setpoint, float position_rad);

/* Return the shortest time (s) in which a cubic covers distance_rad and stays within the speed limit.
 *
 * The cubic's speed is a parabola with the Bernstein coefficients from, 3 d/T - from - to, to. It stays below V as
 * long as the middle one stays below V + sqrt((V - from)(V - to)); the smaller factor stands in for the root, which is
 * exact for equal speeds at both ends and on the safe side otherwise.
 */
inline float setpoint_shortest_s(float distance_rad, float from_rad_s, float to_rad_s, float limit_rad_s)
{
    const float from = distance_rad < 0.0f ? -from_rad_s : from_rad_s;
    const float to = distance_rad < 0.0f ? -to_rad_s : to_rad_s;
    return 3.0f * number_size(distance_rad) / (2.0f * limit_rad_s + (from < to ? from : to));
}

/* Aim at (to_rad, to_rad_s) in the given ticks (1 or more), or later where speed_limit_rad_s (above 0) asks for it.
 * |to_rad_s| and the present speed must be within the limit. Returns whether it takes longer than asked for. */
inline bool setpoint_aim(setpoint_state *setpoint, float to_rad, float to_rad_s, uint32_t ticks,
                         float speed_limit_rad_s)
{
    const float distance_rad = to_rad - setpoint->position_rad;
    const float least_ticks =
        setpoint_shortest_s(distance_rad, setpoint->speed_rad_s, to_rad_s, speed_limit_rad_s) * (float)TICKS_PER_S;
    const bool lengthened = least_ticks > (float)ticks;
    setpoint->from_rad = setpoint->position_rad;
    setpoint->from_rad_s = setpoint->speed_rad_s;
    setpoint->to_rad = to_rad;
    setpoint->to_rad_s = to_rad_s;
    setpoint->ticks = lengthened ? (uint32_t)least_ticks + 1u : ticks;
    setpoint->elapsed = 0u;
    const float per_s = (float)TICKS_PER_S / (float)setpoint->ticks;
    const float mean_rad_s = distance_rad * per_s;
    setpoint->square_rad_s2 = (3.0f * mean_rad_s - 2.0f * setpoint->from_rad_s - to_rad_s) * per_s;
    setpoint->cube_rad_s3 = (setpoint->from_rad_s + to_rad_s - 2.0f * mean_rad_s) * per_s * per_s;
    return lengthened;
}

/* Advance by one tick: along the cubic, and beyond its end straight on at its last speed. Returns the acceleration
 * (rad/s^2) with which it passes the new point. */
inline float setpoint_advance(setpoint_state *setpoint)
{
    setpoint->elapsed = number_count(setpoint->elapsed);
    if (setpoint->elapsed >= setpoint->ticks) {
        const float beyond_s = (float)(setpoint->elapsed - setpoint->ticks) * TICK_S;
        setpoint->position_rad = setpoint->to_rad + setpoint->to_rad_s * beyond_s;
        setpoint->speed_rad_s = setpoint->to_rad_s;
        return 0.0f;
    }
    const float t_s = (float)setpoint->elapsed * TICK_S;
    const float square = setpoint->square_rad_s2;
    const float cube = setpoint->cube_rad_s3 * t_s;
    setpoint->position_rad = setpoint->from_rad + t_s * (setpoint->from_rad_s + t_s * (square + cube));
    setpoint->speed_rad_s = setpoint->from_rad_s + t_s * (2.0f * square + 3.0f * cube);
    return 2.0f * square + 6.0f * cube;
}

/* Advance by one tick while slowing down by deceleration_rad_s2. Returns whether it has come to rest. */
bool setpoint_slow(setpoint_state *setpoint, float deceleration_rad_s2);

/* Hold the present reference within [low_rad, high_rad], at rest where it would leave. Returns whether it would. */
inline bool setpoint_clamp(setpoint_state *setpoint, float low_rad, float high_rad)
{
    if (number_within(setpoint->position_rad, low_rad, high_rad)) {
        return false;
    }
    setpoint->position_rad = number_clamp(setpoint->position_rad, low_rad, high_rad);
    setpoint->speed_rad_s = 0.0f;
    return true;
}

#endif
