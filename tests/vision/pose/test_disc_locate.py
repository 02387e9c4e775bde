"""Bodies with discs from detections to pose: honest covariance, no perspective bias, coded parts and discs together."""

from dataclasses import replace

import numpy as np
import pytest
from closed_form import orientation
from scipy.stats import chi2

from armsight.data import Body, Correspondences, Detections, PoseEstimate, Shot
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import euler_zyx, exp_so3
from armsight.vision.discs.bias import expect
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.locate import locate
from armsight.vision.pose.measure import locate_composite, locate_discs, measure
from armsight.vision.triangulate import triangulate
from disc_views import PLATE, SIZE, discs_of, hd_rig, someplace, views
from views import both_pixels

NOTHING = Correspondences(np.zeros(0, np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, 2, 2)))
NO_CODE = (Detections.none("no tag"), Detections.none("no tag"))


def alone(rig, target, left, right):
    return locate_composite(rig, target.body, target, NO_CODE, (left, right))


@pytest.mark.parametrize(("calibrated", "count"), [(False, 120), (True, 120)])
def test_the_covariance_is_honest(calibrated, count):
    """Normalised squares of the pose's error over seeded views: their mean and the share inside the 95% ellipsoid."""
    rig, nees = hd_rig(known=not calibrated), []
    root = np.linalg.cholesky(rig.cov + 1e-30 * np.eye(22))
    for seed in range(count):
        rng = np.random.default_rng([3, seed])
        T = someplace(rng)
        left, right, _ = views(rig.perturbed(root @ rng.normal(size=22)), PLATE, [T], rng, clutter=5)
        estimate = alone(rig, PLATE, left, right)
        assert isinstance(estimate, PoseEstimate)
        e = log_se3(inverse(estimate.T_left_body) @ T)
        nees.append(e @ np.linalg.solve(estimate.cov, e))
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 6 * count) / count
    assert low < np.mean(nees) < high
    inside = np.mean(np.array(nees) < chi2.ppf(0.95, 6))
    assert abs(inside - 0.95) < 3.5 * np.sqrt(0.95 * 0.05 / count)


def test_large_tilted_discs_leave_no_bias():
    """R = 15 mm at 0.5 m and 45 degrees: centres 0.3 px off without, under 0.005 px with correction."""
    rig = hd_rig(known=True)
    target = discs_of([[-0.05, 0, 0], [0.05, 0, 0], [0, 0.08, 0]], radius=0.015)
    T = pose(exp_so3(np.array([0, np.radians(45), 0])), np.array([0.1, 0.0, 0.5]))
    left, right, _ = views(rig, target, [T], sigma=0.0)
    estimate = alone(rig, target, left, right)
    true = both_pixels(rig, transform(T, target.body.points))
    left_over = both_pixels(rig, transform(estimate.T_left_body, target.body.points)) - true
    assert np.linalg.norm(left_over, axis=2).max() < 0.005
    raw = Correspondences(np.arange(3), np.array(expect(rig, target, T).uv), np.tile(0.01 * np.eye(2), (3, 2, 1, 1)))
    plain = locate(rig, target.body, triangulate(rig, target.body, raw))
    bias = both_pixels(rig, transform(plain.T_left_body, target.body.points)) - true
    assert np.linalg.norm(bias, axis=2).min() > 0.25


def test_a_far_start_ends_at_the_same_pose():
    rig, T = hd_rig(known=True), someplace(np.random.default_rng(2))
    target = discs_of(PLATE.body.points, radius=0.015)
    seen = Correspondences(np.arange(3), np.array(expect(rig, target, T).uv), np.tile(1e-4 * np.eye(2), (3, 2, 1, 1)))
    near = locate_discs(rig, target.body, target, NOTHING, seen, T)
    far = locate_discs(rig, target.body, target, NOTHING, seen, T @ exp_se3(np.full(6, 0.02)))
    step = log_se3(inverse(near.T_left_body) @ far.T_left_body)
    # Settled to 1e-4 px: a thousandth of a sigma at 0.01 px of noise, times the geometry's weakness.
    assert step @ np.linalg.solve(near.cov, step) < 0.03**2


def composite():
    """A body of a coded square of 4 x 4 points and three discs, all in one plane."""
    x, y = np.meshgrid(np.arange(4) * 0.01, np.arange(4) * 0.01)
    coded = np.column_stack([x.ravel() - 0.015, y.ravel() + 0.02, np.zeros(16)])
    names = tuple(f"C{i}" for i in range(16)) + PLATE.body.point_names
    return Body("plate", names, np.vstack([coded, PLATE.body.points])), coded


def code_seen(rig, coded, T, rng, sigma=0.05):
    """Detections of the coded points in both cameras."""
    uv = both_pixels(rig, transform(T, coded))
    uv = uv + sigma * rng.normal(size=uv.shape)
    return tuple(Detections(np.arange(16), uv[:, s], np.tile(sigma**2 * np.eye(2), (16, 1, 1))) for s in (0, 1))


def test_coded_points_and_discs_are_located_together():
    rig, (body, coded) = hd_rig(known=True), composite()
    nees, gain = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        T = someplace(rng)
        left, right, _ = views(rig, PLATE, [T], rng, clutter=10)
        code = code_seen(rig, coded, T, rng)
        both = locate_composite(rig, body, PLATE, code, (left, right))
        assert set(both.points.ids.tolist()) == set(range(19))
        e = log_se3(inverse(both.T_left_body) @ T)
        nees.append(e @ np.linalg.solve(both.cov, e))
        by_code = locate_composite(rig, body, PLATE, code, views(rig, PLATE, [])[:2])
        assert by_code.points.ids.tolist() == list(range(16))
        gain.append(np.sqrt(by_code.cov[3, 3] / both.cov[3, 3]))
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 6 * 60) / 60
    assert low < np.mean(nees) < high
    # The discs lie three times as far apart as the coded points.
    assert np.median(gain) > 2


def test_coded_parts_name_discs_that_could_not_name_themselves():
    """Two discs only, or two bodies' discs in view: the code says where they are."""
    rig, (body, coded), rng = hd_rig(known=True), composite(), np.random.default_rng(0)
    T, other = (pose(exp_so3(np.array([0.1, 0.2, a])), np.array([x, 0.0, 0.9])) for x, a in ((0.0, 0.3), (0.25, 2.0)))
    code = code_seen(rig, coded, T, rng)
    left, right, _ = views(rig, PLATE, [T, other], rng)
    assert set(locate_composite(rig, body, PLATE, code, (left, right)).points.ids.tolist()) == set(range(19))
    assert "ambiguous" in locate_composite(rig, body, PLATE, NO_CODE, (left, right)).reason
    left, right, _ = views(rig, PLATE, [T], rng, hidden=[(0, 0, 0), (0, 0, 1)])
    assert set(locate_composite(rig, body, PLATE, code, (left, right)).points.ids.tolist()) == set(range(19)) - {16}


def test_discs_name_themselves_where_the_code_is_not_seen():
    rig, (body, coded), rng = hd_rig(known=True), composite(), np.random.default_rng(1)
    T = someplace(rng)
    left, right, _ = views(rig, PLATE, [T], rng)
    code = code_seen(rig, coded, T, rng)
    half = Detections(code[0].ids[:2], code[0].uv[:2], code[0].cov_uv[:2])
    for seen in (NO_CODE, (half, NO_CODE[1])):
        estimate = locate_composite(rig, body, PLATE, seen, (left, right))
        assert set(estimate.points.ids.tolist()) == {16, 17, 18}
    missed = locate_composite(rig, body, PLATE, NO_CODE, views(rig, PLATE, [])[:2])
    assert missed.reason == ("left: no tag; right: no tag; left: 0 discs found; right: 0 discs found; plate has 3")


def test_exchanged_cameras_are_reported():
    rig, rng = hd_rig(), np.random.default_rng(0)
    left, right, _ = views(rig, PLATE, [someplace(rng)], rng)
    assert alone(rig, PLATE, right, left).reason.startswith(
        "left and right are exchanged: the discs fit the rig the other"
    )


class Discerning:
    """A DiscTarget that finds what the test asks for."""

    def __init__(self, target, found):
        self.body, self.radii_m, self.bright, self.normals = target.body, target.radii_m, target.bright, target.normals
        self.bias_normals = target.bias_normals
        self._found = list(found)

    def find(self, image):
        return self._found.pop(0)


def test_a_shot_is_measured_from_its_discs():
    rig, rng = hd_rig(known=True), np.random.default_rng(0)
    T = someplace(rng)
    left, right, _ = views(rig, PLATE, [T], rng)
    shot = Shot("s", *(np.zeros((SIZE[1], SIZE[0]), np.uint8) for _ in "lr"))
    estimate = measure(rig, Composite("plate", (), Discerning(PLATE, (left, right))), shot)
    e = log_se3(inverse(estimate.T_left_body) @ T)
    assert e @ np.linalg.solve(estimate.cov, e) < chi2.ppf(1 - 1e-4, 6)
    nothing = views(rig, PLATE, [])[:2]
    missed = measure(rig, Composite("plate", (), Discerning(PLATE, nothing)), shot)
    assert missed.reason.startswith("left: 0 discs found; right: 0 discs found; plate has 3; left: the image is dark")


@pytest.mark.parametrize("seed", range(3))
def test_three_discs_in_the_published_frame_report_its_angles(seed):
    """x along P1 P2 and z from P3 to their middle: the pose's roll, pitch, yaw are those of 18.11 to 18.16."""
    rig, rng = hd_rig(known=True), np.random.default_rng(seed)
    published = discs_of([[-0.055, 0, 0], [0.055, 0, 0], [0, 0, -0.085]], normal=(0.0, 1.0, 0.0))
    facing = pose(exp_so3(np.array([np.pi / 2, 0, 0])), np.zeros(3))  # its y, out of the faces, towards the cameras
    T = someplace(rng) @ inverse(facing)
    left, right, _ = views(rig, published, [T], rng, sigma=1e-7)
    estimate = alone(rig, replace(published), left, right)
    angles, _ = euler_zyx(estimate.T_left_body[:3, :3])
    p = estimate.points.p_left
    assert angles == pytest.approx(orientation(*p).euler_zyx, abs=1e-5)
    assert angles == pytest.approx(euler_zyx(T[:3, :3])[0], abs=1e-5)
