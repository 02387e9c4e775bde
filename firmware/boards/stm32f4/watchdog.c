/* The independent watchdog: its own oscillator (32 kHz, anything from 17 to 47), and no way to stop it. */
#include "drivers.h"
#include "registers.h"

#define PRESCALE_4 0u
#define PRESCALE_32 3u

static void set(uint32_t prescale, uint32_t reload)
{
    IWDG->kr = IWDG_KEY_START;
    while (IWDG->sr != 0u) { /* an earlier change is still on its way to the slow side */
    }
    IWDG->kr = IWDG_KEY_UNLOCK;
    IWDG->pr = prescale;
    IWDG->rlr = reload;
    while (IWDG->sr != 0u) { /* feeding now would give it the old time */
    }
    IWDG->kr = IWDG_KEY_FEED; /* locks it again */
}

void watchdog_set_short(void) { set(PRESCALE_4, 80u - 1u); }

void watchdog_set_long(void) { set(PRESCALE_32, 2000u - 1u); }

void watchdog_feed(void) { IWDG->kr = IWDG_KEY_FEED; }

bool watchdog_was_here(void)
{
    const bool was = (RCC->csr & RCC_CSR_IWDGRSTF) != 0u;
    RCC->csr |= RCC_CSR_RMVF;
    return was;
}
