#include "wire.h"

#include <stddef.h>
#include <string.h>

#include "common.h"
#include "inside.h"

#define BITS_PER_BYTE 10u /* 8N1: a start and a stop bit */

void wire_init(wire_state *wire, const wire_setup *setup)
{
    memset(wire, 0, sizeof *wire); /* a compound literal may take its size of stack */
    wire->setup = *setup;
    wire->periods = wire_periods_at(setup->baud);
    wire->report.outputs.first_joint = NO_JOINT;
    common_init(wire);
}

/* Begin to look for the next message. */
static void await(wire_input *input)
{
    input->framing.parse_state = MAVLINK_PARSE_STATE_IDLE;
    input->message.len = 0u;
}

/* Return whether the header that was just read belongs to no message of ours. MAVLink's own check would also reject
 * messages whose trailing zeros were left out, and without one a false begin swallows up to 255 bytes of good
 * messages. */
static bool is_foreign(const wire_input *input)
{
    const mavlink_parse_state_t state = input->framing.parse_state;
    const bool header_read = state == MAVLINK_PARSE_STATE_GOT_PAYLOAD || state == MAVLINK_PARSE_STATE_GOT_MSGID3;
    if (!header_read || input->framing.packet_idx != 0u) {
        return false;
    }
    const mavlink_msg_entry_t *entry = mavlink_get_msg_entry(input->message.msgid);
    return entry == NULL || input->message.len == 0u || input->message.len > entry->max_msg_len ||
           input->message.incompat_flags != 0u;
}

/* Count the frames that are missing before this one. */
static void count_frame(wire_state *wire)
{
    wire_input *input = &wire->input;
    const uint8_t number = input->message.seq;
    const bool begins = input->message.msgid == MAVLINK_MSG_ID_HELLO; /* a host counts from where it likes */
    if (input->counting != 0u && !begins) {
        wire->counters.lost_messages += (uint8_t)(number - input->frame_count);
    }
    input->counting = 1u;
    input->frame_count = (uint8_t)(number + 1u);
}

/* What a byte made of the message that is put together. */
enum { FRAME_OPEN = 0, FRAME_WHOLE = 1, FRAME_NONE = 2 };

static uint32_t take_byte(wire_state *wire, uint8_t byte)
{
    wire_input *input = &wire->input;
    if (input->framing.parse_state <= MAVLINK_PARSE_STATE_IDLE && byte != MAVLINK_STX) {
        return FRAME_NONE;
    }
    switch (mavlink_frame_char_buffer(&input->message, &input->framing, byte, NULL, NULL)) {
    case MAVLINK_FRAMING_OK:
        return FRAME_WHOLE;
    case MAVLINK_FRAMING_INCOMPLETE:
        return input->framing.parse_state == MAVLINK_PARSE_STATE_IDLE || is_foreign(input) ? FRAME_NONE : FRAME_OPEN;
    default:
        wire->counters.crc_errors++;
        return FRAME_NONE;
    }
}

/* Read the held bytes on from number next. What is no message after all costs its first byte only: the others are
 * read again, so that a message within it is found. */
static void read_held(wire_state *wire, uint32_t next)
{
    wire_input *input = &wire->input;
    uint32_t begin = 0u;
    while (next < input->held_count) {
        const uint32_t made = take_byte(wire, input->held[next]);
        next++;
        if (made == FRAME_OPEN) {
            continue;
        }
        if (made == FRAME_WHOLE) {
            count_frame(wire);
            message_take(wire, &input->message);
            begin = next;
        } else {
            wire->counters.lost_bytes++;
            begin++;
            next = begin;
        }
        await(input);
    }
    if (begin != 0u) {
        input->held_count -= begin;
        for (uint32_t i = 0u; i < input->held_count; i++) {
            input->held[i] = input->held[begin + i];
        }
        input->begin_tick = wire_tick(wire);
    }
}

void wire_receive(wire_state *wire, const uint8_t *bytes, uint32_t length, uint32_t overrun)
{
    wire_input *input = &wire->input;
    wire->counters.overrun_bytes += overrun;
    for (uint32_t i = 0u; i < length; i++) {
        if (input->held_count == 0u) {
            input->begin_tick = wire_tick(wire);
        }
        input->held[input->held_count] = bytes[i];
        input->held_count++;
        read_held(wire, input->held_count - 1u);
    }
}

/* Give up a message whose rest does not come. */
static void give_up_late(wire_state *wire)
{
    wire_input *input = &wire->input;
    const uint32_t bytes = MAVLINK_NUM_NON_PAYLOAD_BYTES + (uint32_t)input->message.len;
    const uint32_t ticks = WIRE_GAP_TICKS + bytes * BITS_PER_BYTE * TICKS_PER_S / wire->setup.baud;
    if (input->held_count == 0u || wire_tick(wire) - input->begin_tick <= ticks) {
        return;
    }
    wire->counters.lost_bytes++;
    input->held_count--;
    for (uint32_t i = 0u; i < input->held_count; i++) {
        input->held[i] = input->held[i + 1u];
    }
    input->begin_tick = wire_tick(wire);
    await(input);
    read_held(wire, 0u);
}

void wire_poll(wire_state *wire)
{
    const bool fresh = telemetry_fetch(wire);
    give_up_late(wire);
    command_deliver(wire);
    if (fresh) {
        telemetry_write(wire);
    }
}

void wire_before_tick(wire_state *wire, core_inputs *inputs)
{
    wire_shared *shared = &wire->shared;
    const uint32_t stops = atomic_load(&shared->stops);
    if (stops != shared->stops_taken) {
        shared->stops_taken = stops;
        inputs->stop_pressed = 1u;
    }
    const uint32_t sessions = atomic_load(&shared->sessions);
    inputs->taken_over = sessions - shared->sessions_taken;
    shared->sessions_taken = sessions;
    if (atomic_load(&shared->mail_full) != 0u) {
        inputs->command.kind = shared->mail.kind;
        inputs->command.sequence = shared->mail.sequence;
        inputs->command.move = shared->mail.move;
        if (shared->mail.kind == COMMAND_GAINS) {
            inputs->command.gains = shared->mail.gains;
        }
        atomic_store(&shared->mail_full, 0u);
    } else {
        inputs->command.kind = COMMAND_NONE;
    }
}

void wire_after_tick(wire_state *wire, const core_inputs *inputs, const core_outputs *outputs)
{
    wire_shared *shared = &wire->shared;
    memcpy(shared->report.last_duty, shared->report.outputs.duty, sizeof shared->report.last_duty);
    memcpy(shared->report.counts, inputs->counts, sizeof shared->report.counts);
    memcpy(shared->report.current_ma, inputs->current_ma, sizeof shared->report.current_ma);
    shared->report.outputs = *outputs;
    shared->report.supply_mv = inputs->supply_mv;
    atomic_fetch_add(&shared->report_count, 1u);
}
