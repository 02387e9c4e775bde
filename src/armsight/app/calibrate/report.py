"""The result of a calibration as a Report: its table, its JSON, and a page with its assessment and its figures."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.app.calibrate import figures
from armsight.app.calibrate.assessment import (
    BEYOND,
    HELD_M,
    SHARES,
    advice,
    assess,
    graded_metrics,
    predicted_sigmas,
    target,
    target_points,
)
from armsight.app.show.messages import weak
from armsight.app.show.page import PAGE, bullets, folded, table, text
from armsight.app.show.plotting import Figure
from armsight.app.show.report import Block, Html, Plot, Report, Section, Text, figure_files
from armsight.app.show.table import TextTable, plain_text
from armsight.geometry.pose import left_jacobian
from armsight.geometry.rotation import log_so3
from armsight.vision.calibrate.result import Calibration, corner_variance_px2
from armsight.vision.calibrate.screen import merged_notes
from armsight.vision.calibrate.weak import COVERAGE_GRID, contradicted
from armsight.vision.rig import StereoRig

_ROUNDING = 1e-12
#: Lines of a kind that are printed, of rejected pairs, and shown, of notes; half, double: so many.
_LISTED = 8
#: Why the reprojection RMS may be far below the epipolar RMS of the same fit.
MOTION_FITTED = "The reprojection follows the board, which moved between the two exposures; the epipolar RMS does not."


def headline_table(calibration: Calibration) -> str:
    """Return the held-out metrics beside those of the fit, each with its meaning and its grade."""
    rows = list[tuple[str, ...]]()
    for row in graded_metrics(calibration):
        grade = f'<span class="grade {row.grade}">{row.grade}</span>' if row.grade else "your call"
        rows.append((text(row.name), f"<b>{text(row.heldout)}</b>", text(row.fit), grade, text(row.meaning)))
    meaning = "Error of the fitted model at the points it was fitted to. It does not predict errors in millimetres."
    meaning += "" if calibration.motion is None else f" {MOTION_FITTED}"
    rows.append(("reprojection RMS", "–", f"{calibration.reprojection_rms_px:.3g} px", "", meaning))
    return table(("", f"held out, {calibration.held_out.folds} folds", "fit", "", "meaning"), rows, "headline")


def models_table(calibration: Calibration) -> str:
    """Return the distortion models that were tried, with their held-out errors."""
    rows = []
    for name, h in calibration.models.items():
        values = (f"{h.epipolar_rms_px:.4f}", f"{1e3 * h.rigid_rms_m:.4f}", f"{100 * h.scale_error:+.3f}")
        chosen = "<b>chosen</b>" if name == calibration.rig.left.model else ""
        rows.append((text(name), *values, f"{h.normalised_rms:.2f}", chosen))
    head = ("model", "epipolar RMS, px", "rigid RMS, mm", "scale error, %", "residual / sigma", "")
    return table(head, rows, "numbers")


def _with_sigma(value: float, sigma: float) -> str:
    """Return a value to the digits its sigma allows, with the sigma; "given" where it was not estimated."""
    if not sigma > _ROUNDING * max(abs(value), 1.0):
        return f"{value:.6g} <i>given</i>"
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def cameras_table(rig: StereoRig) -> str:
    """Return intrinsics and distortion of both cameras with their sigmas."""
    sigma, n_left = np.sqrt(np.diag(rig.cov)), rig.left.parameters.size
    rows = {
        "image, px": ["{} x {}".format(*camera.image_size_px) for camera in rig.cameras],
        "distortion model": [text(camera.model) for camera in rig.cameras],
    }
    values = np.r_[rig.left.parameters, rig.right.parameters]
    for k, (name, value) in enumerate(zip(rig.parameter_names, values, strict=False)):
        label = name.split(".", 1)[1].replace("_px", ", px")
        rows.setdefault(label, ["–", "–"])[k >= n_left] = _with_sigma(float(value), float(sigma[k]))
    return table(("", "left", "right"), [(name, *both) for name, both in rows.items()], "numbers")


def pose_table(rig: StereoRig) -> str:
    """Return the pose of the right camera in the left one's frame, mm and degrees, with sigmas."""
    cov, T = rig.cov[-6:, -6:], rig.T_left_right
    cov_t = T[:3, :3] @ cov[:3, :3] @ T[:3, :3].T  # the tangent's translation is along the right camera's axes
    phi = log_so3(T[:3, :3])
    J = np.linalg.inv(left_jacobian(-phi))  # of the rotation vector, by a rotation on the right
    rotation = np.degrees(phi)
    sigma_mm, sigma_deg = 1e3 * np.sqrt(np.diag(cov_t)), np.degrees(np.sqrt(np.diag(J @ cov[3:, 3:] @ J.T)))
    rows = [
        ("baseline, mm", _with_sigma(1e3 * rig.baseline_m, 1e3 * rig.baseline_sigma_m)),
        *((f"{axis}, mm", _with_sigma(1e3 * T[k, 3], sigma_mm[k])) for k, axis in enumerate("XYZ")),
        ("angle between the optical axes, degrees", f"{rig.convergence_deg:.3f}"),
        *((f"rotation vector {axis}, degrees", _with_sigma(rotation[k], sigma_deg[k])) for k, axis in enumerate("XYZ")),
    ]
    return table(("T_left_right", "value ± one sigma"), rows, "numbers")


def sigma_table(calibration: Calibration) -> str:
    """Return the predicted sigmas at the nearest, the middle and the farthest target."""
    middle = target_points(calibration).mean(axis=1)
    chosen = middle[np.argsort(middle[:, 2])[[0, len(middle) // 2, -1]]]
    depth, lateral = predicted_sigmas(calibration.rig, chosen, corner_variance_px2(calibration))
    rows, what = [], target(calibration)
    for k, name in enumerate(("nearest", "middle", "farthest")):
        sigmas = [f"{1e3 * s[k]:.2g}" if np.isfinite(s[k]) else "not seen by both" for s in (*depth, *lateral)]
        rows.append((f"{name} {what}, Z {1e3 * chosen[k, 2]:.0f} mm", *sigmas))
    head = ("sigma, mm", *(f"{kind}: {share}" for kind in ("depth", "lateral") for share in SHARES))
    return table(head, rows, "numbers")


class Captioned(NamedTuple):
    """A figure of the page; its texts are templates of what :func:`_words` has."""

    title: str  #: of its section
    draw: Callable[[Calibration], Figure | None]  #: plots it, or returns None where there is nothing to plot
    description: str  #: for who cannot see it
    see: str  #: what it shows
    bad: str  #: what would be bad
    opening: str = "You should see"


FIGURES = {
    "coverage": Captioned(
        "Coverage of the images",
        figures.coverage_figure,
        "Maps of both images: how many points were seen in which part",
        "points of the {what} (dots) in nearly all cells of both images, up to their corners. Colour: their number. The "
        f"percentages are counted in {COVERAGE_GRID} x {COVERAGE_GRID} cells, larger than those of the map.",
        "hatched cells where you want to measure: no point was seen there, so the lens model is extrapolated. Take more "
        "pairs with the {what} there. (The dark rim around the image of a fisheye lens stays empty.)",
    ),
    "residuals": Captioned(
        "Residuals of the fit",
        figures.residuals_figure,
        "Residual vectors over both images, every point and averaged by region",
        "above, short arrows in all directions, alike in both images, as random noise is: one sigma of a point along u or "
        "v is {sigma[0]:.3g} px left and {sigma[1]:.3g} px right. Below, tiny arrows without a pattern. Note the scale "
        "over each panel.",
        "neighbours that point the same way, or a vortex or a star below: the lens differs from its model there, or the "
        f"{{what}} from its drawing. Red arrows are more than {figures.STANDS_OUT:g} times their own uncertainty. "
        "Longer arrows in one image than in the other: that camera is out of focus, moves, or has too little light.",
    ),
    "pairs": Captioned(
        "Held-out errors by pair",
        figures.pairs_figure,
        "Bars: held-out epipolar and rigid error of every pair",
        "bars of similar length, all blue.{few}",
        f"orange bars, more than {figures.OUTSTANDING:g} times the median. A pair that stands out in the epipolar error "
        "moved between the two images or was taken at two moments; one that stands out in the rigid error only was "
        "blurred, far away or bent. Look at its images and take it again. Each pair was measured with a rig fitted "
        "without it.",
    ),
    "volume": Captioned(
        "Predicted uncertainty of a measurement",
        figures.volume_figure,
        "Maps of the predicted depth and lateral sigma over a slice of the volume",
        "one sigma of a triangulated point, in a slice through the middle of the {what}'s positions (dots): of 100 "
        "measurements of a point, 95 have an error of less than two sigma. Depth is along the line of sight, and its sigma "
        "grows with the square of the distance; lateral is across it, in the worse direction. The axes are the left "
        "camera's.",
        "a calibration's share above that of the pixel noise where you measure: more and better pairs help there, while "
        "a longer baseline, more pixels or nearer cameras help against the pixel noise. Beyond the dots the calibration "
        "is extrapolated.",
        "It shows",
    ),
    "target": Captioned(
        "Shape of the target",
        figures.target_figure,
        "Map of the target's deviation from its drawing",
        "the deviation of the target from its drawing, {deviation_mm:.2g} mm RMS: a few hundredths of a "
        "millimetre for a target on glass or aluminium, tenths for paper on card. It was estimated together with the "
        "cameras, so that it does not distort their parameters.",
        "a millimetre or more: a loose or bowed sheet, which also bends from pair to pair. Glue it to something stiff. "
        "(The cameras cannot measure the size of the whole target; it is the one you gave.)",
        "It shows",
    ),
}


def _words(calibration: Calibration) -> dict[str, object]:
    pairs = len(calibration.errors.pair)
    most, few = figures.MOST_BARS, " The {} with the largest rigid error are shown."
    return {
        "what": target(calibration),
        "sigma": np.sqrt(corner_variance_px2(calibration)),
        "deviation_mm": 1e3 * calibration.deviation_m,
        "few": few.format(most) if pairs > most else "",
    }


def _rejected(calibration: Calibration) -> dict[str, list[str]]:
    """Return the pairs of each reason for which some were not used."""
    reasons: dict[str, list[str]] = {}
    for pair in calibration.rejected:
        reasons.setdefault(pair.reason, []).append(pair.pair)
    return reasons


def _result(calibration: Calibration) -> str:
    used = len(calibration.pairs)
    weak_points = bullets(advice(calibration)) or "<p>None.</p>\n"
    rejected = f"<p>None: all {used} pairs were used.</p>\n"
    if calibration.rejected:
        rows = [(", ".join(map(text, pairs)), text(reason)) for reason, pairs in _rejected(calibration).items()]
        rejected = f"<p>{used} of {calibration.pairs_found} were used.</p>\n{table(('pair', 'reason'), rows, 'prose')}"
    notes = bullets(calibration.notes)
    if len(calibration.notes) > _LISTED:
        notes = bullets(merged_notes(calibration.notes)) + folded(f"all {len(calibration.notes)}", notes)
    return (
        headline_table(calibration)
        + "<p>Rely on the held-out column: a fit adapts to the pairs it is made from, the more so the fewer they are. The "
        "held-out metrics come from pairs that were not fitted, measured as later measurements are.</p>\n"
        f"<h3>Weak points, and what to do</h3>\n{weak_points}"
        f"<h3>Pairs that were not used</h3>\n{rejected}"
        + (f"<h3>Corrected, or used in part</h3>\n{notes}" if notes else "")
    )


def _volume(calibration: Calibration) -> str:
    unknown = "<p><b>The uncertainty of this calibration is unknown; its share is missing here.</b></p>\n"
    return (
        f"{sigma_table(calibration)}<p>The calibration's share is common to all points and all shots: averaging does not "
        "reduce it, but it largely cancels between positions close to each other. The noise is that of a typical point of "
        f"these images. The slice extends {100 * BEYOND:.0f}% beyond the nearest and the farthest point. An error in the "
        f"size given for the {target(calibration)} adds to these errors.</p>\n"
        f"{'' if calibration.rig.cov.any() else unknown}"
    )


def _parameters(calibration: Calibration) -> str:
    rig = calibration.rig
    tried = (
        f"<h3>Distortion models tried</h3>\n{models_table(calibration)}<p>Evaluated on held-out pairs alone; of models "
        "that are about as good, the simplest is chosen.</p>\n"
    )
    return (
        f"{cameras_table(rig)}{pose_table(rig)}<p>± is one sigma. T_left_right is the pose of the right camera in the left "
        "camera's frame: X right, Y down, Z forward. Parameters are correlated, so a single sigma may be large while a "
        "measured point is well known; the rig file holds the whole covariance. Noise of a point beyond its detection's "
        f"own: {rig.sigma_px:.3g} px.</p>\n{tried if calibration.models else ''}"
    )


def _provenance(rig: StereoRig) -> str:
    shown = {key: round(value, 6) if isinstance(value, float) else value for key, value in rig.provenance.items()}
    texts = {k: v if isinstance(v, str) else json.dumps(v, ensure_ascii=False, default=str) for k, v in shown.items()}
    rows = [(text(key), text(value)) for key, value in texts.items()]
    return table(("", ""), rows, "provenance") if rows else "<p>Nothing is recorded.</p>"


def _printed(calibration: Calibration, output: Path, board_file: Path | None, page: Path | None) -> str:
    c, h, poor, rejected = calibration, calibration.held_out, _poor(calibration), _rejected(calibration)
    rows = (
        ("epipolar RMS", f"{h.epipolar_rms_px:.3f} px"),
        ("rigid RMS (shape of the target)", f"{1e3 * h.rigid_rms_m:.3f} mm"),
        ("scale error", f"{100 * h.scale_error:+.3f} %"),
        ("residual over predicted sigma", f"{h.normalised_rms:.2f}"),
    )
    title = f"Held-out errors: {h.folds} folds, each measured with the fit to the others"
    use = "" if contradicted(c) else f"; to measure it: armsight measure {output} --target {board_file}"
    fit_px = f"{c.epipolar_rms_px:.3f} px" if np.isfinite(c.epipolar_rms_px) else "unknown"
    fitted = "" if c.motion is None else f" ({MOTION_FITTED[0].lower()}{MOTION_FITTED[1:].rstrip('.')})"
    held, rms_mm = c.deviation_m < HELD_M, 1e3 * c.deviation_m
    deviation = "" if held else f"; the body differs from its drawing by {rms_mm:.3f} mm RMS"
    lines = [
        plain_text(TextTable(title, ("", ""), rows)),
        f"fit: epipolar {fit_px}, reprojection {c.reprojection_rms_px:.3f} px RMS{fitted}; "
        f"{len(c.pairs)} of {c.pairs_found} pairs; distortion {c.rig.left.model}; corner noise {c.rig.sigma_px:.3f} px",
        f"baseline {1e3 * c.rig.baseline_m:.2f} mm, convergence {c.rig.convergence_deg:.2f} deg{deviation}",
        *([] if c.disc_radius_m is None else [f"radius of the board's discs: {1e3 * c.disc_radius_m:.3f} mm"]),
    ]
    for reason, (first, *more) in itertools.islice(rejected.items(), _LISTED):
        lines.append(
            f"rejected {f'{1 + len(more)} pairs {first} to {more[-1]}' if more else f'pair {first}'}: {reason}"
        )
    lines += [f"and {len(rejected) - _LISTED} more reasons: --json, --report"] if len(rejected) > _LISTED else []
    lines += [f"note: {note}" for note in merged_notes(c.notes)]
    lines += map(weak, [*c.weaknesses, *([f"do not rely on this calibration yet: {', '.join(poor)}"] if poor else [])])
    lines.append(f"rig written to {output}" + ("" if page is None else f", report to {page}"))
    lines += [] if board_file is None else [f"board as found written to {board_file}{use}"]
    return "\n".join(lines)


def _poor(calibration: Calibration) -> list[str]:
    return [f"{row.name} {row.heldout}" for row in graded_metrics(calibration) if row.grade == "poor"]


#: Names of all files that a report may have.
REPORT_FILES = (PAGE, *figure_files("report", FIGURES))


def calibration_report(
    calibration: Calibration, output: Path, board_file: Path | None, report: Path | None, seconds: float
) -> Report:
    """Return what a calibration says."""
    c, words, page = calibration, _words(calibration), None if report is None else report / PAGE
    graded, meaning = assess(c)
    left, right = ("{} x {}".format(*camera.image_size_px) for camera in c.rig.cameras)
    size = f"{left} px" if left == right else f"{left} px left, {right} px right"
    used = f"{len(c.pairs)} of {c.pairs_found} pairs of images used"
    sections: dict[str, Section] = {"result": ("Assessment", [Html(_result(c))])}
    for name, (title, draw, description, see, bad, opening) in FIGURES.items():
        caption = f"<p><b>{opening}</b> {see}</p><p><b>Bad would be</b> {bad}</p>".format(**words)
        shown: list[Block] = [Plot(name, partial(draw, c), caption, description)]
        sections[name] = title, [*shown, Html(_volume(c))] if name == "volume" else shown
    sections["parameters"] = "Parameters of the cameras", [Html(_parameters(c))]
    sections["provenance"] = "Provenance", [Html(_provenance(c.rig))]
    sections["printed"] = "", [Text(_printed(c, output, board_file, page))]
    values = {name: getattr(c, name) for name in ("pairs_found", "rejected", "notes", "weaknesses", "models")}
    values |= {name: getattr(c.rig, name) for name in ("baseline_m", "convergence_deg", "sigma_px")}
    values |= {"fit": {name: getattr(c, name) for name in ("epipolar_rms_px", "reprojection_rms_px")}}
    values |= {"pairs_used": len(c.pairs), "grade": graded[0], "poor": _poor(c), "heldout": c.held_out}
    values |= {"distortion_model": c.rig.left.model, "body_deviation_rms_m": c.deviation_m}
    values |= {"disc_radius_m": c.disc_radius_m, "rig": output, "board": board_file, "report": page, "seconds": seconds}
    values["shutters"] = None if c.rig.shutters is None else c.rig.shutters.to_json()
    what = f"{c.body.name} · {used} · {size} · baseline {1e3 * c.rig.baseline_m:.1f} mm"
    return Report("calibrate", "Calibration of two cameras", what, meaning, sections, values=values, assessed=graded)
