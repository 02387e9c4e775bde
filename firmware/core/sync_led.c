#include "sync_led.h"

bool sync_led_on(const core_config *config, uint32_t tick)
{
    static const uint32_t code[16] = { /* bit 0 of word 0 is first */
        0xE8FBC1FFu, 0x8B72904Cu, 0x8951B3E7u, 0x2323AB63u, 0x72188402u, 0x3B2F61AAu,
        0x37E5A851u, 0xCAC9FB49u, 0x2C53180Cu, 0x9AE345FDu, 0xB05DF1E6u, 0xBEB41BB6u,
        0xE9EA502Au, 0x5E4B9C0Eu, 0xA1CC2457u, 0x07B859B7u};
    const uint32_t bit = tick / config->sync_led_ticks % SYNC_LED_BITS;
    return config->sync_led_pin != 0u && (code[bit / 32u] >> bit % 32u & 1u) != 0u;
}
