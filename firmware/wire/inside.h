/* What the wire's files share among each other. All functions: main loop. */
#ifndef ARMSIGHT_WIRE_INSIDE_H
#define ARMSIGHT_WIRE_INSIDE_H

#include "wire.h"

#define WIRE_SYSTEM 1u    /* the board's MAVLink system and component */
#define WIRE_COMPONENT 1u
#define COMMAND_STORE 0x100u /* a CONFIG_STORE in its order among the commands; the core never sees it */

/* Return the tick of the newest report. */
static inline uint32_t wire_tick(const wire_state *wire) { return wire->report.outputs.tick; }

/* Execute a message whose checksum is right. */
void message_take(wire_state *wire, const mavlink_message_t *message);

/* Return whether a command may be taken, by its number, its session and the system that sent it; rejects or drops it
 * otherwise. */
bool command_admit(wire_state *wire, const mavlink_message_t *message, uint32_t sequence, uint32_t session);

/* Return the slot at the queue's end for a command of this kind; NULL, and rejects it, where there is none. */
core_command *command_append(wire_state *wire, uint32_t kind, uint32_t sequence);

/* Reject a command before it reaches the core, or say that the wire itself acknowledged it. */
void command_reject(wire_state *wire, uint32_t sequence, uint32_t rejection);
void command_acknowledge(wire_state *wire, uint32_t sequence);

/* Stop in an emergency: what waits is dropped. */
void command_stop(wire_state *wire);

/* Mail the oldest waiting command if the mailbox is empty and what became of the last one is known. */
void command_deliver(wire_state *wire);

/* Take a message that is no command: about the configuration. */
void settings_take(wire_state *wire, const mavlink_message_t *message);

/* Copy so many bytes from this one on of the configuration in use. */
void settings_copy(const wire_state *wire, uint32_t offset, void *to, uint32_t length);

/* Check the configuration that came in parts, and hand it to the board. */
void settings_store(wire_state *wire, uint32_t sequence);

/* Write a message behind what waits to go out; where there is no room it is lost, and its number missing says so. */
void telemetry_put(wire_state *wire, const mavlink_message_t *message);

/* Return whether what waits to go out leaves telemetry worth writing. */
bool telemetry_has_room(const wire_state *wire);

/* Take over the newest report, and what became of the commands in it. Returns whether there was one. */
bool telemetry_fetch(wire_state *wire);

/* Write the telemetry that is due. After telemetry_fetch. */
void telemetry_write(wire_state *wire);

#endif
