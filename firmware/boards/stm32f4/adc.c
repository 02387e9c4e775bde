/* The converter: a timer starts a scan of all channels once a PWM period, DMA puts it into a ring of the last sixteen
 * scans. A tick adds up the ring, whichever scan is just being replaced: always the last sixteen of each channel. */
#include "drivers.h"
#include "registers.h"

#define CURRENT_FULL_MA 3000u  /* 3.3 V at the driver's 1.1 V/A */
#define SUPPLY_FULL_MV 69300u  /* 3.3 V behind a divider by 21 */
#define OPEN_COUNTS 65535u
#define STREAM (&DMA2->stream[0])

_Static_assert(CHANNELS * CONVERSION_CLOCKS < ADC_HZ / PWM_HZ, "a scan ends before the next one begins");
_Static_assert(SCANS < PWM_HZ / TICKS_PER_S, "all sixteen scans are younger than a tick");

/* Of each reading in a scan, the converter's channel. */
static const uint8_t channel[CHANNELS] = ADC_CHANNELS;
static volatile uint16_t ring[SCANS][CHANNELS];

static void scan_start(void)
{
    uint32_t sequence[3] = {0u, 0u, FIELD(CHANNELS - 1u, 20)};
    uint32_t sampling[2] = {0u, 0u};
    for (uint32_t i = 0u; i < CHANNELS; i++) {
        sequence[i / 6u] |= (uint32_t)channel[i] << (5u * (i % 6u));
        sampling[channel[i] / 10u] |= ADC_SMP_56 << (3u * (channel[i] % 10u));
    }
    ADC1->sqr3 = sequence[0];
    ADC1->sqr2 = sequence[1];
    ADC1->sqr1 = sequence[2];
    ADC1->smpr2 = sampling[0];
    ADC1->smpr1 = sampling[1];
    ADC1->cr1 = ADC_CR1_SCAN;
    ADC1->sr = 0u;
    ADC1->cr2 = ADC_CR2_EXTEN_RISING | ADC_TRIGGER | ADC_CR2_DDS | ADC_CR2_DMA | ADC_CR2_ADON;
}

static void ring_start(void)
{
    STREAM->cr = 0u;
    while ((STREAM->cr & DMA_CR_EN) != 0u) { /* it ends the transfer it is in */
    }
    DMA2->lifcr = DMA_FLAGS;
    STREAM->par = (uint32_t)(uintptr_t)&ADC1->dr;
    STREAM->m0ar = (uint32_t)(uintptr_t)ring;
    STREAM->ndtr = SCANS * CHANNELS;
    STREAM->cr = DMA_CR_PL(3u) | DMA_CR_MSIZE_HALF | DMA_CR_PSIZE_HALF | DMA_CR_MINC | DMA_CR_CIRC;
    STREAM->cr |= DMA_CR_EN;
}

void adc_start(void)
{
    RCC->ahb1enr |= RCC_AHB1ENR_DMA2;
    RCC->apb2enr |= RCC_APB2ENR_ADC1;
    (void)RCC->apb2enr;
    ADC1->cr2 = 0u;
    ADC_CCR = ADC_CCR_DIV4;
    ring_start();
    scan_start();
}

/* Return whether the ring went on since the last tick: it is half or wholly through every 0.4 ms. */
static bool alive(void)
{
    const uint32_t progress = DMA2->lisr & (DMA_HTIF | DMA_TCIF);
    DMA2->lifcr = progress;
    return progress != 0u;
}

void adc_read(core_inputs *inputs)
{
    const bool running = alive();
    uint32_t sum[CHANNELS] = {0u};
    for (uint32_t scan = 0u; scan < SCANS; scan++) {
        for (uint32_t i = 0u; i < CHANNELS; i++) {
            sum[i] += ring[scan][i];
        }
    }
    for (uint32_t joint = 0u; joint < BOARD_JOINTS; joint++) {
        inputs->current_ma[joint] = (int32_t)(sum[joint] * CURRENT_FULL_MA >> 16);
        inputs->counts[joint] = running ? sum[BOARD_JOINTS + 1u + joint] : OPEN_COUNTS;
    }
    inputs->supply_mv = running ? (uint32_t)((uint64_t)sum[BOARD_JOINTS] * SUPPLY_FULL_MV >> 16) : 0u;
    if (!running) {
        adc_start();
    }
}
