#include "motor.h"

#include "number.h"

#define FADE_S 0.4f           /* a gap fades with this time constant: what opens more slowly is not seen */
#define PRIOR_VARIANCE 0.005625f /* of R and K over the configuration's: 0.075^2, so that three sigma of both cover 15 % */
#define WANDER_VARIANCE 4e-7f /* by which each becomes less certain per window: windings get warm */
#define SIGMAS 3.0f
#define SCALE_LOW 0.8f        /* further off than so is no tolerance of a motor */
#define SCALE_HIGH 1.25f
#define WINDOW_TICKS 32u      /* over which R and K are learnt */
#define WINDOW_NOISE_RAD 0.0025f /* two readings' noise, at most 20 counts of a usual potentiometer */
#define SURPRISE 9.0f         /* squared sigmas beyond which a window teaches nothing */
#define SAMPLE_TICKS 4u
#define PARTED 0.85f          /* of a gap: where it began to open */
#define STEADY 0.4f           /* of a gap in its first half: it opens steadily, not faster and faster */
#define AGREED 3.0f           /* of apart_rad: so much way together proves that the wiring was right */
#define SETTLE_TICKS 3u       /* after the windings were closed, currents are not yet known */

void motor_start(motor_state *motor, float angle_rad)
{
    const float duty = motor->duty;
    *motor = (motor_state){.duty = duty,
                           .last_rad = angle_rad,
                           .window_rad = angle_rad,
                           .resistance_scale = 1.0f,
                           .constant_scale = 1.0f,
                           .variance_rr = PRIOR_VARIANCE,
                           .variance_kk = PRIOR_VARIANCE};
}

/* Learn both scales from a window: v = r (R i) + k (K w), by recursive least squares (Kalman's form). */
static void learn(motor_state *motor, const motor_config *config, float angle_rad)
{
    const float ticks = (float)motor->window_ticks;
    const float ir_v = motor->window_ir_v / ticks;
    const float kw_v = config->constant_v_s * (angle_rad - motor->window_rad) / (ticks * TICK_S);
    const float noise_v = config->constant_v_s * WINDOW_NOISE_RAD / (ticks * TICK_S);
    const float gain_r = motor->variance_rr * ir_v + motor->variance_rk * kw_v;
    const float gain_k = motor->variance_rk * ir_v + motor->variance_kk * kw_v;
    const float variance = ir_v * gain_r + kw_v * gain_k + noise_v * noise_v;
    const float off_v = motor->window_v / ticks - motor->resistance_scale * ir_v - motor->constant_scale * kw_v;
    if (off_v * off_v <= SURPRISE * variance) {
        const float way_rad = number_size(angle_rad - motor->window_rad);
        motor->agreed_rad += way_rad > 4.0f * WINDOW_NOISE_RAD ? way_rad : 0.0f;
        motor->resistance_scale =
            number_clamp(motor->resistance_scale + gain_r * off_v / variance, SCALE_LOW, SCALE_HIGH);
        motor->constant_scale = number_clamp(motor->constant_scale + gain_k * off_v / variance, SCALE_LOW, SCALE_HIGH);
        motor->variance_rr += WANDER_VARIANCE - gain_r * gain_r / variance;
        motor->variance_rk -= gain_r * gain_k / variance;
        motor->variance_kk += WANDER_VARIANCE - gain_k * gain_k / variance;
    }
}

static void window_begin(motor_state *motor, float angle_rad)
{
    motor->window_v = 0.0f;
    motor->window_ir_v = 0.0f;
    motor->window_rad = angle_rad;
    motor->window_ticks = 0u;
}

static void window(motor_state *motor, const motor_config *config, float voltage_v, float ir_v, float angle_rad)
{
    motor->window_v += voltage_v;
    motor->window_ir_v += ir_v;
    motor->window_ticks++;
    if (motor->window_ticks < WINDOW_TICKS) {
        return;
    }
    if (number_size(motor->gap_rad) < 0.5f * config->apart_rad) {
        learn(motor, config, angle_rad);
    }
    window_begin(motor, angle_rad);
}

static void sample(motor_state *motor, float angle_rad, float reference_rad)
{
    if (motor->driven_ticks % SAMPLE_TICKS == 0u) {
        const uint32_t at = motor->sampled % MOTOR_SAMPLES;
        motor->sample_read_rad[at] = angle_rad;
        motor->sample_motor_rad[at] = motor->travel_rad;
        motor->sample_reference_rad[at] = reference_rad;
        motor->sampled++;
    }
}

void motor_pause(motor_state *motor, float angle_rad)
{
    motor->last_rad = angle_rad;
    window_begin(motor, angle_rad);
}

void motor_measure(motor_state *motor, const motor_config *config, float supply_v, float current_a, float angle_rad,
                   float reference_rad)
{
    const float moved_rad = angle_rad - motor->last_rad;
    motor->last_rad = angle_rad;
    motor->driven_ticks = number_count(motor->driven_ticks);
    if (config->resistance_ohm <= 0.0f || motor->driven_ticks <= SETTLE_TICKS) {
        motor->window_rad = angle_rad;
        return;
    }
    const float voltage_v = motor->duty * supply_v;
    const float ir_v = current_a * config->resistance_ohm;
    const float emf_v = voltage_v - motor->resistance_scale * ir_v;
    motor->speed_rad_s = emf_v / (motor->constant_scale * config->constant_v_s);
    const float variance = motor->variance_rr * ir_v * ir_v + 2.0f * motor->variance_rk * ir_v * emf_v +
                           motor->variance_kk * emf_v * emf_v;
    const float unsure_rad_s = SIGMAS * number_root(variance > 0.0f ? variance : 0.0f) / config->constant_v_s;
    const float keep = 1.0f - TICK_S / FADE_S;
    motor->gap_rad = keep * motor->gap_rad + moved_rad - motor->speed_rad_s * TICK_S;
    motor->band_rad = keep * motor->band_rad + unsure_rad_s * TICK_S;
    motor->travel_rad += motor->speed_rad_s * TICK_S;
    sample(motor, angle_rad, reference_rad);
    window(motor, config, voltage_v, ir_v, angle_rad);
}

/* A joint's last milliseconds, since motor and reading parted. */
typedef struct parting {
    uint32_t samples;
    float read_rad;      /* how far each went */
    float motor_rad;
    float reference_rad;
    float early_share;   /* the reading's part of the motor's way in the first half, */
    float late_share;    /* in the second */
    float early_gap;     /* the first half's part of the gap */
} parting;

static float share(float part, float whole) { return number_size(whole) < 1e-3f ? 0.0f : part / whole; }

/* Return the sample from which on most of the gap opened. */
static uint32_t parted_at(const motor_state *motor, uint32_t known)
{
    const float apart = motor->last_rad - motor->travel_rad;
    float most = 0.0f;
    for (uint32_t back = 1u; back <= known; back++) {
        const uint32_t at = (motor->sampled - back) % MOTOR_SAMPLES;
        const float off = number_size(apart - (motor->sample_read_rad[at] - motor->sample_motor_rad[at]));
        most = off > most ? off : most;
    }
    for (uint32_t back = 1u; back < known; back++) {
        const uint32_t at = (motor->sampled - back) % MOTOR_SAMPLES;
        const float off = number_size(apart - (motor->sample_read_rad[at] - motor->sample_motor_rad[at]));
        if (off >= PARTED * most) {
            return back;
        }
    }
    return known;
}

static parting parted(const motor_state *motor)
{
    const uint32_t known = motor->sampled < MOTOR_SAMPLES ? motor->sampled : MOTOR_SAMPLES;
    parting found = {.samples = parted_at(motor, known)};
    const uint32_t first = (motor->sampled - found.samples) % MOTOR_SAMPLES;
    const uint32_t half = (motor->sampled - (found.samples + 1u) / 2u) % MOTOR_SAMPLES;
    const uint32_t newest = (motor->sampled - 1u) % MOTOR_SAMPLES;
    const float early_read_rad = motor->sample_read_rad[half] - motor->sample_read_rad[first];
    const float early_motor_rad = motor->sample_motor_rad[half] - motor->sample_motor_rad[first];
    found.read_rad = motor->last_rad - motor->sample_read_rad[first];
    found.motor_rad = motor->travel_rad - motor->sample_motor_rad[first];
    found.reference_rad = motor->sample_reference_rad[newest] - motor->sample_reference_rad[first];
    found.early_share = share(early_read_rad, early_motor_rad);
    found.late_share = share(found.read_rad - early_read_rad, found.motor_rad - early_motor_rad);
    found.early_gap = share(early_read_rad - early_motor_rad, found.read_rad - found.motor_rad);
    return found;
}

/* Name a fault that showed while the reference rested: what opens steadily drifts; a reading that stands still lets the
 * joint creep faster and faster. */
static uint32_t name_resting(const parting *was, bool agreed)
{
    const float follows = share(was->read_rad, was->motor_rad);
    if (!agreed && follows < -0.6f) {
        return FAULT_POT_INVERTED;
    }
    return was->early_gap > STEADY ? FAULT_POT_DRIFT : FAULT_POT_FROZEN;
}

/* Name a fault of a potentiometer that was good: it stuck, slips or drifts. The loop makes a reading that drifts or slips
 * go along with the reference all the same. */
static uint32_t name_broken(const parting *was)
{
    const float gap_rad = number_size(was->read_rad - was->motor_rad);
    const float follows = share(was->read_rad, was->motor_rad);
    if (follows < -0.6f && number_size(was->motor_rad) > 0.35f * gap_rad) {
        return FAULT_POT_INVERTED;
    }
    if (number_size(was->read_rad) < 0.35f * number_size(was->reference_rad)) {
        return FAULT_POT_FROZEN;
    }
    const bool still = number_size(was->motor_rad) < 0.35f * gap_rad;
    return still || follows < 0.2f || follows > 1.0f ? FAULT_POT_DRIFT : FAULT_POT_SLIP;
}

/* Name a fault that was there when the joint was enabled. */
static uint32_t name_wrong(const parting *was)
{
    const float follows = share(was->read_rad, was->motor_rad);
    if (follows < -0.3f) {
        return FAULT_POT_INVERTED;
    }
    if (follows > 1.0f) {
        return FAULT_POT_SCALE;
    }
    if (was->late_share > was->early_share + 0.25f) {
        return FAULT_POT_LAG;
    }
    return follows < 0.15f ? FAULT_POT_FROZEN : FAULT_POT_SCALE;
}

static uint32_t name(const motor_state *motor, const motor_config *config)
{
    const parting was = parted(motor);
    if (was.samples <= 2u && number_size(was.motor_rad) < 0.5f * number_size(was.read_rad - was.motor_rad)) {
        return FAULT_POT_JUMP;
    }
    const bool agreed = motor->agreed_rad > AGREED * config->apart_rad;
    if (number_size(was.reference_rad) < 0.25f * number_size(was.read_rad - was.motor_rad)) {
        return name_resting(&was, agreed);
    }
    return agreed ? name_broken(&was) : name_wrong(&was);
}

uint32_t motor_disagrees(const motor_state *motor, const motor_config *config, float supply_v, float current_a)
{
    if (config->resistance_ohm <= 0.0f || number_size(motor->gap_rad) <= config->apart_rad + motor->band_rad) {
        return FAULT_NONE;
    }
    const float across_v = number_size(motor->duty) * supply_v;
    if (number_size(current_a) * config->resistance_ohm < 0.02f * across_v) {
        return FAULT_CURRENT_SENSOR;
    }
    return name(motor, config);
}

#define SWING_TICKS 60u   /* a swing of 8 Hz and faster changes its side as often */
#define SWINGS 8u         /* so many changes are no answer to anything */
#define SWING_RAD_S 0.3f  /* as far from the reference's speed at least */
#define SWING_SHARE 0.2f  /* of the speed limit */

bool motor_swings(motor_state *motor, float reference_rad_s, float speed_limit_rad_s)
{
    const float share_rad_s = SWING_SHARE * speed_limit_rad_s;
    const float far_rad_s = share_rad_s > SWING_RAD_S ? share_rad_s : SWING_RAD_S;
    const float off_rad_s = motor->speed_rad_s - reference_rad_s;
    const int32_t side = off_rad_s > far_rad_s ? 1 : (off_rad_s < -far_rad_s ? -1 : 0);
    motor->swing_ticks = number_count(motor->swing_ticks);
    if (side != 0 && side != motor->swing_side) {
        motor->swings = motor->swing_ticks <= SWING_TICKS ? motor->swings + 1u : 0u;
        motor->swing_side = side;
        motor->swing_ticks = 0u;
    }
    return motor->swings >= SWINGS;
}

#define FAST_TICKS 30u
#define FAST 1.08f /* of the limit: by both witnesses */

bool motor_is_fast(motor_state *motor, float reading_rad_s, float speed_limit_rad_s)
{
    const float fast_rad_s = FAST * speed_limit_rad_s;
    const bool fast = number_size(motor->speed_rad_s) > fast_rad_s && number_size(reading_rad_s) > speed_limit_rad_s;
    motor->fast_ticks = fast ? number_count(motor->fast_ticks) : 0u;
    return motor->fast_ticks >= FAST_TICKS;
}
