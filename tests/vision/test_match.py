"""Matching: OpenCV's epipolar lines and dictionaries are the oracles."""

import cv2
import numpy as np
import pytest

from armsight.data import Correspondences, Detections
from armsight.geometry.rotation import skew
from armsight.vision.match import GATE_PX, SIGMAS, epipolar_distances, gate, join, match, renamed
from armsight.vision.rig import StereoRig
from strategies import CAMERAS, folding_rig, ordinary_rig
from views import board, body_of, both_pixels, pixels, seen, somewhere


def some_detections(rng, n=30):
    """Detections of a random part of n points, each with its own position and covariance."""
    ids = np.sort(rng.choice(n, rng.integers(0, n + 1), replace=False))
    root = rng.normal(size=(len(ids), 2, 2))
    return Detections(ids, rng.uniform(0, 700, (len(ids), 2)), root @ root.transpose(0, 2, 1))


def split(shot):
    """Return what each camera detected of a shot's correspondences."""
    parts = []
    for c in (0, 1):
        rows = shot.seen[:, c]
        parts.append(Detections(shot.ids[rows], shot.uv[rows, c], shot.cov_uv[rows, c]))
    return parts


@pytest.mark.parametrize("seed", range(20))
def test_joining_is_by_identity(seed):
    rng = np.random.default_rng(seed)
    sides = [some_detections(rng), some_detections(rng)]
    joined = join(*sides)
    positions = [dict(zip(d.ids.tolist(), zip(d.uv, d.cov_uv, strict=True), strict=True)) for d in sides]
    assert joined.ids.tolist() == sorted({*positions[0], *positions[1]})
    for i, uv, cov, found in zip(joined.ids.tolist(), joined.uv, joined.cov_uv, joined.seen, strict=True):
        for c in (0, 1):
            assert found[c] == (i in positions[c])
            if found[c]:
                np.testing.assert_array_equal(uv[c], positions[c][i][0])
                np.testing.assert_array_equal(cov[c], positions[c][i][1])
            else:
                assert np.isnan(uv[c]).all()
                assert not cov[c].any()
    assert joined.paired.tolist() == [i in positions[0] and i in positions[1] for i in joined.ids.tolist()]
    assert joined.dropped == ()


@pytest.mark.parametrize("model", CAMERAS)
def test_epipolar_distance_is_that_of_opencvs_lines_in_undistorted_pixels(model):
    rig, rng, n = ordinary_rig(model), np.random.default_rng(0), 200
    rays = np.concatenate([rng.uniform(-0.4, 0.4, (2, n, 2)), np.ones((2, n, 1))], axis=2)
    raw = [pixels(camera, ray) for camera, ray in zip(rig.cameras, rays, strict=True)]
    straight = [(ray @ camera.matrix.T)[:, :2] for camera, ray in zip(rig.cameras, rays, strict=True)]
    R, t = rig.T_left_right[:3, :3], rig.T_left_right[:3, 3]
    # x_right^T F x_left = 0 is OpenCV's convention with the left image as the first.
    F = np.linalg.inv(rig.right.matrix).T @ (skew(-R.T @ t) @ R.T) @ np.linalg.inv(rig.left.matrix)
    expected = np.empty((n, 2))
    for side, first in ((1, 0), (0, 1)):
        lines = cv2.computeCorrespondEpilines(straight[first].reshape(-1, 1, 2), first + 1, F).reshape(-1, 3)
        expected[:, side] = np.abs(np.einsum("ni,ni->n", np.column_stack([straight[side], np.ones(n)]), lines))
    np.testing.assert_allclose(epipolar_distances(rig, *raw), expected, rtol=0, atol=1e-6)
    assert np.median(expected) > 10


@pytest.mark.parametrize("model", CAMERAS)
def test_true_pairs_lie_on_their_lines(model):
    rig = ordinary_rig(model)
    shot = seen(rig, board(), somewhere(np.random.default_rng(1)))
    assert epipolar_distances(rig, shot.uv[:, 0], shot.uv[:, 1]).max() < 1e-9


def test_the_gate_drops_by_name_what_is_off_and_nothing_else():
    rig, points, rng = ordinary_rig(), board(), np.random.default_rng(2)
    shot = seen(rig, points, somewhere(rng), sigma=rig.sigma_px, rng=rng, hidden=[(4, 0), (9, 1)])
    uv = shot.uv.copy()
    uv[7, 0] += [0, 8.0]
    uv[[11, 12], 1] = uv[[12, 11], 1]  # two names exchanged: along the row, and the rows here are not epipolar lines
    uv[20, 1] = [1e5, 1e5]
    left = gate(rig, body_of(points), Correspondences(shot.ids, uv, shot.cov_uv, shot.dropped))
    assert [d.point for d in left.dropped] == ["P7", "P11", "P12", "P20"]
    assert all("px off its epipolar line (gate 2.0 px)" in d.reason for d in left.dropped)
    assert left.dropped[0].reason.startswith("8") or left.dropped[0].reason.startswith("7")
    kept = [i for i in range(len(points)) if i not in (7, 11, 12, 20)]
    assert left.ids.tolist() == kept
    np.testing.assert_array_equal(left.uv, uv[kept])
    np.testing.assert_array_equal(left.cov_uv, shot.cov_uv[kept])


@pytest.mark.parametrize(("sigma", "image"), [(0.01, 0.0), (1.0, 0.0), (0.0, 2.0), (1.0, 2.0)])
def test_the_gate_is_wide_enough_for_the_noise(sigma, image):
    base = ordinary_rig()
    rig = StereoRig(base.left, base.right, base.T_left_right, base.cov, sigma)
    shot = seen(rig, board(), somewhere(np.random.default_rng(3)))
    limit = max(GATE_PX, SIGMAS * np.sqrt(2 * (sigma**2 + image**2)))
    cov = np.tile(image**2 * np.eye(2), (len(shot.ids), 2, 1, 1))
    rng = np.random.default_rng(4)
    uv = shot.uv + np.hypot(sigma, image) * rng.normal(size=shot.uv.shape)
    # Six standard deviations of a difference: one in a thousand million by chance.
    assert gate(rig, body_of(board()), Correspondences(shot.ids, uv, cov)).dropped == ()
    for off, dropped in ((0.9, False), (1.25, True)):
        moved = shot.uv.copy()
        moved[:, 1, 1] += off * limit  # the lines lie about level: nearly all of it is epipolar distance
        found = gate(rig, body_of(board()), Correspondences(shot.ids, moved, cov))
        assert len(found.dropped) == dropped * len(shot.ids)


@pytest.mark.parametrize("hidden", [0, 20])
@pytest.mark.parametrize("seed", range(5))
def test_a_board_named_in_reverse_is_put_right(seed, hidden):
    rig, points, rng = ordinary_rig(), board(9, 7, 0.02), np.random.default_rng(seed)
    reverse = np.arange(62, -1, -1)
    lost = [(i, c) for c in (0, 1) for i in rng.choice(63, hidden, replace=False)]
    shot = seen(rig, points, somewhere(rng), sigma=rig.sigma_px, rng=rng, hidden=lost)
    left, right = split(shot)
    named = match(rig, body_of(points), left, right, symmetries=(reverse,))
    mended = match(rig, body_of(points), left, renamed(right, reverse), symmetries=(reverse,))
    for found in (named, mended):
        assert found.dropped == ()
        np.testing.assert_array_equal(found.ids, shot.ids[shot.seen.any(axis=1)])
        np.testing.assert_array_equal(found.uv, shot.uv[shot.seen.any(axis=1)])
    unmended = match(rig, body_of(points), left, renamed(right, reverse))
    assert unmended.paired.sum() < 0.2 * shot.paired.sum()


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.3])
def test_a_middle_that_keeps_its_name_does_not_outvote_the_board(sigma):
    """Half a 9x7 board, up to and with its middle: in reverse only the middle has a partner, itself, on its line."""
    rig, points, rng = ordinary_rig(), board(9, 7, 0.02), np.random.default_rng(6)
    reverse = np.arange(62, -1, -1)
    shot = seen(
        rig, points, somewhere(rng), sigma=sigma, rng=rng, hidden=[(i, c) for i in range(32, 63) for c in (0, 1)]
    )
    left, right = split(shot)
    for given in (right, renamed(right, reverse)):
        found = match(rig, body_of(points), left, given, symmetries=(reverse,))
        assert found.ids.tolist() == list(range(32))
        assert found.paired.all()


def test_renaming_is_by_the_permutation():
    d = Detections(np.array([0, 2, 3]), np.array([[0.0, 0], [2, 2], [3, 3]]), np.zeros((3, 2, 2)))
    new = renamed(d, np.array([3, 1, 0, 2]))
    assert new.ids.tolist() == [0, 2, 3]
    assert new.uv[:, 0].tolist() == [2, 3, 0]


def test_pixels_without_a_ray_are_dropped_without_a_word_from_numpy():
    rig = folding_rig()
    far = Detections(np.arange(3), np.array([[1000.0, 360], [1010, 360], [1020, 360]]), np.zeros((3, 2, 2)))
    near = Detections(np.arange(3), np.array([[600.0, 360], [610, 360], [620, 360]]), np.zeros((3, 2, 2)))
    found = match(rig, body_of(board(3, 1)), far, near, symmetries=(np.arange(2, -1, -1),))
    assert len(found.ids) == 0
    assert [d.point for d in found.dropped] == ["P0", "P1", "P2"]


def test_flips_are_evaluated_by_what_has_a_ray():
    rig = folding_rig()
    p = np.array([[-0.1, -0.1, 1.0], [0.0, 0.0, 1.0], [0.1, 0.1, 1.0]])
    uv = both_pixels(rig, p)
    left = Detections(np.arange(3), np.concatenate([uv[:2, 0], [[1010, 360]]]), np.zeros((3, 2, 2)))
    right = Detections(np.arange(3), np.concatenate([uv[:2, 1], [[1020, 360]]]), np.zeros((3, 2, 2)))
    nothing = Detections(np.arange(3), np.tile([1015.0, 360], (3, 1)), np.zeros((3, 2, 2)))
    reverse = np.arange(2, -1, -1)
    assert match(rig, body_of(p), left, right, symmetries=(reverse,)).ids.tolist() == [0, 1]
    assert match(rig, body_of(p), left, renamed(right, reverse), symmetries=(reverse,)).ids.tolist() == [0, 1]
    assert len(match(rig, body_of(p), left, nothing, symmetries=(reverse,)).ids) == 0


def test_nothing_in_nothing_out():
    rig, none = ordinary_rig(), Detections.none("no board")
    some = split(seen(rig, board(), somewhere(np.random.default_rng(5))))
    body, flip = body_of(board()), np.arange(29, -1, -1)
    assert len(match(rig, body, none, none, symmetries=(flip,)).ids) == 0
    alone = match(rig, body, some[0], none, symmetries=(flip,))
    assert not alone.paired.any()
    np.testing.assert_array_equal(alone.uv[:, 0], some[0].uv)
