"""The Black Pill: the Nucleo's drivers with another header; what differs, and four joints against the core."""

import re
from pathlib import Path

import pytest
from firmware_build import board_image
from firmware_layout import c
from stm32f4_build import COMPILERS, fresh
from stm32f4_chip import AbsoluteSensor
from stm32f4_emulator import RAM
from stm32f4_registers import ADC_CHANNEL
from test_stm32f4_run import Nucleo, Wiring

from armsight.firmware.elf import read_elf
from armsight.robot.boards.configuration import USED_PINS

BOARD = "blackpill"
WIRING = Wiring(
    BOARD,
    ("PA8", "PA9", "PA10", "PA11"),
    ("PB1", "PB8", "PB9", "PB10"),
    ("PA0", "PA1", "PA2", "PA3"),
    "PB0",
    "PB2",
    2400,
)
COMPILER = COMPILERS[1]
PAGE = Path(__file__).resolve().parents[4] / "docs" / "howto" / "blackpill.md"


@pytest.fixture
def booted():
    emulator = fresh(COMPILER, BOARD)
    emulator.chip.inputs["PB12"] = 0
    emulator.boot()
    return emulator


def test_the_image_fits_and_its_boot_does_nothing_the_manual_forbids(booted):
    elf, chip = read_elf(board_image(BOARD, COMPILER)), booted.chip
    assert elf.hard_float
    assert all(
        segment.load_address + len(segment.data) <= 0x08004000 or segment.load_address >= 0x0800C000
        for segment in elf.segments
    )
    assert chip.wrongs == []
    assert chip["FLASH.ACR"] == 0x703
    assert (chip.sysclk(), chip.apb1()[0], chip.apb2()[0]) == (96e6, 48e6, 96e6)
    assert (chip["SYSTICK.RVR"] + 1) / chip.sysclk() == 1e-3
    assert chip.apb2()[1] / (2 * chip["TIM1.ARR"]) == 20e3
    assert abs(chip.apb2()[0] / chip["USART1.BRR"] / 921600 - 1) < 0.00375
    assert chip["RCC.CR"] >> 18 & 3 == 2  # a crystal, watched
    assert chip["TIM1.BDTR"] == 0x3F00
    assert (chip["DBGMCU.APB2_FZ"], chip["DBGMCU.APB1_FZ"]) == (1, 1 << 12 | 1 << 2)
    assert [chip.output(pin) for pin in (*WIRING.pwm, *WIRING.direction, WIRING.enable)] == [0.0] * 9


def test_without_its_crystal_it_runs_as_fast_on_its_own():
    emulator = fresh(COMPILER, BOARD)
    emulator.chip.external_clock = False
    emulator.boot()
    assert (emulator.chip.wrongs, emulator.chip.sysclk()) == ([], 96e6)


def test_the_currents_are_read_around_the_middle_of_the_pulses(booted):
    """TIM4 begins with TIM1 at a pulse's middle, and triggers half of the four conversions before the next one's."""
    chip = booted.chip
    four = 4 * (56 + 12) * chip.apb2()[0] / 24e6
    assert chip["TIM4.ARR"] + 1 - chip["TIM4.CCR4"] == four / 2
    assert chip.apb1()[1] == chip.apb2()[1]  # the two timers' clocks


def test_every_pin_does_what_the_documentation_says_and_no_other_is_touched(booted):
    rows = re.findall(r"^\| ([^|]+) \| (P[ABC]\d+) \| (\w+) \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    chip = booted.chip
    for user in (1, 2, 255):
        booted.call("pins_connect", user)
    assert len(rows) == 28
    for what, pin, peripheral in rows:
        analog = re.fullmatch(r"ADC1_IN(\d+)", peripheral)
        assert chip.function(pin) == ("analog" if analog else peripheral), what
        assert not analog or ADC_CHANNEL[pin] == int(analog[1])
    pins = {what: pin for what, pin, _ in rows}
    joints = range(1, 5)
    assert tuple(pins[f"PWM of joint {i}"] for i in joints) == WIRING.pwm
    assert tuple(pins[f"direction of joint {i}"] for i in joints) == WIRING.direction
    assert tuple(pins[f"potentiometer {i}"] for i in joints) == WIRING.pots
    scan = [f"current of joint {i}" for i in joints] + ["motor supply"] + [f"potentiometer {i}" for i in joints]
    assert chip.sequence() == [ADC_CHANNEL[pins[what]] for what in scan]
    others = {f"P{port}{i}" for port in "ABC" for i in range(16)} - set(pins.values())
    assert {chip.function(pin) for pin in others - {"PA13", "PA14"}} == {"input"}
    assert USED_PINS["blackpill-f411ce"] == {*pins.values(), "PA13", "PA14"}


def test_an_open_line_stops_the_pwm_without_the_processor(booted):
    booted.uc.mem_write(RAM + 64, bytes.fromhex("0000003f") * 6)
    booted.call("drives_write", RAM + 64)
    assert [booted.chip.output(pin) for pin in WIRING.pwm] == [0.5] * 4
    booted.chip.set_input("PB12", 1)
    assert [booted.chip.output(pin) for pin in WIRING.pwm] == [0.0] * 4
    assert booted.call("drives_stopped") & 1


def test_four_joints_run_as_the_core_does_bit_for_bit_and_six_are_no_configuration(library):
    """``run`` compares every tick's pins with the core on this computer, as the Nucleo's tests do."""
    board = Nucleo(COMPILER, library, wiring=WIRING)
    board.hello()
    (welcome,) = board.said["WELCOME"]
    has = (welcome.board, welcome.joints, welcome.sensors, welcome.quadrature_inputs, welcome.config_source)
    assert has == ("blackpill-f411ce", 4, 7, 2, c.CONFIG_NEWEST)
    board.command(c.COMMAND_ENABLE)
    for goal in (0.3, -0.2, 0.1):
        board.move(goal, 50)
        board.run(25)
        assert max(map(board.chip.output, WIRING.pwm)) > 0.02
        board.run(25)
    assert (board.arm.outputs.state, board.arm.outputs.faults) == (c.STATE_ENABLED, 0)
    board.chip.set_input("PB12", 1)
    board.run(3)
    assert board.arm.outputs.state == board.status.state == c.STATE_STOPPED
    six = Nucleo(COMPILER, library, wiring=WIRING, joints=6)
    six.hello()
    assert six.said["WELCOME"][0].config_source == c.CONFIG_FACTORY


def test_its_encoders_read_on_its_own_timers_and_spi(booted):
    sensor = AbsoluteSensor(1234)
    booted.chip.sensors["PA2"] = sensor
    config = c.core_config()
    config.joint_count = 4
    for joint, (kind, which) in {0: (1, 2), 1: (1, 1), 2: (2, 0)}.items():
        config.joint[joint].encoder = c.encoder_config(kind, which, 4000.0, 1, 0, 0.0)
    booted.uc.mem_write(RAM + 64, bytes(config))
    booted.call("encoders_start", RAM + 64)
    booted.chip.count("TIM2", -7)
    booted.chip.count("TIM3", 9)
    booted.call("encoders_read", RAM + 64)
    inputs = c.core_inputs.from_buffer_copy(booted.uc.mem_read(RAM + 64, len(bytes(c.core_inputs()))))
    assert list(inputs.counts[:2]) == [9, 2**32 - 7]
    assert inputs.counts[2] & 0x3FFF == 1234
    assert booted.chip.wrongs == []
