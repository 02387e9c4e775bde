/* What every board runs: the core, the wire and the stored configuration around one struct literal. */
#ifndef ARMSIGHT_LOOP_H
#define ARMSIGHT_LOOP_H

#include "board.h"
#include "wire.h"

typedef struct board_loop {
    const board_description *board;
    core_state core;
    core_inputs inputs;
    core_outputs outputs;
    wire_state wire;
    volatile uint32_t unpolled_ticks; /* since the main loop came round */
    config_copy copies[2]; /* main loop's scratch */
} board_loop;

/* Load the configuration and begin with the drives off. Once, before the tick timer runs. */
void loop_start(board_loop *loop, const board_description *board);

/* Run one tick. Timer interrupt, every ms; may interrupt loop_poll, never the other way round. */
void loop_tick(board_loop *loop);

/* Serve the wire. Main loop, again and again. */
void loop_poll(board_loop *loop);

#endif
