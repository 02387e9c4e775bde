"""From reset to the first tick on the Nucleo-F446RE: clocks, watchdog, pins, and what a fault does."""

import ast
import re
import struct
from pathlib import Path

import pytest
from firmware_build import board_image
from stm32f4_build import COMPILERS, fresh
from stm32f4_emulator import FLASH, RAM
from stm32f4_registers import ADC_CHANNEL
from unicorn.arm_const import UC_ARM_REG_SP

from armsight.firmware.elf import read_elf

ROOT = Path(__file__).resolve().parents[4]
PWM_PINS = ("PA8", "PA9", "PA10", "PC6", "PC7", "PC8")
DIRECTION_PINS = ("PB2", "PB14", "PB15", "PB8", "PB9", "PB10")
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
    elf = read_elf(board_image("stm32f4", compiler))
    assert elf.hard_float
    with capsys.disabled():
        print(f"\nstm32f4 by {compiler}: {elf.flash_bytes} bytes of flash memory, {elf.ram_bytes} of RAM")
    assert elf.flash_bytes < 464 * 1024
    assert elf.ram_bytes < 112 * 1024


@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_image_leaves_the_stored_configurations_alone(compiler):
    """Sectors 1 and 2 (0x08004000 to 0x0800BFFF) hold them: nothing may be loaded there."""
    for segment in read_elf(board_image("stm32f4", compiler)).segments:
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


def test_the_tick_can_be_interrupted_by_its_timer_and_interrupts_nothing_else(booted):
    """PendSV, which runs it, has the lowest priority; SysTick, which counts, the highest."""
    assert booted.chip["SCB.SHPR3"] == 0xF0 << 16


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


def documented() -> list[tuple[str, str, str, str]]:
    """Return what, pin, connector and peripheral of each row of the documentation's pin table."""
    text = (ROOT / "docs" / "reference" / "nucleo_pins.md").read_text(encoding="utf-8")
    return re.findall(r"^\| ([^|]+) \| (P[ABC]\d+) \| ([^|]+) \| [^|]*\| (\w+) \|$", text, flags=re.MULTILINE)


def test_every_pin_does_what_the_documentation_says(booted):
    chip, rows = booted.chip, documented()
    for user in (1, 2, 3, 255):
        booted.call("pins_connect", user)  # as a configuration with encoders lets it
    assert len(rows) == 39
    for what, pin, _, peripheral in rows:
        analog = re.fullmatch(r"ADC1_IN(\d+)", peripheral)
        assert chip.function(pin) == ("analog" if analog else peripheral), what
        assert not analog or ADC_CHANNEL[pin] == int(analog[1])
    pins = {what: pin for what, pin, _, _ in rows}
    joints = range(1, 7)
    assert [pins[f"PWM of joint {i}"] for i in joints] == list(PWM_PINS)
    assert [pins[f"direction of joint {i}"] for i in joints] == list(DIRECTION_PINS)
    scan = [f"current of joint {i}" for i in joints] + ["motor supply"] + [f"potentiometer {i}" for i in joints]
    assert chip.sequence() == [ADC_CHANNEL[pins[what]] for what in scan]


def test_no_other_pin_is_touched(booted):
    """The debugger's are as after reset, and everything else is a floating input."""
    used = {pin for _, pin, _, _ in documented()}
    after_reset = {"PA13": "nothing", "PA14": "nothing", "PA15": "nothing", "PB3": "nothing", "PB4": "nothing"}
    for pin in (f"P{port}{i}" for port in "ABC" for i in range(16)):
        if pin not in used:
            assert booted.chip.function(pin) == after_reset.get(pin, "input"), pin


def test_the_wiring_picture_shows_the_same_pins():
    script = (ROOT / "docs" / "images" / "wiring.py").read_text(encoding="utf-8")
    plotted = ast.literal_eval(re.search(r"^JOINTS = (\(.*?^\))", script, flags=re.DOTALL | re.MULTILINE)[1])
    socket = {what: (pin, connector) for what, pin, connector, _ in documented()}
    for joint, *shown in plotted:
        expected = ("potentiometer {}", "PWM of joint {}", "direction of joint {}", "current of joint {}")
        assert [tuple(pin.split()) for pin in shown] == [socket[what.format(joint)] for what in expected]
    for what, said in (("motor supply", "supply"), ("emergency stop", "stop"), ("enable of all bridges", "enable")):
        assert f"{said}: {socket[what][0]}  {socket[what][1]}" in script
    for what, said in (("direction of joint 1", "DIR 1"), ("PWM of joint 1", "PWM 1"), ("current of joint 1", "CS 1")):
        assert f"{said}: {socket[what][0]}" in script


def test_the_currents_are_read_around_the_middle_of_the_pulses(booted):
    """The trigger comes half of their six conversions before the counter's 0, which is where a pulse has its middle."""
    chip = booted.chip
    converter = chip.apb2()[0] / (2, 4, 6, 8)[chip["ADC.CCR"] >> 16 & 3]
    six_s = sum(chip.sampling(channel) + 12 for channel in chip.sequence()[:6]) / converter
    assert chip["TIM8.CCR4"] / chip.apb2()[1] == pytest.approx(six_s / 2, rel=1e-12)
    assert chip["TIM8.CR2"] >> 4 & 7 == 7  # OC4REF is the trigger


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
    booted.uc.reg_write(UC_ARM_REG_SP, RAM)  # at worst the stack has left the RAM
    booted.run_into(vector, instructions=3000)
    assert [chip.output(pin) for pin in (*PWM_PINS, ENABLE_PIN)] == [0.0] * 7
    assert chip.fed == fed
    assert chip.writes[before][0] == "GPIOC.BSRR"  # the enable pin first
    assert chip.wrongs == []


def test_where_it_crashed_is_kept_over_the_reset_and_reported_once(booted):
    stack, pc, lr = booted.word(FLASH) - 256, 0x0800C2A4, 0x0800C100
    booted.uc.mem_write(stack, struct.pack("<8I", 0, 0, 0, 0, 0, lr, pc, 0))
    booted.chip["SCB.CFSR"] = 0x82  # a data access without a memory there
    booted.uc.reg_write(UC_ARM_REG_SP, stack)
    booted.run_into(4, instructions=3000)
    booted.power_up("memory_start")
    record = RAM + 64
    assert booted.call("crash_was_here", record) == 1
    assert struct.unpack("<3I", booted.uc.mem_read(record + 4, 12)) == (pc, lr, 0x82)
    assert booted.call("crash_was_here", record) == 0
    assert bytes(booted.uc.mem_read(record, 16)) == bytes(16)


def test_a_restart_by_the_watchdog_is_reported_once(emulator):
    emulator.chip["RCC.CSR"] = 1 << 29 | 1 << 26
    emulator.power_up("watchdog_was_here")
    assert emulator.call("watchdog_was_here") == 0
    emulator.chip["RCC.CSR"] = 1 << 29
    assert emulator.call("watchdog_was_here") == 1
