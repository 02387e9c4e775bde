/* The registers of the STM32F446 and STM32F411 that the boards use. Names are the reference manuals' (RM0390, whose
 * chapters are named; RM0383 has the same) in lower case; the processor's own are ARMv7-M's. A gap named reserved keeps
 * the offsets. */
#ifndef ARMSIGHT_STM32F4_REGISTERS_H
#define ARMSIGHT_STM32F4_REGISTERS_H

#include <stdint.h>

#define BIT(n) (1u << (n))
#define FIELD(value, n) ((uint32_t)(value) << (n))

typedef volatile uint32_t word;

/* RM0390 chapter 3, embedded flash memory interface. */
typedef struct flash_registers {
    word acr, keyr, optkeyr, sr, cr, optcr;
} flash_registers;
#define FLASH ((flash_registers *)0x40023C00u)
#define FLASH_ACR_LATENCY 0xFu
#define FLASH_ACR_PRFTEN BIT(8)
#define FLASH_ACR_ICEN BIT(9)
#define FLASH_ACR_DCEN BIT(10)
#define FLASH_ACR_DCRST BIT(12)
#define FLASH_KEY1 0x45670123u
#define FLASH_KEY2 0xCDEF89ABu
#define FLASH_SR_ERRORS 0x1F2u /* OPERR, WRPERR, PGAERR, PGPERR, PGSERR, RDERR: each cleared by writing 1 */
#define FLASH_SR_BSY BIT(16)
#define FLASH_CR_PG BIT(0)
#define FLASH_CR_SER BIT(1)
#define FLASH_CR_SNB(sector) FIELD(sector, 3)
#define FLASH_CR_PSIZE_WORD FIELD(2, 8) /* 32 bits at a time: 2.7 V or more */
#define FLASH_CR_STRT BIT(16)
#define FLASH_CR_LOCK BIT(31)

/* RM0390 chapter 5, power control. */
typedef struct pwr_registers {
    word cr, csr;
} pwr_registers;
#define PWR ((pwr_registers *)0x40007000u)
#define PWR_CR_PVDE BIT(4)
#define PWR_CR_PLS(level) FIELD(level, 5)
#define PWR_CR_VOS_SCALE1 FIELD(3, 14)
#define PWR_CR_ODEN BIT(16)
#define PWR_CR_ODSWEN BIT(17)
#define PWR_CSR_PVDO BIT(2)
#define PWR_CSR_ODRDY BIT(16)
#define PWR_CSR_ODSWRDY BIT(17)

/* RM0390 chapter 6, reset and clock control. */
typedef struct rcc_registers {
    word cr, pllcfgr, cfgr, cir, ahb1rstr, ahb2rstr, ahb3rstr, reserved0, apb1rstr, apb2rstr, reserved1[2];
    word ahb1enr, ahb2enr, ahb3enr, reserved2, apb1enr, apb2enr, reserved3[10], bdcr, csr;
} rcc_registers;
#define RCC ((rcc_registers *)0x40023800u)
#define RCC_CR_HSEON BIT(16)
#define RCC_CR_HSERDY BIT(17)
#define RCC_CR_HSEBYP BIT(18)
#define RCC_CR_CSSON BIT(19)
#define RCC_CR_PLLON BIT(24)
#define RCC_CR_PLLRDY BIT(25)
#define RCC_PLLCFGR_SRC_HSE BIT(22)
#define RCC_CFGR_SW_PLL 2u
#define RCC_CFGR_SWS_PLL FIELD(2, 2)
#define RCC_CFGR_SWS_MASK FIELD(3, 2)
#define RCC_CFGR_PPRE1_DIV2 FIELD(4, 10)
#define RCC_CFGR_PPRE1_DIV4 FIELD(5, 10)
#define RCC_CFGR_PPRE2_DIV2 FIELD(4, 13)
#define RCC_AHB1ENR_GPIOA BIT(0)
#define RCC_AHB1ENR_GPIOB BIT(1)
#define RCC_AHB1ENR_GPIOC BIT(2)
#define RCC_AHB1ENR_DMA1 BIT(21)
#define RCC_AHB1ENR_DMA2 BIT(22)
#define RCC_APB1ENR_TIM2 BIT(0) /* 3 and 4 follow */
#define RCC_APB1ENR_TIM4 BIT(2)
#define RCC_APB1ENR_SPI2 BIT(14)
#define RCC_APB1ENR_SPI3 BIT(15)
#define RCC_APB1ENR_USART2 BIT(17)
#define RCC_APB1ENR_PWR BIT(28)
#define RCC_APB2ENR_TIM1 BIT(0)
#define RCC_APB2ENR_TIM8 BIT(1)
#define RCC_APB2ENR_USART1 BIT(4)
#define RCC_APB2ENR_ADC1 BIT(8)
#define RCC_CSR_RMVF BIT(24)
#define RCC_CSR_IWDGRSTF BIT(29)

/* RM0390 chapter 7, general purpose pins. */
typedef struct gpio_registers {
    word moder, otyper, ospeedr, pupdr, idr, odr, bsrr, lckr, afrl, afrh;
} gpio_registers;
#define GPIOA ((gpio_registers *)0x40020000u)
#define GPIOB ((gpio_registers *)0x40020400u)
#define GPIOC ((gpio_registers *)0x40020800u)

/* RM0390 chapter 9, direct memory access: two controllers of eight streams. */
typedef struct dma_stream {
    word cr, ndtr, par, m0ar, m1ar, fcr;
} dma_stream;
typedef struct dma_registers {
    word lisr, hisr, lifcr, hifcr;
    dma_stream stream[8];
} dma_registers;
#define DMA1 ((dma_registers *)0x40026000u)
#define DMA2 ((dma_registers *)0x40026400u)
#define DMA_CR_EN BIT(0)
#define DMA_CR_FROM_MEMORY FIELD(1, 6)
#define DMA_CR_CIRC BIT(8)
#define DMA_CR_MINC BIT(10)
#define DMA_CR_PSIZE_HALF FIELD(1, 11)
#define DMA_CR_MSIZE_HALF FIELD(1, 13)
#define DMA_CR_PL(priority) FIELD(priority, 16)
#define DMA_CR_CHSEL(channel) FIELD(channel, 25)
#define DMA_HTIF BIT(4) /* half of the transfer; streams 0 and 4; 1 and 5 six bits further, 2 and 6 sixteen, 3 and 7
                           22 */
#define DMA_TCIF BIT(5) /* the whole of it */
#define DMA_FLAGS 0x3Du /* all five */

/* RM0390 chapter 10, external interrupts. */
typedef struct exti_registers {
    word imr, emr, rtsr, ftsr, swier, pr;
} exti_registers;
#define EXTI ((exti_registers *)0x40013C00u)
#define EXTI_PVD BIT(16)

/* RM0390 chapter 13, analogue to digital converter. */
typedef struct adc_registers {
    word sr, cr1, cr2, smpr1, smpr2, jofr[4], htr, ltr, sqr1, sqr2, sqr3, jsqr, jdr[4], dr;
} adc_registers;
#define ADC1 ((adc_registers *)0x40012000u)
#define ADC_CCR (*(word *)0x40012304u)
#define ADC_CCR_DIV4 FIELD(1, 16)
#define ADC_CR1_SCAN BIT(8)
#define ADC_CR2_ADON BIT(0)
#define ADC_CR2_DMA BIT(8)
#define ADC_CR2_DDS BIT(9)
#define ADC_CR2_EXTSEL_TIM4_CC4 FIELD(9, 24)
#define ADC_CR2_EXTSEL_TIM8_TRGO FIELD(14, 24)
#define ADC_CR2_EXTEN_RISING FIELD(1, 28)
#define ADC_SMP_56 3u /* sampling for 56 of its clocks; a conversion takes 12 more */

/* RM0390 chapters 16 and 17, timers. */
typedef struct tim_registers {
    word cr1, cr2, smcr, dier, sr, egr, ccmr1, ccmr2, ccer, cnt, psc, arr, rcr, ccr1, ccr2, ccr3, ccr4, bdtr;
} tim_registers;
#define TIM2 ((tim_registers *)0x40000000u)
#define TIM3 ((tim_registers *)0x40000400u)
#define TIM4 ((tim_registers *)0x40000800u)
#define TIM1 ((tim_registers *)0x40010000u)
#define TIM8 ((tim_registers *)0x40010400u)
#define TIM_CR1_CEN BIT(0)
#define TIM_CR1_CENTRE FIELD(1, 5)
#define TIM_CR1_ARPE BIT(7)
#define TIM_CR2_TRGO_ENABLE FIELD(1, 4)
#define TIM_CR2_TRGO_OC4REF FIELD(7, 4)
#define TIM_SMCR_ENCODER 3u /* counts the edges of both inputs */
#define TIM_SMCR_TRIGGER 6u /* starts with another timer: of TIM4's, its first is TIM1 */
#define TIM_SR_BIF BIT(7)
#define TIM_EGR_UG BIT(0)
#define TIM_OC_PWM1_PRELOAD FIELD(0xD, 3) /* OCxM = 110, OCxPE = 1; the upper channel eight bits further */
#define TIM_OC4_PWM2 FIELD(7, 12) /* high from its compare value on */
#define TIM_CCER_CC4E BIT(12)
#define TIM_IC_FILTERED 0x8181u /* channels 1 and 2 are inputs; what lasts 6 times 8 clocks is an edge */
#define TIM_BDTR_LOCK3 FIELD(3, 8)
#define TIM_BDTR_OSSI BIT(10)
#define TIM_BDTR_OSSR BIT(11)
#define TIM_BDTR_BKE BIT(12)
#define TIM_BDTR_BKP BIT(13)
#define TIM_BDTR_MOE BIT(15)

/* RM0390 chapter 25, USART. */
typedef struct usart_registers {
    word sr, dr, brr, cr1, cr2, cr3, gtpr;
} usart_registers;
#define USART1 ((usart_registers *)0x40011000u)
#define USART2 ((usart_registers *)0x40004400u)
#define USART_SR_ORE BIT(3)
#define USART_CR1_RE BIT(2)
#define USART_CR1_TE BIT(3)
#define USART_CR1_UE BIT(13)
#define USART_CR3_DMAR BIT(6)
#define USART_CR3_DMAT BIT(7)

/* RM0390 chapter 26, SPI. */
typedef struct spi_registers {
    word cr1, cr2, sr, dr;
} spi_registers;
#define SPI2 ((spi_registers *)0x40003800u)
#define SPI3 ((spi_registers *)0x40003C00u)
#define SPI_CR1_CPHA BIT(0)
#define SPI_CR1_MSTR BIT(2)
#define SPI_CR1_DIV8 FIELD(2, 3)
#define SPI_CR1_SPE BIT(6)
#define SPI_CR1_SSI BIT(8)
#define SPI_CR1_SSM BIT(9)
#define SPI_CR1_DFF BIT(11) /* 16 bits */
#define SPI_SR_RXNE BIT(0)

/* RM0390 chapter 20, independent watchdog. */
typedef struct iwdg_registers {
    word kr, pr, rlr, sr;
} iwdg_registers;
#define IWDG ((iwdg_registers *)0x40003000u)
#define IWDG_KEY_FEED 0xAAAAu
#define IWDG_KEY_UNLOCK 0x5555u
#define IWDG_KEY_START 0xCCCCu

/* RM0390 chapter 33, what stands still while a debugger has stopped the processor. */
#define DBGMCU_APB1_FZ (*(word *)0xE0042008u)
#define DBGMCU_APB2_FZ (*(word *)0xE004200Cu)
#define DBGMCU_TIM4 BIT(2)
#define DBGMCU_IWDG BIT(12)
#define DBGMCU_TIM1 BIT(0)
#define DBGMCU_TIM8 BIT(1)

/* ARMv7-M B3: system timer, interrupt controller, system control, floating point. */
typedef struct systick_registers {
    word csr, rvr, cvr;
} systick_registers;
#define SYSTICK ((systick_registers *)0xE000E010u)
#define SYSTICK_CSR_ENABLE BIT(0)
#define SYSTICK_CSR_TICKINT BIT(1)
#define SYSTICK_CSR_PROCESSOR BIT(2)
#define NVIC_ISER0 (*(word *)0xE000E100u)
#define IRQ_PVD 1u
#define SCB_ICSR (*(word *)0xE000ED04u)
#define SCB_ICSR_PENDSVSET BIT(28)
#define SCB_AIRCR (*(word *)0xE000ED0Cu)
#define SCB_AIRCR_RESET (FIELD(0x5FA, 16) | BIT(2)) /* key, SYSRESETREQ */
#define SCB_VTOR (*(word *)0xE000ED08u)
#define SCB_CFSR (*(word *)0xE000ED28u)
#define SCB_SHPR3 (*(word *)0xE000ED20u)
#define SCB_CPACR (*(word *)0xE000ED88u)
#define SCB_CPACR_FPU FIELD(0xF, 20)
#define FPU_FPCCR (*(word *)0xE000EF34u)
#define FPU_FPCCR_ASPEN BIT(31)
#define FPU_FPCCR_LSPEN BIT(30)

#endif
