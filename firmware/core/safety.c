#include "safety.h"

#include "number.h"
#include "pot.h"

#define FAULT_NAME(name, code, reaction, text) [code] = #name,
#define FAULT_TEXT(name, code, reaction, text) [code] = text,
#define FAULT_REACTION(name, code, reaction, text) [code] = REACTION_##reaction,
#define CODE_NAME(name, code, text) [code] = #name,
#define CODE_TEXT(name, code, text) [code] = text,

static const char *const fault_names[FAULT_COUNT] = {"NONE", FAULT_LIST(FAULT_NAME)};
static const char *const fault_texts[FAULT_COUNT] = {"no fault", FAULT_LIST(FAULT_TEXT)};
static const uint8_t fault_reactions[FAULT_COUNT] = {0, FAULT_LIST(FAULT_REACTION)};
static const char *const state_names[STATE_COUNT] = {STATE_LIST(CODE_NAME)};
static const char *const state_texts[STATE_COUNT] = {STATE_LIST(CODE_TEXT)};
static const char *const rejection_names[REJECTION_COUNT] = {"NONE", REJECTION_LIST(CODE_NAME)};
static const char *const rejection_texts[REJECTION_COUNT] = {"acknowledged", REJECTION_LIST(CODE_TEXT)};

const char *fault_name(uint32_t code) { return code < FAULT_COUNT ? fault_names[code] : "?"; }
const char *fault_text(uint32_t code) { return code < FAULT_COUNT ? fault_texts[code] : "?"; }
const char *state_name(uint32_t code) { return code < STATE_COUNT ? state_names[code] : "?"; }
const char *state_text(uint32_t code) { return code < STATE_COUNT ? state_texts[code] : "?"; }
const char *rejection_name(uint32_t code) { return code < REJECTION_COUNT ? rejection_names[code] : "?"; }
const char *rejection_text(uint32_t code) { return code < REJECTION_COUNT ? rejection_texts[code] : "?"; }

bool safety_drives_on(const core_state *core)
{
    return core->state == STATE_ENABLED || core->state == STATE_STOPPING || core->state == STATE_HOLDING;
}

void safety_raise(core_state *core, uint32_t fault, uint32_t joint)
{
    const uint32_t bit = 1u << fault;
    core->standing |= bit;
    core->faults |= bit;
    if (joint < JOINTS) {
        core->joint_faults[joint] |= bit;
    }
    if (core->first_fault == FAULT_NONE) {
        core->first_fault = fault;
        core->first_joint = joint;
    }
    uint32_t reaction = fault_reactions[fault];
    if (reaction == REACTION_CHOSEN) {
        reaction = core->config.silence_reaction;
    }
    if (core->state == STATE_STOPPED) {
        return;
    }
    if (reaction == REACTION_RELEASE || !safety_drives_on(core)) {
        core->state = STATE_FAULTED;
    } else if (core->state == STATE_ENABLED) {
        core->state = STATE_STOPPING;
    }
}

void safety_stop(core_state *core) { core->state = STATE_STOPPED; }

void safety_forget(core_state *core)
{
    core->faults = 0u;
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        core->joint_faults[joint] = 0u;
    }
    core->first_fault = FAULT_NONE;
    core->first_joint = NO_JOINT;
}

static void watch_supply(core_state *core, uint32_t supply_mv)
{
    const bool low = supply_mv < core->config.supply_min_mv;
    const bool high = supply_mv > core->config.supply_max_mv;
    core->supply_bad_ticks = low || high ? number_count(core->supply_bad_ticks) : 0u;
    if (core->supply_bad_ticks >= core->config.supply_ticks) {
        safety_raise(core, low ? FAULT_SUPPLY_LOW : FAULT_SUPPLY_HIGH, NO_JOINT);
    }
}

void safety_watch_arm(core_state *core, const core_inputs *inputs)
{
    if (core->started != 0u && inputs->tick != core->tick + 1u) {
        safety_raise(core, FAULT_TICK_MISSED, NO_JOINT);
    }
    if (inputs->overrun != 0u) {
        safety_raise(core, FAULT_TICK_OVERRUN, NO_JOINT);
    }
    watch_supply(core, inputs->supply_mv);
    for (uint32_t fault = 1u; fault < FAULT_COUNT; fault++) {
        if ((core->permanent & (1u << fault)) != 0u) {
            safety_raise(core, fault, NO_JOINT);
        }
    }
    if (core->state == STATE_ENABLED) {
        core->silent_ticks = number_count(core->silent_ticks);
        if (core->silent_ticks > core->config.silence_ticks) {
            safety_raise(core, FAULT_HOST_SILENT, NO_JOINT);
        }
    }
}

/* Return the count of ticks in a row in which something holds. */
static uint32_t in_a_row(uint32_t ticks, bool holds) { return holds ? number_count(ticks) : 0u; }

/* Return for how many ticks the joint has been driven hard without rotating. Travel is looked at, not speed: the noise
 * of a potentiometer is a speed, but it leads nowhere. */
static uint32_t joint_stands(joint_state *joint, const joint_config *config)
{
    const bool driven = number_size(joint->pid.duty) >= config->stall_duty;
    const bool rotated = number_size(joint->pid.measured_rad - joint->stall_mark_rad) > config->stall_rad;
    joint->stall_ticks = in_a_row(joint->stall_ticks, driven && !rotated);
    if (joint->stall_ticks == 0u) {
        joint->stall_mark_rad = joint->pid.measured_rad;
    }
    return joint->stall_ticks;
}

void safety_watch_joint(core_state *core, uint32_t joint, uint32_t counts)
{
    const joint_config *config = &core->config.joint[joint];
    joint_state *state = &core->joint[joint];
    const pid_state *pid = &state->pid;
    if (pot_is_inverted(&state->pot, &config->pot, pid->error_rad, pid->duty)) {
        safety_raise(core, FAULT_POT_INVERTED, joint);
    }
    if (pot_is_frozen(&state->pot, &config->pot, counts, state->setpoint.position_rad)) {
        safety_raise(core, FAULT_POT_FROZEN, joint);
    }
    if (joint_stands(state, config) >= core->config.stall_ticks) {
        safety_raise(core, FAULT_STALL, joint);
    }
    const bool behind = number_size(pid->error_rad) > config->following_rad;
    state->following_ticks = in_a_row(state->following_ticks, behind);
    if (state->following_ticks >= core->config.following_ticks) {
        safety_raise(core, FAULT_FOLLOWING, joint);
    }
}
