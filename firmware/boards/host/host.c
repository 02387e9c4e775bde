/* The host board: the firmware as a shared library, its functions called by name; pil_tick runs the emulated board. A
 * caller in another language lays the records out by itself; host_size lets it find out whether it did so rightly. */
#include "frame.h"
#include "wire.h"

#define RECORD_LIST(X)                                                                                             \
    X(joint_gains) X(gain_set) X(pot_config) X(joint_config) X(core_config) X(config_copy) X(move_command)         \
    X(core_command) X(core_inputs) X(core_outputs) X(pid_state) X(pid_demand) X(setpoint_state) X(governor_state) \
    X(motor_config) X(transmission_config) X(encoder_config) X(encoder_state) X(motor_state) X(motor_sums) \
    X(zero_state) X(observer_state) X(crash_record) X(board_abilities) X(pot_state) \
    X(joint_state) X(core_state) X(pil_request) X(pil_answer) X(wire_setup) X(wire_periods) X(wire_counters)       \
    X(wire_state)

typedef struct record_size {
    const char *name;
    uint32_t bytes;
} record_size;

#define RECORD_SIZE(name) {#name, sizeof(name)},
static const record_size record_sizes[] = {RECORD_LIST(RECORD_SIZE)};

/* Return the size in bytes of the record of this name, 0 where there is none. Any context. */
uint32_t host_size(const char *name);

uint32_t host_size(const char *name)
{
    for (uint32_t record = 0u; record < sizeof record_sizes / sizeof record_sizes[0]; record++) {
        const char *left = record_sizes[record].name;
        const char *right = name;
        while (*left != '\0' && *left == *right) {
            left++;
            right++;
        }
        if (*left == *right) {
            return record_sizes[record].bytes;
        }
    }
    return 0u;
}
