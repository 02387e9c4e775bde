"""The control law: against the same law in float64, and the properties a PID that drives a motor must have."""

import ctypes
import math
from dataclasses import dataclass

import pytest
from firmware_layout import c
from hypothesis import given
from hypothesis import strategies as st

DT = 0.001
FULL_RANGE_RAD = 5.2  # full scale of a joint; full scale of a duty is 1


@dataclass
class Law:
    """The law of docs/reference/firmware.md in float64: the oracle, written from the equations."""

    kp: float
    ki: float
    kd: float
    kv: float
    tau: float
    kb: float
    limit: float = 1.0
    slew: float = 1000.0
    integral: float = 0.0
    measured: float = 0.0
    speed: float = 0.0
    duty: float = 0.0

    def step(self, reference, rate, gravity, measured):
        self.speed += DT / (self.tau + DT) * ((measured - self.measured) / DT - self.speed)
        self.measured = measured
        error = reference - measured
        asked = self.kp * error + self.integral - self.kd * self.speed + self.kv * rate + gravity
        allowed = min(max(asked, -self.limit), self.limit)
        self.duty = min(max(allowed, self.duty - self.slew * DT), self.duty + self.slew * DT)
        if self.ki > 0:
            self.integral += DT * (self.ki * error + self.kb * (self.duty - asked))
        else:
            self.integral -= DT * self.kb * self.integral
        self.integral = min(max(self.integral, -self.limit), self.limit)
        return self.duty


class Pid:
    """One joint's controller in the firmware."""

    def __init__(self, library, *gains, limit=1.0, slew=1000.0, cap=None, spring=1e9):
        self.library, self.state, self.gains = library, c.pid_state(), c.joint_gains(*gains[:4], 0.0, 0.0, *gains[4:])
        high = limit if cap is None else cap
        self.demand = c.pid_demand(0, 0, 0, spring, 0, limit, -high, high, slew)
        self.limited = 0
        library.pid_reset(ctypes.byref(self.state), 0.0)

    def step(self, reference, rate=0.0, gravity=0.0, measured=0.0):
        self.demand.reference_rad, self.demand.reference_rad_s, self.demand.gravity_duty = reference, rate, gravity
        limited = ctypes.c_uint32()
        state, gains = ctypes.byref(self.state), ctypes.byref(self.gains)
        self.library.pid_measure(state, gains, measured)
        self.demand.damped_rad_s = self.state.speed_rad_s
        duty = self.library.pid_step(state, gains, ctypes.byref(self.demand), ctypes.byref(limited))
        self.limited = limited.value
        return duty

    def change(self, *gains):
        after = c.joint_gains(*gains[:4], 0.0, 0.0, *gains[4:])
        self.library.pid_change_gains(ctypes.byref(self.state), ctypes.byref(self.gains), ctypes.byref(after))
        self.gains = after


def respond(controller, reference, ticks=3000):
    """The duties and angles of a joint (5 rad/s at full duty, 30 ms, half a duty of gravity load) under a controller."""
    angle, speed, duties, angles = 0.0, 0.0, [], []
    for k in range(ticks):
        at, rate = reference(k * DT)
        duty = controller.step(at, rate, 0.1, angle)
        speed += DT / 0.03 * (5.0 * (duty - 0.15) - speed)
        angle += DT * speed
        duties.append(duty)
        angles.append(angle)
    return duties, angles


REFERENCES = {
    "step": lambda t: (1.0, 0.0),
    "ramp": lambda t: (0.8 * t, 0.8),
    "far step": lambda t: (2.5 if t < 1.5 else -2.5, 0.0),
}
GAINS = {
    "firm": (4.0, 8.0, 0.1, 0.2, 0.005, 20.0),
    "no integral": (6.0, 0.0, 0.05, 0.2, 0.002, 20.0),
    "unfiltered": (3.0, 4.0, 0.02, 0.0, 0.0, 0.0),
}


@pytest.mark.parametrize("gains", GAINS.values(), ids=GAINS)
@pytest.mark.parametrize("reference", REFERENCES.values(), ids=REFERENCES)
@pytest.mark.parametrize(("limit", "slew"), [(1.0, 1000.0), (0.6, 20.0)])
def test_responses_are_those_of_the_law_in_float64(library, gains, reference, limit, slew):
    duties, angles = respond(Pid(library, *gains, limit=limit, slew=slew), reference)
    law_duties, law_angles = respond(Law(*gains, limit=limit, slew=slew), reference)
    assert max(abs(a - b) for a, b in zip(duties, law_duties, strict=True)) < 1e-4
    assert max(abs(a - b) for a, b in zip(angles, law_angles, strict=True)) < 1e-4 * FULL_RANGE_RAD
    assert abs(angles[-1] - law_angles[-1]) < 1e-5


@pytest.mark.parametrize("gains", [(50, 0, 0, 0, 0, 0), (0, 100, 0, 0, 0, 5), (0, 0, 50, 0, 0, 0), (0, 0, 0, 50, 0, 0)])
def test_the_duty_stays_within_its_limit_and_says_so(library, gains):
    pid = Pid(library, *gains, limit=0.3)
    held = 0
    for k in range(500):
        assert abs(pid.step(1.0, 1.0, 0.0, -0.02 * k)) <= ctypes.c_float(0.3).value
        held |= pid.limited
    assert held == c.LIMITED_DUTY


def test_a_current_limit_is_distinguished_from_a_duty_limit(library):
    pid = Pid(library, 10, 0, 0, 0, 0, 0, limit=0.8, cap=0.2)
    assert pid.step(1.0) == ctypes.c_float(0.2).value
    assert pid.limited == c.LIMITED_CURRENT


def test_the_slew_limit_holds_both_ways_and_says_so(library):
    pid = Pid(library, 10, 0, 0, 0, 0, 0, slew=20.0)
    last = 0.0
    for k in range(300):
        duty = pid.step(1.0 if k // 100 % 2 == 0 else -1.0)
        assert abs(duty - last) <= 0.02 + 1e-7  # a rounding of float32
        assert (pid.limited & c.LIMITED_SLEW != 0) == (abs(duty) < 1.0)
        last = duty


def test_zero_gains_give_exactly_nothing(library):
    pid = Pid(library, 0, 0, 0, 0, 0.005, 20)
    assert {pid.step(math.sin(k), math.cos(k), 0.0, math.cos(3 * k)) for k in range(100)} == {0.0}


def test_a_step_of_the_reference_does_not_kick_the_derivative(library):
    pid = Pid(library, 0, 0, 5.0, 0, 0.001, 0)
    assert [pid.step(reference) for reference in (0, 0, 1, -1, 1)] == [0.0] * 5


def test_the_derivative_of_a_ramp_is_its_slope_after_the_filter(library):
    tau, slope = 0.01, 0.7
    pid = Pid(library, 0, 0, 1.0, 0, tau, 0, limit=1.0)
    for k in range(1, 101):
        duty = pid.step(0.0, measured=slope * k * DT)
        expected = -slope * (1 - (tau / (tau + DT)) ** k)  # the discrete first-order filter's step response
        assert duty == pytest.approx(expected, abs=2e-4)  # a float32 angle of 0.07 rad is rounded to 4e-9, over 1 ms


def test_the_integral_of_a_constant_error_grows_by_its_gain(library):
    pid = Pid(library, 0, 2.0, 0, 0, 0, 0)
    duties = [pid.step(0.1) for _ in range(1001)]
    assert duties[0] == 0.0
    assert duties[-1] == pytest.approx(0.2, rel=1e-4)


def test_feed_forward_and_gravity_are_added(library):
    assert Pid(library, 0, 0, 0, 0.25, 0, 0).step(0.0, rate=2.0, gravity=-0.125) == 0.375


def test_acceleration_and_dry_friction_are_fed_forward(library):
    pid = Pid(library, 0, 0, 0, 0, 0, 0)
    pid.gains.ka_s2_per_rad, pid.gains.kf_duty, pid.demand.reference_rad_s2 = 0.02, 0.1, 5.0
    assert pid.step(0.0, rate=100.0) == pytest.approx(0.2, abs=1e-5)
    pid.demand.reference_rad_s2 = 0.0
    assert pid.step(0.0, rate=-0.005) == pytest.approx(-0.05, abs=1e-6)  # half of it at the creeping speed
    assert pid.step(0.0) == 0.0


def test_however_far_the_reference_the_spring_drives_no_harder_than_it_may(library):
    pid = Pid(library, 5.0, 0, 0, 0.1, 0, 0, spring=0.25)
    assert pid.step(1.0, rate=2.0, gravity=0.125) == 0.375
    assert pid.step(-1.0, rate=2.0) == -0.25
    assert pid.step(0.02, rate=0.5) == pytest.approx(0.15, abs=1e-6)


def test_against_its_limit_the_integral_rests_where_the_law_says(library):
    pid = Pid(library, 1.0, 5.0, 0, 0, 0, 50.0, limit=0.5)
    for _ in range(2000):
        pid.step(1.0)
    # At rest against the limit: ki e = kb (asked - duty), so that the integral is duty + ki e / kb - kp e.
    assert pid.state.integral_duty == pytest.approx(0.5 + 5.0 / 50.0 - 1.0, abs=1e-4)


def test_back_calculation_overshoots_less_than_none(library):
    def overshoot(anti_windup_per_s):
        pid = Pid(library, 2.0, 10.0, 0.05, 0, 0.002, anti_windup_per_s, limit=0.4)
        return max(respond(pid, lambda t: (1.5, 0.0), 4000)[1]) - 1.5

    assert overshoot(20.0) < 0.5 * overshoot(0.0)


def test_a_slew_limit_does_not_wind_up_either(library):
    pid = Pid(library, 2.0, 10.0, 0, 0, 0, 100.0, slew=0.5)
    for _ in range(200):
        pid.step(1.0)
    assert pid.state.integral_duty < 0


@pytest.mark.parametrize("after", [(8, 8, 0.1, 0.2, 0.005, 20), (4, 8, 0.4, 0, 0.02, 20), (1, 80, 0, 1, 0, 20)])
def test_a_change_of_gains_does_not_move_the_duty(library, after):
    """The tick after a change gives what it would have given without it, to one tick of the new integral's change."""
    old, new = (Pid(library, 4, 8, 0.1, 0.2, 0.005, 20) for _ in range(2))
    for k in range(100):
        for pid in (old, new):
            pid.step(0.1, 0.3, 0.05, 0.0001 * k)
    new.change(*after)
    angle = 0.0001 * 99  # the same measurement again, so that the filters' memory is all that differs
    new.gains.derivative_filter_s = old.gains.derivative_filter_s
    moved = new.step(0.1, 0.3, 0.05, angle) - old.step(0.1, 0.3, 0.05, angle)
    # The speed changes by under 0.02 rad/s in that tick; with the gains' difference that is all there is to it.
    assert abs(moved) <= abs(after[2] - 0.1) * 0.02 + 1e-6


def test_what_a_change_leaves_fades_without_an_integral_gain(library):
    pid = Pid(library, 4, 8, 0, 0, 0, 20)
    for _ in range(50):
        pid.step(0.1)
    before = pid.step(0.1)
    pid.change(0, 0, 0, 0, 0, 20)
    assert pid.step(0.1) == pytest.approx(before, abs=8 * 0.1 * DT + 1e-6)
    for _ in range(1000):
        last = pid.step(0.1)
    assert abs(last) < before * math.exp(-19.0)


@given(
    steps=st.lists(st.tuples(*[st.floats(-10, 10, width=32)] * 3), min_size=1, max_size=40),
    gains=st.tuples(*[st.floats(0, 100, width=32)] * 4, st.floats(0, 1, width=32), st.floats(0, 1000, width=32)),
)
def test_no_gains_and_inputs_break_the_limits(library, steps, gains):
    pid = Pid(library, *gains, limit=0.5, slew=100.0)
    last = 0.0
    for reference, rate, measured in steps:
        duty = pid.step(reference, rate, 0.0, measured)
        assert abs(duty) <= 0.5
        assert abs(duty - last) <= 0.1 + 1e-7
        last = duty
