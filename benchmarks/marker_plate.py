"""The three-disc plate before a stereo rig: images with truth through any lens, and what the bound makes of its pose.

Rims are projected by OpenCV point by point and painted by the exact border integral; nothing here uses armsight's
projection of discs.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.rig import StereoRig
from disc_bound import centre_bound
from disc_images import HEIGHT, WIDTH, add_region, closed_border, exposed, polygon_border

#: The scene: levels of background, plate and discs; sigma of the lens.
BACKGROUND, PLATE, DISC, BLUR = 100.0, 45.0, 185.0, 0.7
#: The plate reaches this far beyond its discs' centres, m.
MARGIN_M = 0.03
FOCAL, BASELINE = 900.0, 0.22
LENS = np.array([-0.21, 0.06, 0.0007, -0.0005, 0.004])


def parallel_rig(distortion: np.ndarray | None = None, toe_deg: float = 0.0) -> StereoRig:
    """Return two HD cameras 220 mm apart, each rotated inwards by ``toe_deg``; exactly known."""
    d = np.zeros(0) if distortion is None else distortion
    model = "none" if distortion is None else "brown5"
    cameras = [
        Camera((WIDTH, HEIGHT), model, np.array([FOCAL, FOCAL, WIDTH / 2 + du, HEIGHT / 2 + dv]), d * s)
        for du, dv, s in ((-0.5, -0.5, 1.0), (-0.5, -0.5, 1.03))
    ]
    angle = np.radians(toe_deg)
    T_left_right = pose(
        exp_so3(np.array([0.0, -2 * angle, 0.0])), BASELINE * np.array([np.cos(angle), 0.0, np.sin(angle)])
    )
    n = 14 + 2 * d.size
    return StereoRig(cameras[0], cameras[1], T_left_right, np.zeros((n, n)), 0.0)


def project(camera: Camera, p: np.ndarray) -> np.ndarray:
    """Project (N, 3) points of the camera's frame by OpenCV."""
    d = camera.distortion if camera.distortion.size else None
    return cv2.projectPoints(np.ascontiguousarray(p), np.zeros(3), np.zeros(3), camera.matrix, d)[0].reshape(-1, 2)


def rim(
    camera: Camera, T: np.ndarray, centre: np.ndarray, normal: np.ndarray, radius: float, sigma: float
) -> np.ndarray:
    """Return the image (N, 2) of a disc's rim at even steps of its angle."""
    x = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    near = np.linalg.norm(T[:3, :3] @ centre + T[:3, 3]) - radius
    count = max(64, int(np.ceil(2 * np.pi * radius / near * camera.intrinsics[0] * 1.3 / (0.5 * sigma))))
    t = np.arange(count) * (2 * np.pi / count)
    p = centre + radius * (np.cos(t)[:, None] * x + np.sin(t)[:, None] * y)
    return project(camera, p @ T[:3, :3].T + T[:3, 3])


def views(rig: StereoRig, T_left_body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's pose in each camera's frame."""
    return T_left_body, inverse(rig.T_left_right) @ T_left_body


def corners(target: DiscTarget) -> np.ndarray:
    """Return the corners (4, 3) of the plate."""
    low, high = target.body.points.min(axis=0) - MARGIN_M, target.body.points.max(axis=0) + MARGIN_M
    return np.array([[low[0], low[1], 0.0], [high[0], low[1], 0.0], [high[0], high[1], 0.0], [low[0], high[1], 0.0]])


def light_of(
    camera: Camera, target: DiscTarget, T: np.ndarray, *, blur: float = BLUR, covered: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """Return the light (HEIGHT, WIDTH) that a camera gets from the plate.

    Args:
        camera: the camera.
        target: the plate.
        T: (4, 4) pose in the camera's frame.
        blur: sigma, px.
        covered: polygons (M, 2) in the image, px, painted over everything in the background's level.
    """
    light = np.full((HEIGHT, WIDTH), BACKGROUND)
    c = corners(target)
    t = np.arange(24)[:, None] / 24
    outline = np.concatenate([a + t * (b - a) for a, b in zip(c, np.roll(c, -1, axis=0), strict=True)])
    add_region(light, polygon_border(project(camera, outline @ T[:3, :3].T + T[:3, 3]), blur), blur, PLATE - BACKGROUND)
    for centre, normal, radius in zip(target.body.points, target.normals, target.radii_m, strict=True):
        add_region(light, closed_border(rim(camera, T, centre, normal, radius, blur)), blur, DISC - PLATE)
    for polygon in covered:
        cover_up(light, polygon, blur)
    return light


def cover_up(light: np.ndarray, polygon: np.ndarray, blur: float) -> None:
    """Lay a polygon (M, 2) of the background's level over an image, which it overwrites."""
    share = np.zeros_like(light)
    add_region(share, polygon_border(polygon, blur), blur, 1.0)
    light += share * (BACKGROUND - light)


def shot(
    rig: StereoRig, target: DiscTarget, T: np.ndarray, noise: float, rng: np.random.Generator, **options
) -> tuple[np.ndarray, np.ndarray]:
    """Return both images of the plate at T_left_body."""
    left, right = (
        exposed(light_of(camera, target, at, **options), noise, 0.0, rng)
        for camera, at in zip(rig.cameras, views(rig, T), strict=True)
    )
    return left, right


def in_view(rig: StereoRig, target: DiscTarget, T: np.ndarray, border: float = 12.0) -> bool:
    """Whether the whole plate lies in both images, face to both cameras by 20 degrees at least."""
    for camera, at in zip(rig.cameras, views(rig, T), strict=True):
        p = corners(target) @ at[:3, :3].T + at[:3, 3]
        uv = project(camera, p)
        if not ((p[:, 2] > 0.1).all() and (uv > border).all() and (uv < (WIDTH - border, HEIGHT - border)).all()):
            return False
        middle = target.body.points.mean(axis=0) @ at[:3, :3].T + at[:3, 3]
        if at[:3, 2] @ middle < 0.35 * np.linalg.norm(middle):
            return False
    return True


def poses(
    rig: StereoRig,
    target: DiscTarget,
    count: int,
    rng: np.random.Generator,
    z: tuple[float, float] = (0.6, 1.2),
    tilt_deg: float = 50.0,
) -> list[np.ndarray]:
    """Return poses T_left_body: rotated anyhow about the normal, tilted up to an angle, in full view of both."""
    out = []
    while len(out) < count:
        axis = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(0, tilt_deg)) * np.array([np.cos(axis), np.sin(axis), 0.0])
        R = exp_so3(tilt) @ exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        depth = rng.uniform(*z)
        where = np.array([rng.uniform(-0.4, 0.6) * depth, rng.uniform(-0.35, 0.35) * depth, depth])
        T = pose(R, where - R @ target.body.points.mean(axis=0))
        if in_view(rig, target, T):
            out.append(T)
    return out


def ellipses(camera: Camera, target: DiscTarget, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (N, 2) and S11, S12, S22 (N, 3) of the discs' images, from the moments of their projected rims."""
    uv, shape = [], []
    for centre, normal, radius in zip(target.body.points, target.normals, target.radii_m, strict=True):
        x, y, dy = closed_border(rim(camera, T, centre, normal, radius, 0.7))
        k = np.fft.rfftfreq(len(x), 1 / len(x))
        dx = np.fft.irfft(1j * k * np.fft.rfft(x), len(x)) * (2 * np.pi / len(x))
        dx *= -1.0 if (y @ dx) > 0 else 1.0
        area = x @ dy
        u, v = (x**2 / 2) @ dy / area, -(y**2 / 2) @ dx / area
        p, q = x - u, y - v
        second = np.array([(p**3 / 3) @ dy, (p**2 * q / 2) @ dy, -(q**3 / 3) @ dx]) / area
        uv.append((u, v))
        shape.append(4 * second)
    return np.array(uv), np.array(shape)


def pose_bound(rig: StereoRig, target: DiscTarget, T: np.ndarray, noise: float, blur: float = BLUR) -> np.ndarray:
    """Return the bound (6, 6) of the pose's tangent, from the bounds of all six centres."""
    information = np.zeros((6, 6))
    n = len(target.radii_m)
    for side, camera in enumerate(rig.cameras):
        uv, shape = ellipses(camera, target, views(rig, T)[side])
        C = centre_bound(uv, shape, blur, np.full(n, DISC), np.full(n, PLATE), noise)
        J = np.empty((n, 2, 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = 1e-5
            ends = [ellipses(camera, target, views(rig, T @ exp_se3(s * step))[side])[0] for s in (1, -1)]
            J[:, :, k] = (ends[0] - ends[1]) / 2e-5
        information += np.einsum("nia,nij,njb->ab", J, np.linalg.inv(C), J)
    return np.linalg.inv(information)
