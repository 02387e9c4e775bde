/* Bridges with a PWM, a direction and a common enable pin: 20 kHz, centre-aligned.
 *
 * The timers' break inputs are on the emergency stop's line: the PWM falls without the processor's help. A break stays
 * until drives_write, which does nothing while the line is open. */
#include "drivers.h"
#include "number.h"
#include "registers.h"

#define CHANNELS_ON (0x1111u & ((1u << 4u * PWM_CHANNELS) - 1u)) /* CCxE */
#define PWM_PAIR (TIM_OC_PWM1_PRELOAD | FIELD(TIM_OC_PWM1_PRELOAD, 8))
#define BRIDGE_OFF (TIM_BDTR_LOCK3 | TIM_BDTR_OSSI | TIM_BDTR_OSSR | TIM_BDTR_BKE | TIM_BDTR_BKP)
/* The currents are read while the counter is near 0, a pulse's middle: half of their conversions before it. */
#define TRIGGER (BOARD_JOINTS * CONVERSION_CLOCKS * (TIMER_HZ / ADC_HZ) / 2u)

_Static_assert(PWM_STEPS <= 0xFFFFu, "the counter has 16 bits");
_Static_assert(TRIGGER < PWM_STEPS, "the trigger is within a period");

typedef struct stop_line {
    gpio_registers *port;
    uint32_t pin;
} stop_line;

static tim_registers *const timers[] = PWM_TIMERS;
static const stop_line stop_lines[] = STOP_LINES;
static const uint8_t direction[BOARD_JOINTS] = DIRECTION_PINS;

#define TIMERS (sizeof timers / sizeof timers[0])

_Static_assert(BOARD_JOINTS == TIMERS * PWM_CHANNELS, "each motor has a channel");

/* Return the compare register of a joint's PWM. */
static word *compare(uint32_t joint) { return &(&timers[joint / PWM_CHANNELS]->ccr1)[joint % PWM_CHANNELS]; }

static void timer_start(tim_registers *timer)
{
    timer->cr1 = TIM_CR1_CENTRE | TIM_CR1_ARPE;
    timer->arr = PWM_STEPS;
    timer->psc = 0u;
    timer->rcr = 0u; /* a new duty is taken at either end of the count: within 25 us */
    timer->ccr1 = 0u;
    timer->ccr2 = 0u;
    timer->ccr3 = 0u;
    timer->ccr4 = PWM_CHANNELS == 4u ? 0u : TRIGGER;
    timer->ccmr1 = PWM_PAIR;
    timer->ccmr2 = PWM_PAIR;
    timer->ccer = CHANNELS_ON;
    /* Idle outputs are low. Where all four channels drive motors another timer starts with this one and triggers. */
    timer->cr2 = PWM_CHANNELS == 4u ? TIM_CR2_TRGO_ENABLE : TIM_CR2_TRGO_OC4REF;
    timer->egr = TIM_EGR_UG;
    timer->bdtr = BRIDGE_OFF; /* locked: no erroneous write switches the break off again */
    timer->sr = 0u;
}

#ifdef TRIGGER_TIMER
/* The converter's trigger counts up once a period of the PWM, from the moment at which that begins at 0. */
static void trigger_start(void)
{
    RCC->apb1enr |= TRIGGER_CLOCK;
    (void)RCC->apb1enr;
    TRIGGER_TIMER->psc = 0u;
    TRIGGER_TIMER->arr = 2u * PWM_STEPS - 1u;
    TRIGGER_TIMER->ccr4 = 2u * PWM_STEPS - TRIGGER;
    TRIGGER_TIMER->ccmr2 = TIM_OC4_PWM2;
    TRIGGER_TIMER->ccer = TIM_CCER_CC4E; /* its pin is not connected to it */
    TRIGGER_TIMER->egr = TIM_EGR_UG;
    TRIGGER_TIMER->smcr = TIM_SMCR_TRIGGER;
}
#endif

void drives_start(void)
{
    RCC->apb2enr |= PWM_CLOCKS;
    (void)RCC->apb2enr;
    DBGMCU_APB2_FZ = FROZEN_APB2; /* a breakpoint stops the motors too */
    DBGMCU_APB1_FZ = FROZEN_APB1;
    for (uint32_t i = 0u; i < TIMERS; i++) {
        timer_start(timers[i]);
    }
#ifdef TRIGGER_TIMER
    trigger_start();
#endif
}

void drives_run(void)
{
    for (uint32_t i = 0u; i < TIMERS; i++) {
        timers[i]->sr = 0u; /* what the break inputs saw before the pins were theirs */
    }
    for (uint32_t i = 0u; i < TIMERS; i++) {
        timers[i]->cr1 |= TIM_CR1_CEN;
    }
}

/* Return the compare value of a duty: the output is high while the counter is below it, at PWM_STEPS always. */
static uint32_t steps(float duty)
{
    if (!number_finite(duty)) {
        return 0u;
    }
    return (uint32_t)(number_clamp(number_size(duty), 0.0f, 1.0f) * (float)PWM_STEPS + 0.5f);
}

/* Let the timers' outputs be what this register says of them. */
static void outputs(uint32_t bdtr)
{
    for (uint32_t i = 0u; i < TIMERS; i++) {
        timers[i]->bdtr = bdtr;
    }
}

void drives_write(const float duty[JOINTS])
{
    uint32_t directions = 0u;
    for (uint32_t joint = 0u; joint < BOARD_JOINTS; joint++) {
        directions |= BIT(direction[joint]) << (duty[joint] < 0.0f ? 0u : 16u); /* high backwards */
        *compare(joint) = steps(duty[joint]);
    }
    GPIOB->bsrr = directions; /* at once, the duty up to 25 us later: too short for a motor to feel */
    outputs(BRIDGE_OFF | TIM_BDTR_MOE);
    ENABLE_PORT->bsrr = BIT(ENABLE_PIN);
}

void drives_off(void)
{
    ENABLE_PORT->bsrr = BIT(ENABLE_PIN) << 16;
    outputs(BRIDGE_OFF);
    for (uint32_t joint = 0u; joint < BOARD_JOINTS; joint++) {
        *compare(joint) = 0u;
    }
}

/* Return whether a timer's break came since the last time, and forget it. */
static bool broken(tim_registers *timer)
{
    const bool was = (timer->sr & TIM_SR_BIF) != 0u;
    timer->sr = ~TIM_SR_BIF;
    return was;
}

bool drives_stopped(void)
{
    bool stopped = false;
    for (uint32_t i = 0u; i < TIMERS; i++) {
        stopped = broken(timers[i]) || stopped;
    }
    for (uint32_t i = 0u; i < sizeof stop_lines / sizeof stop_lines[0]; i++) {
        stopped = stopped || (stop_lines[i].port->idr & BIT(stop_lines[i].pin)) != 0u;
    }
    return stopped;
}
