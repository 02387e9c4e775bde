#include "config.h"

#include <stddef.h>

#include "number.h"
#include "pid.h"

_Static_assert(sizeof(pot_config) == 2u * (POT_NODES + 3u) + 4u * (POT_NODES + 4u), "pot_config has a hole");
_Static_assert(sizeof(encoder_config) == 24u, "encoder_config has a hole");
_Static_assert(offsetof(joint_config, transmission) + 12u == sizeof(joint_config),
               "a new joint only has more at its end");
_Static_assert(offsetof(config_copy, crc) == sizeof(config_copy) - sizeof(uint32_t), "config_copy has a hole");

uint32_t config_crc_on(uint32_t crc, const void *bytes, uint32_t length)
{
    static const uint32_t of_nibble[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    const uint8_t *byte = bytes;
    for (uint32_t i = 0u; i < length; i++) {
        crc ^= byte[i];
        crc = (crc >> 4) ^ of_nibble[crc & 15u];
        crc = (crc >> 4) ^ of_nibble[crc & 15u];
    }
    return crc;
}

uint32_t config_crc(const void *bytes, uint32_t length) { return ~config_crc_on(0xFFFFFFFFu, bytes, length); }

#define REV_RAD 6.28318531f

static const joint_config factory_joint = {
    .gains = {.kp_per_rad = 1.0f, .derivative_filter_s = 0.005f, .anti_windup_per_s = 10.0f},
    .pot = {.node_count = 2u,
            .counts = {3277u, 62258u},
            .short_counts = 1000u,
            .open_counts = 64500u,
            .angle_rad = {-2.6f, 2.6f},
            .direction = 1,
            .jump_rad = 0.02f,
            .frozen_rad = 0.1f,
            .inverted_rad = 0.1f},
    .motor = {.constant_v_s = 1.0f, .apart_rad = 0.03f, .backlash_rad = 0.01f},
    .soft_min_rad = -2.4f,
    .soft_max_rad = 2.4f,
    .speed_limit_rad_s = 0.5f,
    .deceleration_rad_s2 = 5.0f,
    .acceleration_rad_s2 = 5.0f,
    .jerk_rad_s3 = 500.0f,
    .duty_limit = 0.2f,
    .duty_slew_per_s = 5.0f,
    .gravity_slew_per_s = 2.0f,
    .current_cut_per_a_s = 5.0f,
    .following_rad = 0.3f,
    .stall_duty = 0.19f,
    .stall_rad = 0.01f,
    .current_limit_ma = 1000u,
    .motor_direction = 1,
    .encoder = {.counts_per_rev = (float)ENCODER_REV, .direction = 1},
};

void config_factory(core_config *config)
{
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        config->joint[joint] = factory_joint;
    }
    config->joint_count = JOINTS;
    config->supply_min_mv = 10000u;
    config->supply_max_mv = 14000u;
    config->supply_nominal_mv = 12000u;
    config->supply_ticks = 5u;
    config->pot_ticks = 5u;
    config->following_ticks = 50u;
    config->stall_ticks = 500u;
    config->overload_ticks = 500u;
    config->silence_ticks = 100u;
    config->silence_reaction = REACTION_HOLD;
    config->sync_led_ticks = 3u;
}

static bool table_is_valid(const pot_config *pot)
{
    if (pot->node_count < 2u || pot->node_count > POT_NODES || pot->short_counts >= pot->open_counts) {
        return false;
    }
    const bool rising = pot->angle_rad[1] > pot->angle_rad[0];
    for (uint32_t node = 0u; node < pot->node_count; node++) {
        if (!number_within(pot->angle_rad[node], -13.0f, 13.0f)) {
            return false;
        }
        if (node == 0u) {
            continue;
        }
        const float before = pot->angle_rad[node - 1u];
        const bool onwards = rising ? pot->angle_rad[node] > before : pot->angle_rad[node] < before;
        if (!onwards || pot->counts[node] <= pot->counts[node - 1u]) {
            return false;
        }
    }
    return pot->direction == 1 || pot->direction == -1;
}

static bool encoder_is_valid(const encoder_config *encoder)
{
    const bool quadrature = encoder->sensor == SENSOR_QUADRATURE;
    const bool placed =
        quadrature ? encoder->input >= 1u && encoder->input <= JOINTS : encoder->zero_counts < ENCODER_REV;
    return encoder->sensor <= SENSOR_ABSOLUTE && placed && number_within(encoder->counts_per_rev, 16.0f, 1e7f) &&
           (encoder->direction == 1 || encoder->direction == -1) && number_within(encoder->home_rad, -13.0f, 13.0f);
}

static bool sensor_is_valid(const joint_config *joint)
{
    const pot_config *pot = &joint->pot;
    const bool own =
        joint->encoder.sensor == SENSOR_POTENTIOMETER ? table_is_valid(pot) : encoder_is_valid(&joint->encoder);
    return own && number_within(pot->jump_rad, 1e-4f, 1.0f) && number_within(pot->frozen_rad, 1e-3f, 1.0f) &&
           number_within(pot->inverted_rad, 1e-3f, 1.0f);
}

static bool motor_is_valid(const motor_config *motor)
{
    return number_within(motor->resistance_ohm, 0.0f, 1000.0f) && number_within(motor->constant_v_s, 1e-3f, 1e3f) &&
           number_within(motor->apart_rad, 1e-3f, 1.0f) && number_within(motor->backlash_rad, 0.0f, 1.0f);
}

static bool transmission_is_valid(const transmission_config *between)
{
    return number_within(between->twist_rad_per_a, 0.0f, 1.0f) && number_within(between->uneven, 0.0f, 0.5f) &&
           number_within(between->damping_share, 0.0f, 1.0f);
}

/* Return whether a potentiometer's table reaches the soft limits, within its band. */
static bool table_is_consistent(const joint_config *joint)
{
    const pot_config *pot = &joint->pot;
    const float first = (float)pot->direction * pot->angle_rad[0];
    const float last = (float)pot->direction * pot->angle_rad[pot->node_count - 1u];
    const float low = first < last ? first : last;
    const float high = first < last ? last : first;
    return joint->soft_min_rad >= low && joint->soft_max_rad <= high && pot->short_counts < pot->counts[0] &&
           pot->counts[pot->node_count - 1u] < pot->open_counts;
}

/* Return whether a step of an encoder is small enough, and the soft limits lie within the revolution it measures. */
static bool encoder_is_consistent(const joint_config *joint)
{
    const encoder_config *encoder = &joint->encoder;
    const float step_rad = REV_RAD / encoder->counts_per_rev;
    const float half_rad = (0.5f * (float)ENCODER_REV - 1.0f) * step_rad;
    const bool within = encoder->sensor == SENSOR_QUADRATURE || (joint->soft_min_rad >= encoder->home_rad - half_rad &&
                                                                 joint->soft_max_rad <= encoder->home_rad + half_rad);
    return within && step_rad <= 0.5f * joint->pot.jump_rad && step_rad <= 0.5f * joint->pot.frozen_rad;
}

/* Return whether the numbers fit each other: a stall shows below the duty's limit, the sensor reaches the soft limits,
 * a healthy gear's backlash leaves motor and sensor together. */
static bool joint_is_consistent(const joint_config *joint)
{
    const bool own =
        joint->encoder.sensor == SENSOR_POTENTIOMETER ? table_is_consistent(joint) : encoder_is_consistent(joint);
    return own && joint->motor.backlash_rad < joint->motor.apart_rad && joint->stall_duty <= joint->duty_limit &&
           joint->speed_limit_rad_s * TICK_S < joint->pot.jump_rad;
}

/* Return whether no two quadrature encoders are on one timer. */
static bool inputs_differ(const core_config *config)
{
    uint32_t taken = 0u;
    for (uint32_t joint = 0u; joint < config->joint_count; joint++) {
        const encoder_config *encoder = &config->joint[joint].encoder;
        const uint32_t bit = encoder->sensor == SENSOR_QUADRATURE ? 1u << encoder->input : 0u;
        if ((taken & bit) != 0u) {
            return false;
        }
        taken |= bit;
    }
    return true;
}

static bool word_within(uint32_t word, uint32_t least, uint32_t most) { return word >= least && word <= most; }

static bool joint_is_valid(const joint_config *joint)
{
    return pid_gains_in_range(&joint->gains) && sensor_is_valid(joint) && motor_is_valid(&joint->motor) &&
           transmission_is_valid(&joint->transmission) &&
           number_within(joint->soft_min_rad, -13.0f, 13.0f) && number_within(joint->soft_max_rad, -13.0f, 13.0f) &&
           joint->soft_min_rad < joint->soft_max_rad && number_within(joint->speed_limit_rad_s, 0.01f, 20.0f) &&
           number_within(joint->deceleration_rad_s2, 0.1f, 1000.0f) &&
           number_within(joint->acceleration_rad_s2, 0.1f, 1000.0f) && number_within(joint->jerk_rad_s3, 1.0f, 1e6f) &&
           number_within(joint->gravity_slew_per_s, 0.1f, 1000.0f) && number_within(joint->duty_limit, 0.0f, 1.0f) &&
           number_within(joint->duty_slew_per_s, 0.1f, 1000.0f) &&
           number_within(joint->current_cut_per_a_s, 0.0f, 1000.0f) &&
           number_within(joint->following_rad, 1e-3f, 13.0f) && number_within(joint->stall_duty, 0.01f, 1.0f) &&
           number_within(joint->stall_rad, 1e-4f, 1.0f) &&
           word_within(joint->current_limit_ma, 10u, 500000u) &&
           (joint->motor_direction == 1 || joint->motor_direction == -1) && joint_is_consistent(joint);
}

bool config_is_valid(const core_config *config)
{
    if (config->joint_count < 1u || config->joint_count > JOINTS) {
        return false;
    }
    for (uint32_t joint = 0u; joint < config->joint_count; joint++) {
        if (!joint_is_valid(&config->joint[joint])) {
            return false;
        }
    }
    return inputs_differ(config) && config->supply_min_mv < config->supply_max_mv &&
           config->supply_min_mv >= config->supply_nominal_mv / 2u &&
           word_within(config->supply_nominal_mv, 1000u, 100000u) &&
           word_within(config->overload_ticks, 1u, 10000u) && word_within(config->brake_release_ticks, 0u, 1000u) &&
           word_within(config->brake_engage_ticks, 0u, 1000u) && word_within(config->supply_ticks, 1u, 1000u) &&
           word_within(config->pot_ticks, 1u, 100u) && word_within(config->following_ticks, 1u, 10000u) &&
           word_within(config->stall_ticks, 1u, 10000u) && word_within(config->silence_ticks, 2u, 60000u) &&
           (config->sync_led_pin == 0u || word_within(config->sync_led_pin, 16u, 143u)) &&
           word_within(config->sync_led_ticks, 1u, 100u) &&
           (config->silence_reaction == REACTION_HOLD || config->silence_reaction == REACTION_RELEASE);
}

void config_seal(config_copy *copy, const core_config *config, uint32_t serial)
{
    copy->magic = CONFIG_MAGIC;
    copy->version = CONFIG_VERSION;
    copy->serial = serial;
    copy->config = *config;
    copy->crc = config_crc(copy, (uint32_t)offsetof(config_copy, crc));
}

static bool copy_is_good(const config_copy *copy)
{
    return copy->magic == CONFIG_MAGIC && copy->version == CONFIG_VERSION &&
           copy->crc == config_crc(copy, (uint32_t)offsetof(config_copy, crc)) && config_is_valid(&copy->config);
}

#define VERSION_5 5u
#define NEW_BYTES ((uint32_t)sizeof(transmission_config)) /* a joint of version 5 ended before its transmission */

/* Move bytes up by so many, the last first. */
static void move_up(uint8_t *from, uint32_t length, uint32_t by)
{
    while (length != 0u) {
        length--;
        from[length + by] = from[length];
    }
}

void config_upgrade(config_copy *copy)
{
    const uint32_t old = (uint32_t)offsetof(config_copy, crc) - JOINTS * NEW_BYTES;
    uint8_t *at = (uint8_t *)copy;
    uint32_t crc = 0u;
    for (uint32_t i = 4u; i != 0u; i--) {
        crc = crc << 8 | at[old + i - 1u];
    }
    if (copy->magic != CONFIG_MAGIC || copy->version != VERSION_5 || crc != config_crc(copy, old)) {
        return;
    }
    const uint32_t joints = (uint32_t)offsetof(config_copy, config);
    const uint32_t joint = (uint32_t)offsetof(joint_config, transmission);
    uint32_t end = old;
    for (uint32_t left = JOINTS; left != 0u; left--) { /* what is new has the value 0 */
        const uint32_t from = joints + left * joint;
        move_up(at + from, end - from, left * NEW_BYTES);
        for (uint32_t i = 0u; i < NEW_BYTES; i++) {
            at[from + (left - 1u) * NEW_BYTES + i] = 0u;
        }
        end = from;
    }
    copy->version = CONFIG_VERSION;
    copy->crc = config_crc(copy, (uint32_t)offsetof(config_copy, crc));
}

/* Return the newer of two copies; serial numbers may wrap. */
static const config_copy *newer(const config_copy *first, const config_copy *second)
{
    return second->serial - first->serial - 1u < 0x7FFFFFFFu ? second : first;
}

uint32_t config_load(core_config *config, const config_copy *first, const config_copy *second)
{
    const bool first_good = copy_is_good(first);
    const bool second_good = copy_is_good(second);
    if (first_good && second_good) {
        *config = newer(first, second)->config;
        return CONFIG_NEWEST;
    }
    if (first_good || second_good) {
        *config = first_good ? first->config : second->config;
        return CONFIG_OLDER;
    }
    config_factory(config);
    return CONFIG_FACTORY;
}

uint32_t config_next(const config_copy *first, const config_copy *second, uint32_t *serial)
{
    const bool first_good = copy_is_good(first);
    const bool second_good = copy_is_good(second);
    const config_copy *keep = first_good ? first : second;
    if (first_good && second_good) {
        keep = newer(first, second);
    }
    *serial = first_good || second_good ? keep->serial + 1u : 1u;
    return keep == first ? 1u : 0u;
}
