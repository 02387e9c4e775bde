"""The slow, obvious oracle of the renderer: SAMPLES x SAMPLES rays through every pixel, in plain numpy.

Nothing of armsight's camera or painter is used: the distortion is undone by fixed-point iteration, a pattern is looked
up point by point, the blur is a convolution of the fine samples.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d

SAMPLES = 32
#: Each step of the iteration takes three quarters of the error away at the very least, mostly nine tenths.
STEPS = 16
STILL = 1e-12  # a step shorter than this is the last


def rays(camera, uv):
    """Unproject (N, 2) by fixed-point iteration of the textbook formulas."""
    fx, fy, cx, cy = camera.intrinsics
    u, v = (uv[:, 0] - cx) / fx, (uv[:, 1] - cy) / fy
    d = np.zeros(8)
    d[: camera.distortion.size] = camera.distortion
    if camera.model == "fisheye":
        r = np.hypot(u, v)
        theta = r.copy()
        for _ in range(STEPS):
            t2, last = theta * theta, theta
            theta = r / (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3]))))
            if np.abs(theta - last).max() < STILL:
                break
        s = np.sin(theta) / np.maximum(r, 1e-12)
        return np.stack([s * u, s * v, np.cos(theta)], axis=1)
    x, y = u.copy(), v.copy()
    k1, k2, p1, p2, k3, k4, k5, k6 = d
    for _ in range(STEPS if d.any() else 0):
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        last = x
        x, y = (
            (u - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (v - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
        if np.abs(x - last).max() < STILL:
            break
    return np.stack([x, y, np.ones_like(x)], axis=1)


def look(pattern, T_camera_body, directions, under):
    """What rays (N, 3) see where they hit a pattern; ``under`` (N,) where they do not."""
    T = T_camera_body @ pattern.T_body_pattern
    normal, origin = T[:3, 2], T[:3, 3]
    if normal @ origin <= 0:
        return under
    depth = (normal @ origin) / (directions @ normal)
    p = (depth[:, None] * directions - origin) @ T[:3, :3]
    out = under.copy()
    i = np.searchsorted(pattern.x_edges, p[:, 0], side="right") - 1
    j = np.searchsorted(pattern.y_edges, p[:, 1], side="right") - 1
    ny, nx = pattern.values.shape
    hit = (depth > 0) & (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
    seen = pattern.values[j[hit], i[hit]]
    out[hit] = np.where(seen >= 0, seen, under[hit])
    for x, y, radius, value in pattern.discs:
        out[(depth > 0) & (np.hypot(p[:, 0] - x, p[:, 1] - y) < radius)] = value
    return out


def brute(camera, layers, window, psf_sigma_px, background=0.4, samples=SAMPLES):
    """Light on the pixels of a window (u0, v0, u1, v1); layers are (pattern, T_camera_body), the nearest last."""
    margin = int(np.ceil(5 * psf_sigma_px))
    u0, v0, u1, v1 = window
    fine = [
        np.arange((a - margin) * samples, (b + margin) * samples) / samples + 0.5 / samples - 0.5
        for a, b in ((u0, u1), (v0, v1))
    ]
    u, v = np.meshgrid(*fine)
    directions = rays(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    light = np.full(u.size, float(background))
    for pattern, T in layers:
        light = look(pattern, T, directions, light)
    light = light.reshape(u.shape)
    if psf_sigma_px > 0:
        for axis in (0, 1):
            light = gaussian_filter1d(light, psf_sigma_px * samples, axis=axis, truncate=6)
    height, width = (n // samples for n in light.shape)
    pixels = light.reshape(height, samples, width, samples).mean(axis=(1, 3))
    return pixels[margin : height - margin, margin : width - margin]


def displacement_px(image, reference):
    """By how much (du, dv) the image is shifted against a reference, both (h, w): least squares on its gradient."""
    gv, gu = np.gradient(reference)
    inner = np.s_[1:-1, 1:-1]
    A = np.stack([-gu[inner].ravel(), -gv[inner].ravel(), np.ones(gu[inner].size)], axis=1)
    return np.linalg.lstsq(A, (image - reference)[inner].ravel(), rcond=None)[0][:2]
