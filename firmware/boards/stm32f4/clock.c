/* The external clock (or 16 MHz of the internal oscillator) down to what the PLL takes, up to twice the processor's
 * speed, and half of that. */
#include "drivers.h"
#include "registers.h"

#define HSE_PATIENCE 20000u /* passes of a loop: about 10 ms; a clock that is there is there within microseconds */
#define PLL_FACTORS(m, n) ((m) | FIELD(n, 6) | FIELD(0, 16) | FIELD(8, 24) | FIELD(2, 28))
#define HALF_MHZ(mhz, m, n) ((mhz) * (n) / (m) / 2u)

_Static_assert(HALF_MHZ(HSE_MHZ, PLL_HSE_M, PLL_HSE_N) * 1000000u == PROCESSOR_HZ, "the PLL's output is halved");
_Static_assert(HALF_MHZ(16u, PLL_HSI_M, PLL_HSI_N) * 1000000u == PROCESSOR_HZ, "without the external clock too");

/* Wait until the supply suffices, and fail as soon as it no longer does: at this speed the flash memory needs 2.7 V. */
static void watch_supply(void)
{
    PWR->cr = PWR_CR_VOS_SCALE1 | PWR_CR_PLS(5u) | PWR_CR_PVDE; /* falls at 2.82 V */
    while ((PWR->csr & PWR_CSR_PVDO) != 0u) {
    }
    EXTI->rtsr = EXTI_PVD; /* PVDO rises when the supply falls */
    EXTI->pr = EXTI_PVD;
    EXTI->imr = EXTI_PVD;
    NVIC_ISER0 = BIT(IRQ_PVD);
}

/* Let the regulator give what the highest speeds need. */
static void over_drive(void)
{
    PWR->cr |= PWR_CR_ODEN;
    while ((PWR->csr & PWR_CSR_ODRDY) == 0u) {
    }
    PWR->cr |= PWR_CR_ODSWEN;
    while ((PWR->csr & PWR_CSR_ODSWRDY) == 0u) {
    }
}

static bool hse_start(void)
{
    if (HSE_IS_CRYSTAL == 0u) {
        RCC->cr |= RCC_CR_HSEBYP;
    }
    RCC->cr |= RCC_CR_HSEON;
    for (uint32_t pass = 0u; pass < HSE_PATIENCE; pass++) {
        if ((RCC->cr & RCC_CR_HSERDY) != 0u) {
            return true;
        }
    }
    RCC->cr &= ~RCC_CR_HSEON;
    return false;
}

void clock_start(void)
{
    RCC->apb1enr = RCC_APB1ENR_PWR;
    (void)RCC->apb1enr; /* a peripheral answers two of its bus's clocks after it got them */
    watch_supply();
    const bool external = hse_start();
    RCC->pllcfgr = external ? PLL_FACTORS(PLL_HSE_M, PLL_HSE_N) | RCC_PLLCFGR_SRC_HSE
                            : PLL_FACTORS(PLL_HSI_M, PLL_HSI_N);
    RCC->cr |= RCC_CR_PLLON;
    if (OVER_DRIVE != 0u) {
        over_drive();
    }
    FLASH->acr = FLASH_ACR_DCEN | FLASH_ACR_ICEN | FLASH_ACR_PRFTEN | FLASH_WAIT_STATES;
    while ((FLASH->acr & FLASH_ACR_LATENCY) != FLASH_WAIT_STATES) {
    }
    RCC->cfgr = BUS_DIVIDERS;
    while ((RCC->cr & RCC_CR_PLLRDY) == 0u) {
    }
    RCC->cfgr |= RCC_CFGR_SW_PLL;
    while ((RCC->cfgr & RCC_CFGR_SWS_MASK) != RCC_CFGR_SWS_PLL) {
    }
    if (external) {
        RCC->cr |= RCC_CR_CSSON; /* a clock that fails then breaks the PWM by hardware, and interrupts */
    }
}
