"""A room before two cameras, apart from the code it tests: walls and boards of texture at depths, lamps, people, a screen.

A shot is the ray of each pixel cut with each plane, the nearest one seen; then light, what walks by, noise and JPEG.
"""

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from armsight.data import Shot
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.render.background import cluttered, textured

RATE_HZ = 5.0
FINE = 2  # rays a pixel along each side
STILL = np.zeros(6)


class Room:
    """A room from a seed, seen by the rig at a scale of its images."""

    def __init__(self, seed, *, scale=0.5, texture=True):
        self.rng = np.random.default_rng(seed)
        self.rig = small(example_rig(), scale)
        draw = textured if seed % 2 else cluttered
        self.planes = []
        for z, size in ((2.6, 7.0), (1.9, 1.2), (1.6, 0.9), (1.4, 0.7)):
            shift = self.rng.uniform(-0.5, 0.5, 2) * (z < 2.5)
            T = pose(exp_so3(self.rng.normal(0, 0.15, 3)), np.array([*shift, z]))
            image = draw((1600, 1200), self.rng) if texture else np.full((1200, 1600), 0.4, np.float32)
            smooth = cv2.GaussianBlur(255 * image, (0, 0), 1.5)  # what no pixel resolves would be seen elsewhere
            self.planes.append((T, size, smooth))
        self.walkers = self.rng.uniform(0.2, 0.8, (3, 2))
        self._still = {}

    @cached_property
    def _rays(self):
        """The rays of both cameras' pixels, FINE along each side of one."""
        width, height = self.rig.left.image_size_px
        v, u = np.mgrid[: FINE * height, : FINE * width] / FINE - 0.5 + 0.5 / FINE
        return [camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1)) for camera in self.rig.cameras]

    def clean(self, side, xi):
        """The image of a camera that moved by a right tangent of its own pose."""
        key = side, tuple(xi)
        if key not in self._still:
            T = (np.eye(4), self.rig.T_left_right)[side] @ exp_se3(np.asarray(xi, float))
            width, height = self.rig.cameras[side].image_size_px
            rays = self._rays[side]
            depth, out = np.full(len(rays), np.inf), np.full(len(rays), 90.0)
            for T_left_plane, size, image in self.planes:
                W = inverse(T_left_plane) @ T
                d, o = rays @ W[:3, :3].T, W[:3, 3]
                t = -o[2] / d[:, 2]
                at = (o + t[:, None] * d)[:, :2] / size
                h, w = image.shape
                xy = (at * w + np.array([w / 2, h / 2])).astype(np.float32)
                inside = (np.abs(xy - np.array([w / 2, h / 2])) < np.array([w / 2 - 2, h / 2 - 2])).all(axis=1)
                hit = (t > 0) & (t < depth) & inside
                depth[hit] = t[hit]
                x, y = (xy[:, i].reshape(-1, FINE * width) for i in (0, 1))
                seen = cv2.remap(image, x, y, cv2.INTER_CUBIC)
                out[hit] = seen.ravel()[hit]
            big = out.reshape(FINE * height, FINE * width).astype(np.float32)
            image = cv2.resize(big, (width, height), interpolation=cv2.INTER_AREA)
            self._still[key] = cv2.GaussianBlur(image, (0, 0), 0.8)
        return self._still[key]

    def shot(self, k, left=STILL, right=STILL, *, lamp=0.0, sun=None, people=False, noise=2.0, quality=None):
        """Shot k; ``lamp`` adds that share of light from one side, ``sun`` is a shadow's soft edge, a share of the width;
        ``people`` walk by and a screen changes."""
        images = []
        for side, xi in enumerate((left, right)):
            image = self.clean(side, xi)
            height, width = image.shape
            image = image * (1.0 + lamp * np.linspace(0.3, 1.0, width, dtype=np.float32))
            if sun is not None:
                image = image * (1.0 - 0.4 / (1.0 + np.exp((np.arange(width, dtype=np.float32) - sun * width) / 6)))
            if people:
                for n, (x, y) in enumerate(self.walkers):
                    at = (int(width * ((x + 0.02 * (n + 1) * k) % 1.2 - 0.1)) - 8 * side, int(height * y))
                    cv2.ellipse(image, at, (width // 14, height // 5), 0, 0, 360, 40.0 + 50 * n, -1)
                screen = np.float32(np.random.default_rng(k).uniform(20, 230, (height // 6, width // 6)))
                image[height // 20 : height // 20 + height // 6, width // 2 : width // 2 + width // 6] = screen
            image = np.clip(image + self.rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)
            if quality:
                image = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0)
            images.append(image)
        return Shot(f"{k}", *images, t_s=k / RATE_HZ)


def small(rig, scale):
    """The rig with images of a share of their size."""
    cameras = []
    for camera in rig.cameras:
        width, height = (round(scale * side) for side in camera.image_size_px)
        K = scale * np.asarray(camera.intrinsics)
        K[2:] += 0.5 * scale - 0.5
        cameras.append(replace(camera, image_size_px=(width, height), intrinsics=K))
    return replace(rig, left=cameras[0], right=cameras[1])
