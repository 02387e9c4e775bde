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

/* Return the shortest time (s) in which a cubic covers distance_rad and stays within the speed limit.
 *
 * The cubic's speed is a parabola with the Bernstein coefficients from, 3 d/T - from - to, to. It stays below V as
 * long as the middle one stays below V + sqrt((V - from)(V - to)); the smaller factor stands in for the root, which is
 * exact for equal speeds at both ends and on the safe side otherwise.
 */
static float shortest_s(float distance_rad, float from_rad_s, float to_rad_s, float limit_rad_s)
{
    const float sign = distance_rad < 0.0f ? -1.0f : 1.0f;
    const float from = sign * from_rad_s;
    const float to = sign * to_rad_s;
    const float larger = from > to ? from : to;
    return 3.0f * sign * distance_rad / (limit_rad_s + (limit_rad_s - larger) + from + to);
}

bool setpoint_aim(setpoint_state *setpoint, float to_rad, float to_rad_s, uint32_t ticks, float speed_limit_rad_s)
{
    const float distance_rad = to_rad - setpoint->position_rad;
    const float least_ticks =
        shortest_s(distance_rad, setpoint->speed_rad_s, to_rad_s, speed_limit_rad_s) * (float)TICKS_PER_S;
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

float setpoint_advance(setpoint_state *setpoint)
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

bool setpoint_clamp(setpoint_state *setpoint, float low_rad, float high_rad)
{
    const float held_rad = number_clamp(setpoint->position_rad, low_rad, high_rad);
    if (held_rad == setpoint->position_rad) {
        return false;
    }
    setpoint->position_rad = held_rad;
    setpoint->speed_rad_s = 0.0f;
    return true;
}
