#include "pid.h"

#include "motor.h"
#include "number.h"

#define INLINE static inline __attribute__((always_inline))
#define BEYOND 2.0f /* so many times a speed is damped beyond its limit; half: limits are exceeded by loads, double: it
                       chatters there */
#define BRAKE_S 0.003f /* s; a few ticks; half: a motor's speed measured a tick late swings, double: limits hold
                          later */
#define SPARE_SPEED 1.03f /* of the speed limit: a joint that moves at it can still catch up; 1: it cannot, 1.06: it is
                             faster than its limit by that */
#define LOADED 0.25f /* of the speed limit: a joint far from its reference that is slower is held back by a load; half:
                        loads are lifted later, double: free joints overshoot */
#define CREEP_RAD_S 0.005f /* from here on dry friction is compensated by half and more */

void pid_reset(pid_state *pid, float measured_rad)
{
    *pid = (pid_state){.measured_rad = measured_rad};
}

extern inline void pid_measure(pid_state *, const joint_gains *, float);

float pid_measure_by_motor(joint_state *joint, const joint_gains *gains)
{
    pid_state *pid = &joint->pid;
    if (joint->motor.alone != 0u) {
        pid->measured_rad = joint->held_rad;
        pid->speed_rad_s = joint->held_rad_s;
        pid_measure(pid, gains, joint->held_rad + motor_way(&joint->motor, joint->suspect == FAULT_NONE));
        joint->held_rad = pid->measured_rad;
        joint->held_rad_s = pid->speed_rad_s;
    }
    joint->motor.twist_rad += motor_twists(&joint->motor, joint->current_a);
    return joint->pot.angle_rad + joint->motor.twist_rad;
}

/* Return the duty asked for held to the limits, and say which of them held it. */
INLINE float limited_duty(const pid_state *pid, const pid_demand *demand, float asked, uint32_t *limited)
{
    const float slew_duty = demand->duty_slew_per_s * TICK_S;
    if (asked >= demand->duty_low && asked <= demand->duty_high && number_size(asked - pid->duty) <= slew_duty) {
        return asked;
    }
    const float within = number_clamp(asked, demand->duty_low, demand->duty_high);
    if (within != asked) {
        *limited |= number_size(within) < demand->duty_limit ? LIMITED_CURRENT : LIMITED_DUTY;
    }
    const float reached = number_towards(pid->duty, within, slew_duty);
    if (reached != within) {
        *limited |= LIMITED_SLEW;
    }
    return reached;
}

/* Return a direction, -1 to 1, without a jump where it changes. */
static float direction_of(float speed_rad_s) { return speed_rad_s / (number_size(speed_rad_s) + CREEP_RAD_S); }

/* Return the error that the integral gathers while the spring is bounded: what a joint that a load holds back or drives
 * away lacks of a share of its speed limit, or of its reference's speed, by whichever is faster, reading or motor, and
 * never more than its error. A joint that moves on gathers none. */
static float bounded_error(const joint_gains *gains, const pid_demand *demand, float spring, float error_rad)
{
    if (gains->kp_per_rad <= 0.0f || spring * error_rad <= 0.0f) {
        return 0.0f;
    }
    const float damped_rad_s = demand->damped_rad_s;
    const float motor_rad_s = demand->motor_rad_s;
    const float fast_rad_s = number_size(motor_rad_s) > number_size(damped_rad_s) ? motor_rad_s : damped_rad_s;
    const float per_rad_s = gains->kd_s_per_rad + demand->own_s_per_rad;
    const float along =
        demand->reference_rad_s * spring > 0.0f ? per_rad_s * number_size(demand->reference_rad_s) : 0.0f;
    const float least = LOADED * number_size(spring);
    const float needed = along > least ? along : least;
    const float lacking = (spring > 0.0f ? needed : -needed) - per_rad_s * fast_rad_s;
    return lacking * spring > 0.0f ? number_bound(lacking / gains->kp_per_rad, number_size(error_rad)) : 0.0f;
}

/* The law; inline, so that pid_control needs no demand in memory. */
INLINE float step(pid_state *pid, const joint_gains *gains, const pid_demand *demand, uint32_t *limited)
{
    const float error_rad = demand->reference_rad - pid->measured_rad;
    /* However far the reference is away: the joint is not driven to it faster than its speed limit. */
    const float requested = gains->kp_per_rad * error_rad + gains->kv_s_per_rad * demand->reference_rad_s;
    const float spring = number_bound(requested, demand->spring_limit);
    const float gathered_rad = spring == requested ? error_rad : bounded_error(gains, demand, spring, error_rad);
    const float forward = gains->ka_s2_per_rad * demand->reference_rad_s2 +
                          gains->kf_duty * direction_of(demand->reference_rad_s) + demand->gravity_duty;
    const float asked = spring + pid->integral_duty - gains->kd_s_per_rad * demand->damped_rad_s + forward;
    const float duty = limited_duty(pid, demand, asked - demand->braked_duty, limited);
    float integral = pid->integral_duty;
    if (gains->ki_per_rad_s > 0.0f) {
        /* Back-calculation: what a limit took away is taken from the integral as well. */
        const float pull = gains->anti_windup_per_s * (duty - asked);
        integral += TICK_S * (gains->ki_per_rad_s * gathered_rad + pull);
    } else {
        /* Nothing feeds the integral: what a change of gains left in it fades. */
        integral -= TICK_S * gains->anti_windup_per_s * integral;
    }
    pid->integral_duty = number_bound(integral, demand->duty_limit);
    if (pid->integral_duty != integral) {
        *limited |= LIMITED_DUTY;
    }
    pid->duty = duty;
    pid->error_rad = error_rad;
    pid->reference_rad_s = demand->reference_rad_s;
    pid->reference_rad_s2 = demand->reference_rad_s2;
    return duty;
}

float pid_step(pid_state *pid, const joint_gains *gains, const pid_demand *demand, uint32_t *limited)
{
    return step(pid, gains, demand, limited);
}

/* Return the duty of kp and kv that moves a free joint at its speed limit and a little more: what back-EMF
 * (own_s_per_rad) and damping take there. Without a known motor nothing bounds it. */
static float spring_limit(const joint_config *config, float own_s_per_rad)
{
    if (config->motor.resistance_ohm <= 0.0f) {
        return FLT_MAX;
    }
    return SPARE_SPEED * config->speed_limit_rad_s * (config->gains.kd_s_per_rad + own_s_per_rad);
}

void pid_control(joint_state *joint, const joint_config *config, float per_nominal_v)
{
    if (joint->gravity_duty != joint->gravity_asked) {
        joint->gravity_duty =
            number_towards(joint->gravity_duty, joint->gravity_asked, config->gravity_slew_per_s * TICK_S);
    }
    if (joint->over_a > 0.0f || joint->duty_cap != config->duty_limit) {
        const float cut_duty = config->current_cut_per_a_s * joint->over_a * TICK_S;
        joint->duty_cap = number_clamp(joint->duty_cap - cut_duty, 0.0f, config->duty_limit);
    }
    float duty_low = -joint->duty_cap, duty_high = joint->duty_cap;
    const float own_s_per_rad = config->motor.constant_v_s * per_nominal_v;
    const float fastest_rad_s = joint->motor.fastest_rad_s;
    const float free_duty = fastest_rad_s * own_s_per_rad;
    const bool fast = joint->motor.sure_rad_s > fastest_rad_s;
    const float faster_rad_s = fast ? motor_sure(&joint->motor) - fastest_rad_s : 0.0f;
    if (faster_rad_s > 0.0f) { /* it is driven on as a free motor at its limit, less what brings it back there in
                                  BRAKE_S */
        const float left_duty = free_duty - config->gains.ka_s2_per_rad * (1.0f / BRAKE_S) * faster_rad_s;
        if (joint->motor.speed_rad_s > 0.0f) {
            duty_high = number_clamp(left_duty, duty_low, duty_high);
        } else {
            duty_low = number_clamp(-left_duty, duty_low, duty_high);
        }
        joint->limited |= LIMITED_SPEED;
    }
    const float seen_rad_s = motor_witness(&joint->motor, joint->pid.speed_rad_s + joint->motor.beyond_rad_s);
    const float more_rad_s = BEYOND * (seen_rad_s - number_bound(seen_rad_s, fastest_rad_s));
    const pid_demand demand = {.reference_rad = joint->reference.position_rad,
                               .reference_rad_s = joint->reference.speed_rad_s,
                               .reference_rad_s2 = joint->reference.acceleration_rad_s2,
                               .damped_rad_s = seen_rad_s + more_rad_s,
                               .braked_duty = joint->motor.damping_share * own_s_per_rad * more_rad_s,
                               .spring_limit = spring_limit(config, own_s_per_rad),
                               .own_s_per_rad = own_s_per_rad,
                               .motor_rad_s = joint->motor.speed_rad_s,
                               .gravity_duty = joint->gravity_duty,
                               .duty_limit = config->duty_limit,
                               .duty_low = duty_low,
                               .duty_high = duty_high,
                               .duty_slew_per_s = config->duty_slew_per_s};
    (void)step(&joint->pid, &config->gains, &demand, &joint->limited);
}

void pid_change_gains(pid_state *pid, const joint_gains *before, const joint_gains *after)
{
    pid->integral_duty += (before->kp_per_rad - after->kp_per_rad) * pid->error_rad -
                          (before->kd_s_per_rad - after->kd_s_per_rad) * pid->speed_rad_s +
                          (before->kv_s_per_rad - after->kv_s_per_rad) * pid->reference_rad_s +
                           (before->ka_s2_per_rad - after->ka_s2_per_rad) * pid->reference_rad_s2 +
                           (before->kf_duty - after->kf_duty) * direction_of(pid->reference_rad_s);
}

bool pid_gains_finite(const joint_gains *gains)
{
    return number_finite(gains->kp_per_rad) && number_finite(gains->ki_per_rad_s) &&
           number_finite(gains->kd_s_per_rad) && number_finite(gains->kv_s_per_rad) &&
           number_finite(gains->ka_s2_per_rad) && number_finite(gains->kf_duty) &&
           number_finite(gains->derivative_filter_s) && number_finite(gains->anti_windup_per_s);
}

bool pid_gains_in_range(const joint_gains *gains)
{
    return number_within(gains->kp_per_rad, 0.0f, 100.0f) && number_within(gains->ki_per_rad_s, 0.0f, 1000.0f) &&
           number_within(gains->kd_s_per_rad, 0.0f, 100.0f) && number_within(gains->kv_s_per_rad, 0.0f, 100.0f) &&
           number_within(gains->ka_s2_per_rad, 0.0f, 10.0f) && number_within(gains->kf_duty, 0.0f, 1.0f) &&
           number_within(gains->derivative_filter_s, 0.0f, 1.0f) &&
           number_within(gains->anti_windup_per_s, 0.0f, 1000.0f);
}
