"""One camera: OpenCV is the oracle of projection, finite differences of every derivative."""

import cv2
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.vision.camera import DISTORTION_MODELS, Camera
from asserts import assert_jacobian
from strategies import CAMERAS, FOLDING, SIZE

MODELS = list(CAMERAS)


def grid(camera, step=80):
    """Raw pixels over the whole image, its corners included."""
    width, height = camera.image_size_px
    u, v = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    corners = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1), camera.intrinsics[2:]]
    return np.concatenate([pixels, np.array(corners)])


def points_in_view(camera, n=200):
    """Seeded points whose images fill the frame, 0.3 to 3 m away, built without the camera's own unproject."""
    rng = np.random.default_rng(11)
    z = rng.uniform(0.3, 3.0, n)
    return np.column_stack([rng.uniform(-0.65, 0.65, n) * z, rng.uniform(-0.36, 0.36, n) * z, z])


def opencv_project(camera, p):
    p = p.reshape(-1, 1, 3)
    if camera.model == "fisheye":
        uv, _ = cv2.fisheye.projectPoints(p, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    else:
        d = np.array(camera.distortion) if camera.distortion.size else None
        uv, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), camera.matrix, d)
    return uv.reshape(-1, 2)


def test_every_model_has_a_camera_here():
    assert set(MODELS) == set(DISTORTION_MODELS)


@pytest.mark.parametrize("model", MODELS)
def test_project_is_opencvs(model):
    camera, p = CAMERAS[model], points_in_view(CAMERAS[model])
    # Pixels of about 1e3 in doubles, a few dozen operations: 1e3 * 2.2e-16 * 50.
    np.testing.assert_allclose(camera.project(p), opencv_project(camera, p), rtol=0, atol=1e-11)


@pytest.mark.parametrize("model", MODELS)
def test_the_axis_meets_the_principal_point(model):
    camera = CAMERAS[model]
    np.testing.assert_array_equal(camera.project(np.array([[0.0, 0.0, 2.0]])), [camera.intrinsics[2:]])


def test_fisheye_sees_past_ninety_degrees():
    camera = CAMERAS["fisheye"]
    theta = np.radians([80.0, 90.0, 100.0])
    p = np.column_stack([np.sin(theta), np.zeros(3), np.cos(theta)])
    k = camera.distortion
    radius = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)  # Kannala-Brandt
    np.testing.assert_allclose(
        camera.project(p)[:, 0], camera.intrinsics[2] + camera.intrinsics[0] * radius, atol=1e-11
    )


@pytest.mark.parametrize("off", [0.0, 1e-200, 1e-12, 1e-10, 1e-8, 1e-5, 1e-2])
@pytest.mark.parametrize("z", [-2.0, -1e-3])
def test_fisheye_straight_behind_is_right_or_nothing(off, z):
    """The image of the backward direction is a circle: near it the side counts, on it there is no image."""
    camera = CAMERAS["fisheye"]
    rotations = np.radians([0.0, 90, 200, 315])
    sides = np.column_stack([np.cos(rotations), np.sin(rotations)])
    uv, J_p, J_k = camera.project_jacobians(np.column_stack([off * abs(z) * sides, np.full(4, z)]))
    if off <= 1e-10:
        assert np.isnan(uv).all()
        assert np.isnan(J_p).all()
        assert np.isnan(J_k).all()
        return
    theta, k = np.pi - np.arctan(off), camera.distortion
    radius = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    expected = camera.intrinsics[2:] + camera.intrinsics[:2] * radius * sides
    # The coordinates of about 1e4 px rotate with the direction off * (cos, sin), which holds 16 digits.
    np.testing.assert_allclose(uv, expected, rtol=0, atol=1e-10)
    assert np.isfinite(J_p).all()
    assert np.isfinite(J_k).all()


@pytest.mark.parametrize("model", MODELS)
def test_unproject_undoes_project_over_the_image(model):
    camera = CAMERAS[model]
    uv = grid(camera)
    rays = camera.unproject(uv)
    assert np.abs(np.linalg.norm(rays, axis=1) - 1).max() < 1e-15 * 4
    # Newton stops at a step of 1e-12 focal lengths, 1e-9 px, and has then converged quadratically far below it.
    np.testing.assert_allclose(camera.project(rays), uv, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", MODELS)
def test_unproject_is_the_direction_of_the_point(model):
    camera, p = CAMERAS[model], points_in_view(CAMERAS[model])
    rays = camera.unproject(camera.project(p))
    np.testing.assert_allclose(rays, p / np.linalg.norm(p, axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_nothing_behind_a_camera(model):
    camera = CAMERAS[model]
    behind = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    uv, J_p, J_k = camera.project_jacobians(np.concatenate([behind, [[0.0, 0.0, 1.0]]]))
    lost = [1, 2] if model == "fisheye" else [0, 1, 2]
    for out in (uv, J_p, J_k):
        assert np.isnan(out[lost]).all()
        assert np.isfinite(out[3]).all()
    assert np.isfinite(uv[0]).all() == (model == "fisheye")


def test_no_ray_where_the_distortion_has_no_inverse():
    rays = FOLDING.unproject(np.array([[640 + 500 * 0.71, 360.0], [640 + 500 * 0.69, 360.0], [np.nan, 3.0]]))
    assert np.isnan(rays[[0, 2]]).all()
    assert np.isfinite(rays[1]).all()


@pytest.mark.parametrize("model", MODELS)
def test_jacobian_by_the_point(model):
    camera = CAMERAS[model]
    p = np.concatenate([points_in_view(camera, 6), [[0.0, 0.0, 1.0], [1e-7, -1e-7, 1.0]]])
    _, J_p, _ = camera.project_jacobians(p)
    for i in range(len(p)):
        assert_jacobian(J_p[i], lambda x: camera.project(x[None])[0], p[i], 1e-3, rtol=1e-8)


@pytest.mark.parametrize("model", MODELS)
def test_jacobian_by_the_parameters(model):
    camera, p = CAMERAS[model], points_in_view(CAMERAS[model], 6)
    _, _, J_k = camera.project_jacobians(p)
    step = np.concatenate([np.full(4, 1.0), np.full(camera.distortion.size, 1e-3)])
    assert J_k.shape == (6, 2, camera.parameters.size)
    assert_jacobian(J_k, lambda x: camera.with_parameters(x).project(p), camera.parameters, step, rtol=1e-8)


def test_arrays_cannot_be_written():
    with pytest.raises(ValueError, match="read-only"):
        CAMERAS["brown4"].intrinsics[0] = 1


@pytest.mark.parametrize(
    ("model", "intrinsics", "distortion", "message"),
    [
        ("brown6", np.ones(4), np.zeros(6), "unknown distortion model 'brown6'; known are none, brown4"),
        ("brown4", np.ones(3), np.zeros(4), "4 intrinsics"),
        ("brown4", np.ones(4), np.zeros(5), "4 distortion coefficients, got 4 and 5"),
        ("none", np.array([1, 1, np.nan, 1]), np.zeros(0), "finite"),
        ("brown4", np.ones(4), np.array([0, 0, np.inf, 0]), "finite"),
        ("none", np.array([-1.0, 1, 1, 1]), np.zeros(0), "focal lengths must be positive"),
    ],
)
def test_rejected_cameras(model, intrinsics, distortion, message):
    with pytest.raises(InputError, match=message):
        Camera(SIZE, model, intrinsics, distortion)


@pytest.mark.parametrize("size", [(0, 480), (640, 0), (-640, 480), (float("nan"), 480)])
def test_an_impossible_image_size_is_rejected(size):
    with pytest.raises(InputError, match=f"the image size must be positive, got {size[0]} x {size[1]} px"):
        Camera(size, "none", np.ones(4), np.zeros(0))
