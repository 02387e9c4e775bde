/* The serial port: DMA writes what comes into a ring, and sends what goes out piece by piece. */
#include "drivers.h"
#include "registers.h"

#define RX_BYTES 1024u
#define TX_BYTES 256u
#define RX_STREAM (&WIRE_DMA->stream[WIRE_RX])
#define TX_STREAM (&WIRE_DMA->stream[WIRE_TX])
#define SHIFT(stream) (((stream) - 4u) % 2u * 6u + ((stream) - 4u) / 2u * 16u) /* of its flags in hisr and hifcr */
#define RX_SHIFT SHIFT(WIRE_RX)
#define TX_SHIFT SHIFT(WIRE_TX)
#define CHANNEL 4u /* the serial port's on both streams */
#define DIVIDER ((UART_HZ + UART_BAUD / 2u) / UART_BAUD) /* sixteen samples a bit */

_Static_assert(UART_BAUD / 10u / TICKS_PER_S * 10u < RX_BYTES, "ten ticks' bytes fit into the ring");

static volatile uint8_t rx[RX_BYTES];
static uint32_t rx_taken; /* where the next byte to take lies */
static volatile uint8_t tx[TX_BYTES];

static void stream_start(dma_stream *stream, volatile uint8_t *memory, uint32_t bytes, uint32_t mode)
{
    stream->par = (uint32_t)(uintptr_t)&WIRE->dr;
    stream->m0ar = (uint32_t)(uintptr_t)memory;
    stream->ndtr = bytes;
    stream->cr = DMA_CR_CHSEL(CHANNEL) | DMA_CR_PL(2u) | DMA_CR_MINC | mode;
    stream->cr |= DMA_CR_EN;
}

void uart_start(void)
{
    RCC->ahb1enr |= WIRE_DMA_CLOCK;
    RCC->WIRE_CLOCK |= WIRE_CLOCK_BIT;
    (void)RCC->WIRE_CLOCK;
    WIRE->brr = DIVIDER;
    WIRE->cr3 = USART_CR3_DMAR | USART_CR3_DMAT;
    stream_start(RX_STREAM, rx, RX_BYTES, DMA_CR_CIRC);
    WIRE->cr1 = USART_CR1_UE | USART_CR1_TE | USART_CR1_RE;
}

/* Return where the stream writes next, and add what was lost because nobody took it in time to *overrun. */
static uint32_t rx_position(uint32_t *overrun)
{
    const bool wrapped = (WIRE_DMA->hisr >> RX_SHIFT & DMA_TCIF) != 0u; /* before the position */
    const uint32_t position = (RX_BYTES - RX_STREAM->ndtr) % RX_BYTES;
    if (wrapped || position < rx_taken) {
        WIRE_DMA->hifcr = DMA_TCIF << RX_SHIFT;
    }
    if (wrapped && position >= rx_taken) { /* it came round, and past a byte not taken yet */
        *overrun += RX_BYTES;
        rx_taken = position;
    }
    if ((WIRE->sr & USART_SR_ORE) != 0u) {
        (void)WIRE->dr; /* after sr: clears it */
        *overrun += 1u;
    }
    return position;
}

uint32_t uart_receive(uint8_t *bytes, uint32_t room, uint32_t *overrun)
{
    const uint32_t position = rx_position(overrun);
    uint32_t count = 0u;
    while (count < room && rx_taken != position) {
        bytes[count++] = rx[rx_taken];
        rx_taken = (rx_taken + 1u) % RX_BYTES;
    }
    return count;
}

uint32_t uart_send(const uint8_t *bytes, uint32_t length)
{
    if (length == 0u || (TX_STREAM->cr & DMA_CR_EN) != 0u) { /* it clears the bit by itself when all are sent */
        return 0u;
    }
    uint32_t taken = 0u;
    while (taken < length && taken < TX_BYTES) {
        tx[taken] = bytes[taken];
        taken++;
    }
    WIRE_DMA->hifcr = DMA_FLAGS << TX_SHIFT;
    stream_start(TX_STREAM, tx, taken, DMA_CR_FROM_MEMORY);
    return taken;
}
