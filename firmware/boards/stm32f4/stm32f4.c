/* An STM32F4 as a board: what the common loop asks for, and the tick's timer.
 *
 * SysTick counts milliseconds and asks for PendSV, which has the lowest priority and runs the tick: so a tick that
 * takes too long is seen while it runs, and no millisecond goes uncounted. The main loop serves the wire. Floats are
 * used by PendSV and the main loop; the processor keeps stack space for its registers on entry and fills it only where
 * both do (lazy stacking, its default). */
#include "drivers.h"
#include "loop.h"
#include "registers.h"
#include "start.h"

static board_loop loop;
static volatile uint32_t ticks;
static volatile uint32_t overruns;
static volatile uint32_t running;
static uint32_t overruns_reported;
static crash_record last_crash;

static void sense(core_inputs *inputs)
{
    const uint32_t seen = overruns;
    inputs->tick = ticks;
    inputs->overrun = seen - overruns_reported;
    overruns_reported = seen;
    inputs->stop_pressed = drives_stopped() ? 1u : 0u;
    adc_read(inputs);
    encoders_read(inputs);
}

static void drive(const core_outputs *outputs)
{
    if (outputs->drives_on != 0u || outputs->windings_shorted != 0u) {
        drives_write(outputs->duty);
    } else {
        drives_off();
    }
}

static uint32_t reset_cause(void)
{
    const bool crashed = crash_was_here(&last_crash);
    const bool watchdog = watchdog_was_here();
    return crashed ? RESET_CRASH : watchdog ? RESET_WATCHDOG : RESET_POWER;
}

static void crash(crash_record *record) { *record = last_crash; }

static void restart(void)
{
    drives_off();
    SCB_AIRCR = SCB_AIRCR_RESET;
    for (;;) { /* it takes a few clocks */
    }
}

static const board_description board = {
    .name = BOARD_NAME,
    .baud = UART_BAUD,
    .abilities = {BOARD_JOINTS, 1u << SENSOR_POTENTIOMETER | 1u << SENSOR_QUADRATURE | 1u << SENSOR_ABSOLUTE,
                  QUADRATURE_INPUTS},
    .sense = sense,
    .drive = drive,
    .feed_watchdog = watchdog_feed,
    .reset_cause = reset_cause,
    .crash = crash,
    .receive = uart_receive,
    .send = uart_send,
    .read_copy = flash_read,
    .write_copy = flash_write,
    .restart = restart,
    .light = pins_light,
};

void systick_interrupt(void)
{
    ticks++;
    if (running != 0u) {
        overruns++;
    }
    SCB_ICSR = SCB_ICSR_PENDSVSET;
}

void pendsv_interrupt(void)
{
    running = 1u;
    loop_tick(&loop);
    running = 0u;
}

static void ticks_start(void)
{
    SCB_SHPR3 = FIELD(0xF0, 16); /* PendSV last, SysTick first */
    SYSTICK->rvr = PROCESSOR_HZ / TICKS_PER_S - 1u;
    SYSTICK->cvr = 0u;
    SYSTICK->csr = SYSTICK_CSR_PROCESSOR | SYSTICK_CSR_TICKINT | SYSTICK_CSR_ENABLE;
}

void board_main(void)
{
    watchdog_set_long();
    clock_start();
    drives_start();
    pins_start();
    adc_start();
    uart_start();
    loop_start(&loop, &board);
    encoders_start(&loop.core.config);
    pins_light_start(loop.core.config.sync_led_pin);
    drives_run();
    watchdog_set_short();
    ticks_start();
    for (;;) {
        loop_poll(&loop);
    }
}
