"""Gains by the rule: the loop has the poles that were asked for, and a motion within them leaves no error."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.robot.boards.tuning import GAIN_RANGES, MotorFigures, quiet_bandwidth, quiet_gains, tuned_gains

MOTOR = MotorFigures(resistance_ohm=6.0, constant_v_s=2.4, inertia_kg_m2=0.03, viscous_n_m_s=0.02, dry_n_m=0.2)
STALL, OWN = 2.4 * 12.0 / 6.0, 2.4**2 / 6.0 + 0.02


@pytest.mark.parametrize(("bandwidth", "damping"), [(30.0, 1.0), (60.0, 0.7), (45.0, 0.5)])
def test_the_loop_with_its_filter_has_the_bandwidth_and_damping_asked_for(bandwidth, damping):
    free = MotorFigures(resistance_ohm=1.0, constant_v_s=0.01, inertia_kg_m2=0.03, viscous_n_m_s=0.0, dry_n_m=0.0)
    kp, ki, kd, *_, t, _ = tuned_gains(free, 1e4, bandwidth, damping)
    stall, own = 100.0, 1e-4
    poles = np.roots([0.03 * t, 0.03 + own * t, own + stall * (kd + kp * t), stall * (kp + ki * t), stall * ki])
    expected = [np.roots([1.0, 2 * damping * w, w * w]) for w in (bandwidth, bandwidth / 0.35)]
    assert np.poly(poles) == pytest.approx(np.poly(np.concatenate(expected)), rel=1e-3)


def test_feed_forward_is_what_the_motion_takes():
    _, _, kd, kv, ka, kf, filter_s, _ = tuned_gains(MOTOR, 12.0, 40.0)
    speed, acceleration = 1.2, -3.0
    torque = 0.03 * acceleration + OWN * speed
    late_rad_s = (filter_s + 0.5e-3) * acceleration
    assert STALL * (kv * speed + ka * acceleration - kd * (speed - late_rad_s)) == pytest.approx(torque)
    assert 0 < STALL * kf < 0.2


def test_a_motor_that_damps_itself_enough_gets_no_derivative():
    _, _, kd, kv, *_ = tuned_gains(MOTOR, 12.0, 5.0)
    assert (kd, kv) == (0.0, pytest.approx(OWN / STALL))


@pytest.mark.parametrize("what", ["supply_v", "bandwidth_rad_s", "inertia_kg_m2"])
def test_a_number_that_is_not_positive_is_rejected_by_name(what):
    given = {"supply_v": 12.0, "bandwidth_rad_s": 40.0}
    motor = MOTOR if what in given else MotorFigures(6.0, 2.4, 0.0, 0.02, 0.2)
    with pytest.raises(InputError, match=f"{what} is 0; it must be positive"):
        tuned_gains(motor, **{name: 0.0 if name == what else value for name, value in given.items()})


def test_the_quiet_bandwidth_gives_gains_that_a_board_takes():
    motor = MotorFigures(resistance_ohm=6.8, constant_v_s=2.08, inertia_kg_m2=0.04, viscous_n_m_s=0.02, dry_n_m=0.2)
    most = GAIN_RANGES["ki_per_rad_s"][1]
    assert tuned_gains(motor, 12.0, 40.0)[1] > most  # by stiffness and noise alone it would be so
    assert tuned_gains(motor, 12.0, quiet_bandwidth(motor, 12.0, 0.0003, 0.08))[1] <= most


def test_quiet_gains_hold_against_gravity_that_changes_better_than_a_bandwidth_as_quiet():
    noise_rad = 0.0018
    known = tuned_gains(MOTOR, 12.0, quiet_bandwidth(MOTOR, 12.0, noise_rad, 0.08))
    free, loaded = (quiet_gains(MOTOR, 12.0, noise_rad, gravity) for gravity in (0.0, 2.5))
    assert free[1] > 1.3 * known[1]
    assert loaded[1] > 1.1 * free[1]  # more noise is admitted where gravity asks for it


def test_quiet_gains_are_robust_within_what_a_board_takes():
    for noise_rad in (0.0003, 0.0018):
        for inertia in (0.015, 0.03, 0.18):
            motor = MotorFigures(6.0, 2.4, inertia, 0.02, 0.2)
            gains = quiet_gains(motor, 12.0, noise_rad, 2.5)
            assert all(low <= gain <= high for gain, (low, high) in zip(gains, GAIN_RANGES.values(), strict=True))
            kp, ki, kd, *_, t, _ = gains
            s = 1j * np.geomspace(1.0, 1000.0, 400)
            loop = STALL * (kp + ki / s + kd * s / (t * s + 1)) / (inertia * s * s + OWN * s) * np.exp(-1.5e-3 * s)
            assert np.abs(1 / (1 + loop)).max() < 1.85  # greatest sensitivity, a tick and a half late
