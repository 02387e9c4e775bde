/* What the Nucleo-F446RE's drivers give. docs/howto/add_a_board.md has the pin table and the wiring. */
#ifndef ARMSIGHT_STM32F4_DRIVERS_H
#define ARMSIGHT_STM32F4_DRIVERS_H

#include <stdbool.h>

#include "types.h"

#define PROCESSOR_HZ 180000000u
#define TIMER_HZ PROCESSOR_HZ /* of TIM1 and TIM8: twice their bus, which is half the processor's */
#define UART_HZ 45000000u     /* of USART2's bus, APB1 */
#define ADC_HZ 22500000u      /* a quarter of the converter's bus, APB2 */
#define PWM_HZ 20000u
#define PWM_STEPS (TIMER_HZ / PWM_HZ / 2u) /* the counter goes up and down once a period */
#define UART_BAUD 921600u
#define SCANS 16u             /* readings of each converter channel added up: 16 of 12 bits make 16 bits */
#define CHANNELS 13u          /* six currents, the supply, six potentiometers, in this order */
#define CONVERSION_CLOCKS 68u /* 56 sampling, 12 converting */

/* Bring the processor to 180 MHz: from the ST-Link's 8 MHz, or from the internal oscillator where there is none.
 * Startup only, before any other peripheral has its clock. */
void clock_start(void);

/* Connect the pins to what drives them. Startup only, after the timers are set up. */
void pins_start(void);

/* Make the pin of the sync LED (core_config's sync_led_pin) an output, unless the table or the debugger has it, or it is
 * beyond port C. Startup only, after pins_start. */
void pins_light_start(uint32_t led_pin);

/* Switch the LED on or off, where pins_light_start could. Tick only. */
void pins_light(uint32_t led_pin, bool on);

/* Set up the PWM timers with all outputs off. Startup only. */
void drives_start(void);

/* Let both timers run, and with them the converter. Startup only, last. */
void drives_run(void);

/* Drive the motors with these duties (-1 to 1); a number that is none counts as 0. Tick only. */
void drives_write(const float duty[JOINTS]);

/* Switch the bridges off and the PWM outputs low. Any context, any state: needs nothing but the registers. */
void drives_off(void);

/* Return whether the emergency stop's line is open, or was since the last call. Tick only. */
bool drives_stopped(void);

/* Start the converter; the timers trigger it. Startup, and the tick where it stands still. */
void adc_start(void);

/* Read what the converter saw since the last tick. Where it stood still every potentiometer reads open (65535), and it
 * is started again. Tick only. */
void adc_read(core_inputs *inputs);

/* Start the wire on the ST-Link's serial port. Startup only. */
void uart_start(void);

/* Take up to room bytes that came in and return how many; add those lost for lack of room to *overrun. Main loop. */
uint32_t uart_receive(uint8_t *bytes, uint32_t room, uint32_t *overrun);

/* Take bytes to send, if the last ones are gone, and return how many were taken. Main loop. */
uint32_t uart_send(const uint8_t *bytes, uint32_t length);

/* Let the watchdog wait so long before it resets the processor, and feed it. The first call starts it; nothing ends it.
 * No interrupt that feeds it may come between. */
void watchdog_set_short(void); /* 10 ms (6.8 to 18.8: its oscillator is a rough one): while ticks run */
void watchdog_set_long(void);  /* 2 s (1.4 to 3.8): while starting, and while the flash memory is written */
void watchdog_feed(void);

/* Return whether it was the watchdog that reset the processor; forgets it. Startup only. */
bool watchdog_was_here(void);

/* Read stored copy which (0 or 1) as it is. Any context but the tick. */
void flash_read(uint32_t which, config_copy *copy);

/* Write copy which (0 or 1) and return whether it reads back so. The processor stands still meanwhile, up to 0.6 s, and
 * so do the ticks: main loop only, with the drives off. */
bool flash_write(uint32_t which, const config_copy *copy);

#endif
