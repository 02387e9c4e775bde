/* The control law of one joint (docs/reference/firmware.md, "Control law"). Float32, 1 kHz, no state but pid_state.
 * All functions: tick context, one caller per state. */
#ifndef ARMSIGHT_PID_H
#define ARMSIGHT_PID_H

#include <stdbool.h>

#include "types.h"

/* Forget everything: duty and integral 0, speed 0 at measured_rad. */
void pid_reset(pid_state *pid, float measured_rad);

/* Take this tick's measurement (rad) into the speed filter; every tick, driven or not. */
inline void pid_measure(pid_state *pid, const joint_gains *gains, float measured_rad)
{
    const float raw_rad_s = (measured_rad - pid->measured_rad) * (float)TICKS_PER_S;
    const float weight = TICK_S / (gains->derivative_filter_s + TICK_S);
    pid->speed_rad_s += weight * (raw_rad_s - pid->speed_rad_s);
    pid->measured_rad = measured_rad;
}

/* Let the motion of its motor count for the reading of a joint that it holds, after pid_measure. Returns where a motor
 * is, by the reading and what the current twists between them. */
float pid_measure_by_motor(joint_state *joint, const joint_gains *gains);

/* Compute this tick's duty (-duty_limit to duty_limit) from the last measurement; sets LIMITED_... bits in *limited. */
float pid_step(pid_state *pid, const joint_gains *gains, const pid_demand *demand, uint32_t *limited);

/* Compute a joint's duty of this tick within what its limits, a speed beyond its limit and the host's gravity duty
 * leave; per_nominal_v: 1 / nominal supply. */
void pid_control(joint_state *joint, const joint_config *config, float per_nominal_v);

/* Move what a change of gains would add to the output into the integral, so that the output does not jump. */
void pid_change_gains(pid_state *pid, const joint_gains *before, const joint_gains *after);

/* Return whether every gain is finite. */
bool pid_gains_finite(const joint_gains *gains);

/* Return whether every gain is in the range types.h names. */
bool pid_gains_in_range(const joint_gains *gains);

#endif
