"""Sources of the error, the covariance by Monte Carlo, and what the motion leaves open."""

from dataclasses import replace

import numpy as np
import pytest
from handeye_motions import error
from scipy.stats import chi2

from armsight.errors import CalibrationError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.handeye.handeye import TRUSTED_M, TRUSTED_RAD, calibrate_poses, known_where_seen, require_known
from armsight.loop.handeye.poses import Poses
from armsight.loop.handeye.sources import pose_kernel
from armsight.robot.arm_file import open_arm

CENTRE = np.array([0.05, 0.03, 0.0])


def made(
    seed,
    *,
    n=25,
    in_hand=False,
    flange=(0.0, 0.0),
    camera=(0.0, 0.0, 0.0),
    links=(0.0, 0.0),
    walk=(0.0, 0.0),
    spread=0.6,
):
    """Poses whose noise is known, the true Z and X, and T_link_flange; sigmas in m and rad."""
    rng = np.random.default_rng(seed)
    arm = open_arm("six_r")
    q = arm.home + rng.uniform(-spread, spread, (n, 6))
    frames = np.array([arm.links(one) for one in q])
    to_flange = inverse(frames) @ frames[:, -1:]
    X, Z = exp_se3(rng.normal(0, [0.05] * 3 + [1] * 3)), exp_se3(rng.normal(0, [0.5] * 3 + [1] * 3))
    A = frames[:, -1]
    wrong = rng.normal(0, [links[0]] * 3 + [links[1]] * 3, (8, 6))  # one constant error a link
    true = A.copy()
    for k in range(8):
        true = true @ inverse(to_flange[:, k]) @ exp_se3(wrong[k]) @ to_flange[:, k]
    true = true @ exp_se3(rng.normal(0, [flange[0]] * 3 + [flange[1]] * 3, (n, 6)))
    B = inverse(true @ X) @ Z if in_hand else inverse(Z) @ true @ X
    about = exp_se3(np.concatenate([CENTRE, np.zeros(3)]))
    B = (
        B
        @ about
        @ exp_se3(np.concatenate([np.zeros((n, 3)), rng.normal(0, camera[2], (n, 3))], axis=1))
        @ inverse(about)
    )
    B[:, :3, 3] += rng.normal(0, [camera[0], camera[0], camera[1]], (n, 3))
    if any(walk):
        eye, steps = inverse(B), exp_se3(rng.normal(0, [walk[0]] * 3 + [walk[1]] * 3, (n, 6)))
        walked = [eye[0]]
        for k in range(1, n):
            walked.append(walked[-1] @ inverse(eye[k - 1]) @ eye[k] @ steps[k])
        B = inverse(np.array(walked))
    return Poses(A, B, np.zeros((n, 6, 6)), in_hand, CENTRE), Z, X, to_flange


def nees(found, Z, X):
    e = error(found, Z, X)
    return float(e @ np.linalg.solve(found.cov, e))


def nees_held(found, X):
    e = log_se3(inverse(found.T_flange_held) @ X)
    return float(e @ np.linalg.solve(found.cov[6:, 6:], e))


@pytest.mark.parametrize("in_hand", [False, True])
def test_the_covariance_holds_the_error_of_arm_and_camera(in_hand):
    squares = []
    for seed in range(8):
        poses, Z, X, _ = made(seed, in_hand=in_hand, flange=(3e-4, 5e-4), camera=(5e-4, 2e-3, 1e-3))
        found = calibrate_poses(poses, quick=True)
        squares.append(nees(found, Z, X))
    # Chance 1e-3 at either end; the variances come from 138 numbers each, the covariance is widened for that.
    assert chi2.ppf(1e-3, 96) / 1.2 < sum(squares) < 1.2 * chi2.isf(1e-3, 96)


def test_an_arm_whose_geometry_is_off_is_recognised_and_the_covariance_allows_for_it():
    of_links, white, left_out = [], [], []
    for seed in range(4):
        poses, Z, X, links = made(seed, n=30, camera=(2e-4, 5e-4, 5e-4), links=(3e-4, 1e-3))
        found = calibrate_poses(poses, links=links)
        assert "robot's geometry off" in found.structure
        assert found.arm_off > 0.99
        errors = (found.held_out_geometry, found.held_out_nominal, found.held_out)
        left_out.append([error.rms()[0] for error in errors])
        of_links.append(nees(found, Z, X))
        white.append(nees(calibrate_poses(poses, quick=True), Z, X))
    # The mounting of the true arm, found beside its links, predicts worse with the model than the one that suits the model.
    of_geometry, of_model, of_true_arm = np.mean(left_out, axis=0)
    assert 1.1 * of_geometry < of_model < of_true_arm
    # Eight links say little about their variances: the median, of which a draw of three sigmas takes nothing.
    assert chi2.ppf(0.05, 12) < np.median(of_links) < chi2.isf(0.05, 12)
    assert np.median(white) > 10 * np.median(of_links)  # what noise that changes from pose to pose would have claimed


@pytest.mark.parametrize(("share", "said"), [([1, 1, 1], "target's size"), ([0, 0, 1], "depths")])
def test_what_the_eye_sees_too_far_away_is_named_and_the_covariance_allows_for_it(share, said):
    off, named = [], []
    for seed in range(6):
        poses, Z, X, links = made(seed, n=30, camera=(2e-4, 5e-4, 5e-4), in_hand=bool(seed % 2))
        assert calibrate_poses(poses, links=links).mistaken_eye() == []
        B = poses.B.copy()
        B[:, :3, 3] *= 1 + 0.01 * np.array(share)
        found = calibrate_poses(replace(poses, B=B), links=links)
        off.append(nees(found, Z, X))
        named.append([said in each and ("by 1.0" in each or "by 0.9" in each) for each in found.mistaken_eye()])
    assert chi2.ppf(0.05, 12) < np.median(off) < chi2.isf(0.05, 12)
    assert named == [[True]] * 6


def test_an_arm_that_bends_by_its_pose_is_not_taken_for_noise_though_its_joints_are_known():
    off = []
    for seed in range(4):
        poses, Z, X, links = made(seed, n=30, camera=(2e-4, 5e-4, 5e-4), flange=(2e-4, 4e-4))
        down = -poses.A[:, 2, :3]
        bent = exp_se3(np.concatenate([0 * down, 5e-3 * np.cross([0.0, 0.0, 1.0], down)], axis=1))
        found = calibrate_poses(replace(poses, B=poses.B @ inverse(X) @ bent @ X), links=links)
        assert found.arm_off > 0.99
        off.append(nees(found, Z, X))
    assert np.median(off) < chi2.isf(0.05, 12)


def test_what_an_arms_lengths_do_in_all_poses_alike_is_allowed_for():
    # Half a millimetre a link, without joints: a millimetre of the mounting, of which a fifth is in the residuals.
    off, claimed = [], []
    for seed in range(5):
        poses, _, X, _ = made(
            seed, n=25, in_hand=True, camera=(3e-4, 8e-4, 5e-4), flange=(1e-4, 1e-4), links=(5e-4, 0.0), spread=0.4
        )
        for quick, squares in ((False, off), (True, claimed)):
            found = calibrate_poses(poses, quick=quick)
            squares.append(nees_held(found, X))
    assert sum(off) < 0.25 * sum(claimed)


@pytest.mark.parametrize("seed", range(3))
def test_an_arms_smooth_error_is_found_where_the_poses_are_near_each_other(seed):
    # A correlation that is wide beside their spread is nearly the same for all, and its mean is what the fit takes away.
    poses, _, X, _ = made(
        seed, n=40, in_hand=True, flange=(3e-5, 5e-5), camera=(5e-5, 1e-4, 1e-4), links=(5e-4, 3e-3), spread=0.25
    )
    found = calibrate_poses(poses)
    assert "drift_m" in found.sigmas
    assert nees_held(found, X) < chi2.isf(1e-3, 6)  # 446 to 751 without the drift
    assert found.held_out_geometry is not None
    assert found.held_out_geometry.rms()[0] < 0.75 * found.held_out_nominal.rms()[0]


def test_lengths_of_links_that_no_residual_shows_are_allowed_for():
    squares = []
    for seed in range(6):
        poses, _, X, links = made(
            seed, n=20, in_hand=True, flange=(5e-4, 1e-3), camera=(1e-3, 3e-3, 2e-3), links=(1e-3, 2e-4)
        )
        found = calibrate_poses(poses, links=links)
        squares.append(nees_held(found, X))
    assert sum(squares) < chi2.isf(1e-3, 36)


def test_poses_left_out_distinguish_the_arms_error_from_the_cameras():
    arm = calibrate_poses(made(1, n=60, flange=(1e-4, 5e-3))[0])
    camera = calibrate_poses(made(1, n=60, camera=(2e-4, 2e-3, 1e-3))[0])
    assert arm.likelihoods["robot"] > arm.likelihoods["camera"] + 0.2
    assert camera.likelihoods["camera"] > camera.likelihoods["robot"] + 0.2
    assert arm.sigmas["flange_rad"] == pytest.approx(5e-3, rel=0.2)
    assert camera.sigmas["depth_m"] == pytest.approx(2e-3, rel=0.3)
    assert camera.camera_m > 3 * camera.arm_m


def test_errors_that_vision_shares_between_poses_are_found_by_the_arm():
    poses, Z, X, _ = made(4, n=30, flange=(1e-4, 2e-4), camera=(1e-4, 2e-4, 3e-4))
    depth = poses.B[:, :3, 3] * (
        poses.B[:, 2, 3:] - poses.B[:, 2, 3].mean()
    )  # along the view, a third of a mm at 1 sigma
    scale = 3e-4 / np.linalg.norm(depth, axis=1).max()
    common = np.zeros((30, 6, 1))
    common[:, :3, 0] = scale * np.einsum("nji,nj->ni", poses.B[:, :3, :3], depth)
    off = exp_se3(-4.0 * common[..., 0])
    wrong = Poses(poses.A, poses.B @ off, poses.cov, poses.in_hand, poses.centre, common)
    found, without = (calibrate_poses(p, quick=True) for p in (wrong, replace(wrong, common=None)))
    assert found.common[0] == pytest.approx(4.0, abs=1.5)
    assert nees(found, Z, X) < chi2.isf(1e-3, 12)
    assert found.held_out.rms()[0] < 0.9 * without.held_out.rms()[0]
    assert without.common_m == 0 < found.common_m


@pytest.mark.parametrize("steps", [(0.0, 0.0), (5e-4, 5e-4)], ids=["eye-seen", "eye-walking"])
def test_a_scale_that_walks_is_recognised_and_the_covariance_allows_for_it(steps):
    squares, off = [], []
    for seed in range(1):
        poses, _, X, _ = made(seed, n=40, in_hand=True, flange=(5e-5, 5e-5), camera=(1e-4, 1e-4, 1e-4), walk=steps)
        walked = np.cumsum(np.random.default_rng(seed).normal(0, 4e-3, 40))
        eye = inverse(poses.B)
        eye[:, :3, 3] *= 2 * np.exp(walked - walked[0])[:, None]
        poses = replace(poses, B=inverse(eye))
        found, before = (calibrate_poses(poses, t_s=t_s, scale=True) for t_s in (np.arange(40.0), None))
        assert ("camera walking" in found.structure) == any(steps)
        assert found.sigmas["scale_walk"] == pytest.approx(4e-3 * np.sqrt(39), rel=0.4)
        squares.append(nees_held(found, X))
        off.append([np.linalg.norm(each.T_flange_held[:3, 3] - X[:3, 3]) for each in (found, before)])
    assert sum(squares) < chi2.isf(1e-3, 6)
    assert sum(found for found, _ in off) < 0.5 * sum(before for _, before in off)


def test_a_scale_is_rejected_where_the_flange_only_rotates():
    rng = np.random.default_rng(8)
    A = exp_se3(np.concatenate([np.zeros((60, 3)), rng.uniform(-0.5, 0.5, (60, 3))], axis=1))
    A[:, :3, 3] = [0.4, 0.1, 0.3]
    X, Z = exp_se3(np.array([0.02, -0.05, 0.06, 0.1, 0.2, -0.3])), exp_se3(np.array([0.6, 0.1, 0.0, 0.5, -1.0, 0.2]))
    B = inverse(A @ X) @ Z @ exp_se3(rng.normal(size=(60, 6)) * 2e-4)
    B[:, :3, 3] *= 0.2
    measured = A @ exp_se3(rng.normal(size=(60, 6)) * 5e-4)
    with pytest.raises(CalibrationError, match=r"hardly moves: its positions spread by 0\.\d mm"):
        calibrate_poses(Poses(measured, B, np.zeros((60, 6, 6)), True, np.zeros(3)), scale=True)


def test_a_scale_that_runs_away_is_not_taken():
    # The wrist alone rotates: the flange hardly moves, and lengths of zero explain that, too.
    rng = np.random.default_rng(2)
    arm = open_arm("irb120")
    q = np.tile(arm.home, (80, 1))
    q[:, 3:] += rng.uniform(-0.2, 0.2, (80, 3))
    A = np.array([arm.forward(one) for one in q]) @ exp_se3(rng.normal(0, [5e-4] * 3 + [3e-4] * 3, (80, 6)))
    X, Z = exp_se3(np.array([0.02, -0.05, 0.06, 0.1, 0.2, -0.3])), exp_se3(np.array([0.6, 0.1, 0.0, 0.5, -1.0, 0.2]))
    B = inverse(A @ X) @ Z
    B[:, :3, 3] += rng.normal(0, [3e-3, 3e-3, 9e-3], (80, 3))
    B[:, :3, :3] = B[:, :3, :3] @ exp_se3(np.c_[np.zeros((80, 3)), rng.normal(0, 2e-3, (80, 3))])[:, :3, :3]
    found = calibrate_poses(Poses(A, B, np.zeros((80, 6, 6)), True, np.zeros(3)), scale=True)
    assert found.scale == 1  # 0.35 was taken
    assert nees(found, Z, X) < chi2.isf(1e-3, 12)


def test_a_walk_of_the_eye_is_recognised():
    poses, Z, X, _ = made(3, n=40, in_hand=True, flange=(1e-5, 1e-5), walk=(1e-3, 1e-3))
    found = calibrate_poses(poses, t_s=np.arange(40.0))
    assert "camera walking" in found.structure
    assert found.sigmas["walk_m"] == pytest.approx(1e-3, rel=0.4)
    assert nees(found, Z, X) < chi2.isf(1e-4, 12)


def test_an_arm_that_wanders_is_recognised_by_poses_left_out():
    poses, Z, X, _ = made(5, n=30, flange=(5e-5, 5e-5), camera=(5e-5, 5e-5, 5e-5))
    steps = np.random.default_rng(6).normal(0.0, 4e-4, (30, 6))
    wandered = replace(poses, A=poses.A @ exp_se3(np.cumsum(steps, axis=0)))
    found = calibrate_poses(wandered, t_s=np.arange(30.0))
    assert "over time" in found.structure
    assert nees(found, Z, X) < chi2.isf(1e-3, 12)
    assert nees(calibrate_poses(wandered, quick=True), Z, X) > 10 * nees(found, Z, X)


def test_the_order_of_the_rows_changes_nothing():
    poses, _, _, _ = made(5, flange=(1e-3, 1e-3), camera=(1e-3, 1e-3, 1e-3))
    B = poses.B.copy()
    B[4] = B[4] @ exp_se3(np.array([0.05, 0, 0, 0.2, 0, 0]))
    poses = Poses(poses.A, B, poses.cov, poses.in_hand, poses.centre)
    shuffled = np.random.default_rng(0).permutation(25)
    one, other = calibrate_poses(poses), calibrate_poses(poses.rows(shuffled))
    np.testing.assert_array_equal(one.T_flange_held, other.T_flange_held)
    np.testing.assert_array_equal(one.cov, other.cov)
    np.testing.assert_array_equal(one.used[shuffled], other.used)
    np.testing.assert_array_equal(one.held_out.position_m[shuffled], other.held_out.position_m)
    assert list(np.flatnonzero(~one.used)) == [4]


def test_a_target_of_another_size_is_found():
    poses, Z, X, _ = made(6, n=40, camera=(3e-4, 3e-4, 5e-4))
    B = poses.B.copy()
    B[:, :3, 3] *= 0.9
    wrong = Poses(poses.A, B, poses.cov, poses.in_hand, poses.centre)
    found = calibrate_poses(wrong, scale=True)
    assert abs(found.scale - 1 / 0.9) < 4 * found.sigma_scale
    assert found.sigma_scale < 2e-3
    assert nees(found, Z, X) < chi2.isf(1e-4, 12)
    assert calibrate_poses(poses, scale=True).sigma_scale == 0.0  # 1 is kept where nothing speaks against it


def rotated(xi, n=20, seed=0, noise=0.0):
    """Poses of a flange that moves along tangents, seen exactly but for the rotation's noise, rad."""
    rng = np.random.default_rng(seed)
    A = exp_se3(xi)
    B = A @ exp_se3(np.array([0.02, 0.05, 0.1, 0.3, -0.2, 0.4]))
    B = B @ exp_se3(rng.normal(0, [noise] * 6, (n, 6)))
    return Poses(A, B, np.zeros((n, 6, 6)), False, np.zeros(3))


def test_rotation_about_one_axis_is_rejected_and_the_axis_named_also_under_noise():
    xi = np.zeros((20, 6))
    xi[:, 0], xi[:, 4] = np.linspace(0, 0.3, 20), np.linspace(-0.6, 0.6, 20)
    for noise in (0.0, 2e-3):
        with pytest.raises(
            CalibrationError, match=r"one axis only, \[-?0\.00 1\.00 -?0\.00\].*flange-body along this axis"
        ):
            calibrate_poses(rotated(xi, noise=noise))


def test_translations_alone_are_rejected():
    xi = np.concatenate([np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)), np.zeros((20, 3))], axis=1)
    with pytest.raises(CalibrationError, match=r"hardly rotates .* open in every direction"):
        calibrate_poses(rotated(xi, noise=1e-3))


def test_how_far_away_the_rig_stands_does_not_leave_a_mounting_open():
    poses, _, _, _ = made(5, n=15, camera=(1e-4, 2e-4, 2e-4), links=(2e-3, 8e-3), spread=0.35)
    sigmas_m = []
    for metres in (0.0, 8.0):
        away = exp_se3(np.array([0.0, 0.0, metres, 0.0, 0.0, 0.0]))
        seen = replace(poses, B=away @ poses.B)
        found = calibrate_poses(seen)
        require_known(found, seen.B, TRUSTED_M, TRUSTED_RAD)
        covs = known_where_seen(found, seen.B)["base-rig"][1], found.cov
        sigmas_m.append([np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]) for cov in covs])
    (near, _), (far, at_the_lens) = sigmas_m
    assert far == pytest.approx(near, rel=0.1)  # vision's errors depend on the distance, by less
    assert at_the_lens > TRUSTED_M


def test_a_pose_kernel_is_a_covariance():
    A = exp_se3(np.random.default_rng(0).normal(0, [0.3] * 3 + [2.0] * 3, (60, 6)))
    assert np.linalg.eigvalsh(pose_kernel(A)).min() > -1e-12


@pytest.mark.parametrize("seed", [3, 4])
def test_half_of_the_poses_may_be_wrong(seed):
    poses, Z, X, _ = made(seed, n=24, in_hand=True, camera=(3e-4, 1e-3, 1e-3))
    rng = np.random.default_rng([seed, 1])
    B = poses.B.copy()
    wrong = rng.permutation(24)[:12]
    about = exp_se3(rng.normal(0, [0.05] * 3 + [0.6] * 3, (12, 6)))
    B[wrong] = B[wrong] @ about
    found = calibrate_poses(replace(poses, B=B), quick=True)
    assert set(np.flatnonzero(~found.used)) == set(wrong)
    assert nees(found, Z, X) < chi2.ppf(0.999, 12)
