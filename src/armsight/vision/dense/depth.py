"""From disparity to depth, with what matching and calibration leave uncertain.

sigma_z^2 = (z^2 / (f b) sigma_d)^2 + what the rig's covariance does to the depth. The second is smooth over image and
depth: it is worked out at a few places, by triangulating the same pixels with rigs that are off by one standard
deviation along each principal axis of the covariance, and interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from armsight.data import Array, Record
from armsight.vision.dense.method import Disparity
from armsight.vision.rectify import Rectification
from armsight.vision.triangulate import midpoints

#: Places along rows, columns and inverse disparity at which the calibration's share is worked out.
_COLUMNS, _ROWS, _DEPTHS = 7, 5, 4


@dataclass(frozen=True, eq=False)
class Depth(Record):
    """Depths of a left image in standard form.

    Attributes:
        depth_m: (H, W) along the camera's axis; NaN where the camera sees nothing, or infinitely far.
        sigma_m: (H, W) standard deviation where it was measured; NaN elsewhere.
        calibration_m: (H, W) the calibration's share of it, common to neighbours and to all shots.
    """

    depth_m: Array
    sigma_m: Array
    calibration_m: Array


def calibration_share(form: Rectification, uv: Array, disparity: Array) -> Array:
    """Return the standard deviation (N,) of depths, relative to them, that the rig's covariance brings.

    Args:
        form: how the images became standard form.
        uv: (N, 2) pixels of the left image in standard form.
        disparity: (N,) px.
    """
    rig = form.rig
    raw = form.to_raw(uv, "left"), form.to_raw(uv - np.column_stack([disparity, np.zeros(len(disparity))]), "right")
    axis = form.T_left_rectleft[:3, 2]
    z = midpoints(rig, *raw) @ axis
    values, vectors = np.linalg.eigh(rig.cov)
    variance = np.zeros(len(uv))
    for value, vector in zip(values, vectors.T, strict=True):
        if value > 0:
            variance += (midpoints(rig.perturbed(np.sqrt(value) * vector), *raw) @ axis - z) ** 2
    return np.asarray(np.sqrt(variance) / z)


def depth_of(form: Rectification, result: Disparity) -> Depth:
    """Return depths with their standard deviations."""
    z = np.where(form.seen("left"), form.depth(result.disparity), np.nan)
    measured = result.measured & np.isfinite(z)
    share = np.full(z.shape, np.nan)
    share[measured] = _interpolated(form, result.disparity, measured) * z[measured]
    per_px = z**2 / (form.focal_px * form.rig.baseline_m)
    return Depth(z, np.hypot(per_px * result.sigma_px, share), share)


def _interpolated(form: Rectification, disparity: NDArray[np.float32], measured: NDArray[np.bool_]) -> Array:
    """Return the calibration's relative share (N,) at the measured pixels."""
    v, u = np.nonzero(measured)
    inverse = 1 / np.maximum(disparity[measured].astype(np.float64), 1e-3)
    if not form.rig.cov.any() or not len(inverse):
        return np.zeros(len(inverse))
    height, width = measured.shape
    low, high = float(inverse.min()), float(inverse.max()) * (1 + 1e-9) + 1e-12
    axes = (np.linspace(0, height - 1, _ROWS), np.linspace(0, width - 1, _COLUMNS), np.linspace(low, high, _DEPTHS))
    rows, columns, inverses = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    share = calibration_share(form, np.column_stack([columns, rows]), 1 / inverses).reshape(_ROWS, _COLUMNS, _DEPTHS)
    whole = np.isfinite(share)
    share = np.where(whole, share, share[whole].max() if whole.any() else 0.0)  # corners that a camera does not see
    return np.asarray(RegularGridInterpolator(axes, share)(np.column_stack([v, u, inverse])))
