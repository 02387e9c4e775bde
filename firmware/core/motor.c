#include "motor.h"

#define FADE_S 0.4f           /* a gap fades with this time constant: what opens more slowly is not seen */
#define PRIOR_VARIANCE 0.005625f /* of R and K over the configuration's: 0.075^2, so that three sigma of both cover 15 % */
#define WANDER_VARIANCE 6e-9f /* by which each becomes less certain per tick: windings get warm */
#define SIGMAS 3.0f
#define SCALE_LOW 0.8f        /* further off than so is no resistance's tolerance, warm or cold */
#define SCALE_HIGH 1.25f
#define CONSTANT_LOW (1.0f - CONSTANT_OFF)
#define CONSTANT_HIGH (1.0f + CONSTANT_OFF)
#define WINDOW_TICKS 32u      /* R and K are learnt from a window: until the reading has moved, looked at as often, */
#define REST_TICKS 256u       /* or has rested for so long */
#define WINDOW_NOISE_RAD 0.0025f /* two readings' noise, at most 20 counts of a usual potentiometer */
#define RESTING 0.5f          /* of the backlash: two positions in it are a sigma of 0.41 apart */
#define WINDOW_WAY_RAD (4.0f * WINDOW_NOISE_RAD) /* on less the loop's answer to the noise looks like a motor constant */
#define SURPRISE 9.0f         /* squared sigmas beyond which a window teaches nothing */
#define SAMPLE_TICKS 8u
#define AGREED 4.0f           /* of apart_rad: so much way together proves that wiring and scale are right, */
#define SAME_LOW 0.75f        /* if the motor's is as much of the reading's: */
#define SAME_HIGH 1.3f        /* its constant is off by 15 %, the rest are resistance, backlash and noise */
#define CAREFUL 0.5f          /* of the speed limit until then: a reading of a third of the true speed is no faster joint */
#define CONSTANT_OFF 0.15f    /* by so much a motor's constant may be off */
#define UNKNOWN_RAD_S 1000.0f
#define SEEN_RAD_S 0.5f       /* above a motor's speed in one tick by noise: no slower joint is held to its limit by it */
#define SIDE_UNKNOWN 0
#define REVERSAL_TICKS 64u    /* in a longer window than so a joint may have reversed and come back */
#define DEAD_SHARE 0.05f      /* of what the voltage could drive: a current that small of late is none */
#define SETTLE_TICKS 3u       /* after the windings were closed, currents are not yet known */

void motor_start(motor_state *motor, float angle_rad, float speed_limit_rad_s, uint32_t phase)
{
    const float duty = motor->duty;
    *motor = (motor_state){.duty = duty,
                           .fastest_rad_s = speed_limit_rad_s > SEEN_RAD_S ? speed_limit_rad_s : SEEN_RAD_S,
                           .last_rad = angle_rad,
                           .window_rad = angle_rad,
                           .window_ticks = phase,
                           .window_side = SIDE_UNKNOWN,
                           .resistance_scale = 1.0f,
                           .constant_scale = 1.0f,
                           .variance_rr = PRIOR_VARIANCE,
                           .variance_kk = PRIOR_VARIANCE,
                           .unsure_rad_s = UNKNOWN_RAD_S,
                           .trust = CAREFUL,
                           .phase = phase};
}

static void way_begin(motor_state *motor)
{
    motor->way_motor_rad = 0.0f;
    motor->way_read_rad = 0.0f;
    motor->way_mark_rad = 0.0f;
    motor->way_ticks = 0u;
}

/* Take a window's way of both into that since the joint last rested: once it is long and the same, the reading is trusted. */
static void earn(motor_state *motor, const motor_config *config, float way_rad)
{
    const float emf_v = motor->window_v - motor->resistance_scale * motor->window_ir_v;
    motor->way_motor_rad += emf_v * TICK_S / config->constant_v_s;
    motor->way_read_rad += way_rad;
    motor->way_ticks += motor->window_ticks;
    if (number_size(motor->way_read_rad - motor->way_mark_rad) > WINDOW_WAY_RAD) { /* it goes on, be it slowly */
        motor->way_mark_rad = motor->way_read_rad;
        motor->way_ticks = 0u;
    } else if (motor->way_ticks >= REST_TICKS) {
        way_begin(motor);
    }
    if (number_size(motor->way_read_rad) < AGREED * config->apart_rad) {
        return;
    }
    const float same = motor->way_motor_rad / motor->way_read_rad;
    motor->trust = same > SAME_LOW && same < SAME_HIGH ? 1.0f : motor->trust;
    way_begin(motor);
}

/* Return how far the motor's way over a window may be from the reading's, and remember which way it went. Only a gear that
 * goes on to the side where its teeth lie already crosses no backlash: a motor that rests may be anywhere between them. */
static float window_noise(motor_state *motor, const motor_config *config, float way_rad)
{
    const bool moved = number_size(way_rad) > WINDOW_WAY_RAD;
    const int32_t side = moved ? (way_rad > 0.0f ? 1 : -1) : SIDE_UNKNOWN;
    const bool goes_on = side == motor->window_side && moved && motor->window_ticks <= REVERSAL_TICKS;
    motor->window_side = side;
    const float crossed = goes_on ? 0.0f : moved ? 1.0f : RESTING;
    return WINDOW_NOISE_RAD + crossed * config->backlash_rad;
}

/* Learn both scales from a window: v = r (R i) + k (K w), by recursive least squares (Kalman's form). */
static void learn(motor_state *motor, const motor_config *config, float angle_rad, float noise_rad)
{
    const float ticks = (float)motor->window_ticks;
    const float per_tick = 1.0f / ticks;
    const float wander = WANDER_VARIANCE * ticks;
    motor->variance_rr += motor->variance_rr < PRIOR_VARIANCE ? wander : 0.0f; /* also where nothing is learnt */
    const float per_s = (float)TICKS_PER_S * per_tick;
    const float ir_v = motor->window_ir_v * per_tick;
    const float kw_v = config->constant_v_s * (angle_rad - motor->window_rad) * per_s;
    const float noise_v = config->constant_v_s * noise_rad * per_s;
    const float gain_r = motor->variance_rr * ir_v + motor->variance_rk * kw_v;
    const float gain_k = motor->variance_rk * ir_v + motor->variance_kk * kw_v;
    const float variance = ir_v * gain_r + kw_v * gain_k + noise_v * noise_v;
    const float off_v = motor->window_v * per_tick - motor->resistance_scale * ir_v - motor->constant_scale * kw_v;
    if (off_v * off_v <= SURPRISE * variance) {
        const float per_variance = 1.0f / variance;
        const bool moved = number_size(angle_rad - motor->window_rad) > WINDOW_WAY_RAD;
        motor->resistance_scale =
            number_clamp(motor->resistance_scale + gain_r * off_v * per_variance, SCALE_LOW, SCALE_HIGH);
        if (moved) { /* else the constant is only taken into account (Schmidt's form) */
            motor->constant_scale =
                number_clamp(motor->constant_scale + gain_k * off_v * per_variance, CONSTANT_LOW, CONSTANT_HIGH);
            motor->variance_kk += wander - gain_k * gain_k * per_variance;
        }
        motor->variance_rr -= gain_r * gain_r * per_variance;
        motor->variance_rk -= gain_r * gain_k * per_variance;
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
    if (motor->window_ticks % WINDOW_TICKS != 0u) {
        return;
    }
    const float way_rad = angle_rad - motor->window_rad;
    if (motor->window_ticks < REST_TICKS && number_size(way_rad) <= WINDOW_WAY_RAD) {
        return;
    }
    const float noise_rad = window_noise(motor, config, way_rad);
    if (motor->trust != 1.0f) {
        earn(motor, config, way_rad);
    }
    /* A gap that R and K may explain must be learnt from: else they would stay wrong for good. */
    if (number_size(motor->gap_rad) < 0.5f * config->apart_rad + motor->band_rad) {
        learn(motor, config, angle_rad, noise_rad);
    }
    window_begin(motor, angle_rad);
}

/* Let the unknown duration of a pause make the motor's speed unknown. */
void motor_pause(motor_state *motor, float angle_rad)
{
    motor->last_rad = angle_rad;
    motor->unsure_rad_s = UNKNOWN_RAD_S;
    motor->sure_rad_s = 0.0f;
    motor->window_side = SIDE_UNKNOWN; /* backlash may be crossed meanwhile */
    window_begin(motor, angle_rad);
}

/* What changes slowly: how uncertain the speed is, and the samples. */
static void sample(motor_state *motor, const motor_config *config, float ir_v, float emf_v, float angle_rad)
{
    const float variance = motor->variance_rr * ir_v * ir_v + 2.0f * motor->variance_rk * ir_v * emf_v +
                           motor->variance_kk * emf_v * emf_v;
    motor->unsure_rad_s = SIGMAS * number_root(variance > 0.0f ? variance : 0.0f) / config->constant_v_s;
    if (motor->trust == 1.0f) {
        motor->doubt_rad_s = motor->unsure_rad_s;
    } else { /* nobody contradicts a constant that is too large: the joint is as fast as it may be */
        const float by_resistance_v = SIGMAS * number_root(motor->variance_rr) * number_size(ir_v);
        motor->doubt_rad_s = (by_resistance_v - CONSTANT_OFF * number_size(emf_v)) / config->constant_v_s;
    }
    const uint32_t at = motor->sampled % MOTOR_SAMPLES;
    motor->sample_read_rad[at] = angle_rad;
    motor->sample_motor_rad[at] = motor->travel_rad;
    motor->sampled++;
}

void motor_measure(motor_state *motor, const motor_config *config, float supply_v, float current_a, float angle_rad)
{
    const float moved_rad = angle_rad - motor->last_rad;
    motor->last_rad = angle_rad;
    motor->driven_ticks = number_count(motor->driven_ticks);
    if (config->resistance_ohm <= 0.0f || motor->driven_ticks <= SETTLE_TICKS) {
        motor->window_rad = angle_rad;
        motor->trust = config->resistance_ohm <= 0.0f ? 1.0f : motor->trust; /* no witness, no trust to earn */
        return;
    }
    const float voltage_v = motor->duty * supply_v;
    const float ir_v = current_a * config->resistance_ohm;
    const float emf_v = voltage_v - motor->resistance_scale * ir_v;
    const bool sampled = (motor->driven_ticks + motor->phase) % SAMPLE_TICKS == 0u || motor->unsure_rad_s == UNKNOWN_RAD_S;
    if (sampled) {
        motor->per_constant = 1.0f / (motor->constant_scale * config->constant_v_s);
    }
    motor->speed_rad_s = emf_v * motor->per_constant;
    const float keep = 1.0f - TICK_S / FADE_S;
    const float travelled_rad = motor->speed_rad_s * TICK_S;
    motor->travel_rad += travelled_rad;
    const float seen_a = number_size(current_a);
    motor->current_a = seen_a > keep * motor->current_a ? seen_a : keep * motor->current_a;
    if (sampled) {
        sample(motor, config, ir_v, emf_v, angle_rad);
    }
    motor->gap_rad = keep * motor->gap_rad + moved_rad - travelled_rad;
    motor->band_rad = keep * motor->band_rad + motor->unsure_rad_s * TICK_S;
    window(motor, config, voltage_v, ir_v, angle_rad);
    const float size_rad_s = number_size(motor->speed_rad_s);
    const bool known = motor->current_a * config->resistance_ohm > DEAD_SHARE * config->constant_v_s * size_rad_s;
    motor->known = known ? 1u : 0u;
    motor->sure_rad_s = known ? size_rad_s - motor->doubt_rad_s : 0.0f;
}

uint32_t motor_disagrees(const motor_state *motor, const motor_config *config, float supply_v)
{
    const float across_v = number_size(motor->duty) * supply_v;
    if (motor->current_a * config->resistance_ohm < DEAD_SHARE * across_v) {
        return FAULT_CURRENT_SENSOR;
    }
    /* What it looks like so far, by the last 32 ms. */
    const uint32_t back = motor->sampled < 4u ? motor->sampled : 4u;
    const uint32_t at = (motor->sampled - back) % MOTOR_SAMPLES;
    const float motor_rad = motor->travel_rad - motor->sample_motor_rad[at];
    const float read_rad = motor->last_rad - motor->sample_read_rad[at];
    const bool agreed = motor->trust == 1.0f;
    if (number_size(read_rad) < 0.25f * number_size(motor_rad) + WINDOW_NOISE_RAD) {
        return FAULT_POT_FROZEN;
    }
    if (!agreed && read_rad * motor_rad < 0.0f) {
        return FAULT_POT_INVERTED;
    }
    if (read_rad * motor_rad < 0.0f || number_size(read_rad) > number_size(motor_rad)) {
        return FAULT_POT_DRIFT;
    }
    return agreed ? FAULT_POT_SLIP : FAULT_POT_SCALE;
}

#define NAME_SAMPLES 24u    /* of the last 192 ms: most of them after the joint was let go of */
#define NAME_NOISE_RAD 0.002f
#define JUMP_SHARE 0.7f
#define LAG_SHARE 0.5f      /* of what the others leave unexplained: a lag has one number more to fit with */

/* Sums over the samples: reading y, motor m, their difference z, the sample's number k, the way between them x. */
typedef struct name_sums {
    float y, m, z, k, x;
    float yy, mm, zz, kk, xx;
    float my, zk, yk, yx, kx;
} name_sums;

/* Return what is left of squares yy once a regressor with squares xx is fitted; *slope is its factor. */
static float left_of(float yy, float xy, float xx, float *slope)
{
    *slope = xx > 0.0f ? xy / xx : 0.0f;
    return yy - *slope * xy;
}

static name_sums sums_of(const motor_state *motor, uint32_t count)
{
    name_sums s = {0};
    const uint32_t first = (motor->sampled - count) % MOTOR_SAMPLES;
    float x = 0.0f;
    for (uint32_t i = 0u; i < count; i++) {
        const uint32_t at = (motor->sampled - count + i) % MOTOR_SAMPLES;
        const float y = motor->sample_read_rad[at] - motor->sample_read_rad[first];
        const float m = motor->sample_motor_rad[at] - motor->sample_motor_rad[first];
        const float z = y - m;
        const float k = (float)i;
        x -= z;
        s.y += y; s.m += m; s.z += z; s.k += k; s.x += x;
        s.yy += y * y; s.mm += m * m; s.zz += z * z; s.kk += k * k; s.xx += x * x;
        s.my += m * y; s.zk += z * k; s.yk += y * k; s.yx += y * x; s.kx += k * x;
    }
    const float n = (float)count; /* about their means */
    s.yy -= s.y * s.y / n; s.mm -= s.m * s.m / n; s.zz -= s.z * s.z / n; s.kk -= s.k * s.k / n; s.xx -= s.x * s.x / n;
    s.my -= s.m * s.y / n; s.zk -= s.z * s.k / n; s.yk -= s.y * s.k / n; s.yx -= s.y * s.x / n; s.kx -= s.k * s.x / n;
    return s;
}

/* Return what is left of the reading if it follows late: y = a k + x T/lag by least squares; x alone is what lag adds. */
static float left_by_lag(const name_sums *s, float *rate)
{
    float unused;
    const float yy = left_of(s->yy, s->yk, s->kk, &unused);
    const float yx = s->yx - s->yk * s->kx / s->kk;
    const float xx = s->xx - s->kx * s->kx / s->kk;
    return left_of(yy, yx, xx, rate);
}

/* Return whether most of what lies between reading and motor opened from one sample to the next. */
static bool jumped(const motor_state *motor, uint32_t count)
{
    float low = 0.0f, high = 0.0f, largest = 0.0f, last = 0.0f;
    const uint32_t first = (motor->sampled - count) % MOTOR_SAMPLES;
    for (uint32_t i = 1u; i < count; i++) {
        const uint32_t at = (motor->sampled - count + i) % MOTOR_SAMPLES;
        const float z = motor->sample_read_rad[at] - motor->sample_motor_rad[at] - motor->sample_read_rad[first] +
                        motor->sample_motor_rad[first];
        const float step = number_size(z - last);
        low = z < low ? z : low;
        high = z > high ? z : high;
        largest = step > largest ? step : largest;
        last = z;
    }
    return largest > 10.0f * NAME_NOISE_RAD && largest > JUMP_SHARE * (high - low);
}

uint32_t motor_names(const motor_state *motor, uint32_t suspect)
{
    const uint32_t count = motor->sampled < NAME_SAMPLES ? motor->sampled : NAME_SAMPLES;
    if (count < NAME_SAMPLES / 2u) {
        return suspect;
    }
    if (jumped(motor, count)) {
        return FAULT_POT_JUMP;
    }
    const name_sums s = sums_of(motor, count);
    const float noise = (float)count * NAME_NOISE_RAD * NAME_NOISE_RAD;
    if (s.mm < 4.0f * noise) { /* the motor rests */
        return s.yy > 4.0f * noise ? FAULT_POT_DRIFT : suspect;
    }
    float share, drift, rate;
    const float by_share = left_of(s.yy, s.my, s.mm, &share) + noise;
    const float by_drift = left_of(s.zz, s.zk, s.kk, &drift) + noise;
    const float least = by_share < by_drift ? by_share : by_drift;
    if (by_share < by_drift && share < -0.3f) {
        return FAULT_POT_INVERTED;
    }
    if (left_by_lag(&s, &rate) + noise < LAG_SHARE * least && rate > 0.0f) {
        return FAULT_POT_LAG;
    }
    if (by_drift < by_share) {
        return number_size(drift) * (float)count > 4.0f * NAME_NOISE_RAD ? FAULT_POT_DRIFT : suspect;
    }
    if (share < 0.15f) {
        return FAULT_POT_FROZEN;
    }
    const bool agreed = motor->trust == 1.0f;
    return agreed && share < 1.0f ? FAULT_POT_SLIP : FAULT_POT_SCALE;
}

#define SWING_TICKS 60u   /* a swing of 8 Hz and faster changes its side as often */
#define SWINGS 8u         /* so many changes are no answer to anything */
#define SWING_RAD_S 0.4f  /* as far from the reference's speed at least */

bool motor_swings_far(motor_state *motor, float off_rad_s)
{
    const int32_t side = off_rad_s > 0.0f ? 1 : -1;
    if (motor->known == 0u || number_size(off_rad_s) <= SWING_RAD_S) {
        motor->swings = motor->known == 0u ? 0u : motor->swings;
        return false;
    }
    if (side != motor->swing_side) {
        motor->swings = motor->driven_ticks - motor->swing_since <= SWING_TICKS ? motor->swings + 1u : 0u;
        motor->swing_side = side;
        motor->swing_since = motor->driven_ticks;
    }
    return motor->swings >= SWINGS;
}

#define FAST_TICKS 30u
#define FAST 1.08f /* of what it is held to: by both witnesses */

bool motor_is_fast(motor_state *motor, float reading_rad_s)
{
    const float fast_rad_s = FAST * motor->fastest_rad_s;
    const bool fast = number_size(motor->speed_rad_s) > fast_rad_s && number_size(reading_rad_s) > motor->fastest_rad_s;
    motor->fast_ticks = fast ? number_add(motor->fast_ticks, WATCH_TICKS) : 0u;
    return motor->fast_ticks >= FAST_TICKS;
}
