/* The reference within its limits: a path that the host's points make, followed within speed, acceleration, jerk and
 * the braking distance before the soft limits. A path within them is followed exactly. All functions: tick context. */
#ifndef ARMSIGHT_GOVERNOR_H
#define ARMSIGHT_GOVERNOR_H

#include <stdbool.h>

#include "types.h"

/* Stand still at position_rad. */
void governor_hold(governor_state *reference, float position_rad);

/* Follow the path for one tick within [low_rad, high_rad], at fastest (rad/s) at most; path_rad_s2 is its acceleration.
 * Returns the LIMITED_... bits that hold it back. */
uint32_t governor_step(governor_state *reference, const setpoint_state *path, float path_rad_s2,
                       const joint_config *config, float fastest, float low_rad, float high_rad);

#endif
