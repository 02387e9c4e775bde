#include <stddef.h>
#include <string.h>

#include "common.h"
#include "inside.h"

#define FRAME(name) (MAVLINK_MSG_ID_##name##_LEN + MAVLINK_NUM_NON_PAYLOAD_BYTES)
#define JOINTS_EVERY 10u       /* JOINTS are as many times rarer than ANGLES */
#define STATUS_TICKS 20u       /* 50 Hz where the wire carries it */
#define STATUS_EVERY 4u        /* and not more often than every so many ANGLES */
#define STATUS_GAP_DIVISOR 4u  /* STATUS of commands comes at most as many times more often than by itself */
#define USED_PER_25_BAUD 2u    /* bytes a second to use: 80 % of what the wire carries */
#define BACKLOG_PER_BAUD 1000u /* telemetry waits while more than 10 ms of it wait to go out, */
#define BACKLOG_BYTES 512u     /* or more than this */

static wire_periods periods_of(uint32_t angles)
{
    const uint32_t status = STATUS_EVERY * angles;
    return (wire_periods){angles, JOINTS_EVERY * angles, status < STATUS_TICKS ? STATUS_TICKS : status};
}

wire_periods wire_periods_at(uint32_t baud)
{
    wire_periods periods = periods_of(1u);
    for (uint32_t angles = 2u; angles <= TICKS_PER_S; angles++) {
        const uint32_t bytes_per_s = FRAME(ANGLES) * TICKS_PER_S / periods.angles +
                                     FRAME(JOINTS) * TICKS_PER_S / periods.joints +
                                     FRAME(BOARD_STATUS) * TICKS_PER_S / periods.status;
        if (bytes_per_s + 3u <= baud / 25u * USED_PER_25_BAUD) { /* 3: what the divisions left out */
            break;
        }
        periods = periods_of(angles);
    }
    return periods;
}

void telemetry_put(wire_state *wire, const mavlink_message_t *message)
{
    wire_ring *ring = &wire->output;
    uint8_t bytes[MAVLINK_MAX_PACKET_LEN];
    const uint32_t length = mavlink_msg_to_send_buffer(bytes, message);
    if (length > WIRE_OUT_BYTES - (ring->written - ring->taken)) {
        return;
    }
    const uint32_t from = ring->written % WIRE_OUT_BYTES;
    const uint32_t first = length < WIRE_OUT_BYTES - from ? length : WIRE_OUT_BYTES - from;
    memcpy(&ring->bytes[from], bytes, first);
    memcpy(ring->bytes, &bytes[first], length - first);
    ring->written += length;
}

bool telemetry_has_room(const wire_state *wire)
{
    const uint32_t waiting = wire->output.written - wire->output.taken;
    return waiting <= BACKLOG_BYTES && waiting <= wire->setup.baud / BACKLOG_PER_BAUD;
}

bool wire_to_restart(const wire_state *wire)
{
    return wire->common.restart != 0u && wire->output.written == wire->output.taken;
}

uint32_t wire_output(const wire_state *wire, const uint8_t **bytes)
{
    const wire_ring *ring = &wire->output;
    const uint32_t from = ring->taken % WIRE_OUT_BYTES;
    const uint32_t waiting = ring->written - ring->taken;
    *bytes = &ring->bytes[from];
    return waiting < WIRE_OUT_BYTES - from ? waiting : WIRE_OUT_BYTES - from;
}

void wire_sent(wire_state *wire, uint32_t length) { wire->output.taken += length; }

/* Take the tick's report; again if a tick came meanwhile. */
static void copy_report(wire_state *wire)
{
    do {
        wire->reports_read = atomic_load(&wire->shared.report_count);
        wire->report = wire->shared.report;
    } while (wire->reports_read != atomic_load(&wire->shared.report_count));
}

bool telemetry_fetch(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    const uint32_t acknowledged = outputs->acknowledged_count;
    const uint32_t rejected = outputs->rejected_count;
    const uint32_t state = outputs->state;
    const uint32_t faults = outputs->faults;
    const uint32_t not_homed = outputs->not_homed;
    if (wire->reports_read == atomic_load(&wire->shared.report_count)) {
        return false;
    }
    copy_report(wire);
    if (wire->stop_waits != 0u && wire->reports_read != wire->stop_report) {
        wire->stop_waits = 0u;
        command_acknowledge(wire, wire->stop_sequence);
    }
    if (outputs->acknowledged_count != acknowledged &&
        !common_answered(wire, outputs->acknowledged_sequence, REJECTION_NONE)) {
        wire->fate.acknowledged_count += outputs->acknowledged_count - acknowledged;
        wire->fate.acknowledged_sequence = outputs->acknowledged_sequence;
        wire->status_due |= wire->mailed_kind != COMMAND_MOVE;
    }
    if (outputs->rejected_count != rejected &&
        !common_answered(wire, outputs->rejected_sequence, outputs->rejection)) {
        wire->fate.rejected_count += outputs->rejected_count - rejected;
        wire->fate.rejected_sequence = outputs->rejected_sequence;
        wire->fate.rejection = outputs->rejection;
        wire->status_due = 1u;
    }
    wire->status_urgent |= outputs->state != state || outputs->faults != faults || outputs->not_homed != not_homed;
    return true;
}

static void write_status(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    mavlink_board_status_t status = {
        .tick = outputs->tick,
        .state = outputs->state,
        .faults = outputs->faults,
        .first_fault = outputs->first_fault,
        .first_joint = outputs->first_joint,
        .acknowledged_sequence = wire->fate.acknowledged_sequence,
        .acknowledged_count = wire->fate.acknowledged_count,
        .rejected_sequence = wire->fate.rejected_sequence,
        .rejected_count = wire->fate.rejected_count,
        .rejection = wire->fate.rejection,
        .supply_mv = wire->report.supply_mv,
        .crc_errors = wire->counters.crc_errors,
        .lost_bytes = wire->counters.lost_bytes,
        .overrun_bytes = wire->counters.overrun_bytes,
        .stale_commands = wire->counters.stale_commands,
        .lost_messages = wire->counters.lost_messages,
        .config_stored = wire->counters.config_stored,
        .not_homed = (uint8_t)outputs->not_homed,
    };
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        status.joint_faults[joint] = outputs->joint_faults[joint];
    }
    mavlink_message_t message;
    mavlink_msg_board_status_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &status);
    telemetry_put(wire, &message);
    wire->status_tick = outputs->tick;
    wire->status_urgent = 0u;
    wire->status_due = 0u;
}

static void write_joints(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    mavlink_joints_t joints = {.tick = outputs->tick};
    memcpy(joints.speed_rad_s, outputs->speed_rad_s, sizeof joints.speed_rad_s);
    memcpy(joints.reference_rad, outputs->reference_rad, sizeof joints.reference_rad);
    memcpy(joints.reference_rad_s, outputs->reference_rad_s, sizeof joints.reference_rad_s);
    memcpy(joints.duty, outputs->duty, sizeof joints.duty);
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        joints.limited[joint] = (uint8_t)outputs->limited[joint];
    }
    mavlink_message_t message;
    mavlink_msg_joints_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, &joints);
    telemetry_put(wire, &message);
    wire->joints_tick = outputs->tick;
}

static void write_angles(wire_state *wire)
{
    const core_outputs *outputs = &wire->report.outputs;
    mavlink_message_t message;
    mavlink_msg_angles_pack_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &message, outputs->tick,
                                   outputs->angle_rad);
    telemetry_put(wire, &message);
    wire->angles_tick = outputs->tick;
}

/* Return whether it is time for a BOARD_STATUS. A host of another version learns why its commands are rejected, and no
 * more. */
static bool status_is_due(const wire_state *wire)
{
    const uint32_t since = wire_tick(wire) - wire->status_tick;
    if (wire->greeted != 0u && (wire->status_urgent != 0u || since >= wire->periods.status)) {
        return true;
    }
    return wire->status_due != 0u && since >= wire->periods.status / STATUS_GAP_DIVISOR;
}

void telemetry_write(wire_state *wire)
{
    const uint32_t tick = wire_tick(wire);
    common_write(wire);
    if (status_is_due(wire) && telemetry_has_room(wire)) {
        write_status(wire);
    }
    if (wire->greeted == 0u) {
        return;
    }
    if (tick - wire->joints_tick >= wire->periods.joints && telemetry_has_room(wire)) {
        write_joints(wire);
    }
    if (tick - wire->angles_tick >= wire->periods.angles && telemetry_has_room(wire)) {
        write_angles(wire);
    }
}
