"""Discs painted row by row: some sixteen rows a pixel, each exact in its Gaussian blur; obvious, seeded."""

import numpy as np
from scipy.special import ndtr

import disc_rims
from armsight.geometry.pose import inverse
from views import pixels

SAMPLES = 16


def outline(c, a, b, rotation, points=720):
    """Rim (points, 2) of an ellipse."""
    t = 2 * np.pi * np.arange(points) / points
    u, v = a * np.cos(t), b * np.sin(t)
    cosine, sine = np.cos(rotation), np.sin(rotation)
    return np.column_stack([c[0] + u * cosine - v * sine, c[1] + u * sine + v * cosine])


def share(rims, blur, corner, size):
    """Share of disc (size, size) in the pixels of a window, its first pixel at ``corner``; rims are convex and apart."""
    out, edges = np.zeros((size, size)), np.arange(size + 1) - 0.5

    def ramp(x):
        """A blurred step, summed up from the left: its differences are what each pixel has of it."""
        return x * ndtr(x / blur) + blur * np.exp(-0.5 * (x / blur) ** 2) / np.sqrt(2 * np.pi)

    for rim in rims:
        rim = np.roll(rim - corner, -rim[:, 1].argmin(), axis=0)
        bottom = rim[:, 1].argmax()
        height = rim[bottom, 1] - rim[0, 1]
        angle = np.pi / np.ceil(SAMPLES * height)
        angles = np.arange(angle / 2, np.pi, angle)  # rows lie closer at the ends, where a disc's width rises as a root
        rows, heights = rim[0, 1] + height * np.sin(angles / 2) ** 2, height * angle / 2 * np.sin(angles)
        sides = rim[: bottom + 1], np.roll(rim, -1, axis=0)[bottom - 1 :][::-1]
        left, right = (ramp(edges - np.interp(rows, *side.T[::-1])[:, None]) for side in sides)
        down = np.diff(ndtr((edges[:, None] - rows) / blur), axis=0) * heights
        out += down @ np.abs(np.diff(left - right, axis=1))
    return out


def grey(light, noise, rng):
    """Expose: noise, rounding, eight bits."""
    return np.clip(np.rint(light + noise * rng.normal(size=light.shape)), 0, 255).astype(np.uint8)


def rims_of(camera, T_camera_body, target, points=360):
    """Rims in the image of a body's discs, by OpenCV's projection point by point."""
    R, t = T_camera_body[:3, :3], T_camera_body[:3, 3]
    discs = zip(target.body.points, target.normals, target.radii_m, strict=True)
    return [pixels(camera, disc_rims.rim(p, n, r, points) @ R.T + t) for p, n, r in discs]


def light_of(rig, target, T_left_body, *, hidden=(), base=45.0, contrast=130.0, blur=0.8):
    """What both cameras see of bright discs on an even ground; ``hidden`` names (disc, camera) that something covers."""
    lights = []
    for side, camera in enumerate(rig.cameras):
        width, height = camera.image_size_px
        light = np.full((height, width), base)
        T = T_left_body if side == 0 else inverse(rig.T_left_right) @ T_left_body
        for m, outline_px in enumerate(rims_of(camera, T, target)):
            if (m, side) in hidden:
                continue
            corner = np.floor(outline_px.min(axis=0)).astype(int) - 6
            size = int(np.ceil(np.ptp(outline_px, axis=0).max())) + 13
            window = share([outline_px], blur, corner, size)
            low, high = np.maximum(corner, 0), np.minimum(corner + size, (width, height))
            if (high > low).all():
                part = window[low[1] - corner[1] : high[1] - corner[1], low[0] - corner[0] : high[0] - corner[0]]
                light[low[1] : high[1], low[0] : high[0]] += contrast * part
        lights.append(light)
    return lights


def pair_of(rig, target, T_left_body, rng, *, hidden=(), noise=2.0):
    """Both images of :func:`light_of`."""
    return [grey(light, noise, rng) for light in light_of(rig, target, T_left_body, hidden=hidden)]
