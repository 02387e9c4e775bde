#include "core.h"

#include "command.h"
#include "config.h"
#include "encoder.h"
#include "governor.h"
#include "motor.h"
#include "number.h"
#include "observer.h"
#include "pid.h"
#include "pot.h"
#include "safety.h"
#include "setpoint.h"

#define GUARD 0xA5C3965Au

void core_init(core_state *core, const core_config *config, uint32_t source, uint32_t reset)
{
    *core = (core_state){.guard_head = GUARD, .first_joint = NO_JOINT, .guard_tail = GUARD};
    const bool usable = source != CONFIG_FACTORY && config_is_valid(config);
    if (usable) {
        core->config = *config;
    } else {
        config_factory(&core->config);
        core->permanent = FAULT_BIT(FAULT_CONFIG);
        safety_raise(core, FAULT_CONFIG, NO_JOINT);
    }
    if (reset != RESET_POWER) {
        safety_raise(core, reset == RESET_CRASH ? FAULT_CRASH : FAULT_WATCHDOG, NO_JOINT);
    }
    for (uint32_t i = 0u; i < JOINTS; i++) {
        core->start_gains.joint[i] = core->config.joint[i].gains;
    }
    safety_changed_config(core, false);
}

/* Read a joint's sensor. */
static void measure(core_state *core, joint_state *joint, const joint_config *config, uint32_t i, uint32_t counts)
{
    const bool known = joint->pot.valid != 0u;
    uint32_t fault;
    if (config->encoder.sensor == SENSOR_POTENTIOMETER) {
        fault = pot_read(&joint->pot, &config->pot, counts, core->config.pot_ticks);
    } else {
        fault = encoder_read(&joint->encoder, &joint->pot, config, counts, core->config.pot_ticks);
        core->not_homed |= encoder_is_homed(&joint->encoder, config) ? 0u : 1u << i;
    }
    if (fault != FAULT_NONE) {
        safety_raise(core, fault, i);
    }
    if (!known || fault != FAULT_NONE) {
        pid_reset(&joint->pid, joint->pot.angle_rad); /* a new position is no speed */
        observer_move(&joint->observer, joint->pot.angle_rad);
    } else {
        pid_measure(&joint->pid, &config->gains, joint->pot.angle_rad);
    }
}

/* Watch a joint without its motor. */
static void observe(const core_state *core, joint_state *joint, const joint_config *config, float angle_rad)
{
    joint->motor.last_rad = angle_rad;
    joint->motor.driven_ticks++;
    joint->motor.trust = 1.0f; /* no witness, no trust to earn */
    const float supply_duty = 1000.0f * core->supply_v / (float)core->config.supply_nominal_mv;
    observer_measure(&joint->observer, &config->gains, joint->motor.duty * supply_duty, angle_rad);
}

/* Bring a reference that has nearly come to rest to it: the path ends where it is. */
static void settle(joint_state *joint)
{
    setpoint_hold(&joint->setpoint, joint->reference.position_rad);
    governor_hold(&joint->reference, joint->reference.position_rad);
}

/* Move a joint's reference by one tick; returns whether it is at rest. */
static bool advance(joint_state *joint, const joint_config *config, bool slowing)
{
    bool resting = false;
    float path_rad_s2 = 0.0f;
    if (slowing) {
        const float before_rad_s = joint->setpoint.speed_rad_s;
        resting = setpoint_slow(&joint->setpoint, joint->stop_rad_s2);
        path_rad_s2 = (joint->setpoint.speed_rad_s - before_rad_s) * (float)TICKS_PER_S;
        joint->held_back = 0u;
    } else {
        path_rad_s2 = setpoint_advance(&joint->setpoint);
        joint->limited |= joint->held_back;
    }
    if (setpoint_clamp(&joint->setpoint, joint->low_rad, joint->high_rad)) {
        joint->limited |= LIMITED_SOFT;
        path_rad_s2 = 0.0f;
    }
    const float fastest = joint->motor.trust * config->speed_limit_rad_s;
    joint->limited |= governor_step(&joint->reference, &joint->setpoint, path_rad_s2, config, fastest, joint->low_rad,
                                    joint->high_rad);
    if (resting && number_size(joint->reference.speed_rad_s) < 0.01f * config->speed_limit_rad_s) {
        settle(joint);
    } else {
        resting = false;
    }
    /* Limits that were widened for a joint outside close in behind it. */
    if (joint->low_rad != config->soft_min_rad) {
        joint->low_rad = number_clamp(joint->reference.position_rad, joint->low_rad, config->soft_min_rad);
    }
    if (joint->high_rad != config->soft_max_rad) {
        joint->high_rad = number_clamp(joint->reference.position_rad, config->soft_max_rad, joint->high_rad);
    }
    return resting;
}

static void advance_arm(core_state *core)
{
    if (core->state == STATE_ENABLED && core->brake_ticks != 0u) { /* brakes open or close: the references wait */
        core->brake_ticks -= core->closing == 0u ? 1u : 0u;
        return;
    }
    const bool slowing = core->state == STATE_STOPPING;
    bool resting = true;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        const bool joint_rests = advance(&core->joint[i], &core->config.joint[i], slowing);
        resting = resting && joint_rests;
    }
    if (slowing && resting) {
        core->state = STATE_HOLDING;
    }
}

/* Drive every joint, watch what comes of it. */
static void drive(core_state *core)
{
    const float per_nominal_v = 1000.0f / (float)core->config.supply_nominal_mv;
    advance_arm(core);
    for (uint32_t i = 0u; core->by_motor != 0u && i < core->config.joint_count; i++) {
        motor_damp(&core->joint[i].motor, core->joint[i].pid.speed_rad_s);
    }
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        const joint_config *config = &core->config.joint[i];
        if (joint->released == 0u) {
            pid_control(joint, config, per_nominal_v);
        }
        if (!number_finite(joint->pid.duty + joint->pid.integral_duty)) {
            safety_raise(core, FAULT_ARITHMETIC, i);
        }
    }
    safety_watch_joints(core);
}

/* Let the references rest where the joints are, so that nothing is left of the last motion. */
static void rest(core_state *core)
{
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        setpoint_hold(&joint->setpoint, joint->pot.angle_rad);
        governor_hold(&joint->reference, joint->pot.angle_rad);
        joint->released = 0u;
        joint->motor.alone = 0u;
        if (joint->pid.duty != 0.0f && motor_stepped(&joint->motor)) {
            /* its current's answer to the end shows its sign */
            joint->motor.dither_vv = joint->motor.dither_va = joint->motor.dither_aa = joint->motor.dithers = 0.0f;
        }
        joint->pid.integral_duty = joint->pid.duty = joint->pid.error_rad = joint->pid.reference_rad_s = 0.0f;
        joint->limited = 0u;
    }
}

/* On the way to disabled: let the brakes close before the drives go off. */
static void close_brakes(core_state *core)
{
    if (core->closing == 0u || !safety_drives_on(core)) {
        core->closing = 0u;
        return;
    }
    if (core->brake_ticks != 0u) {
        core->brake_ticks--;
        return;
    }
    core->closing = 0u;
    core->state = core->faults != 0u ? STATE_FAULTED : STATE_DISABLED;
}

/* Write every field of the outputs: the joints' duties for the present supply, as gains are those of the nominal
 * one. */
static void report(core_state *core, core_outputs *outputs, uint32_t supply_mv)
{
    const uint32_t least_mv = core->config.supply_nominal_mv / 2u; /* a sensor of the supply may fail too */
    const float scale = (float)core->config.supply_nominal_mv / (float)(supply_mv > least_mv ? supply_mv : least_mv);
    const bool on = safety_drives_on(core);
    outputs->tick = core->tick;
    outputs->drives_on = on ? 1u : 0u;
    outputs->windings_shorted = core->shorted;
    outputs->brakes_open = on && core->closing == 0u ? 1u : 0u;
    outputs->feed_watchdog = 1u;
    outputs->state = core->state;
    outputs->faults = core->faults;
    outputs->first_fault = core->first_fault;
    outputs->first_joint = core->first_joint;
    outputs->acknowledged_sequence = core->acknowledged_sequence;
    outputs->acknowledged_count = core->acknowledged_count;
    outputs->rejected_sequence = core->rejected_sequence;
    outputs->rejected_count = core->rejected_count;
    outputs->rejection = core->rejection;
    outputs->not_homed = core->not_homed;
    for (uint32_t i = 0u; i < JOINTS; i++) { /* of joints that are not there all is 0 */
        joint_state *joint = &core->joint[i];
        joint->motor.duty = on && joint->released == 0u ? number_bound(joint->pid.duty * scale, 1.0f) : 0.0f;
        outputs->joint_faults[i] = core->joint_faults[i];
        outputs->limited[i] = joint->limited;
        outputs->duty[i] = (float)core->config.joint[i].motor_direction * joint->motor.duty;
        outputs->angle_rad[i] = joint->pot.angle_rad;
        outputs->speed_rad_s[i] = joint->pid.speed_rad_s;
        outputs->reference_rad[i] = joint->reference.position_rad;
        outputs->reference_rad_s[i] = joint->reference.speed_rad_s;
    }
}

void core_tick(core_state *core, const core_inputs *inputs, core_outputs *outputs)
{
    if (core->guard_head != GUARD || core->guard_tail != GUARD) {
        *outputs = (core_outputs){.tick = inputs->tick, .state = STATE_STOPPED, .first_joint = NO_JOINT};
        return;
    }
    core->standing = 0u;
    core->not_homed = 0u;
    const bool closed = core->shorted != 0u; /* the windings, by drives on or off */
    core->supply_v = (float)inputs->supply_mv * 0.001f;
    const bool weak = inputs->supply_mv < core->config.supply_min_mv || core->supply_bad_ticks != 0u;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        const joint_config *config = &core->config.joint[i];
        joint->limited = 0u;
        measure(core, joint, config, i, inputs->counts[i]);
        joint->current_a = (float)(config->motor_direction * inputs->current_ma[i]) * 0.001f - joint->zero.now_a;
        joint->over_a = number_size(joint->current_a) - (float)config->current_limit_ma * 0.001f;
        float angle_rad = joint->pot.angle_rad;
        if (core->by_motor != 0u) {
            angle_rad = pid_measure_by_motor(joint, &config->gains);
        }
        if (closed) {
            if ((weak || joint->over_a > 0.0f) && joint->motor.duty != 0.0f) {
                /* what it does not put out is not known */
                motor_limit(&joint->motor);
            }
            if (config->motor.resistance_ohm > 0.0f) {
                motor_measure(&joint->motor, &config->motor, core->supply_v, joint->current_a, angle_rad);
            } else {
                observe(core, joint, config, angle_rad);
            }
        } else {
            motor_sleep(&joint->zero, joint->current_a);
        }
    }
    if ((core->faults & FAULT_BIT(FAULT_CURRENT_SENSOR)) != 0u) {
        safety_limit_blindly(core);
    }
    safety_watch_arm(core, inputs);
    core->tick = inputs->tick;
    core->started = 1u;
    if (inputs->stop_pressed != 0u) {
        safety_stop(core);
    }
    command_take(core, inputs);
    if (safety_drives_on(core)) {
        drive(core);
    }
    close_brakes(core);
    if (safety_drives_on(core)) {
        core->shorted = 1u;
        core->stopped_ticks = 0u;
    } else {
        rest(core);
        if (core->shorted != 0u) {
            safety_watch_rest(core);
        } else {
            safety_watch_sleep(core);
        }
    }
    report(core, outputs, inputs->supply_mv);
}
