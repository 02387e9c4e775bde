"""Potentiometers: counts to angle, and which counts are not accepted."""

import ctypes

import numpy as np
import pytest
from firmware_layout import c
from hypothesis import given
from hypothesis import strategies as st

CONFIRM = 5
BAND = (2000, 64000)


def pot_config(counts, angles, direction=1, jump=0.01):
    """A potentiometer with a table of these nodes."""
    config = c.pot_config(node_count=len(counts), direction=direction, jump_rad=jump)
    config.counts[: len(counts)], config.angle_rad[: len(angles)] = counts, angles
    config.short_counts, config.open_counts = BAND
    return config


BENT = ([3000, 10000, 20000, 33000, 47000, 60000], [-2.5, -1.9, -1.2, 0.1, 1.0, 2.4])
FULL = (list(range(4000, 62001, 7250)), np.linspace(2.0, -2.0, 9).tolist())


@pytest.mark.parametrize("table", [BENT, FULL, ([100, 65000], [-1.0, 1.0])], ids=["bent", "nine nodes", "two nodes"])
@pytest.mark.parametrize("direction", [1, -1])
def test_angles_are_read_off_the_table(library, table, direction):
    config = pot_config(*table, direction)
    inside = np.arange(table[0][0], table[0][-1] + 1, 37)
    got = [library.pot_angle(ctypes.byref(config), int(counts)) for counts in inside]
    np.testing.assert_allclose(got, direction * np.interp(inside, *table), atol=1e-6)


def test_beyond_its_outer_nodes_the_table_goes_on_straight(library):
    config = pot_config(*BENT)
    low, high = (library.pot_angle(ctypes.byref(config), counts) for counts in (2000, 62000))
    assert low == pytest.approx(-2.5 - 1000 * 0.6 / 7000, abs=1e-6)
    assert high == pytest.approx(2.4 + 2000 * 1.4 / 13000, abs=1e-6)


class Reader:
    """One potentiometer being read."""

    def __init__(self, library):
        self.library, self.config, self.state = library, pot_config([3000, 63000], [-3.0, 3.0]), c.pot_state()

    def read(self, counts, times=1):
        for _ in range(times):
            fault = self.library.pot_read(ctypes.byref(self.state), ctypes.byref(self.config), counts, CONFIRM)
        return fault


@pytest.fixture
def reader(library):
    """A potentiometer that has been read in its middle."""
    reader = Reader(library)
    assert reader.read(33000) == c.FAULT_NONE
    return reader


@pytest.mark.parametrize(
    ("counts", "fault"),
    [
        (0, c.FAULT_POT_SHORT),
        (1999, c.FAULT_POT_SHORT),
        (64001, c.FAULT_POT_OPEN),
        (65535, c.FAULT_POT_OPEN),
        (40000, c.FAULT_POT_JUMP),
        (33701, c.FAULT_POT_JUMP),
    ],
)
def test_a_reading_that_cannot_be_is_a_fault_once_it_lasts(reader, counts, fault):
    assert reader.read(counts, CONFIRM - 1) == c.FAULT_NONE
    assert reader.state.angle_rad == pytest.approx(0.0, abs=1e-6)  # it is not accepted meanwhile
    assert reader.state.bad_ticks == CONFIRM - 1
    assert reader.read(counts) == fault


@pytest.mark.parametrize("counts", [0, 65535, 40000])
def test_a_short_glitch_is_forgiven(reader, counts):
    for _ in range(20):
        assert reader.read(counts, CONFIRM - 1) == c.FAULT_NONE
        assert reader.read(33001) == c.FAULT_NONE
        assert reader.state.angle_rad == pytest.approx(1e-4, abs=1e-6)


@pytest.mark.parametrize("counts", [2000, 64000])
def test_the_edges_of_the_band_are_good(library, counts):
    assert Reader(library).read(counts, 20) == c.FAULT_NONE


def test_the_fastest_plausible_motion_is_no_jump(reader):
    for counts in range(33000, 43000, 99):  # 0.0099 rad per tick
        assert reader.read(counts) == c.FAULT_NONE
        assert reader.state.bad_ticks == 0


def test_after_missing_readings_the_joint_may_be_as_far_as_it_can_have_moved(reader):
    reader.read(0, 3)
    assert reader.read(33000 + 399) == c.FAULT_NONE
    assert reader.state.angle_rad == pytest.approx(0.0399, abs=1e-6)


def test_a_jump_is_reported_once_and_the_new_angle_is_read(reader):
    assert reader.read(40000, CONFIRM) == c.FAULT_POT_JUMP
    assert reader.read(40000) == c.FAULT_NONE
    assert reader.state.angle_rad == pytest.approx(0.7, abs=1e-6)


def test_after_an_open_wire_any_angle_is_accepted(reader):
    assert reader.read(65535, 100) == c.FAULT_POT_OPEN
    assert reader.read(10000) == c.FAULT_NONE
    assert reader.state.angle_rad == pytest.approx(-2.3, abs=1e-6)


@given(st.lists(st.integers(0, 65535), max_size=200))
def test_a_accepted_angle_never_moves_faster_than_the_joint_can(library, readings):
    """Unless a fault was reported: what the arm acts on is continuous."""
    reader, last, since = Reader(library), None, 1
    for counts in readings:
        fault = reader.read(counts)
        if fault != c.FAULT_NONE or not reader.state.valid:
            last = None
            continue
        if last is not None:
            assert abs(reader.state.angle_rad - last) <= 0.01 * since + 1e-6
        since = reader.state.bad_ticks + 1
        last = reader.state.angle_rad if reader.state.bad_ticks == 0 else last
