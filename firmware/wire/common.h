/* MAVLink's common messages. All functions: main loop. */
#ifndef ARMSIGHT_WIRE_COMMON_H
#define ARMSIGHT_WIRE_COMMON_H

#include "wire.h"

/* Begin with nothing asked for. */
void common_init(wire_state *wire);

/* Execute a message, if it is one of them; returns whether it was. */
bool common_take(wire_state *wire, const mavlink_message_t *message);

/* Say what became of a command of this number, REJECTION_NONE where it was acknowledged; returns whether it was one of
 * theirs: the session's owner then hears nothing of it. */
bool common_answered(wire_state *wire, uint32_t sequence, uint32_t rejection);

/* Wait for no answer any more: what waited was dropped. */
void common_forget(wire_state *wire);

/* Begin a session: its owner asks for messages anew. */
void common_begin_session(wire_state *wire);

/* Write what is due. After telemetry_fetch. */
void common_write(wire_state *wire);

#endif
