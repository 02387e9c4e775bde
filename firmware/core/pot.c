#include "pot.h"

#include "number.h"

float pot_angle(const pot_config *config, uint32_t counts)
{
    uint32_t node = 1u;
    while (node + 1u < config->node_count && counts > config->counts[node]) {
        node++;
    }
    const float run = (float)(config->counts[node] - config->counts[node - 1u]);
    const float rise = config->angle_rad[node] - config->angle_rad[node - 1u];
    const float along = (float)(int32_t)(counts - config->counts[node - 1u]);
    return (float)config->direction * (config->angle_rad[node - 1u] + rise * (along / run));
}

uint32_t pot_read(pot_state *pot, const pot_config *config, uint32_t counts, uint32_t confirm_ticks)
{
    const uint32_t suspect = counts < config->short_counts  ? FAULT_POT_SHORT
                             : counts > config->open_counts ? FAULT_POT_OPEN
                                                            : FAULT_NONE;
    return pot_take(pot, config, counts, pot_angle(config, counts), suspect, confirm_ticks);
}

uint32_t pot_take(pot_state *pot, const pot_config *config, uint32_t counts, float angle_rad, uint32_t suspect,
                  uint32_t confirm_ticks)
{
    pot->alive |= counts ^ pot->counts;
    pot->counts = counts;
    /* The longer the last good reading is ago, the further the joint may have moved. */
    const float reach_rad = config->jump_rad * (float)(pot->bad_ticks + 1u);
    if (suspect == FAULT_NONE && pot->valid != 0u && number_size(angle_rad - pot->angle_rad) > reach_rad) {
        suspect = FAULT_POT_JUMP;
    }
    if (suspect != FAULT_NONE) {
        pot->bad_ticks = number_count(pot->bad_ticks);
        if (pot->bad_ticks < confirm_ticks) {
            return FAULT_NONE;
        }
        if (suspect != FAULT_POT_JUMP) {
            pot->valid = 0u; /* when it comes back, it may be anywhere */
            return suspect;
        }
        /* A jump that lasts is the new position: the fault is reported, and the reading goes on from there. */
    }
    pot->valid = 1u;
    pot->bad_ticks = 0u;
    pot->angle_rad = angle_rad;
    return suspect;
}

bool pot_is_read(const pot_state *pot) { return pot->valid != 0u && pot->bad_ticks == 0u; }

void pot_watch(pot_state *pot, float reference_rad)
{
    pot->mark_rad = reference_rad;
    pot->towards = 0;
    pot->farthest_rad = 0.0f;
}

bool pot_is_frozen(pot_state *pot, const pot_config *config, float reference_rad)
{
    if (pot->alive != 0u) {
        pot->alive = 0u;
        pot->mark_rad = reference_rad;
    }
    return number_size(reference_rad - pot->mark_rad) > config->frozen_rad;
}

bool pot_is_inverted(pot_state *pot, const pot_config *config, float error_rad, float duty)
{
    const bool driven_there = duty * error_rad > 0.0f; /* braked otherwise, or left alone */
    const int32_t towards = driven_there ? (error_rad > 0.0f ? 1 : -1) : 0;
    const float along_rad = (float)towards * pot->angle_rad;
    /* Measured from the farthest position it was driven to, so that noise does not add up. */
    if (towards != pot->towards || along_rad > pot->farthest_rad) {
        pot->towards = towards;
        pot->farthest_rad = along_rad;
    }
    /* A joint that follows its reference downwards is driven upwards all the way: it must be away from it, too. */
    return pot->farthest_rad - along_rad > config->inverted_rad &&
           number_size(error_rad) > 0.5f * config->inverted_rad;
}
