/* From reset to board_main, and what happens when the processor can no longer be trusted. */
#include "start.h"

#include "drivers.h"
#include "memory.h"
#include "registers.h"

#define INTERRUPTS 97 /* of the STM32F446 */
#define CRASH_MAGIC 0x43524153u
#define FRAME_BYTES 32u /* what the processor puts on the stack: r0 to r3, r12, lr, pc, xpsr */

typedef void (*handler)(void);

typedef struct vector_table {
    uint32_t *stack;
    handler system[15];
    handler interrupt[INTERRUPTS];
} vector_table;

extern uint32_t main_stack_begin[], main_stack_top[]; /* of stm32f446re.ld */

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

/* What is kept of a crash until the board has started again: in RAM that memory_start leaves alone. */
typedef struct kept_crash {
    crash_record record;
    uint32_t check; /* at power-up RAM holds anything */
} kept_crash;

__attribute__((section(".kept"))) static kept_crash kept;

static uint32_t check_of(const crash_record *record)
{
    return CRASH_MAGIC ^ record->exception ^ record->pc ^ record->lr ^ record->cfsr;
}

bool crash_was_here(crash_record *record)
{
    const bool was = kept.check == check_of(&kept.record);
    *record = was ? kept.record : (crash_record){0};
    kept.check = ~check_of(&kept.record);
    return was;
}

void fault_stop(const uint32_t *frame, uint32_t exception)
{
    drives_off();
    const uintptr_t at = (uintptr_t)frame;
    const bool readable = at >= (uintptr_t)main_stack_begin && at + FRAME_BYTES <= (uintptr_t)main_stack_top;
    kept.record.exception = exception & 0x1FFu;
    kept.record.pc = readable ? frame[6] : 0u;
    kept.record.lr = readable ? frame[5] : 0u;
    kept.record.cfsr = SCB_CFSR;
    kept.check = check_of(&kept.record);
    for (;;) {
    }
}

/* The stack may be what failed: begin a new one. */
__attribute__((naked)) void fault(void)
{
    __asm__ volatile("cpsid i\n"
                   "mov r0, sp\n"
                   "mrs r1, ipsr\n"
                   "ldr r2, =main_stack_top\n"
                   "mov sp, r2\n"
                   "b fault_stop\n");
}
