/* What the drivers of an STM32F4 board give. chip.h says which board: its clocks, peripherals and pins. */
#ifndef ARMSIGHT_STM32F4_DRIVERS_H
#define ARMSIGHT_STM32F4_DRIVERS_H

#include <stdbool.h>

#include <chip.h> /* of the board's own folder */

#include "types.h"

#define PWM_HZ 20000u
#define PWM_STEPS (TIMER_HZ / PWM_HZ / 2u) /* the counter goes up and down once a period */
#define UART_BAUD 921600u
#define SCANS 16u             /* readings of each converter channel added up: 16 of 12 bits make 16 bits */
#define CHANNELS (2u * BOARD_JOINTS + 1u) /* currents, the supply, potentiometers, in this order */
#define CONVERSION_CLOCKS 68u /* 56 sampling, 12 converting */

/* Bring the processor to its speed: from the external clock, or from the internal oscillator where there is none.
 * Startup only, before any other peripheral has its clock. */
void clock_start(void);

/* Who needs a pin: every board (ALWAYS), quadrature encoders (the number of their input), or absolute ones (SPI). */
enum { ALWAYS = 0, SPI = 255 };

/* Connect the pins to what drives them, but for the encoders'. Startup only, after the timers are set up. */
void pins_start(void);

/* Connect the pins of a quadrature encoder's input, or of SPI. Startup only, once their peripheral is set up. */
void pins_connect(uint32_t user);

/* Let a joint's potentiometer pin be the chip select of its absolute encoder, high. Startup only. */
void pins_select_start(uint32_t joint);

/* Make the pin of the sync LED (core_config's sync_led_pin) an output, unless the table or the debugger has it, or it
 * is beyond port C. Startup only, after pins_start. */
void pins_light_start(uint32_t led_pin);

/* Switch the LED on or off, where pins_light_start could. Tick only. */
void pins_light(uint32_t led_pin, bool on);

/* Set up the PWM timers with all outputs off. Startup only. */
void drives_start(void);

/* Let the timers run, and with them the converter. Startup only, last. */
void drives_run(void);

/* Drive the motors with these duties (-1 to 1); a number that is none counts as 0. Tick only. */
void drives_write(const float duty[JOINTS]);

/* Switch the bridges off and the PWM outputs low. Any context, any state: needs nothing but the registers. */
void drives_off(void);

/* Return whether the emergency stop's line is open, or was since the last call. Tick only. */
bool drives_stopped(void);

/* Start the converter; the timers trigger it. Startup, and the tick where it stands still. */
void adc_start(void);

/* Read what the converter saw since the last tick. Where it stood still every potentiometer reads open (65535), there
 * is no supply, and it is started again. Tick only. */
void adc_read(core_inputs *inputs);

/* Set up the encoders that a configuration has, and wait up to 20 ms for each absolute one. Startup only. */
void encoders_start(const core_config *config);

/* Put the readings of the encoders in place of their joints' potentiometers. Tick only, after adc_read. */
void encoders_read(core_inputs *inputs);

/* Start the wire. Startup only. */
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
