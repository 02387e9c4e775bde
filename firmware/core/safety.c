#include "safety.h"

#include "config.h"
#include "governor.h"
#include "motor.h"
#include "number.h"
#include "observer.h"
#include "pid.h"
#include "pot.h"
#include "setpoint.h"

#define LOST_TICKS 100u /* so many ticks lost of late are no accident; half: a burst of interrupts stops the arm,
                           double: an overloaded board moves on for longer */
#define CRC_BYTES 2u /* of the configuration looked at in a tick: all of it in less than a second; half: a flipped bit
                        shows after twice the time, double: ticks cost more */
#define OVERCURRENT_TICKS 20u /* in a row above the limit; half: a reversal trips it, double: windings heat for
                                 longer */
#define STOP_TICKS 300u /* after which an emergency stop ends with sleeping drives, braked by shorted windings until
                           then; half: a fast joint coasts, double: a bridge that conducts by itself drives on for
                           longer */
#define NAME_EARLY_TICKS 64u /* after which a weak motor may show: its reading holds it again; half: noise names,
                                double: it sinks for longer */
#define NAME_TICKS 160u /* after which a joint has shown which fault it has; half: more are named wrongly, double: the
                           arm hears of it later */
#define NAME_LATE_TICKS 480u /* likewise, where only rest shows it; half: it still moves, double: the arm hears of it
                                later */
#define MAY_REST (FAULT_BIT(FAULT_MOTOR) | FAULT_BIT(FAULT_POT_DRIFT)) /* the reading of a weak motor rests, one that
                                                                          drifts does not */
#define HELD_RAD 0.2f /* rad that a joint which its motor holds may move; half: a reading that drifts drops the arm
                         before it is known, double: a joint that cannot be held goes further */

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

extern inline bool safety_drives_on(const core_state *);

/* Begin to slow all references down in the same time, so that the arm stays on its path: the joint that needs longest
 * brakes as hard as it may, the others less. */
static void stop_along_path(core_state *core)
{
    float longest_s = TICK_S;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        const float takes_s =
            number_size(core->joint[i].reference.speed_rad_s) / core->config.joint[i].deceleration_rad_s2;
        longest_s = takes_s > longest_s ? takes_s : longest_s;
    }
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        joint->stop_rad_s2 = number_size(joint->reference.speed_rad_s) / longest_s;
        setpoint_hold(&joint->setpoint, joint->reference.position_rad);
        joint->setpoint.speed_rad_s = joint->reference.speed_rad_s;
    }
}

/* Hold a joint where it is, wherever it was to be. */
static void yield(joint_state *joint)
{
    setpoint_hold(&joint->setpoint, joint->pot.angle_rad);
    governor_hold(&joint->reference, joint->pot.angle_rad);
}

static uint32_t reaction_to(const core_state *core, uint32_t fault)
{
    const uint32_t reaction = fault_reactions[fault];
    return reaction == REACTION_CHOSEN ? core->config.silence_reaction : reaction;
}

void safety_raise(core_state *core, uint32_t fault, uint32_t joint)
{
    const uint32_t bit = FAULT_BIT(fault);
    core->standing |= bit;
    core->faults |= bit;
    if (joint < JOINTS) {
        core->joint_faults[joint] |= bit;
    }
    if (joint < JOINTS && fault_reactions[fault] == REACTION_JOINT) {
        core->joint[joint].encoder.homed = 0u; /* an encoder that missed counts has lost its zero */
    }
    if (core->first_fault == FAULT_NONE) {
        core->first_fault = fault;
        core->first_joint = joint;
    }
    const uint32_t reaction = reaction_to(core, fault);
    if (core->state == STATE_STOPPED) {
        return;
    }
    if (reaction == REACTION_RELEASE || reaction == REACTION_SLEEP || !safety_drives_on(core)) {
        core->state = STATE_FAULTED;
        return;
    }
    if (core->state == STATE_ENABLED) {
        core->state = STATE_STOPPING;
        stop_along_path(core);
    }
    if (joint < JOINTS && reaction == REACTION_JOINT) {
        core->joint[joint].released = 1u;
        core->joint[joint].motor.alone = 0u;
        core->joint[joint].suspect = FAULT_NONE;
    } else if (joint < JOINTS && reaction == REACTION_YIELD) {
        yield(&core->joint[joint]);
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

/* Watch the tick timer. What was lost fades by one in ten ticks. */
static void watch_ticks(core_state *core, uint32_t tick)
{
    const uint32_t lost = core->started != 0u ? tick - core->tick - 1u : 0u;
    if (lost != 0u) {
        safety_raise(core, FAULT_TICK_MISSED, NO_JOINT);
        core->missed += 10u * (lost < LOST_TICKS ? lost : LOST_TICKS);
    } else if (core->missed != 0u) {
        core->missed--;
    }
    if (core->missed > 10u * LOST_TICKS) {
        safety_raise(core, FAULT_TICKS_LOST, NO_JOINT);
        core->missed = 10u * LOST_TICKS;
    }
}

/* Watch the configuration in use: a few bytes a tick, the whole about once a second. */
static void watch_memory(core_state *core)
{
    const uint32_t left = (uint32_t)sizeof core->config - core->crc_at;
    const uint32_t bytes = left < CRC_BYTES ? left : CRC_BYTES;
    core->crc = config_crc_on(core->crc, (const uint8_t *)&core->config + core->crc_at, bytes);
    core->crc_at += bytes;
    if (core->crc_at < sizeof core->config) {
        return;
    }
    if (core->crc_known != 0u && core->crc != core->crc_right) {
        core->permanent |= FAULT_BIT(FAULT_MEMORY);
    }
    core->crc_right = core->crc;
    core->crc_known = 1u;
    safety_changed_config(core, true);
}

void safety_changed_config(core_state *core, bool known)
{
    core->crc_known = known ? core->crc_known : 0u;
    core->crc = 0xFFFFFFFFu;
    core->crc_at = 0u;
}

void safety_watch_arm(core_state *core, const core_inputs *inputs)
{
    watch_ticks(core, inputs->tick);
    watch_memory(core);
    if (inputs->taken_over != 0u && core->state == STATE_ENABLED) {
        safety_raise(core, FAULT_TAKEN_OVER, NO_JOINT);
    }
    if (inputs->overrun != 0u) {
        safety_raise(core, FAULT_TICK_OVERRUN, NO_JOINT);
    }
    watch_supply(core, inputs->supply_mv);
    for (uint32_t fault = 1u; core->permanent != 0u && fault < FAULT_COUNT; fault++) {
        if ((core->permanent & FAULT_BIT(fault)) != 0u) {
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

/* Return the count of ticks in a row in which something holds, looked at each WATCH_TICKS. */
static uint32_t in_a_row(uint32_t ticks, bool holds) { return holds ? number_add(ticks, WATCH_TICKS) : 0u; }

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

/* Watch a joint that is held to its limits and away from its reference by off_rad. */
static void watch_load(core_state *core, joint_state *joint, const joint_config *config, uint32_t i, float off_rad)
{
    const bool full = (joint->limited & (LIMITED_DUTY | LIMITED_CURRENT)) != 0u;
    joint->overload_ticks = in_a_row(joint->overload_ticks, full && off_rad > 0.5f * config->following_rad);
    if (joint->overload_ticks >= core->config.overload_ticks) {
        safety_raise(core, FAULT_OVERLOAD, i);
        joint->overload_ticks = 0u;
    }
}

/* Take back gains with which a joint swings. */
static void take_back_gains(core_state *core, joint_state *joint, uint32_t i)
{
    joint_gains *gains = &core->config.joint[i].gains;
    pid_change_gains(&joint->pid, gains, &core->start_gains.joint[i]);
    *gains = core->start_gains.joint[i];
    safety_changed_config(core, false);
    joint->motor.swings = 0u;
}

/* Give a fault of a joint another name, once there is evidence for it. */
static void rename_fault(core_state *core, uint32_t i, uint32_t from, uint32_t to)
{
    core->joint_faults[i] &= ~FAULT_BIT(from);
    core->joint_faults[i] |= FAULT_BIT(to);
    uint32_t joints = 0u;
    for (uint32_t other = 0u; other < JOINTS; other++) {
        joints |= core->joint_faults[other];
    }
    core->faults &= joints | ~FAULT_BIT(from);
    core->faults |= FAULT_BIT(to);
    if (core->first_fault == from && core->first_joint == i) {
        core->first_fault = to;
    }
}

/* Raise a fault of a joint's drive: other faults of the joint came of it. */
static void blame(core_state *core, joint_state *joint, uint32_t fault, uint32_t i)
{
    if (core->first_joint == i) {
        rename_fault(core, i, core->first_fault, fault);
    }
    safety_raise(core, fault, i);
    joint->suspect = fault == FAULT_CURRENT_SENSOR ? fault : FAULT_NONE;
    core->shorted = fault == FAULT_BRIDGE ? 0u : core->shorted;
}

/* Hold a joint by its reading: its motor is no witness any more, until the drives were off. */
static void doubt_motor(joint_state *joint, const joint_config *config)
{
    motor_doubt(&joint->motor, &config->motor);
    if (joint->released != 0u) {
        joint->motor.sampled = 0u; /* what it did meanwhile it was not driven to */
        pid_reset(&joint->pid, joint->pot.angle_rad);
    }
    if ((joint->released | joint->motor.alone) != 0u) {
        joint->released = joint->motor.alone = 0u;
        joint->pid.measured_rad = joint->pot.angle_rad;
        yield(joint);
    }
}

/* Hold a joint by its motor: whichever of both is wrong, a back-EMF of nothing is rest, and the reading shows there
 * what it is. */
static void doubt_reading(core_state *core, joint_state *joint)
{
    joint->released = 0u;
    core->by_motor = 1u;
    motor_recall(&joint->motor);
    joint->held_rad = joint->pot.angle_rad;
    joint->held_rad_s = joint->pid.speed_rad_s;
    yield(joint);
}

/* Watch a joint's current. */
static void watch_current(core_state *core, joint_state *joint, const joint_config *config, uint32_t i)
{
    motor_state *motor = &joint->motor;
    const bool hot = joint->over_a > (float)config->current_limit_ma * 0.001f; /* more than twice the limit */
    motor->current_ticks = in_a_row(motor->current_ticks, hot);
    if (motor->current_ticks >= OVERCURRENT_TICKS) {
        safety_raise(core, FAULT_OVERCURRENT, i);
    }
}

/* Watch a joint that its motor holds. Where its current fails, too, or it leaves its position by the motor or by a
 * reading that may be right, nothing holds it: the arm is let go of, which closes the brakes. */
static void watch_held(core_state *core, joint_state *joint, const joint_config *config, uint32_t i)
{
    motor_warms(&joint->motor, &config->motor, WATCH_TICKS);
    const bool blind = joint->suspect == FAULT_NONE && motor_answers_otherwise(&joint->motor, &config->motor);
    const bool reads = (core->joint_faults[i] & FAULT_BIT(FAULT_MOTOR)) != 0u ||
                       (joint->suspect == FAULT_POT_DRIFT && joint->suspect_ticks < NAME_TICKS);
    const float read_rad = reads ? number_size(joint->pot.angle_rad - joint->reference.position_rad) : 0.0f;
    const float motor_rad = 2.0f * number_size(joint->pid.error_rad); /* so far a joint goes whose motor has half of its
                                                                         constant */
    if (blind || read_rad > HELD_RAD || motor_rad > HELD_RAD) {
        safety_raise(core, blind ? FAULT_CURRENT_SENSOR : FAULT_FOLLOWING, i);
        core->state = STATE_FAULTED;
    }
    watch_current(core, joint, config, i);
}

/* Watch the motor: as a witness of the motion, and for itself. */
static void watch_motor(core_state *core, joint_state *joint, const joint_config *config, uint32_t i)
{
    motor_state *motor = &joint->motor;
    if (motor_is_apart(motor, &config->motor) || motor->none_samples >= MOTOR_NONE_SAMPLES) {
        const uint32_t fault = motor_disagrees(motor, &config->motor, core->supply_v);
        joint->suspect_ticks = 0u;
        if (fault == FAULT_CURRENT_SENSOR) {
            doubt_motor(joint, config);
            blame(core, joint, fault, i);
        } else {
            safety_raise(core, fault, i);
            joint->suspect = fault;
            const bool rests = fault == FAULT_POT_FROZEN && joint->reference.speed_rad_s == 0.0f;
            if (motor->trust == 1.0f || rests || fault == FAULT_POT_DRIFT) {
                /* else coasting shows the reading's share, whatever R is */
                doubt_reading(core, joint);
            }
        }
    } else if (motor->weakened != 0u && !motor_answers_otherwise(motor, &config->motor)) {
        doubt_motor(joint, config);
        blame(core, joint, FAULT_MOTOR, i);
        core->joint_faults[i] |= motor->weakened;
        core->faults |= motor->weakened;
    }
}

void safety_limit_blindly(core_state *core)
{
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        const joint_config *config = &core->config.joint[i];
        if (joint->motor.doubted != 0u && (core->joint_faults[i] & FAULT_BIT(FAULT_CURRENT_SENSOR)) != 0u) {
            const float drawn_a = motor_draws(&joint->motor, &config->motor, core->supply_v, joint->pid.speed_rad_s);
            joint->over_a = number_size(drawn_a) - (float)config->current_limit_ma * 0.001f;
        }
    }
}

/* Return whether a joint whose motor is not watched is driven by its bridge, which does not follow its duty. */
static bool runs_on(const core_state *core, joint_state *joint, const joint_config *config, bool off)
{
    if (config->motor.resistance_ohm > 0.0f || config->transmission.twist_rad_per_a > 0.0f) {
        return false; /* the motor shows it; and a spring drives a joint, too */
    }
    const float supply_duty = 1000.0f * core->supply_v / (float)core->config.supply_nominal_mv;
    const float fast = number_size(joint->pid.speed_rad_s) / config->speed_limit_rad_s;
    const bool driven = observer_is_driven(&joint->observer, supply_duty, fast, off);
    const bool powered = core->supply_v >= 0.001f * (float)core->config.supply_min_mv;
    return driven && powered; /* without a supply a load or a hand moves it */
}

/* Return whether the reading holds a joint with one of these faults: a weak motor, or a reading that goes too far. */
static bool may_hold(uint32_t parts) { return (parts & ~FAULT_BIT(FAULT_POT_SCALE)) == FAULT_BIT(FAULT_MOTOR); }

/* Give a suspected fault its name; where parts cannot be distinguished, those of all. */
static void name(core_state *core, joint_state *joint, const joint_config *config, uint32_t parts, uint32_t i)
{
    uint32_t fault = 1u;
    while ((parts & FAULT_BIT(fault)) == 0u) {
        fault++;
    }
    if (may_hold(parts)) {
        doubt_motor(joint, config);
    } else if (joint->released != 0u) {
        pid_reset(&joint->pid, joint->pot.angle_rad);
        doubt_reading(core, joint);
    }
    rename_fault(core, i, joint->suspect, fault);
    core->joint_faults[i] |= parts;
    core->faults |= parts;
    joint->suspect = FAULT_NONE;
}

/* Give a fault by which motor and reading disagreed its right name, once the motion since then shows it. Letting go of
 * a joint asks whose fault it is: where the back-EMF goes on without a step, the motor is a good witness. */
static void name_suspect(core_state *core, joint_state *joint, const joint_config *config, uint32_t i)
{
    motor_state *motor = &joint->motor;
    const bool stepped = motor_stepped(motor);
    const bool asked = (stepped || motor->doubted != 0u) && motor->trust == 1.0f;
    if (motor_is_stuck(motor, &config->motor, core->supply_v, &core->sums) ||
        (asked && motor_disobeys(motor, &config->motor, core->supply_v, joint->pid.error_rad))) {
        blame(core, joint, motor_is_dead(motor, &config->motor) ? FAULT_CURRENT_SENSOR : FAULT_BRIDGE, i);
        core->state = STATE_FAULTED; /* nothing holds it but a brake */
        return;
    }
    if (joint->suspect == FAULT_NONE) {
        return;
    }
    if (motor->doubted != 0u) {
        motor_weakens(motor, &config->motor, &core->sums);
    }
    /* What a load takes shows at rest. */
    const bool shows = motor->doubted == 0u || joint->reference.speed_rad_s == 0.0f;
    joint->suspect_ticks = in_a_row(joint->suspect_ticks, shows);
    if (motor->doubted == 0u && (stepped || motor_answers_otherwise(motor, &config->motor))) {
        doubt_motor(joint, config);
        rename_fault(core, i, joint->suspect, FAULT_CURRENT_SENSOR);
        joint->suspect = FAULT_CURRENT_SENSOR;
    }
    if (joint->suspect_ticks < NAME_EARLY_TICKS) {
        return;
    }
    const bool due = joint->suspect_ticks >= NAME_TICKS;
    if (motor->doubted == 0u) {
        const uint32_t parts = motor_names(motor, &config->motor, joint->suspect, &core->sums);
        const bool settled = (parts & MAY_REST) == 0u || joint->suspect_ticks >= NAME_LATE_TICKS;
        if (may_hold(parts) || (due && settled)) {
            name(core, joint, config, parts, i);
        } else if (due && parts == FAULT_BIT(FAULT_POT_DRIFT)) {
            rename_fault(core, i, joint->suspect, FAULT_POT_DRIFT);
            joint->suspect = FAULT_POT_DRIFT;
        }
    } else if (due) {
        const float dry_v = config->gains.kf_duty * (float)core->config.supply_nominal_mv * 0.001f;
        name(core, joint, config, motor_blames(motor, &config->motor, dry_v), i);
    }
}

static void watch_joint(core_state *core, joint_state *joint, const joint_config *config, uint32_t i)
{
    if ((joint->released | joint->motor.doubted | joint->motor.alone) != 0u) {
        name_suspect(core, joint, config, i);
        if (joint->motor.alone != 0u && safety_drives_on(core)) {
            watch_held(core, joint, config, i);
            return;
        }
    }
    if (runs_on(core, joint, config, joint->released != 0u)) {
        blame(core, joint, FAULT_BRIDGE, i);
    }
    if (joint->released != 0u || !safety_drives_on(core)) {
        return;
    }
    const float off_rad = number_size(joint->pid.error_rad);
    if (joint->motor.doubted == 0u) {
        watch_motor(core, joint, config, i);
    }
    if (motor_is_fast(&joint->motor, &config->motor, joint->pid.speed_rad_s)) {
        /* by the reading where the motor is no witness */
        safety_raise(core, FAULT_OVERSPEED, i);
    }
    watch_current(core, joint, config, i);
    if (motor_swings(&joint->motor, joint->pid.speed_rad_s, joint->reference.speed_rad_s, config->speed_limit_rad_s)) {
        safety_raise(core, FAULT_OSCILLATION, i);
        take_back_gains(core, joint, i);
        if (joint->motor.doubted == 0u && motor_answers_otherwise(&joint->motor, &config->motor)) {
            /* it swings for that */
            doubt_motor(joint, config);
            blame(core, joint, FAULT_CURRENT_SENSOR, i);
        }
    }
    watch_load(core, joint, config, i, off_rad);
    if (pot_is_inverted(&joint->pot, &config->pot, joint->pid.error_rad, joint->pid.duty)) {
        /* Where the motor is no witness, an inversion cannot be distinguished from a push: take the worse. */
        const bool witnessed = config->motor.resistance_ohm > 0.0f;
        safety_raise(core, witnessed ? FAULT_PUSHED : FAULT_POT_INVERTED, i);
        pot_watch(&joint->pot, joint->reference.position_rad);
    }
    if (pot_is_frozen(&joint->pot, &config->pot, joint->reference.position_rad)) {
        safety_raise(core, FAULT_POT_FROZEN, i);
    }
    if (joint_stands(joint, config) >= core->config.stall_ticks) {
        safety_raise(core, FAULT_STALL, i);
    }
    joint->following_ticks = in_a_row(joint->following_ticks, off_rad > config->following_rad);
    if (joint->following_ticks >= core->config.following_ticks) {
        safety_raise(core, FAULT_FOLLOWING, i);
    }
}

void safety_watch_joints(core_state *core)
{
    for (uint32_t i = core->tick % WATCH_TICKS; i < core->config.joint_count; i += WATCH_TICKS) {
        watch_joint(core, &core->joint[i], &core->config.joint[i], i);
    }
}

void safety_watch_rest(core_state *core)
{
    core->stopped_ticks = core->state == STATE_STOPPED ? core->stopped_ticks + 1u : 0u;
    if (core->stopped_ticks >= STOP_TICKS) {
        core->shorted = 0u;
    }
    for (uint32_t i = core->tick % WATCH_TICKS; i < core->config.joint_count; i += WATCH_TICKS) {
        joint_state *joint = &core->joint[i];
        const joint_config *config = &core->config.joint[i];
        joint->motor.stepped_off |= motor_may_have_stepped(&joint->motor) ? 1u : 0u;
        if ((joint->motor.stepped_off != 0u &&
             motor_disobeys(&joint->motor, &config->motor, core->supply_v, 0.0f)) ||
            runs_on(core, joint, config, true)) {
            blame(core, joint, FAULT_BRIDGE, i);
        }
    }
}

void safety_watch_sleep(core_state *core)
{
    core->stopped_ticks = 0u;
    for (uint32_t i = 0u; i < core->config.joint_count; i++) {
        joint_state *joint = &core->joint[i];
        const motor_config *motor = &core->config.joint[i].motor;
        const bool bridge = (core->joint_faults[i] & FAULT_BIT(FAULT_BRIDGE)) != 0u;
        if (!bridge || !motor_flows_asleep(&joint->zero, motor, core->supply_v)) {
            continue;
        }
        /* Or the bridge conducts asleep: only a free joint that rests all the same shows that it does not. */
        core->joint_faults[i] |= FAULT_BIT(FAULT_CURRENT_SENSOR);
        core->faults |= FAULT_BIT(FAULT_CURRENT_SENSOR);
        const bool rests = number_size(joint->pot.angle_rad - joint->motor.last_rad) < motor->apart_rad;
        if (rests && core->config.brake_engage_ticks == 0u) {
            rename_fault(core, i, FAULT_BRIDGE, FAULT_CURRENT_SENSOR);
        }
    }
}
