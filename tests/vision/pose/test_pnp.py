"""Poses from one camera: the truth must be among the candidates, and both solutions of a plane."""

import numpy as np
import pytest

from armsight.geometry.pose import log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.pose.pnp import body_poses, consensus_poses
from strategies import CAMERAS
from views import board, pixels

pytestmark = pytest.mark.opencv

RNG = np.random.default_rng(0)
ROTATED = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
BODIES = {
    "corner": np.array([[0.0, 0, 0], [0.06, 0, 0], [0, 0.06, 0], [0, 0, 0.06]]),
    "cloud": RNG.uniform(-0.1, 0.1, (12, 3)),
    "board": board(),
    "square": board(2, 2, 0.1),
    "tilted board": board() @ ROTATED + [0.3, 0.1, -0.2],
    "bowed board": board() + np.column_stack([np.zeros((30, 2)), 0.02 * board()[:, 0] ** 2]),
}
MODELS = list(CAMERAS)


def views(n=10, seed=1):
    """Poses of a body before a camera, tilted between 20 and 60 degrees so that mirror solutions lie apart."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        rotation, axis = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(20, 60)) * np.array([np.cos(axis), np.sin(axis), 0])
        R = exp_so3(tilt) @ exp_so3(np.array([0, 0, rotation]))
        yield R, np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.6, 1.0)])


def posed(points, R, middle):
    """The pose that rotates a body and sets its middle somewhere."""
    return pose(R, middle - R @ points.mean(axis=0))


def apart(T, other):
    """Rotation angle, rad, and distance, m, between two poses' bodies near the origin."""
    xi = log_se3(np.linalg.inv(T) @ other)
    return np.linalg.norm(xi[3:]), np.linalg.norm(T[:3, 3] - other[:3, 3])


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", BODIES)
def test_without_noise_the_best_pose_is_the_truth(name, model):
    camera, points = CAMERAS[model], BODIES[name]
    for R, middle in views():
        T = posed(points, R, middle)
        found = body_poses(points, camera, pixels(camera, points @ T[:3, :3].T + T[:3, 3]))
        # OpenCV's closed forms lose half the digits at their roots: 1e-8 of a focal length of 1e3 px.
        assert found[0][1] < 1e-4
        angle, distance = apart(found[0][0], T)
        assert angle < 1e-5
        assert distance < 1e-5
        assert [rms for _, rms in found] == sorted(rms for _, rms in found)


@pytest.mark.parametrize("name", ["board", "square", "tilted board"])
def test_a_plane_has_two_poses(name):
    camera, points, rng = CAMERAS["brown5"], BODIES[name], np.random.default_rng(3)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    for R, middle in views():
        T = posed(points, R, 3 * middle)  # far away, where the two look nearly alike
        found = body_poses(
            points, camera, pixels(camera, points @ T[:3, :3].T + T[:3, 3]) + 0.1 * rng.normal(size=(len(points), 2))
        )
        assert len(found) == 2
        # Necker's reversal: the normal is mirrored in the line of sight, so both make the same angle with it.
        sight = middle / np.linalg.norm(middle)
        slants = [np.degrees(np.arccos(abs(sight @ T[:3, :3] @ normal))) for T, _ in found]
        assert abs(slants[0] - slants[1]) < 10
        assert apart(found[0][0], found[1][0])[0] > np.radians(20)


def test_what_does_not_determine_a_pose_has_none():
    camera = CAMERAS["brown5"]
    line = np.column_stack([np.linspace(-0.1, 0.1, 6), np.zeros(6), np.zeros(6)])
    T = pose(np.eye(3), np.array([0, 0, 1.0]))
    assert body_poses(line, camera, pixels(camera, line + T[:3, 3])) == []
    assert body_poses(BODIES["cloud"][:3], camera, pixels(camera, BODIES["cloud"][:3] + T[:3, 3])) == []
    assert body_poses(BODIES["cloud"], camera, np.full((12, 2), np.nan)) == []


@pytest.mark.parametrize("name", ["corner", "cloud", "square"])
def test_consensus_finds_the_truth_among_wrong_names(name):
    camera, points, rng = CAMERAS["brown5"], BODIES[name], np.random.default_rng(4)
    for R, middle in views(5):
        T = posed(points, R, middle)
        uv = pixels(camera, points @ T[:3, :3].T + T[:3, 3]) + 0.1 * rng.normal(size=(len(points), 2))
        ids = np.append(np.arange(len(points)), 1)  # one point stands twice, the second time elsewhere
        found = consensus_poses(points, camera, ids, np.append(uv, [[100.0, 100.0]], axis=0))
        near = [c for c in found if apart(c.T_camera_body, T)[0] < np.radians(5)]
        assert len(near) == 1
        assert near[0].rows.tolist() == list(range(len(points)))
        assert near[0].rms_px < 0.5
