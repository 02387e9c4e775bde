/* The emulated board's start-up: vectors, SysTick, and frames by semihosting. Under QEMU reset runs it all; under
 * Unicorn, which has neither SysTick nor semihosting, Python calls pil_boot once and then pil_tick. */
#include <stddef.h>

#include "memory.h"
#include "pil.h"
#include "semihost.h"

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))
#define SYSTICK_CONTROL REGISTER(0xE000E010u)
#define SYSTICK_RELOAD REGISTER(0xE000E014u)
#define SYSTICK_VALUE REGISTER(0xE000E018u)
#define FPU_ACCESS REGISTER(0xE000ED88u) /* CPACR */
#define FPU_FULL (0xFu << 20)
#define SYSTICK_RUN 7u /* the processor's clock, interrupt, on */
#define CLOCK_HZ 25000000u
#define FPU_REGISTERS 32u

extern char stack_top[]; /* of mps2.ld */

void reset(void);
void pil_boot(void);
void tick_interrupt(void);
void unexpected_interrupt(void);

static volatile uint32_t due; /* not 0: a request waits for its tick */

void tick_interrupt(void)
{
    if (due != 0u) {
        pil_control();
        due = 0u;
    }
}

void unexpected_interrupt(void) { semihost_exit(false); }

typedef void (*vector)(void);

__attribute__((section(".vectors"), used)) static const vector vectors[16] = {
    (vector)(uintptr_t)stack_top, reset,           unexpected_interrupt, unexpected_interrupt,
    unexpected_interrupt,              unexpected_interrupt, unexpected_interrupt, NULL,
    NULL,                         NULL,            NULL,            unexpected_interrupt,
    unexpected_interrupt,              NULL,            unexpected_interrupt, tick_interrupt,
};

/* Wait for the tick's interrupt with all floating-point registers in use; returns whether it left them as they were.
 * It loops instead of sleeping: an emulated processor that sleeps costs its emulator more than one that
 * counts. */
static bool wait_for_tick(uint32_t seed)
{
    uint32_t before[FPU_REGISTERS];
    uint32_t after[FPU_REGISTERS]; // cppcheck-suppress constVariable - the assembly writes it
    for (uint32_t i = 0u; i < FPU_REGISTERS; i++) {
        before[i] = seed + i * 0x01010101u;
    }
    due = 1u;
    __asm__ volatile("vldmia %0, {s0-s31}\n"
                     "1: ldr r3, [%2]\n"
                     "cmp r3, #0\n"
                     "bne 1b\n"
                     "vstmia %1, {s0-s31}"
                     :
                     : "r"(before), "r"(after), "r"(&due)
                     : "r3", "cc", "memory", "s0", "s1", "s2", "s3", "s4", "s5", "s6", "s7", "s8", "s9", "s10", "s11",
                       "s12", "s13", "s14", "s15", "s16", "s17", "s18", "s19", "s20", "s21", "s22", "s23", "s24", "s25",
                       "s26", "s27", "s28", "s29", "s30", "s31");
    for (uint32_t i = 0u; i < FPU_REGISTERS; i++) {
        if (after[i] != before[i]) {
            return false;
        }
    }
    return true;
}

static bool serve(int32_t from, int32_t to)
{
    while (semihost_read(from, &pil_request_frame, sizeof pil_request_frame)) {
        if (pil_begin()) {
            if (!wait_for_tick(pil_request_frame.tick)) {
                return false;
            }
            pil_end();
        }
        if (!semihost_write(to, &pil_answer_frame, sizeof pil_answer_frame)) {
            return false;
        }
    }
    return true;
}

/* Everything after the floating-point unit is on: apart, so that no register of it is saved before. */
__attribute__((noinline)) static void start(void)
{
    memory_start();
    pil_start();
}

__attribute__((noinline)) static void run(void)
{
    SYSTICK_RELOAD = CLOCK_HZ / TICKS_PER_S - 1u;
    SYSTICK_VALUE = 0u;
    SYSTICK_CONTROL = SYSTICK_RUN;
    const int32_t from = semihost_open("/dev/stdin", false);
    const int32_t to = semihost_open("/dev/stdout", true);
    semihost_exit(from >= 0 && to >= 0 && serve(from, to));
}

void pil_boot(void)
{
    FPU_ACCESS |= FPU_FULL;
    __asm__ volatile("dsb\nisb" ::: "memory");
    start();
}

void reset(void)
{
    pil_boot();
    run();
}
