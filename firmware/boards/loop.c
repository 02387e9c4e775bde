#include "loop.h"

#include <stddef.h>
#include <string.h>

#include "config.h"
#include "core.h"
#include "number.h"
#include "sync_led.h"

#define CHUNK 128u
#define HUNG_TICKS 1000u /* a main loop that does not come round for so long hangs: the watchdog shall have it */

/* Return whether the board has the joints and the sensors that a configuration asks for. */
static bool suits(const board_abilities *board, const core_config *config)
{
    for (uint32_t joint = 0u; joint < config->joint_count; joint++) {
        const encoder_config *encoder = &config->joint[joint].encoder;
        const bool there = encoder->sensor != SENSOR_QUADRATURE || encoder->input <= board->quadrature_inputs;
        if ((board->sensors >> encoder->sensor & 1u) == 0u || !there) {
            return false;
        }
    }
    return config->joint_count <= board->joints;
}

/* Return what config_load says of the two stored copies, which it leaves in loop->copies. */
static uint32_t load(board_loop *loop, core_config *config)
{
    loop->board->read_copy(0u, &loop->copies[0]);
    loop->board->read_copy(1u, &loop->copies[1]);
    config_upgrade(&loop->copies[0]);
    config_upgrade(&loop->copies[1]);
    return config_load(config, &loop->copies[0], &loop->copies[1]);
}

void loop_start(board_loop *loop, const board_description *board)
{
    core_config config;
    memset(loop, 0, sizeof *loop); /* a compound literal may take its size of stack */
    loop->board = board;
    uint32_t source = load(loop, &config);
    if (!suits(&board->abilities, &config)) { /* written by the firmware of another board, or the factory's six
                                                 joints */
        config_factory(&config);
        config.joint_count = board->abilities.joints;
        source = CONFIG_FACTORY;
    }
    core_init(&loop->core, &config, source, board->reset_cause());
    wire_setup setup = {board->name, board->baud, source, &loop->core.config, {0}, board->abilities};
    board->crash(&setup.crash);
    wire_init(&loop->wire, &setup);
}

void loop_tick(board_loop *loop)
{
    loop->board->sense(&loop->inputs);
    if (loop->board->light != NULL && loop->core.config.sync_led_pin != 0u) {
        loop->board->light(loop->core.config.sync_led_pin, sync_led_on(&loop->core.config, loop->inputs.tick));
    }
    wire_before_tick(&loop->wire, &loop->inputs);
    core_tick(&loop->core, &loop->inputs, &loop->outputs);
    loop->board->drive(&loop->outputs);
    loop->unpolled_ticks = number_count(loop->unpolled_ticks);
    if (loop->outputs.feed_watchdog != 0u && loop->unpolled_ticks < HUNG_TICKS) {
        loop->board->feed_watchdog();
    }
    wire_after_tick(&loop->wire, &loop->inputs, &loop->outputs);
}

/* Write a configuration beside the newest good copy; returns whether it is stored. */
static bool write(board_loop *loop, const core_config *config)
{
    uint32_t serial = 0u;
    const uint32_t which = config_next(&loop->copies[0], &loop->copies[1], &serial);
    config_seal(&loop->copies[which], config, serial);
    return loop->board->write_copy(which, &loop->copies[which]);
}

/* Store a configuration, and a second time where the other copy is broken or was never written. */
static bool store(board_loop *loop, const core_config *config)
{
    core_config stored;
    if (!suits(&loop->board->abilities, config)) {
        return false;
    }
    load(loop, &stored);
    const bool done = write(loop, config);
    if (done && load(loop, &stored) != CONFIG_NEWEST) {
        return write(loop, config);
    }
    return done;
}

void loop_poll(board_loop *loop)
{
    uint8_t bytes[CHUNK];
    uint32_t length;
    loop->unpolled_ticks = 0u;
    do {
        uint32_t overrun = 0u;
        length = loop->board->receive(bytes, CHUNK, &overrun);
        wire_receive(&loop->wire, bytes, length, overrun);
    } while (length == CHUNK);
    wire_poll(&loop->wire);
    const core_config *config = wire_to_store(&loop->wire);
    if (config != NULL) {
        wire_stored(&loop->wire, store(loop, config));
    }
    const uint8_t *waiting;
    while ((length = wire_output(&loop->wire, &waiting)) != 0u) {
        const uint32_t taken = loop->board->send(waiting, length);
        wire_sent(&loop->wire, taken);
        if (taken != length) {
            break;
        }
    }
    if (wire_to_restart(&loop->wire) && loop->outputs.drives_on == 0u) {
        loop->board->restart();
    }
}
