"""Discs in rendered images: their position, size and shape against closed forms, OpenCV's rims and brute force."""

import cv2
import numpy as np
import pytest
from render_oracle import brute, displacement_px

from armsight.geometry.pose import exp_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.render.render import Shutter, radiance
from armsight.sim.render.scene import Pattern, PosedBody, plate
from armsight.vision.camera import Camera

#: The issue's bound on a displaced centre, and one grey level of a sensor of unit gain.
SHIFT_PX, LEVEL = 0.002, 1 / 255
DARK, BRIGHT = 0.1, 0.9
FOCAL = 900.0
LENSES = {
    "none": [],
    "brown5": [-0.25, 0.08, 0.0008, -0.0006, 0.01],
    "brown8": [0.3, 0.1, 0.0008, -0.0006, 0.01, 0.6, 0.05, 0.0],
    "fisheye": [0.05, -0.01, 0.002, 0.0],
}
EXPOSURE_S, ROW_S = 0.008, 2e-4
TWIST = np.array([0.35, -0.2, 0.1, 0.6, -0.4, 2.0])


def camera(model="none", size=(160, 120)):
    """A camera whose axis lies far to the left of its small image: the middle of that is 0.26 off the axis."""
    intrinsics = np.array([FOCAL, 1.004 * FOCAL, size[0] / 2 - 200.3, size[1] / 2 + 120.2])
    return Camera(size, model, intrinsics, np.array(LENSES[model]))


def at_pixel(cam, uv, depth, tilt_deg, around):
    """Pose of a plate whose origin is seen at a pixel; its normal is tilted against the line of sight."""
    ray = cam.unproject(np.array([uv], float))[0]
    face = exp_so3(np.cross([0.0, 0.0, 1.0], ray) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], ray)) * np.arccos(ray[2]))
    tilt = exp_so3(np.radians(tilt_deg) * np.array([np.cos(around), np.sin(around), 0.0]))
    return pose(face @ tilt, depth * ray)


def wall(radius_m):
    """One disc on a plate so large that its borders are far out of the image."""
    far = np.array([-1.0, 1.0])
    return Pattern(far, far, np.array([[DARK]]), np.array([[0.0, 0.0, radius_m, BRIGHT]]))


def rim(cam, T, radius_m, count=4096):
    """The image of the disc's rim by OpenCV."""
    t = np.arange(count) * (2 * np.pi / count)
    p = radius_m * np.stack([np.cos(t), np.sin(t), 0 * t], axis=1) @ T[:3, :3].T + T[:3, 3]
    zero = np.zeros(3)
    if cam.model == "fisheye":
        return cv2.fisheye.projectPoints(p[:, None], zero, zero, cam.matrix, cam.distortion)[0].reshape(-1, 2)
    return cv2.projectPoints(p, zero, zero, cam.matrix, cam.distortion if cam.distortion.size else None)[0].reshape(
        -1, 2
    )


def polygon_moments(points):
    """Area, and the integrals of x, y, x^2, xy, y^2 over a polygon."""
    x, y = points.T
    x1, y1 = np.roll(points, -1, axis=0).T
    c = x * y1 - x1 * y
    out = np.array(
        [
            c.sum() / 2,
            ((x + x1) * c).sum() / 6,
            ((y + y1) * c).sum() / 6,
            ((x * x + x * x1 + x1 * x1) * c).sum() / 12,
            ((x * y1 + 2 * x * y + 2 * x1 * y1 + x1 * y) * c).sum() / 24,
            ((y * y + y * y1 + y1 * y1) * c).sum() / 12,
        ]
    )
    return out * np.sign(out[0])


def light_moments(light, reach):
    """The same of what is brighter than the plate, near the middle: far off, the plate's float32 rounding would count."""
    v, u = np.mgrid[60 - reach : 61 + reach, 80 - reach : 81 + reach]
    share = (light[v, u].astype(float) - float(light[1, 1])) / (BRIGHT - DARK)
    return np.array([(share * f).sum() for f in (1.0, u, v, u * u, u * v, v * v)])


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("radius_px", [2.5, 6.0, 12.0, 30.0])
def test_position_area_and_shape_are_those_of_the_rim(model, radius_px):
    """Tilts to 75 degrees, sharp and far out of focus: the blur adds its variance and moves nothing."""
    cam, rng = camera(model), np.random.default_rng(4)
    for tilt in (0.0, 45.0, 60.0, 75.0):
        for psf in (0.5, 1.5, 3.0):
            depth, uv = 0.6, np.array([80, 60]) + rng.uniform(-1, 1, 2)
            radius_m = radius_px / FOCAL * depth
            T = at_pixel(cam, uv, depth, tilt, rng.uniform(0, 2 * np.pi))
            light = radiance(cam, [PosedBody((wall(radius_m),), T)], psf_sigma_px=psf)
            true = polygon_moments(rim(cam, T, radius_m))
            seen = light_moments(light, min(59, int(1.2 * radius_px + 5 * psf + 3)))
            assert seen[0] == pytest.approx(true[0], rel=2e-3, abs=0.01)
            centre, centre_true = seen[1:3] / seen[0], true[1:3] / true[0]
            np.testing.assert_allclose(centre, centre_true, atol=SHIFT_PX)
            for k, i, j in ((3, 0, 0), (4, 0, 1), (5, 1, 1)):
                spread = seen[k] / seen[0] - centre[i] * centre[j]
                expected = true[k] / true[0] - centre_true[i] * centre_true[j] + (i == j) * (psf**2 + 1 / 12)
                # A radius is twice the root of this: 0.01 of it is 0.002 px of a radius of 10 px.
                assert spread == pytest.approx(expected, abs=0.002 * radius_px + 0.004)


@pytest.mark.parametrize(
    ("model", "radius_px", "tilt", "psf"),
    [("none", 4.0, 60.0, 0.5), ("brown5", 7.0, 60.0, 1.0), ("brown8", 7.0, 45.0, 2.0), ("fisheye", 9.0, 70.0, 0.7)],
)
def test_a_tilted_disc_is_what_brute_force_sees(model, radius_px, tilt, psf):
    cam = camera(model)
    T = at_pixel(cam, (80.3, 59.6), 0.6, tilt, 0.7)
    pattern = plate(0.3, 0.3, DARK, [(0.0, 0.0, radius_px / FOCAL * 0.6, BRIGHT)])
    half = int(np.ceil(radius_px + 2.5 * psf + 1))
    win = (80 - half, 60 - half, 81 + half, 61 + half)
    light = radiance(cam, [PosedBody((pattern,), T)], psf_sigma_px=psf)[win[1] : win[3], win[0] : win[2]]
    reference = brute(cam, [(pattern, T)], win, psf)
    assert np.abs(displacement_px(light, reference)).max() < SHIFT_PX
    assert np.abs(light - reference).max() < LEVEL


@pytest.mark.parametrize(("model", "exposure_s"), [("none", 0.002), ("brown5", 0.008), ("brown5", 0.03)])
def test_a_moving_disc_is_the_mean_of_where_it_was(model, exposure_s):
    """Up to a streak of its own diameter and more."""
    cam, radius_m = camera(model), 8.0 / FOCAL * 0.6
    T = at_pixel(cam, (80.2, 60.4), 0.6, 50.0, 1.1)
    body = PosedBody((wall(radius_m),), T, TWIST)
    light = radiance(cam, [body], psf_sigma_px=0.8, shutter=Shutter(exposure_s=exposure_s))
    times = ((np.arange(200) + 0.5) / 200 - 0.5) * exposure_s
    true = np.mean([polygon_moments(rim(cam, T @ exp_se3(t * TWIST), radius_m, 512)) for t in times], axis=0)
    seen = light_moments(light, 50)
    assert seen[0] == pytest.approx(true[0], rel=1e-3)
    np.testing.assert_allclose(seen[1:3] / seen[0], true[1:3] / true[0], atol=SHIFT_PX)


def rows_of(points, rows, lines=64):
    """Width of a convex polygon and its first moment in u, in each of some pixel rows: scan lines, no pixels."""
    y = rows[:, None] + (np.arange(lines) + 0.5) / lines - 0.5
    x0, y0 = points.T
    x1, y1 = np.roll(points, -1, axis=0).T
    crosses = (y0 <= y.ravel()[:, None]) != (y1 <= y.ravel()[:, None])
    low, high = np.zeros(y.size), np.zeros(y.size)
    for k in np.flatnonzero(crosses.any(axis=1)):
        edges = np.flatnonzero(crosses[k])
        x = x0[edges] + (y.ravel()[k] - y0[edges]) / (y1[edges] - y0[edges]) * (x1[edges] - x0[edges])
        low[k], high[k] = x.min(), x.max()
    width, moment = (high - low).reshape(y.shape), ((high**2 - low**2) / 2).reshape(y.shape)
    return width.mean(axis=1), moment.mean(axis=1)


def test_each_row_of_a_rolling_shutter_cuts_the_disc_at_its_own_moment():
    cam, radius_m = camera("brown5"), 9.0 / FOCAL * 0.6
    T = at_pixel(cam, (80.2, 60.4), 0.6, 40.0, 0.4)
    shutter = Shutter(exposure_s=EXPOSURE_S, row_s=ROW_S)
    light = radiance(cam, [PosedBody((wall(radius_m),), T, TWIST)], psf_sigma_px=0.0, shutter=shutter)
    share = (light.astype(float) - DARK) / (BRIGHT - DARK)
    rows = np.arange(45, 76)
    u = np.arange(light.shape[1])
    nodes, weights = np.polynomial.legendre.leggauss(24)
    width, moment = np.zeros(rows.size), np.zeros(rows.size)
    for i, v in enumerate(rows):
        for x, w in zip(nodes, weights, strict=True):
            t = (v - 59.5) * ROW_S + 0.5 * EXPOSURE_S * x
            one = rows_of(rim(cam, T @ exp_se3(t * TWIST), radius_m, 512), rows[i : i + 1], 16)
            width[i], moment[i] = width[i] + 0.5 * w * one[0][0], moment[i] + 0.5 * w * one[1][0]
    assert width[0] == width[-1] == 0.0
    assert share[rows].sum() == pytest.approx(width.sum(), rel=1e-3)
    assert (share[rows] @ u).sum() / share[rows].sum() == pytest.approx(moment.sum() / width.sum(), abs=SHIFT_PX)
    assert rows @ share[rows].sum(axis=1) / share[rows].sum() == pytest.approx(rows @ width / width.sum(), abs=SHIFT_PX)


def test_a_blurred_moving_disc_under_a_rolling_shutter_is_what_brute_force_sees():
    """Every row of the oracle is a picture of its own: its moments, its blur."""
    cam, psf = camera("brown5"), 0.7
    T = at_pixel(cam, (80.2, 60.4), 0.6, 40.0, 0.4)
    pattern = plate(0.3, 0.3, DARK, [(0.0, 0.0, 5.0 / FOCAL * 0.6, BRIGHT)])
    shutter = Shutter(exposure_s=0.25 * EXPOSURE_S, row_s=0.25 * ROW_S)
    u0, v0, u1, v1 = 71, 52, 90, 69
    light = radiance(cam, [PosedBody((pattern,), T, TWIST)], psf_sigma_px=psf, shutter=shutter)[v0:v1, u0:u1]
    nodes, weights = np.polynomial.legendre.leggauss(6)
    reference = np.zeros_like(light, dtype=float)
    for v in range(v0, v1):
        for x, w in zip(nodes, weights, strict=True):
            at = T @ exp_se3(((v - 59.5) * shutter.row_s + 0.5 * shutter.exposure_s * x) * TWIST)
            reference[v - v0] += 0.5 * w * brute(cam, [(pattern, at)], (u0, v, u1, v + 1), psf, samples=12)[0]
    assert np.abs(displacement_px(light, reference)).max() < SHIFT_PX
    assert np.abs(light - reference).max() < 2 * LEVEL
