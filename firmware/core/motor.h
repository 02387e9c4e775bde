/* One motor as a second witness of its joint's motion: its back-EMF, (u V - i R) / K, gives the speed without the
 * potentiometer. It shares nothing with the control law but the reading of the angle. All functions: tick context. */
#ifndef ARMSIGHT_MOTOR_H
#define ARMSIGHT_MOTOR_H

#include <stdbool.h>

#include "number.h"
#include "types.h"

#define MOTOR_STEP_TICKS 160u /* for so long a step may be what a gap began with; half: slow gaps have no beginning,
                                 double: old steps are blamed */
#define MOTOR_TWIST 0.5f /* of the largest current's twist of late: half: soft joints are dropped, twice: faults show
                            later */
#define MOTOR_WITNESS 0.1f /* of the speed it is held to: so much faster than the reading it must be to count; half:
                              noise brakes, double: a wrong reading lets it be faster */

/* Begin to watch a joint that reads angle_rad and has this speed limit; phase differs from joint to joint, so that not
 * all are sampled at once. */
void motor_start(motor_state *motor, float angle_rad, float speed_limit_rad_s, uint32_t phase);

/* Let what lies between motor and reading count from the start on. */
static inline void motor_through(motor_state *motor, const transmission_config *between)
{
    motor->twist_rad_per_a = between->twist_rad_per_a;
    motor->twist_share = 1.0f;
    motor->uneven = between->uneven;
    motor->damping_share = between->damping_share;
    if (motor->swift_per_a > 0.0f) { /* twist over torque is 1/stiffness, speed over torque and time 1/inertia */
        const float radians = number_root(between->twist_rad_per_a * (float)TICKS_PER_S / motor->swift_per_a);
        motor->swing_ticks = (uint32_t)(3.14159f * radians);
        motor->twist_share = 1.0f / (1.0f + radians);
    }
}

/* Return by how much more the current twists the transmission in a tick. */
static inline float motor_twists(const motor_state *motor, float current_a)
{
    return motor->twist_share * (motor->twist_rad_per_a * current_a - motor->twist_rad);
}

/* Say that in the tick that is measured next a driver that limits the current may not put the whole duty out. */
void motor_limit(motor_state *motor);

/* Take what a tick measured: supply (V), current (A, the joint's direction) and reading, while the windings are closed.
 * What R and K really are is learnt as long as motor and reading agree. */
void motor_measure(motor_state *motor, const motor_config *config, float supply_v, float current_a, float angle_rad);

/* Take a tick in which the bridge sleeps: what current_a shows then is the sensor's zero. */
void motor_sleep(zero_state *zero, float current_a);

/* Return whether a current is shown that was not, once the bridge has slept for 32 ms: the sensor's error. */
bool motor_flows_asleep(const zero_state *zero, const motor_config *config, float supply_v);

/* Return how fast the motor surely is: sure_rad_s doubts it as at the last sample, and the current may be larger by
 * now. */
float motor_sure(const motor_state *motor);

/* Return the way of a motor in a tick; yielding: by the least its winding may take of the voltage. Held at rest by that
 * it gives way to its load as far as its resistance is uncertain, and is never driven on. Its constant has no part in
 * it. */
float motor_way(const motor_state *motor, bool yielding);

/* Return the joint's speed: the reading's, or the motor's where that is faster beyond all its uncertainty. */
static inline float motor_witness(const motor_state *motor, float reading_rad_s)
{
    const float least_rad_s = number_size(reading_rad_s) + MOTOR_WITNESS * motor->fastest_rad_s;
    return motor->sure_rad_s > least_rad_s && motor_sure(motor) > least_rad_s ? motor->speed_rad_s : reading_rad_s;
}

/* Let the motor's speed be damped in place of the reading's as far as damping_share says: an elastic joint that is read
 * behind its spring is damped by the motor before it. While the motor's is not known, the reading's is. */
void motor_damp(motor_state *motor, float reading_rad_s);

/* Return how far motor and reading may be apart by the motor's uncertain numbers, and by the twist that the current
 * does not show: friction, inertia, and a stiffness that is another than the configuration's. */
static inline float motor_explains(const motor_state *motor)
{
    return motor->band_rad + MOTOR_TWIST * motor->twist_rad_per_a * motor->current_a;
}

/* Return whether its driver may have limited the current since the last sample. */
static inline bool motor_is_limited(const motor_state *motor) { return motor->limited_ticks > motor->part_ticks; }

/* Return whether motor and reading are apart further than that, noise and backlash explain. */
static inline bool motor_is_apart(const motor_state *motor, const motor_config *config)
{
    const float left_rad = number_size(motor->gap_rad) - config->apart_rad - motor_explains(motor);
    /* A motor that went less far than its duty's voltage leads it: the reading lags by as much. */
    return left_rad > 0.0f && !motor_is_limited(motor) &&
           (motor->gap_rad * motor->withheld_rad >= 0.0f || left_rad > number_size(motor->withheld_rad));
}

/* Return the fault by which they are apart, as it looks at first. */
uint32_t motor_disagrees(const motor_state *motor, const motor_config *config, float supply_v);

/* Return the fault (FAULT_BIT) by what motor and reading did in the last 192 ms, or those that cannot be distinguished;
 * suspect where that does not show it. A motor that was let go of changes its speed by itself: only then a reading that
 * drifts can be distinguished from one that slips. */
uint32_t motor_names(const motor_state *motor, const motor_config *config, uint32_t suspect, motor_sums *sums);

/* Return whether the speed by the back-EMF has changed of late as no torque changes it: then current, winding or bridge
 * are not what they were, and the reading has no part in it. */
static inline bool motor_stepped(const motor_state *motor)
{
    return motor->step_ticks != 0u && motor->driven_ticks - motor->step_ticks < MOTOR_STEP_TICKS;
}

/* Look for what the motor's constant is since the step, whatever current's offset and gain are. */
void motor_weakens(motor_state *motor, const motor_config *config, motor_sums *sums);

/* Let the resistance be as uncertain as it may have changed within so many ticks: a temperature that rises is no random
 * walk. */
void motor_warms(motor_state *motor, const motor_config *config, uint32_t ticks);

/* Let a motor be the only witness: with what was known of it before what the reading has spoilt. */
void motor_recall(motor_state *motor);

/* Let a motor be no witness any more, until the drives were off. */
void motor_doubt(motor_state *motor, const motor_config *config);

/* Return whether the current answers to the voltage otherwise than the learnt winding lets it: the reading has no part
 * in it. */
bool motor_answers_otherwise(const motor_state *motor, const motor_config *config);

#define MOTOR_NONE_SAMPLES 5u /* 40 ms, half of what its sums remember */

/* Return which part has failed (FAULT_BIT), or which cannot be distinguished. Over what was before, by offset a,
 * gain g, constant k and resistance r:
 *
 *     what shows                        offset   sign, lead   gain   weak   shorted
 *     answer of current to voltage      1        0, -1        g      1      1/r
 *     current at rest without voltage   a        0            0      0      0
 *     voltage that the load takes       1        1            1      1/k    r/k     of what it took
 *     constant by reading               1        1            1      k      k       of the learnt one
 *
 * dry_v: what friction takes of the voltage, either way. */
uint32_t motor_blames(const motor_state *motor, const motor_config *config, float dry_v);

/* Return whether since such a step reading and current go with a voltage that stays, whatever is put out. */
bool motor_is_stuck(const motor_state *motor, const motor_config *config, float supply_v, motor_sums *sums);

/* Return whether the back-EMF has stepped of late, or may have while a driver limited the current: a bridge that drives
 * by itself once the drives are off does so, a reading that fails does not. */
bool motor_may_have_stepped(const motor_state *motor);

/* Return whether for 16 ms a motor has not done what was put out to it, and by reading and current another voltage
 * drives it: against the way error_rad that it is driven, or at all where nothing was put out and shorted windings
 * brake. */
bool motor_disobeys(const motor_state *motor, const motor_config *config, float supply_v, float error_rad);

/* Return whether no current flows that the voltage must drive: a broken lead, and its load drives the joint. */
bool motor_is_dead(const motor_state *motor, const motor_config *config);

#define MOTOR_SWING 0.2f /* of the speed limit: so far from the reference's speed a swing goes at least; half: elastic
                            joints alarm, double: slow swings are not seen */

/* Return whether the motor swings about its reference, from whose speed it is far off by off_rad_s, by its own speed if
 * known. */
bool motor_swings_far(motor_state *motor, float off_rad_s, bool known);

#define UNKNOWN_RAD_S 1000.0f /* as uncertain as a motor's speed is whose voltage is not known */

/* Return whether the voltage across a motor, and so its speed, is known: not where a driver may have withheld some. */
static inline bool motor_is_known(const motor_state *motor) { return motor->sure_rad_s > -0.5f * UNKNOWN_RAD_S; }

/* Return whether the motor, or where its speed is not known the reading, swings about a reference that moves at
 * reference_rad_s. To be asked each WATCH_TICKS. */
static inline bool motor_swings(motor_state *motor, float reading_rad_s, float reference_rad_s, float speed_limit_rad_s)
{
    const bool known = motor_is_known(motor);
    const float off_rad_s = (known ? motor->speed_rad_s : reading_rad_s) - reference_rad_s;
    return number_size(off_rad_s) > MOTOR_SWING * speed_limit_rad_s && motor_swings_far(motor, off_rad_s, known);
}

/* Return whether a joint whose reading is faster than its limit has been so long enough to be sure. */
bool motor_stays_fast(motor_state *motor, const motor_config *config, float reading_rad_s);

/* Return whether the joint has been faster than it may be long enough to be sure; reading_rad_s is what the reading
 * says of it, alone where the motor is no witness. To be asked each WATCH_TICKS. */
static inline bool motor_is_fast(motor_state *motor, const motor_config *config, float reading_rad_s)
{
    if (number_size(reading_rad_s) <= motor->fastest_rad_s) {
        motor->fast_ticks = 0u;
        return false;
    }
    return motor_stays_fast(motor, config, reading_rad_s);
}

/* Return the current that the duty must drive by the reading's speed. */
float motor_draws(const motor_state *motor, const motor_config *config, float supply_v, float reading_rad_s);

#endif
