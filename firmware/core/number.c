#include "number.h"

/* The copies for who does not inline them. */
extern inline bool number_finite(float);
extern inline bool number_within(float, float, float);
extern inline float number_clamp(float, float, float);
extern inline float number_bound(float, float);
extern inline float number_towards(float, float, float);
extern inline float number_size(float);
extern inline float number_root(float);
extern inline uint32_t number_count(uint32_t);
extern inline uint32_t number_add(uint32_t, uint32_t);
