#include <stddef.h>
#include <string.h>

#include "config.h"
#include "inside.h"

_Static_assert(sizeof(((mavlink_config_part_t *)NULL)->bytes) == WIRE_PART_BYTES, "CONFIG_PART's bytes");

const core_config *wire_to_store(const wire_state *wire)
{
    return wire->staged.storing != 0u ? &wire->staged.config : NULL;
}

void wire_stored(wire_state *wire, bool done)
{
    wire->staged.storing = 0u;
    if (done) {
        wire->counters.config_stored++;
        command_acknowledge(wire, wire->staged.sequence);
    } else {
        command_reject(wire, wire->staged.sequence, REJECTION_CONFIG_BROKEN);
    }
}

void settings_store(wire_state *wire, uint32_t sequence)
{
    wire_staged *staged = &wire->staged;
    if (wire->report.outputs.drives_on != 0u) {
        command_reject(wire, sequence, REJECTION_WRONG_STATE);
    } else if (config_crc(&staged->config, sizeof staged->config) != staged->crc) {
        command_reject(wire, sequence, REJECTION_CONFIG_BROKEN);
    } else if (!config_is_valid(&staged->config)) {
        command_reject(wire, sequence, REJECTION_OUT_OF_RANGE);
    } else {
        staged->sequence = sequence;
        staged->storing = 1u;
    }
}

static void take_store(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_config_store_t store;
    mavlink_msg_config_store_decode(message, &store);
    if (command_admit(wire, message, store.sequence, store.session) &&
        command_append(wire, COMMAND_STORE, store.sequence) != NULL) {
        wire->staged.crc = store.crc;
    }
}

void settings_copy(const wire_state *wire, uint32_t offset, void *to, uint32_t length)
{
    uint32_t number;
    do { /* a tick that came between may have changed the gains */
        number = atomic_load(&wire->shared.report_count);
        memcpy(to, (const uint8_t *)wire->setup.config + offset, length);
    } while (number != atomic_load(&wire->shared.report_count));
}

/* Answer with a part of the configuration in use; an empty one beyond its end. */
static void take_read(wire_state *wire, const mavlink_message_t *message)
{
    const uint32_t offset = mavlink_msg_config_read_get_offset(message);
    const uint32_t left = offset < sizeof(core_config) ? (uint32_t)sizeof(core_config) - offset : 0u;
    const uint32_t length = left < WIRE_PART_BYTES ? left : WIRE_PART_BYTES;
    mavlink_config_part_t part = {.offset = offset, .total = sizeof(core_config), .length = (uint8_t)length};
    settings_copy(wire, length == 0u ? 0u : offset, part.bytes, length);
    mavlink_message_t answer;
    mavlink_msg_config_part_encode_status(WIRE_SYSTEM, WIRE_COMPONENT, &wire->output.framing, &answer, &part);
    telemetry_put(wire, &answer);
}

/* Keep a part of a new configuration; what is wrong with it shows in the CRC of the whole. */
static void take_part(wire_state *wire, const mavlink_message_t *message)
{
    mavlink_config_part_t part;
    mavlink_msg_config_part_decode(message, &part);
    const bool fits = part.total == sizeof(core_config) && part.length <= WIRE_PART_BYTES &&
                      part.offset <= sizeof(core_config) && part.length <= sizeof(core_config) - part.offset;
    if (fits && wire->staged.storing == 0u) {
        wire->common.params_staged = 0u;
        memcpy((uint8_t *)&wire->staged.config + part.offset, part.bytes, part.length);
    }
}

void settings_take(wire_state *wire, const mavlink_message_t *message)
{
    if (message->msgid == MAVLINK_MSG_ID_CONFIG_STORE) {
        take_store(wire, message); /* rejected by name before a HELLO, as every command */
    } else if (wire->greeted == 0u) {
        return;
    } else if (message->msgid == MAVLINK_MSG_ID_CONFIG_READ) {
        take_read(wire, message);
    } else if (message->msgid == MAVLINK_MSG_ID_CONFIG_PART) {
        take_part(wire, message);
    } /* anything else is the board's own, come back from a looped wire */
}
