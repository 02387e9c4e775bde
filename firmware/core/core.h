/* The controller: one call per millisecond. No hardware, no clock, no allocation; needs memcpy and memset alone. */
#ifndef ARMSIGHT_CORE_H
#define ARMSIGHT_CORE_H

#include <stdbool.h>

#include "types.h"

/* Begin with the drives off. Call once, before the tick timer runs.
 *
 * config: a valid one is copied; an invalid one is replaced by the factory's values and rejects enabling.
 * source: what config_load returned; CONFIG_FACTORY rejects enabling too.
 * reset: RESET_...; all but RESET_POWER latch a fault that can be cleared.
 */
void core_init(core_state *core, const core_config *config, uint32_t source, uint32_t reset);

/* Run one tick of 1 ms. Timer interrupt or a task of the highest priority; not reentrant. Everything in outputs is
 * written. Where the state's guard words are gone nothing can be trusted: drives off, and the watchdog is not fed. */
void core_tick(core_state *core, const core_inputs *inputs, core_outputs *outputs);

#endif
