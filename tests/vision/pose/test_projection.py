"""Shape modes: held against the seven freedoms written out once more, and against what a rigid fit can take away."""

import numpy as np
import pytest

from armsight.geometry.rigid import fit_rigid
from armsight.vision.pose.projection import every_point, smooth, without_gauge
from views import board

BALL = np.random.default_rng(0).normal(size=(9, 3)) * 0.05
BODIES = {"ball": BALL, "board": board(), "tilted board": board() @ np.linalg.qr(BALL[:3])[0] + [0.1, -0.2, 0.7]}


def freedoms(points):
    """(7, M, 3) three shifts, three rotations and one scaling, as velocities of the points."""
    x, y, z = points.T
    o, i = np.zeros_like(x), np.ones_like(x)
    return np.array(
        [
            *(np.column_stack(c) for c in ([i, o, o], [o, i, o], [o, o, i])),  # shifts
            *(np.column_stack(c) for c in ([o, -z, y], [z, o, -x], [-y, x, o])),  # rotations about x, y, z
            points,  # scaling
        ]
    )


def span(fields):
    """Orthonormal rows that span displacement fields."""
    _, s, basis = np.linalg.svd(fields.reshape(len(fields), -1), full_matrices=False)
    return basis[s > 1e-10 * s[0]]


def assert_modes(points, modes):
    flat = modes.reshape(len(modes), -1)
    np.testing.assert_allclose(np.sqrt((modes**2).sum(axis=2).mean(axis=1)), 1.0, rtol=1e-12)
    np.testing.assert_allclose(flat @ flat.T, len(points) * np.eye(len(modes)), atol=1e-9)
    overlap = flat @ span(freedoms(points)).T / np.sqrt(len(points))
    assert np.abs(overlap).max() < 1e-9


@pytest.mark.parametrize("name", BODIES)
def test_every_points_modes_are_all_but_the_seven_freedoms(name):
    points = BODIES[name]
    modes = every_point(points)
    assert_modes(points, modes)
    assert len(modes) == 3 * len(points) - 7
    together = np.concatenate([span(freedoms(points)), modes.reshape(len(modes), -1) / np.sqrt(len(points))])
    assert np.linalg.matrix_rank(together) == 3 * len(points)


def test_points_on_one_line_have_six_freedoms():
    points = np.outer(np.linspace(-0.1, 0.1, 5), [1.0, 2.0, -1.0]) + np.array([0.1, 0.0, 0.5])
    modes = every_point(points)
    assert len(modes) == 15 - 6
    assert_modes(points - points.mean(axis=0), modes)


@pytest.mark.parametrize(("degree", "count"), [(1, 9 - 7), (2, 18 - 7), (4, 45 - 7)])
def test_smooth_modes_are_the_polynomials_but_for_the_seven_freedoms(degree, count):
    points = board()
    modes = smooth(points, degree)
    # Every freedom of a plane is a polynomial of the first degree: all seven are taken out.
    assert len(modes) == count
    assert_modes(points, modes)
    x, y, _ = (10 * points).T
    terms = np.array([x**i * y**j for i in range(degree + 1) for j in range(degree + 1) if i + j <= degree])
    fields = np.concatenate([terms[:, :, None] * axis for axis in np.eye(3)])
    assert np.linalg.matrix_rank(np.concatenate([span(fields), span(modes)]), tol=1e-8) == 3 * len(terms)


def test_a_scaling_and_a_bow_are_among_the_smooth_modes():
    points = board()
    x, y, o = points[:, 0], points[:, 1], np.zeros(len(points))
    for field in (np.column_stack([x, -y, o]), np.column_stack([y, x, o]), np.column_stack([o, o, x * x])):
        inside = span(np.concatenate([smooth(points, 2), freedoms(points)]))
        left = field.ravel() - inside.T @ (inside @ field.ravel())
        assert np.abs(left).max() < 1e-12 * np.abs(field).max()


@pytest.mark.parametrize("name", BODIES)
def test_no_rigid_motion_takes_any_of_a_mode_away(name):
    points = BODIES[name]
    for mode in every_point(points):
        bent = points + 1e-6 * mode
        T = fit_rigid(points, bent)
        left = bent - (points @ T[:3, :3].T + T[:3, 3])
        # What a rigid fit could take is of second order in the displacement over the body's size.
        np.testing.assert_allclose(left, 1e-6 * mode, atol=1e-6 * 1e-3)


@pytest.mark.parametrize("name", BODIES)
def test_what_is_only_a_freedom_leaves_no_mode(name):
    points = BODIES[name]
    mixed = np.einsum("kl,lmi->kmi", np.random.default_rng(1).normal(size=(4, 7)), freedoms(points))
    field = every_point(points)[0]
    modes = without_gauge(points, np.concatenate([mixed, field[None]]))
    assert len(modes) == 1
    np.testing.assert_allclose(np.abs((modes[0] * field).sum()), len(points), rtol=1e-9)
