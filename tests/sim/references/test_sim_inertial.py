"""The simulated inertial unit: without errors, each error by itself, and whether a calibration stays honest."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.geometry.pose import exp_se3
from armsight.loop.references.calibrate import PosePath, calibrate
from armsight.loop.references.inertial import Inertial
from armsight.loop.references.reference import Reading
from armsight.loop.references.stream import check_stream
from armsight.sim.references.inertial import InertialErrors, InertialUnit, record

T_S = np.arange(0.0, 16.0, 1e-3)
RATES = np.array([1.1, 1.7, 2.3, 0.9, 1.3, 1.9])
MOUNT = exp_se3(np.array([0.03, -0.05, 0.08, 0.3, -0.2, 0.5]))
QUIET = InertialErrors(noise=np.full(6, 1e-12), step=np.full(6, 1e-9), bandwidth_hz=400.0)


def poses(t):
    """The tool rotates by a radian and moves by 0.1 m about every axis; it begins and ends at rest."""
    ease = np.clip((t - 1.0) / 2.0, 0, 1) * np.clip((15.0 - t) / 2.0, 0, 1)
    ease = ease**3 * (10 - 15 * ease + 6 * ease**2)
    return exp_se3(ease[:, None] * np.repeat([0.1, 1.0], 3) * np.sin(RATES * t[:, None] + np.arange(6)))


def test_at_rest_it_reads_gravity_and_in_motion_the_rate():
    t, z = record(T_S, poses(T_S) @ MOUNT, QUIET, np.random.default_rng(0))
    np.testing.assert_allclose(z[50, 3:], MOUNT[:3, :3].T @ [0, 0, 9.80665], atol=1e-3)
    path = PosePath(T_S[::20], poses(T_S[::20]))
    sensor = Inertial.of("imu", T_tool_sensor=MOUNT)
    for k in range(300, 1200, 150):
        for channel in (0, 1):
            due = sensor.expected(path(t[k] - 1 / (np.sqrt(2) * np.pi * 400)), channel).z  # the chip's filter is late
            np.testing.assert_allclose(z[k, 3 * channel : 3 * channel + 3], due, atol=(2e-3, 2e-2)[channel])


def test_a_unit_that_is_read_as_time_passes_reads_what_it_records():
    """The same but for the order of random numbers: none is drawn that counts."""
    whole = record(T_S, poses(T_S) @ MOUNT, replace(QUIET, scale=np.full((6, 3), 0.01), clock=0.003), Random())
    unit = InertialUnit(replace(QUIET, scale=np.full((6, 3), 0.01), clock=0.003), Random())
    parts = [unit.read(T_S[k : k + 7], poses(T_S[k : k + 7]) @ MOUNT) for k in range(0, len(T_S), 7)]
    np.testing.assert_allclose(np.concatenate([t for t, _ in parts]), whole[0], atol=1e-12)
    np.testing.assert_allclose(np.concatenate([z for _, z in parts]), whole[1], atol=2e-8)


class Random:
    """No noise, nothing lost or repeated."""

    def normal(self, size):
        return np.zeros(size)

    def uniform(self, size):
        return np.full(size, 0.5)


def test_each_error_does_what_it_says():
    rng, Ts = np.random.default_rng(1), poses(T_S) @ MOUNT
    plain = record(T_S, Ts, QUIET, rng)[1]
    clipped = record(T_S, Ts, replace(QUIET, largest=np.repeat([1.0, 30.0], 3)), rng)
    assert check_stream(clipped[0], clipped[1], "imu").saturated
    warmed = record(T_S, Ts, replace(QUIET, warming=np.repeat([0.0, 0.1], 3), warming_s=4.0), rng)[1]
    np.testing.assert_allclose((warmed - plain)[-1, 3:], 0.1 * (1 - np.exp(-4.0)), atol=1e-3)
    slow = record(T_S, Ts, replace(QUIET, clock=0.01), rng)
    assert len(slow[0]) == pytest.approx(len(plain) / 1.01, abs=2)
    lost = record(T_S, Ts, replace(QUIET, lost=0.1, repeated=0.1), rng)
    assert check_stream(*lost, "imu").longest_gap_s >= 0.02
    still = check_stream(np.arange(len(plain)), plain, "imu").doubled  # at rest without noise nothing changes
    assert check_stream(*lost, "imu").doubled == pytest.approx(still + 0.1 * (1 - still), abs=0.03)
    loose = record(T_S, Ts, replace(QUIET, mount_hz=20.0), rng)[1]
    assert 1e-4 < np.abs(loose - plain)[:, 0].max() < 1.0
    assert np.abs(loose - plain)[:50].max() < 1e-6


def test_a_calibration_of_a_sensor_that_no_model_describes_is_near_and_says_how_near():
    """Warm-up, walk, rounding, the chip's filter and hum: what lasts shows in the times left out."""
    rng = np.random.default_rng(1)
    errors = InertialErrors(
        bias=rng.normal(size=6) * np.repeat([0.05, 0.2], 3),
        walk=np.repeat([1e-4, 1e-3], 3),
        warming=np.repeat([2e-3, 0.02], 3),
        warming_s=10.0,
        scale=np.vstack([rng.normal(0.0, 0.01, (3, 3)), np.triu(rng.normal(0.0, 0.01, (3, 3)))]),
        g_sensitivity=rng.normal(0.0, 1e-4, (3, 3)),
        hum=np.repeat([2e-3, 0.05], 3),
    )
    t, z = record(T_S, poses(T_S) @ MOUNT, errors, rng)
    at = T_S[::25]
    path = PosePath(at, poses(at))
    means = z[: len(z) // 5 * 5].reshape(-1, 5, 6).mean(axis=1)
    times = t[: len(means) * 5].reshape(-1, 5).mean(axis=1)
    noise = np.repeat([1.5e-3, 0.03], 3)
    readings = [
        Reading(float(s), c, each[3 * c : 3 * c + 3], np.diag(noise[3 * c : 3 * c + 3] ** 2))
        for s, each in zip(times, means, strict=True)
        if 0.3 < s < 15.7
        for c in (0, 1)
    ]
    found = calibrate(Inertial.of("imu").begun(readings, path), readings, path, fit_delay=True)
    apart = found.reference.T_tool_sensor[:3, :3].T @ MOUNT[:3, :3]
    assert np.degrees(np.arccos((np.trace(apart) - 1) / 2)) < 0.1
    assert 1.0 < np.mean(found.squares[found.used]) < 2.5
    off = (found.reference.values[:3] - MOUNT[:3, 3]) / np.sqrt(np.diag(found.reference.cov)[3:6])
    assert (np.abs(off) < 3.5).all()
    # The low-pass of 42 Hz is 1 / (sqrt(2) pi 42) s late.
    assert found.reference.delay_s == pytest.approx(5.4e-3, abs=2e-4)
