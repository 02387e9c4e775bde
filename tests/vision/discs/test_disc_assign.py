"""Naming discs by an approximate pose: right or not at all."""

import numpy as np
import pytest

from armsight.data import Correspondences, Discs, Missed
from armsight.geometry.pose import exp_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.discs.assign import assign
from armsight.vision.discs.bias import expect
from disc_views import PLATE, SIGMA, discs_of, hd_rig, someplace, views

SIX = discs_of([[0, 0, 0], [0.06, 0, 0], [0.06, 0.05, 0], [-0.02, 0.07, 0], [0.03, -0.04, 0.02], [-0.05, 0.02, 0.03]])
T_FRONT = pose(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.1, 0.0, 0.8]))
SURE = np.diag([2e-4, 2e-4, 6e-4, 2e-3, 2e-3, 2e-3]) ** 2


def added(discs, uv, like, bright=None, scale=1.0):
    """The same discs and one more at uv that looks like row ``like``."""
    return Discs(
        np.vstack([discs.uv, uv]),
        np.concatenate([discs.cov_uv, discs.cov_uv[like : like + 1]]),
        np.vstack([discs.shape, discs.shape[like] * scale**2]),
        np.append(discs.bright, discs.bright[like] if bright is None else bright),
    )


def row_of(owner, disc):
    return int(np.flatnonzero((owner == [0, disc]).all(axis=1))[0])


def test_discs_are_named_rightly_or_not_at_all_in_clutter():
    """100 predictions as far off as their covariance says; 30 discs of clutter."""
    rig, named = hd_rig(), 0
    root = np.linalg.cholesky(np.diag([4e-3, 4e-3, 8e-3, 0.02, 0.02, 0.02]) ** 2)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        T = someplace(rng)
        left, right, owner = views(rig, SIX, [T], rng, clutter=30)
        about = T @ exp_se3(root @ rng.normal(size=6))
        seen = assign(rig, SIX, about, root @ root.T, left, right)
        assert isinstance(seen, Correspondences)
        for k, m in enumerate(seen.ids):
            for side, discs in enumerate((left, right)):
                if np.isfinite(seen.uv[k, side, 0]):
                    (row,) = np.flatnonzero((discs.uv == seen.uv[k, side]).all(axis=1))
                    assert owner[side][row].tolist() == [0, m]
                    named += 1
    assert named > 0.9 * 2 * 6 * 100


def test_covariances_and_positions_come_through_unchanged():
    rig = hd_rig()
    left, right, owner = views(rig, PLATE, [T_FRONT])
    seen = assign(rig, PLATE, T_FRONT, SURE, left, right)
    assert seen.ids.tolist() == [0, 1, 2]
    assert seen.cov_uv == pytest.approx(np.tile(SIGMA**2 * np.eye(2), (3, 2, 1, 1)))
    for m in range(3):
        assert (seen.uv[m, 0] == left.uv[row_of(owner[0], m)]).all()
        assert (seen.uv[m, 1] == right.uv[row_of(owner[1], m)]).all()


def test_a_disc_that_one_camera_sees_is_named_there():
    rig = hd_rig()
    left, right, _ = views(rig, PLATE, [T_FRONT], hidden=[(0, 1, 1), (0, 2, 0), (0, 2, 1)])
    seen = assign(rig, PLATE, T_FRONT, SURE, left, right)
    assert seen.ids.tolist() == [0, 1]
    assert seen.seen.tolist() == [[True, True], [True, False]]


def test_two_that_compete_are_dropped_by_name():
    """Along the epipolar line and by less than the pose is known: nothing distinguishes them, if not the other discs."""
    rig = hd_rig()
    loose = np.diag([6e-3, 6e-3, 0.02, 4e-3, 4e-3, 4e-3]) ** 2
    for hidden, named in (([0, 2], []), ([], [0, 1, 2])):
        left, right, owner = views(rig, PLATE, [T_FRONT], hidden=[(0, m, s) for m in hidden for s in (0, 1)])
        row = row_of(owner[0], 1)
        seen = assign(rig, PLATE, T_FRONT, loose, added(left, left.uv[row] + [6.0, 0.0], row), right)
        if named:
            assert seen.ids.tolist() == named
            assert (seen.uv[1, 0] == left.uv[row]).all()
        else:
            assert seen == Missed(
                "ambiguous: P2: several detections may be it: 2 in the left image, 1 in the right image"
            )


@pytest.mark.parametrize(
    ("step", "bright", "scale"),
    [((0.5, 0.2), False, 1.0), ((0.5, 0.2), None, 1.4), ((0.5, 0.2), None, 0.6), ((0.0, 3.0), None, 1.0)],
)
def test_brightness_size_and_the_epipolar_line_settle_it(step, bright, scale):
    rig = hd_rig()
    left, right, owner = views(rig, PLATE, [T_FRONT])
    row = row_of(owner[0], 1)
    left = added(left, left.uv[row] + step, row, bright, scale)
    loose = np.diag([2e-3, 2e-3, 2e-3, 4e-3, 4e-3, 4e-3]) ** 2
    seen = assign(rig, PLATE, T_FRONT, loose, left, right)
    assert seen.ids.tolist() == [0, 1, 2]
    assert (seen.uv[1, 0] == left.uv[row]).all()


def test_one_detection_that_two_discs_want_is_given_to_neither():
    rig = hd_rig()
    close = discs_of([[0, 0, 0], [0.004, 0, 0], [0.06, 0, 0], [0, 0.06, 0]], radius=0.002)
    left, right, owner = views(rig, close, [T_FRONT], hidden=[(0, 0, 0), (0, 0, 1)])
    loose = np.diag([4e-3, 4e-3, 2e-3, 1e-3, 1e-3, 1e-3]) ** 2
    alone = [
        Discs(*(a[[row_of(o, 1)]] for a in (d.uv, d.cov_uv, d.shape, d.bright)))
        for d, o in zip((left, right), owner, strict=True)
    ]
    seen = assign(rig, close, T_FRONT, loose, *alone)
    assert isinstance(seen, Missed)
    assert seen.reason.startswith("ambiguous: P1: several detections may be it")
    # With the others seen the pose is known, and the neighbour's detection is the neighbour's.
    assert assign(rig, close, T_FRONT, loose, left, right).ids.tolist() == [1, 2, 3]


def test_detections_that_no_one_position_explains_are_not_a_disc():
    rig = hd_rig()
    left, right, owner = views(rig, PLATE, [T_FRONT])
    uv = np.array(right.uv)
    uv[row_of(owner[1], 0)] += [0.0, 4.0]
    loose = np.diag([2e-3, 2e-3, 2e-3, 4e-3, 4e-3, 4e-3]) ** 2
    seen = assign(rig, PLATE, T_FRONT, loose, left, Discs(uv, right.cov_uv, right.shape, right.bright))
    # The other two settle the pose, and then which of the two it is that lies wrong.
    assert seen.ids.tolist() == [0, 1, 2]
    assert seen.seen.tolist() == [[True, False], [True, True], [True, True]]
    alone = [
        Discs(*(a[[row_of(o, 0)]] for a in (at, d.cov_uv, d.shape, d.bright)))
        for at, d, o in zip((left.uv, uv), (left, right), owner, strict=True)
    ]
    assert "do not agree" in assign(rig, PLATE, T_FRONT, loose, *alone).reason


def test_nothing_there_is_a_miss():
    rig = hd_rig()
    left, right, _ = views(rig, PLATE, [T_FRONT])
    away = T_FRONT @ exp_se3(np.array([0.1, 0.05, 0, 0, 0, 0]))
    assert assign(rig, PLATE, away, SURE, left, right).reason == "no disc is where plate should show one"


def test_the_faces_of_a_thin_plate_are_reported_by_their_normals():
    rig = hd_rig()
    points = np.tile(PLATE.body.points, (2, 1))
    normals = np.repeat([[0, 0, 1.0], [0, 0, -1.0]], 3, axis=0)
    both = discs_of(points, normal=normals)
    expected = expect(rig, both, T_FRONT)
    assert (expected.facing[:3] < 0).all()
    left, right, _ = views(rig, PLATE, [T_FRONT])
    assert assign(rig, both, T_FRONT, SURE, left, right).ids.tolist() == [3, 4, 5]
