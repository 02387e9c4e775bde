#include "command.h"

#include "encoder.h"
#include "governor.h"
#include "motor.h"
#include "number.h"
#include "observer.h"
#include "pid.h"
#include "pot.h"
#include "safety.h"
#include "setpoint.h"

/* Begin to drive a joint from where it is, at rest, with limits that let it move in but never further out. */
static void start_joint(joint_state *joint, const joint_config *config, uint32_t nominal_mv, uint32_t i)
{
    const float angle_rad = joint->pot.angle_rad;
    const float speed_rad_s = joint->pid.speed_rad_s;
    pid_reset(&joint->pid, angle_rad);
    joint->pid.speed_rad_s = speed_rad_s; /* the filter runs on: a coasting joint is braked from the first tick */
    setpoint_hold(&joint->setpoint, angle_rad);
    governor_hold(&joint->reference, angle_rad);
    motor_start(&joint->motor, angle_rad, config->speed_limit_rad_s, i);
    const float ka_mv = config->gains.ka_s2_per_rad * (float)nominal_mv; /* J R / K by 1000 */
    joint->motor.swift_per_a = ka_mv > 0.0f ? config->motor.resistance_ohm / ka_mv : 0.0f;
    joint->released = 0u;
    observer_move(&joint->observer, angle_rad);
    joint->observer.speed_rad_s = speed_rad_s;
    joint->zero.ticks = 0u;
    joint->suspect = FAULT_NONE;
    pot_watch(&joint->pot, angle_rad);
    joint->low_rad = angle_rad < config->soft_min_rad ? angle_rad : config->soft_min_rad;
    joint->high_rad = angle_rad > config->soft_max_rad ? angle_rad : config->soft_max_rad;
    joint->gravity_duty = 0.0f;
    joint->gravity_asked = 0.0f;
    joint->duty_cap = config->duty_limit;
    joint->following_ticks = 0u;
    joint->stall_ticks = 0u;
    joint->overload_ticks = 0u;
    joint->stall_mark_rad = angle_rad;
    joint->held_back = 0u;
}

static uint32_t enable(core_state *core, bool inward)
{
    const bool held = core->state == STATE_HOLDING;
    if (core->state != STATE_DISABLED && !(held && core->faults == 0u)) {
        return REJECTION_WRONG_STATE;
    }
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        const joint_config *config = &core->config.joint[i];
        if (!pot_is_read(&core->joint[i].pot)) {
            return REJECTION_POT_UNREAD;
        }
        if (!encoder_is_homed(&core->joint[i].encoder, config)) {
            return REJECTION_NOT_HOMED;
        }
        if (!inward && !number_within(core->joint[i].pot.angle_rad, config->soft_min_rad, config->soft_max_rad)) {
            return REJECTION_OUTSIDE_LIMITS;
        }
    }
    core->by_motor = 0u;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        const transmission_config *between = &core->config.joint[i].transmission;
        core->by_motor |= between->twist_rad_per_a + between->damping_share > 0.0f ? 1u : 0u;
        if (!held || (core->joint[i].released | core->joint[i].motor.alone) != 0u) {
            /* what is held stays where it is held */
            start_joint(&core->joint[i], &core->config.joint[i], core->config.supply_nominal_mv, i);
            motor_through(&core->joint[i].motor, between);
        }
    }
    core->state = STATE_ENABLED;
    core->silent_ticks = 0u;
    core->brake_ticks = held ? 0u : core->config.brake_release_ticks;
    return REJECTION_NONE;
}

static uint32_t disable(core_state *core)
{
    if (core->state == STATE_STOPPED) {
        return REJECTION_WRONG_STATE;
    }
    if (safety_drives_on(core) && core->config.brake_engage_ticks != 0u) {
        for (uint32_t i = 0u; i < core->config.joint_count; i++) {
            setpoint_hold(&core->joint[i].setpoint, core->joint[i].reference.position_rad);
            governor_hold(&core->joint[i].reference, core->joint[i].reference.position_rad);
        }
        core->closing = 1u;
        core->brake_ticks = core->config.brake_engage_ticks;
        return REJECTION_NONE;
    }
    core->state = core->faults != 0u ? STATE_FAULTED : STATE_DISABLED;
    return REJECTION_NONE;
}

static uint32_t clear_faults(core_state *core)
{
    if (core->state == STATE_STOPPED || core->state == STATE_STOPPING) {
        return REJECTION_WRONG_STATE;
    }
    bool stands = core->standing != 0u;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) { /* a joint without its witness is held, and no more */
        stands = stands || (safety_drives_on(core) && core->joint[i].motor.doubted != 0u);
    }
    if (stands) {
        return REJECTION_FAULT_STANDS;
    }
    safety_forget(core);
    if (core->state == STATE_FAULTED) {
        core->state = STATE_DISABLED;
    } /* a held arm stays held, until it is enabled */
    return REJECTION_NONE;
}

static uint32_t clear_stop(core_state *core, bool pressed)
{
    if (core->state != STATE_STOPPED) {
        return REJECTION_WRONG_STATE;
    }
    if (pressed) {
        return REJECTION_STOP_PRESSED;
    }
    core->state = core->faults != 0u ? STATE_FAULTED : STATE_DISABLED;
    return REJECTION_NONE;
}

static uint32_t check_move(const core_state *core, const move_command *move)
{
    const bool lasts = move->duration_ticks >= 1u && move->duration_ticks <= 10000u;
    float nothing = 0.0f; /* stays so unless a number is none */
    float most_duty = 0.0f;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        const float duty = number_size(move->gravity_duty[i]);
        nothing += 0.0f * move->position_rad[i] + 0.0f * move->speed_rad_s[i] + 0.0f * duty;
        most_duty = duty > most_duty ? duty : most_duty;
    }
    if (nothing != 0.0f) {
        return REJECTION_NOT_FINITE;
    }
    return lasts && most_duty <= 1.0f ? REJECTION_NONE : REJECTION_OUT_OF_RANGE;
}

static void move_joint(joint_state *joint, const joint_config *config, const move_command *move, uint32_t i)
{
    const float limit_rad_s = config->speed_limit_rad_s;
    float to_rad = move->position_rad[i];
    float to_rad_s = number_bound(move->speed_rad_s[i], limit_rad_s);
    uint32_t held_back = to_rad_s != move->speed_rad_s[i] ? LIMITED_SPEED : 0u;
    if (!number_within(to_rad, joint->low_rad, joint->high_rad)) {
        to_rad = number_clamp(to_rad, joint->low_rad, joint->high_rad);
        held_back |= LIMITED_SOFT;
        to_rad_s = 0.0f; /* it ends at the limit, so it ends at rest */
    }
    if (setpoint_aim(&joint->setpoint, to_rad, to_rad_s, move->duration_ticks, limit_rad_s)) {
        held_back |= LIMITED_SPEED;
    }
    joint->held_back = held_back;
    joint->gravity_asked = move->gravity_duty[i];
}

static uint32_t take_move(core_state *core, const move_command *move)
{
    const bool ready = core->state == STATE_ENABLED && core->closing == 0u;
    const uint32_t rejection = ready ? check_move(core, move) : REJECTION_WRONG_STATE;
    if (rejection != REJECTION_NONE) {
        return rejection;
    }
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        move_joint(&core->joint[i], &core->config.joint[i], move, i);
    }
    core->silent_ticks = 0u;
    return REJECTION_NONE;
}

static uint32_t take_gains(core_state *core, const gain_set *gains)
{
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        if (!pid_gains_in_range(&gains->joint[i])) {
            return pid_gains_finite(&gains->joint[i]) ? REJECTION_OUT_OF_RANGE : REJECTION_NOT_FINITE;
        }
    }
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        pid_change_gains(&core->joint[i].pid, &core->config.joint[i].gains, &gains->joint[i]);
        core->config.joint[i].gains = gains->joint[i];
    }
    safety_changed_config(core, false);
    return REJECTION_NONE;
}

/* Take the arm, which somebody has brought to its home, as being there. */
static uint32_t home(core_state *core)
{
    if (safety_drives_on(core)) {
        return REJECTION_WRONG_STATE;
    }
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        encoder_home(&joint->encoder, &core->config.joint[i]);
        joint->pot.valid = joint->encoder.homed != 0u ? 0u : joint->pot.valid; /* its next angle is no jump */
    }
    return REJECTION_NONE;
}

static uint32_t execute(core_state *core, const core_inputs *inputs)
{
    const core_command *command = &inputs->command;
    switch (command->kind) {
    case COMMAND_MOVE:
        return take_move(core, &command->move);
    case COMMAND_ENABLE:
        return enable(core, false);
    case COMMAND_ENABLE_INWARD:
        return enable(core, true);
    case COMMAND_DISABLE:
        return disable(core);
    case COMMAND_CLEAR_FAULTS:
        return clear_faults(core);
    case COMMAND_CLEAR_STOP:
        return clear_stop(core, inputs->stop_pressed != 0u);
    case COMMAND_GAINS:
        return take_gains(core, &command->gains);
    case COMMAND_HOME:
        return home(core);
    default:
        return REJECTION_UNKNOWN_COMMAND;
    }
}

void command_take(core_state *core, const core_inputs *inputs)
{
    if (inputs->command.kind == COMMAND_NONE) {
        return;
    }
    const uint32_t rejection = execute(core, inputs);
    if (rejection == REJECTION_NONE) {
        core->acknowledged_sequence = inputs->command.sequence;
        core->acknowledged_count++;
    } else {
        core->rejected_sequence = inputs->command.sequence;
        core->rejected_count++;
        core->rejection = rejection;
    }
}
