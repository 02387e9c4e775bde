/* The sync LED: its code is a function of the board's clock, so that cameras that see it know when they exposed. */
#ifndef ARMSIGHT_SYNC_LED_H
#define ARMSIGHT_SYNC_LED_H

#include <stdbool.h>

#include "types.h"

#define SYNC_LED_BITS 511u /* of the code: a maximum-length sequence of x^9 + x^4 + 1 */

/* Return whether the LED is on from this tick until the next. No state: nothing that happens to a tick shifts the code,
 * but a wrap of the tick's 32 bits does, once in 49 days. Tick. */
bool sync_led_on(const core_config *config, uint32_t tick);

#endif
