"""Pairs with an exact truth: flat layers of random texture for speed, and rendered solids for what flat layers lack."""

from functools import lru_cache

import cv2
import numpy as np
from solids import box, see, with_noise

from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.dense.evaluate import TrueDisparity, seen_by_right


def texture(height, width, rng, grain=2.0):
    """Random grey levels, smooth over about ``grain`` px."""
    t = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), grain)
    return np.clip(128 + 40 * t / t.std(), 0, 255)


@lru_cache
def layers(height=120, width=200, far=6, near=22, seed=0, noise=1.0):
    """A near square before a far wall, both at whole disparities: left, right, truth."""
    rng = np.random.default_rng(seed)
    wall, square = texture(height, width + 2 * near, rng), texture(height, width + 2 * near, rng)
    box_ = slice(height // 4, 3 * height // 4), slice(width // 2 - 25, width // 2 + 25)
    left = wall[:, near : near + width].copy()
    right = wall[:, near + far : near + far + width].copy()
    truth = np.full((height, width), float(far))
    left[box_] = square[box_]
    moved = slice(box_[1].start - near, box_[1].stop - near)
    right[box_[0], moved] = square[box_]
    truth[box_] = near
    images = [np.clip(np.rint(i + noise * rng.normal(size=i.shape)), 0, 255).astype(np.uint8) for i in (left, right)]
    return (*images, TrueDisparity(truth, seen_by_right(truth)))


@lru_cache
def rendered(seed, size=(360, 270), noise=2.0):
    """Boxes anyhow rotated before a wall: left, right, truth; disparities 8 to 56."""
    rng = np.random.default_rng(seed)
    focal, baseline = 400.0, 0.1
    camera = Camera(size, "none", np.array([focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2]), np.zeros(0))
    far = focal * baseline / 9
    wall = box(np.array([6 * far, 6 * far, 0.01]), grain_m=0.06 * far, contrast=rng.uniform(10, 35), seed=seed)
    tilt = np.array([*rng.uniform(-0.4, 0.4, 2), 0.0])
    solids = [(wall, pose(exp_so3(tilt), np.array([0, 0, far])))]
    for _ in range(6):
        z = focal * baseline / rng.uniform(14, 50)
        body = box(
            z * rng.uniform((0.1, 0.1, 0.05), (0.5, 0.5, 0.3)),
            grain_m=z * rng.uniform(0.02, 0.08),
            contrast=rng.uniform(6, 40),
            seed=int(rng.integers(10**6)),
        )
        position = np.array([rng.uniform(-0.45, 0.45) * z, rng.uniform(-0.35, 0.35) * z, z])
        solids.append((body, pose(exp_so3(rng.uniform(-0.7, 0.7, 3)), position)))
    left, depth = see(camera, solids)
    aside = pose(np.eye(3), np.array([-baseline, 0.0, 0.0]))
    right, depth_right = see(camera, [(s, aside @ T) for s, T in solids])
    d = focal * baseline / depth
    column = np.arange(size[0])[None] - d
    k = np.clip(np.rint(column), 0, size[0] - 1).astype(int)
    there = focal * baseline / np.take_along_axis(depth_right, k, axis=1)
    truth = TrueDisparity(d, (column >= 0) & (np.abs(there - d) < 1))
    return with_noise(left, noise, rng), with_noise(right, noise, rng), truth


def at(image, y, x):
    """A grey level, of the nearest pixel where (y, x) is outside of the image."""
    height, width = image.shape
    return int(image[min(max(y, 0), height - 1), min(max(x, 0), width - 1)])


def raw_costs(left, right, search, steps, absent, cost):
    """Costs pixel by pixel: ``cost(differ, y, x, d)`` of the census bits at ``steps`` that differ, else ``absent``."""

    def bits(image, y, x):
        return [at(image, y + j, x + i) < at(image, y, x) for j in steps for i in steps if (i, j) != (0, 0)]

    out = np.full((*left.shape, search.count), absent)
    for y, x in np.ndindex(left.shape):
        for d in range(search.first, min(search.first + search.count, x + 1)):
            differ = sum(a != b for a, b in zip(bits(left, y, x), bits(right, y, x - d), strict=True))
            out[y, x, d - search.first] = cost(differ, y, x, d)
    return out
