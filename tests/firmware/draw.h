/* Random words for programs that shake the firmware: xorshift (Marsaglia, 2003), the same on every computer. */

#include <stdint.h>

static uint32_t word = 2463534242u;

static uint32_t draw(void)
{
    word ^= word << 13;
    word ^= word >> 17;
    word ^= word << 5;
    return word;
}
