"""From disparity to depth, with the standard deviation that matching and calibration cause.

sigma_z^2 = (z^2 / (f b) sigma_d)^2 + the share of the rig's covariance. The second term is smooth over image and depth:
it is computed at a few positions, by triangulating the same pixels with rigs that are off by one standard deviation
along each principal axis of the covariance, and interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from armsight.data import Array, Record
from armsight.vision.dense.method import Disparity
from armsight.vision.rectify import ROWS_AT_ONCE, Rectification
from armsight.vision.triangulate import midpoints

#: Number of positions along rows, columns and inverse disparity at which the calibration's share is computed.
_COLUMNS, _ROWS, _DEPTHS = 7, 5, 4


@dataclass(frozen=True, eq=False)
class Depth(Record):
    """Depths of a rectified left image."""

    depth_m: Array  #: (H, W) along the camera's axis; NaN where the camera sees nothing, or infinitely far
    sigma_m: Array  #: (H, W) standard deviation where it was measured; NaN elsewhere
    calibration_m: Array  #: (H, W) the calibration's share of it, common to neighbours and to all shots


def calibration_share(rectification: Rectification, uv: Array, disparity: Array) -> Array:
    """Return the relative standard deviation (N,) of depths that the rig's covariance causes.

    ``uv``: (N, 2) pixels of the rectified left image; ``disparity``: (N,) px.
    """
    rig = rectification.rig
    raw = (
        rectification.to_raw(uv, "left"),
        rectification.to_raw(uv - np.column_stack([disparity, np.zeros(len(disparity))]), "right"),
    )
    axis = rectification.T_left_rectleft[:3, 2]
    z = midpoints(rig, *raw) @ axis
    values, vectors = np.linalg.eigh(rig.cov)
    variance = np.zeros(len(uv))
    for value, vector in zip(values, vectors.T, strict=True):
        if value > 0:
            variance += (midpoints(rig.perturbed(np.sqrt(value) * vector), *raw) @ axis - z) ** 2
    return np.asarray(np.sqrt(variance) / z)


def depth_of(rectification: Rectification, result: Disparity) -> Depth:
    """Return depths with their standard deviations."""
    seen, shape = rectification.seen("left"), result.disparity.shape
    z, share = np.full(shape, np.nan), _calibration(rectification, result.disparity, result.measured & seen)
    sigma = np.empty(shape)
    for top in range(0, shape[0], ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        z[rows] = np.where(seen[rows], rectification.depth(result.disparity[rows]), np.nan)
        share[rows] *= z[rows]
        per_px = z[rows] ** 2 / (rectification.focal_px * rectification.rig.baseline_m)
        sigma[rows] = np.hypot(per_px * result.sigma_px[rows], share[rows])
    return Depth(z, sigma, share)


def _calibration(rectification: Rectification, disparity: NDArray[np.float32], measured: NDArray[np.bool_]) -> Array:
    """Return the calibration's relative share (H, W) where it was measured, NaN elsewhere; a few rows at a time."""
    measured = measured & (disparity > 0)  # what is infinitely far has no depth
    out = np.where(measured, 0.0, np.nan)
    if not rectification.rig.cov.any() or not measured.any():
        return out
    height, width = measured.shape
    least, most = (float(f(disparity[measured])) for f in (np.min, np.max))
    low, high = 1 / most, 1 / least * (1 + 1e-9) + 1e-12
    axes = (np.linspace(0, height - 1, _ROWS), np.linspace(0, width - 1, _COLUMNS), np.linspace(low, high, _DEPTHS))
    rows, columns, inverses = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    share = calibration_share(rectification, np.column_stack([columns, rows]), 1 / inverses).reshape(
        _ROWS, _COLUMNS, _DEPTHS
    )
    whole = np.isfinite(share)
    share = np.where(whole, share, share[whole].max() if whole.any() else 0.0)  # corners that a camera does not see
    for top in range(0, height, ROWS_AT_ONCE):
        strip = slice(top, top + ROWS_AT_ONCE)
        v, u = np.nonzero(measured[strip])
        inverse = 1 / disparity[strip][v, u].astype(np.float64)
        positions = ((v + top) / max(height - 1, 1), u / max(width - 1, 1), (inverse - low) / (high - low))
        cells = [p * (n - 1) for p, n in zip(positions, share.shape, strict=True)]
        out[strip][v, u] = map_coordinates(share, cells, order=1, mode="nearest")
    return out
