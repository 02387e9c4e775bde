"""What gravity shows of a worn arm with a sensor whose errors are not all in the model, and what it leaves open."""

from dataclasses import replace

import numpy as np
import pytest
from worn_arm import poses, worn

from armsight.errors import InputError
from armsight.loop.estimators.armerror import Prior
from armsight.loop.identify.gravity import ArmRests, gravity_shows, parallel
from armsight.loop.references.inertial import ACCELEROMETER, GYRO, Inertial
from armsight.loop.references.reference import Reading, ToolMotion
from armsight.robot.models import MODELS

#: What the sensor's calibration left: rotation, bias, M_a; and the tilt is unknown.
LEFT = np.full(38, 1e-9)
LEFT[:3], LEFT[9:12], LEFT[12:18], LEFT[36:] = np.radians(0.05), 0.01, 5e-4, np.radians(5.0)
STEP_M_S2 = 0.0024  # of a 14 bit chip of 2 g


def rested(seed, rests=60):
    """A worn arm at rests; the sensor warms up meanwhile, is a little bent and rounded, all of which no model has."""
    arm, rng = worn(seed), np.random.default_rng(9000 + seed)
    q, approach = poses(arm.nominal, rests, rng, 1.5)
    said = replace(Inertial.of("imu"), cov=np.diag(LEFT**2), delay_s=0.004)  # as its calibration left it
    true = said.moved(rng.normal(size=38) * np.append(LEFT[:-2], np.radians([0.3, 0.3])))
    readings = []
    for k, T in enumerate(arm.true.forward(arm.joints(q, approach))):
        z = true.expected(ToolMotion(T), ACCELEROMETER).z
        z = z * (1 + 2e-5 * z) + 0.004 * (k / rests - 0.5) * np.array([1, -1, 0.5]) + rng.normal(0.0, 0.003, 3)
        readings.append(Reading(float(k), ACCELEROMETER, np.round(z / STEP_M_S2) * STEP_M_S2, 0.004**2 * np.eye(3)))
    beyond = arm.joints(q, approach) - q + 0.5 * arm.backlash * approach
    zeros = (arm.true.offset - arm.nominal.offset) * arm.nominal.direction + beyond.mean(axis=0)
    return arm.nominal, said, q, readings, true.values[-2:], zeros


def test_tilt_and_the_zeros_that_gravity_shows_are_found_and_the_others_are_open():
    off, zeros_off = [], []
    for seed in range(3):
        arm, said, q, readings, tilt, zeros = rested(700 + seed)
        shown, _ = gravity_shows(arm, said, q, readings)
        assert [s.name for s in shown if s.open] == [f"zero {k}" for k in (1, 2, 3, 4)]
        truth = np.array([*tilt, *(zeros[np.array(s.joints) - 1].sum() for s in shown[2:])])
        miss = np.array([s.value for s in shown]) - truth
        assert (np.abs(miss) < 3 * np.array([s.sigma for s in shown])).all()
        off.append(np.degrees(miss[:2]))
        closed = [k for k, s in enumerate(shown) if s.name in ("zero 2+3+4", "zero 5")]
        zeros_off.append(np.degrees(miss[closed]))
        assert max(np.degrees(shown[k].sigma) for k in closed) < 0.06  # a link bent about a joint's axis is a zero, too
    assert np.sqrt(np.mean(np.square(off))) < 0.08  # two sigma of what is claimed
    assert np.sqrt(np.mean(np.square(zeros_off))) < 0.06


@pytest.mark.parametrize("scatter_rad", [1e-3, 5e-3])
def test_the_scatter_of_rests_is_found(scatter_rad):
    found = []
    for seed in range(720, 724):
        rng, arm = np.random.default_rng(seed), MODELS["six_r"]
        said = replace(Inertial.of("imu"), cov=np.diag(LEFT**2))
        q = poses(arm, 60, rng, 1.5)[0]
        at = arm.forward(q + rng.normal(0.0, scatter_rad, q.shape))
        z = [said.expected(ToolMotion(T), ACCELEROMETER).z + rng.normal(0.0, 0.004, 3) for T in at]
        readings = [Reading(float(k), ACCELEROMETER, each, 0.004**2 * np.eye(3)) for k, each in enumerate(z)]
        given = ArmRests(arm, Prior(), q).scatter.max()
        found.append(gravity_shows(arm, said, q, readings)[1].noise["carrier"] * given)
    assert np.mean(found) == pytest.approx(scatter_rad, rel=0.15)


@pytest.mark.parametrize("name", ["six_r", "iiwa", "franka"])
def test_zeros_hold_a_bent_link_whatever_its_twist(name):
    """Zeros that cancel a bend in every pose, found by the poses alone, are its negative."""
    arm, rng = MODELS[name], np.random.default_rng(5)
    twists = np.resize(np.radians([-90, 60, 70, 100, -60, -75, 90]), arm.joints)
    arm = replace(arm, alpha=twists, direction=np.resize([1.0, -1.0, -1.0, 1.0], arm.joints))
    rests = ArmRests(arm, Prior(), rng.uniform(-1.0, 1.0, (12, arm.joints)))
    rotation = np.concatenate([rests.at(float(k))[1][3:] for k in range(12)])
    zeros = np.flatnonzero(rests.scatter)
    for bent in zeros[1:] - 1:
        step = np.zeros(len(rests.sigma))
        step[bent], step[zeros] = 1.0, np.linalg.lstsq(rotation[:, zeros], -rotation[:, bent])[0]
        np.testing.assert_allclose(rotation @ step, 0.0, atol=1e-9)
        np.testing.assert_allclose(rests.moved(step).zeros(np.eye(len(step)))[0], 0.0, atol=1e-9)


def test_joints_with_parallel_axes_are_one_set():
    assert parallel(MODELS["six_r"]) == [[0], [1, 2, 3], [4], [5]]


def test_too_few_rests_and_other_channels_are_rejected():
    arm, said, q, readings, *_ = rested(1, rests=8)
    with pytest.raises(InputError, match="imu: 7 rests were given; gravity shows zeros from 8 on"):
        gravity_shows(arm, said, q[:7], readings[:7])
    with pytest.raises(InputError, match="accelerometer only"):
        gravity_shows(arm, said, q, [replace(r, channel=GYRO) for r in readings])
