"""The Nucleo's PWM driver, register by register: duties, directions, switching off, and the emergency stop's line."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stm32f4_build import COMPILERS, fresh
from stm32f4_emulator import RAM

PWM_PINS = ("PA8", "PA9", "PA10", "PC6", "PC7", "PC8")
DIRECTION_PINS = ("PB2", "PB14", "PB15", "PB8", "PB9", "PB10")
ENABLE_PIN = "PC9"
COMPARE = (*(f"TIM1.CCR{i}" for i in (1, 2, 3)), *(f"TIM8.CCR{i}" for i in (1, 2, 3)))
STEPS = 4500  # 180 MHz / (2 * 20 kHz)
MOE = 1 << 15
AT = RAM + 64


def started(compiler):
    """A Nucleo whose PWM runs with the outputs off and the emergency stop's loop closed."""
    emulator = fresh(compiler)
    emulator.chip.inputs |= {"PA6": 0, "PB12": 0}
    emulator.power_up("clock_start", "drives_start", "pins_start", "drives_run")
    return emulator


@pytest.fixture(params=COMPILERS)
def emulator(request):
    return started(request.param)


@pytest.fixture(scope="module", params=COMPILERS)
def shared(request):
    """One for tests that leave nothing behind."""
    return started(request.param)


def drive(emulator, duties):
    emulator.uc.mem_write(AT, struct.pack("<6f", *duties))
    emulator.call("drives_write", AT)


def stopped(emulator) -> bool:
    return bool(emulator.call("drives_stopped") & 1)


def outputs(chip):
    return [chip.output(pin) for pin in PWM_PINS]


@pytest.mark.parametrize(
    ("duty", "compare"),
    [
        (0.0, 0),
        (-0.0, 0),
        (1e-5, 0),
        (1.2e-4, 1),  # 0.54 of a step
        (0.25, 1125),
        (0.5, 2250),
        (0.9999, 4500),
        (1.0, 4500),
        (1.5, 4500),
        (3e38, 4500),
        (math.nan, 0),
        (math.inf, 0),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_duty_becomes_a_compare_value_and_a_direction(shared, duty, compare, sign):
    chip = shared.chip
    drive(shared, [sign * duty] * 6)
    assert [chip[name] for name in COMPARE] == [compare] * 6
    backwards = sign * duty < 0.0
    assert [chip.output(pin) for pin in DIRECTION_PINS] == [float(backwards)] * 6
    assert outputs(chip) == [compare / STEPS] * 6
    assert chip.wrongs == []


@given(duties=st.lists(st.floats(-1.0, 1.0, width=32), min_size=6, max_size=6))
@settings(max_examples=30)
def test_every_joint_has_its_own_channel_and_pin(shared, duties):
    drive(shared, duties)
    steps = np.floor(np.abs(np.array(duties, np.float32)) * np.float32(STEPS) + np.float32(0.5))
    assert [shared.chip[name] for name in COMPARE] == steps.astype(int).tolist()
    assert [shared.chip.output(pin) for pin in DIRECTION_PINS] == [float(duty < 0.0) for duty in duties]
    assert shared.chip.wrongs == []


def test_the_new_duties_are_there_before_the_outputs_are_switched_on(emulator):
    chip, before = emulator.chip, len(emulator.chip.writes)
    drive(emulator, [0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
    order = [name for name, _ in chip.writes[before:]]
    assert sorted(order[:6]) == sorted(COMPARE)
    assert order[6:] == ["GPIOB.BSRR", "TIM1.BDTR", "TIM8.BDTR", "GPIOC.BSRR"]
    assert chip.output(ENABLE_PIN) == 1.0
    assert chip["TIM1.BDTR"] == chip["TIM8.BDTR"] == 0x3F00 | MOE


def test_off_is_off_at_once_and_on_begins_at_nothing(emulator):
    chip = emulator.chip
    drive(emulator, [0.8] * 6)
    before = len(chip.writes)
    emulator.call("drives_off")
    assert [name for name, _ in chip.writes[before : before + 3]] == ["GPIOC.BSRR", "TIM1.BDTR", "TIM8.BDTR"]
    assert chip.output(ENABLE_PIN) == 0.0
    assert not (chip["TIM1.BDTR"] | chip["TIM8.BDTR"]) & MOE
    assert outputs(chip) == [0.0] * 6
    assert [chip[name] for name in COMPARE] == [0] * 6
    assert chip.wrongs == []


@pytest.mark.parametrize("pin", ["PA6", "PB12"])
def test_an_open_line_stops_the_pwm_without_the_processor(emulator, pin):
    """Each of the two pins by itself: the timer it breaks falls, and the firmware hears of it."""
    chip = emulator.chip
    drive(emulator, [0.5] * 6)
    assert not stopped(emulator)
    chip.set_input(pin, 1)  # no instruction runs
    broken = {"PB12": slice(0, 3), "PA6": slice(3, 6)}[pin]
    assert outputs(chip)[broken] == [0.0] * 3
    assert stopped(emulator)


def test_drives_cannot_be_switched_on_while_the_line_is_open(emulator):
    chip = emulator.chip
    chip.set_input("PA6", 1)
    chip.set_input("PB12", 1)
    drive(emulator, [0.5] * 6)
    assert outputs(chip) == [0.0] * 6
    assert stopped(emulator)
    chip.set_input("PA6", 0)
    chip.set_input("PB12", 0)
    assert outputs(chip) == [0.0] * 6  # closing it again moves nothing


@pytest.mark.parametrize("pin", ["PA6", "PB12"])
def test_a_stop_shorter_than_a_tick_is_not_forgotten(emulator, pin):
    chip = emulator.chip
    drive(emulator, [0.5] * 6)
    chip.set_input(pin, 1)
    chip.set_input(pin, 0)
    assert stopped(emulator)
    assert not stopped(emulator)  # reported once


@pytest.mark.parametrize("compiler", COMPILERS)
def test_what_the_line_did_before_its_pins_were_connected_is_no_stop(compiler):
    emulator = fresh(compiler)
    emulator.chip.inputs |= {"PA6": 0, "PB12": 0}
    emulator.power_up("clock_start", "drives_start", "pins_start")
    emulator.chip["TIM1.SR"] |= 1 << 7
    emulator.chip["TIM8.SR"] |= 1 << 7
    emulator.call("drives_run")
    assert not stopped(emulator)


def test_a_cut_wire_is_a_stop(emulator):
    emulator.chip.inputs.clear()
    emulator.chip.breaks()
    assert stopped(emulator)
