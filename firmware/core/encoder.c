#include "encoder.h"

#include "number.h"
#include "pot.h"

#define TWO_PI 6.28318531f
#define ANGLE 0x3FFFu       /* of a frame: its 14 bits */
#define ERROR 0x4000u       /* EF: the command before it was not understood */
#define LOOPS_DONE 0x0100u  /* LF of DIAAGC: the offsets are compensated */
#define MAGNET 0x0E00u      /* MAGL, MAGH and COF of DIAAGC */

_Static_assert(ENCODER_REV == ANGLE + 1u, "14 bits are a revolution");

bool encoder_frames_sound(uint32_t frames)
{
    uint32_t odd = frames ^ frames >> 8; /* of each half of 16 bits the lowest: whether its number of ones is odd */
    odd ^= odd >> 4;
    odd ^= odd >> 2;
    odd ^= odd >> 1;
    return (odd & 0x00010001u) == 0u && (frames & (ERROR | ERROR << 16)) == 0u && (frames & LOOPS_DONE << 16) != 0u;
}

bool encoder_magnet_wrong(uint32_t frames) { return (frames & MAGNET << 16) != 0u; }

/* Return how many counts from its zero the encoder is. Counts of a timer wrap, those of an angle do half a revolution
 * away. */
static int32_t from_zero(const encoder_state *encoder, const encoder_config *config, uint32_t counts)
{
    if (config->sensor == SENSOR_QUADRATURE) {
        return (int32_t)(counts - encoder->zero_counts);
    }
    return (int32_t)((counts - config->zero_counts + ENCODER_REV / 2u) & ANGLE) - (int32_t)(ENCODER_REV / 2u);
}

uint32_t encoder_read(encoder_state *encoder, pot_state *pot, const joint_config *config, uint32_t reading,
                      uint32_t confirm_ticks)
{
    const encoder_config *own = &config->encoder;
    uint32_t suspect = FAULT_NONE;
    uint32_t counts = reading;
    if (own->sensor == SENSOR_QUADRATURE) {
        if (pot->valid == 0u && encoder->homed == 0u) {
            encoder->zero_counts = counts; /* as if it stood at home, until somebody says so */
        }
        encoder->counts = counts;
    } else {
        const bool sound = encoder_frames_sound(reading);
        suspect = sound && !encoder_magnet_wrong(reading) ? FAULT_NONE : FAULT_ENCODER;
        counts = reading & ANGLE;
    }
    const float rad_per_count = (float)own->direction * (TWO_PI / own->counts_per_rev);
    const float angle_rad = own->home_rad + rad_per_count * (float)from_zero(encoder, own, counts);
    return pot_take(pot, &config->pot, counts, angle_rad, suspect, confirm_ticks);
}

void encoder_home(encoder_state *encoder, const joint_config *config)
{
    if (config->encoder.sensor == SENSOR_QUADRATURE) {
        encoder->zero_counts = encoder->counts;
        encoder->homed = 1u;
    }
}

bool encoder_is_homed(const encoder_state *encoder, const joint_config *config)
{
    return config->encoder.sensor != SENSOR_QUADRATURE || encoder->homed != 0u;
}

uint32_t encoder_telemetry(const joint_config *config, uint32_t reading)
{
    switch (config->encoder.sensor) {
    case SENSOR_QUADRATURE:
        return reading & 0xFFFFu;
    case SENSOR_ABSOLUTE:
        return (reading & ANGLE) | (encoder_frames_sound(reading) ? 0u : ENCODER_UNSOUND) |
               (encoder_magnet_wrong(reading) ? ENCODER_MAGNET : 0u);
    default:
        return reading < 65535u ? reading : 65535u;
    }
}
