"""The reference between host commands: a cubic, continuous, within the speed limit."""

import ctypes

import numpy as np
import pytest
from firmware_layout import c
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

DT = 0.001


class Setpoint:
    """One joint's reference in the firmware."""

    def __init__(self, library, position=0.0):
        self.library, self.state = library, c.setpoint_state()
        library.setpoint_hold(ctypes.byref(self.state), position)

    def aim(self, to, to_speed, ticks, limit=2.0):
        return self.library.setpoint_aim(ctypes.byref(self.state), to, to_speed, ticks, limit)

    def advance(self, ticks=1):
        """The (position, speed) of each of the next ticks."""
        out = []
        for _ in range(ticks):
            self.library.setpoint_advance(ctypes.byref(self.state))
            out.append((self.state.position_rad, self.state.speed_rad_s))
        return np.array(out)


def test_between_commands_lies_the_cubic_through_both(library):
    setpoint = Setpoint(library)
    setpoint.aim(0.02, 1.0, 16)
    setpoint.advance(16)
    assert not setpoint.aim(0.03, -0.5, 16)
    spline = CubicHermiteSpline([0.0, 16 * DT], [0.02, 0.03], [1.0, -0.5])
    at = np.arange(1, 17) * DT
    got = setpoint.advance(16)
    np.testing.assert_allclose(got[:, 0], spline(at), atol=1e-8)  # float32 of 0.03 rad
    np.testing.assert_allclose(got[:, 1], spline(at, 1), atol=1e-5)  # the same over 16 ms


@pytest.mark.parametrize("period", [4, 16, 17, 100], ids=lambda ticks: f"{1000 / ticks:.0f} Hz")
def test_a_host_of_any_rate_moves_the_reference_along_its_own_curve(library, period):
    """A sine commanded every ``period`` ticks: off it by no more than a cubic must be."""
    setpoint, omega, amplitude = Setpoint(library), 3.0, 0.5
    setpoint.aim(0.0, amplitude * omega, 100)
    setpoint.advance(100)
    worst, last = 0.0, setpoint.state.position_rad
    for k in range(2000 // period):
        end = (k + 1) * period * DT
        setpoint.aim(amplitude * np.sin(omega * end), amplitude * omega * np.cos(omega * end), period)
        got = setpoint.advance(period)
        at = (k * period + np.arange(1, period + 1)) * DT
        worst = max(worst, np.abs(got[:, 0] - amplitude * np.sin(omega * at)).max())
        assert np.abs(np.diff([last, *got[:, 0]])).max() <= amplitude * omega * DT * 1.001
        last = got[-1, 0]
    # Cubic Hermite interpolation is off by at most h^4/384 times the fourth derivative; then float32.
    assert worst < (period * DT) ** 4 / 384 * amplitude * omega**4 + 2e-7


def test_beyond_its_end_it_goes_straight_on(library):
    setpoint = Setpoint(library)
    setpoint.aim(0.1, 0.5, 100)
    setpoint.advance(100)
    np.testing.assert_allclose(setpoint.advance(50)[-1], [0.1 + 0.5 * 0.05, 0.5], rtol=1e-6)


def test_a_far_point_takes_the_time_the_speed_limit_asks_for(library):
    setpoint = Setpoint(library)
    assert setpoint.aim(1.0, 0.0, 10, limit=0.5)
    got = setpoint.advance(3001)
    # From rest to rest a cubic is fastest in its middle, at 1.5 d/T: 1 rad at 0.5 rad/s takes 3 s.
    assert setpoint.state.ticks in (3000, 3001)
    assert got[:, 1].max() == pytest.approx(0.5, rel=1e-3)
    assert got[-1].tolist() == [1.0, 0.0]


@given(
    aims=st.lists(
        st.tuples(st.floats(-4, 4, width=32), st.floats(-1, 1, width=32), st.integers(1, 60)), min_size=1, max_size=12
    ),
    limit=st.floats(0.0625, 5, width=32),
)
def test_position_and_speed_are_continuous_and_within_the_limit(library, aims, limit):
    setpoint, last, last_speed = Setpoint(library), 0.0, 0.0
    for to, share, ticks in aims:
        setpoint.aim(to, share * limit, ticks, limit)
        # Bernstein form: the speed of a cubic changes fastest at an end, by twice the coefficients' difference over T.
        span = setpoint.state.ticks * DT
        middle = 3 * (to - last) / span - last_speed - share * limit
        steepest = 2 * max(abs(middle - last_speed), abs(share * limit - middle)) / span
        for position, speed in setpoint.advance(min(ticks, 40)):
            assert abs(speed) <= limit * (1 + 1e-4) + 1e-4
            assert abs(position - last) <= limit * DT * (1 + 1e-4) + 2e-6  # float32 at 4 rad, a few times
            assert abs(speed - last_speed) <= steepest * DT * (1 + 1e-3) + 2e-3
            last, last_speed = position, speed


def test_slowing_down_takes_the_distance_the_deceleration_asks_for(library):
    setpoint = Setpoint(library)
    setpoint.aim(0.1, 1.0, 100)
    setpoint.advance(100)
    ticks = next(k for k in range(1, 1000) if library.setpoint_slow(ctypes.byref(setpoint.state), 5.0))
    assert ticks in (200, 201)  # v/a; one more where float32 leaves a crumb of speed
    assert setpoint.state.position_rad == pytest.approx(0.1 + 0.1, abs=0.5 * DT + 1e-6)  # v^2/2a, half a step of v
    assert np.ptp(setpoint.advance(100)[:, 0]) == 0.0


def test_the_clamp_stops_the_reference_at_the_limit(library):
    setpoint = Setpoint(library)
    setpoint.aim(0.1, 1.0, 100)
    setpoint.advance(100)
    clamp = lambda low, high: library.setpoint_clamp(ctypes.byref(setpoint.state), low, high)  # noqa: E731
    assert not clamp(-1.0, 0.5)
    assert setpoint.state.speed_rad_s == 1.0
    assert clamp(-1.0, 0.05)
    assert (setpoint.state.position_rad, setpoint.state.speed_rad_s) == (ctypes.c_float(0.05).value, 0.0)
