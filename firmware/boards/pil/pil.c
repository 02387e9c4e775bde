#include "pil.h"

#include <string.h>

#include "loop.h"

#define BAUD 921600u
#define BAUD_PER_BYTE 10000u /* baud that carry one byte each ms: 10 bits, 1000 ticks */
#define WATCHDOG_TICKS 10u

pil_request pil_request_frame;
pil_answer pil_answer_frame;

/* What lies beside the processor. */
static board_loop loop;
static config_copy storage[2];
static uint32_t bytes_read;   /* of the request's */
static uint32_t line_credit;  /* what the wire still carries of this tick, in baud */
static uint32_t unfed_ticks;
static bool by_watchdog;
static bool restart_asked;

static void sense(core_inputs *inputs)
{
    pil_answer_frame.sync_led = 0u;
    inputs->tick = pil_request_frame.tick;
    inputs->overrun = pil_request_frame.overrun;
    inputs->stop_pressed = pil_request_frame.stop_pressed;
    inputs->supply_mv = pil_request_frame.supply_mv;
    memcpy(inputs->counts, pil_request_frame.counts, sizeof inputs->counts);
    memcpy(inputs->current_ma, pil_request_frame.current_ma, sizeof inputs->current_ma);
}

static void drive(const core_outputs *outputs) { pil_answer_frame.outputs = *outputs; }

static void light(uint32_t pin, bool on)
{
    (void)pin;
    pil_answer_frame.sync_led = on ? 1u : 0u;
}

static void feed_watchdog(void) { unfed_ticks = 0u; }

static uint32_t reset_cause(void) { return by_watchdog ? RESET_WATCHDOG : RESET_POWER; }

static uint32_t receive(uint8_t *bytes, uint32_t room, uint32_t *overrun)
{
    const uint32_t left = pil_request_frame.length - bytes_read;
    const uint32_t length = left < room ? left : room;
    (void)overrun; /* a request's bytes always find room */
    memcpy(bytes, &pil_request_frame.bytes[bytes_read], length);
    bytes_read += length;
    return length;
}

static uint32_t send(const uint8_t *bytes, uint32_t length)
{
    const uint32_t carried = line_credit / BAUD_PER_BYTE;
    const uint32_t taken = length < carried ? length : carried;
    memcpy(&pil_answer_frame.bytes[pil_answer_frame.length], bytes, taken);
    pil_answer_frame.length += taken;
    line_credit -= taken * BAUD_PER_BYTE;
    return taken;
}

static void read_copy(uint32_t which, config_copy *copy) { *copy = storage[which]; }

static bool write_copy(uint32_t which, const config_copy *copy)
{
    storage[which] = *copy;
    return true;
}

static void crash(crash_record *record) { *record = (crash_record){0}; }
static void ask_restart(void) { restart_asked = true; }

static const board_description board = {
    .name = "pil",
    .baud = BAUD,
    .abilities = {JOINTS, 1u << SENSOR_POTENTIOMETER | 1u << SENSOR_QUADRATURE | 1u << SENSOR_ABSOLUTE, JOINTS},
    .sense = sense,
    .drive = drive,
    .feed_watchdog = feed_watchdog,
    .reset_cause = reset_cause,
    .crash = crash,
    .receive = receive,
    .send = send,
    .read_copy = read_copy,
    .write_copy = write_copy,
    .restart = ask_restart,
    .light = light,
};

_Static_assert((BAUD + BAUD_PER_BYTE) / BAUD_PER_BYTE < FRAME_BYTES, "an answer has room for what a tick carries");

static void restart(bool watchdog)
{
    by_watchdog = watchdog;
    restart_asked = false;
    unfed_ticks = 0u;
    line_credit = 0u;
    loop_start(&loop, &board);
}

void pil_start(void) { restart(false); }

bool pil_begin(void)
{
    const pil_request *request = &pil_request_frame;
    const bool known =
        request->magic == FRAME_REQUEST && request->version == FRAME_VERSION && request->length <= FRAME_BYTES;
    pil_answer_frame.magic = known ? FRAME_ANSWER : FRAME_REJECTED;
    pil_answer_frame.version = FRAME_VERSION;
    pil_answer_frame.tick = request->tick;
    pil_answer_frame.length = 0u;
    if (!known) {
        return false;
    }
    if (restart_asked || request->restart != RESTART_NONE || unfed_ticks == WATCHDOG_TICKS) {
        restart(!restart_asked && request->restart != RESTART_POWER);
    }
    bytes_read = 0u;
    line_credit = line_credit % BAUD_PER_BYTE + BAUD; /* a byte's part carries over, idle time does not */
    loop_poll(&loop);
    return true;
}

void pil_control(void)
{
    unfed_ticks++;
    loop_tick(&loop);
}

void pil_end(void) { loop_poll(&loop); }

void pil_tick(void)
{
    if (pil_begin()) {
        pil_control();
        pil_end();
    }
}
