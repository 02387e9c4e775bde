"""Encoders in the core: an AS5047's frames, counts to angle, what is not plausible, and the zero of a quadrature one."""

import ctypes
import math

import pytest
from firmware_arm import LabArm, lab_config
from firmware_layout import c
from hypothesis import given
from hypothesis import strategies as st

CONFIRM = 5
GOOD = 0x0180  # DIAAGC: offsets compensated, gain in the middle


def frame(data, *, error=False):
    """What an AS5047 answers: a parity that makes the ones even, its error bit, 14 bits."""
    bits = data | error << 14
    return bits | (bin(bits).count("1") % 2) << 15


def reading(angle, diagnosis=GOOD, **error):
    return frame(angle, **error) | frame(diagnosis) << 16


def encoder_joint(sensor, *, counts_per_rev=16384.0, direction=1, zero=0, home=0.0, jump=0.02):
    config = c.joint_config()
    config.encoder = c.encoder_config(sensor, 1, counts_per_rev, direction, zero, home)
    config.pot.jump_rad = jump
    return config


class Reader:
    """One encoder being read."""

    def __init__(self, library, config):
        self.library, self.config = library, config
        self.encoder, self.pot = c.encoder_state(), c.pot_state()

    def read(self, value, times=1):
        given = (self.encoder, self.pot, self.config)
        for _ in range(times):
            fault = self.library.encoder_read(*map(ctypes.byref, given), value % 2**32, CONFIRM)
        return fault


@given(angle=st.integers(0, 0x3FFF), diagnosis=st.integers(0, 0xFF), bit=st.integers(0, 31))
def test_a_sound_pair_of_frames_is_taken_and_any_flipped_bit_is_not(library, angle, diagnosis, bit):
    value = reading(angle, GOOD & ~0xFF | diagnosis)
    assert library.encoder_frames_sound(value)
    assert not library.encoder_frames_sound(value ^ 1 << bit)


@pytest.mark.parametrize("value", [0, 0xFFFFFFFF, reading(100, error=True), reading(100, GOOD & ~0x100)])
def test_a_stuck_line_an_error_bit_and_a_sensor_that_is_not_ready_are_not_sound(library, value):
    assert not library.encoder_frames_sound(value)


@pytest.mark.parametrize(("bit", "wrong"), [(9, True), (10, True), (11, True), (0, False), (7, False)])
def test_a_magnet_too_weak_or_too_strong_is_reported_in_the_diagnosis(library, bit, wrong):
    assert library.encoder_magnet_wrong(reading(5, GOOD ^ 1 << bit)) == wrong


@given(counts=st.integers(-8192, 8191), zero=st.integers(0, 16383), direction=st.sampled_from((1, -1)))
def test_an_absolute_angle_is_that_from_its_zero_across_its_wrap(library, counts, zero, direction):
    reader = Reader(library, encoder_joint(c.SENSOR_ABSOLUTE, direction=direction, zero=zero, home=0.25))
    assert reader.read(reading((zero + counts) % 16384)) == c.FAULT_NONE
    assert reader.pot.angle_rad == pytest.approx(0.25 + direction * counts * 2 * math.pi / 16384, abs=2e-6)


@pytest.mark.parametrize(
    "bad", [0, 0xFFFFFFFF, reading(1000, error=True), reading(1000) ^ 4, reading(1000, GOOD | 0x800)]
)
def test_a_bad_reading_leaves_the_angle_and_is_a_fault_once_it_lasts(library, bad):
    reader = Reader(library, encoder_joint(c.SENSOR_ABSOLUTE))
    reader.read(reading(1000))
    angle = reader.pot.angle_rad
    assert reader.read(bad, CONFIRM - 1) == c.FAULT_NONE
    assert (reader.pot.angle_rad, reader.pot.valid) == (angle, 1)
    assert reader.read(bad) == c.FAULT_ENCODER
    assert reader.pot.valid == 0


@pytest.mark.parametrize("direction", [1, -1])
def test_a_quadrature_count_goes_on_across_the_timers_wrap(library, direction):
    reader = Reader(library, encoder_joint(c.SENSOR_QUADRATURE, counts_per_rev=4096.0, direction=direction, home=-1.0))
    for count in range(-30, 60, 5):
        assert reader.read(count) == c.FAULT_NONE
    assert reader.pot.angle_rad == pytest.approx(-1.0 + direction * 85 * 2 * math.pi / 4096, abs=1e-6)
    assert reader.read(1000, CONFIRM) == c.FAULT_POT_JUMP


def test_telemetry_says_what_is_wrong_with_an_absolute_reading(library):
    config = ctypes.byref(encoder_joint(c.SENSOR_ABSOLUTE))
    said = [library.encoder_telemetry(config, value) for value in (reading(77), reading(77) ^ 2, reading(77, 0x900))]
    assert said == [77, (77 ^ 2) | c.ENCODER_UNSOUND, 77 | c.ENCODER_MAGNET]


class EncoderArm(LabArm):
    """The lab's arm with encoders in place of potentiometers."""

    def __init__(self, library, kinds):
        config = lab_config(library)
        for i, kind in enumerate(kinds):
            config.joint[i].encoder = c.encoder_config(
                kind, i + 1, 16384.0, 1, 3000, 0.5 * (kind == c.SENSOR_QUADRATURE)
            )
        self.kinds = kinds
        super().__init__(library, config)

    def counts(self, i):
        angle = math.floor(self.angle_rad[i] * 16384 / (2 * math.pi))
        if self.kinds[i] == c.SENSOR_ABSOLUTE:
            return reading((3000 + angle) % 16384)
        return angle % 2**32 if self.kinds[i] == c.SENSOR_QUADRATURE else super().counts(i)


MIXED = (0, 1, 2, 1, 2, 0)


def test_no_drive_without_a_zero_and_a_lost_count_takes_it_away(library):
    arm = EncoderArm(library, MIXED)
    arm.enable()
    assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_NOT_HOMED)
    arm.command(c.COMMAND_ENABLE_INWARD)
    assert (arm.acknowledged(), arm.outputs.drives_on) == (False, 0)
    arm.command(c.COMMAND_HOME)
    assert arm.acknowledged()
    arm.tick(2)
    assert list(arm.outputs.angle_rad) == pytest.approx([0, 0.5, 0, 0.5, 0, 0], abs=1e-3)
    arm.enable()
    assert arm.acknowledged()
    arm.command(c.COMMAND_HOME)
    assert (arm.acknowledged(), arm.outputs.rejection) == (False, c.REJECTION_WRONG_STATE)
    arm.wander(200, amplitude_rad=0.1)
    assert arm.outputs.faults == 0

    def lost(arm):
        arm.inputs.counts[3] = (arm.inputs.counts[3] + 5000) % 2**32

    arm.spoil = lost
    arm.tick(CONFIRM + 1)
    assert arm.outputs.joint_faults[3] == 1 << c.FAULT_POT_JUMP
    arm.tick(500)
    arm.command(c.COMMAND_DISABLE)
    arm.command(c.COMMAND_CLEAR_FAULTS)
    arm.command(c.COMMAND_ENABLE)
    assert arm.outputs.rejection == c.REJECTION_NOT_HOMED


def test_an_absolute_encoder_that_falls_silent_lets_go_of_its_joint_alone(library):
    arm = EncoderArm(library, (2,) * 6)
    arm.enable()
    arm.move(0.3, ticks=500)
    arm.tick(100)

    def silent(arm):
        arm.inputs.counts[2] = 0

    arm.spoil = silent
    arm.tick(CONFIRM)
    assert (arm.outputs.joint_faults[2], arm.outputs.duty[2]) == (1 << c.FAULT_ENCODER, 0.0)
    assert arm.outputs.drives_on == 1
