#include "governor.h"

#include "number.h"

#define TRACK_S 0.02f /* s; time constant of the way back to the path, once near it; half: it overshoots, double: it is
                         off the path for longer */
#define ANSWER_PER_S 200.0f /* 1/s; of the speed that leads there: four times as fast, so that nothing overshoots; half:
                               it does, double: the acceleration limit acts instead */

void governor_hold(governor_state *reference, float position_rad)
{
    *reference = (governor_state){.position_rad = position_rad};
}

/* Return the greatest speed from which a joint stops within distance_rad (0 or more): sqrt(2 a d), less the late_rad_s
 * it loses only after the deceleration has come. */
static inline float stopping_speed(float twice_rad_s2, float distance_rad, float late_rad_s)
{
    return number_root(late_rad_s * late_rad_s + twice_rad_s2 * distance_rad) - late_rad_s;
}

/* Return that speed towards a limit distance_rad away, at most fastest_rad_s; far from the limit no root is needed. */
static inline float limit_speed(float twice_rad_s2, float distance_rad, float late_rad_s, float fastest_rad_s)
{
    if (twice_rad_s2 * distance_rad >= fastest_rad_s * (fastest_rad_s + 2.0f * late_rad_s)) {
        return fastest_rad_s;
    }
    const float speed_rad_s = stopping_speed(twice_rad_s2, distance_rad > 0.0f ? distance_rad : 0.0f, late_rad_s);
    return speed_rad_s < fastest_rad_s ? speed_rad_s : fastest_rad_s;
}

uint32_t governor_step(governor_state *reference, const setpoint_state *path, float path_rad_s2,
                       const joint_config *config, float fastest, float low_rad, float high_rad)
{
    uint32_t limited = 0u;
    const float faster_rad_s2 = config->acceleration_rad_s2;
    const float slower_rad_s2 = config->deceleration_rad_s2;
    const float before_rad = reference->position_rad;
    const float before_rad_s = reference->speed_rad_s;
    const float error_rad = path->position_rad - before_rad;
    const float back_rad_s = stopping_speed(2.0f * faster_rad_s2, number_size(error_rad), faster_rad_s2 * TRACK_S);
    const float asked_rad_s = path->speed_rad_s + (error_rad < 0.0f ? -back_rad_s : back_rad_s);
    const float late_rad_s = slower_rad_s2 * TRACK_S;
    const float room_rad = asked_rad_s < 0.0f ? before_rad - low_rad : high_rad - before_rad;
    const float requested_rad_s =
        number_bound(asked_rad_s, limit_speed(2.0f * slower_rad_s2, room_rad, late_rad_s, fastest));
    float requested_rad_s2 = (requested_rad_s - before_rad_s) * ANSWER_PER_S;
    if (requested_rad_s == asked_rad_s) {
        requested_rad_s2 += path_rad_s2;
    } else {
        limited |= number_size(asked_rad_s) > fastest ? LIMITED_SPEED : LIMITED_SOFT;
    }
    const bool braking = requested_rad_s2 * before_rad_s < 0.0f;
    const float most_rad_s2 = braking && slower_rad_s2 > faster_rad_s2 ? slower_rad_s2 : faster_rad_s2;
    const float held_rad_s2 = number_bound(requested_rad_s2, most_rad_s2);
    const float next_rad_s2 =
        number_towards(reference->acceleration_rad_s2, held_rad_s2, config->jerk_rad_s3 * TICK_S);
    if (next_rad_s2 != requested_rad_s2) {
        limited |= LIMITED_ACCELERATION;
    }
    reference->speed_rad_s = number_bound(before_rad_s + next_rad_s2 * TICK_S, fastest);
    reference->acceleration_rad_s2 = (reference->speed_rad_s - before_rad_s) * (float)TICKS_PER_S;
    const float reached_rad = before_rad + 0.5f * TICK_S * (before_rad_s + reference->speed_rad_s);
    reference->position_rad = reached_rad;
    if (!number_within(reached_rad, low_rad, high_rad)) {
        reference->position_rad = number_clamp(reached_rad, low_rad, high_rad);
        reference->speed_rad_s = 0.0f;
        reference->acceleration_rad_s2 = 0.0f;
        limited |= LIMITED_SOFT;
    }
    return limited;
}
