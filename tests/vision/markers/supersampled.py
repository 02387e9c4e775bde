"""A slow and obvious painter: plane patterns through a homography, area-sampled, blurred by a sampled Gaussian."""

import cv2
import numpy as np
from scipy.sparse import csr_array


def view(size_px, tilt, tilt_axis, rotation, centre, distance=12.0):
    """Return the homography (3, 3) from the plane's coordinates (about 0, pattern one unit large) to pixels."""
    axis = np.array([np.cos(tilt_axis), np.sin(tilt_axis), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, rotation]))[0]
    f = size_px * distance
    K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
    return K @ np.column_stack([R[:, 0], R[:, 1], [0.0, 0.0, distance]])


def project(H, xy):
    """Map plane points (N, 2) to pixels (N, 2)."""
    p = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    return p[:, :2] / p[:, 2:]


def pixels(count, samples, blur_px, pad):
    """Return the sparse matrix (count, (count + 2 pad) samples) that blurs an axis's samples and averages each pixel's."""
    reach = int(4 * blur_px * samples + 0.5)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (blur_px * samples)) ** 2) if blur_px else np.ones(1)
    taps = np.convolve(taps / taps.sum(), np.full(samples, 1.0 / samples)).astype(np.float32)
    columns = (np.arange(count)[:, None] + pad) * samples - reach + np.arange(len(taps))
    rows = np.repeat(np.arange(count), len(taps))
    return csr_array((np.tile(taps, count), (rows, columns.ravel())), shape=(count, (count + 2 * pad) * samples))


def paint(pattern, H, shape, blur_px, samples=16):
    """Return (h, w) the mean of ``pattern(x, y)`` over each pixel, blurred; pattern gives -1 (dark) to 1 (bright)."""
    h, w = shape
    pad = int(np.ceil(4 * blur_px)) + 1
    v = (np.arange((h + 2 * pad) * samples) + 0.5) / samples - 0.5 - pad
    u = (np.arange((w + 2 * pad) * samples) + 0.5) / samples - 0.5 - pad
    G = np.linalg.inv(H)
    across, lines = pixels(w, samples, blur_px, pad), []
    for V in np.array_split(v[:, None], h):
        d = G[2, 0] * u + G[2, 1] * V + G[2, 2]
        fine = pattern((G[0, 0] * u + G[0, 1] * V + G[0, 2]) / d, (G[1, 0] * u + G[1, 1] * V + G[1, 2]) / d)
        lines.append(across @ fine.astype(np.float32).T)
    return (pixels(h, samples, blur_px, pad) @ np.concatenate(lines, axis=1).T).astype(np.float64)


def expose(painted, contrast, noise, rng, middle=128.0):
    """Return 8-bit grey: ``contrast`` levels from dark to bright, Gaussian noise of so many levels."""
    return np.clip(np.rint(middle + 0.5 * contrast * painted + rng.normal(0.0, noise, painted.shape)), 0, 255).astype(
        np.uint8
    )


def checks(x, y):
    """Return chessboard squares one unit large, dark where both coordinates lie in 0..1."""
    return np.where((np.floor(x) + np.floor(y)) % 2 == 0, -1.0, 1.0)


def board(columns, rows, margin=1.0):
    """Return the pattern of a chessboard of inner corners columns x rows, first corner at 0, first square dark."""

    def pattern(x, y):
        inside = (x >= -1) & (x < columns) & (y >= -1) & (y < rows)
        return np.where(inside, checks(x, y), 1.0)

    return pattern


def picture(cells, outside=1.0, low=0.0, high=1.0):
    """Return the pattern of a picture (h, w) scaled over low..high along x; y in proportion."""
    h, w = cells.shape
    scale = w / (high - low)

    def pattern(x, y):
        i, j = np.floor((y - low) * scale).astype(int), np.floor((x - low) * scale).astype(int)
        inside = (i >= 0) & (i < h) & (j >= 0) & (j < w)
        return np.where(inside, cells[np.clip(i, 0, h - 1), np.clip(j, 0, w - 1)], outside)

    return pattern
