#include "setpoint.h"

#include "number.h"

void setpoint_hold(setpoint_state *setpoint, float position_rad)
{
    *setpoint = (setpoint_state){.position_rad = position_rad,
                                 .from_rad = position_rad,
                                 .to_rad = position_rad,
                                 .ticks = 1u,
                                 .elapsed = 1u};
}

/* The copies for who does not inline them. */
extern inline float setpoint_shortest_s(float, float, float, float);
extern inline bool setpoint_aim(setpoint_state *, float, float, uint32_t, float);
extern inline float setpoint_advance(setpoint_state *);
extern inline bool setpoint_clamp(setpoint_state *, float, float);

bool setpoint_slow(setpoint_state *setpoint, float deceleration_rad_s2)
{
    setpoint->speed_rad_s = number_towards(setpoint->speed_rad_s, 0.0f, deceleration_rad_s2 * TICK_S);
    setpoint->position_rad += setpoint->speed_rad_s * TICK_S;
    if (setpoint->speed_rad_s != 0.0f) {
        return false;
    }
    setpoint_hold(setpoint, setpoint->position_rad);
    return true;
}
