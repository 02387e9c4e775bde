"""Skew and readout of two cameras from a moving body: found with an honest sigma, rejected of a slow one, corrected."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Body, Correspondences, Missed, PoseEstimate
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.vision.pose import shutter
from armsight.vision.pose.bundle import CAUCHY_SCALE
from armsight.vision.pose.posefit import PixelObservations, whitened
from armsight.vision.pose.shutter import (
    Motion,
    Shutters,
    TimedShot,
    estimate_shutters,
    measure_moving,
    measure_with_motion,
)

SKEW_S, READOUT_S, SIGMA_PX, RATE_HZ = 5e-3, 14e-3, 0.1, 30.0
RIG = replace(example_rig((1280, 720), 900.0), sigma_px=0.0)
POINTS = np.column_stack([np.mgrid[:5, :4].reshape(2, -1).T * 0.04 - [0.08, 0.06], np.zeros(20)])
BODY = Body("plate", tuple(map(str, range(20))), POINTS)
NOTHING = Shutters(0.0, 0.0, np.zeros((2, 2)))


def at(t, speed, phase):
    """Poses (N, 4, 4) at times (N,) of a body that moves and rotates at about a speed, m/s and rad/s."""
    f = 2 * np.pi * np.array([0.5, 0.7, 0.4, 0.6, 0.3, 0.5])
    x = speed * np.sqrt(2 / 3) * np.repeat([1.0, 2.0], 3) / f * np.sin(f * np.atleast_1d(t)[:, None] + phase)
    T = np.tile(pose(exp_so3(np.array([0.2, -0.3, 0.4])), np.array([0.1, 0.0, 0.8])), (len(x), 1, 1))
    T[:, :3, :3] = T[:, :3, :3] @ exp_so3(x[:, 3:])
    T[:, :3, 3] += x[:, :3]
    return T


def recorded(seed, speed, skew_s=SKEW_S, readout_s=READOUT_S, *, count=24, stamped_s=0.0, sigma_px=SIGMA_PX):
    """Shots of a moving body with their noise, and its true poses; the stamps of the right camera vary by ``stamped_s``."""
    rng = np.random.default_rng(seed)
    phase, shots = rng.uniform(0, 2 * np.pi, 6), []
    t_s = np.arange(count) / RATE_HZ
    for t in t_s:
        apart_s, uv = stamped_s * rng.normal(), np.empty((20, 2, 2))
        for c, camera in enumerate(RIG.cameras):
            late = np.zeros(20)
            for _ in range(4):  # the row that sees a point depends on when it looks
                T = at(t + c * (skew_s + apart_s) + late, speed, phase)
                p = np.einsum("nij,nj->ni", T[:, :3, :3], POINTS) + T[:, :3, 3]
                uv[:, c] = camera.project(transform(inverse(RIG.T_left_right), p) if c else p)
                late = ((uv[:, c, 1] + 0.5) / 720 - 0.5) * readout_s
        uv += sigma_px * rng.standard_normal(uv.shape)
        seen = Correspondences(np.arange(20), uv, np.tile(sigma_px**2 * np.eye(2), (20, 2, 1, 1)))
        shots.append(TimedShot(float(t), seen, at(t + 1e-3, speed, phase)[0], apart_s))
    return shots, at(t_s, speed, phase)


def test_skew_and_readout_are_found_and_their_sigma_is_honest():
    z = []
    for seed in range(12):
        found = estimate_shutters(RIG, BODY, recorded(seed, 0.3)[0], readout=True)
        assert isinstance(found, Shutters)
        assert abs(found.skew_s - SKEW_S) < 2e-4
        z.append((np.array([found.skew_s, found.readout_s]) - [SKEW_S, READOUT_S]) / found.sigmas)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert ((rms > 0.5) & (rms < 1.5)).all(), rms


@pytest.mark.parametrize("both", [False, True])
def test_errors_of_points_that_persist_from_shot_to_shot_are_in_the_sigma(both):
    z, motion_only = [], []
    for seed in range(12):
        shots = recorded(seed, 0.3, sigma_px=0.02)[0]
        off = np.random.default_rng([seed, 1]).normal(0, 0.05, (20, 2, 2))  # of each point in each camera, in all shots
        if both:
            off[:, 1] = off[:, 0]
        persistent = [replace(shot, seen=replace(shot.seen, uv=shot.seen.uv + off)) for shot in shots]
        found = [estimate_shutters(RIG, BODY, some, readout=True) for some in (persistent, shots)]
        assert all(isinstance(each, Shutters) for each in found)
        error = np.array([found[0].skew_s, found[0].readout_s]) - [SKEW_S, READOUT_S]
        z.append(error / found[0].sigmas)
        motion_only.append(error / found[1].sigmas)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert ((rms > 0.5) & (rms < 1.5)).all(), rms
    assert np.sqrt(np.mean(np.square(motion_only), axis=0)).max() > 3  # they matter


@pytest.mark.parametrize("skew_s", [-8e-3, 0.0, 15e-3])
def test_skew_of_global_shutters_is_found_whatever_its_sign(skew_s):
    found = estimate_shutters(RIG, BODY, recorded(1, 0.3, skew_s, 0.0)[0])
    assert isinstance(found, Shutters)
    assert abs(found.skew_s - skew_s) < 4 * found.sigmas[0] < 4e-4


def test_known_readout_is_held_and_stamps_that_differ_are_taken_into_account():
    shots = recorded(2, 0.3, stamped_s=3e-3)[0]
    known = Shutters(0.0, READOUT_S, np.zeros((2, 2)))
    found = estimate_shutters(RIG, BODY, shots, known=known)
    assert isinstance(found, Shutters)
    assert found.readout_s == READOUT_S
    assert abs(found.skew_s - SKEW_S) < 4 * found.sigmas[0]
    blind = estimate_shutters(RIG, BODY, [replace(shot, apart_s=0.0) for shot in shots], known=known)
    assert isinstance(blind, Missed) or blind.sigmas[0] > 3 * found.sigmas[0]


def test_kernels_move_pixels_and_sum_scores_as_whole_poses_and_matrices_do():
    shot, rng = recorded(7, 0.3, count=1)[0][0], np.random.default_rng(7)
    o, T = PixelObservations.of(shot.seen, 0.2), shot.T_left_body
    motion = Motion(rng.normal(size=6), rng.normal(size=6), np.diag(rng.uniform(1e-6, 1e-5, 6)), True)
    dt, scale2 = np.append(rng.uniform(-0.02, 0.02, len(o.point) - 1), 1e-9), 1.3
    by = np.column_stack([o.camera, rng.uniform(-0.5, 0.5, len(dt))])
    p = POINTS[o.point]
    Ts = T @ exp_se3(motion.twist * dt[:, None] + motion.acceleration * dt[:, None] ** 2 / 2)
    uv, now = np.empty((2, len(dt), 2))
    for rows in (o.camera == 0, o.camera == 1):
        to_camera = inverse(RIG.T_left_right) if o.camera[rows][0] else np.eye(4)
        camera = RIG.cameras[o.camera[rows][0]]
        now[rows] = camera.project(transform(to_camera @ T, p[rows]))
        uv[rows] = o.uv[rows] - camera.project(transform(to_camera @ Ts[rows], p[rows])) + now[rows]
    np.testing.assert_allclose(shutter._at_one_time(RIG, BODY, o, T, motion, dt).uv, uv, atol=1e-9)

    W, A, _ = whitened(RIG.cameras, RIG.T_left_right, POINTS, o, T)
    r = (W @ (uv - now)[..., None])[..., 0]
    d2 = (r**2).sum(axis=1)
    root = np.repeat(np.sqrt(1.0 / (1.0 + d2 / (CAUCHY_SCALE**2 * scale2)) / scale2), 2)
    r, A = r.ravel() * root, A * root[:, None]
    rates = (A.reshape(-1, 2, 6) @ (motion.twist + dt[:, None] * motion.acceleration)[..., None])[..., 0]
    Q = np.linalg.qr(A)[0]
    M, *D = ((rates[:, :, None] * by[:, None]).reshape(-1, 2), *(A * np.repeat(b, 2)[:, None] for b in by.T))
    M, *D = (each - Q @ (Q.T @ each) for each in (M, *D))
    noise = [[np.trace(a.T @ b @ motion.cov) for b in D] for a in D]
    found = shutter._linear(RIG, BODY, o, T, motion, (dt, by), 2, scale2)
    for got, expected in zip(found, (M.T @ r, M.T @ M, noise, d2), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-7)


def test_wrong_detections_do_not_move_the_skew():
    shots = recorded(3, 0.3, readout_s=0.0)[0]
    for shot in shots[::3]:
        uv = np.array(shot.seen.uv)
        uv[4, 1] += 8.0
        shots[shots.index(shot)] = replace(shot, seen=replace(shot.seen, uv=uv))
    found = estimate_shutters(RIG, BODY, shots)
    assert isinstance(found, Shutters)
    assert abs(found.skew_s - SKEW_S) < 2e-4


def test_slow_and_short_motions_are_rejected_with_a_reason():
    still = estimate_shutters(RIG, BODY, recorded(4, 0.0)[0])
    slow = estimate_shutters(RIG, BODY, recorded(4, 0.01)[0], readout=True)
    short = estimate_shutters(RIG, BODY, recorded(4, 0.3, count=5)[0])
    assert isinstance(still, Missed)
    assert "slow" in still.reason
    assert isinstance(slow, Missed)
    assert "slow" in slow.reason
    assert isinstance(short, Missed)
    assert "3 shots" in short.reason


def test_moved_to_one_time_a_moving_body_is_measured_as_by_synchronised_cameras():
    def rms_and_nees(shots, truth, shutters):
        results = [r for r, _ in measure_moving(RIG, BODY, shots, shutters)]
        assert all(isinstance(r, PoseEstimate) for r in results)
        gaps = [
            r.T_left_body[:3, :3].T @ (T[:3, 3] - r.T_left_body[:3, 3]) for r, T in zip(results, truth, strict=True)
        ]
        nees = [g @ np.linalg.solve(r.cov[:3, :3], g) / 3 for g, r in zip(gaps, results, strict=True)]
        return np.sqrt(np.mean(np.square(gaps))), np.mean(nees)

    apart, together = recorded(5, 0.3), recorded(5, 0.3, 0.0, 0.0)
    found = estimate_shutters(RIG, BODY, apart[0], readout=True)
    as_it_is, _ = rms_and_nees(*apart, NOTHING)
    corrected, nees = rms_and_nees(*apart, found)
    reference, _ = rms_and_nees(*together, NOTHING)
    assert as_it_is > 10 * reference
    assert corrected < 1.5 * reference
    assert 0.5 < nees < 1.6
    unsure = measure_moving(RIG, BODY, apart[0], replace(found, cov=np.diag([1e-6, 0.0])))
    sure = measure_moving(RIG, BODY, apart[0], replace(found, cov=np.zeros((2, 2))))
    assert all(np.trace(a.cov[:3, :3]) > np.trace(b.cov[:3, :3]) for (a, _), (b, _) in zip(unsure, sure, strict=True))


def test_a_shot_alone_is_measured_with_a_motion_that_is_known_otherwise():
    """Monte Carlo over shots whose skew varies and whose velocity is known with an error."""
    speed, jitter_s, sigma = 0.4, 1e-3, np.repeat([0.01, 0.02], 3)
    shutters = Shutters(SKEW_S, READOUT_S, np.zeros((2, 2)), jitter_s)
    nees, gaps, blind, rng = [], [], [], np.random.default_rng(20)
    for seed in range(6):
        shots, truth = recorded(seed, speed, stamped_s=jitter_s)
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 6)
        for shot, T in zip(shots, truth, strict=True):
            before, after = (at(shot.t_s + dt, speed, phase)[0] for dt in (-0.01, 0.01))
            back, on = (log_se3(inverse(T) @ there) for there in (before, after))
            twist = (on - back) / 0.02 + sigma * rng.normal(size=6)
            motion = Motion(twist, (on + back) / 1e-4, np.diag(sigma**2), True)
            found = measure_with_motion(RIG, BODY, replace(shot, apart_s=0.0), motion, shutters)
            assert isinstance(found, PoseEstimate)
            gap = log_se3(inverse(found.T_left_body) @ T)
            nees.append(gap @ np.linalg.solve(found.cov, gap))
            gaps.append(gap[:3])
            still = measure_with_motion(RIG, BODY, shot, motion, NOTHING)
            assert isinstance(still, PoseEstimate)
            blind.append(log_se3(inverse(still.T_left_body) @ T)[:3])
    assert 4.8 < np.mean(nees) < 7.5
    assert np.mean(np.square(gaps)) < np.mean(np.square(blind)) / 25


def test_skew_that_varies_is_followed_from_shot_to_shot():
    jitter_s = 4e-3
    shots, truth = recorded(6, 0.3, readout_s=0.0, stamped_s=jitter_s, count=40)
    shots = [replace(shot, apart_s=0.0) for shot in shots]
    found = estimate_shutters(RIG, BODY, shots)
    assert isinstance(found, Shutters)
    assert abs(found.skew_s - SKEW_S) < 4 * found.sigmas[0]
    assert 0.6 * jitter_s < found.jitter_s < 1.5 * jitter_s
    results = [r for r, _ in measure_moving(RIG, BODY, shots, found)]
    blind = [r for r, _ in measure_moving(RIG, BODY, shots, replace(found, jitter_s=0.0))]

    def gaps(estimates):
        pairs = [(r.T_left_body, T) for r, T in zip(estimates, truth, strict=True) if isinstance(r, PoseEstimate)]
        return [T[:3, :3].T @ (T_true[:3, 3] - T[:3, 3]) for T, T_true in pairs]

    assert all(isinstance(r, PoseEstimate) for r in results)
    assert np.sqrt(np.mean(np.square(gaps(results)))) < np.sqrt(np.mean(np.square(gaps(blind)))) / 5
    nees = [g @ np.linalg.solve(r.cov[:3, :3], g) / 3 for g, r in zip(gaps(results), results, strict=True)]
    assert 0.5 < np.mean(nees) < 1.8
