"""Springs and eccentric drums between motor and sensor: found where they are, and only there, from simulated recordings."""

import numpy as np
import pytest

from armsight.robot.boards.identification import DITHER_HZ, fit_drum, fit_spring
from armsight.robot.boards.tuning import Elasticity, MotorFigures, elastic_gains
from armsight.sim.joints import COUNTS_PER_RAD, ZERO_COUNTS, JointPlant, drawn_model, plain_transmission, sprung

PHASES = np.pi * np.arange(len(DITHER_HZ)) ** 2 / len(DITHER_HZ)


def swing(t):
    return 0.12 * np.sin(np.pi * t) + 0.04 * np.sin(4 * np.pi * t)


def travel(t):
    return 0.8 * (1 - np.cos(2 * np.pi * t / 5))


def recorded(seed, rows, path, dither, seconds=5.0):
    """(times, volts, amperes, angles) of six joints that follow a path loosely, as the board reports them each 2 ms."""
    model = drawn_model(seed, load=0.3)
    plant = JointPlant(-np.sign(model.gravity_n_m) * np.pi / 2, seed=seed, model=model, transmission=rows(model))
    start, total, rows_ = plant.link.copy(), np.zeros(6), []
    duty, t = np.zeros(6), 0.0
    for k in range(round(1e3 * seconds)):
        sensed, t = plant.sense(), 1e-3 * k
        q = (sensed.counts - ZERO_COUNTS) / COUNTS_PER_RAD
        if k % 2 == 0:
            rows_.append(np.stack([np.full(6, t), 12.0 * duty, 1e-3 * sensed.current_ma, q]))
        error = start - np.sign(start) * path(t) - q
        total += 2e-3 * error
        added = dither * np.sin(2 * np.pi * DITHER_HZ * (k // 10) * 0.01 + PHASES).sum() / np.sqrt(len(DITHER_HZ))
        duty = np.clip(2.0 * error + total + added, -1.0, 1.0)
        plant.step(duty, True)
    return model, np.array(rows_)


def test_a_spring_is_found_with_its_resonance_and_a_rigid_joint_has_none():
    share = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.5])
    hz = np.array([8.0, 10.0, 12.0, 10.0, 14.0, 12.0])
    model, rows = recorded(31, lambda m: plain_transmission(**sprung(m, hz, np.full(6, 0.05), share)), swing, 0.15)
    held = hz * np.sqrt(1 - share)
    for j in range(6):
        fit, elastic = fit_spring(*rows[250:, :, j].T)
        assert fit.motor.resistance_ohm == pytest.approx(model.resistance_ohm[j] / model.current_gain[j], rel=0.2)
        assert fit.motor.constant_v_s == pytest.approx(model.constant_v_s[j], rel=0.15)
        assert 0.65 < elastic.held_hz(fit.motor.inertia_kg_m2) / held[j] < 1.15  # backlash of up to 10 mrad softens it
        assert elastic.link_share == pytest.approx(share[j], abs=0.15)
    _, rows = recorded(31, lambda m: plain_transmission(), swing, 0.15)
    assert [fit_spring(*rows[250:, :, j].T) for j in range(6)] == [None] * 6


def test_a_drum_is_found_with_its_periods_and_an_even_joint_has_none():
    for rows, size in (({"drum_rad": 0.04, "drum_per_rev": 4.0}, 0.16), ({}, None)):
        model, seen = recorded(32, lambda m, rows=rows: plain_transmission(**rows), travel, 0.0)
        for j in range(6):
            motor = MotorFigures(
                model.resistance_ohm[j] / model.current_gain[j], model.constant_v_s[j], 0.05, 0.02, 0.2
            )
            drum = fit_drum(*seen[:, :, j].T, motor, 0.0)
            if size is None:
                assert drum is None
            else:
                assert drum[0] * drum[1] == pytest.approx(size, rel=0.25)


def test_elastic_gains_are_slower_for_softer_joints_and_none_for_the_softest():
    motor = MotorFigures(6.0, 2.4, 0.06, 0.02, 0.2)

    def ki(hz):
        stiffness = 0.03 * (2 * np.pi * hz) ** 2
        gains = elastic_gains(motor, 12.0, Elasticity(stiffness, 1e-3 * stiffness, 0.5), 4e-4)
        return None if gains is None else float(gains[1])

    found = [ki(hz) for hz in (6.0, 9.0, 14.0, 30.0)]
    assert found == sorted(found)
    assert found[0] < 0.3 * found[-1]
    assert ki(2.0) is None


def test_elastic_gains_leave_room_for_backlash_that_opens():
    """A gap in a spring is a softer spring: unloaded, its poles decay at a fifth of the stiffness too."""
    motor = MotorFigures(6.0, 2.4, 0.06, 0.02, 0.2)
    stiffness = 0.03 * (2 * np.pi * 20.0) ** 2
    loaded, light = (
        elastic_gains(motor, 12.0, Elasticity(stiffness, 1e-3 * stiffness, 0.5, opens), 4e-4) for opens in (False, True)
    )
    assert 0.4 * loaded[1] < light[1] < 0.9 * loaded[1]


@pytest.mark.parametrize("count", [0, 1, 2, 50, 3000])
def test_readings_that_show_nothing_show_no_spring_and_no_drum(count):
    t_s, nothing = 0.002 * np.arange(count), np.zeros(count)
    motor = MotorFigures(6.0, 0.6, 0.03, 0.01, 0.05)
    for angle_rad in (nothing, 0.1 * np.sin(t_s)):
        assert fit_spring(t_s, nothing, nothing, angle_rad) is None
        assert fit_drum(t_s, nothing, nothing, nothing, motor, 0.0) is None
