"""A tool without markers, rendered: matched densely, found in its cloud, against the pose it was rendered at."""

import numpy as np
import pytest

from armsight.data import Missed
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.render.mesh import box, joined, moved, see, with_noise
from armsight.vision.dense.depth import depth_of
from armsight.vision.dense.method import Search
from armsight.vision.dense.registration import Surface, locate_cloud, read_stl
from armsight.vision.dense.semiglobal import Semiglobal

GRAIN = {"grain_m": 0.012, "contrast": 30.0, "seed": 3}


def tool():
    """A gripper's body with a plate and an arm: no rotation of it looks like another."""
    return joined(
        box(np.array([0.10, 0.08, 0.06]), **GRAIN),
        moved(box(np.array([0.03, 0.12, 0.03]), **GRAIN), pose(np.eye(3), np.array([0.03, 0.06, -0.02]))),
        moved(
            box(np.array([0.12, 0.025, 0.025]), **GRAIN),
            pose(exp_so3(np.array([0, 0, 0.4])), np.array([-0.07, -0.03, -0.03])),
        ),
    )


def cloud(T_left_body, rng):
    """Render the tool before a wall with the example rig, match it, and return its points and sigmas."""
    rig = example_rig((640, 480), focal_px=640.0)
    wall = box(np.array([3.0, 3.0, 0.02]), grain_m=0.05, contrast=25.0, seed=9)
    behind = pose(exp_so3(np.array([0.1, 0.1, 0.0])), np.array([0.1, 0.0, 1.3]))
    images = []
    for camera, T in ((rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right))):
        images.append(with_noise(see(camera, [(wall, T @ behind), (tool(), T @ T_left_body)])[0], 1.5, rng))
    form = rig.rectify()
    result = Semiglobal().match(*form.images(*images), Search(0, int(form.disparity_of(0.55))))
    depth = depth_of(form, result)
    chosen = result.measured & np.isfinite(depth.depth_m)
    v, u = np.nonzero(chosen)
    points = form.points(np.column_stack([u, v]).astype(float), result.disparity[chosen])
    return points, depth.sigma_m[chosen]


def test_a_rendered_tool_is_found_to_a_millimetre_and_half_a_degree():
    rng = np.random.default_rng(0)
    T_true = pose(exp_so3(np.array([0.3, -0.4, 0.2])), np.array([0.06, -0.02, 0.8]))
    points, sigma = cloud(T_true, rng)
    surface = Surface.of_mesh(tool().vertices, tool().triangles)
    for _ in range(3):
        start = T_true @ exp_se3(np.concatenate([rng.uniform(-0.008, 0.008, 3), np.radians(rng.uniform(-3, 3, 3))]))
        found = locate_cloud(surface, points, sigma, start)
        assert not isinstance(found, Missed), found
        off = log_se3(inverse(found.T_left_body) @ T_true)
        assert np.linalg.norm(off[:3]) < 1.0e-3  # the target at 0.8 m
        assert np.degrees(np.linalg.norm(off[3:])) < 0.5
        assert found.points > 1000
    assert isinstance(locate_cloud(surface, points, sigma, T_true @ pose(np.eye(3), np.array([0, 0, -0.4]))), Missed)


def corner_cloud(rng, T, noise):
    """Points of the three faces of a box that a camera at the origin sees."""
    surface = Surface.of_mesh(*box_mesh())
    seen = np.einsum("ni,ni->n", surface.normals, inverse(T)[:3, 3] - surface.points) > 0
    p = transform(T, surface.points[seen])
    return p + noise * rng.normal(size=(len(p), 1)) * p / np.linalg.norm(p, axis=1, keepdims=True)


def box_mesh():
    b = box(np.array([0.08, 0.06, 0.05]))
    return b.vertices, b.triangles


def test_independent_noise_is_averaged_away():
    rng = np.random.default_rng(1)
    T = pose(exp_so3(np.array([0.6, 0.7, 0.1])), np.array([0.0, 0.0, 0.6]))
    points = corner_cloud(rng, T, 5e-4)
    start = T @ exp_se3(np.array([0.006, -0.005, 0.004, 0.05, -0.04, 0.05]))
    found = locate_cloud(Surface.of_mesh(*box_mesh()), points, np.full(len(points), 5e-4), start)
    off = log_se3(inverse(found.T_left_body) @ T)
    # Thousands of points of 0.5 mm hold each of three faces to 0.5 / sqrt(1000) mm; five sigma of it, and three faces.
    assert np.linalg.norm(off[:3]) < 3 * 5 * 5e-4 / np.sqrt(1000)
    assert found.rms_m == pytest.approx(5e-4, rel=0.5)
    assert (np.linalg.eigvalsh(found.cov) > 0).all()


def test_a_reference_cloud_stands_in_for_a_mesh():
    rng = np.random.default_rng(2)
    T = pose(exp_so3(np.array([0.6, 0.7, 0.1])), np.array([0.0, 0.0, 0.6]))
    reference = corner_cloud(rng, T, 1e-4)
    surface = Surface.of_cloud(transform(inverse(T), reference), inverse(T)[:3, 3])
    T_now = T @ exp_se3(np.array([0.003, 0.004, -0.003, 0.03, 0.02, -0.03]))
    points = corner_cloud(rng, T_now, 1e-4)
    found = locate_cloud(surface, points, np.full(len(points), 1e-4), T)
    off = log_se3(inverse(found.T_left_body) @ T_now)
    assert np.linalg.norm(off[:3]) < 3e-4  # normals at edges are rounded over 24 neighbours, some mm
    assert np.degrees(np.linalg.norm(off[3:])) < 0.2


def test_a_plane_does_not_fix_a_pose():
    rng = np.random.default_rng(0)
    p = np.column_stack([rng.uniform(-0.5, 0.5, (4000, 2)), np.full(4000, 0.7)])
    surface = Surface(p - [0, 0, 0.7], np.tile([0.0, 0.0, -1.0], (4000, 1)))
    found = locate_cloud(surface, p, np.full(4000, 1e-3), pose(np.eye(3), np.array([0.0, 0.0, 0.705])))
    assert isinstance(found, Missed)
    assert "slide" in found.reason


def test_meshes_are_sampled_on_their_surface():
    surface = Surface.of_mesh(*box_mesh())
    half = np.array([0.04, 0.03, 0.025])
    share = np.abs(surface.points) / half
    np.testing.assert_allclose(share.max(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(np.einsum("ni,ni->n", surface.normals, surface.points), half[share.argmax(axis=1)])
    with pytest.raises(InputError, match="area"):
        Surface.of_mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))


def test_stl_files_are_read_in_mm(tmp_path):
    vertices, triangles = box_mesh()
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows = np.zeros(len(triangles), kind)
    rows["corners"] = 1e3 * vertices[triangles]
    path = tmp_path / "a.stl"
    path.write_bytes(bytes(80) + len(rows).to_bytes(4, "little") + rows.tobytes())
    got, faces = read_stl(path)
    np.testing.assert_allclose(got[faces], vertices[triangles], atol=1e-8)
    path.write_bytes(b"solid a")
    with pytest.raises(InputError, match="binary STL"):
        read_stl(path)
    with pytest.raises(InputError, match="no such file"):
        read_stl(tmp_path / "none.stl")
