from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Body
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, log_se3, pose, transform
from armsight.geometry.rigid import fit_rigid, fit_scale
from armsight.geometry.rotation import exp_so3, log_so3
from armsight.vision.calibrate.bodies import LEAST_SHOTS, calibrate_bodies
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.pose.assign import instances
from armsight.vision.rig import StereoRig
from views import both_pixels

SIGMA_PX = 0.3
SIZE = (4000, 3000)


def true_rig(model="brown5"):
    """Two cameras of long focal length, 0.5 m apart, that look at the same position 1.8 m away."""
    d = {"brown5": (-0.1, 0.15, 3e-4, -2e-4, 0.0), "fisheye": (0.05, -0.02, 0.0, 0.0)}[model]
    left = Camera(SIZE, model, np.array([8000.0, 8010.0, 2010.0, 1480.0]), np.array(d))
    right = Camera(SIZE, model, np.array([8050.0, 8040.0, 1980.0, 1510.0]), 0.9 * np.array(d))
    T = pose(exp_so3(np.array([0.02, -0.27, 0.01])), np.array([0.5, 0.02, 0.05]))
    n = left.parameters.size + right.parameters.size + 6
    return StereoRig(left, right, T, np.zeros((n, n)), 0.0, {})


def ball(seed=2, wrong_m=1.5e-4):
    """The drawing of a ball of 20 points, 100 mm across, and the ball as it was made."""
    n = np.arange(20) + 0.5
    z, rotation = 1 - 2 * n / 20, np.pi * (1 + np.sqrt(5)) * n
    points = 0.05 * np.column_stack([np.sqrt(1 - z**2) * np.cos(rotation), np.sqrt(1 - z**2) * np.sin(rotation), z])
    nominal = Body("ball", tuple(f"M{i}" for i in range(20)), points)
    return nominal, points + wrong_m / np.sqrt(3) * np.random.default_rng(seed).normal(size=points.shape)


def random_pose(rng):
    """A ball anywhere in view, rotated any way."""
    return pose(exp_so3(np.pi * rng.uniform(-1, 1, 3)), np.array([0.0, 0.0, 1.8]) + 0.14 * rng.uniform(-1, 1, 3))


def seen_points(rig, points, T, rng):
    """What both cameras see of a ball: per camera the ids and pixels (noisy) of the points on its near side."""
    p = transform(T, points)
    uv = both_pixels(rig, p) + SIGMA_PX * rng.normal(size=(len(p), 2, 2))
    outward = p - T[:3, 3]
    centres = (np.zeros(3), rig.T_left_right[:3, 3])
    ids = [
        np.flatnonzero(((c - p) * outward).sum(axis=1) > 0.25 * 0.05 * np.linalg.norm(c - T[:3, 3])) for c in centres
    ]
    return tuple(ids), tuple(uv[i, side] for side, i in enumerate(ids))


def recording(rig, points, count, seed=0):
    rng = np.random.default_rng(seed)
    Ts = [random_pose(rng) for _ in range(count)]
    return [SeenShot(str(n), *seen_points(rig, points, T, rng)) for n, T in enumerate(Ts)], Ts


def known(rig):
    return rig.left, rig.right


def off(a, b):
    """RMS distance of two bodies laid on each other at the same size."""
    a = a / fit_scale(b, a)
    return np.sqrt(((transform(fit_rigid(a, b), a) - b) ** 2).sum(axis=1).mean())


@pytest.mark.parametrize("model", ["brown5", "fisheye"])
def test_the_relative_pose_is_found_within_its_covariance(model):
    true = true_rig(model)
    nominal, _ = ball()
    shots, _ = recording(true, nominal.points, 30)
    c = calibrate_bodies(nominal, shots, known(true))
    error, cov = log_se3(inverse(c.rig.T_left_right) @ true.T_left_right), c.rig.cov[-6:, -6:]
    assert (np.abs(error) < 4 * np.sqrt(np.diag(cov))).all()
    # Known intrinsics stay what they were, and are certain.
    assert not c.rig.cov[:-6].any()
    assert (c.rig.left.parameters == true.left.parameters).all()
    # Some 500 detections: the noise is known to sqrt(1 / 1000), 3%; four times that.
    assert c.rig.sigma_px == pytest.approx(SIGMA_PX, rel=0.13)
    assert c.deviation_m < 1e-15
    assert len(c.pairs) == 30
    assert not c.rejected


def test_a_refined_body_is_nearer_the_truth():
    true = true_rig()
    nominal, made = ball()
    shots, _ = recording(true, made, 30)
    plain, refined = (calibrate_bodies(nominal, shots, known(true), refine_body=r) for r in (False, True))
    assert off(refined.body.points, made) < 0.4 * off(nominal.points, made)
    error, cov = log_se3(inverse(refined.rig.T_left_right) @ true.T_left_right), refined.rig.cov[-6:, -6:]
    assert (np.abs(error) < 4 * np.sqrt(np.diag(cov))).all()
    # The drawing's errors look like noise until the body may differ from it.
    assert plain.rig.sigma_px > 1.3 * SIGMA_PX
    # Scaled by the held-out residuals, in which the body as four fifths of the shots show it errs too: never below.
    assert 0.87 * SIGMA_PX < refined.rig.sigma_px < 1.2 * SIGMA_PX
    assert refined.reprojection_rms_px < plain.reprojection_rms_px
    assert refined.deviation_m == pytest.approx(off(nominal.points, made), rel=0.2)
    assert refined.body.point_names == nominal.point_names


def test_a_body_nominal_is_left_nominal():
    true = true_rig()
    nominal, _ = ball()
    shots, _ = recording(true, nominal.points, 30)
    c = calibrate_bodies(nominal, shots, known(true), refine_body=True, folds=2)
    # A point is seen in some 15 shots by each camera: 0.3 px * 1.8 m / 8000 px / sqrt(30) is 0.012 mm an axis.
    assert c.deviation_m < 2e-5


def two_in_view(true, points, count, seed=4):
    """Shots in which two balls of the same kind hang 0.3 m apart; their detections lie in any order."""
    rng = np.random.default_rng(seed)
    shots, pairs = [], []
    for n in range(count):
        Ts = [random_pose(rng) for _ in range(2)]
        Ts[0][0, 3] -= 0.15
        Ts[1][0, 3] += 0.15
        (a, uv_a), (b, uv_b) = (seen_points(true, points, T, rng) for T in Ts)
        ids = [np.r_[a[i], b[i]] for i in (0, 1)]
        uv = [np.r_[uv_a[i], uv_b[i]] for i in (0, 1)]
        order = [rng.permutation(len(i)) for i in ids]
        shots.append(SeenShot(str(n), (ids[0][order[0]], ids[1][order[1]]), (uv[0][order[0]], uv[1][order[1]])))
        pairs.append((Ts, (len(a[0]) + len(a[1]), len(b[0]) + len(b[1]))))
    return shots, pairs


def test_two_bodies_of_one_kind_are_distinguished():
    true = true_rig()
    nominal, _ = ball()
    shots, truths = two_in_view(true, nominal.points, 8)
    for shot, (Ts, counts) in zip(shots, truths, strict=True):
        found = instances(nominal.points, true, shot)
        assert len(found) == 2
        for T, seen in found:
            gaps = [np.linalg.norm(T[:3, 3] - other[:3, 3]) for other in Ts]
            which = int(np.argmin(gaps))
            # One point's depth is known to sqrt(2) * 0.3 px * (1.8 m)^2 / (8000 px * 0.5 m) = 0.34 mm, its position across
            # to 0.07 mm; the middle of the ball, behind them all, to little more. Three times that.
            assert gaps[which] < 1e-3
            # 0.34 mm at 50 mm from the middle rotate the ball by 7 mrad; three times that.
            assert np.linalg.norm(log_so3(T[:3, :3].T @ Ts[which][:3, :3])) < 0.02
            assert int(seen.seen.sum()) == counts[which]


def test_two_bodies_in_every_shot_calibrate_as_well():
    true = true_rig()
    nominal, _ = ball()
    shots, _ = two_in_view(true, nominal.points, 12)
    c = calibrate_bodies(nominal, shots, known(true))
    error, cov = log_se3(inverse(c.rig.T_left_right) @ true.T_left_right), c.rig.cov[-6:, -6:]
    assert (np.abs(error) < 4.5 * np.sqrt(np.diag(cov))).all()


def test_one_shot_of_wrong_detections_does_not_rotation_the_cameras():
    true = true_rig()
    nominal, _ = ball()
    shots, _ = recording(true, nominal.points, LEAST_SHOTS + 1)
    rng = np.random.default_rng(0)
    shots[2] = replace(shots[2], uv=tuple(rng.uniform(0, 3000, uv.shape) for uv in shots[2].uv))
    c = calibrate_bodies(nominal, shots, known(true))
    # Bodies that each camera sees alone fit any relative pose; this once won over the true one.
    error, cov = log_se3(inverse(c.rig.T_left_right) @ true.T_left_right), c.rig.cov[-6:, -6:]
    assert (np.abs(error) < 4.5 * np.sqrt(np.diag(cov))).all()


def test_shots_without_the_body_are_named_and_too_few_are_reported():
    true = true_rig()
    nominal, _ = ball()
    shots, _ = recording(true, nominal.points, 12)
    rng = np.random.default_rng(0)
    shots[2] = replace(shots[2], uv=tuple(rng.uniform(0, 3000, uv.shape) for uv in shots[2].uv))
    c = calibrate_bodies(nominal, shots, known(true))
    assert [r.pair for r in c.rejected] == ["2"]
    assert "no pose of the body agrees with its" in c.rejected[0].reason
    with pytest.raises(CalibrationError, match=f"{LEAST_SHOTS - 1} of {LEAST_SHOTS - 1} shots are usable"):
        calibrate_bodies(nominal, shots[3 : LEAST_SHOTS + 2], known(true))
    nothing = [SeenShot("0", (np.zeros(0, np.int64),) * 2, (np.zeros((0, 2)),) * 2)] * LEAST_SHOTS
    with pytest.raises(CalibrationError, match="no shot shows"):
        calibrate_bodies(nominal, nothing, known(true))
