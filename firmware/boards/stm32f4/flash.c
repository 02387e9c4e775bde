/* The two stored copies of the configuration: sectors 1 and 2 of the flash memory, 16 KB each. */
#include "drivers.h"
#include "registers.h"

#define FIRST_SECTOR 1u
#define FIRST_ADDRESS 0x08004000u
#define SECTOR_BYTES 0x4000u

_Static_assert(sizeof(config_copy) <= SECTOR_BYTES && sizeof(config_copy) % 4u == 0u, "whole words of one sector");

static uint32_t address(uint32_t which) { return FIRST_ADDRESS + which * SECTOR_BYTES; }

void flash_read(uint32_t which, config_copy *copy) { *copy = *(const config_copy *)(uintptr_t)address(which); }

static void settle(void)
{
    while ((FLASH->sr & FLASH_SR_BSY) != 0u) {
    }
}

static void erase(uint32_t sector)
{
    FLASH->cr = FLASH_CR_PSIZE_WORD | FLASH_CR_SNB(sector) | FLASH_CR_SER;
    FLASH->cr |= FLASH_CR_STRT;
    settle();
}

static void program(uint32_t at, const config_copy *copy)
{
    const uint32_t *from = (const uint32_t *)(const void *)copy;
    word *to = (word *)(uintptr_t)at;
    FLASH->cr = FLASH_CR_PSIZE_WORD | FLASH_CR_PG;
    for (uint32_t i = 0u; i < sizeof *copy / 4u; i++) {
        to[i] = from[i];
        settle();
    }
}

/* The data cache knows nothing of erasing: what it holds of the sector is old. */
static void cache_forget(void)
{
    FLASH->acr &= ~FLASH_ACR_DCEN;
    FLASH->acr |= FLASH_ACR_DCRST;
    FLASH->acr &= ~FLASH_ACR_DCRST;
    FLASH->acr |= FLASH_ACR_DCEN;
}

static bool reads(uint32_t at, const config_copy *copy)
{
    const uint32_t *source = (const uint32_t *)(const void *)copy;
    const word *there = (const word *)(uintptr_t)at;
    for (uint32_t i = 0u; i < sizeof *copy / 4u; i++) {
        if (there[i] != source[i]) {
            return false;
        }
    }
    return true;
}

bool flash_write(uint32_t which, const config_copy *copy)
{
    __asm__ volatile("cpsid i" ::: "memory"); /* none could be fetched while the memory is busy; one tick stays due */
    watchdog_set_long();
    settle();
    FLASH->keyr = FLASH_KEY1;
    FLASH->keyr = FLASH_KEY2;
    FLASH->sr = FLASH_SR_ERRORS;
    erase(FIRST_SECTOR + which);
    program(address(which), copy);
    FLASH->cr = FLASH_CR_LOCK;
    cache_forget();
    watchdog_set_short();
    __asm__ volatile("cpsie i" ::: "memory");
    return reads(address(which), copy);
}
