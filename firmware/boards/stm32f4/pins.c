/* Which pin does what. docs/howto/add_a_board.md shows the same table, and a test holds them together. */
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
} pin;

static const pin pins[] = {
    {GPIOC, 9, OUTPUT, PULL_DOWN, 0}, /* enables all bridges */
    {GPIOA, 8, ALTERNATE, PULL_DOWN, 1},  /* PWM 1: TIM1_CH1 */
    {GPIOA, 9, ALTERNATE, PULL_DOWN, 1},  /* PWM 2: TIM1_CH2 */
    {GPIOA, 10, ALTERNATE, PULL_DOWN, 1}, /* PWM 3: TIM1_CH3 */
    {GPIOC, 6, ALTERNATE, PULL_DOWN, 3},  /* PWM 4: TIM8_CH1 */
    {GPIOC, 7, ALTERNATE, PULL_DOWN, 3},  /* PWM 5: TIM8_CH2 */
    {GPIOC, 8, ALTERNATE, PULL_DOWN, 3},  /* PWM 6: TIM8_CH3 */
    {GPIOB, 5, OUTPUT, PULL_DOWN, 0}, /* directions 1 to 6 */
    {GPIOB, 6, OUTPUT, PULL_DOWN, 0},
    {GPIOB, 7, OUTPUT, PULL_DOWN, 0},
    {GPIOB, 8, OUTPUT, PULL_DOWN, 0},
    {GPIOB, 9, OUTPUT, PULL_DOWN, 0},
    {GPIOB, 10, OUTPUT, PULL_DOWN, 0},
    {GPIOA, 6, ALTERNATE, PULL_UP, 3},  /* emergency stop: TIM8_BKIN */
    {GPIOB, 12, ALTERNATE, PULL_UP, 1}, /* emergency stop: TIM1_BKIN */
    {GPIOA, 2, ALTERNATE, FLOATING, 7}, /* USART2_TX */
    {GPIOA, 3, ALTERNATE, PULL_UP, 7},  /* USART2_RX */
    {GPIOC, 0, ANALOG, FLOATING, 0}, /* potentiometers 1 to 6 */
    {GPIOC, 1, ANALOG, FLOATING, 0},
    {GPIOC, 2, ANALOG, FLOATING, 0},
    {GPIOC, 3, ANALOG, FLOATING, 0},
    {GPIOC, 4, ANALOG, FLOATING, 0},
    {GPIOC, 5, ANALOG, FLOATING, 0},
    {GPIOA, 0, ANALOG, FLOATING, 0}, /* currents 1 to 6 */
    {GPIOA, 1, ANALOG, FLOATING, 0},
    {GPIOA, 4, ANALOG, FLOATING, 0},
    {GPIOA, 7, ANALOG, FLOATING, 0},
    {GPIOB, 0, ANALOG, FLOATING, 0},
    {GPIOB, 1, ANALOG, FLOATING, 0},
    {GPIOA, 5, ANALOG, FLOATING, 0}, /* supply */
};

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
    for (uint32_t i = 0u; i < sizeof pins / sizeof pins[0]; i++) {
        connect(&pins[i]);
    }
}

void pins_light_start(uint32_t led_pin)
{
    static gpio_registers *const ports[] = {GPIOA, GPIOB, GPIOC};
    const uint32_t port = led_pin / 16u - 1u; /* of 0 it is beyond them all */
    led_port = NULL;
    if (port >= sizeof ports / sizeof ports[0]) {
        return;
    }
    const pin led = {ports[port], (uint8_t)(led_pin % 16u), OUTPUT, FLOATING, 0};
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
