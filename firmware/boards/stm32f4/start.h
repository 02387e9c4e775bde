/* Between the vector table and the board. */
#ifndef ARMSIGHT_STM32F4_START_H
#define ARMSIGHT_STM32F4_START_H

/* Set everything up and serve the wire for ever. Called once memory and floating point are ready. */
void board_main(void);

/* Count a millisecond and ask for the tick. SysTick, highest priority. */
void systick_interrupt(void);

/* Run the tick. PendSV, lowest priority. */
void pendsv_interrupt(void);

/* Begin. Reset. */
void reset(void);

/* Switch the drives off and wait for the watchdog. Every fault, a failed clock, supply too low, unexpected interrupt. */
void fault(void);
void fault_stop(void);

#endif
