/* The wire: the host's bytes become commands for the core, its reports become telemetry. MAVLink 2, dialect
 * armsight.xml.
 *
 * Two contexts meet here: wire_before_tick and wire_after_tick belong to the tick; everything else to the main loop,
 * which the tick may interrupt. They meet in a mailbox for one command, a count of stops, and a report that is
 * read again if a tick came meanwhile.
 */
#ifndef ARMSIGHT_WIRE_H
#define ARMSIGHT_WIRE_H

#include <stdatomic.h>
#include <stdbool.h>

#include "mavlink_setup.h"
#include "types.h"

#define FIRMWARE_VERSION "0.2.0" /* the package's; at most 16 characters */
#define WIRE_OUT_BYTES 1024u     /* room for what waits to go out; a power of two */
#define WIRE_QUEUE 8u            /* commands that may wait for their tick */
#define WIRE_PART_BYTES 200u     /* of the configuration in one CONFIG_PART */
#define WIRE_GAP_TICKS 5u        /* how much later than the wire alone asks for a message may end */

/* Who speaks. */
typedef struct wire_setup {
    const char *board;         /* its name, at most 16 characters */
    uint32_t baud;             /* bits a second, 8N1 */
    uint32_t config_source;    /* CONFIG_NEWEST, CONFIG_OLDER or CONFIG_FACTORY */
    const core_config *config; /* in use; the tick may change its gains */
    crash_record crash;        /* that the board started after */
    board_abilities abilities;
} wire_setup;

/* How often each kind of telemetry goes out, in ticks. */
typedef struct wire_periods {
    uint32_t angles;
    uint32_t joints;
    uint32_t status;
} wire_periods;

/* What has gone wrong on the way from the host, and what came of it. Counts wrap. */
typedef struct wire_counters {
    uint32_t crc_errors;     /* messages whose checksum was wrong */
    uint32_t lost_bytes;     /* bytes that belonged to no message */
    uint32_t overrun_bytes;  /* bytes for which the board had no room */
    uint32_t stale_commands; /* dropped: not newer than one that came already, or crowded out by newer ones */
    uint32_t lost_messages;  /* missing in the count of the frames */
    uint32_t config_stored;  /* configurations stored */
} wire_counters;

/* The commands' fate, the core's and the wire's own. */
typedef struct wire_fate {
    uint32_t acknowledged_sequence;
    uint32_t acknowledged_count;
    uint32_t rejected_sequence;
    uint32_t rejected_count;
    uint32_t rejection;
} wire_fate;

/* What a tick leaves for the telemetry. */
typedef struct wire_report {
    core_outputs outputs;
    uint32_t supply_mv;
    uint32_t counts[JOINTS];
    int32_t current_ma[JOINTS];
    float last_duty[JOINTS]; /* of the tick before: on while counts and currents were measured */
} wire_report;

/* What comes in: a message being put together. */
typedef struct wire_input {
    mavlink_message_t message;
    mavlink_status_t framing;
    uint8_t held[MAVLINK_MAX_PACKET_LEN]; /* its bytes, to be read again from the second one should it be none */
    uint32_t held_count;
    uint32_t begin_tick;
    uint32_t counting;                    /* not 0: frame_count is known */
    uint8_t frame_count;                  /* of the next frame */
} wire_input;

/* What goes out: a ring of bytes. Both counts run on and wrap. */
typedef struct wire_ring {
    mavlink_status_t framing;
    uint32_t written;
    uint32_t taken;
    uint8_t bytes[WIRE_OUT_BYTES];
} wire_ring;

/* Commands that wait for a tick, the oldest first. */
typedef struct wire_queue {
    core_command command[WIRE_QUEUE];
    uint32_t count;
} wire_queue;

/* A configuration on its way in. */
typedef struct wire_staged {
    core_config config;
    uint32_t crc;      /* the host's */
    uint32_t sequence; /* of its CONFIG_STORE */
    uint32_t storing;  /* not 0: handed to the board */
} wire_staged;

/* What tools ask for by MAVLink's common messages. */
typedef struct wire_common {
    uint32_t sensed_period; /* of SENSED, ticks; 0: none */
    uint32_t sensed_tick;   /* when the last one went out */
    uint32_t second_tick;   /* and the last HEARTBEAT */
    uint32_t owner_tick;    /* when the session's owner was heard last */
    uint32_t tools;         /* not 0: a HEARTBEAT came since the last HELLO: they listen */
    uint32_t said_faults[JOINTS + 1u]; /* as text, of each joint and of none */
    uint32_t said_state;
    uint32_t listed;        /* parameters sent of a list */
    uint32_t params_staged; /* not 0: staged.config has the limits that were set */
    uint32_t waits;         /* not 0: the core's answer is waited for */
    uint32_t sequence;      /* of the command it is to */
    uint32_t param;         /* which it sets */
    uint32_t restart;       /* not 0: the board is to start anew */
    uint16_t command;       /* MAV_CMD_ it answers */
    uint16_t texts;         /* said in pieces; it wraps */
    uint8_t system;         /* who asked */
    uint8_t component;
} wire_common;

/* What the tick and the main loop share. */
typedef struct wire_shared {
    core_command mail;             /* the main loop's while mail_full is 0, the tick's otherwise */
    _Atomic uint32_t mail_full;
    _Atomic uint32_t stops;        /* STOPs that came */
    uint32_t stops_taken;          /* the tick's */
    _Atomic uint32_t sessions;     /* HELLOs that came */
    uint32_t sessions_taken;       /* the tick's */
    wire_report report;            /* the tick's: read again if report_count has changed meanwhile */
    _Atomic uint32_t report_count; /* how many there were */
} wire_shared;

/* The whole wire. */
typedef struct wire_state {
    wire_setup setup;
    wire_periods periods;
    wire_counters counters;
    wire_input input;
    wire_ring output;
    wire_queue queue;
    wire_staged staged;
    wire_common common;
    wire_shared shared;
    wire_fate fate;
    wire_report report;       /* the newest one, the main loop's */
    uint32_t reports_read;
    uint32_t session;         /* its commands carry it */
    uint32_t owner;           /* MAVLink system of the host that has it */
    uint32_t greeted;         /* not 0: a HELLO of this version came */
    uint32_t sequence_known;  /* not 0: newest_sequence is one */
    uint32_t newest_sequence; /* of the commands that came since the last HELLO */
    uint32_t stop_waits;      /* not 0: a STOP came that is in no report yet */
    uint32_t stop_sequence;   /* its number */
    uint32_t stop_report;     /* the report before the tick that takes it */
    uint32_t mailed_kind;     /* of the last command mailed */
    uint32_t angles_tick;     /* when the last one of each went out */
    uint32_t joints_tick;
    uint32_t status_tick;
    uint32_t status_urgent;   /* not 0: state or faults changed since the last STATUS */
    uint32_t status_due;      /* not 0: a command was acknowledged, or something rejected */
} wire_state;

/* Begin with nothing come and nothing said. Before the first tick. */
void wire_init(wire_state *wire, const wire_setup *setup);

/* Return the telemetry's periods: the shortest that leave a fifth of the wire free. Any context. */
wire_periods wire_periods_at(uint32_t baud);

/* Take bytes of the host, and the number of those that were lost for lack of room. Main loop. */
void wire_receive(wire_state *wire, const uint8_t *bytes, uint32_t length, uint32_t overrun);

/* Hand the next command to the tick, and write the telemetry that is due. Main loop, after wire_receive. */
void wire_poll(wire_state *wire);

/* Return the configuration the board must store now and report by wire_stored; NULL without. Main loop, after
 * wire_poll. */
const core_config *wire_to_store(const wire_state *wire);
void wire_stored(wire_state *wire, bool done);

/* Return whether the board is to start anew, once what waits has gone out. Main loop, after wire_poll. */
bool wire_to_restart(const wire_state *wire);

/* Point *bytes to what waits to go out and return how much of it lies there in one piece; wire_sent then takes
 * how many were sent. Main loop. */
uint32_t wire_output(const wire_state *wire, const uint8_t **bytes);
void wire_sent(wire_state *wire, uint32_t length);

/* Put in this tick's command, COMMAND_NONE without, and a STOP that came. Tick, before core_tick. */
void wire_before_tick(wire_state *wire, core_inputs *inputs);

/* Keep what this tick gave for the telemetry. Tick, after core_tick. */
void wire_after_tick(wire_state *wire, const core_inputs *inputs, const core_outputs *outputs);

#endif
