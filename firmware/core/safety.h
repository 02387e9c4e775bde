/* Faults: how they latch, what they do to the arm, and what watches for them. All functions: tick context, except the
 * texts, which any context may ask for. */
#ifndef ARMSIGHT_SAFETY_H
#define ARMSIGHT_SAFETY_H

#include <stdbool.h>

#include "types.h"

/* Return the short name of a fault, a state or a rejection ("POT_OPEN"), or "?" for a code that is none. */
const char *fault_name(uint32_t code);
const char *state_name(uint32_t code);
const char *rejection_name(uint32_t code);

/* Return its text for people, or "?" for a code that is none. */
const char *fault_text(uint32_t code);
const char *state_text(uint32_t code);
const char *rejection_text(uint32_t code);

/* Return whether the drives are on in the present state. */
inline bool safety_drives_on(const core_state *core)
{
    return core->state == STATE_ENABLED || core->state == STATE_STOPPING || core->state == STATE_HOLDING;
}

/* Latch a fault of a joint (0 to 5, or NO_JOINT), whose cause stands in this tick, and react to it. */
void safety_raise(core_state *core, uint32_t fault, uint32_t joint);

/* Take the emergency stop: drives off in every state, asleep within 0.3 s. */
void safety_stop(core_state *core);

/* Forget all latched faults; the caller has made sure that the cause of none of them stands. */
void safety_forget(core_state *core);

/* Watch the tick timer, the memory, the supply and, while the arm follows the host, the host's silence. */
void safety_watch_arm(core_state *core, const core_inputs *inputs);

/* Take the current that the duty must drive for that of a sensor that is doubted, where currents are limited. */
void safety_limit_blindly(core_state *core);

/* Watch some of the driven joints, every one once in WATCH_TICKS, after their duties are known. */
void safety_watch_joints(core_state *core);

/* Watch joints whose windings are shorted with the drives off: one that is driven on puts all drivers to sleep. */
void safety_watch_rest(core_state *core);

/* Watch what sleeping bridges show: a current that flows through one is its sensor's error. */
void safety_watch_sleep(core_state *core);

/* Begin the watch over the configuration in use from its first byte; known: its CRC is still the one it had. */
void safety_changed_config(core_state *core, bool known);

#endif
