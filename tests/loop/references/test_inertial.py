"""The inertial unit: derivatives, an oracle by finite differences of a path, and calibration of a perturbed sensor."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.references.calibrate import PosePath, calibrate
from armsight.loop.references.inertial import ACCELEROMETER, GYRO, Inertial
from armsight.loop.references.reference import STANDARD_GRAVITY_M_S2, Reading, ToolMotion

UP = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])
RATES = np.array([1.1, 1.7, 2.3, 0.9, 1.3, 1.9])


def pose(t_s):
    """A path that rotates by 1 rad and moves by 0.2 m about every axis."""
    return exp_se3(np.array([0.2, 0.2, 0.2, 1.0, 1.0, 1.0]) * np.sin(RATES * t_s + np.arange(6)))


def motion(t_s, h=1e-3):
    """The same with twist and acceleration by central differences."""

    def twist(t_s):
        return log_se3(inverse(pose(t_s - h)) @ pose(t_s + h)) / (2 * h)

    return ToolMotion(pose(t_s), twist(t_s), (twist(t_s + h) - twist(t_s - h)) / (2 * h))


def some(seed, size=1.0):
    """A sensor of the class MPU-6050 whose parameters are drawn."""
    rng = np.random.default_rng(seed)
    first = Inertial.of("imu")
    step = size * rng.normal(size=38) * np.sqrt(np.diag(first.cov))
    step[3:6] *= 0.3  # up to 0.1 m
    return first.moved(step)


@pytest.mark.parametrize("channel", [GYRO, ACCELEROMETER])
def test_every_derivative_is_that_of_finite_differences(channel):
    h = 1e-6
    sensor, at = some(1), motion(0.7)
    got = sensor.expected(at, channel)

    def differences(change, count):
        return np.column_stack([(sensor_z(change(h * e)) - sensor_z(change(-h * e))) / (2 * h) for e in np.eye(count)])

    def sensor_z(given):
        return given[0].expected(given[1], channel).z

    by = {
        "by_tool": lambda e: (sensor, at._replace(T_base_tool=at.T_base_tool @ exp_se3(e))),
        "by_twist": lambda e: (sensor, at._replace(twist=at.twist + e)),
        "by_acceleration": lambda e: (sensor, at._replace(acceleration=at.acceleration + e)),
        "by_parameters": lambda e: (sensor.moved(e), at),
    }
    for name, change in by.items():
        numeric = differences(change, 38 if name == "by_parameters" else 6)
        np.testing.assert_allclose(getattr(got, name), numeric, atol=1e-6, err_msg=name)


def test_it_reads_what_a_point_of_the_path_feels():
    h = 1e-3
    T = exp_se3(np.array([0.05, -0.1, 0.2, 0.4, 0.5, -0.6]))
    sensor = replace(Inertial.of("imu", T_tool_sensor=T), delay_s=0.0)
    for t_s in (0.3, 1.9):
        S = [pose(t_s + k * h) @ T for k in (-1, 0, 1)]
        force = S[1][:3, :3].T @ ((S[0] - 2 * S[1] + S[2])[:3, 3] / h**2 + UP)
        rate = log_se3(inverse(S[0]) @ S[2])[3:] / (2 * h)
        np.testing.assert_allclose(sensor.expected(motion(t_s), ACCELEROMETER).z, force, atol=1e-4)
        np.testing.assert_allclose(sensor.expected(motion(t_s), GYRO).z, rate, atol=1e-5)


def sweep(true, seed, count=200, seconds=20.0, noise=(1e-3, 0.02)):
    """Readings of both channels along the path."""
    rng, out = np.random.default_rng(seed), []
    for k, t_s in enumerate(np.linspace(0.0, seconds, count)):
        channel = k % 2
        z = true.expected(motion(t_s - true.delay_s), channel).z + rng.normal(0.0, noise[channel], 3)
        out.append(Reading(float(t_s), channel, z, noise[channel] ** 2 * np.eye(3)))
    return out


def test_mounting_biases_scales_and_delay_are_found_from_a_sweep():
    off, squares = [], []
    for seed in range(3):
        true = replace(some(10 + seed), delay_s=0.007)
        given, first = sweep(true, seed), Inertial.of("imu")
        got = calibrate(first.begun(given, motion), given, motion, fit_delay=True)
        miss = np.append(true.values - got.reference.values, true.delay_s - got.reference.delay_s)
        rotated = log_se3(inverse(got.reference.T_tool_sensor) @ true.T_tool_sensor)[3:]
        sigma = np.sqrt(np.append(np.diag(got.reference.cov), got.reference.sigma_delay_s**2))
        off.append(np.append(rotated, miss) / sigma)
        squares.append(got.squares.mean())
    assert 0.6 < np.mean(np.square(off)) < 1.5  # 117 numbers
    assert 0.85 < np.mean(squares) < 1.15


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: replace(r, z=r.z / STANDARD_GRAVITY_M_S2) if r.channel else r, "accelerometer reads .* as if in g;"),
        (lambda r: r if r.channel else replace(r, z=np.degrees(r.z)), "gyro reads .* as if in deg/s;"),
        (lambda r: replace(r, z=r.z * [1, 1, -1]), "axes are mirrored"),
    ],
)
def test_other_units_and_mirrored_axes_are_named(change, said):
    given = [change(r) for r in sweep(some(3), 0, count=60)]
    with pytest.raises(InputError, match=said):
        Inertial.of("imu").begun(given, motion)


def test_a_path_between_poses_does_not_cut_the_acceleration_of_a_fast_sweep():
    """30 poses a second at up to 4.6 rad/s; cubics cut 2 % of the acceleration, and of the lever."""
    at = np.arange(0.0, 12.0, 1 / 30)
    path = PosePath(at, np.array([pose(2 * t_s) for t_s in at]))
    times = np.arange(0.5, 11.5, 0.1)
    true = np.array([4 * motion(2 * t_s)[2] for t_s in times])
    off = np.array([path(t_s).acceleration for t_s in times]) - true
    share = np.linalg.norm(off, axis=0) / np.linalg.norm(true, axis=0)
    assert share.max() < 0.005
