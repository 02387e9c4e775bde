/* Memory: filled at reset, and what compilers ask for where there is no C library: memcpy, memset, and the run-time
 * ABI's names for them. Any context. */
#include <stddef.h>
#include <stdint.h>

#include "memory.h"

#define KEEP __asm__ volatile("" ::: "memory") /* else the loop becomes a call of the function it stands in */

void *memcpy(void *to, const void *from, size_t length);
void *memset(void *to, int value, size_t length);
void __aeabi_memcpy(void *to, const void *from, size_t length);
void __aeabi_memcpy4(void *to, const void *from, size_t length);
void __aeabi_memcpy8(void *to, const void *from, size_t length);
void __aeabi_memclr(void *to, size_t length);
void __aeabi_memclr4(void *to, size_t length);
void __aeabi_memclr8(void *to, size_t length);
void __aeabi_memset(void *to, size_t length, int value);
void __aeabi_memset4(void *to, size_t length, int value);
void __aeabi_memset8(void *to, size_t length, int value);

/* A word anywhere: the processor reads and writes single words at any address. */
typedef struct __attribute__((packed, may_alias)) word {
    uint32_t bits; // cppcheck-suppress unusedStructMember
} word;

extern char data_begin[], data_end[], data_stored[], bss_begin[], bss_end[]; /* of sections.ld */

void memory_start(void)
{
    memcpy(data_begin, data_stored, (uintptr_t)data_end - (uintptr_t)data_begin);
    memset(bss_begin, 0, (uintptr_t)bss_end - (uintptr_t)bss_begin);
}

void *memcpy(void *to, const void *from, size_t length)
{
    uint8_t *target = to;
    const uint8_t *source = from;
    if ((((uintptr_t)to | (uintptr_t)from) & 3u) == 0u) { /* eight words at a time need aligned ones */
        for (; length >= 32u; length -= 32u) {
            __asm__ volatile("ldmia %1!, {r3-r6, r8-r10, r12}\n"
                             "stmia %0!, {r3-r6, r8-r10, r12}"
                             : "+&r"(target), "+r"(source)
                             :
                             : "r3", "r4", "r5", "r6", "r8", "r9", "r10", "r12", "memory");
        }
    }
    for (; length >= 4u; length -= 4u, target += 4, source += 4) {
        *(word *)(void *)target = *(const word *)(const void *)source;
        KEEP;
    }
    for (; length != 0u; length--) {
        *target++ = *source++;
        KEEP;
    }
    return to;
}

void *memset(void *to, int value, size_t length)
{
    uint8_t *target = to;
    const word fill = {(uint8_t)value * 0x01010101u};
    if (((uintptr_t)to & 3u) == 0u) {
        register uint32_t r3 __asm__("r3") = (uint8_t)value * 0x01010101u;
        register uint32_t r4 __asm__("r4") = r3, r5 __asm__("r5") = r3, r6 __asm__("r6") = r3;
        for (; length >= 32u; length -= 32u) {
            __asm__ volatile("stmia %0!, {r3-r6}\n"
                             "stmia %0!, {r3-r6}"
                             : "+r"(target)
                             : "r"(r3), "r"(r4), "r"(r5), "r"(r6)
                             : "memory");
        }
    }
    for (; length >= 4u; length -= 4u, target += 4) {
        *(word *)(void *)target = fill;
        KEEP;
    }
    for (; length != 0u; length--) {
        *target++ = (uint8_t)value;
        KEEP;
    }
    return to;
}

void __aeabi_memcpy(void *to, const void *from, size_t length) { memcpy(to, from, length); }
void __aeabi_memcpy4(void *to, const void *from, size_t length) { memcpy(to, from, length); }
void __aeabi_memcpy8(void *to, const void *from, size_t length) { memcpy(to, from, length); }
void __aeabi_memclr(void *to, size_t length) { memset(to, 0, length); }
void __aeabi_memclr4(void *to, size_t length) { memset(to, 0, length); }
void __aeabi_memclr8(void *to, size_t length) { memset(to, 0, length); }
void __aeabi_memset(void *to, size_t length, int value) { memset(to, value, length); }
void __aeabi_memset4(void *to, size_t length, int value) { memset(to, value, length); }
void __aeabi_memset8(void *to, size_t length, int value) { memset(to, value, length); }
