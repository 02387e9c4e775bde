"""Discs painted by brute force: sixteen samples a pixel and side, Gaussian blur on the samples; slow, obvious, seeded."""

import cv2
import numpy as np

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
    """Share of disc (size, size) that the pixels of a window show, its first pixel at ``corner``; rims are convex."""
    fine = np.zeros((size * SAMPLES, size * SAMPLES), np.float32)
    for rim in rims:
        np.maximum(fine, filled((rim - corner + 0.5) * SAMPLES, size * SAMPLES), out=fine)
    soft = cv2.GaussianBlur(fine, (0, 0), blur * SAMPLES)
    return soft.reshape(size, SAMPLES, size, SAMPLES).mean(axis=(1, 3)).astype(float)


def filled(rim, size):
    """Share (size, size) of each cell along its middle row that lies inside a convex polygon."""
    ends = np.roll(rim, -1, axis=0)
    rows = np.arange(size) + 0.5
    out = np.zeros((size, size))
    columns = np.arange(size)
    for k, y in enumerate(rows):
        cut = (rim[:, 1] <= y) != (ends[:, 1] <= y)
        if cut.any():
            a, b = rim[cut], ends[cut]
            x = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
            out[k] = np.clip(x.max() - columns, 0, 1) - np.clip(x.min() - columns, 0, 1)
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
