/* Feeds the emulated board whatever bytes a fuzzer makes up: raw ones, and messages whose frame is right and whose
 * content is not. Aborts if what comes out is not what it must be, or if the link is not usable again 20 ms after the
 * last bad byte.
 *
 * Built with clang's -fsanitize=fuzzer, or with -DSHAKE by any compiler: then it generates its own inputs, as many as its
 * argument says. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config.h"
#include "mavlink_setup.h"
#include "number.h"
#include "pil.h"

#define USABLE_TICKS 20u
#define LINE_BYTES 92u /* what 921600 baud carry in a tick */

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static const uint32_t kinds[] = {
    MAVLINK_MSG_ID_HELLO, MAVLINK_MSG_ID_MOVE,        MAVLINK_MSG_ID_COMMAND,     MAVLINK_MSG_ID_STOP,
    MAVLINK_MSG_ID_GAINS, MAVLINK_MSG_ID_CONFIG_READ, MAVLINK_MSG_ID_CONFIG_PART, MAVLINK_MSG_ID_CONFIG_STORE,
    MAVLINK_MSG_ID_COMMAND_LONG, MAVLINK_MSG_ID_PARAM_SET, MAVLINK_MSG_ID_PARAM_REQUEST_READ,
    MAVLINK_MSG_ID_PARAM_REQUEST_LIST, MAVLINK_MSG_ID_HEARTBEAT, MAVLINK_MSG_ID_TIMESYNC, MAVLINK_MSG_ID_ANGLES,      MAVLINK_MSG_ID_BOARD_STATUS,
};

static mavlink_status_t framing;
static uint32_t session; /* of the last WELCOME */

#define SAID_BYTES 1024u
#define SESSION_AT 74u /* in a WELCOME, with its header */
#define SESSION_END 78u

static uint8_t said[SAID_BYTES]; /* what went out since the last greeting */
static uint32_t said_count;

/* Look for a WELCOME in what went out, wherever it begins: a restart may have cut the message before it. */
static void hear(const uint8_t *bytes, uint32_t length)
{
    const uint32_t room = SAID_BYTES - said_count;
    const uint32_t taken = length < room ? length : room;
    memcpy(&said[said_count], bytes, taken);
    said_count += taken;
    for (uint32_t i = 0u; i + SESSION_END <= said_count; i++) {
        const uint32_t kind = said[i + 7u] | (uint32_t)said[i + 8u] << 8 | (uint32_t)said[i + 9u] << 16;
        const uint32_t whole = said[i + 1u] + 10u; /* zeros at its end are left out */
        if (said[i] == MAVLINK_STX && kind == MAVLINK_MSG_ID_WELCOME && whole > SESSION_AT) {
            session = 0u;
            memcpy(&session, &said[i + SESSION_AT], (whole < SESSION_END ? whole : SESSION_END) - SESSION_AT);
        }
    }
}

static void require(int truth, const char *what)
{
    if (!truth) {
        fprintf(stderr, "%s\n", what);
        abort();
    }
}

/* Run a tick with these bytes on the wire. */
static void tick(const uint8_t *bytes, uint32_t length)
{
    pil_request *request = &pil_request_frame;
    request->length = length;
    memcpy(request->bytes, bytes, length);
    request->counts[request->tick % JOINTS] ^= 1u;
    pil_tick();
    request->tick++;
    request->restart = RESTART_NONE;
    hear(pil_answer_frame.bytes, pil_answer_frame.length);
    const core_outputs *outputs = &pil_answer_frame.outputs;
    require(pil_answer_frame.magic == FRAME_ANSWER && pil_answer_frame.length <= LINE_BYTES + 1u, "too much goes out");
    require(outputs->state < STATE_COUNT && outputs->first_fault < FAULT_COUNT, "no such state or fault");
    require(outputs->rejection < REJECTION_COUNT, "no such rejection");
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        require(number_within(outputs->duty[joint], -1.0f, 1.0f), "a duty out of range");
        require(number_finite(outputs->reference_rad[joint]), "a reference that is no number");
        require(outputs->drives_on != 0u || outputs->duty[joint] == 0.0f, "a duty with the drives off");
    }
}

/* Let bytes come in as fast as the wire carries them. */
static void bring(const uint8_t *bytes, uint32_t length)
{
    while (length != 0u) {
        const uint32_t now = length < LINE_BYTES ? length : LINE_BYTES;
        tick(bytes, now);
        bytes += now;
        length -= now;
    }
}

/* Put a message around a content; returns its length. */
static uint32_t frame(uint8_t *bytes, uint32_t kind, const uint8_t *content, uint32_t length)
{
    mavlink_message_t message;
    const mavlink_msg_entry_t *entry = mavlink_get_msg_entry(kind);
    memset(&message, 0, sizeof message);
    message.msgid = kind & 0xFFFFFFu;
    memcpy(_MAV_PAYLOAD_NON_CONST(&message), content, length < entry->max_msg_len ? length : entry->max_msg_len);
    mavlink_finalize_message_buffer(&message, 255u, 1u, &framing, entry->min_msg_len, entry->max_msg_len,
                                    entry->crc_extra);
    return mavlink_msg_to_send_buffer(bytes, &message);
}

static const uint8_t nothing[1];

static void say(uint32_t kind, const void *content, uint32_t length)
{
    uint8_t bytes[MAVLINK_MAX_PACKET_LEN];
    bring(bytes, frame(bytes, kind, content, length));
}

static void greet(void)
{
    const mavlink_hello_t hello = {.dialect_version = ARMSIGHT_DIALECT_VERSION, .config_version = CONFIG_VERSION};
    said_count = 0u;
    session = 0u;
    say(MAVLINK_MSG_ID_HELLO, &hello, sizeof hello);
    for (uint32_t i = 0u; i < USABLE_TICKS && session == 0u; i++) { /* what waits to go out goes first */
        tick(nothing, 0u);
    }
}

/* Store a configuration with which the arm can be enabled. */
static void store(void)
{
    core_config config;
    config_factory(&config);
    greet();
    for (uint32_t offset = 0u; offset < sizeof config; offset += 200u) {
        const uint32_t left = (uint32_t)sizeof config - offset;
        mavlink_config_part_t part = {.offset = offset, .total = sizeof config};
        part.length = (uint8_t)(left < 200u ? left : 200u);
        memcpy(part.bytes, (const uint8_t *)&config + offset, part.length);
        say(MAVLINK_MSG_ID_CONFIG_PART, &part, sizeof part);
    }
    const mavlink_config_store_t store = {.sequence = 1u, .crc = config_crc(&config, sizeof config), .session = session};
    say(MAVLINK_MSG_ID_CONFIG_STORE, &store, sizeof store);
    tick(nothing, 0u);
}

/* Greet, give one command, and see it acknowledged or rejected. */
static void require_usable(void)
{
    for (uint32_t i = 0u; i < USABLE_TICKS; i++) {
        tick(nothing, 0u);
    }
    greet();
    const mavlink_command_t command = {.sequence = 1u, .session = session, .kind = COMMAND_DISABLE};
    const uint32_t before = pil_answer_frame.outputs.acknowledged_count + pil_answer_frame.outputs.rejected_count;
    say(MAVLINK_MSG_ID_COMMAND, &command, sizeof command);
    tick(nothing, 0u);
    const uint32_t after = pil_answer_frame.outputs.acknowledged_count + pil_answer_frame.outputs.rejected_count;
    require(after == before + 1u, "the link is not usable again");
}

/* Each step of the data is a control byte and what it says: below 128 so many raw bytes, else a message of that kind,
 * or time. */
static uint32_t step(const uint8_t *data, uint32_t size)
{
    uint8_t bytes[MAVLINK_MAX_PACKET_LEN];
    const uint32_t control = data[0];
    const uint32_t kind = control % 16u;
    uint32_t length = size - 1u < control ? size - 1u : control;
    if (control < 128u) {
        bring(&data[1], length);
        return 1u + length;
    }
    if (kind >= sizeof kinds / sizeof kinds[0]) {
        pil_request_frame.restart = control == 255u ? RESTART_POWER : RESTART_NONE;
        pil_request_frame.stop_pressed = control == 254u;
        tick(data, 0u);
        return 1u;
    }
    const uint32_t most = mavlink_get_msg_entry(kinds[kind])->max_msg_len;
    length = size - 1u < most ? size - 1u : most;
    bring(bytes, frame(bytes, kinds[kind], &data[1], length));
    return 1u + length;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    pil_request_frame = (pil_request){.magic = FRAME_REQUEST, .version = FRAME_VERSION, .supply_mv = 12000u};
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        pil_request_frame.counts[joint] = 32768u;
    }
    static int stored;
    if (!stored) { /* it lasts */
        pil_start();
        store();
        stored = 1;
    }
    pil_start();
    greet();
    for (size_t at = 0u; at < size;) {
        at += step(&data[at], (uint32_t)(size - at));
    }
    pil_request_frame.stop_pressed = 0u;
    require_usable();
    return 0;
}

#ifdef SHAKE
#include "draw.h"

int main(int count, char **arguments)
{
    static uint8_t data[4096];
    const long rounds = count > 1 ? atol(arguments[1]) : 1000;
    for (long round = 0; round < rounds; round++) {
        const uint32_t size = draw() % sizeof data;
        for (uint32_t i = 0u; i < size; i++) {
            const uint32_t random = draw() >> 16; /* zeros and small ones make numbers small */
            data[i] = (uint8_t)(random % 3u == 0u ? 0u : random % 3u == 1u ? (random >> 8) % 8u : random >> 8);
        }
        LLVMFuzzerTestOneInput(data, size);
    }
    return 0;
}
#endif
