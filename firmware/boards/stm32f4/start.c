/* From reset to board_main, and what happens when the processor can no longer be trusted. */
#include "start.h"

#include "drivers.h"
#include "memory.h"
#include "registers.h"

#define INTERRUPTS 97 /* of the STM32F446 */

typedef void (*handler)(void);

typedef struct vector_table {
    uint32_t *stack;
    handler system[15];
    handler interrupt[INTERRUPTS];
} vector_table;

extern uint32_t main_stack_top[]; /* of stm32f446re.ld */

extern const vector_table vectors;

__attribute__((section(".vector_table"), used)) const vector_table vectors = {
    .stack = main_stack_top,
    .system = {reset, [1 ... 12] = fault, pendsv_interrupt, systick_interrupt},
    .interrupt = {[0 ... INTERRUPTS - 1] = fault},
};

void reset(void)
{
    SCB_CPACR |= SCB_CPACR_FPU;
    FPU_FPCCR |= FPU_FPCCR_ASPEN | FPU_FPCCR_LSPEN;
    __asm__ volatile("dsb\nisb" ::: "memory");
    SCB_VTOR = (uint32_t)(uintptr_t)&vectors;
    memory_start();
    board_main();
}

void fault_stop(void)
{
    drives_off();
    for (;;) {
    }
}

/* The stack may be what failed: begin a new one. */
__attribute__((naked)) void fault(void)
{
    __asm__ volatile("cpsid i\n"
                   "ldr r0, =main_stack_top\n"
                   "mov sp, r0\n"
                   "b fault_stop\n");
}
