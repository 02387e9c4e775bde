#include "governor.h"

#include "number.h"

#define TRACK_S 0.02f  /* time constant of the way back to the path, once near it */
#define ANSWER_S 0.005f /* and of the speed that leads there: a quarter, so that nothing overshoots */

void governor_hold(governor_state *reference, float position_rad)
{
    *reference = (governor_state){.position_rad = position_rad};
}

/* Return the greatest speed from which a joint stops within distance_rad (0 or more): sqrt(2 a d), less what it travels
 * until the deceleration has come. */
static float stopping_speed(float distance_rad, float deceleration_rad_s2)
{
    const float late_rad_s = deceleration_rad_s2 * TRACK_S;
    return number_root(late_rad_s * late_rad_s + 2.0f * deceleration_rad_s2 * distance_rad) - late_rad_s;
}

/* Return that speed towards a limit distance_rad away, at most fastest_rad_s; far from the limit no root is needed. */
static float limit_speed(float distance_rad, float deceleration_rad_s2, float fastest_rad_s)
{
    const float late_rad_s = deceleration_rad_s2 * TRACK_S;
    if (2.0f * deceleration_rad_s2 * distance_rad >= fastest_rad_s * (fastest_rad_s + 2.0f * late_rad_s)) {
        return fastest_rad_s;
    }
    const float speed_rad_s = stopping_speed(distance_rad > 0.0f ? distance_rad : 0.0f, deceleration_rad_s2);
    return speed_rad_s < fastest_rad_s ? speed_rad_s : fastest_rad_s;
}

uint32_t governor_step(governor_state *reference, const setpoint_state *path, float path_rad_s2,
                       const governor_limits *limits)
{
    uint32_t limited = 0u;
    const float error_rad = path->position_rad - reference->position_rad;
    const float back_rad_s = stopping_speed(number_size(error_rad), limits->acceleration_rad_s2);
    const float asked_rad_s = path->speed_rad_s + (error_rad < 0.0f ? -back_rad_s : back_rad_s);
    const float fastest = limits->speed_rad_s;
    const float up = limit_speed(limits->high_rad - reference->position_rad, limits->deceleration_rad_s2, fastest);
    const float down = limit_speed(reference->position_rad - limits->low_rad, limits->deceleration_rad_s2, fastest);
    const float requested_rad_s = number_clamp(asked_rad_s, -down, up);
    float requested_rad_s2 = (requested_rad_s - reference->speed_rad_s) / ANSWER_S;
    if (requested_rad_s == asked_rad_s) {
        requested_rad_s2 += path_rad_s2;
    } else {
        limited |= number_size(asked_rad_s) > fastest ? LIMITED_SPEED : LIMITED_SOFT;
    }
    const bool braking = requested_rad_s2 * reference->speed_rad_s < 0.0f;
    const float most_rad_s2 = braking && limits->deceleration_rad_s2 > limits->acceleration_rad_s2
                                  ? limits->deceleration_rad_s2
                                  : limits->acceleration_rad_s2;
    const float held_rad_s2 = number_clamp(requested_rad_s2, -most_rad_s2, most_rad_s2);
    const float step = limits->jerk_rad_s3 * TICK_S;
    const float next_rad_s2 =
        number_clamp(held_rad_s2, reference->acceleration_rad_s2 - step, reference->acceleration_rad_s2 + step);
    if (next_rad_s2 != requested_rad_s2) {
        limited |= LIMITED_ACCELERATION;
    }
    const float before_rad_s = reference->speed_rad_s;
    reference->speed_rad_s = number_clamp(before_rad_s + next_rad_s2 * TICK_S, -fastest, fastest);
    reference->acceleration_rad_s2 = (reference->speed_rad_s - before_rad_s) / TICK_S;
    const float reached_rad = reference->position_rad + 0.5f * (before_rad_s + reference->speed_rad_s) * TICK_S;
    reference->position_rad = number_clamp(reached_rad, limits->low_rad, limits->high_rad);
    if (reference->position_rad != reached_rad) {
        reference->speed_rad_s = 0.0f;
        reference->acceleration_rad_s2 = 0.0f;
        limited |= LIMITED_SOFT;
    }
    return limited;
}
