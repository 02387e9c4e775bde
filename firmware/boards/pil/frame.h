/* The lock-step frames of the emulated board: Python sends a request, the firmware runs one tick and answers. Fields
 * of four bytes and byte arrays of a multiple of four, little-endian, without a hole: the frames are the same bytes
 * to every compiler. */
#ifndef ARMSIGHT_FRAME_H
#define ARMSIGHT_FRAME_H

#include "types.h"

#define FRAME_REQUEST 0x51525341u /* "ASRQ" as bytes in memory */
#define FRAME_ANSWER 0x4E415341u  /* "ASAN" */
#define FRAME_REJECTED 0x4F4E5341u /* "ASNO": magic or version is another, or it is too long; no tick was run */
#define FRAME_VERSION 4u          /* goes up whenever a frame changes */
#define FRAME_BYTES 512u          /* most bytes of the wire either way in one tick */

/* What a request may do before its tick. */
enum { RESTART_NONE = 0, RESTART_POWER = 1, RESTART_WATCHDOG = 2 };

typedef struct pil_request {
    uint32_t magic;
    uint32_t version;
    uint32_t tick;
    uint32_t restart;            /* RESTART_...: the board starts anew; the stored configuration stays */
    uint32_t overrun;            /* injected: not 0 says that the last tick took too long */
    uint32_t stop_pressed;       /* the button */
    uint32_t supply_mv;
    uint32_t counts[JOINTS];
    int32_t current_ma[JOINTS];
    uint32_t length;             /* bytes of the wire that came in since the last tick */
    uint8_t bytes[FRAME_BYTES];
} pil_request;

typedef struct pil_answer {
    uint32_t magic;
    uint32_t version;
    uint32_t tick;               /* the request's */
    core_outputs outputs;
    uint32_t sync_led;           /* not 0: the sync LED is on from this tick until the next */
    uint32_t length;             /* bytes of the wire that go out in this tick: never more than the baud rate carries */
    uint8_t bytes[FRAME_BYTES];
} pil_answer;

#endif
