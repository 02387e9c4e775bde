"""Assessment of a calibration: its predicted uncertainty in space, and its held-out metrics with a grade each.

In: a Calibration. Out, first: the predicted sigma of a triangulated point over the volume that both cameras see, split into
the shares of pixel noise and of calibration (:func:`predicted_sigmas`, :func:`volume_slice`); they are computed as in a
measurement, so they are what a measurement will claim. Second: metrics of the held-out errors with grades and advice
(:func:`graded_metrics`, :func:`advice`), and the grade of the whole (:func:`assess`). The limits of the grades are a guide
for the reader; nothing is rejected because of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import transform
from armsight.vision.calibrate.result import Calibration
from armsight.vision.markers.board import open_board
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Shares of a predicted sigma, in the order of the first axis of the arrays.
SHARES = ("pixel noise", "calibration", "both together")
#: The slice extends beyond the nearest and the farthest target by the first share of its distance, and to both sides by
#: the second share of the targets' extent, as far as both cameras see.
BEYOND, BESIDE = 0.15, 0.5
_DEEP, _WIDE = 80, 120
_WIDEST_TANGENT = 3.0  # of half the field of view: the slice of a fisheye lens would be infinitely wide otherwise
#: Relative to the distance: a point that triangulates elsewhere lies outside the valid range of the lens model.
_ROUND_TRIP = 1e-6
_LEAST_SIGMA_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Slice(Record):
    """Predicted sigmas over a plane through the cameras and the positions of the targets.

    Attributes:
        axis: 0 if the plane's sideways coordinate is X of the left camera, 1 if it is Y.
        sideways_m: (W,) coordinates along that axis, m.
        depth_m: (D,) Z of the left camera, m.
        seen: (D, W) whether both cameras see the point.
        sigma_depth_m: (3, D, W) one sigma along the line of sight, m, by SHARES; NaN where not seen.
        sigma_lateral_m: (3, D, W) one sigma across the line of sight, in the worse direction, m.
    """

    axis: int
    sideways_m: Array
    depth_m: Array
    seen: Array
    sigma_depth_m: Array
    sigma_lateral_m: Array


def corner_variance_px2(calibration: Calibration) -> Array:
    """Return (2,) the variance of a typical corner in the left and the right image, px^2: its own and the rig's share."""
    observations, base = calibration.observations, max(calibration.rig.sigma_px, _LEAST_SIGMA_PX) ** 2
    image = np.trace(observations.cov_uv, axis1=1, axis2=2) / 2
    sides = [image[observations.camera == side] for side in (0, 1)]
    return np.array([base + (float(np.median(values)) if len(values) else 0.0) for values in sides])


def predicted_sigmas(rig: StereoRig, p_left: Array, variance_px2: Array) -> tuple[Array, Array]:
    """Predict the uncertainty of triangulated points.

    Args:
        rig: the calibrated pair.
        p_left: (N, 3) points, m, left camera's frame.
        variance_px2: (2,) variance of a detection in the left and the right image, px^2.

    Returns:
        (3, N) one sigma along the line of sight from between the cameras, m, by SHARES; (3, N) across it, in the worse
        direction, m. NaN where a point is not in both images.
    """
    uv = np.stack([camera.project(p) for camera, p in zip(rig.cameras, _by_camera(rig, p_left), strict=True)], axis=1)
    size = np.array([camera.image_size_px for camera in rig.cameras])
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(((uv > -0.5) & (uv < size - 0.5)).all(axis=(1, 2)))
    cov_uv = np.broadcast_to(variance_px2[:, None, None] * np.eye(2), (len(rows), 2, 2, 2))
    p, noise, by_rig = optimal_points(rig, uv[rows], cov_uv)
    with np.errstate(invalid="ignore"):
        back = np.linalg.norm(p - p_left[rows], axis=1) < _ROUND_TRIP * np.linalg.norm(p_left[rows], axis=1)
    calibration = by_rig @ rig.cov @ by_rig.transpose(0, 2, 1)
    depth, lateral = np.full((2, len(SHARES), len(p_left)), np.nan)
    for k, cov in enumerate((noise, calibration, noise + calibration)):
        depth[k, rows[back]], lateral[k, rows[back]] = _along_and_across(rig, p[back], cov[back])
    return depth, lateral


def _by_camera(rig: StereoRig, p_left: Array) -> tuple[Array, Array]:
    """Return points (N, 3) of the left frame in both cameras' frames."""
    return p_left, (p_left - rig.T_left_right[:3, 3]) @ rig.T_left_right[:3, :3]


def _along_and_across(rig: StereoRig, p_left: Array, cov: Array) -> tuple[Array, Array]:
    """Split covariances (N, 3, 3) into sigma along the line of sight and the larger one across it, (N,) each."""
    sight = p_left - rig.T_left_right[:3, 3] / 2
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", sight, cov, sight)
    flat = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    across = np.linalg.eigvalsh(flat @ cov @ flat)[:, -1]
    return np.sqrt(np.maximum(along, 0)), np.sqrt(np.maximum(across, 0))


def target_points(calibration: Calibration) -> Array:
    """Return (S, M, 3) the points of the target in every pair used, m, left camera's frame."""
    Ts = calibration.solution.state.Ts_left_body
    return np.asarray(transform(Ts[:, None], calibration.body.points))


def volume_slice(calibration: Calibration) -> Slice:
    """Predict the sigmas over the plane through the targets' middle, from before the nearest to beyond the farthest.

    The plane contains the left camera's X axis, or its Y axis if the cameras are mounted one above the other.
    """
    rig, targets = calibration.rig, target_points(calibration)
    axis = int(np.argmax(np.abs(rig.T_left_right[:2, 3])))
    z = targets[..., 2]
    depth = np.linspace((1 - BEYOND) * max(z.min(), 1e-3 * z.max()), (1 + BEYOND) * z.max(), _DEEP)
    middle = targets.mean(axis=1)
    slope = float(np.median(middle[:, 1 - axis] / middle[:, 2]))
    low, high = _view(rig, axis)
    across = targets[..., axis]
    margin = BESIDE * float(np.ptp(across))
    sideways = np.linspace(
        max(depth[-1] * low, float(across.min()) - margin), min(depth[-1] * high, float(across.max()) + margin), _WIDE
    )
    p = np.empty((_DEEP, _WIDE, 3))
    p[..., axis], p[..., 1 - axis], p[..., 2] = sideways, (slope * depth)[:, None], depth[:, None]
    along, across = predicted_sigmas(rig, p.reshape(-1, 3), corner_variance_px2(calibration))
    shape = (len(SHARES), _DEEP, _WIDE)
    along, across = along.reshape(shape), across.reshape(shape)
    return Slice(axis, sideways, depth, np.isfinite(along[0]), along, across)


def _view(rig: StereoRig, axis: int) -> tuple[float, float]:
    """Return the limits of the left camera's field of view as tangents, along X (axis 0) or Y (axis 1)."""
    width, height = rig.left.image_size_px
    u, v = np.linspace(-0.5, width - 0.5, 33), np.linspace(-0.5, height - 0.5, 33)
    border = [np.stack([u, np.full(33, v[k])], 1) for k in (0, -1)] + [
        np.stack([np.full(33, u[k]), v], 1) for k in (0, -1)
    ]
    rays = rig.left.unproject(np.concatenate(border))
    rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0)]
    tangent = rays[:, axis] / rays[:, 2] if len(rays) else np.array([-1.0, 1.0])
    return max(float(tangent.min()), -_WIDEST_TANGENT), min(float(tangent.max()), _WIDEST_TANGENT)


Grade = Literal["good", "fair", "poor"]

#: A metric is good up to the first limit, and fair up to the second. Epipolar error: sharp corners of a still target give
#: 0.05 to 0.3 px; beyond 1 px something is wrong with the images, not with the noise. The limits grow in proportion where
#: the image's longer side has more than LARGE_PX pixels, as such images are rarely sharp to the pixel.
EPIPOLAR_PX, LARGE_PX = (0.3, 1.0), 1280
#: Held-out over fitted epipolar RMS: the degree of overfitting.
OVERFIT = (1.25, 2.0)
#: Relative error of size, either sign.
SCALE = (0.001, 0.005)
#: Residual over predicted sigma, or its inverse: 1 means that the predicted sigma is right.
HONESTY = (1.25, 2.0)
#: A target or body that differs from its drawing by less was not estimated, m.
HELD_M = 1e-8


@dataclass(frozen=True)
class GradedMetric:
    """One metric of a calibration.

    Attributes:
        name: its name.
        heldout: its value on held-out pairs, with its unit.
        fit: its value in the fit, or a dash.
        meaning: what it means, a sentence or two.
        grade: how good it is; None where that depends on the use of the rig.
        advice: what to do where it is not good; may be empty.
    """

    name: str
    heldout: str
    fit: str
    meaning: str
    grade: Grade | None = None
    advice: str = ""


@dataclass(frozen=True)
class CalibrationAssessment:
    """The grade of a calibration, its headline, and what that means for the user."""

    grade: Grade
    headline: str
    meaning: str


def target_drawing(calibration: Calibration) -> Array | None:
    """Return (M, 3) the drawing of the calibration target, m; None where the calibration is from a body of markers."""
    try:
        points = open_board(calibration.body.name).body.points
    except InputError:
        return None
    return points if points.shape == calibration.body.points.shape else None


def target(calibration: Calibration) -> str:
    """Return what the cameras were shown: body or target."""
    return "body" if target_drawing(calibration) is None else "target"


def distance_m(calibration: Calibration) -> float:
    """Return the median distance of the target from the left camera, m."""
    return float(np.median(np.linalg.norm(target_points(calibration).mean(axis=1), axis=1)))


def _grade(value: float, limits: tuple[float, float]) -> Grade:
    """Return the grade of a metric of which less is better; NaN is poor."""
    if not math.isfinite(value):
        return "poor"
    return "good" if value <= limits[0] else "fair" if value <= limits[1] else "poor"


def graded_metrics(calibration: Calibration) -> tuple[GradedMetric, ...]:
    """Return the held-out metrics of a calibration with their grades, the most important first."""
    h, fit = calibration.heldout, calibration.epipolar_rms_px
    distance, what = distance_m(calibration), target(calibration)
    large = max(1.0, max(max(camera.image_size_px) for camera in calibration.rig.cameras) / LARGE_PX)
    epipolar = (large * EPIPOLAR_PX[0], large * EPIPOLAR_PX[1])
    overfit = h.epipolar_rms_px / fit if fit > 0 else 1.0
    honesty = max(h.normalised_rms, 1 / h.normalised_rms) if h.normalised_rms > 0 else math.inf
    rows = (
        GradedMetric(
            "rigid RMS",
            f"{1e3 * h.rigid_rms_m:.3g} mm",
            "–",
            f"Distance of triangulated points from those of the exact {what}: the error of a measured shape, "
            f"{100 * h.rigid_rms_m / distance:.2g}% of the distance of {1e3 * distance:.0f} mm. "
            f"{_print(calibration)}Compare it with what your task needs.",
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
            f"it was too large. {_rescaled(calibration)}",
            _grade(honesty, HONESTY),
            ""
            if h.normalised_rms < 1
            else "held-out errors are larger than predicted: some pairs are worse than the rest, or the noise is not "
            "random; look at the errors by pair and at the residual vectors",
        ),
    )
    return rows


def _print(calibration: Calibration) -> str:
    """Return a sentence on the target's share of the rigid error; empty where it is negligible."""
    deviation_mm = 1e3 * calibration.deviation_m
    if deviation_mm < 0.01:
        return ""
    return f"It includes the {deviation_mm:.2g} mm by which the {target(calibration)} itself differs from its drawing. "


def _rescaled(calibration: Calibration) -> str:
    """Return a sentence on how the rig's sigmas were adjusted to the held-out errors; empty where they were not."""
    before = calibration.solution.sigma_px
    factor = calibration.rig.sigma_px / before if before > 0 else 1.0
    return f"All sigmas of this rig have been multiplied by {factor:.2f} to match." if abs(factor - 1) > 0.005 else ""


def advice(calibration: Calibration) -> tuple[str, ...]:
    """Return what is weak and what to do about it: the calibration's own list, then metrics that are not good."""
    return (
        *calibration.weaknesses,
        *(
            f"{row.name} {row.heldout}: {row.advice}"
            for row in graded_metrics(calibration)
            if row.grade in ("fair", "poor") and row.advice
        ),
    )


def _baseline_share(calibration: Calibration) -> float:
    """Return one standard deviation of the baseline as a share of it."""
    rig = calibration.rig
    along = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3] / rig.baseline_m
    return float(np.sqrt(along @ rig.cov[-6:-3, -6:-3] @ along)) / rig.baseline_m


def assess(calibration: Calibration) -> CalibrationAssessment:
    """Return the assessment of a calibration: poor if a metric is, fair if there is advice, else good."""
    h = calibration.heldout
    grades = {row.grade for row in graded_metrics(calibration)}
    expect = (
        f"On held-out pairs, measured points deviate by {1e3 * h.rigid_rms_m:.2g} mm (RMS) from their true shape, at a "
        f"distance of about {1e3 * distance_m(calibration):.0f} mm; lengths, compared with those of the "
        f"{target(calibration)}, are right to {100 * max(abs(h.scale_error), _baseline_share(calibration)):.2g}%."
    )
    if "poor" in grades:
        return CalibrationAssessment(
            "poor", "Do not rely on this calibration yet.", f"{expect} Follow the advice below and calibrate again."
        )
    count = len(advice(calibration))
    if count:
        points = "one weak point" if count == 1 else f"{count} weak points"
        return CalibrationAssessment(
            "fair", f"Usable, with {points}.", f"{expect} What is weak, and what to do about it, is listed below."
        )
    return CalibrationAssessment(
        "good",
        "Good. No weak points found.",
        f"{expect} Leave mount, focus and zoom of both cameras as they are: the calibration holds for them alone.",
    )
