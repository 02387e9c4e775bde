"""From reset to the first tick on the Nucleo-F446RE: clocks, watchdog, pins, and what a fault does."""

import struct

import pytest
from stm32f4_build import COMPILERS, fresh, image
from stm32f4_emulator import FLASH, RAM
from stm32f4_registers import ADC_CHANNEL

from armsight.firmware.elf import read_elf

PWM_PINS = ("PA8", "PA9", "PA10", "PC6", "PC7", "PC8")
DIRECTION_PINS = ("PB5", "PB6", "PB7", "PB8", "PB9", "PB10")
ENABLE_PIN = "PC9"
INTERRUPTS = 97  # of the STM32F446, position 0 to 96


@pytest.fixture(params=COMPILERS)
def emulator(request):
    """A Nucleo before its reset, its emergency stop's loop closed."""
    emulator = fresh(request.param)
    emulator.chip.inputs |= {"PA6": 0, "PB12": 0}
    return emulator


@pytest.fixture
def booted(emulator):
    """The same, before the first tick."""
    emulator.boot()
    return emulator


@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_image_computes_in_hardware_and_fits(compiler, capsys):
    elf = read_elf(image(compiler))
    assert elf.hard_float
    with capsys.disabled():
        print(f"\nstm32f4 by {compiler}: {elf.flash_bytes} bytes of flash memory, {elf.ram_bytes} of RAM")
    assert elf.flash_bytes < 464 * 1024
    assert elf.ram_bytes < 112 * 1024


@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_image_leaves_the_stored_configurations_alone(compiler):
    """Sectors 1 and 2 (0x08004000 to 0x0800BFFF) hold them: nothing may be loaded there."""
    for segment in read_elf(image(compiler)).segments:
        end = segment.load_address + len(segment.data)
        assert end <= 0x08004000 or segment.load_address >= 0x0800C000


def test_the_boot_does_nothing_the_manual_forbids(booted):
    """The model checks: peripherals clocked, over-drive before them, wait states before the switch, locks, keys, flags."""
    assert booted.chip.wrongs == []


def test_the_clocks_are_what_the_drivers_reckon_with(booted):
    chip = booted.chip
    assert chip.sysclk() == 180e6
    assert (chip.apb1()[0], chip.apb2()[0]) == (45e6, 90e6)
    assert chip["FLASH.ACR"] == 0x705  # five wait states, prefetch, both caches
    assert (chip["SYSTICK.RVR"] + 1) / chip.sysclk() == 1e-3
    assert chip["SYSTICK.CSR"] == 7
    for timer in ("TIM1", "TIM8"):
        assert chip[f"{timer}.CR1"] >> 5 & 3 == 1  # centre-aligned: up and down once a period
        assert chip.apb2()[1] / (chip[f"{timer}.PSC"] + 1) / (2 * chip[f"{timer}.ARR"]) == 20e3
    # Of 3.75% that receiver and sender may differ by with ten bits a byte, the sender takes a tenth.
    assert abs(chip.apb1()[0] / chip["USART2.BRR"] / 921600 - 1) < 0.00375


def test_the_clock_security_watches_the_external_clock(booted):
    assert booted.chip["RCC.CR"] >> 19 & 1
    assert booted.chip["RCC.CR"] >> 18 & 1  # the ST-Link's clock, no crystal


def test_without_an_external_clock_it_runs_on_its_own(emulator):
    emulator.chip.external_clock = False
    emulator.boot()
    assert emulator.chip.wrongs == []
    assert emulator.chip.sysclk() == 180e6
    assert emulator.chip["RCC.CR"] >> 19 & 1 == 0
    assert emulator.chip["RCC.CR"] >> 16 & 1 == 0


def test_floating_point_comes_first_and_the_watchdog_before_what_could_hang(booted):
    chip = booted.chip
    assert [name for name, _ in chip.writes[:2]] == ["SCB.CPACR", "SCB.FPCCR"]
    assert chip["SCB.CPACR"] >> 20 == 0xF
    assert chip["SCB.FPCCR"] >> 30 == 3  # automatic and lazy
    assert chip.first("IWDG.KR") < chip.first("RCC.APB1ENR")


def test_the_watchdog_waits_long_while_it_starts_and_short_while_it_runs(booted):
    chip = booted.chip
    keys = [(name, value) for name, value in chip.writes if name.startswith("IWDG")]
    start, unlock, feed = 0xCCCC, 0x5555, 0xAAAA
    once = [("IWDG.KR", start), ("IWDG.KR", unlock)]
    assert keys == [
        *once,
        ("IWDG.PR", 3),
        ("IWDG.RLR", 1999),
        ("IWDG.KR", feed),
        *once,
        ("IWDG.PR", 0),
        ("IWDG.RLR", 79),
        ("IWDG.KR", feed),
    ]
    assert chip.watchdog_ms() == 10.0


def test_a_supply_that_falls_is_a_fault(booted):
    chip = booted.chip
    assert chip["PWR.CR"] >> 4 & 0xF == 0b1011  # on, level 5
    assert chip["EXTI.IMR"] == chip["EXTI.RTSR"] == 1 << 16
    assert chip["NVIC.ISER0"] == 1 << 1
    assert chip.first("EXTI.IMR") < chip.first("RCC.CFGR", 2)


def test_all_outputs_are_off_until_the_first_tick(booted):
    chip = booted.chip
    assert [chip.output(pin) for pin in (*PWM_PINS, *DIRECTION_PINS, ENABLE_PIN)] == [0.0] * 13
    assert not any(value >> 15 & 1 for timer in ("TIM1", "TIM8") for value in chip.written(f"{timer}.BDTR"))
    # Low before it is an output, and pulled low before that.
    odr, mode = chip.first("GPIOC.BSRR", 1 << 25), chip.first("GPIOC.MODER", 1 << 18)
    assert chip.first("GPIOC.PUPDR", 2 << 18) < odr < mode


def test_the_timers_are_locked_with_their_break_on(booted):
    for timer in ("TIM1", "TIM8"):
        assert booted.chip[f"{timer}.BDTR"] == 0x3F00  # no MOE, BKP high, BKE, OSSR, OSSI, lock level 3, no dead time
        assert booted.chip[f"{timer}.CR2"] >> 8 == 0  # idle outputs are low


def test_a_debugger_that_stops_the_processor_stops_the_motors(booted):
    assert booted.chip["DBGMCU.APB2_FZ"] == 3  # TIM1, TIM8
    assert booted.chip["DBGMCU.APB1_FZ"] == 1 << 12  # the watchdog with them


def test_every_pin_does_what_the_table_says(booted):
    chip = booted.chip
    assert [chip.function(pin) for pin in PWM_PINS] == [
        *(f"TIM1_CH{i}" for i in (1, 2, 3)),
        *(f"TIM8_CH{i}" for i in (1, 2, 3)),
    ]
    assert {chip.function(pin) for pin in (*DIRECTION_PINS, ENABLE_PIN)} == {"output"}
    assert (chip.function("PA6"), chip.function("PB12")) == ("TIM8_BKIN", "TIM1_BKIN")
    assert (chip.function("PA2"), chip.function("PA3")) == ("USART2_TX", "USART2_RX")
    assert {chip.function(pin) for pin in ADC_CHANNEL if pin not in ("PA2", "PA3", "PA6")} == {"analog"}
    assert (chip.function("PA13"), chip.function("PA14")) == ("nothing", "nothing")  # the debugger's: as after reset
    assert (chip["GPIOA.AFRH"] >> 20, chip["GPIOA.MODER"] >> 26) == (0, 0xA8000000 >> 26)


def test_an_open_emergency_stop_pulls_its_line_high(booted):
    booted.chip.inputs.clear()
    assert booted.chip.input("PA6") == booted.chip.input("PB12") == 1


def test_the_streams_write_where_the_program_looks(booted):
    chip, elf = booted.chip, booted.symbols
    assert chip["DMA2.S0NDTR"] == 16 * 13
    assert chip["DMA1.S5NDTR"] == 1024
    for stream in ("DMA2.S0", "DMA1.S5"):
        assert elf["bss_begin"] <= chip[f"{stream}M0AR"] < elf["bss_end"]
        assert chip[f"{stream}CR"] & 0x101 == 0x101  # runs, in a circle
        assert not chip[f"{stream}FCR"] & 4  # direct mode


def test_every_vector_leads_into_the_program(booted):
    """Reset, PendSV and SysTick have handlers of their own; everything else is a fault."""
    vectors = struct.unpack(f"<{16 + INTERRUPTS}I", booted.uc.mem_read(FLASH, 4 * (16 + INTERRUPTS)))
    own = {1: "reset", 14: "pendsv_interrupt", 15: "systick_interrupt"}
    assert vectors[0] % 8 == 0
    for number, address in enumerate(vectors[1:], start=1):
        assert address == booted.symbols[own.get(number, "fault")] | 1, number
    assert booted.chip["SCB.VTOR"] == FLASH


def test_the_stack_lies_below_all_variables(booted):
    """One that grows too far leaves the RAM, which faults, instead of writing over the controller."""
    top = booted.word(FLASH)
    assert RAM < top <= booted.symbols["data_begin"] <= booted.symbols["bss_begin"]
    assert booted.stack_used() < (top - RAM) // 2


@pytest.mark.parametrize("vector", [2, 3, 4, 5, 6, 16, 17, 112])
def test_a_fault_switches_the_drives_off_and_lets_the_watchdog_run_out(booted, vector):
    """Non-maskable (the clock failed), hard, memory, bus and usage faults, and any interrupt that has no handler."""
    chip = booted.chip
    booted.chip.scans(20)
    duties = struct.pack("<6f", 0.5, 0.5, 0.5, -0.5, -0.5, -0.5)
    booted.uc.mem_write(RAM + 64, duties)
    booted.call("drives_write", RAM + 64)
    assert chip.output(ENABLE_PIN) == 1.0
    fed, before = chip.fed, len(chip.writes)
    booted.run_into(vector, instructions=3000)
    assert [chip.output(pin) for pin in (*PWM_PINS, ENABLE_PIN)] == [0.0] * 7
    assert chip.fed == fed
    assert chip.writes[before][0] == "GPIOC.BSRR"  # the enable pin first
    assert chip.wrongs == []


def test_a_restart_by_the_watchdog_is_told_once(emulator):
    emulator.chip["RCC.CSR"] = 1 << 29 | 1 << 26
    emulator.power_up("watchdog_was_here")
    assert emulator.call("watchdog_was_here") == 0
    emulator.chip["RCC.CSR"] = 1 << 29
    assert emulator.call("watchdog_was_here") == 1
