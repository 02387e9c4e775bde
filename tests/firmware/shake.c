/* Shakes the core for the sanitizers: random ticks, commands and configurations; ends with 0 if all that came out was
 * finite and within its limits. */
#include <stdio.h>
#include <string.h>

#include "config.h"
#include "core.h"
#include "draw.h"
#include "number.h"

static void fill(void *bytes, size_t length)
{
    unsigned char *byte = bytes;
    for (size_t i = 0; i < length; i++) {
        byte[i] = (unsigned char)draw();
    }
}

static void aim(move_command *move)
{
    for (uint32_t i = 0; i < JOINTS; i++) {
        move->position_rad[i] = (float)(int32_t)draw() * 2e-9f;
        move->speed_rad_s[i] = (float)(int32_t)draw() * 5e-10f;
        move->gravity_duty[i] = (float)(int32_t)draw() * 4e-10f;
    }
    move->duration_ticks = draw() % 50u;
}

static void prepare(core_inputs *inputs, uint32_t tick)
{
    inputs->tick = draw() % 500u == 0u ? draw() : tick;
    inputs->overrun = draw() % 700u == 0u;
    inputs->stop_pressed = draw() % 600u == 0u;
    inputs->supply_mv = draw() % 300u == 0u ? draw() : 12000u;
    for (uint32_t i = 0; i < JOINTS; i++) {
        inputs->counts[i] = draw() % 200u == 0u ? draw() % 65536u : inputs->counts[i] + draw() % 9u - 4u;
        inputs->current_ma[i] = (int32_t)(draw() % 4000u) - 2000;
    }
    if (draw() % 3u == 0u) {
        fill(&inputs->command, sizeof inputs->command);
    }
    if (draw() % 2u == 0u) {
        aim(&inputs->command.move);
    }
    inputs->command.kind = draw() % 10u;
}

static int sound(const core_outputs *outputs)
{
    for (uint32_t i = 0; i < JOINTS; i++) {
        if (!number_within(outputs->duty[i], -1.0f, 1.0f) || !number_finite(outputs->angle_rad[i]) ||
            !number_finite(outputs->speed_rad_s[i]) || !number_finite(outputs->reference_rad[i]) ||
            !number_finite(outputs->reference_rad_s[i])) {
            return 0;
        }
    }
    return outputs->state < STATE_COUNT && outputs->first_fault < FAULT_COUNT;
}

static int run(uint32_t round)
{
    static core_state core;
    core_config config;
    core_inputs inputs;
    core_outputs outputs;
    config_copy copies[2];
    config_factory(&config);
    memset(&inputs, 0, sizeof inputs);
    for (uint32_t i = 0; round % 2u == 1u && i < JOINTS; i++) {
        config.joint[i].encoder.sensor = draw() % 3u;
        config.joint[i].encoder.input = i + 1u;
    }
    config_seal(&copies[0], &config, draw());
    config_seal(&copies[1], &config, draw());
    ((unsigned char *)&copies[round % 2u])[draw() % sizeof copies[0]] ^= (unsigned char)draw();
    const uint32_t source = config_load(&config, &copies[0], &copies[1]);
    if (round % 10u == 9u) {
        fill(&config, sizeof config);
    }
    core_init(&core, &config, source, round % 7u == 6u);
    for (uint32_t i = 0; i < JOINTS; i++) {
        inputs.counts[i] = 20000u + draw() % 20000u;
    }
    for (uint32_t tick = 0; tick < 2000u; tick++) {
        prepare(&inputs, tick);
        core_tick(&core, &inputs, &outputs);
        if (!sound(&outputs)) {
            return 0;
        }
    }
    return 1;
}

int main(void)
{
    for (uint32_t round = 0; round < 100u; round++) {
        if (!run(round)) {
            fprintf(stderr, "round %u: an output is not what it must be\n", (unsigned)round);
            return 1;
        }
    }
    return 0;
}
