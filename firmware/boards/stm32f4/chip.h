/* What the Nucleo-F446RE's drivers reckon with, and its pins. docs/howto/nucleo.md has the pin table and the wiring;
 * a test holds them together. Boards of the same family have a header of this name with the same definitions. */
#ifndef ARMSIGHT_CHIP_H
#define ARMSIGHT_CHIP_H

#include "registers.h"

#define BOARD_NAME "nucleo-f446re"
#define BOARD_JOINTS 6u

/* Clocks: 8 MHz from the ST-Link (or 16 MHz of the internal oscillator) down to 2, up to 360, down to 180. */
#define PROCESSOR_HZ 180000000u
#define TIMER_HZ PROCESSOR_HZ  /* of the PWM timers: twice their bus, which is half the processor's */
#define UART_HZ 45000000u      /* of the wire's bus, APB1 */
#define SPI_HZ 45000000u       /* of the encoders' bus, APB1 */
#define ADC_HZ 22500000u       /* a quarter of the converter's bus, APB2 */
#define HSE_MHZ 8u
#define HSE_IS_CRYSTAL 0u      /* the ST-Link's clock comes as it is */
#define PLL_HSE_M 4u           /* 2 MHz into the PLL: the manual's advice against jitter; 1 to 2 are allowed */
#define PLL_HSE_N 180u
#define PLL_HSI_M 8u
#define PLL_HSI_N 180u
#define OVER_DRIVE 1u          /* needed beyond 168 MHz */
#define FLASH_WAIT_STATES 5u   /* 150 to 180 MHz at 2.7 V or more */
#define BUS_DIVIDERS (RCC_CFGR_PPRE1_DIV4 | RCC_CFGR_PPRE2_DIV2)

/* Bridges. */
#define PWM_TIMERS {TIM1, TIM8}
#define PWM_CLOCKS (RCC_APB2ENR_TIM1 | RCC_APB2ENR_TIM8)
#define PWM_CHANNELS 3u        /* of each timer that drive a motor */
#define ENABLE_PORT GPIOC
#define ENABLE_PIN 9u
#define DIRECTION_PINS {2, 14, 15, 8, 9, 10} /* of port B */
#define STOP_LINES {{GPIOA, 6}, {GPIOB, 12}} /* the timers' break inputs */
#define FROZEN_APB1 DBGMCU_IWDG
#define FROZEN_APB2 (DBGMCU_TIM1 | DBGMCU_TIM8)

/* Converter: its channels of the currents, the supply, the potentiometers; TIM8's fourth channel starts a scan. */
#define ADC_CHANNELS {0, 1, 4, 7, 8, 9, 5, 10, 11, 12, 13, 14, 15}
#define ADC_TRIGGER ADC_CR2_EXTSEL_TIM8_TRGO

/* Wire: USART2, the ST-Link's serial port; its streams of DMA1. */
#define WIRE USART2
#define WIRE_CLOCK apb1enr
#define WIRE_CLOCK_BIT RCC_APB1ENR_USART2
#define WIRE_DMA DMA1
#define WIRE_DMA_CLOCK RCC_AHB1ENR_DMA1
#define WIRE_RX 5u
#define WIRE_TX 6u

/* Encoders. */
#define QUADRATURE_TIMERS {TIM2, TIM3, TIM4}
#define QUADRATURE_INPUTS 3u
#define ENCODER_SPI SPI3
#define ENCODER_SPI_CLOCK RCC_APB1ENR_SPI3
#define SELECT_PORT GPIOC      /* a joint's pin there selects its absolute encoder, or is its potentiometer's */

/* X(port, pin, mode, pull, alternate function of the datasheet's table, user) */
#define PIN_LIST(X)                                                                   \
    X(GPIOC, 9, OUTPUT, PULL_DOWN, 0, ALWAYS)     /* enables all bridges */           \
    X(GPIOA, 8, ALTERNATE, PULL_DOWN, 1, ALWAYS)  /* PWM 1: TIM1_CH1 */               \
    X(GPIOA, 9, ALTERNATE, PULL_DOWN, 1, ALWAYS)  /* PWM 2: TIM1_CH2 */               \
    X(GPIOA, 10, ALTERNATE, PULL_DOWN, 1, ALWAYS) /* PWM 3: TIM1_CH3 */               \
    X(GPIOC, 6, ALTERNATE, PULL_DOWN, 3, ALWAYS)  /* PWM 4: TIM8_CH1 */               \
    X(GPIOC, 7, ALTERNATE, PULL_DOWN, 3, ALWAYS)  /* PWM 5: TIM8_CH2 */               \
    X(GPIOC, 8, ALTERNATE, PULL_DOWN, 3, ALWAYS)  /* PWM 6: TIM8_CH3 */               \
    X(GPIOB, 2, OUTPUT, PULL_DOWN, 0, ALWAYS)     /* directions 1 to 6 */             \
    X(GPIOB, 14, OUTPUT, PULL_DOWN, 0, ALWAYS)                                        \
    X(GPIOB, 15, OUTPUT, PULL_DOWN, 0, ALWAYS)                                        \
    X(GPIOB, 8, OUTPUT, PULL_DOWN, 0, ALWAYS)                                         \
    X(GPIOB, 9, OUTPUT, PULL_DOWN, 0, ALWAYS)                                         \
    X(GPIOB, 10, OUTPUT, PULL_DOWN, 0, ALWAYS)                                        \
    X(GPIOA, 6, ALTERNATE, PULL_UP, 3, ALWAYS)    /* emergency stop: TIM8_BKIN */     \
    X(GPIOB, 12, ALTERNATE, PULL_UP, 1, ALWAYS)   /* emergency stop: TIM1_BKIN */     \
    X(GPIOA, 2, ALTERNATE, FLOATING, 7, ALWAYS)   /* USART2_TX */                     \
    X(GPIOA, 3, ALTERNATE, PULL_UP, 7, ALWAYS)    /* USART2_RX */                     \
    X(GPIOC, 0, ANALOG, FLOATING, 0, ALWAYS)      /* potentiometers 1 to 6 */         \
    X(GPIOC, 1, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOC, 2, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOC, 3, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOC, 4, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOC, 5, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOA, 0, ANALOG, FLOATING, 0, ALWAYS)      /* currents 1 to 6 */               \
    X(GPIOA, 1, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOA, 4, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOA, 7, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOB, 0, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOB, 1, ANALOG, FLOATING, 0, ALWAYS)                                          \
    X(GPIOA, 5, ANALOG, FLOATING, 0, ALWAYS)      /* supply */                        \
    X(GPIOA, 15, ALTERNATE, PULL_UP, 1, 1)        /* quadrature 1: TIM2_CH1, CH2 */   \
    X(GPIOB, 3, ALTERNATE, PULL_UP, 1, 1)                                             \
    X(GPIOB, 4, ALTERNATE, PULL_UP, 2, 2)         /* quadrature 2: TIM3_CH1, CH2 */   \
    X(GPIOB, 5, ALTERNATE, PULL_UP, 2, 2)                                             \
    X(GPIOB, 6, ALTERNATE, PULL_UP, 2, 3)         /* quadrature 3: TIM4_CH1, CH2 */   \
    X(GPIOB, 7, ALTERNATE, PULL_UP, 2, 3)                                             \
    X(GPIOC, 10, ALTERNATE, FLOATING, 6, SPI)     /* SPI3_SCK, MISO, MOSI */          \
    X(GPIOC, 11, ALTERNATE, PULL_DOWN, 6, SPI)                                        \
    X(GPIOC, 12, ALTERNATE, FLOATING, 6, SPI)

#endif
