/* Pins: chip.h says which does what. */
#include <stddef.h>

#include "drivers.h"
#include "registers.h"

enum { INPUT = 0, OUTPUT = 1, ALTERNATE = 2, ANALOG = 3 };
enum { FLOATING = 0, PULL_UP = 1, PULL_DOWN = 2 };

typedef struct pin {
    gpio_registers *port;
    uint8_t number;
    uint8_t mode;
    uint8_t pull;
    uint8_t function; /* alternate function, of the datasheet's table */
    uint8_t user;
} pin;

#define PIN(port, number, mode, pull, function, user) {port, number, mode, pull, function, user},
static const pin pins[] = {PIN_LIST(PIN)};

static gpio_registers *led_port; /* of the sync LED; NULL without */

static void put(word *reg, uint32_t value, uint32_t bits, uint32_t number)
{
    *reg = (*reg & ~(((1u << bits) - 1u) << (bits * number))) | value << (bits * number);
}

/* What a pin will do comes before it does it: an output is low from its first moment on. */
static void connect(const pin *setup)
{
    gpio_registers *port = setup->port;
    put(&port->pupdr, setup->pull, 2u, setup->number);
    put(setup->number < 8u ? &port->afrl : &port->afrh, setup->function, 4u, setup->number % 8u);
    if (setup->mode == OUTPUT) {
        port->bsrr = BIT(setup->number) << 16;
    }
    put(&port->moder, setup->mode, 2u, setup->number);
}

void pins_start(void)
{
    RCC->ahb1enr |= RCC_AHB1ENR_GPIOA | RCC_AHB1ENR_GPIOB | RCC_AHB1ENR_GPIOC;
    (void)RCC->ahb1enr;
    pins_connect(ALWAYS);
}

void pins_connect(uint32_t user)
{
    for (uint32_t i = 0u; i < sizeof pins / sizeof pins[0]; i++) {
        if (pins[i].user == user) {
            connect(&pins[i]);
        }
    }
}

void pins_select_start(uint32_t joint)
{
    SELECT_PORT->bsrr = BIT(joint);
    put(&SELECT_PORT->moder, OUTPUT, 2u, joint);
}

void pins_light_start(uint32_t led_pin)
{
    static gpio_registers *const ports[] = {GPIOA, GPIOB, GPIOC};
    const uint32_t port = led_pin / 16u - 1u; /* of 0 it is beyond them all */
    led_port = NULL;
    if (port >= sizeof ports / sizeof ports[0]) {
        return;
    }
    const pin led = {ports[port], (uint8_t)(led_pin % 16u), OUTPUT, FLOATING, 0, ALWAYS};
    bool taken = led.port == GPIOA && (led.number == 13u || led.number == 14u); /* the debugger's */
    for (uint32_t i = 0u; i < sizeof pins / sizeof pins[0]; i++) {
        taken = taken || (pins[i].port == led.port && pins[i].number == led.number);
    }
    if (!taken) {
        connect(&led);
        led_port = led.port;
    }
}

void pins_light(uint32_t led_pin, bool on)
{
    if (led_port != NULL) {
        led_port->bsrr = BIT(led_pin % 16u) << (on ? 0u : 16u);
    }
}
