/* Between the vector table and the board. */
#ifndef ARMSIGHT_STM32F4_START_H
#define ARMSIGHT_STM32F4_START_H

#include <stdbool.h>

#include "types.h"

/* Return whether a fault ended the last run, and where; forgets it. Startup only. */
bool crash_was_here(crash_record *record);

/* Set everything up and serve the wire for ever. Called once memory and floating point are ready. */
void board_main(void);

/* Count a millisecond and ask for the tick. SysTick, highest priority. */
void systick_interrupt(void);

/* Run the tick. PendSV, lowest priority. */
void pendsv_interrupt(void);

/* Begin. Reset. */
void reset(void);

/* Switch the drives off, keep where it happened, and wait for the watchdog. Every fault, a failed clock, supply too
 * low, unexpected interrupt. */
void fault(void);
void fault_stop(const uint32_t *frame, uint32_t exception);

#endif
