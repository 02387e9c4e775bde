/* One potentiometer: counts to joint angle, and whether the counts are plausible. All functions: tick context. */
#ifndef ARMSIGHT_POT_H
#define ARMSIGHT_POT_H

#include <stdbool.h>

#include "types.h"

/* Return the joint angle (rad) at counts (0 to 65535): straight lines between the nodes, and on beyond the outer
 * ones. */
float pot_angle(const pot_config *config, uint32_t counts);

/* Take this tick's counts. A reading out of its band, or one further off than the joint can have moved, is not
 * plausible: the angle stays. Returns the fault once that lasts confirm_ticks (1 or more), FAULT_NONE until then. */
uint32_t pot_read(pot_state *pot, const pot_config *config, uint32_t counts, uint32_t confirm_ticks);

/* Take an angle (rad) that a sensor of any kind has at these counts. suspect: FAULT_NONE, or why it is no reading. As
 * pot_read otherwise. */
uint32_t pot_take(pot_state *pot, const pot_config *config, uint32_t counts, float angle_rad, uint32_t suspect,
                  uint32_t confirm_ticks);

/* Return whether the present angle is a reading of this tick. */
bool pot_is_read(const pot_state *pot);

/* Begin to watch how the counts follow the reference (rad). */
void pot_watch(pot_state *pot, float reference_rad);

/* Return whether the counts have stood still while the reference (rad) travelled frozen_rad. Driven joints only. */
bool pot_is_frozen(pot_state *pot, const pot_config *config, float reference_rad);

/* Return whether the joint has moved away from its command by inverted_rad although it is driven towards it.
 * error_rad is reference minus angle, duty this tick's. Driven joints only. */
bool pot_is_inverted(pot_state *pot, const pot_config *config, float error_rad, float duty);

#endif
