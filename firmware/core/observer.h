/* A joint whose motor is not watched, by its duty and its reading alone: an observer of position, speed and of what of
 * the duty its load takes (an extended state observer: Han, IEEE Trans. Ind. Electron. 56, 2009). What the joint makes
 * of a duty is what its feed-forward says: ka of an acceleration, kv - kd of a speed. All functions: tick context. */
#ifndef ARMSIGHT_OBSERVER_H
#define ARMSIGHT_OBSERVER_H

#include <stdbool.h>

#include "types.h"

/* Begin anew at a reading (rad) that is no motion: the joint goes on as fast as it did, under its usual load. */
void observer_move(observer_state *observer, float angle_rad);

/* Take what a tick measured, while the windings are closed; duty: put out in the last tick, of the nominal supply. */
void observer_measure(observer_state *observer, const joint_gains *gains, float duty, float angle_rad);

/* Return whether the joint is driven the way it moves by more than any push, which is the supply's duty (of the nominal
 * one) at most, less at a speed near its limit (fast: of it), and its own duty does not: a bridge that conducts by
 * itself. off: nothing is put out, its windings are shorted. To be asked each WATCH_TICKS. */
bool observer_is_driven(observer_state *observer, float supply_duty, float fast, bool off);

#endif
