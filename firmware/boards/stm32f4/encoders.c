/* Encoders: a timer counts the edges of a quadrature one; absolute ones (AS5047) are on one SPI, each with a chip
 * select.
 *
 * A frame of SPI answers the one before it. Each tick asks for the angle first, which answers what was asked last in
 * the tick before, and then for the diagnosis, which answers with the angle: a fresh angle and a diagnosis one tick
 * old, in two frames. AS5047P datasheet, chapters 7.3 (frames, registers) and 5.6 (times). */
#include "encoder.h"

#include "drivers.h"
#include "registers.h"

#define ASK_ANGLE 0xFFFFu     /* read ANGLECOM, 0x3FFF: address, read bit, even parity */
#define ASK_DIAGNOSIS 0xFFFCu /* read DIAAGC, 0x3FFC */
#define ASK_ERRORS 0x4001u    /* read ERRFL, 0x0001, which clears it and the error bit of all frames */
#define ERROR_BIT 0x4000u
#define SETTLE_NS 350u /* chip select to clock, and how long it stays high between two frames */
#define PATIENCE 200u  /* passes of a loop until a frame is through: more than 10 us; one takes 3 */
#define WAKE_TRIES 20u /* a ms apart: an AS5047 answers 10 ms after its supply came */
#define LOOP_CLOCKS 3u /* at least, of a pass in pass_time */

_Static_assert(SPI_HZ / 8u <= 10000000u, "no faster than the encoder's clock may be");

static tim_registers *const timer[QUADRATURE_INPUTS] = QUADRATURE_TIMERS;
static encoder_config encoder[BOARD_JOINTS];
static uint32_t counted[BOARD_JOINTS]; /* by its timer since the start */
static uint32_t ask[BOARD_JOINTS];     /* what its second frame asks for */

/* Let at least so many clocks go by. */
static void pass_time(uint32_t clocks)
{
    uint32_t passes = clocks / LOOP_CLOCKS + 1u;
    __asm__ volatile("1: subs %0, %0, #1\n bne 1b" : "+r"(passes) : : "cc");
}

static void settle(void) { pass_time(PROCESSOR_HZ / 1000000u * SETTLE_NS / 1000u); }

/* Send a frame to a joint's encoder and return what came meanwhile; 0, which is not sound, where nothing did. */
static uint32_t exchange(uint32_t joint, uint32_t frame)
{
    uint32_t answer = 0u;
    SELECT_PORT->bsrr = BIT(joint) << 16;
    settle();
    (void)ENCODER_SPI->dr; /* what came too late for an earlier frame */
    ENCODER_SPI->dr = frame;
    for (uint32_t pass = 0u; pass < PATIENCE; pass++) {
        if ((ENCODER_SPI->sr & SPI_SR_RXNE) != 0u) {
            answer = ENCODER_SPI->dr & 0xFFFFu;
            break;
        }
    }
    settle();
    SELECT_PORT->bsrr = BIT(joint);
    settle();
    return answer;
}

static uint32_t read_frames(uint32_t joint)
{
    const uint32_t diagnosis = exchange(joint, ASK_ANGLE);
    const uint32_t angle = exchange(joint, ask[joint]);
    ask[joint] = (angle & ERROR_BIT) != 0u && ask[joint] != ASK_ERRORS ? ASK_ERRORS : ASK_DIAGNOSIS;
    return angle | diagnosis << 16;
}

/* Return the count of a joint's timer, which has 16 bits: of each tick its change. */
static uint32_t read_count(uint32_t joint)
{
    const uint32_t change = (timer[encoder[joint].input - 1u]->cnt - counted[joint]) & 0xFFFFu;
    counted[joint] += change < 0x8000u ? change : change - 0x10000u;
    return counted[joint];
}

static void quadrature_start(uint32_t input)
{
    tim_registers *const own = timer[input - 1u];
    RCC->apb1enr |= RCC_APB1ENR_TIM2 << (input - 1u);
    (void)RCC->apb1enr;
    own->arr = 0xFFFFu; /* TIM2 would have 32 bits */
    own->ccmr1 = TIM_IC_FILTERED;
    own->smcr = TIM_SMCR_ENCODER;
    own->cr1 = TIM_CR1_CEN;
    pins_connect(input);
}

static void spi_start(void)
{
    RCC->apb1enr |= ENCODER_SPI_CLOCK;
    (void)RCC->apb1enr;
    ENCODER_SPI->cr1 = SPI_CR1_CPHA | SPI_CR1_MSTR | SPI_CR1_DIV8 | SPI_CR1_SSI | SPI_CR1_SSM | SPI_CR1_DFF;
    ENCODER_SPI->cr1 |= SPI_CR1_SPE;
    pins_connect(SPI);
}

/* Read until it answers, or long enough. */
static void wake(uint32_t joint)
{
    for (uint32_t i = 0u; i < WAKE_TRIES && !encoder_frames_sound(read_frames(joint)); i++) {
        pass_time(PROCESSOR_HZ / 1000u);
    }
}

void encoders_start(const core_config *config)
{
    uint32_t absolute = 0u;
    for (uint32_t joint = 0u; joint < BOARD_JOINTS && joint < config->joint_count; joint++) {
        encoder[joint] = config->joint[joint].encoder;
        if (encoder[joint].sensor == SENSOR_QUADRATURE) {
            quadrature_start(encoder[joint].input);
            counted[joint] = 0u;
        } else if (encoder[joint].sensor == SENSOR_ABSOLUTE) {
            pins_select_start(joint); /* all of them before the first frame: one bus */
            ask[joint] = ASK_DIAGNOSIS;
            absolute |= BIT(joint);
        }
    }
    if (absolute != 0u) {
        spi_start();
    }
    for (uint32_t joint = 0u; joint < BOARD_JOINTS; joint++) {
        if ((absolute >> joint & 1u) != 0u) {
            wake(joint);
        }
    }
}

void encoders_read(core_inputs *inputs)
{
    for (uint32_t joint = 0u; joint < BOARD_JOINTS; joint++) {
        if (encoder[joint].sensor == SENSOR_QUADRATURE) {
            inputs->counts[joint] = read_count(joint);
        } else if (encoder[joint].sensor == SENSOR_ABSOLUTE) {
            inputs->counts[joint] = read_frames(joint);
        }
    }
}
