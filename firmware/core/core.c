#include "core.h"

#include "command.h"
#include "config.h"
#include "number.h"
#include "pid.h"
#include "pot.h"
#include "safety.h"
#include "setpoint.h"

#define GUARD 0xA5C3965Au

void core_init(core_state *core, const core_config *config, uint32_t source, bool watchdog_reset)
{
    *core = (core_state){.guard_head = GUARD, .first_joint = NO_JOINT, .guard_tail = GUARD};
    const bool usable = source != CONFIG_FACTORY && config_is_valid(config);
    if (usable) {
        core->config = *config;
    } else {
        config_factory(&core->config);
        core->permanent = 1u << FAULT_CONFIG;
        safety_raise(core, FAULT_CONFIG, NO_JOINT);
    }
    if (watchdog_reset) {
        safety_raise(core, FAULT_WATCHDOG, NO_JOINT);
    }
}

/* Read a potentiometer into the joint. */
static void measure(core_state *core, uint32_t i, uint32_t counts)
{
    joint_state *joint = &core->joint[i];
    const joint_config *config = &core->config.joint[i];
    const bool known = joint->pot.valid != 0u;
    const uint32_t fault = pot_read(&joint->pot, &config->pot, counts, core->config.pot_ticks);
    if (fault != FAULT_NONE) {
        safety_raise(core, fault, i);
    }
    if (!known || fault != FAULT_NONE) {
        pid_reset(&joint->pid, joint->pot.angle_rad); /* a new position is no speed */
    } else {
        pid_measure(&joint->pid, &config->gains, joint->pot.angle_rad);
    }
}

/* Move a joint's reference by one tick; returns whether it is at rest. */
static bool advance(joint_state *joint, const joint_config *config, bool slowing)
{
    bool resting = false;
    if (slowing) {
        resting = setpoint_slow(&joint->setpoint, config->deceleration_rad_s2);
        joint->held_back = 0u;
    } else {
        setpoint_advance(&joint->setpoint);
        joint->limited |= joint->held_back;
    }
    if (setpoint_clamp(&joint->setpoint, joint->low_rad, joint->high_rad)) {
        joint->limited |= LIMITED_SOFT;
    }
    /* Limits that were widened for a joint outside close in behind it. */
    joint->low_rad = number_clamp(joint->setpoint.position_rad, joint->low_rad, config->soft_min_rad);
    joint->high_rad = number_clamp(joint->setpoint.position_rad, config->soft_max_rad, joint->high_rad);
    return resting;
}

static void advance_arm(core_state *core)
{
    const bool slowing = core->state == STATE_STOPPING;
    bool resting = true;
    for (uint32_t i = 0u; i < JOINTS; i++) {
        const bool joint_rests = advance(&core->joint[i], &core->config.joint[i], slowing);
        resting = resting && joint_rests;
    }
    if (slowing && resting) {
        core->state = STATE_HOLDING;
    }
}

static void control(joint_state *joint, const joint_config *config, uint32_t current_ma)
{
    const float over_a = ((float)current_ma - (float)config->current_limit_ma) * 0.001f;
    joint->duty_cap =
        number_clamp(joint->duty_cap - config->current_cut_per_a_s * over_a * TICK_S, 0.0f, config->duty_limit);
    const pid_demand demand = {.reference_rad = joint->setpoint.position_rad,
                               .reference_rad_s = joint->setpoint.speed_rad_s,
                               .gravity_duty = joint->gravity_duty,
                               .duty_limit = config->duty_limit,
                               .duty_cap = joint->duty_cap,
                               .duty_slew_per_s = config->duty_slew_per_s};
    (void)pid_step(&joint->pid, &config->gains, &demand, &joint->limited);
}

/* Drive every joint, watch what comes of it. */
static void drive(core_state *core, const core_inputs *inputs)
{
    advance_arm(core);
    for (uint32_t i = 0u; i < JOINTS; i++) {
        control(&core->joint[i], &core->config.joint[i], inputs->current_ma[i]);
        safety_watch_joint(core, i, inputs->counts[i]);
    }
}

/* Let the references rest where the joints are, so that nothing is left of the last motion. */
static void rest(core_state *core)
{
    for (uint32_t i = 0u; i < JOINTS; i++) {
        joint_state *joint = &core->joint[i];
        setpoint_hold(&joint->setpoint, joint->pot.angle_rad);
        joint->pid.integral_duty = 0.0f;
        joint->pid.duty = 0.0f;
        joint->pid.error_rad = 0.0f;
        joint->pid.reference_rad_s = 0.0f;
        joint->limited = 0u;
    }
}

/* Write every field of the outputs. */
static void report(const core_state *core, core_outputs *outputs)
{
    outputs->tick = core->tick;
    outputs->drives_on = safety_drives_on(core) ? 1u : 0u;
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
    for (uint32_t i = 0u; i < JOINTS; i++) {
        const joint_state *joint = &core->joint[i];
        outputs->joint_faults[i] = core->joint_faults[i];
        outputs->limited[i] = joint->limited;
        outputs->duty[i] = (float)core->config.joint[i].motor_direction * joint->pid.duty;
        outputs->angle_rad[i] = joint->pot.angle_rad;
        outputs->speed_rad_s[i] = joint->pid.speed_rad_s;
        outputs->reference_rad[i] = joint->setpoint.position_rad;
        outputs->reference_rad_s[i] = joint->setpoint.speed_rad_s;
    }
}

void core_tick(core_state *core, const core_inputs *inputs, core_outputs *outputs)
{
    if (core->guard_head != GUARD || core->guard_tail != GUARD) {
        *outputs = (core_outputs){.tick = inputs->tick, .state = STATE_STOPPED, .first_joint = NO_JOINT};
        return;
    }
    core->standing = 0u;
    for (uint32_t i = 0u; i < JOINTS; i++) {
        core->joint[i].limited = 0u;
        measure(core, i, inputs->counts[i]);
    }
    safety_watch_arm(core, inputs);
    core->tick = inputs->tick;
    core->started = 1u;
    if (inputs->stop_pressed != 0u) {
        safety_stop(core);
    }
    command_take(core, inputs);
    if (safety_drives_on(core)) {
        drive(core, inputs);
    }
    if (!safety_drives_on(core)) {
        rest(core);
    }
    report(core, outputs);
}
