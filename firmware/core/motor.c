#include "motor.h"

#define SAMPLE_KEEPS (1.0f - (float)SAMPLE_TICKS * TICK_S / FADE_S) /* of what fades, from sample to sample */
#define FADE_S 0.4f /* s; a gap fades with this time constant; half: slow drifts stay unseen, double: old errors add
                       up */
#define PRIOR_VARIANCE 0.005625f /* of R and K over the configuration's: 0.075^2, three sigma of both cover 15 %; half:
                                    other motors are doubted, double: faults show later at first */
#define WANDER_VARIANCE 6e-9f /* per tick, of K: magnets get warm; half: K follows later, double: a reading's scale is
                                 learnt as K */
#define WARMS 1e-5f /* sigma of R per tick: three of it are 3 % a second, 40 % within 20 s; half: a winding that warms
                       so fast is a fault, double: a reading that stands still is noticed later */
#define WARM_VARIANCE 0.04f /* to which that grows where nothing is learnt: 0.2^2, so that three sigma cover -20 to +40
                               % */
#define SIGMAS 3.0f /* of a number that count as its uncertainty; half: sound joints are doubted, double: faults show
                       late */
#define SCALE_LOW 0.65f /* of R: a tolerance of 15 %, 3 % of the current's gain, copper from -50 to +100 K; half:
                           shorted windings are learnt, double: cold ones doubted */
#define SCALE_HIGH 1.7f /* likewise; half: warm windings are doubted, double: bad contacts are learnt */
#define CONSTANT_LOW (1.0f - CONSTANT_OFF)
#define CONSTANT_HIGH (1.0f + CONSTANT_OFF)
#define WINDOW_TICKS 32u /* R and K are learnt from a window, which ends once the reading has moved, looked at as
                            often; half: noise teaches, double: later */
#define REST_TICKS 256u /* or has rested for so long; half: noise teaches, double: a warm winding is followed later */
#define WINDOW_NOISE_RAD 0.0025f /* two readings' noise, at most 20 counts of a usual potentiometer; half: noise
                                    teaches, double: less is learnt */
#define RESTING 0.5f /* of the backlash: two positions in it are a sigma of 0.41 apart; half: backlash teaches, double:
                        rest teaches less */
#define WINDOW_WAY_RAD (4.0f * WINDOW_NOISE_RAD) /* on less the loop's answer to the noise looks like a motor
                                                    constant */
#define SURPRISE 3.0f /* sigmas beyond which a window teaches nothing until motor and reading agreed once, and then;
                         half: other motors are never learnt, double: wrong scales are */
#define TEACHES 1.5f /* as much as one that is off by so many; half: a winding that warms is followed too late, double:
                        a drift is followed */
#define KNOWN_TICKS 1000u /* so often what was learnt is kept; half: a weak motor is learnt before it shows, double: a
                             young arm shows it later */
#define LATELY_S 1.5f /* what says what the constant is now fades so; half: slow joints show nothing, double: a weak
                         motor shows later */
#define LATELY_WARMS 0.02f /* per s, of R: so fast a winding may warm or cool meanwhile; half: warm windings are weak
                              motors, double: weak motors show later */
#define LATELY_LEFT 0.8f /* variances of a window's noise that a constant may leave; half: weak motors show later,
                            double: readings that lag are weak motors */
#define WEAKENED 0.1f /* of the configured constant, and SIGMAS: so much less is a weak motor; half: other motors are
                         weak, double: motors that lost a quarter are not seen */
#define SAMPLE_TICKS 8u /* between samples; half: ticks cost more, double: faults are named later */
#define AGREED 4.0f /* of apart_rad: so much way together proves that wiring and scale are right; half: noise proves
                       it, double: joints are careful for longer */
#define SAME_LOW 0.75f /* if the motor's is as much of the reading's; half: a scale of 2 passes, double: none passes */
#define SAME_HIGH 1.3f /* at most: its constant is off by 15 %, the rest are resistance, backlash and noise; half: none
                          passes, double: a scale of 0.4 passes */
#define SAME_UNSURE 0.5f /* of the way: what its uncertain resistance may make of the motor's; half: slow joints stay
                            careful, double: wrong scales pass */
#define CAREFUL 0.5f /* of the speed limit until then; half: first motions take twice as long, double: a wrong scale is
                        twice as fast */
#define CONSTANT_OFF 0.15f /* by so much a motor's constant may be off; half: other motors are doubted, double: weak
                              motors are learnt */
#define SMOOTH 0.333333f /* of a tick's news in the speed that is damped: 2 ms; half: soft joints swing, twice: noise */
#define SEEN_RAD_S 0.5f /* rad/s, above a motor's speed in one tick by noise: no slower limit is held by it; half:
                           noise brakes, double: slow joints go beyond theirs */
#define SIDE_UNKNOWN 0
#define REVERSAL_TICKS 64u /* in a longer window a joint may have reversed and come back; half: less is learnt, double:
                              backlash teaches */
#define DEAD_SHARE 0.05f /* of what the voltage could drive: a smaller current of late is none; half: dead sensors show
                            later, double: unloaded joints look dead */
#define SETTLE_TICKS 3u /* after the windings were closed, currents are not yet known; half: the first current is
                           wrong, double: nothing notable */
#define ZERO_TICKS 64u /* over which the zero of a current is averaged; half: noise stays in it, double: the bridges
                          must sleep for longer */
#define DISOBEY_SAMPLES 2u /* 16 ms: by then a joint that was driven goes the way it is driven, or brakes; half: noise
                              convicts, double: a bridge drives on longer */
#define DISOBEY_RAD 0.008f /* in which it goes so far at least: three sigma of two readings; half: noise convicts,
                              double: a bridge shows later */
#define DISOBEY_OFF_RAD 0.02f /* and so far it is from where it is to be; half: lagging joints are suspected, double: a
                                 bridge shows later */
#define FOLLOWS 0.7f /* of the answer of the configured resistance; half: weak motors look like bridges, double: a
                        bridge shows late */
#define FOLLOWS_SAMPLES 8u /* after a step the answer is that since; half: what was before hides a bridge, double: weak
                              motors look like one */
#define INVERTED 0.3f /* of their sum: so little may both differ, by R, K and noise; half: inverted currents are
                         bridges, double: bridges at half of their speed drive on */
#define STUCK_SUPPLY 0.2f /* of the supply: less a stuck bridge hardly moves; half: uncertain windings look like
                             bridges, double: bridges at 0.3 are not seen */
#define STEP_RAD_S 0.05f /* a change of the motor's speed in a tick, beyond noise and torque, that is none; half: noise
                            steps, double: small offsets do not */
#define ROUGH_TIMES 5.0f /* of the mean change from tick to tick: four sigma of its noise; half: noise steps, double:
                            faults do not */
#define DITHER_SUPPLY 0.04f /* of the supply: changes that are smaller are taken once a sample; half: more ticks cost
                               more, double: less shows */
#define DITHER_KEPT 0.875f /* per sample, of the sums over changes of voltage and current: 64 ms; half: noise names
                              parts, nearer 1: a fault shows later in them */
#define ROUGH_SHARE 0.0625f /* of a sample in that mean; half: a noisier load is followed later, double: the mean is
                               noisy itself */
#define ROUGH_RAD_S 0.08f /* rad/s, the mean at first; half: first motions step, double: early steps are missed */

void motor_start(motor_state *motor, float angle_rad, float speed_limit_rad_s, uint32_t phase)
{
    const float duty = motor->duty;
    const float before = motor->variance_rr; /* not 0: it may still be as warm as it was */
    const float resistance = before > 0.0f ? motor->resistance_scale : 1.0f;
    *motor = (motor_state){0};
    motor->duty = duty;
    motor->fastest_rad_s = speed_limit_rad_s > SEEN_RAD_S ? speed_limit_rad_s : SEEN_RAD_S;
    motor->last_rad = motor->part_rad = motor->window_rad = angle_rad;
    motor->resistance_scale = resistance;
    motor->constant_scale = 1.0f;
    motor->variance_rr = before > PRIOR_VARIANCE ? before : PRIOR_VARIANCE;
    motor->variance_kk = PRIOR_VARIANCE;
    motor->unsure_rad_s = UNKNOWN_RAD_S;
    motor->step_rad_s = UNKNOWN_RAD_S;
    motor->sample_ticks = SETTLE_TICKS + 1u;
    motor->part_ticks = SETTLE_TICKS;
    motor->rough_rad_s = ROUGH_RAD_S;
    motor->trust = CAREFUL;
    motor->phase = phase;
}

static void way_begin(motor_state *motor)
{
    motor->way_motor_rad = 0.0f;
    motor->way_unsure_rad = 0.0f;
    motor->way_read_rad = 0.0f;
    motor->way_mark_rad = 0.0f;
    motor->way_ticks = 0u;
}

/* Take a window's way of both into that since the joint last rested: once it is long and the same, the reading is
 * trusted. */
static void earn(motor_state *motor, const motor_config *config, float way_rad)
{
    const float emf_v = motor->window_v - motor->resistance_scale * motor->window_ir_v;
    motor->way_motor_rad += emf_v * TICK_S / config->constant_v_s;
    motor->way_unsure_rad += motor->unsure_per_a * number_size(motor->window_ir_v) * TICK_S / config->resistance_ohm;
    motor->way_read_rad += way_rad;
    motor->way_ticks += motor->window_ticks;
    if (number_size(motor->way_read_rad - motor->way_mark_rad) > WINDOW_WAY_RAD) { /* it goes on, be it slowly */
        motor->way_mark_rad = motor->way_read_rad;
        motor->way_ticks = 0u;
    } else if (motor->way_ticks >= REST_TICKS) {
        way_begin(motor);
    }
    const float size_rad = number_size(motor->way_read_rad);
    if (size_rad < AGREED * config->apart_rad || motor->way_unsure_rad > SAME_UNSURE * size_rad) {
        return; /* a slow joint under load moves no further than its resistance is uncertain */
    }
    const float same = motor->way_motor_rad / motor->way_read_rad;
    motor->trust = same > SAME_LOW && same < SAME_HIGH ? 1.0f : motor->trust;
    way_begin(motor);
}

/* Return how far the motor's way over a window may be from the reading's, and remember which way it went. Only a gear
 * that goes on to the side where its teeth lie already crosses no backlash: a motor that rests may be anywhere between
 * them. */
static float window_noise(motor_state *motor, const motor_config *config, float way_rad)
{
    const bool moved = number_size(way_rad) > WINDOW_WAY_RAD;
    const int32_t pulled = motor->window_ir_v > 0.0f ? 1 : 2; /* a torque that changes its sign moves the teeth, too */
    const int32_t side = moved ? (way_rad > 0.0f ? pulled : -pulled) : SIDE_UNKNOWN;
    const bool goes_on = side == motor->window_side && moved && motor->window_ticks <= REVERSAL_TICKS;
    motor->window_side = side;
    const float crossed = goes_on ? 0.0f : moved ? 1.0f : RESTING;
    const float twist_rad = 0.5f * MOTOR_TWIST * motor->twist_rad_per_a * motor->current_a;
    return WINDOW_NOISE_RAD + crossed * config->backlash_rad + twist_rad + motor->uneven * number_size(way_rad);
}

void motor_warms(motor_state *motor, const motor_config *config, uint32_t ticks)
{
    if (motor->variance_rr < WARM_VARIANCE) {
        const float sigma = number_root(motor->variance_rr) + WARMS * (float)ticks;
        motor->variance_rr = sigma * sigma;
        motor->unsure_per_a = SIGMAS * sigma * config->resistance_ohm / config->constant_v_s;
    }
}

/* Learn both scales from the last window: v = r (R i) + k (K w), by recursive least squares (Kalman's form). */
static void learn(motor_state *motor, const motor_config *config)
{
    const bool moved = motor->window_side != SIDE_UNKNOWN;
    motor_warms(motor, config, motor->mean_ticks); /* also where nothing is learnt */
    const float wander = WANDER_VARIANCE * (float)motor->mean_ticks;
    const float ir_v = motor->mean_ir_v;
    const float kw_v = motor->mean_kw_v;
    const float noise_v = motor->mean_noise_v;
    /* What a joint that rests hides in its backlash goes with the current: all such windows err alike, and one says
     * what many do. */
    if (!moved && motor->variance_rr * ir_v * ir_v < noise_v * noise_v) {
        return;
    }
    const float gain_r = motor->variance_rr * ir_v + motor->variance_rk * kw_v;
    const float gain_k = motor->variance_rk * ir_v + motor->variance_kk * kw_v;
    const float variance = ir_v * gain_r + kw_v * gain_k + noise_v * noise_v;
    const float seen_v = motor->mean_v - motor->resistance_scale * ir_v - motor->constant_scale * kw_v;
    const float sigma_v = number_root(variance);
    if (motor->trust != 1.0f && number_size(seen_v) > SURPRISE * sigma_v) {
        return;
    }
    const float off_v = motor->trust != 1.0f ? seen_v : number_bound(seen_v, TEACHES * sigma_v);
    const float per_variance = 1.0f / variance;
    motor->resistance_scale =
        number_clamp(motor->resistance_scale + gain_r * off_v * per_variance, SCALE_LOW, SCALE_HIGH);
    if (moved) { /* else the constant is only taken into account */
        motor->constant_scale = /* (Schmidt's form) */
            number_clamp(motor->constant_scale + gain_k * off_v * per_variance, CONSTANT_LOW, CONSTANT_HIGH);
        motor->variance_kk += wander - gain_k * gain_k * per_variance;
    }
    motor->variance_rr -= gain_r * gain_r * per_variance;
    motor->variance_rk -= gain_r * gain_k * per_variance;
}

/* Take the means of a window. */
static void mean(motor_state *motor, const motor_config *config, float way_rad, float noise_rad)
{
    const float per_tick = 1.0f / (float)motor->window_ticks;
    const float emf_v = config->constant_v_s * (float)TICKS_PER_S * per_tick;
    motor->mean_v = motor->window_v * per_tick;
    motor->mean_ir_v = motor->window_ir_v * per_tick;
    motor->mean_kw_v = emf_v * way_rad;
    motor->mean_noise_v = emf_v * noise_rad;
    motor->mean_ticks = motor->window_ticks;
}

/* Return the faults of a motor whose constant is less than it was. One that was learnt down to its bound is none: motor
 * and reading may never have agreed. */
static uint32_t weak_parts(const motor_state *motor, bool agreed)
{
    const bool sure = agreed && motor->constant_scale > CONSTANT_LOW;
    return FAULT_BIT(FAULT_MOTOR) | (sure ? 0u : FAULT_BIT(FAULT_POT_SCALE));
}

/* Return where the oldest of what is known of late stands. */
static uint32_t oldest_of(const motor_state *motor)
{
    return motor->known > MOTOR_KNOWN ? motor->known % MOTOR_KNOWN : 0u;
}

/* Look whether the constant is less than it was: not behind a spring, on which a joint swings while dry friction holds
 * its motor. */
static void weakened(motor_state *motor)
{
    const float rr = motor->lately_rr + 1.0f / WARM_VARIANCE;
    const float rv = motor->lately_rv + motor->resistance_scale / WARM_VARIANCE;
    const float ttr = motor->lately_ttr + 1.0f / (LATELY_WARMS * LATELY_WARMS);
    const float per_square = 1.0f / (rr * ttr - motor->lately_tr * motor->lately_tr);
    const float by_r = (ttr * motor->lately_rk - motor->lately_tr * motor->lately_tk) * per_square;
    const float by_tr = (rr * motor->lately_tk - motor->lately_tr * motor->lately_rk) * per_square;
    const float kk = motor->lately_kk - by_r * motor->lately_rk - by_tr * motor->lately_tk;
    const float kv = motor->lately_kv - by_r * rv - by_tr * motor->lately_tv;
    const uint32_t oldest = oldest_of(motor);
    const float by_rv = (ttr * rv - motor->lately_tr * motor->lately_tv) * per_square;
    const float by_tv = (rr * motor->lately_tv - motor->lately_tr * rv) * per_square;
    const float vv = motor->lately_vv + motor->resistance_scale * motor->resistance_scale / WARM_VARIANCE;
    const float left = vv - by_rv * rv - by_tv * motor->lately_tv - kv * kv / kk;
    if (left > LATELY_LEFT * motor->lately_n) {
        return; /* it is none: a reading that lags looks slower, too, but follows no constant */
    }
    const float constant = kv / kk + 2.0f * motor->uneven;
    const float sigma = number_root(1.0f / kk + motor->known_kk[oldest]);
    if (motor->known_k[oldest] - WEAKENED - constant > SIGMAS * sigma ||
        CONSTANT_LOW - 0.5f * WEAKENED - constant > SIGMAS * number_root(1.0f / kk)) {
        motor->weakened = weak_parts(motor, motor->known > MOTOR_KNOWN);
    }
}

/* Take the last window, if in motion, into what the constant is of late, by least squares beside a resistance that
 * changes steadily: v = (r + s t) R i + k K w. A motion either way shows it, however slow; an offset, a winding that
 * warms and a reading that drifts err one way in one direction, the other in the other. */
static void lately(motor_state *motor)
{
    const float seconds = (float)motor->mean_ticks * TICK_S;
    const float keeps = 1.0f - seconds / LATELY_S;
    const bool moved = motor->window_side != SIDE_UNKNOWN && motor->heard_rad_s > 0.0f;
    const float weight = moved ? 1.0f / (motor->mean_noise_v * motor->mean_noise_v) : 0.0f;
    const float weight_r = weight * motor->mean_ir_v;
    const float weight_k = weight * motor->mean_kw_v;
    motor->mean_ticks = 0u;
    motor->lately_ttr = keeps * (motor->lately_ttr - seconds * (2.0f * motor->lately_tr - seconds * motor->lately_rr));
    motor->lately_tr = keeps * (motor->lately_tr - seconds * motor->lately_rr); /* the newest is at 0 s */
    motor->lately_tk = keeps * (motor->lately_tk - seconds * motor->lately_rk);
    motor->lately_tv = keeps * (motor->lately_tv - seconds * motor->lately_rv);
    motor->lately_rr = keeps * motor->lately_rr + weight_r * motor->mean_ir_v;
    motor->lately_rk = keeps * motor->lately_rk + weight_r * motor->mean_kw_v;
    motor->lately_kk = keeps * motor->lately_kk + weight_k * motor->mean_kw_v;
    motor->lately_rv = keeps * motor->lately_rv + weight_r * motor->mean_v;
    motor->lately_kv = keeps * motor->lately_kv + weight_k * motor->mean_v;
    motor->lately_vv = keeps * motor->lately_vv + weight * motor->mean_v * motor->mean_v;
    motor->lately_n = keeps * motor->lately_n + (moved ? 1.0f : 0.0f);
    if (motor->driven_ticks >= (motor->known + 1u) * KNOWN_TICKS) {
        motor->known_k[motor->known % MOTOR_KNOWN] = motor->constant_scale;
        motor->known_kk[motor->known % MOTOR_KNOWN] = motor->variance_kk;
        motor->known_r[motor->known % MOTOR_KNOWN] = motor->resistance_scale;
        motor->known_rr[motor->known % MOTOR_KNOWN] = motor->variance_rr;
        motor->known++;
    }
    motor->weakened = 0u;
    if (moved && motor->trust == 1.0f && motor->known != 0u && motor->twist_rad_per_a == 0.0f) {
        weakened(motor);
    }
}

/* Take the last window: learn from it in the sample after it, compare with what was learnt in the next. */
static void take(motor_state *motor, const motor_config *config)
{
    if (motor->window_ticks > SAMPLE_TICKS) {
        lately(motor);
    } else if (motor->mean_teaches != 0u) {
        learn(motor, config);
    }
}

static void window_begin(motor_state *motor, float angle_rad)
{
    motor->window_v = 0.0f;
    motor->window_ir_v = 0.0f;
    motor->window_rad = angle_rad;
    motor->window_ticks = 0u;
}

/* Take a sample's sums into the window; a window that is long enough teaches. */
static void window(motor_state *motor, const motor_config *config, float angle_rad)
{
    motor->window_v += motor->part_v;
    motor->window_ir_v += motor->part_a * config->resistance_ohm;
    motor->window_ticks += motor->driven_ticks - motor->part_ticks;
    if (motor->window_ticks < WINDOW_TICKS) {
        if (motor->mean_ticks != 0u) { /* the last one, shared among samples: no tick is long */
            take(motor, config);
        }
        return;
    }
    const float way_rad = angle_rad - motor->window_rad;
    if (motor->window_ticks < REST_TICKS && number_size(way_rad) <= WINDOW_WAY_RAD) {
        return;
    }
    const float noise_rad = window_noise(motor, config, way_rad);
    mean(motor, config, way_rad, noise_rad);
    if (motor->trust != 1.0f) {
        earn(motor, config, way_rad);
    }
    /* A gap that R and K may explain must be learnt from: else they would stay wrong for good. */
    const float explained_rad = 0.5f * config->apart_rad + motor_explains(motor);
    motor->mean_teaches = motor->heard_rad_s > 0.0f && number_size(motor->gap_rad) < explained_rad ? 1u : 0u;
    window_begin(motor, angle_rad);
}

static void part_begin(motor_state *motor, float angle_rad)
{
    motor->part_v = 0.0f;
    motor->part_a = 0.0f;
    motor->part_rad = angle_rad;
    motor->part_ticks = motor->driven_ticks;
}

void motor_limit(motor_state *motor)
{
    motor->limited_ticks = motor->driven_ticks + 1u;
    motor->heard_rad_s = 0.0f;
    motor->step_rad_s = UNKNOWN_RAD_S;
}

/* Take a sample in which a driver may have limited the current: it put out anything between nothing and the duty's
 * voltage. What reading and current ask for within that is taken for it, and nothing is learnt. */
static void sample_limited(motor_state *motor, const motor_config *config, float angle_rad)
{
    const float way_rad = angle_rad - motor->part_rad;
    const float ir_v = motor->resistance_scale * config->resistance_ohm * motor->part_a;
    const float asked_v = ir_v + motor->constant_scale * config->constant_v_s * way_rad * (float)TICKS_PER_S;
    const float low_v = motor->part_v < 0.0f ? motor->part_v : 0.0f;
    const float high_v = motor->part_v > 0.0f ? motor->part_v : 0.0f;
    motor->withheld_rad += motor->part_v * motor->per_constant * TICK_S;
    motor->part_v = number_clamp(asked_v, low_v, high_v);
    motor->dither_vv = motor->dither_va = motor->dither_aa = motor->dithers = 0.0f; /* what changed is not known */
    motor->window_side = SIDE_UNKNOWN; /* backlash may be crossed meanwhile */
    motor->mean_ticks = 0u;
}

void motor_sleep(zero_state *zero, float current_a)
{
    if (zero->ticks == 0u) {
        zero->before_a = zero->now_a;
    }
    zero->ticks = zero->ticks < ZERO_TICKS ? zero->ticks + 1u : ZERO_TICKS;
    zero->now_a += current_a / (float)zero->ticks;
}

bool motor_flows_asleep(const zero_state *zero, const motor_config *config, float supply_v)
{
    const float shown_v = number_size(zero->now_a - zero->before_a) * config->resistance_ohm;
    return zero->ticks == ZERO_TICKS / 2u && shown_v > STUCK_SUPPLY * supply_v;
}

#define ANSWER_NONE 0.25f /* a current that answers less does not follow its voltage; half: bridges look like sensors,
                             double: gains of 0.4 like bridges */
#define ANSWER_VV 0.1f /* V^2; smaller squares in them show little yet; half, double: nothing notable */
#define ANSWER_OFF 0.2f /* by so much an answer differs at least; half: light joints are suspected, double: shorted
                           windings are not seen */
#define ANSWER_LOW 0.35f /* of that of the configured resistance: no temperature makes it less; half: gains show only
                            in motion, double: warm light joints alarm */
#define ANSWER_HIGH 1.7f /* or more; half: sound joints alarm, double: shorted windings show only under load */

/* Return how the current answers to the voltage from tick to tick, over the answer of the learnt resistance: no load,
 * no speed and no reading is in it. */
static float answer_of(const motor_state *motor, const motor_config *config)
{
    return motor->resistance_scale * config->resistance_ohm * motor->dither_va / motor->dither_vv;
}

bool motor_answers_otherwise(const motor_state *motor, const motor_config *config)
{
    if (motor->damping_share > 0.0f || motor->dithers < 2.0f) { /* its noise is in the voltage; two changes show none */
        return false;
    }
    const float ohm = motor->resistance_scale * config->resistance_ohm;
    const float vv = motor->dither_vv;
    const float va = motor->dither_va;
    const float per_vv = 1.0f / (vv + ANSWER_VV); /* hardly driven it shows nothing */
    const float left = number_size(motor->dither_aa * vv - va * va);
    const float variance = ohm * ohm * left * per_vv * per_vv / (motor->dithers - 1.0f) + motor->variance_rr;
    const float off = number_size(ohm * va - vv) * per_vv;
    return off > ANSWER_OFF + SIGMAS * number_root(variance) && /* a wrong reading may have taught a wrong resistance */
           number_size(config->resistance_ohm * va - vv) * per_vv > ANSWER_OFF;
}

/* Return whether it does so as no temperature explains. */
static bool answers_as_none(const motor_state *motor, const motor_config *config)
{
    const float seen_v = config->resistance_ohm * motor->dither_va;
    return (seen_v < ANSWER_LOW * motor->dither_vv || seen_v > ANSWER_HIGH * motor->dither_vv) &&
           motor_answers_otherwise(motor, config);
}

/* What changes slowly: how uncertain the speed is, and the samples. */
static void sample(motor_state *motor, const motor_config *config, float ir_v, float emf_v, float angle_rad)
{
    const float variance = motor->variance_rr * ir_v * ir_v + 2.0f * motor->variance_rk * ir_v * emf_v +
                           motor->variance_kk * emf_v * emf_v;
    const float unsure_v = SIGMAS * number_root(variance > 0.0f ? variance : 0.0f) + motor->uneven * number_size(emf_v);
    motor->unsure_rad_s = unsure_v / config->constant_v_s;
    motor->band_rad = SAMPLE_KEEPS * motor->band_rad + motor->unsure_rad_s * (float)SAMPLE_TICKS * TICK_S;
    if (motor->trust == 1.0f) {
        motor->doubt_rad_s = motor->unsure_rad_s;
    } else { /* nobody contradicts a constant that is too large: the joint is as fast as it may be */
        const float by_resistance_v = SIGMAS * number_root(motor->variance_rr) * number_size(ir_v);
        motor->doubt_rad_s = (by_resistance_v - CONSTANT_OFF * number_size(emf_v)) / config->constant_v_s;
    }
    const bool limited = motor_is_limited(motor);
    if (limited) {
        sample_limited(motor, config, angle_rad);
    }
    const uint32_t at = motor->sampled % MOTOR_SAMPLES;
    motor->sample_read_rad[at] = angle_rad;
    motor->sample_v[at] = motor->part_v;
    motor->sample_a[at] = motor->part_a;
    motor->sampled++;
    motor->step_rad_s = STEP_RAD_S + ROUGH_TIMES * motor->rough_rad_s;
    const float ohm = (motor->doubted | motor->alone) != 0u || motor_stepped(motor) ? 0.0f : config->resistance_ohm;
    motor->heard_rad_s = motor->current_a * ohm / (DEAD_SHARE * config->constant_v_s);
    const uint32_t slot = motor->driven_ticks + motor->phase;
    motor->sample_ticks = motor->driven_ticks + SAMPLE_TICKS - slot % SAMPLE_TICKS;
    if (limited) {
        window_begin(motor, angle_rad);
    } else {
        window(motor, config, angle_rad);
    }
    motor->ohm = motor->resistance_scale * config->resistance_ohm;
    motor->per_constant = 1.0f / (motor->constant_scale * config->constant_v_s);
    const float seen_a = number_size(motor->part_a) / (float)(motor->driven_ticks - motor->part_ticks);
    const float kept_a = SAMPLE_KEEPS * motor->current_a;
    motor->current_a = seen_a > kept_a ? seen_a : kept_a;
    if (motor->last_v != 0.0f) { /* else nothing answers any more, and the last answer stays */
        motor->dither_vv *= DITHER_KEPT;
        motor->dither_va *= DITHER_KEPT;
        motor->dither_aa *= DITHER_KEPT;
        motor->dithers *= DITHER_KEPT;
    }
    motor->none_samples = answers_as_none(motor, config) ? motor->none_samples + 1u : 0u;
    motor->withheld_rad *= SAMPLE_KEEPS;
    motor->gap_rad *= SAMPLE_KEEPS;
    part_begin(motor, angle_rad);
}

#define LOAD_SAMPLES 8u /* in a mean of the load; half: noisier, double: the joint moves meanwhile */
#define BEFORE_SAMPLES 23u /* so far back a fault had not begun that shows now; half: it had, double: is not
                              remembered */
#define WORN_CONSTANT 0.83f /* of the learnt constant: what a partly shorted winding has, 0.7 to 0.95; half: sensors
                               are named, double: motors */
#define WORN_SIGMA 0.04f /* of a constant that is seen; half: a motion says more than it knows, double: more are both
                            named */
#define WAY_SHOWS 7e-4f /* rad^2, squares of a way over 24 samples: seven times those of noise; half: noise shows a
                           constant, double: fewer motions do */
#define LOAD_TIMES 1.5f /* of dry friction: how well it is known what the same load takes; half: friction names parts,
                           double: more are both named */
#define LOAD_SHARE 0.1f /* and of that itself; likewise */
#define WEIGHS 4.0f /* no witness says more (logarithm of the odds); half: none convicts against the other, double: one
                       outweighs the other */
#define DECIDES 1.5f /* with less two parts cannot be distinguished; half: more are named wrongly, double: more are both
                        named */

/* Write the means over some samples, which ended back samples ago: what the load takes of the applied voltage, V (less
 * the back-EMF by the reading), and the current, A. */
static void load_of(const motor_state *motor, const motor_config *config, uint32_t back, float *volts, float *amperes)
{
    *volts = *amperes = 0.0f;
    const uint32_t last = motor->sampled - 1u - back;
    for (uint32_t i = 0u; i < LOAD_SAMPLES; i++) {
        *volts += motor->sample_v[(last - i) % MOTOR_SAMPLES];
        *amperes += motor->sample_a[(last - i) % MOTOR_SAMPLES];
    }
    const float way_rad = motor->sample_read_rad[last % MOTOR_SAMPLES] -
                          motor->sample_read_rad[(last - LOAD_SAMPLES) % MOTOR_SAMPLES];
    const float ticks = (float)(LOAD_SAMPLES * SAMPLE_TICKS);
    *volts = (*volts - config->constant_v_s * way_rad * (float)TICKS_PER_S) / ticks;
    *amperes /= ticks;
}

/* Remember what the load took before a fault. */
static void remember_load(motor_state *motor, const motor_config *config)
{
    motor->way_seen = 0.0f;
    motor->before = motor->sampled > LOAD_SAMPLES + BEFORE_SAMPLES ? 1u : 0u;
    if (motor->before != 0u) {
        load_of(motor, config, BEFORE_SAMPLES, &motor->before_v, &motor->before_a);
    }
}

void motor_doubt(motor_state *motor, const motor_config *config)
{
    motor->doubted = 1u;
    if (!motor_stepped(motor)) {
        motor->step_ticks = motor->driven_ticks;
        remember_load(motor, config);
    }
}

float motor_way(const motor_state *motor, bool yielding)
{
    return TICK_S * (motor->speed_rad_s + (yielding ? motor->unsure_per_a * motor->last_a : 0.0f));
}

void motor_recall(motor_state *motor)
{
    motor->alone = 1u;
    if (motor->known == 0u) {
        return;
    }
    const uint32_t oldest = oldest_of(motor);
    motor->resistance_scale = motor->known_r[oldest];
    motor->constant_scale = motor->known_k[oldest];
    motor->variance_rr = motor->known_rr[oldest];
    motor->variance_rk = 0.0f;
    motor->variance_kk = motor->known_kk[oldest];
}

/* Take a change of the motor's speed in a tick that is beyond noise: by its torque, its uncertain numbers, or a
 * step. */
static void changed(motor_state *motor, const motor_config *config, float change_rad_s, float current_a)
{
    const float last_a = number_size(motor->last_a);
    const float largest_a = last_a > motor->current_a ? last_a : motor->current_a;
    const float torque_rad_s = motor->swift_per_a * largest_a;
    const float unsure_rad_s = motor->unsure_per_a * number_size(current_a - motor->last_a);
    if (change_rad_s <= motor->step_rad_s + torque_rad_s + unsure_rad_s || motor_stepped(motor)) {
        return; /* what steps on began with the first */
    }
    motor->step_ticks = motor->driven_ticks;
    motor->heard_rad_s = 0.0f;
    remember_load(motor, config);
}

/* Take how voltage and current changed from one tick to the next. */
static void dither(motor_state *motor, float change_v, float change_a)
{
    motor->dither_vv += change_v * change_v;
    motor->dither_va += change_v * change_a;
    motor->dither_aa += change_a * change_a;
    motor->dithers += 1.0f;
}

void motor_measure(motor_state *motor, const motor_config *config, float supply_v, float current_a, float angle_rad)
{
    const float moved_rad = angle_rad - motor->last_rad;
    motor->last_rad = angle_rad;
    motor->driven_ticks++;
    if (motor->driven_ticks <= SETTLE_TICKS) {
        motor->window_rad = motor->part_rad = angle_rad;
        motor->ohm = motor->resistance_scale * config->resistance_ohm;
        return;
    }
    const float voltage_v = motor->duty * supply_v;
    const float emf_v = voltage_v - motor->ohm * current_a;
    const bool sampled = motor->driven_ticks == motor->sample_ticks;
    const float speed_rad_s = emf_v * motor->per_constant;
    const float change_rad_s = number_size(speed_rad_s - motor->speed_rad_s);
    if (change_rad_s > motor->step_rad_s) {
        changed(motor, config, change_rad_s, current_a);
    }
    const float change_v = voltage_v - motor->last_v;
    if (change_v != 0.0f && (sampled || number_size(change_v) > DITHER_SUPPLY * supply_v)) {
        dither(motor, change_v, current_a - motor->last_a);
    }
    motor->last_v = voltage_v;
    motor->last_a = current_a;
    motor->speed_rad_s = speed_rad_s;
    motor->part_v += voltage_v;
    motor->part_a += current_a;
    if (sampled) {
        sample(motor, config, current_a * config->resistance_ohm, emf_v, angle_rad);
        motor->rough_rad_s += ROUGH_SHARE * (change_rad_s - motor->rough_rad_s);
    }
    motor->gap_rad += moved_rad - speed_rad_s * TICK_S;
    const float size_rad_s = number_size(speed_rad_s);
    motor->sure_rad_s = size_rad_s < motor->heard_rad_s ? size_rad_s - motor->doubt_rad_s : -UNKNOWN_RAD_S;
}

float motor_sure(const motor_state *motor)
{
    const float faster = motor->trust == 1.0f ? 1.0f : 1.0f + CONSTANT_OFF;
    const float by_current_rad_s =
        faster * number_size(motor->speed_rad_s) - motor->unsure_per_a * number_size(motor->last_a);
    return by_current_rad_s < motor->sure_rad_s ? by_current_rad_s : motor->sure_rad_s;
}

void motor_damp(motor_state *motor, float reading_rad_s)
{
    const bool known = motor_is_known(motor) && motor->unsure_rad_s < UNKNOWN_RAD_S;
    const float share = known ? motor->damping_share : 0.0f;
    motor->damped_rad_s += SMOOTH * (motor->speed_rad_s - motor->damped_rad_s);
    motor->beyond_rad_s = share * (motor->damped_rad_s - reading_rad_s);
}

static uint32_t fewer(uint32_t a, uint32_t b) { return a < b ? a : b; }

uint32_t motor_disagrees(const motor_state *motor, const motor_config *config, float supply_v)
{
    const float across_v = number_size(motor->duty) * supply_v;
    if (motor->current_a * config->resistance_ohm < DEAD_SHARE * across_v ||
        (motor->trust == 1.0f && motor_stepped(motor)) || motor_answers_otherwise(motor, config)) {
        return FAULT_CURRENT_SENSOR;
    }
    /* What it looks like so far, by the last 32 ms. */
    const uint32_t back = fewer(motor->sampled, 4u);
    const float read_rad = motor->last_rad - motor->sample_read_rad[(motor->sampled - back) % MOTOR_SAMPLES];
    float motor_v = motor->part_v - motor->resistance_scale * config->resistance_ohm * motor->part_a;
    for (uint32_t i = 1u; i < back; i++) {
        const uint32_t at = (motor->sampled - i) % MOTOR_SAMPLES;
        motor_v += motor->sample_v[at] - motor->resistance_scale * config->resistance_ohm * motor->sample_a[at];
    }
    const float motor_rad = motor_v * motor->per_constant * TICK_S;
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

#define NAME_SAMPLES 24u /* of the last 192 ms: most of them after the joint was let go of; half: noise names parts,
                            double: what was before the fault does */
#define SLOW_RAD_S 0.1f /* rad/s; a reading that drifts more slowly holds its joint; half: weak motors are drifts,
                           double: slow drifts are weak motors */
#define NAME_NOISE_RAD 0.002f /* of a reading; half: noise names faults, double: small ones keep their first name */
#define JUMP_SHARE 0.7f /* of the way between both, in one sample; half: slips look like jumps, double: no jump is
                           named */
#define LAG_SHARE 0.5f /* of what the others leave: a lag has one number more to fit with; half: lags are named
                          otherwise, double: slips are named lags */
#define SAME_SHARE 0.7f /* of what the other leaves; half: more are both named, double: the smaller is always named */
#define STUCK_SHARE 0.5f /* of what a sound bridge leaves; half: bridges show later, double: offsets look like
                            bridges */

/* What a joint did over some samples, in radians since the first of them: reading, way by the voltage alone, way that
 * the winding's voltage takes of it, the sample's number, and the sum of the way between motor and reading. */
enum { READ, VOLTAGE, CURRENT, TIME, BETWEEN };
#define COLUMNS MOTOR_COLUMNS

typedef float combination[COLUMNS]; /* of the columns */

static const combination reading = {1.0f, 0.0f, 0.0f, 0.0f, 0.0f};
static const combination voltage = {0.0f, 1.0f, 0.0f, 0.0f, 0.0f};
static const combination motors = {0.0f, 1.0f, -1.0f, 0.0f, 0.0f};
static const combination gap = {1.0f, -1.0f, 1.0f, 0.0f, 0.0f};
static const combination winding = {0.0f, 0.0f, 1.0f, 0.0f, 0.0f};
static const combination at_terminals = {1.0f, 0.0f, 1.0f, 0.0f, 0.0f}; /* voltage, by reading and current */
static const combination passing = {0.0f, 0.0f, 0.0f, 1.0f, 0.0f};
static const combination between = {0.0f, 0.0f, 0.0f, 0.0f, 1.0f};

static float product(const motor_sums *s, const combination a, const combination b)
{
    float sum = 0.0f;
    for (uint32_t i = 0u; i < COLUMNS; i++) {
        for (uint32_t j = 0u; j < COLUMNS; j++) {
            sum += a[i] * s->of[i * COLUMNS + j] * b[j];
        }
    }
    return sum;
}

static void sums_of(const motor_state *motor, const motor_config *config, uint32_t count, motor_sums *s)
{
    const uint32_t first = motor->sampled - count;
    const float per_v = TICK_S / (motor->constant_scale * config->constant_v_s);
    const float per_a = per_v * motor->resistance_scale * config->resistance_ohm;
    for (uint32_t i = 0u; i < COLUMNS; i++) {
        s->at[i] = s->sum[i] = 0.0f;
        for (uint32_t j = 0u; j < COLUMNS; j++) {
            s->of[i * COLUMNS + j] = 0.0f;
        }
    }
    float *at = s->at, *sum = s->sum;
    for (uint32_t k = 0u; k < count; k++) {
        const uint32_t n = (first + k) % MOTOR_SAMPLES;
        at[READ] = motor->sample_read_rad[n] - motor->sample_read_rad[first % MOTOR_SAMPLES];
        at[VOLTAGE] += k != 0u ? motor->sample_v[n] * per_v : 0.0f;
        at[CURRENT] += k != 0u ? motor->sample_a[n] * per_a : 0.0f;
        at[TIME] = (float)k;
        at[BETWEEN] += at[VOLTAGE] - at[CURRENT] - at[READ];
        for (uint32_t i = 0u; i < COLUMNS; i++) {
            sum[i] += at[i];
            for (uint32_t j = 0u; j < COLUMNS; j++) {
                s->of[i * COLUMNS + j] += at[i] * at[j];
            }
        }
    }
    for (uint32_t i = 0u; i < COLUMNS; i++) {
        for (uint32_t j = 0u; j < COLUMNS; j++) {
            s->of[i * COLUMNS + j] -= sum[i] * sum[j] / (float)count;
        }
    }
}

/* Return what squares are left of y once it is fitted by a; *slope is its factor. */
static float left_by(const motor_sums *s, const combination y, const combination a, float *slope)
{
    const float aa = product(s, a, a);
    const float ay = product(s, a, y);
    *slope = aa > 0.0f ? ay / aa : 0.0f;
    return product(s, y, y) - *slope * ay;
}

/* Take a column out of the sums: what is left of the others once they are fitted by it. */
static void take_out(motor_sums *s, uint32_t column)
{
    const float square = s->of[column * COLUMNS + column];
    for (uint32_t i = 0u; i < COLUMNS; i++) {
        s->at[i] = square > 0.0f ? s->of[i * COLUMNS + column] / square : 0.0f;
    }
    for (uint32_t i = 0u; i < COLUMNS; i++) {
        for (uint32_t j = 0u; j < COLUMNS; j++) {
            s->of[i * COLUMNS + j] -= s->at[i] * s->at[j] * square;
        }
    }
}

/* Return what is left of the reading if it follows late: by least squares a k + x T/lag, of which x alone is what lag
 * adds. */
static float left_by_lag(const motor_sums *s, float *rate)
{
    float slope, between_slope;
    const float kk = product(s, passing, passing);
    const float yy = left_by(s, reading, passing, &slope);
    const float xx = left_by(s, between, passing, &between_slope);
    const float yx = product(s, reading, between) - slope * between_slope * kk;
    *rate = xx > 0.0f ? yx / xx : 0.0f;
    return yy - *rate * yx;
}

/* Return whether most of what lies between reading and motor opened from one sample to the next. */
static bool jumped(const motor_state *motor, const motor_config *config, uint32_t count)
{
    float low = 0.0f, high = 0.0f, largest = 0.0f, z = 0.0f;
    for (uint32_t i = count - 1u; i > 0u; i--) {
        const uint32_t at = (motor->sampled - i) % MOTOR_SAMPLES;
        const float ir_v = motor->resistance_scale * config->resistance_ohm * motor->sample_a[at];
        const float before_rad = motor->sample_read_rad[(at + MOTOR_SAMPLES - 1u) % MOTOR_SAMPLES];
        const float way_rad = (motor->sample_v[at] - ir_v) * motor->per_constant * TICK_S;
        const float step = motor->sample_read_rad[at] - before_rad - way_rad;
        z += step;
        low = z < low ? z : low;
        high = z > high ? z : high;
        largest = number_size(step) > largest ? number_size(step) : largest;
    }
    return largest > 10.0f * NAME_NOISE_RAD && largest > JUMP_SHARE * (high - low);
}

/* Return whether a motor is weak whose reading went further, the reading drifts, or both where they cannot be
 * distinguished. A drift, or a wrong resistance under a load, adds a steady speed: what is left without one follows the
 * motor's changes of speed, one to one or further. A motor that rests shows a drift alone. */
static uint32_t further(const motor_state *motor, motor_sums *s, uint32_t count, float drift, bool rests, float by_lag)
{
    const float per_sample = (float)SAMPLE_TICKS * TICK_S;
    const float slow_rad = SLOW_RAD_S * per_sample; /* a sample */
    const uint32_t weak = weak_parts(motor, motor->trust == 1.0f);
    const float unsure_rad = motor->unsure_per_a * motor->current_a * per_sample;
    bool shared = true;
    if (!rests) {
        float share;
        take_out(s, TIME);
        const float way = product(s, motors, motors);
        const float left = left_by(s, reading, motors, &share) + (float)count * NAME_NOISE_RAD * NAME_NOISE_RAD;
        const float sigma = number_root(left / ((float)count * way));
        if (by_lag < LAG_SHARE * left) {
            return FAULT_BIT(FAULT_POT_LAG);
        }
        if (share - 1.0f - WEAKENED > SIGMAS * sigma) {
            return weak;
        }
        shared = share + sigma > 1.0f + 2.0f * WEAKENED;
    }
    if (number_size(drift) < slow_rad) {
        return weak;
    }
    const bool either = shared && number_size(drift) < slow_rad + unsure_rad;
    return FAULT_BIT(FAULT_POT_DRIFT) | (either ? FAULT_BIT(FAULT_MOTOR) : 0u);
}

uint32_t motor_names(const motor_state *motor, const motor_config *config, uint32_t suspect, motor_sums *s)
{
    const uint32_t count = fewer(motor->sampled, NAME_SAMPLES);
    if (count < NAME_SAMPLES / 2u) {
        return FAULT_BIT(suspect);
    }
    if (jumped(motor, config, count)) {
        return FAULT_BIT(FAULT_POT_JUMP);
    }
    sums_of(motor, config, count, s);
    const float noise = (float)count * NAME_NOISE_RAD * NAME_NOISE_RAD;
    const bool agreed = motor->trust == 1.0f;
    float share, drift, rate;
    const float by_share = left_by(s, reading, motors, &share) + noise;
    const float by_drift = left_by(s, gap, passing, &drift) + noise;
    const float least = by_share < by_drift ? by_share : by_drift;
    const bool rests = product(s, motors, motors) < 4.0f * noise;
    const float by_lag = left_by_lag(s, &rate) + noise;
    if (suspect == FAULT_POT_DRIFT && (rests || share > 1.0f)) {
        return further(motor, s, count, drift, rests, rate > 0.0f ? by_lag : FLT_MAX);
    }
    if (rests) {
        return FAULT_BIT(product(s, reading, reading) > 4.0f * noise ? FAULT_POT_DRIFT : suspect);
    }
    if (by_lag < LAG_SHARE * least && rate > 0.0f) { /* a slip ends late, too */
        return FAULT_BIT(FAULT_POT_LAG) | (agreed && share > 0.0f && share < 1.0f ? FAULT_BIT(FAULT_POT_SLIP) : 0u);
    }
    if (by_share < by_drift && share < -0.3f) {
        return FAULT_BIT(FAULT_POT_INVERTED);
    }
    const bool drifts = number_size(drift) * (float)count > 4.0f * NAME_NOISE_RAD;
    const uint32_t drifting = FAULT_BIT(drifts ? FAULT_POT_DRIFT : suspect);
    const uint32_t sharing = share < 0.15f  ? FAULT_BIT(FAULT_POT_FROZEN)
                             : !agreed      ? FAULT_BIT(FAULT_POT_SCALE)
                             : share < 1.0f ? FAULT_BIT(FAULT_POT_SLIP)
                                            : weak_parts(motor, true);
    return (by_drift < SAME_SHARE * by_share ? 0u : sharing) |
           (by_share < (agreed ? SAME_SHARE : 1.0f / SAME_SHARE) * by_drift ? 0u : drifting);
}

#define BIT_SENSOR FAULT_BIT(FAULT_CURRENT_SENSOR)
#define BIT_MOTOR FAULT_BIT(FAULT_MOTOR)
#define BIT_BRIDGE FAULT_BIT(FAULT_BRIDGE)

uint32_t motor_blames(const motor_state *motor, const motor_config *config, float dry_v)
{
    if (motor->sampled <= LOAD_SAMPLES) {
        return BIT_SENSOR;
    }
    const float answer = answer_of(motor, config);
    const float ohm = motor->resistance_scale * config->resistance_ohm;
    float volts, amperes;
    load_of(motor, config, 0u, &volts, &amperes);
    const float opens_v = 2.0f * config->constant_v_s * config->apart_rad / FADE_S; /* what opens the gap */
    if (!motor_answers_otherwise(motor, config)) { /* at rest an offset stays, and a weak motor takes what its load
                                                      does */
        const float unsure_v = SIGMAS * number_root(motor->variance_rr) * number_size(ohm * amperes);
        return number_size(volts - ohm * amperes) > opens_v + unsure_v ? BIT_SENSOR : BIT_MOTOR;
    }
    if (answer < 1.0f) { /* or a bridge that drives what its load takes, where a current flows that does not follow */
        const bool flows = number_size(answer) < ANSWER_NONE && number_size(ohm * amperes) > opens_v;
        return flows ? BIT_SENSOR | BIT_BRIDGE : BIT_SENSOR;
    }
    float odds = 0.0f; /* their logarithm, for a worn winding: what the load takes, and the constant, if the joint
                          moved */
    if (motor->before != 0u) {
        const float load_v = motor->before_v;
        const float worn_v = (1.0f / (WORN_CONSTANT * answer) - 1.0f) * load_v;
        const float dry_vv = LOAD_TIMES * LOAD_TIMES * dry_v * dry_v;
        const float variance = dry_vv + LOAD_SHARE * LOAD_SHARE * load_v * load_v + 0.25f * opens_v * opens_v;
        odds = number_bound((volts - load_v - 0.5f * worn_v) * worn_v / variance, WEIGHS);
    }
    if (motor->way_seen > WAY_SHOWS) {
        const float variance =
            motor->constant_sigma * motor->constant_sigma + motor->variance_kk + WORN_SIGMA * WORN_SIGMA;
        const float less = 1.0f - WORN_CONSTANT;
        odds += number_bound((1.0f - 0.5f * less - motor->constant_seen) * less / variance, WEIGHS);
    }
    return (odds < DECIDES ? BIT_SENSOR : 0u) | (odds > -DECIDES ? BIT_MOTOR : 0u);
}

void motor_weakens(motor_state *motor, const motor_config *config, motor_sums *s)
{
    const uint32_t since = (motor->driven_ticks - motor->step_ticks) / SAMPLE_TICKS;
    const uint32_t count = fewer(fewer(motor->sampled, NAME_SAMPLES), since);
    if (motor->step_ticks == 0u || count < NAME_SAMPLES / 2u) {
        return;
    }
    sums_of(motor, config, count, s);
    take_out(s, TIME); /* whatever the offset of the current, */
    take_out(s, CURRENT); /* and its gain, or the winding's resistance */
    float constant;
    const float noise = (float)count * NAME_NOISE_RAD * NAME_NOISE_RAD;
    const float way = product(s, reading, reading);
    const float left = left_by(s, voltage, reading, &constant) + noise;
    if (way > motor->way_seen) {
        motor->way_seen = way;
        motor->constant_seen = constant;
        motor->constant_sigma = number_root(left / ((float)count * way));
    }
}

/* Return whether the current follows the duty from tick to tick, as through a sound bridge; in the last 64 ms. */
static bool follows(const motor_state *motor, const motor_config *config)
{
    return motor->damping_share == 0.0f && config->resistance_ohm * motor->dither_va > FOLLOWS * motor->dither_vv;
}

bool motor_is_stuck(const motor_state *motor, const motor_config *config, float supply_v, motor_sums *s)
{
    const uint32_t since = (motor->driven_ticks - motor->step_ticks) / SAMPLE_TICKS;
    const uint32_t count = fewer(fewer(motor->sampled, NAME_SAMPLES), since);
    if (!motor_stepped(motor) || count < 4u || (count >= FOLLOWS_SAMPLES && follows(motor, config))) {
        return false;
    }
    sums_of(motor, config, count, s);
    const float noise = (float)count * NAME_NOISE_RAD * NAME_NOISE_RAD;
    float by_time, unused;
    const float stuck = left_by(s, at_terminals, passing, &by_time) + noise;
    const float offset = left_by(s, gap, passing, &unused) + noise;
    const float gain = left_by(s, gap, winding, &unused) + noise;
    const float weak = left_by(s, gap, reading, &unused) + noise; /* its voltage may stay, too */
    const float electric = offset < gain ? offset : gain;
    const float sound = electric < weak ? electric : weak;
    const float by_v = by_time * config->constant_v_s / (TICK_S * (float)SAMPLE_TICKS);
    return stuck < STUCK_SHARE * sound && number_size(by_v) > STUCK_SUPPLY * supply_v;
}

bool motor_may_have_stepped(const motor_state *motor)
{
    const bool unseen = motor->limited_ticks != 0u && motor->driven_ticks - motor->limited_ticks < MOTOR_STEP_TICKS;
    return unseen || motor_stepped(motor);
}

bool motor_disobeys(const motor_state *motor, const motor_config *config, float supply_v, float error_rad)
{
    if (motor->sampled <= DISOBEY_SAMPLES) {
        return false;
    }
    float applied_v = 0.0f, amperes = 0.0f;
    bool off = true;
    for (uint32_t i = 1u; i <= DISOBEY_SAMPLES; i++) {
        const uint32_t at = (motor->sampled - i) % MOTOR_SAMPLES;
        applied_v += motor->sample_v[at];
        amperes += motor->sample_a[at];
        off = off && motor->sample_v[at] == 0.0f;
    }
    const float per_tick = 1.0f / (float)(DISOBEY_SAMPLES * SAMPLE_TICKS);
    const float way_rad = motor->sample_read_rad[(motor->sampled - 1u) % MOTOR_SAMPLES] -
                          motor->sample_read_rad[(motor->sampled - 1u - DISOBEY_SAMPLES) % MOTOR_SAMPLES];
    const float ir_v = motor->resistance_scale * config->resistance_ohm * amperes * per_tick;
    const float emf_v = config->constant_v_s * way_rad * (float)TICKS_PER_S * per_tick;
    const float terminal_v = ir_v + emf_v;
    /* The resistance or constant of a motor whose bridge follows may be half of the learnt. */
    const float unsure_v = !off && follows(motor, config) ? 0.5f * (number_size(ir_v) + number_size(emf_v)) : 0.0f;
    /* By a current of the wrong sign all of that goes with the duty. */
    const float otherwise_v = terminal_v - applied_v * per_tick;
    const bool inverted = number_size(otherwise_v - 2.0f * ir_v) < INVERTED * number_size(otherwise_v);
    if (number_size(otherwise_v) < STUCK_SUPPLY * supply_v + unsure_v ||
        (inverted && motor->damping_share == 0.0f &&
         config->resistance_ohm * motor->dither_va < -ANSWER_NONE * (motor->dither_vv + ANSWER_VV))) {
        return false;
    }
    if (off) { /* the current drives it on, or would if nothing held it: shorted windings brake */
        return terminal_v * ir_v > DEAD_SHARE * STUCK_SUPPLY * supply_v * number_size(terminal_v) &&
               terminal_v * way_rad > -number_size(terminal_v) * WINDOW_NOISE_RAD;
    }
    return applied_v * error_rad > 0.0f && way_rad * error_rad < 0.0f && number_size(way_rad) > DISOBEY_RAD &&
           number_size(error_rad) > DISOBEY_OFF_RAD;
}

bool motor_is_dead(const motor_state *motor, const motor_config *config)
{
    const uint32_t at = (motor->sampled - 1u) % MOTOR_SAMPLES;
    return config->resistance_ohm * number_size(motor->sample_a[at]) < DEAD_SHARE * number_size(motor->sample_v[at]);
}

#define SWING_TICKS 60u /* in which a swing of 8 Hz and faster changes its side; half: only from 16 Hz on, double:
                           motions look like swings */
#define SWINGS 8u /* so many changes are no answer to anything; half: pushes look like swings, double: a joint swings
                     for longer */
#define SWING_STAYS 0.6f /* of the first half of them: a second half that is smaller decays; half: ringing stops joints,
                            double: noise hides a swing */
#define SWING_RAD_S 0.4f /* rad/s from the reference's speed at least; half: noise swings, double: slow joints swing
                            unseen */
#define SWING_NOISES 1.75f /* of the noise; looks in a row on a side are beyond that by more in sum: white noise as
                              large alarms once in 5000 h; half: each minute, double: joints swing unseen */

bool motor_swings_far(motor_state *motor, float off_rad_s, bool known)
{
    const float size_rad_s = number_size(off_rad_s);
    if (size_rad_s <= SWING_RAD_S) {
        return false;
    }
    const bool goes_on =
        motor->driven_ticks - motor->swing_seen <= WATCH_TICKS && motor->swing_shows_rad_s * off_rad_s > 0.0f;
    const float beyond_rad_s = off_rad_s > 0.0f ? off_rad_s - SWING_RAD_S : off_rad_s + SWING_RAD_S;
    motor->swing_shows_rad_s = goes_on ? motor->swing_shows_rad_s + beyond_rad_s : beyond_rad_s;
    motor->swing_seen = motor->driven_ticks;
    if (off_rad_s * motor->swing_rad_s <= 0.0f) { /* the other side, or noise: of a current beside an uncertain
                                                     resistance or of a reading */
        const float noise_rad_s = known ? motor->unsure_per_a * number_size(motor->last_a) : SWING_RAD_S;
        if (number_size(motor->swing_shows_rad_s) <= SWING_NOISES * noise_rad_s) {
            return false;
        }
        motor->swings = motor->driven_ticks - motor->swing_since <= SWING_TICKS ? motor->swings + 1u : 0u;
        const float goes = number_size(motor->swing_rad_s) * (motor->swings > SWINGS / 2u ? 1.0f : -SWING_STAYS);
        motor->swing_stays_rad_s = motor->swings != 0u ? motor->swing_stays_rad_s + goes : 0.0f;
        if (motor->swings >= SWINGS && motor->swing_stays_rad_s < 0.0f) {
            motor->swings = 0u; /* it decays by itself */
            motor->swing_stays_rad_s = 0.0f;
        }
        motor->swing_rad_s = off_rad_s;
        motor->swing_since = motor->driven_ticks;
    }
    motor->swing_rad_s = size_rad_s > number_size(motor->swing_rad_s) ? off_rad_s : motor->swing_rad_s;
    return motor->swings >= SWINGS;
}

#define FAST_TICKS 30u /* for so long; half: pushed joints alarm, double: a fast joint goes twice as far */
#define FAST 1.08f /* of what it is held to, by both witnesses; half: all alarm, double: none does */

bool motor_stays_fast(motor_state *motor, const motor_config *config, float reading_rad_s)
{
    const bool alone = motor->doubted != 0u || config->resistance_ohm <= 0.0f || !motor_is_known(motor);
    /* What is before the spring: a load that sinks into it makes no motor faster. */
    const float before_rad_s = reading_rad_s + motor_twists(motor, motor->last_a) * (float)TICKS_PER_S;
    const bool fast = number_size(alone ? reading_rad_s : motor->speed_rad_s) > FAST * motor->fastest_rad_s &&
                      (alone || number_size(before_rad_s) > motor->fastest_rad_s);
    motor->fast_ticks = fast ? number_add(motor->fast_ticks, WATCH_TICKS) : 0u;
    return motor->fast_ticks >= FAST_TICKS + motor->swing_ticks;
}

float motor_draws(const motor_state *motor, const motor_config *config, float supply_v, float reading_rad_s)
{
    const float left_v = motor->duty * supply_v - config->constant_v_s * reading_rad_s;
    return left_v / (motor->resistance_scale * config->resistance_ohm);
}
