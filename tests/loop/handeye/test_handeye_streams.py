"""Two clocks and a pivot."""

import io
import zipfile

import numpy as np
import pytest
from handeye_motions import error
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.handeye.pivot import calibrate_pivot
from armsight.loop.handeye.streams import PoseStream, calibrate_streams, coarse_offset

OFFSET_S = 0.3217


def motion(t):
    """A smooth motion of all six degrees of freedom."""
    speeds = np.array([0.31, 0.47, 0.59, 0.71, 0.83, 1.03])
    size = np.array([0.2, 0.2, 0.15, 0.5, 0.4, 0.5])
    return exp_se3(size * np.sin(2 * np.pi * speeds * 0.3 * t[:, None] + np.arange(6)))


def streams(seed, eye="to_hand", noise_m=2e-4, noise_rad=1e-3, length_s=20.0):
    """A hand at 100 Hz, an eye at 30 Hz whose clock is behind by OFFSET_S, and the true Z and X."""
    rng = np.random.default_rng(seed)
    X, Z = exp_se3(rng.normal(0, [0.05] * 3 + [1] * 3)), exp_se3(rng.normal(0, [0.5] * 3 + [1] * 3))
    t_hand = np.arange(0, length_s, 0.01)
    t_eye = np.arange(0.5, length_s - 0.5, 1 / 30)
    A = motion(t_eye)
    B = inverse(Z) @ A @ X if eye == "to_hand" else inverse(A @ X) @ Z
    B = B @ exp_se3(rng.normal(0, [noise_m] * 3 + [noise_rad] * 3, (len(B), 6)))
    return PoseStream.of(t_hand, motion(t_hand), "hand"), PoseStream.of(t_eye - OFFSET_S, B, "eye"), Z, X


@pytest.mark.parametrize("eye", ["to_hand", "in_hand"])
def test_the_offset_and_the_mounting_are_found_within_their_sigmas(eye):
    squares, offsets = 0.0, []
    for seed in range(2):
        hand, seen, Z, X = streams(seed, eye)
        found = calibrate_streams(hand, seen, eye=eye)
        offsets.append((found.offset_s - OFFSET_S) / found.sigma_offset_s)
        assert found.sigma_offset_s < 1e-3
        e = error(found.handeye, Z, X)
        squares += float(np.sum(e**2 / np.diag(found.handeye.cov)))
    assert np.abs(offsets).max() < 4
    assert squares < chi2.isf(1e-3, 24) * 1.5  # the twelve are correlated: their squares scatter more than 24 free ones


def test_the_coarse_offset_is_within_a_sample():
    hand, seen, _, _ = streams(3)
    assert coarse_offset(hand, seen) == pytest.approx(OFFSET_S, abs=1.5 / 30)


@pytest.mark.parametrize(("noise_rad", "blunders"), [(1e-3, 0.2), (0.1, 0.0)])
def test_blunders_and_noise_leave_the_coarse_offset_near(noise_rad, blunders):
    hand, seen, _, _ = streams(3, noise_rad=noise_rad)
    rng, Ts = np.random.default_rng(8), seen.Ts.copy()
    wrong = rng.random(len(Ts)) < blunders
    Ts[wrong, :3, :3] = Rotation.random(int(wrong.sum()), random_state=8).as_matrix()
    assert coarse_offset(hand, PoseStream(seen.t_s, Ts)) == pytest.approx(OFFSET_S, abs=1.5 / 30)


def test_streams_that_stand_still_or_do_not_overlap_are_rejected():
    hand, seen, _, _ = streams(3)
    still = PoseStream(hand.t_s, np.repeat(hand.Ts[:1], len(hand.t_s), axis=0))
    with pytest.raises(CalibrationError, match="nothing rotates"):
        calibrate_streams(still, PoseStream(seen.t_s, np.repeat(seen.Ts[:1], len(seen.t_s), axis=0)))
    with pytest.raises(InputError, match="20 and more"):
        PoseStream.of(seen.t_s[:10], seen.Ts[:10], "eye")


def pivoting(seed, n=40, spread=0.5, noise=1e-4):
    rng = np.random.default_rng(seed)
    tip, at = np.array([0.01, -0.02, 0.15]), np.array([0.4, 0.1, 0.3])
    Ts = exp_se3(np.concatenate([np.zeros((n, 3)), rng.uniform(-spread, spread, (n, 3))], axis=1))
    Ts[:, :3, 3] = at - Ts[:, :3, :3] @ tip + rng.normal(0, noise, (n, 3))
    return Ts, np.concatenate([tip, at])


def test_a_pivot_is_found_within_its_sigma():
    squares = 0.0
    for seed in range(20):
        Ts, truth = pivoting(seed)
        Ts[0, :3, 3] += 0.01
        found = calibrate_pivot(Ts)
        assert not found.used[0]
        assert found.used.sum() >= 38
        e = np.concatenate([found.p_body, found.p_pivot]) - truth
        squares += float(e @ np.linalg.solve(found.cov, e))
    assert chi2.ppf(1e-3, 120) < squares < chi2.isf(1e-3, 120) * 1.15  # scale from 114 numbers each
    assert np.nanmean(found.held_out_m) == pytest.approx(1e-4 * np.sqrt(8 / np.pi), rel=0.3)


def test_a_tool_that_hardly_rotates_is_rejected():
    phi = np.vstack([np.outer(np.linspace(-1, 1, 7), [0, 0, 1.0]), [1.0, 0, 0]])
    Ts = np.tile(np.eye(4), (8, 1, 1))
    Ts[:, :3, :3] = Rotation.from_rotvec(phi).as_matrix()
    Ts[:, :3, 3] = -Ts[:, :3, :3] @ [0, 0, 0.2]
    with pytest.raises(CalibrationError, match="one axis only"):  # one pose alone would decide
        calibrate_pivot(Ts)
    with pytest.raises(CalibrationError, match="rotated too little"):
        calibrate_pivot(pivoting(1, spread=0.01)[0])
    with pytest.raises(InputError, match="4 or more"):
        calibrate_pivot(pivoting(1)[0][:3])


def recorded(data_dir, archive, end):
    """Times and poses t, x, y, z, qx, qy, qz, qw of a recording of others."""
    with zipfile.ZipFile(data_dir / "handeye" / "eth_posepairs" / "datasets" / f"{archive}.zip") as files:
        name = next(name for name in files.namelist() if name.endswith(end))
        D = np.loadtxt(io.BytesIO(files.read(name)), delimiter=",")
    T = np.tile(np.eye(4), (len(D), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(D[:, 4:8]).as_matrix(), D[:, 1:4]
    return D[:, 0], T


def test_a_simulated_arms_one_clock_has_no_offset_and_its_own_motion_gives_back_a_known_mounting(data_dir):
    hand = PoseStream.of(*recorded(data_dir, "robot_arm_w_color_camera_sim", "sim_hand.csv"), "hand")
    t, T = (each[::4] for each in recorded(data_dir, "robot_arm_w_color_camera_sim", "sim_camera.csv"))
    found = calibrate_streams(hand, PoseStream.of(t, inverse(T), "eye"), eye="in_hand")
    assert abs(found.offset_s) < 3 * np.hypot(found.sigma_offset_s, 1e-3)  # stamps are those of steps of 1 ms
    A, good = hand.at(t - OFFSET_S)  # what an eye of a known mounting, whose clock is behind, would have seen
    rng = np.random.default_rng(0)
    X, Z = exp_se3(rng.normal(0, [0.05] * 3 + [1] * 3)), exp_se3(rng.normal(0, [0.5] * 3 + [1] * 3))
    B = inverse(A[good] @ X) @ Z @ exp_se3(rng.normal(0, [1e-3] * 3 + [2e-3] * 3, (int(good.sum()), 6)))
    known = calibrate_streams(hand, PoseStream.of(t[good], B, "eye"), eye="in_hand")
    assert abs(known.offset_s + OFFSET_S) < 3.5 * known.sigma_offset_s
    assert np.abs(error(known.handeye, Z, X) / np.sqrt(np.diag(known.handeye.cov))).max() < 3.5
