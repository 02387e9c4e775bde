/* Encoders: counts of a quadrature timer, or frames of an AS5047, to joint angle. All functions: tick context, but for
 * encoder_telemetry, which any context may call. */
#ifndef ARMSIGHT_ENCODER_H
#define ARMSIGHT_ENCODER_H

#include <stdbool.h>

#include "types.h"

/* Return whether the two frames of an AS5047 are sound: even parity, no error bit, and in the second the sensor's word
 * that its offsets are compensated: a line that is stuck low or high gives neither. */
bool encoder_frames_sound(uint32_t frames);

/* Return whether the second frame reports a magnet too weak or too strong, or an angle that overflowed. */
bool encoder_magnet_wrong(uint32_t frames);

/* Take this tick's reading of a joint whose sensor is an encoder: pot remembers its angle as it does a potentiometer's.
 * A reading that is not sound, or further off than the joint can have moved, is not plausible: the angle stays. Returns
 * the fault once that lasts confirm_ticks (1 or more), FAULT_NONE until then. */
uint32_t encoder_read(encoder_state *encoder, pot_state *pot, const joint_config *config, uint32_t reading,
                      uint32_t confirm_ticks);

/* Let the joint's present reading be that of home_rad. */
void encoder_home(encoder_state *encoder, const joint_config *config);

/* Return whether the joint's angle is known: a quadrature encoder counts from wherever it was switched on. */
bool encoder_is_homed(const encoder_state *encoder, const joint_config *config);

/* Return a reading as telemetry carries it: a potentiometer's counts; the lower 16 bits of a quadrature count; the 14
 * bits of an absolute angle, ENCODER_UNSOUND and ENCODER_MAGNET. */
uint32_t encoder_telemetry(const joint_config *config, uint32_t reading);

#endif
