/* The few operations on numbers the core needs and the C library would otherwise give. Any context. */
#ifndef ARMSIGHT_NUMBER_H
#define ARMSIGHT_NUMBER_H

#include <float.h>
#include <stdbool.h>
#include <stdint.h>

/* The same bits everywhere need float arithmetic that is float arithmetic. */
_Static_assert(FLT_EVAL_METHOD == 0, "float expressions must be computed in float");

/* Return whether x is neither NaN nor infinite. */
inline bool number_finite(float x) { return __builtin_fabsf(x) <= FLT_MAX; }

/* Return whether x lies in [low, high]; NaN does not. */
inline bool number_within(float x, float low, float high) { return x >= low && x <= high; }

/* Return x held within [low, high]; low <= high. */
inline float number_clamp(float x, float low, float high) { return x < low ? low : (x > high ? high : x); }

/* Return x held within [-size, size]; size 0 or more. Quicker than number_clamp where x is mostly within. */
inline float number_bound(float x, float size)
{
    if (__builtin_fabsf(x) <= size) {
        return x;
    }
    return x > size ? size : (x < -size ? -size : x); /* NaN stays */
}

/* Return the target, or what lies most on the way to it from start; most 0 or more. */
inline float number_towards(float start, float target, float most)
{
    const float way = target - start;
    if (__builtin_fabsf(way) <= most) {
        return target;
    }
    return way > most ? start + most : (way < -most ? start - most : target);
}

/* Return the size of x: one instruction. */
inline float number_size(float x) { return __builtin_fabsf(x); }

/* Return the square root of x, 0 or more: one instruction, rounded as IEEE 754 says. */
inline float number_root(float x) { return __builtin_sqrtf(x); }

/* Return count + 1, or count where it would wrap. */
inline uint32_t number_count(uint32_t count) { return count == UINT32_MAX ? count : count + 1u; }

/* Return count + more, or count where it would wrap. */
inline uint32_t number_add(uint32_t count, uint32_t more)
{
    return count > UINT32_MAX - more ? count : count + more;
}

#endif
