#include <stddef.h>
#include <string.h>

#include "common.h"
#include "config.h"
#include "inside.h"

_Static_assert(sizeof(gain_set) == sizeof(((mavlink_gains_t *)NULL)->gains), "GAINS carries a whole gain set");

void command_reject(wire_state *wire, uint32_t sequence, uint32_t rejection)
{
    if (common_answered(wire, sequence, rejection)) {
        return;
    }
    wire->fate.rejected_sequence = sequence;
    wire->fate.rejected_count++;
    wire->fate.rejection = rejection;
    wire->status_due = 1u;
}

void command_acknowledge(wire_state *wire, uint32_t sequence)
{
    if (common_answered(wire, sequence, REJECTION_NONE)) {
        return;
    }
    wire->fate.acknowledged_sequence = sequence;
    wire->fate.acknowledged_count++;
    wire->status_due = 1u;
}

/* Return whether this number comes after all that came; numbers go round. */
static bool is_newer(const wire_state *wire, uint32_t sequence)
{
    const uint32_t ahead = sequence - wire->newest_sequence;
    return wire->sequence_known == 0u || (ahead != 0u && ahead < 0x80000000u);
}

bool command_admit(wire_state *wire, const mavlink_message_t *message, uint32_t sequence, uint32_t session)
{
    if (wire->greeted == 0u) {
        command_reject(wire, sequence, REJECTION_NO_HELLO);
        return false;
    }
    if (session != wire->session || message->sysid != wire->owner) {
        command_reject(wire, sequence, REJECTION_NOT_OWNER);
        return false;
    }
    if (!is_newer(wire, sequence)) {
        wire->counters.stale_commands++;
        return false;
    }
    wire->sequence_known = 1u;
    wire->newest_sequence = sequence;
    return true;
}

/* Drop the waiting commands of a kind; of all kinds for COMMAND_NONE. */
static void drop(wire_state *wire, uint32_t kind)
{
    wire_queue *queue = &wire->queue;
    uint32_t kept = 0u;
    for (uint32_t i = 0u; i < queue->count; i++) {
        if (kind != COMMAND_NONE && queue->command[i].kind != kind) {
            if (kept != i) {
                queue->command[kept] = queue->command[i];
            }
            kept++;
        }
    }
    wire->counters.stale_commands += queue->count - kept;
    queue->count = kept;
}

core_command *command_append(wire_state *wire, uint32_t kind, uint32_t sequence)
{
    wire_queue *queue = &wire->queue;
    if (kind == COMMAND_MOVE) {
        drop(wire, COMMAND_MOVE);
    }
    if (queue->count == WIRE_QUEUE) {
        command_reject(wire, sequence, REJECTION_TOO_MANY);
        return NULL;
    }
    core_command *command = &queue->command[queue->count];
    queue->count++;
    command->kind = kind;
    command->sequence = sequence;
    return command;
}

void command_deliver(wire_state *wire)
{
    wire_queue *queue = &wire->queue;
    const bool busy = atomic_load(&wire->shared.mail_full) != 0u || wire->staged.storing != 0u;
    const bool known = wire->reports_read == atomic_load(&wire->shared.report_count);
    if (busy || !known || queue->count == 0u) {
        return;
    }
    const core_command *oldest = &queue->command[0];
    if (oldest->kind != COMMAND_STORE) {
        wire->shared.mail = *oldest;
        wire->mailed_kind = oldest->kind;
        atomic_store(&wire->shared.mail_full, 1u);
    } else {
        settings_store(wire, oldest->sequence);
    }
    queue->count--;
    for (uint32_t i = 0u; i < queue->count; i++) {
        queue->command[i] = queue->command[i + 1u];
    }
}

/* Begin a session for the host that said hello. Its number comes of what the converters read: nobody who recorded an
 * earlier one knows it. */
static void begin_session(wire_state *wire, const mavlink_message_t *message, uint32_t nonce)
{
    uint32_t crc = config_crc_on(wire->session ^ nonce, &wire->report, sizeof wire->report);
    crc = config_crc_on(crc, &wire->counters, sizeof wire->counters);
    wire->session = crc != 0u ? crc : 1u;
    wire->owner = message->sysid;
    wire->sequence_known = 0u;
    common_begin_session(wire);
    atomic_fetch_add(&wire->shared.sessions, 1u);
}

static void take_hello(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_hello_t hello;
    mavlink_msg_hello_decode(message, &hello);
    wire->greeted = hello.dialect_version == ARMSIGHT_DIALECT_VERSION && hello.config_version == CONFIG_VERSION;
    begin_session(wire, message, hello.nonce);
    drop(wire, COMMAND_NONE);
    mavlink_welcome_t welcome = {
        .dialect_version = ARMSIGHT_DIALECT_VERSION,
        .config_version = CONFIG_VERSION,
        .nonce = hello.nonce,
        .tick = wire_tick(wire),
        .ticks_per_s = TICKS_PER_S,
        .baud = wire->setup.baud,
        .config_source = wire->setup.config_source,
        .joints = wire->setup.abilities.joints,
        .sensors = wire->setup.abilities.sensors,
        .quadrature_inputs = wire->setup.abilities.quadrature_inputs,
        .session = wire->session,
        .firmware = FIRMWARE_VERSION,
    };
    const crash_record *crash = &wire->setup.crash;
    welcome.crash[0] = crash->exception;
    welcome.crash[1] = crash->pc;
    welcome.crash[2] = crash->lr;
    welcome.crash[3] = crash->cfsr;
    for (uint32_t i = 0u; i < sizeof welcome.board && wire->setup.board[i] != '\0'; i++) {
        welcome.board[i] = wire->setup.board[i];
    }
    mavlink_message_t answer;
    mavlink_msg_welcome_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &answer, &welcome);
    telemetry_put(wire, &answer);
    wire->status_urgent = 1u;
}

static void take_move(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_move_t move;
    mavlink_msg_move_decode(message, &move);
    const bool admitted = command_admit(wire, message, move.sequence, move.session);
    core_command *command = admitted ? command_append(wire, COMMAND_MOVE, move.sequence) : NULL;
    if (command == NULL) {
        return;
    }
    memcpy(command->move.position_rad, move.position_rad, sizeof command->move.position_rad);
    memcpy(command->move.speed_rad_s, move.speed_rad_s, sizeof command->move.speed_rad_s);
    memcpy(command->move.gravity_duty, move.gravity_duty, sizeof command->move.gravity_duty);
    command->move.duration_ticks = move.duration_ticks;
}

static void take_command(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_command_t command;
    mavlink_msg_command_decode(message, &command);
    if (!command_admit(wire, message, command.sequence, command.session)) {
        return;
    }
    const bool known =
        (command.kind >= COMMAND_ENABLE && command.kind <= COMMAND_CLEAR_STOP) || command.kind == COMMAND_HOME;
    if (!known) {
        command_reject(wire, command.sequence, REJECTION_UNKNOWN_COMMAND);
        return;
    }
    command_append(wire, command.kind, command.sequence);
}

static void take_gains(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_gains_t gains;
    mavlink_msg_gains_decode(message, &gains);
    const bool admitted = command_admit(wire, message, gains.sequence, gains.session);
    core_command *command = admitted ? command_append(wire, COMMAND_GAINS, gains.sequence) : NULL;
    if (command != NULL) {
        memcpy(&command->gains, gains.gains, sizeof command->gains);
    }
}

void command_stop(wire_state *wire)
{
    drop(wire, COMMAND_NONE);
    common_forget(wire);
    atomic_fetch_add(&wire->shared.stops, 1u);
}

/* A stop is taken whatever its number and whoever sent it; what waited before it is dropped. */
static void take_stop(wire_state *wire, const mavlink_message_t *message)
{
    const uint32_t sequence = mavlink_msg_stop_get_sequence(message);
    command_stop(wire);
    if (is_newer(wire, sequence)) {
        wire->sequence_known = wire->greeted;
        wire->newest_sequence = sequence;
    }
    wire->stop_sequence = sequence;
    wire->stop_report = atomic_load(&wire->shared.report_count);
    wire->stop_waits = 1u;
}

void message_take(wire_state *wire, const mavlink_message_t *message)
{
    if (message->sysid == wire->owner) {
        wire->common.owner_tick = wire_tick(wire);
    }
    if (common_take(wire, message)) {
        return;
    }
    switch (message->msgid) {
    case MAVLINK_MSG_ID_HELLO:
        take_hello(wire, message);
        break;
    case MAVLINK_MSG_ID_MOVE:
        take_move(wire, message);
        break;
    case MAVLINK_MSG_ID_COMMAND:
        take_command(wire, message);
        break;
    case MAVLINK_MSG_ID_STOP:
        take_stop(wire, message);
        break;
    case MAVLINK_MSG_ID_GAINS:
        take_gains(wire, message);
        break;
    default:
        settings_take(wire, message);
        break;
    }
}
