"""Assessment of a calibration: its predicted uncertainty in space, and its held-out metrics with a grade each.

The predicted sigma of a triangulated point is split into the shares of pixel noise and of calibration, as in a measurement
(:func:`predicted_sigmas`, :func:`volume_slice`). The grades are a guide for the reader; nothing is rejected by them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armsight.app.show.report import Grade
from armsight.data import Array, Record
from armsight.geometry.pose import transform
from armsight.vision.calibrate.result import Calibration, corner_variance_px2
from armsight.vision.calibrate.weak import printed_longer
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Shares of a predicted sigma, in the order of the first axis of the arrays.
SHARES = ("pixel noise", "calibration", "both together")
#: The slice extends beyond the targets by the first share of their distance, sideways by the second of their extent.
BEYOND, BESIDE = 0.15, 0.5
_DEEP, _WIDE, _RIM = 80, 120, 33  # points of the slice, and along each side of the field of view
_WIDEST_TANGENT = 3.0  # of half the field of view: the slice of a fisheye lens would be infinitely wide otherwise
#: Relative to the distance: a point that triangulates elsewhere lies outside the valid range of the lens model.
_ROUND_TRIP = 1e-6


@dataclass(frozen=True, eq=False)
class Slice(Record):
    """Predicted sigmas over a plane through the cameras and the positions of the targets."""

    axis: int  #: 0 if the plane's sideways coordinate is X of the left camera, 1 if it is Y
    sideways_m: Array  #: (W,) coordinates along that axis, m
    depth_m: Array  #: (D,) Z of the left camera, m
    seen: Array  #: (D, W) whether both cameras see the point
    sigma_depth_m: Array  #: (3, D, W) one sigma along the line of sight, m, by SHARES; NaN where not seen
    sigma_lateral_m: Array  #: (3, D, W) one sigma across the line of sight, in the worse direction, m


def predicted_sigmas(rig: StereoRig, p_left: Array, variance_px2: Array) -> tuple[Array, Array]:
    """Return one sigma of triangulated points along the line of sight and, at worst, across it, (3, N) m, by SHARES.

    ``p_left``: (N, 3) points, m, left camera's frame. ``variance_px2``: (2,) of a detection left and right, px^2. NaN
    where a point is not in both images.
    """
    T, size = rig.T_left_right, np.array([camera.image_size_px for camera in rig.cameras])
    p_right = (p_left - T[:3, 3]) @ T[:3, :3]
    uv = np.stack([camera.project(p) for camera, p in zip(rig.cameras, (p_left, p_right), strict=True)], axis=1)
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(((uv > -0.5) & (uv < size - 0.5)).all(axis=(1, 2)))
    cov_uv = np.broadcast_to(variance_px2[:, None, None] * np.eye(2), (len(rows), 2, 2, 2))
    p, noise, by_rig = optimal_points(rig, uv[rows], cov_uv)
    with np.errstate(invalid="ignore"):
        back = np.linalg.norm(p - p_left[rows], axis=1) < _ROUND_TRIP * np.linalg.norm(p_left[rows], axis=1)
    calibration = by_rig @ rig.cov @ by_rig.transpose(0, 2, 1)
    sight = p[back] - T[:3, 3] / 2
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    flat = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    depth, lateral = np.full((2, len(SHARES), len(p_left)), np.nan)
    for k, cov in enumerate((noise[back], calibration[back], (noise + calibration)[back])):
        along, across = np.einsum("ni,nij,nj->n", sight, cov, sight), np.linalg.eigvalsh(flat @ cov @ flat)[:, -1]
        depth[k, rows[back]], lateral[k, rows[back]] = np.sqrt(np.maximum([along, across], 0))
    return depth, lateral


def target_points(calibration: Calibration) -> Array:
    """Return (S, M, 3) the points of the target in every pair used, m, left camera's frame."""
    return np.asarray(transform(calibration.solution.state.Ts_left_body[:, None], calibration.body.points))


def volume_slice(calibration: Calibration) -> Slice:
    """Predict the sigmas over the plane through the targets' middle and the left X axis (Y, one above the other)."""
    rig, targets = calibration.rig, target_points(calibration)
    axis, z, middle = int(np.argmax(np.abs(rig.T_left_right[:2, 3]))), targets[..., 2], targets.mean(axis=1)
    depth = np.linspace((1 - BEYOND) * max(z.min(), 1e-3 * z.max()), (1 + BEYOND) * z.max(), _DEEP)
    slope = float(np.median(middle[:, 1 - axis] / middle[:, 2]))
    u, v = (np.linspace(-0.5, side - 0.5, _RIM) for side in rig.left.image_size_px)
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    rays = rig.left.unproject(np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]]))
    rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0)]
    tangent = rays[:, axis] / rays[:, 2] if len(rays) else np.array([-1.0, 1.0])
    low, high = np.clip([tangent.min(), tangent.max()], -_WIDEST_TANGENT, _WIDEST_TANGENT)
    across = targets[..., axis]
    margin = BESIDE * float(np.ptp(across))
    ends = max(depth[-1] * low, across.min() - margin), min(depth[-1] * high, across.max() + margin)
    sideways, p = np.linspace(*ends, _WIDE), np.empty((_DEEP, _WIDE, 3))
    p[..., axis], p[..., 1 - axis], p[..., 2] = sideways, (slope * depth)[:, None], depth[:, None]
    sigmas = predicted_sigmas(rig, p.reshape(-1, 3), corner_variance_px2(calibration))
    along, lateral = np.reshape(sigmas, (2, len(SHARES), _DEEP, _WIDE))
    return Slice(axis, sideways, depth, np.isfinite(along[0]), along, lateral)


#: A metric is good up to the first limit, fair up to the second, px (sharp corners: 0.05 to 0.3); in proportion where
#: images are larger than LARGE_PX.
EPIPOLAR_PX, LARGE_PX = (0.3, 1.0), 1280
#: Held-out over fitted epipolar RMS: the degree of overfitting.
OVERFIT = (1.25, math.inf)  # beyond the first the sigmas are larger, which is no reason to distrust them
#: Relative error of size, either sign.
SCALE = (0.001, 0.005)
#: Residual over predicted sigma, or its inverse: 1 means that the predicted sigma is right.
HONESTY = (1.25, math.inf)
#: A target or body that differs from its drawing by less was not estimated, m.
HELD_M = 1e-8


@dataclass(frozen=True)
class GradedMetric:
    """One metric of a calibration."""

    name: str
    heldout: str  #: its value on held-out pairs, with its unit
    fit: str  #: its value in the fit, or a dash
    meaning: str  #: what it means, a sentence or two
    grade: Grade | None = None  #: how good it is; None where that depends on the use of the rig
    advice: str = ""  #: what to do where it is not good; may be empty


def target(calibration: Calibration) -> str:
    """Return what the cameras were shown: body or target."""
    return "body" if calibration.drawing is None else "target"


def distance_m(calibration: Calibration) -> float:
    """Return the median distance of the target from the left camera, m."""
    return float(np.median(np.linalg.norm(target_points(calibration).mean(axis=1), axis=1)))


def _grade(value: float, limits: tuple[float, float]) -> Grade:
    return "good" if value <= limits[0] else "fair" if value <= limits[1] else "poor"


def graded_metrics(calibration: Calibration) -> tuple[GradedMetric, ...]:
    """Return the held-out metrics of a calibration with their grades, the most important first."""
    c, h, fit, before = calibration, calibration.held_out, calibration.epipolar_rms_px, calibration.solution.sigma_px
    distance, what, deviation_mm = distance_m(c), target(c), 1e3 * c.deviation_m
    large = max(1.0, max(max(camera.image_size_px) for camera in c.rig.cameras) / LARGE_PX)
    epipolar = (large * EPIPOLAR_PX[0], large * EPIPOLAR_PX[1])
    overfit = h.epipolar_rms_px / fit if fit > 0 else 1.0
    honesty = max(h.normalised_rms, 1 / h.normalised_rms) if h.normalised_rms > 0 else math.nan
    rescaled = c.rig.sigma_px / before if before > 0 else 1.0
    by_print = f"It includes the {deviation_mm:.2g} mm by which the {what} itself differs from its drawing. "
    multiplied = f" All sigmas of this rig have been multiplied by {rescaled:.2f} to match."
    larger = (
        "held-out errors are larger than predicted: some pairs are worse than the rest, or the noise is not random; look "
        "at the errors by pair and at the residual vectors"
    )
    return (
        GradedMetric(
            "rigid RMS",
            f"{1e3 * h.rigid_rms_m:.3g} mm",
            "–",
            f"Distance of triangulated points from those of the exact {what}: the error of a measured shape, "
            f"{100 * h.rigid_rms_m / distance:.2g}% of the distance of {1e3 * distance:.0f} mm. "
            f"{'' if deviation_mm < 0.01 else by_print}Compare it with what your task needs.",
        ),
        GradedMetric(
            "scale error",
            f"{100 * h.scale_error:+.3f} %",
            "–",
            f"Relative error of measured lengths; good within {100 * SCALE[0]:g}%. An error of the size you gave for the "
            f"{what} itself does not show here.",
            _grade(abs(h.scale_error), SCALE),
            f"measured lengths are wrong: check the size given for the {what}, and show it tilted at several distances",
        ),
        GradedMetric(
            "epipolar RMS",
            f"{h.epipolar_rms_px:.3g} px",
            f"{fit:.3g} px" if math.isfinite(fit) else "unknown",
            f"Disagreement of the two cameras on a point; good up to {epipolar[0]:.2g} px for images of this size.",
            _grade(h.epipolar_rms_px, epipolar),
            f"the two cameras disagree: hold the {what} still, take both images at the same moment, check that the pairs "
            "belong together and that both images are sharp",
        ),
        GradedMetric(
            "held-out over fit",
            f"{overfit:.2f}",
            "–",
            f"Epipolar RMS of held-out pairs over that of the fit; good up to {OVERFIT[0]:g}. Far above 1 means "
            "overfitting: the fit describes its own pairs better than others.",
            _grade(overfit, OVERFIT),
            "the fit describes its own pairs much better than others: take more pairs, and more different ones",
        ),
        GradedMetric(
            "residual over predicted sigma",
            f"{h.normalised_rms:.2f}",
            "–",
            f"1 means that the predicted uncertainty is right; good from {1 / HONESTY[0]:.2g} to {HONESTY[0]:g}. Below 1 "
            f"it was too large.{multiplied if abs(rescaled - 1) > 0.005 else ' '}",
            _grade(honesty, HONESTY),
            "" if h.normalised_rms < 1 else larger,
        ),
    )


def advice(calibration: Calibration) -> tuple[str, ...]:
    """Return what is weak and what to do about it: the calibration's own list, then metrics that are not good."""
    weak = [row for row in graded_metrics(calibration) if row.grade in ("fair", "poor") and row.advice]
    return (*calibration.weaknesses, *(f"{row.name} {row.heldout}: {row.advice}" for row in weak))


def assess(calibration: Calibration) -> tuple[tuple[Grade, str], str]:
    """Return a calibration's grade (poor if a metric is, fair if there is advice), its headline, and what that means."""
    h, rig, points = calibration.held_out, calibration.rig, len(advice(calibration))
    along = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3] / rig.baseline_m
    baseline_share = float(np.sqrt(along @ rig.cov[-6:-3, -6:-3] @ along)) / rig.baseline_m
    share = max(abs(h.scale_error), baseline_share, (printed_longer(calibration) or (0.0,))[0])
    grade: Grade = "fair" if points else "good"
    if any(row.grade == "poor" for row in graded_metrics(calibration)):
        grade = "poor"
    headline, then = {
        "poor": ("Do not rely on this calibration yet.", "Follow the advice below and calibrate again."),
        "fair": (
            f"Usable, with {'one weak point' if points == 1 else f'{points} weak points'}.",
            "What is weak, and what to do about it, is listed below.",
        ),
        "good": (
            "Good. No weak points found.",
            "Leave mount, focus and zoom of both cameras as they are: the calibration holds for them alone.",
        ),
    }[grade]
    return (
        (grade, headline),
        f"On held-out pairs, measured points deviate by {1e3 * h.rigid_rms_m:.2g} mm (RMS) from their true shape, at a "
        f"distance of about {1e3 * distance_m(calibration):.0f} mm; lengths, compared with those of the "
        f"{target(calibration)}, are right to {100 * share:.2g}%. {then}",
    )
