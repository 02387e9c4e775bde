"""Paths of the tool: their derivatives against finite differences, their shapes against plain geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

import strategies as ours
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, log_so3
from armsight.robot.trajectories.circle import ArcPath, through
from armsight.robot.trajectories.line import LinePath
from armsight.robot.trajectories.path import checked_pose
from armsight.robot.trajectories.waypoints import BlendedPath, blended


def random_poses(seed, n, reach=0.4, rotation=1.0):
    rng = np.random.default_rng(seed)
    return np.array([pose(exp_so3(rng.normal(size=3) * rotation), rng.normal(size=3) * reach) for _ in range(n)])


PATHS = {
    "line": LinePath.between(*random_poses(0, 2)),
    "rotation on the spot": LinePath.between(np.eye(4), pose(exp_so3(np.array([0.3, 1.0, -0.2])), np.zeros(3))),
    "arc": ArcPath(
        random_poses(1, 1)[0], np.array([0.1, 0.2, -0.1]), np.array([0.5, -2.0, 1.0]), np.array([1.0, 0.2, -0.4])
    ),
    "waypoints": blended(random_poses(2, 5), 0.05),
    "waypoints, blends that touch": blended(random_poses(3, 6), 10.0),
}


@pytest.mark.parametrize("name", PATHS)
def test_twist_and_bend_are_the_derivatives(name):
    path, h = PATHS[name], 1e-6
    share = np.linspace(2 * h, 1 - 2 * h, 1001)
    here, before, after = path.at(share), path.at(share - h), path.at(share + h)
    change = after.T_base_tool[:, :3, :3] @ np.swapaxes(before.T_base_tool[:, :3, :3], 1, 2)
    twist = np.hstack([after.T_base_tool[:, :3, 3] - before.T_base_tool[:, :3, 3], log_so3(change)]) / (2 * h)
    third = 10 * np.abs(here.bend).max() / 0.02  # the bend of the shortest blend changes within some percent of the way
    bound = 8 * np.finfo(float).eps / h * 4 + h**2 * third + 1e-9
    np.testing.assert_allclose(here.twist, twist, atol=bound)
    bend = (after.twist - before.twist) / (2 * h)
    scale = max(1.0, np.abs(here.twist).max())
    # At the ends of a blend the bend has a corner: there the difference quotient is off by half a step's change.
    np.testing.assert_allclose(here.bend, bend, atol=scale * 1e-8 + h * third)


@pytest.mark.parametrize("name", PATHS)
def test_every_point_is_a_pose(name):
    T = PATHS[name].at(np.linspace(0, 1, 201)).T_base_tool
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (201, 1, 1)), atol=1e-14)
    assert (T[:, 3] == [0, 0, 0, 1]).all()


@given(ours.poses(), ours.poses())
def test_a_line_is_straight_and_rotates_as_slerp_does(a, b):
    if np.linalg.norm(log_so3(a[:3, :3].T @ b[:3, :3])) > 3.1:  # half a revolution may go either way
        return
    share = np.linspace(0, 1, 9)
    if np.abs(a - b).max() < 1e-150:  # the square of a length below that is no number: there is nothing to travel
        return
    T = LinePath.between(a, b).at(share).T_base_tool
    np.testing.assert_allclose(T[:, :3, 3], a[:3, 3] + share[:, None] * (b[:3, 3] - a[:3, 3]), atol=1e-14)
    slerp = Slerp([0, 1], Rotation.from_matrix(np.array([a[:3, :3], b[:3, :3]])))(share)
    np.testing.assert_allclose(T[:, :3, :3], slerp.as_matrix(), atol=1e-12)


@given(ours.vectors(-1, 1), ours.directions(), st.floats(0.05, 1.0), st.floats(0.1, 6.2), st.floats(0.1, 0.9))
def test_an_arc_goes_through_its_three_points(center, axis, radius, angle, part):
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across *= radius / np.linalg.norm(across)
    a, via, b = (center + exp_so3(axis * f) @ across for f in (0.0, part * angle, angle))
    found, sweep = through(a, via, b)
    # The centre of a flat arc is badly determined: its error grows with the inverse square of the angle.
    np.testing.assert_allclose(found, center, atol=1e-12 / min(part * angle, (1 - part) * angle) ** 2)
    np.testing.assert_allclose(sweep, axis * angle, atol=1e-11 / min(part * angle, (1 - part) * angle) ** 2)


@pytest.mark.parametrize(
    ("a", "via", "b"),
    [([0, 0, 0], [1, 0, 0], [2, 0, 0]), ([0, 0, 0], [0, 0, 0], [1, 0, 0]), ([0, 0, 0], [1, 0, 0], [0, 0, 0])],
)
def test_points_on_a_line_make_no_arc(a, via, b):
    with pytest.raises(InputError, match="no arc goes through them"):
        through(*map(np.array, (a, via, b)))


def test_blends_stay_by_their_corners_and_lines_are_straight_beyond_them():
    corner = np.array([0.3, 0.0, 0.0])
    Ts = np.array([pose(np.eye(3), p) for p in (np.zeros(3), corner, np.array([0.3, 0.2, 0.0]))])
    r = 0.04
    path = blended(Ts, r)
    p = path.at(np.linspace(0, 1, 100_001)).T_base_tool[:, :3, 3]
    # A right angle is passed at 3/16 r sqrt(2).
    assert np.linalg.norm(p - corner, axis=1).min() == pytest.approx(3 / 16 * r * np.sqrt(2), rel=1e-6)
    early, late = p[:, 0] < 0.3 - r, p[:, 1] > r
    assert (p[early][:, 1:] == 0).all()
    np.testing.assert_allclose(p[late][:, 0], 0.3, atol=1e-15)
    np.testing.assert_allclose(p[[0, -1]], Ts[[0, 2], :3, 3], atol=1e-15)


def test_a_blend_takes_no_more_than_half_a_line():
    path = blended(random_poses(5, 4), 1e3)
    assert isinstance(path, BlendedPath)
    lengths = np.diff([0.0, *path.corners_m, path.length_m])
    np.testing.assert_allclose(path.blends_m, np.minimum(lengths[:-1], lengths[1:]) / 2)


@pytest.mark.parametrize(
    ("T", "said"),
    [
        (np.eye(3), "has shape"),
        (np.full((4, 4), np.nan), "NaN"),
        (2 * np.eye(4), "is no pose"),
        (np.diag([1.0, 1, -1, 1]), "is no pose"),
        ("here", "must be numbers"),
    ],
)
def test_what_is_no_pose_is_rejected(T, said):
    with pytest.raises(InputError, match=said):
        checked_pose(T, "T_base_goal")


def test_a_line_to_where_the_tool_is_is_rejected():
    with pytest.raises(InputError, match="nothing to travel"):
        LinePath.between(np.eye(4), np.eye(4))
