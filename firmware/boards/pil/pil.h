/* The emulated board, in lock-step with Python: one request, one tick, one answer. The same code runs on the host
 * (shared library), under Unicorn (pil_tick is called) and under QEMU (startup.c: the middle part runs in the SysTick
 * interrupt). */
#ifndef ARMSIGHT_PIL_H
#define ARMSIGHT_PIL_H

#include <stdbool.h>

#include "frame.h"

/* The frames: the caller fills in the first and reads the second. */
extern pil_request pil_request_frame;
extern pil_answer pil_answer_frame;

/* Switch the board on; what was stored stays. Once before the first tick. */
void pil_start(void);

/* Run one tick on pil_request_frame and write pil_answer_frame: the three parts below, one after the other. */
void pil_tick(void);

/* Main loop: take the request and its bytes. Returns whether it is one; otherwise pil_answer_frame says why not. */
bool pil_begin(void);

/* Tick interrupt. */
void pil_control(void);

/* Main loop: write the answer and its bytes. */
void pil_end(void);

#endif
