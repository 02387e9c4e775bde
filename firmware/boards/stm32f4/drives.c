/* Six bridges with a PWM, a direction and a common enable pin: TIM1 and TIM8, 20 kHz, centre-aligned.
 *
 * Both timers' break inputs are on the emergency stop's line: the PWM falls without the processor's help. A break stays
 * until drives_write, which does nothing while the line is open. */
#include "drivers.h"
#include "number.h"
#include "registers.h"

#define ENABLE_PIN 9u          /* PC9 */
#define DIRECTION_PINS 5u      /* PB5 to PB10 */
#define STOP_A BIT(6)          /* PA6, TIM8's break */
#define STOP_B BIT(12)         /* PB12, TIM1's */
#define CHANNELS_ON 0x111u     /* CC1E, CC2E, CC3E */
#define PWM_PAIR (TIM_OC_PWM1_PRELOAD | FIELD(TIM_OC_PWM1_PRELOAD, 8))
#define BRIDGE_OFF (TIM_BDTR_LOCK3 | TIM_BDTR_OSSI | TIM_BDTR_OSSR | TIM_BDTR_BKE | TIM_BDTR_BKP)
/* The currents are read while the counter is near 0, a pulse's middle: half of the six conversions before it. */
#define TRIGGER (3u * CONVERSION_CLOCKS * (TIMER_HZ / ADC_HZ))

_Static_assert(PWM_STEPS <= 0xFFFFu, "the counter has 16 bits");
_Static_assert(TRIGGER < PWM_STEPS, "the trigger is within a period");

static word *const compare[JOINTS] = {&TIM1->ccr1, &TIM1->ccr2, &TIM1->ccr3, &TIM8->ccr1, &TIM8->ccr2, &TIM8->ccr3};

static void timer_start(tim_registers *timer)
{
    timer->cr1 = TIM_CR1_CENTRE | TIM_CR1_ARPE;
    timer->arr = PWM_STEPS;
    timer->psc = 0u;
    timer->rcr = 0u; /* a new duty is taken at either end of the count: within 25 us */
    timer->ccr1 = 0u;
    timer->ccr2 = 0u;
    timer->ccr3 = 0u;
    timer->ccr4 = TRIGGER;
    timer->ccmr1 = PWM_PAIR;
    timer->ccmr2 = PWM_PAIR;
    timer->ccer = CHANNELS_ON;
    timer->cr2 = TIM_CR2_TRGO_OC4REF; /* idle outputs are low; TIM8's trigger is the converter's */
    timer->egr = TIM_EGR_UG;
    timer->bdtr = BRIDGE_OFF; /* locked: no erroneous write switches the break off again */
    timer->sr = 0u;
}

void drives_start(void)
{
    RCC->apb2enr |= RCC_APB2ENR_TIM1 | RCC_APB2ENR_TIM8;
    (void)RCC->apb2enr;
    DBGMCU_APB2_FZ = DBGMCU_TIM1 | DBGMCU_TIM8; /* a breakpoint stops the motors too */
    DBGMCU_APB1_FZ = DBGMCU_IWDG;
    timer_start(TIM1);
    timer_start(TIM8);
}

void drives_run(void)
{
    TIM1->sr = 0u; /* what the break inputs saw before the pins were theirs */
    TIM8->sr = 0u;
    TIM1->cr1 |= TIM_CR1_CEN;
    TIM8->cr1 |= TIM_CR1_CEN;
}

/* Return the compare value of a duty: the output is high while the counter is below it, at PWM_STEPS always. */
static uint32_t steps(float duty)
{
    if (!number_finite(duty)) {
        return 0u;
    }
    return (uint32_t)(number_clamp(number_size(duty), 0.0f, 1.0f) * (float)PWM_STEPS + 0.5f);
}

void drives_write(const float duty[JOINTS])
{
    uint32_t directions = 0u;
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        directions |= BIT(DIRECTION_PINS + joint) << (duty[joint] < 0.0f ? 0u : 16u); /* high backwards */
        *compare[joint] = steps(duty[joint]);
    }
    GPIOB->bsrr = directions; /* at once, the duty up to 25 us later: too short for a motor to feel */
    TIM1->bdtr = BRIDGE_OFF | TIM_BDTR_MOE;
    TIM8->bdtr = BRIDGE_OFF | TIM_BDTR_MOE;
    GPIOC->bsrr = BIT(ENABLE_PIN);
}

void drives_off(void)
{
    GPIOC->bsrr = BIT(ENABLE_PIN) << 16;
    TIM1->bdtr = BRIDGE_OFF;
    TIM8->bdtr = BRIDGE_OFF;
    for (uint32_t joint = 0u; joint < JOINTS; joint++) {
        *compare[joint] = 0u;
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
    const bool first = broken(TIM1);
    const bool second = broken(TIM8);
    return first || second || (GPIOA->idr & STOP_A) != 0u || (GPIOB->idr & STOP_B) != 0u;
}
