/* One motor as a second witness of its joint's motion: its back-EMF, (u V - i R) / K, gives the speed without the
 * potentiometer. It shares nothing with the control law but the reading of the angle. All functions: tick context. */
#ifndef ARMSIGHT_MOTOR_H
#define ARMSIGHT_MOTOR_H

#include <stdbool.h>

#include "number.h"
#include "types.h"

#define MOTOR_WITNESS 0.1f /* of the speed it is held to: so much faster than the reading it must be to count */

/* Begin to watch a joint that reads angle_rad and has this speed limit; phase differs from joint to joint, so that not
 * all are sampled at once. */
void motor_start(motor_state *motor, float angle_rad, float speed_limit_rad_s, uint32_t phase);

/* Let a tick pass in which the voltage at the motor is not known. */
void motor_pause(motor_state *motor, float angle_rad);

/* Take what a tick measured: supply (V), current (A, the joint's direction) and reading, while the windings are closed.
 * What R and K really are is learnt as long as motor and reading agree. */
void motor_measure(motor_state *motor, const motor_config *config, float supply_v, float current_a, float angle_rad);

/* Return the joint's speed: the reading's, or the motor's where that is faster beyond all its uncertainty. */
static inline float motor_witness(const motor_state *motor, float reading_rad_s)
{
    const float faster_rad_s = motor->sure_rad_s - MOTOR_WITNESS * motor->fastest_rad_s;
    return faster_rad_s > number_size(reading_rad_s) ? motor->speed_rad_s : reading_rad_s;
}

/* Return whether motor and reading are apart further than noise, backlash and the motor's uncertain numbers explain. */
static inline bool motor_is_apart(const motor_state *motor, const motor_config *config)
{
    return number_size(motor->gap_rad) > config->apart_rad + motor->band_rad;
}

/* Return the fault by which they are apart, as it looks at first. */
uint32_t motor_disagrees(const motor_state *motor, const motor_config *config, float supply_v);

/* Return the fault by what motor and reading did in the last 192 ms; suspect where that does not show it. A motor that was
 * let go of changes its speed by itself: only then a reading that drifts can be distinguished from one that slips. */
uint32_t motor_names(const motor_state *motor, uint32_t suspect);

#define MOTOR_SWING 0.2f /* of the speed limit: so far from the reference's speed a swing goes at least */

/* Return whether the motor swings about its reference, from whose speed it is far off by off_rad_s. */
bool motor_swings_far(motor_state *motor, float off_rad_s);

/* Return whether the motor swings about a reference that moves at reference_rad_s. To be asked each tick. */
static inline bool motor_swings(motor_state *motor, float reference_rad_s, float speed_limit_rad_s)
{
    const float off_rad_s = motor->speed_rad_s - reference_rad_s;
    return number_size(off_rad_s) > MOTOR_SWING * speed_limit_rad_s && motor_swings_far(motor, off_rad_s);
}

/* Return whether the joint has been faster than it may be long enough to be sure; reading_rad_s is what the reading says
 * of it. To be asked each WATCH_TICKS. */
bool motor_is_fast(motor_state *motor, float reading_rad_s);

#endif
