/* The contract of a board: one struct literal. To add a board: fill one in, call loop_start, loop_tick from its 1 kHz
 * timer and loop_poll from its main loop (docs/howto/add_a_board.md). */
#ifndef ARMSIGHT_BOARD_H
#define ARMSIGHT_BOARD_H

#include <stdbool.h>

#include "types.h"

typedef struct board_description {
    const char *name; /* at most 16 characters, sent in WELCOME */
    uint32_t baud;    /* bits a second on the wire, 8N1: the telemetry's rate follows from it */

    board_abilities abilities; /* sent in WELCOME */

    /* Tick. Fill in everything but the command: tick, overrun, stop_pressed (the button), supply_mv, counts,
     * current_ma. taken_over is the wire's. */
    void (*sense)(core_inputs *inputs);

    /* Tick. Put the duties to the motors. With drives_on 0 and windings_shorted not 0 keep the bridges awake at duty 0:
     * both ends of a winding low, the motor brakes itself. With both 0 switch the drivers off. Release the brakes,
     * where there are any, while brakes_open is not 0. */
    void (*drive)(const core_outputs *outputs);

    /* Tick, once each time it ran to its end. */
    void (*feed_watchdog)(void);

    /* Before the first tick. Return why the board started, RESET_.... */
    uint32_t (*reset_cause)(void);

    /* Before the first tick, once. Fill in what is kept of the crash that the board started after; 0 without. */
    void (*crash)(crash_record *crash);

    /* Main loop. Take up to room bytes that came from the host and return how many. *overrun: add the bytes for which
     * there was no room since the last call. */
    uint32_t (*receive)(uint8_t *bytes, uint32_t room, uint32_t *overrun);

    /* Main loop. Take bytes for the host and return how many were taken; the others are offered again. */
    uint32_t (*send)(const uint8_t *bytes, uint32_t length);

    /* Main loop, and before the first tick. Read the stored copy 0 or 1 as it is, good or not. */
    void (*read_copy)(uint32_t which, config_copy *copy);

    /* Main loop, drives off. Store a copy (may take long); returns whether it reads back as written. */
    bool (*write_copy)(uint32_t which, const config_copy *copy);

    /* Main loop, drives off. Start anew, as after switching on. */
    void (*restart)(void);

    /* Tick, right after sense, so that its edges do not move with the tick's cost. Switch the LED of this pin (as
     * core_config's sync_led_pin, never 0) on or off; do nothing where the pin has another use. NULL without an LED. */
    void (*light)(uint32_t pin, bool on);
} board_description;

#endif
