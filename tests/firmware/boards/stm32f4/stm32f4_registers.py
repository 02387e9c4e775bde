"""Where the registers of the STM32F446 and STM32F411 lie: their manuals' tables again, apart from the firmware's header."""

from dataclasses import dataclass


def _row(*names: str) -> dict[str, int]:
    """Return registers that follow one another, by their offset."""
    return {name: 4 * i for i, name in enumerate(names)}


_TIM_BASE = _row("CR1", "CR2", "SMCR", "DIER", "SR", "EGR", "CCMR1", "CCMR2", "CCER", "CNT", "PSC", "ARR", "RCR")
TIM = _TIM_BASE | {"CCR1": 0x34, "CCR2": 0x38, "CCR3": 0x3C, "CCR4": 0x40, "BDTR": 0x44}
GPIO = _row("MODER", "OTYPER", "OSPEEDR", "PUPDR", "IDR", "ODR", "BSRR", "LCKR", "AFRL", "AFRH")
DMA = _row("LISR", "HISR", "LIFCR", "HIFCR") | {
    f"S{stream}{name}": 0x10 + 0x18 * stream + offset
    for stream in range(8)
    for name, offset in _row("CR", "NDTR", "PAR", "M0AR", "M1AR", "FCR").items()
}

#: Peripheral: base address, registers by offset, and the bit that gives it its clock (none: always on).
PERIPHERALS = {
    "TIM2": (0x40000000, TIM, ("APB1ENR", 0)),
    "TIM3": (0x40000400, TIM, ("APB1ENR", 1)),
    "TIM4": (0x40000800, TIM, ("APB1ENR", 2)),
    "SPI2": (0x40003800, {"CR1": 0x0, "CR2": 0x4, "SR": 0x8, "DR": 0xC}, ("APB1ENR", 14)),
    "SPI3": (0x40003C00, {"CR1": 0x0, "CR2": 0x4, "SR": 0x8, "DR": 0xC}, ("APB1ENR", 15)),
    "PWR": (0x40007000, {"CR": 0x0, "CSR": 0x4}, ("APB1ENR", 28)),
    "IWDG": (0x40003000, {"KR": 0x0, "PR": 0x4, "RLR": 0x8, "SR": 0xC}, None),
    "USART2": (0x40004400, {"SR": 0x0, "DR": 0x4, "BRR": 0x8, "CR1": 0xC, "CR2": 0x10, "CR3": 0x14}, ("APB1ENR", 17)),
    "USART1": (0x40011000, {"SR": 0x0, "DR": 0x4, "BRR": 0x8, "CR1": 0xC, "CR2": 0x10, "CR3": 0x14}, ("APB2ENR", 4)),
    "TIM1": (0x40010000, TIM, ("APB2ENR", 0)),
    "TIM8": (0x40010400, TIM, ("APB2ENR", 1)),
    "ADC1": (
        0x40012000,
        {"SR": 0x0, "CR1": 0x4, "CR2": 0x8, "SMPR1": 0xC, "SMPR2": 0x10}
        | {"SQR1": 0x2C, "SQR2": 0x30, "SQR3": 0x34, "DR": 0x4C},
        ("APB2ENR", 8),
    ),
    "ADC": (0x40012300, {"CSR": 0x0, "CCR": 0x4}, ("APB2ENR", 8)),
    "EXTI": (0x40013C00, {"IMR": 0x0, "EMR": 0x4, "RTSR": 0x8, "FTSR": 0xC, "SWIER": 0x10, "PR": 0x14}, None),
    "GPIOA": (0x40020000, GPIO, ("AHB1ENR", 0)),
    "GPIOB": (0x40020400, GPIO, ("AHB1ENR", 1)),
    "GPIOC": (0x40020800, GPIO, ("AHB1ENR", 2)),
    "RCC": (
        0x40023800,
        {"CR": 0x0, "PLLCFGR": 0x4, "CFGR": 0x8, "CIR": 0xC}
        | {"AHB1ENR": 0x30, "AHB2ENR": 0x34, "AHB3ENR": 0x38, "APB1ENR": 0x40, "APB2ENR": 0x44, "CSR": 0x74},
        None,
    ),
    "FLASH": (0x40023C00, {"ACR": 0x0, "KEYR": 0x4, "OPTKEYR": 0x8, "SR": 0xC, "CR": 0x10, "OPTCR": 0x14}, None),
    "DMA1": (0x40026000, DMA, ("AHB1ENR", 21)),
    "DMA2": (0x40026400, DMA, ("AHB1ENR", 22)),
    "DBGMCU": (0xE0042000, {"APB1_FZ": 0x8, "APB2_FZ": 0xC}, None),
    "SYSTICK": (0xE000E010, {"CSR": 0x0, "RVR": 0x4, "CVR": 0x8}, None),
    "NVIC": (0xE000E100, {"ISER0": 0x0}, None),
    "SCB": (0xE000ED00, {"ICSR": 0x4, "VTOR": 0x8, "SHPR3": 0x20, "CFSR": 0x28, "CPACR": 0x88, "FPCCR": 0x234}, None),
}

#: What a register holds after a reset, where that is not 0.
RESET = {
    "RCC.CR": 0x83,
    "RCC.PLLCFGR": 0x24003010,
    "RCC.CSR": 0x0E000000,
    "PWR.CR": 0xC000,
    "FLASH.CR": 0x80000000,
    "GPIOA.MODER": 0xA8000000,
    "GPIOA.PUPDR": 0x64000000,
    "GPIOB.MODER": 0x280,
    "GPIOB.PUPDR": 0x100,
    "TIM1.ARR": 0xFFFF,
    "TIM8.ARR": 0xFFFF,
    "IWDG.RLR": 0xFFF,
    "SCB.FPCCR": 0xC0000000,
}

#: What an alternate function connects a pin to, of the datasheet's table.
ALTERNATE = {
    ("PA8", 1): "TIM1_CH1",
    ("PA9", 1): "TIM1_CH2",
    ("PA10", 1): "TIM1_CH3",
    ("PA11", 1): "TIM1_CH4",
    ("PC6", 3): "TIM8_CH1",
    ("PC7", 3): "TIM8_CH2",
    ("PC8", 3): "TIM8_CH3",
    ("PA6", 3): "TIM8_BKIN",
    ("PB12", 1): "TIM1_BKIN",
    ("PA2", 7): "USART2_TX",
    ("PA3", 7): "USART2_RX",
    ("PB6", 7): "USART1_TX",
    ("PB7", 7): "USART1_RX",
    ("PB13", 5): "SPI2_SCK",
    ("PB14", 5): "SPI2_MISO",
    ("PB15", 5): "SPI2_MOSI",
    ("PA15", 1): "TIM2_CH1",
    ("PB3", 1): "TIM2_CH2",
    ("PB4", 2): "TIM3_CH1",
    ("PB5", 2): "TIM3_CH2",
    ("PB6", 2): "TIM4_CH1",
    ("PB7", 2): "TIM4_CH2",
    ("PC10", 6): "SPI3_SCK",
    ("PC11", 6): "SPI3_MISO",
    ("PC12", 6): "SPI3_MOSI",
}

#: The converter's channel of each pin, of the datasheet's table.
ADC_CHANNEL = {f"PA{i}": i for i in range(8)} | {"PB0": 8, "PB1": 9} | {f"PC{i}": 10 + i for i in range(6)}

ADDRESS = {
    base + offset: f"{peripheral}.{name}"
    for peripheral, (base, registers, _) in PERIPHERALS.items()
    for name, offset in registers.items()
}
NAMED = {name: address for address, name in ADDRESS.items()}


@dataclass(frozen=True)
class Part:
    """What distinguishes a chip, on its board."""

    hse_hz: float  #: its external clock
    crystal: bool  #: whether that is a crystal, not a clock
    over_drive: bool  #: whether it has one, for more than 168 MHz
    most_hz: tuple[float, float, float]  #: processor, slow and fast bus
    flash_hz: tuple[float, ...]  #: up to which clock the flash memory needs 0, 1, ... wait states, at 2.7 V or more.
    breaks: tuple[tuple[str, str], ...]  #: timers with a break input, and the pin of it in use
    trigger: int  #: the converter's choice of trigger
    uart: tuple[str, str, str]  #: the wire, and its streams in and out
    absent: tuple[str, ...]  #: peripherals of the table above that it does not have


#: The Nucleo-F446RE and the Black Pill: RM0390 and RM0383, table of wait states and chapter 6.
NUCLEO = Part(
    hse_hz=8e6,
    crystal=False,
    over_drive=True,
    most_hz=(180e6, 45e6, 90e6),
    flash_hz=(30e6, 60e6, 90e6, 120e6, 150e6, 180e6),
    breaks=(("TIM1", "PB12"), ("TIM8", "PA6")),
    trigger=14,
    uart=("USART2", "DMA1.S5", "DMA1.S6"),
    absent=(),
)
BLACK_PILL = Part(
    hse_hz=25e6,
    crystal=True,
    over_drive=False,
    most_hz=(100e6, 50e6, 100e6),
    flash_hz=(30e6, 64e6, 90e6, 100e6),
    breaks=(("TIM1", "PB12"),),
    trigger=9,
    uart=("USART1", "DMA2.S5", "DMA2.S7"),
    absent=("TIM8",),
)
