"""Bodies with discs from rendered images to pose, by the way a user goes: body file, target, measure."""

import re
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.data import Missed, PoseEstimate, Shot
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.sim.example_rig import PLATE_M, tag_plate
from armsight.sim.render import background
from armsight.sim.render.optics import Optics
from armsight.sim.render.render import render_pair
from armsight.sim.render.scene import PosedBody, plate
from armsight.vision.markers.targets import Composite, open_target
from armsight.vision.pose.measure import measure
from disc_views import PLATE, hd_rig, someplace

LIGHT = Optics(0.7, vignetting=0.2, light_gradient=(0.2, -0.1))
DISC = '\n[[markers]]\nname = "{}"\nposition_mm = [{}, {}, 0]\nnormal = [0, 0, -1]\ndisc = {{ radius_mm = {} }}\n'


def file_of(tmp_path, text):
    path = tmp_path / "plate.toml"
    path.write_text(text)
    return str(path)


def three(tmp_path):
    """The three-disc plate: its target, and what it looks like."""
    text = 'name = "plate"\n'
    for name, (x, y, _) in zip(PLATE.body.point_names, PLATE.body.points * 1e3, strict=True):
        text += DISC.format(name, x, y, 8)
    painted = [(x, y - 0.04, 0.008, 0.85) for x, y, _ in PLATE.body.points]
    looks = plate(0.15, 0.13, 0.08, painted).on_body(pose(np.eye(3), np.array([0, 0.04, 0])))
    return open_target(file_of(tmp_path, text)), (looks,)


@cache
def behind(kind):
    """Backgrounds of both cameras."""
    rng = np.random.default_rng(1)
    return tuple(getattr(background, kind)(camera.image_size_px, rng) for camera in hd_rig().cameras)


def shot_of(rig, patterns, T, kind, rng):
    bodies = [] if T is None else [PosedBody(patterns, T)]
    return Shot("s", *render_pair(rig.cameras, rig.T_left_right, bodies, behind(kind), optics=LIGHT, rng=rng))


@pytest.mark.parametrize("kind", ["plain", "cluttered"])
def test_a_plate_of_three_discs_is_measured(tmp_path, kind):
    rig, (target, patterns) = hd_rig(known=True), three(tmp_path)
    assert isinstance(target, Composite)
    nees = []
    for seed in range(8):
        rng = np.random.default_rng([5, seed])
        T = someplace(rng)
        estimate = measure(rig, target, shot_of(rig, patterns, T, kind, rng))
        assert isinstance(estimate, PoseEstimate)
        e = log_se3(inverse(estimate.T_left_body) @ T)
        nees.append(e @ np.linalg.solve(estimate.cov, e))
    # Centres may scatter 1.3 times their bound.
    assert np.mean(nees) < 1.3**2 * chi2.ppf(1 - 1e-4, 6 * 8) / 8


def test_clutter_without_the_plate_is_a_miss_that_counts(tmp_path):
    rig, (target, patterns) = hd_rig(known=True), three(tmp_path)
    for seed in range(3):
        missed = measure(rig, target, shot_of(rig, patterns, None, "cluttered", np.random.default_rng(seed)))
        assert isinstance(missed, Missed)
        found = [int(count) for count in re.findall(r"(\d+) discs? found", missed.reason)]
        assert len(found) == 2
        assert "; plate has 3" in missed.reason
        assert ("; or it moved too far between the two exposures" in missed.reason) == (min(found) >= 3)


def test_tags_and_discs_of_one_body_are_located_together(tmp_path):
    rig = hd_rig(known=True)
    patterns, text = tag_plate()
    positions = [(0.0, -34.0), (0.0, 0.0), (0.0, 34.0)]
    text += "".join(DISC.format(f"D{i}", x, y, 4) for i, (x, y) in enumerate(positions))
    painted = plate(*PLATE_M, value=0.12, discs=[(x / 1e3, y / 1e3, 0.004, 0.85) for x, y in positions])
    target = open_target(file_of(tmp_path, text))
    assert target.body.point_names[-3:] == ("D0", "D1", "D2")
    nees = []
    for seed in range(4):
        rng = np.random.default_rng([6, seed])
        T = someplace(rng, z=(0.5, 0.7))
        estimate = measure(rig, target, shot_of(rig, (painted, *patterns[1:]), T, "plain", rng))
        assert {16, 17, 18} <= set(estimate.points.ids.tolist())
        assert len(estimate.points.ids) == 19
        e = log_se3(inverse(estimate.T_left_body) @ T)
        nees.append(e @ np.linalg.solve(estimate.cov, e))
    assert np.mean(nees) < 1.3**2 * chi2.ppf(1 - 1e-4, 6 * 4) / 4
