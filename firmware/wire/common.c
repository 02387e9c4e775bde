/* MAVLink's common messages, for tools that know no other: mavutil, ground control. docs/reference/mavlink.md.
 *
 * They reach the core as the dialect's own commands do, but with numbers of their own, of which the session's owner
 * hears nothing. One of them waits for the core's answer at a time; a tool repeats what got none. */
#include <float.h>
#include <stddef.h>
#include <string.h>

#include "common.h"
#include "config.h"
#include "encoder.h"
#include "inside.h"
#include "number.h"
#include "safety.h"

#define OWNER_TICKS 2000u /* an owner that was silent for so long, with the drives off, has left */
#define SEQUENCES 0xC0000000u
#define SECOND_TICKS TICKS_PER_S
#define MOST_WORD 1e7f /* floats carry whole numbers up to here */
#define TEXT_BYTES 160u

/* MAVLink's numbers, as its common.xml has them. */
enum {
    MAV_CMD_DO_FLIGHTTERMINATION = 185,
    MAV_CMD_PREFLIGHT_STORAGE = 245,
    MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN = 246,
    MAV_CMD_COMPONENT_ARM_DISARM = 400,
    MAV_CMD_SET_MESSAGE_INTERVAL = 511,
    MAV_RESULT_ACCEPTED = 0,
    MAV_RESULT_TEMPORARILY_REJECTED = 1,
    MAV_RESULT_DENIED = 2,
    MAV_RESULT_UNSUPPORTED = 3,
    MAV_RESULT_FAILED = 4,
    MAV_AUTOPILOT_INVALID = 8,
    MAV_MODE_FLAG_CUSTOM_MODE_ENABLED = 1,
    MAV_MODE_FLAG_SAFETY_ARMED = 128,
    MAV_STATE_STANDBY = 3,
    MAV_STATE_ACTIVE = 4,
    MAV_STATE_CRITICAL = 5,
    MAV_STATE_EMERGENCY = 6,
    MAV_SEVERITY_ALERT = 1,
    MAV_SEVERITY_ERROR = 3,
    MAV_SEVERITY_WARNING = 4,
    MAV_PARAM_TYPE_REAL32 = 9,
};
#define SENSOR_MOTOR_OUTPUTS (1u << 15) /* MAV_SYS_STATUS_SENSOR_ */
#define SENSOR_BATTERY (1u << 25)
#define PREARM_CHECK (1u << 28)

/* What the answer of the core is for. */
enum { WAITS_NOT = 0, WAITS_COMMAND = 1, WAITS_DISARM = 2, WAITS_TO_CLEAR = 3, WAITS_CLEAR = 4, WAITS_PARAM = 5 };

/* ---- parameters ---- */

typedef struct param_kind {
    const char *name;
    uint32_t offset;
    uint32_t is_word; /* not 0: a uint32_t, a float otherwise */
} param_kind;

#define GAIN(name, field) {name, (uint32_t)offsetof(joint_config, gains.field), 0u}
#define LIMIT(name, field) {name, (uint32_t)offsetof(joint_config, field), 0u}
/* Of every joint, named J1_KP and so on; the gains first, in their order. */
static const param_kind joint_params[] = {
    GAIN("KP", kp_per_rad),
    GAIN("KI", ki_per_rad_s),
    GAIN("KD", kd_s_per_rad),
    GAIN("KV", kv_s_per_rad),
    GAIN("KA", ka_s2_per_rad),
    GAIN("KF", kf_duty),
    GAIN("DFILTER", derivative_filter_s),
    GAIN("ANTIWINDUP", anti_windup_per_s),
    LIMIT("MIN", soft_min_rad),
    LIMIT("MAX", soft_max_rad),
    LIMIT("SPEED", speed_limit_rad_s),
    LIMIT("DECEL", deceleration_rad_s2),
    LIMIT("ACCEL", acceleration_rad_s2),
    LIMIT("JERK", jerk_rad_s3),
    LIMIT("DUTY", duty_limit),
    LIMIT("DUTYSLEW", duty_slew_per_s),
    LIMIT("FOLLOWING", following_rad),
    LIMIT("BACKLASH", motor.backlash_rad),
    {"CURRENT_MA", (uint32_t)offsetof(joint_config, current_limit_ma), 1u},
};
static const param_kind arm_params[] = {
    {"SUPPLY_MIN_MV", (uint32_t)offsetof(core_config, supply_min_mv), 1u},
    {"SUPPLY_MAX_MV", (uint32_t)offsetof(core_config, supply_max_mv), 1u},
    {"SILENCE_TICKS", (uint32_t)offsetof(core_config, silence_ticks), 1u},
};
#define GAINS_OF_JOINT ((uint32_t)(sizeof(joint_gains) / sizeof(float)))
#define PARAMS_OF_JOINT ((uint32_t)(sizeof joint_params / sizeof joint_params[0]))
#define PARAMS_OF_ARM ((uint32_t)(sizeof arm_params / sizeof arm_params[0]))
#define PARAMS (JOINTS * PARAMS_OF_JOINT + PARAMS_OF_ARM)
#define NAME_BYTES 16u

static bool is_gain(uint32_t param)
{
    return param < JOINTS * PARAMS_OF_JOINT && param % PARAMS_OF_JOINT < GAINS_OF_JOINT;
}

static const param_kind *kind_of(uint32_t param)
{
    return param < JOINTS * PARAMS_OF_JOINT ? &joint_params[param % PARAMS_OF_JOINT]
                                            : &arm_params[param - JOINTS * PARAMS_OF_JOINT];
}

/* Return where a parameter lies in core_config, bytes. */
static uint32_t offset_of(uint32_t param)
{
    const uint32_t of_joint =
        param < JOINTS * PARAMS_OF_JOINT ? param / PARAMS_OF_JOINT * (uint32_t)sizeof(joint_config) : 0u;
    return of_joint + kind_of(param)->offset;
}

/* Write a parameter's name; zeros fill it up. */
static void name_of(uint32_t param, char name[NAME_BYTES])
{
    uint32_t at = 0u;
    memset(name, 0, NAME_BYTES);
    if (param < JOINTS * PARAMS_OF_JOINT) {
        name[0] = 'J';
        name[1] = (char)('1' + param / PARAMS_OF_JOINT);
        name[2] = '_';
        at = 3u;
    }
    for (const char *from = kind_of(param)->name; *from != '\0' && at < NAME_BYTES; from++) {
        name[at] = *from;
        at++;
    }
}

/* Return the parameter of this name, PARAMS where there is none. */
static uint32_t named(const char name[NAME_BYTES])
{
    char each[NAME_BYTES];
    for (uint32_t param = 0u; param < PARAMS; param++) {
        uint32_t same = 0u;
        name_of(param, each);
        while (same < NAME_BYTES && each[same] == name[same] && each[same] != '\0') {
            same++;
        }
        if (same == NAME_BYTES || each[same] == name[same]) {
            return param;
        }
    }
    return PARAMS;
}

/* Return a parameter: a gain in use, a limit as PARAM_SET left it, or else in use. */
static float param_value(const wire_state *wire, uint32_t param)
{
    uint8_t bytes[4];
    if (wire->common.params_staged != 0u && !is_gain(param)) {
        memcpy(bytes, (const uint8_t *)&wire->staged.config + offset_of(param), sizeof bytes);
    } else {
        settings_copy(wire, offset_of(param), bytes, sizeof bytes);
    }
    float value;
    uint32_t word;
    memcpy(&value, bytes, sizeof value);
    memcpy(&word, bytes, sizeof word);
    return kind_of(param)->is_word != 0u ? (float)word : value;
}

static void put_param(wire_state *wire, uint32_t param)
{
    mavlink_param_value_t answer = {.param_value = param_value(wire, param),
                                    .param_count = PARAMS,
                                    .param_index = (uint16_t)param,
                                    .param_type = MAV_PARAM_TYPE_REAL32};
    name_of(param, answer.param_id);
    mavlink_message_t message;
    mavlink_msg_param_value_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &answer);
    telemetry_put(wire, &message);
}

/* ---- texts ---- */

typedef struct text {
    char bytes[TEXT_BYTES];
    uint32_t length;
} text;

static void append(text *to, const char *from)
{
    while (*from != '\0' && to->length < TEXT_BYTES) {
        to->bytes[to->length] = *from;
        to->length++;
        from++;
    }
}

/* Say a text, in as many pieces as it takes. */
static void say(wire_state *wire, uint32_t severity, const text *said)
{
    const uint32_t piece = MAVLINK_MSG_STATUSTEXT_FIELD_TEXT_LEN;
    mavlink_statustext_t status = {.severity = (uint8_t)severity};
    if (said->length > piece) {
        wire->common.texts = (uint16_t)(wire->common.texts % UINT16_MAX + 1u); /* 0 is a text in one piece */
        status.id = wire->common.texts;
    }
    for (uint32_t at = 0u; at < said->length; at += piece) {
        const uint32_t left = said->length - at;
        memset(status.text, 0, piece);
        memcpy(status.text, &said->bytes[at], left < piece ? left : piece);
        mavlink_message_t message;
        mavlink_msg_statustext_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &status);
        telemetry_put(wire, &message);
        status.chunk_seq++;
    }
}

static void say_rejection(wire_state *wire, uint32_t rejection)
{
    text said = {.length = 0u};
    if (wire->common.tools == 0u) {
        return;
    }
    append(&said, "rejected: ");
    append(&said, rejection_text(rejection));
    say(wire, MAV_SEVERITY_WARNING, &said);
}

static void say_fault(wire_state *wire, uint32_t fault, uint32_t joint)
{
    text said = {.length = 0u};
    if (joint < JOINTS) {
        const char number[2] = {(char)('1' + joint), '\0'};
        append(&said, "joint ");
        append(&said, number);
        append(&said, ": ");
    }
    append(&said, fault_text(fault));
    say(wire, MAV_SEVERITY_ERROR, &said);
}

/* Say one fault that nobody has heard of; returns whether there was one. */
static bool say_new_fault(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    uint32_t of_joints = 0u;
    for (uint32_t joint = 0u; joint <= JOINTS; joint++) {
        const uint32_t faults = joint < JOINTS ? outputs->joint_faults[joint] : outputs->faults & ~of_joints;
        uint32_t *said = &wire->common.said_faults[joint];
        of_joints |= faults;
        *said &= faults;
        for (uint32_t fault = 1u; fault < FAULT_COUNT; fault++) {
            if ((faults & ~*said & FAULT_BIT(fault)) != 0u) {
                *said |= FAULT_BIT(fault);
                say_fault(wire, fault, joint);
                return true;
            }
        }
    }
    return false;
}

static void say_stop(wire_state *wire)
{
    const uint32_t state = wire->report.outputs.state;
    if (state == STATE_STOPPED && wire->common.said_state != state) {
        text said = {.length = 0u};
        append(&said, state_text(state));
        say(wire, MAV_SEVERITY_ALERT, &said);
    }
    wire->common.said_state = state;
}

/* ---- once a second ---- */

static uint8_t system_status(const core_outputs *outputs)
{
    if (outputs->state == STATE_STOPPED) {
        return MAV_STATE_EMERGENCY;
    }
    if (outputs->faults != 0u) {
        return MAV_STATE_CRITICAL;
    }
    return outputs->drives_on != 0u ? MAV_STATE_ACTIVE : MAV_STATE_STANDBY;
}

static void write_heartbeat(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    const uint32_t armed = outputs->drives_on != 0u ? MAV_MODE_FLAG_SAFETY_ARMED : 0u;
    const mavlink_heartbeat_t heartbeat = {.custom_mode = outputs->state,
                                           .autopilot = MAV_AUTOPILOT_INVALID,
                                           .base_mode = (uint8_t)(armed | MAV_MODE_FLAG_CUSTOM_MODE_ENABLED),
                                           .system_status = system_status(outputs),
                                           .mavlink_version = 3u};
    mavlink_message_t message;
    mavlink_msg_heartbeat_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &heartbeat);
    telemetry_put(wire, &message);
}

static void write_sys_status(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    const uint32_t supply = (1u << FAULT_SUPPLY_LOW) | (1u << FAULT_SUPPLY_HIGH);
    int32_t current_ma = 0;
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        const int32_t each = wire->report.current_ma[joint];
        current_ma += each < 0 ? -each : each;
    }
    const bool ready = outputs->faults == 0u && outputs->state != STATE_STOPPED;
    mavlink_sys_status_t status = {
        .onboard_control_sensors_present = SENSOR_MOTOR_OUTPUTS | SENSOR_BATTERY | PREARM_CHECK,
        .onboard_control_sensors_enabled =
            (outputs->drives_on != 0u ? SENSOR_MOTOR_OUTPUTS : 0u) | SENSOR_BATTERY | PREARM_CHECK,
        .onboard_control_sensors_health = ((outputs->faults & ~supply) == 0u ? SENSOR_MOTOR_OUTPUTS : 0u) |
                                          ((outputs->faults & supply) == 0u ? SENSOR_BATTERY : 0u) |
                                          (ready ? PREARM_CHECK : 0u),
        .voltage_battery = (uint16_t)(wire->report.supply_mv < 65534u ? wire->report.supply_mv : 65534u),
        .current_battery = (int16_t)(current_ma < 327670 ? current_ma / 10 : 32767),
        .battery_remaining = -1,
        .errors_comm = (uint16_t)(wire->counters.crc_errors + wire->counters.lost_messages),
        .errors_count1 = (uint16_t)wire->counters.lost_bytes,
        .errors_count2 = (uint16_t)wire->counters.overrun_bytes,
        .errors_count3 = (uint16_t)wire->counters.stale_commands,
        .errors_count4 = (uint16_t)wire->fate.rejected_count,
    };
    mavlink_message_t message;
    mavlink_msg_sys_status_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &status);
    telemetry_put(wire, &message);
}

static int16_t short_of(int32_t value)
{
    return (int16_t)(value > INT16_MAX ? INT16_MAX : value < INT16_MIN ? INT16_MIN : value);
}

static void write_sensed(wire_state *wire)
{
    const wire_report *report = &wire->report;
    mavlink_sensed_t sensed = {.tick = report->outputs.tick};
    memcpy(sensed.duty, report->last_duty, sizeof sensed.duty);
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        sensed.counts[joint] = (uint16_t)encoder_telemetry(&wire->setup.config->joint[joint], report->counts[joint]);
        sensed.current_ma[joint] = short_of(report->current_ma[joint]);
    }
    mavlink_message_t message;
    mavlink_msg_sensed_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &sensed);
    telemetry_put(wire, &message);
}

/* Return whether the session's owner has left: the drives are off, and nothing has come from it for long. */
static bool owner_left(const wire_state *wire)
{
    return wire->report.outputs.drives_on == 0u && wire_tick(wire) - wire->common.owner_tick > OWNER_TICKS;
}

/* Hand the core a command whose answer is waited for; NULL where the queue is full, which was answered. */
static core_command *ask_core(wire_state *wire, uint32_t kind, uint32_t waits)
{
    wire->common.sequence = SEQUENCES | ((wire->common.sequence + 1u) & ~SEQUENCES);
    wire->common.waits = waits;
    return command_append(wire, kind, wire->common.sequence);
}

void common_write(wire_state *wire)
{
    wire_common *common = &wire->common;
    const uint32_t tick = wire_tick(wire);
    if (common->waits == WAITS_TO_CLEAR) {
        (void)ask_core(wire, COMMAND_CLEAR_FAULTS, WAITS_CLEAR);
    }
    if (common->sensed_period != 0u && tick - common->sensed_tick >= common->sensed_period &&
        telemetry_has_room(wire)) {
        common->sensed_tick = tick;
        write_sensed(wire);
    }
    const bool listened = common->tools != 0u || wire->greeted == 0u || owner_left(wire);
    if (listened && tick - common->second_tick >= SECOND_TICKS && telemetry_has_room(wire)) {
        common->second_tick = tick;
        write_heartbeat(wire);
        write_sys_status(wire);
    }
    common->restart = wire->report.outputs.drives_on == 0u ? common->restart : 0u;
    if (common->tools != 0u) {
        say_stop(wire);
    }
    const bool said = common->tools != 0u && telemetry_has_room(wire) && say_new_fault(wire);
    if (!said && telemetry_has_room(wire) && common->listed < PARAMS) {
        put_param(wire, common->listed);
        common->listed++;
    }
}

/* ---- commands ---- */

static void acknowledge(wire_state *wire, uint32_t result, uint32_t rejection)
{
    const mavlink_command_ack_t answer = {.command = wire->common.command,
                                          .result = (uint8_t)result,
                                          .result_param2 = (int32_t)rejection,
                                          .target_system = wire->common.system,
                                          .target_component = wire->common.component};
    mavlink_message_t message;
    mavlink_msg_command_ack_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &answer);
    telemetry_put(wire, &message);
}

bool common_answered(wire_state *wire, uint32_t sequence, uint32_t rejection)
{
    wire_common *common = &wire->common;
    if (common->sequence == 0u || sequence != common->sequence) {
        return false;
    }
    const uint32_t waits = common->waits;
    common->waits = WAITS_NOT;
    if (rejection != REJECTION_NONE) {
        say_rejection(wire, rejection);
    }
    if (waits == WAITS_DISARM && rejection == REJECTION_NONE && wire->report.outputs.faults != 0u) {
        common->waits = WAITS_TO_CLEAR; /* a tool has no other way to clear them */
    } else if (waits == WAITS_PARAM) {
        put_param(wire, common->param);
    } else if (waits == WAITS_CLEAR) {
        acknowledge(wire, MAV_RESULT_ACCEPTED, rejection);
    } else if (waits != WAITS_NOT) {
        acknowledge(wire, rejection == REJECTION_NONE ? MAV_RESULT_ACCEPTED : MAV_RESULT_DENIED, rejection);
    }
    return true;
}

void common_forget(wire_state *wire) { wire->common.waits = WAITS_NOT; }

void common_begin_session(wire_state *wire)
{
    wire->common.waits = WAITS_NOT;
    wire->common.sensed_period = 0u;
    wire->periods = wire_periods_at(wire->setup.baud);
    wire->common.tools = 0u;
    wire->common.owner_tick = wire_tick(wire);
}

/* Return whether who sent this may change anything: there is no session, or it is its own, or one whose owner has left;
 * that one ends, and who had it must say hello again. */
static bool may_change(wire_state *wire, const mavlink_message_t *message)
{
    if (wire->greeted != 0u && message->sysid != wire->owner && owner_left(wire)) {
        wire->greeted = 0u;
    }
    return wire->greeted == 0u || message->sysid == wire->owner;
}

static bool is_for_us(uint32_t system, uint32_t component)
{
    return (system == 0u || system == WIRE_SYSTEM) && (component == 0u || component == WIRE_COMPONENT);
}

/* Set how often a message comes, by an interval in us: 0 as by default, below it never. Returns a MAV_RESULT. */
static uint32_t set_interval(wire_state *wire, float id, float interval_us)
{
    const wire_periods usual = wire_periods_at(wire->setup.baud);
    const bool off = interval_us < 0.0f;
    const float ticks = number_clamp(interval_us * 0.001f + 0.5f, 1.0f, 60000.0f);
    const uint32_t period = off ? UINT32_MAX : (uint32_t)ticks;
    const bool by_default = interval_us == 0.0f;
    if (!number_finite(id) || !number_finite(interval_us)) {
        return MAV_RESULT_DENIED;
    }
    if (id == (float)MAVLINK_MSG_ID_SENSED) {
        wire->common.sensed_period = off || by_default ? 0u : period;
    } else if (id == (float)MAVLINK_MSG_ID_ANGLES) {
        wire->periods.angles = by_default ? usual.angles : period;
    } else if (id == (float)MAVLINK_MSG_ID_JOINTS) {
        wire->periods.joints = by_default ? usual.joints : period;
    } else {
        return MAV_RESULT_UNSUPPORTED;
    }
    return MAV_RESULT_ACCEPTED;
}

/* Store gains in use and the limits that were set. */
static void store(wire_state *wire)
{
    wire_staged *staged = &wire->staged;
    if (wire->common.params_staged == 0u) {
        settings_copy(wire, 0u, &staged->config, sizeof staged->config);
    }
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        settings_copy(wire, offset_of(joint * PARAMS_OF_JOINT), &staged->config.joint[joint].gains,
                      sizeof(joint_gains));
    }
    staged->crc = config_crc(&staged->config, sizeof staged->config);
    wire->common.params_staged = 1u;
    (void)ask_core(wire, COMMAND_STORE, WAITS_COMMAND);
}

static uint32_t arm(wire_state *wire, float armed)
{
    (void)ask_core(wire, armed != 0.0f ? COMMAND_ENABLE : COMMAND_DISABLE,
                   armed != 0.0f ? WAITS_COMMAND : WAITS_DISARM);
    return MAV_RESULT_ACCEPTED;
}

static uint32_t terminate(wire_state *wire, float stop)
{
    if (stop != 0.0f) {
        command_stop(wire);
        acknowledge(wire, MAV_RESULT_ACCEPTED, REJECTION_NONE);
    } else {
        (void)ask_core(wire, COMMAND_CLEAR_STOP, WAITS_COMMAND);
    }
    return MAV_RESULT_ACCEPTED;
}

static uint32_t restart(wire_state *wire, float how)
{
    if (how != 1.0f) {
        return MAV_RESULT_UNSUPPORTED;
    }
    if (wire->report.outputs.drives_on != 0u) {
        return MAV_RESULT_TEMPORARILY_REJECTED;
    }
    acknowledge(wire, MAV_RESULT_ACCEPTED, REJECTION_NONE);
    wire->common.restart = 1u;
    return MAV_RESULT_ACCEPTED;
}

/* Begin a command; what is returned was not acknowledged yet, unless it is MAV_RESULT_ACCEPTED. */
static uint32_t begin(wire_state *wire, const mavlink_command_long_t *asked)
{
    switch (asked->command) {
    case MAV_CMD_COMPONENT_ARM_DISARM:
        if (asked->param1 != 0.0f && asked->param1 != 1.0f) {
            return MAV_RESULT_DENIED;
        }
        return arm(wire, asked->param1);
    case MAV_CMD_DO_FLIGHTTERMINATION:
        return terminate(wire, asked->param1);
    case MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
        return restart(wire, asked->param1);
    case MAV_CMD_PREFLIGHT_STORAGE:
        if (asked->param1 != 1.0f) {
            return MAV_RESULT_UNSUPPORTED;
        }
        store(wire);
        return MAV_RESULT_ACCEPTED;
    default:
        return MAV_RESULT_UNSUPPORTED;
    }
}

static void take_command_long(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_command_long_t asked;
    mavlink_msg_command_long_decode(message, &asked);
    if (!is_for_us(asked.target_system, asked.target_component)) {
        return;
    }
    const bool stops = asked.command == MAV_CMD_DO_FLIGHTTERMINATION && asked.param1 != 0.0f;
    if (wire->common.waits != WAITS_NOT && !stops) {
        wire->counters.stale_commands++;
        return;
    }
    wire->common.command = asked.command;
    wire->common.system = message->sysid;
    wire->common.component = message->compid;
    if (!stops && !may_change(wire, message)) {
        acknowledge(wire, MAV_RESULT_DENIED, REJECTION_NOT_OWNER);
        say_rejection(wire, REJECTION_NOT_OWNER);
        return;
    }
    if (asked.command == MAV_CMD_SET_MESSAGE_INTERVAL) {
        acknowledge(wire, set_interval(wire, asked.param1, asked.param2), REJECTION_NONE);
        return;
    }
    const uint32_t result = begin(wire, &asked);
    if (result != MAV_RESULT_ACCEPTED) {
        acknowledge(wire, result, REJECTION_NONE);
    }
}

/* Set a limit beside the configuration in use; returns whether it was. */
static bool set_limit(wire_state *wire, uint32_t param, float value)
{
    core_config *config = &wire->staged.config;
    if (wire->staged.storing != 0u) {
        return false;
    }
    if (wire->common.params_staged == 0u) {
        settings_copy(wire, 0u, config, sizeof *config);
        wire->common.params_staged = 1u;
    }
    uint8_t before[4];
    uint8_t *at = (uint8_t *)config + offset_of(param);
    memcpy(before, at, sizeof before);
    if (kind_of(param)->is_word != 0u) {
        if (!number_within(value, 0.0f, MOST_WORD) || (float)(uint32_t)value != value) {
            return false;
        }
        const uint32_t word = (uint32_t)value;
        memcpy(at, &word, sizeof word);
    } else {
        memcpy(at, &value, sizeof value);
    }
    if (!config_is_valid(config)) {
        memcpy(at, before, sizeof before);
        return false;
    }
    return true;
}

/* Send the core the gains in use with one of them changed. */
static void set_gain(wire_state *wire, uint32_t param, float value)
{
    core_command *command = ask_core(wire, COMMAND_GAINS, WAITS_PARAM);
    if (command == NULL) {
        return;
    }
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        settings_copy(wire, offset_of(joint * PARAMS_OF_JOINT), &command->gains.joint[joint], sizeof(joint_gains));
    }
    joint_gains *gains = &command->gains.joint[param / PARAMS_OF_JOINT];
    memcpy((uint8_t *)gains + param % PARAMS_OF_JOINT * sizeof value, &value, sizeof value);
}

static void take_param_set(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_param_set_t set;
    mavlink_msg_param_set_decode(message, &set);
    const uint32_t param = named(set.param_id);
    if (!is_for_us(set.target_system, set.target_component) || param == PARAMS) {
        return;
    }
    if (wire->common.waits != WAITS_NOT) {
        wire->counters.stale_commands++;
        return;
    }
    if (!may_change(wire, message)) {
        say_rejection(wire, REJECTION_NOT_OWNER);
        put_param(wire, param);
        return;
    }
    if (is_gain(param)) {
        wire->common.param = param;
        set_gain(wire, param, set.param_value);
        return;
    }
    if (!set_limit(wire, param, set.param_value)) {
        say_rejection(wire, REJECTION_OUT_OF_RANGE);
    }
    put_param(wire, param);
}

static void take_param_read(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_param_request_read_t read;
    mavlink_msg_param_request_read_decode(message, &read);
    if (!is_for_us(read.target_system, read.target_component)) {
        return;
    }
    const uint32_t param = read.param_index < 0 ? named(read.param_id) : (uint32_t)read.param_index;
    if (param < PARAMS) {
        put_param(wire, param);
    }
}

static void take_param_list(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_param_request_list_t list;
    mavlink_msg_param_request_list_decode(message, &list);
    if (is_for_us(list.target_system, list.target_component)) {
        wire->common.listed = 0u;
    }
}

static void take_timesync(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_timesync_t times;
    mavlink_msg_timesync_decode(message, &times);
    if (times.tc1 != 0) {
        return; /* an answer to nobody's question */
    }
    times.tc1 = (int64_t)wire_tick(wire) * (1000000000 / (int64_t)TICKS_PER_S);
    mavlink_message_t answer;
    mavlink_msg_timesync_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &answer, &times);
    telemetry_put(wire, &answer);
}

/* A tool listens: it hears of all faults that stand. */
static void take_heartbeat(wire_state *wire)
{
    if (wire->common.tools == 0u) {
        memset(wire->common.said_faults, 0, sizeof wire->common.said_faults);
        wire->common.said_state = STATE_COUNT;
        wire->common.tools = 1u;
    }
}

void common_init(wire_state *wire) { wire->common.listed = PARAMS; }

bool common_take(wire_state *wire, const mavlink_message_t *message)
{
    switch (message->msgid) {
    case MAVLINK_MSG_ID_HEARTBEAT:
        take_heartbeat(wire);
        return true;
    case MAVLINK_MSG_ID_COMMAND_LONG:
        take_command_long(wire, message);
        return true;
    case MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
        take_param_list(wire, message);
        return true;
    case MAVLINK_MSG_ID_PARAM_REQUEST_READ:
        take_param_read(wire, message);
        return true;
    case MAVLINK_MSG_ID_PARAM_SET:
        take_param_set(wire, message);
        return true;
    case MAVLINK_MSG_ID_TIMESYNC:
        take_timesync(wire, message);
        return true;
    default:
        return false;
    }
}
