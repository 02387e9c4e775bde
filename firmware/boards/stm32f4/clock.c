/* 180 MHz: 8 MHz from the ST-Link (or 16 MHz of the internal oscillator) down to 2, up to 360, down to 180. */
#include "drivers.h"
#include "registers.h"

#define HSE_PATIENCE 20000u /* passes of a loop: about 10 ms; a clock that is there is there within microseconds */
#define PLL_IN_MHZ 2u       /* the manual's advice against jitter; 1 to 2 are allowed */
#define PLL_N 180u
#define PLL_FACTORS(in_mhz) ((in_mhz) / PLL_IN_MHZ | FIELD(PLL_N, 6) | FIELD(0, 16) | FIELD(8, 24) | FIELD(2, 28))

_Static_assert(PLL_IN_MHZ * PLL_N / 2u * 1000000u == PROCESSOR_HZ, "the PLL's output is halved");
_Static_assert(PLL_IN_MHZ * PLL_N >= 100u && PLL_IN_MHZ * PLL_N <= 432u, "the PLL's own range, MHz");

/* Wait until the supply suffices, and fail as soon as it no longer does: at 180 MHz the flash memory needs 2.7 V. */
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

static bool hse_start(void)
{
    RCC->cr |= RCC_CR_HSEBYP;
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
    RCC->pllcfgr = external ? PLL_FACTORS(8u) | RCC_PLLCFGR_SRC_HSE : PLL_FACTORS(16u);
    RCC->cr |= RCC_CR_PLLON;
    PWR->cr |= PWR_CR_ODEN; /* beyond 168 MHz: over-drive */
    while ((PWR->csr & PWR_CSR_ODRDY) == 0u) {
    }
    PWR->cr |= PWR_CR_ODSWEN;
    while ((PWR->csr & PWR_CSR_ODSWRDY) == 0u) {
    }
    FLASH->acr = FLASH_ACR_DCEN | FLASH_ACR_ICEN | FLASH_ACR_PRFTEN | FLASH_WAIT_STATES;
    while ((FLASH->acr & FLASH_ACR_LATENCY) != FLASH_WAIT_STATES) {
    }
    RCC->cfgr = RCC_CFGR_PPRE1_DIV4 | RCC_CFGR_PPRE2_DIV2;
    while ((RCC->cr & RCC_CR_PLLRDY) == 0u) {
    }
    RCC->cfgr |= RCC_CFGR_SW_PLL;
    while ((RCC->cfgr & RCC_CFGR_SWS_MASK) != RCC_CFGR_SWS_PLL) {
    }
    if (external) {
        RCC->cr |= RCC_CR_CSSON; /* a clock that fails then breaks the PWM by hardware, and interrupts */
    }
}
