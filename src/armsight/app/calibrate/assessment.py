"""Is a calibration good? Its held-out figures judged one by one, and the verdict in plain words.

The limits are orientation for a reader, no gate: nothing is refused because of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armsight.app.report_volume import board_points
from armsight.data import Array
from armsight.errors import InputError
from armsight.vision.calibrate.result import Calibration
from armsight.vision.markers.board import open_board

Grade = Literal["good", "fair", "poor"]

#: Up to the first a figure is good, up to the second fair. Epipolar error: sharp corners of a still board give 0.05 to
#: 0.3 px; beyond 1 px something is wrong with the images, not with the noise. In proportion where the image's longer
#: side is more than that many pixels, for such images are rarely sharp to the pixel.
EPIPOLAR_PX, LARGE_PX = (0.3, 1.0), 1280
#: Held-out over fitted epipolar RMS: how much the fit has learned its own pairs by heart.
OVERFIT = (1.25, 2.0)
#: Relative error of size, either sign.
SCALE = (0.001, 0.005)
#: Residual over predicted sigma, or its inverse: 1 is honest.
HONESTY = (1.25, 2.0)
#: A board or body that differs from its drawing by less was held to it, m.
HELD_M = 1e-8


@dataclass(frozen=True)
class Judged:
    """One figure of the headline.

    Attributes:
        name: what it is called.
        heldout: its value on held-out pairs, with its unit.
        fit: its value in the fit, or a dash.
        meaning: what it says, in words.
        grade: how good it is; None where that depends on what the rig is for.
        advice: what to do about it where it is not good; empty where there is nothing to do.
    """

    name: str
    heldout: str
    fit: str
    meaning: str
    grade: Grade | None = None
    advice: str = ""


def board_drawing(calibration: Calibration) -> Array | None:
    """Return (M, 3) the drawing of the calibration board, m; None where the calibration is from a body of markers."""
    try:
        points = open_board(calibration.body.name).body.points
    except InputError:
        return None
    return points if points.shape == calibration.body.points.shape else None


def target(calibration: Calibration) -> str:
    """Return what the cameras were shown, in a word."""
    return "body" if board_drawing(calibration) is None else "board"


def distance_m(calibration: Calibration) -> float:
    """Return the median distance of the boards from the left camera, m."""
    return float(np.median(np.linalg.norm(board_points(calibration).mean(axis=1), axis=1)))


def _grade(value: float, limits: tuple[float, float]) -> Grade:
    """Grade a figure of which less is better; what is no number is poor."""
    if not math.isfinite(value):
        return "poor"
    return "good" if value <= limits[0] else "fair" if value <= limits[1] else "poor"


def judged(calibration: Calibration) -> tuple[Judged, ...]:
    """Judge the held-out figures of a calibration, the most telling first."""
    h, fit = calibration.heldout, calibration.epipolar_rms_px
    distance, what = distance_m(calibration), target(calibration)
    large = max(1.0, max(max(camera.image_size_px) for camera in calibration.rig.cameras) / LARGE_PX)
    epipolar = (large * EPIPOLAR_PX[0], large * EPIPOLAR_PX[1])
    overfit = h.epipolar_rms_px / fit if fit > 0 else 1.0
    honesty = max(h.normalised_rms, 1 / h.normalised_rms) if h.normalised_rms > 0 else math.inf
    rows = (
        Judged(
            "rigid RMS",
            f"{1e3 * h.rigid_rms_m:.3g} mm",
            "–",
            f"How far triangulated points lie from where the perfect {what} has them: the error of a measured "
            f"shape, {100 * h.rigid_rms_m / distance:.2g}% of the distance of {1e3 * distance:.0f} mm. "
            f"{_print(calibration)}Compare it with what your task needs.",
        ),
        Judged(
            "scale error",
            f"{100 * h.scale_error:+.3f} %",
            "–",
            f"Whether lengths come out too long or too short; good within {100 * SCALE[0]:g}%. An error of the size you "
            f"gave for the {what} itself does not show here.",
            _grade(abs(h.scale_error), SCALE),
            f"measured lengths are off: check the size given for the {what}, and show it tilted at several distances",
        ),
        Judged(
            "epipolar RMS",
            f"{h.epipolar_rms_px:.3g} px",
            f"{fit:.3g} px",
            f"Whether the two cameras agree on a point; good up to {epipolar[0]:.2g} px for images of this size.",
            _grade(h.epipolar_rms_px, epipolar),
            f"the two cameras disagree: hold the {what} still, take both images at the same moment, check that the pairs "
            "belong together and that both images are sharp",
        ),
        Judged(
            "held-out over fit",
            f"{overfit:.2f}",
            "–",
            f"Epipolar RMS of pairs left out over that of the fit; good up to {OVERFIT[0]:g}. Far above 1 the fit has "
            "learned its pairs by heart.",
            _grade(overfit, OVERFIT),
            "the fit knows its own pairs much better than others: take more pairs, and more different ones",
        ),
        Judged(
            "residual over predicted sigma",
            f"{h.normalised_rms:.2f}",
            "–",
            f"Whether the predicted uncertainty is honest: 1 is, good from {1 / HONESTY[0]:.2g} to {HONESTY[0]:g}; "
            f"below, it was too careful. {_rescaled(calibration)}",
            _grade(honesty, HONESTY),
            ""
            if h.normalised_rms < 1
            else "held-out errors are larger than the fit predicted: some pairs are worse than "
            "the rest, or the noise is not random; look at the errors by pair and at the residual vectors",
        ),
    )
    return rows


def _print(calibration: Calibration) -> str:
    """Say how much of the rigid error is the board's own."""
    deviation_mm = 1e3 * calibration.deviation_m
    if deviation_mm < 0.01:
        return ""
    return f"It includes the {deviation_mm:.2g} mm by which the {target(calibration)} itself differs from its drawing. "


def _rescaled(calibration: Calibration) -> str:
    """Say by how much the rig's sigmas were adjusted to the held-out errors."""
    before = calibration.solution.sigma_px
    factor = calibration.rig.sigma_px / before if before > 0 else 1.0
    return f"All sigmas of this rig have been multiplied by {factor:.2f} to match." if abs(factor - 1) > 0.005 else ""


def advice(calibration: Calibration) -> tuple[str, ...]:
    """Return what is weak and what to do about it: the calibration's own words, then figures that are not good."""
    return (
        *calibration.weaknesses,
        *(
            f"{row.name} {row.heldout}: {row.advice}"
            for row in judged(calibration)
            if row.grade in ("fair", "poor") and row.advice
        ),
    )


def _baseline_share(calibration: Calibration) -> float:
    """Return one standard deviation of the baseline as a share of it."""
    rig = calibration.rig
    along = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3] / rig.baseline_m
    return float(np.sqrt(along @ rig.cov[-6:-3, -6:-3] @ along)) / rig.baseline_m


def verdict(calibration: Calibration) -> tuple[Grade, str, str]:
    """Return the grade of a calibration, its headline, and what that means for the one who made it."""
    h = calibration.heldout
    grades = {row.grade for row in judged(calibration)}
    expect = (
        f"On pairs it was not fitted on, measured points lie {1e3 * h.rigid_rms_m:.2g} mm (RMS) off their true shape, at "
        f"a distance of about {1e3 * distance_m(calibration):.0f} mm, and lengths, compared with the "
        f"{target(calibration)}'s, are right to {100 * max(abs(h.scale_error), _baseline_share(calibration)):.2g}%."
    )
    if "poor" in grades:
        return "poor", "Do not rely on this calibration yet.", f"{expect} Do what is said below and calibrate again."
    count = len(advice(calibration))
    if count:
        points = "one weak point" if count == 1 else f"{count} weak points"
        return "fair", f"Usable, with {points}.", f"{expect} What is weak, and what to do about it, is said below."
    return (
        "good",
        "Good. Nothing stands out as weak.",
        f"{expect} Leave mount, focus and zoom of both cameras as they are: the calibration holds for them alone.",
    )
