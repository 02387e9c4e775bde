/* The Black Pill (WeAct, STM32F411CEU6): what the drivers of boards/stm32f4 reckon with there, and its pins for four
 * joints. docs/howto/blackpill.md has the pin table and the wiring; a test holds them together. */
#ifndef ARMSIGHT_CHIP_H
#define ARMSIGHT_CHIP_H

#include "registers.h"

#define BOARD_NAME "blackpill-f411ce"
#define BOARD_JOINTS 4u

/* Clocks: a crystal of 25 MHz (or 16 MHz of the internal oscillator) to 192 and down to 96, which gives 921600 baud to
 * 0.2%; 100 MHz would give 0.5%. */
#define PROCESSOR_HZ 96000000u
#define TIMER_HZ PROCESSOR_HZ
#define UART_HZ 96000000u      /* APB2 */
#define SPI_HZ 48000000u       /* APB1 */
#define ADC_HZ 24000000u       /* a quarter of APB2 */
#define HSE_MHZ 25u
#define HSE_IS_CRYSTAL 1u
#define PLL_HSE_M 25u
#define PLL_HSE_N 192u
#define PLL_HSI_M 8u
#define PLL_HSI_N 96u
#define OVER_DRIVE 0u
#define FLASH_WAIT_STATES 3u   /* 90 to 100 MHz at 2.7 V or more */
#define BUS_DIVIDERS RCC_CFGR_PPRE1_DIV2

/* Bridges: the one timer with a break input drives all four. TIM4 starts with it and triggers the converter. */
#define PWM_TIMERS {TIM1}
#define PWM_CLOCKS RCC_APB2ENR_TIM1
#define PWM_CHANNELS 4u
#define TRIGGER_TIMER TIM4
#define TRIGGER_CLOCK RCC_APB1ENR_TIM4
#define ENABLE_PORT GPIOB
#define ENABLE_PIN 2u
#define DIRECTION_PINS {1, 8, 9, 10} /* of port B */
#define STOP_LINES {{GPIOB, 12}}
#define FROZEN_APB1 (DBGMCU_IWDG | DBGMCU_TIM4)
#define FROZEN_APB2 DBGMCU_TIM1

#define ADC_CHANNELS {4, 5, 6, 7, 8, 0, 1, 2, 3}
#define ADC_TRIGGER ADC_CR2_EXTSEL_TIM4_CC4

/* Wire: USART1 with its streams of DMA2. */
#define WIRE USART1
#define WIRE_CLOCK apb2enr
#define WIRE_CLOCK_BIT RCC_APB2ENR_USART1
#define WIRE_DMA DMA2
#define WIRE_DMA_CLOCK RCC_AHB1ENR_DMA2
#define WIRE_RX 5u
#define WIRE_TX 7u

#define QUADRATURE_TIMERS {TIM2, TIM3}
#define QUADRATURE_INPUTS 2u
#define ENCODER_SPI SPI2
#define ENCODER_SPI_CLOCK RCC_APB1ENR_SPI2
#define SELECT_PORT GPIOA

/* X(port, pin, mode, pull, alternate function of the datasheet's table, user) */
#define PIN_LIST(X)                                                                 \
    X(GPIOB, 2, OUTPUT, PULL_DOWN, 0, ALWAYS)     /* enables all bridges */         \
    X(GPIOA, 8, ALTERNATE, PULL_DOWN, 1, ALWAYS)  /* PWM 1 to 4: TIM1_CH1 to CH4 */ \
    X(GPIOA, 9, ALTERNATE, PULL_DOWN, 1, ALWAYS)                                    \
    X(GPIOA, 10, ALTERNATE, PULL_DOWN, 1, ALWAYS)                                   \
    X(GPIOA, 11, ALTERNATE, PULL_DOWN, 1, ALWAYS)                                   \
    X(GPIOB, 1, OUTPUT, PULL_DOWN, 0, ALWAYS)     /* directions 1 to 4 */           \
    X(GPIOB, 8, OUTPUT, PULL_DOWN, 0, ALWAYS)                                       \
    X(GPIOB, 9, OUTPUT, PULL_DOWN, 0, ALWAYS)                                       \
    X(GPIOB, 10, OUTPUT, PULL_DOWN, 0, ALWAYS)                                      \
    X(GPIOB, 12, ALTERNATE, PULL_UP, 1, ALWAYS)   /* emergency stop: TIM1_BKIN */   \
    X(GPIOB, 6, ALTERNATE, FLOATING, 7, ALWAYS)   /* USART1_TX */                   \
    X(GPIOB, 7, ALTERNATE, PULL_UP, 7, ALWAYS)    /* USART1_RX */                   \
    X(GPIOA, 0, ANALOG, FLOATING, 0, ALWAYS)      /* potentiometers 1 to 4 */       \
    X(GPIOA, 1, ANALOG, FLOATING, 0, ALWAYS)                                        \
    X(GPIOA, 2, ANALOG, FLOATING, 0, ALWAYS)                                        \
    X(GPIOA, 3, ANALOG, FLOATING, 0, ALWAYS)                                        \
    X(GPIOA, 4, ANALOG, FLOATING, 0, ALWAYS)      /* currents 1 to 4 */             \
    X(GPIOA, 5, ANALOG, FLOATING, 0, ALWAYS)                                        \
    X(GPIOA, 6, ANALOG, FLOATING, 0, ALWAYS)                                        \
    X(GPIOA, 7, ANALOG, FLOATING, 0, ALWAYS)                                        \
    X(GPIOB, 0, ANALOG, FLOATING, 0, ALWAYS)      /* supply */                      \
    X(GPIOA, 15, ALTERNATE, PULL_UP, 1, 1)        /* quadrature 1: TIM2_CH1, CH2 */ \
    X(GPIOB, 3, ALTERNATE, PULL_UP, 1, 1)                                           \
    X(GPIOB, 4, ALTERNATE, PULL_UP, 2, 2)         /* quadrature 2: TIM3_CH1, CH2 */ \
    X(GPIOB, 5, ALTERNATE, PULL_UP, 2, 2)                                           \
    X(GPIOB, 13, ALTERNATE, FLOATING, 5, SPI)     /* SPI2_SCK, MISO, MOSI */        \
    X(GPIOB, 14, ALTERNATE, PULL_DOWN, 5, SPI)                                      \
    X(GPIOB, 15, ALTERNATE, FLOATING, 5, SPI)

#endif
