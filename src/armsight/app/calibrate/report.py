"""The report of a calibration: one HTML page with its assessment, and its figures as PNG files beside it.

In: a Calibration. Out: a folder. The page holds its figures itself, needs no network and runs no script. Everything is
rendered in memory first; then each file is written completely, the page last.

In order: the tables; the sections of the page, from the assessment to the parameters; the page. A section is a function of
the calibration and of its figures (name -> HTML image). Its caption explains what one should see, and what would be bad.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.app.calibrate.assessment import (
    BEYOND,
    SHARES,
    advice,
    assess,
    corner_variance_px2,
    graded_metrics,
    predicted_sigmas,
    target,
    target_points,
)
from armsight.app.calibrate.figures import (
    MOST_BARS,
    OUTSTANDING,
    STANDS_OUT,
    coverage_figure,
    pairs_figure,
    residuals_figure,
    target_figure,
    volume_figure,
)
from armsight.app.report.page import PAGE, bullets, html_page, picture, put_files, table, text, writable_folder
from armsight.app.report.plotting import drawing, png, require_matplotlib
from armsight.data import Array
from armsight.geometry.pose import exp_se3
from armsight.geometry.rotation import log_so3
from armsight.vision.calibrate.result import Calibration, HeldOutErrors
from armsight.vision.calibrate.weak import COVERAGE_GRID
from armsight.vision.rig import StereoRig

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STEP_RAD = 1e-6
_ROUNDING = 1e-12


def headline_table(calibration: Calibration) -> str:
    """Return the held-out metrics beside those of the fit, each with its meaning and its grade."""
    rows = [
        (
            text(row.name),
            f"<b>{text(row.heldout)}</b>",
            text(row.fit),
            f'<span class="grade {row.grade}">{row.grade}</span>' if row.grade else "your call",
            text(row.meaning),
        )
        for row in graded_metrics(calibration)
    ]
    fit = f"{calibration.reprojection_rms_px:.3g} px"
    meaning = "Error of the fitted model at the points it was fitted to. It does not predict errors in millimetres."
    if calibration.motion is not None:
        meaning += f" {MOTION_FITTED}"
    rows.append(("reprojection RMS", "–", fit, "", meaning))
    head = ("", f"held out, {calibration.heldout.folds} folds", "fit", "", "meaning")
    return table(head, rows, "headline")


#: Why the reprojection RMS may be far below the epipolar RMS of the same fit.
MOTION_FITTED = (
    "The reprojection follows the board, which moved between the two exposures of a pair; the epipolar RMS does not."
)


def models_table(calibration: Calibration) -> str:
    """Return the distortion models that were tried, with their held-out errors."""

    def row(name: str, h: HeldOutErrors) -> tuple[str, ...]:
        chosen = "<b>chosen</b>" if name == calibration.rig.left.model else ""
        values = (f"{h.epipolar_rms_px:.4f}", f"{1e3 * h.rigid_rms_m:.4f}", f"{100 * h.scale_error:+.3f}")
        return (text(name), *values, f"{h.normalised_rms:.2f}", chosen)

    head = ("model", "epipolar RMS, px", "rigid RMS, mm", "scale error, %", "residual / sigma", "")
    return table(head, [row(name, h) for name, h in calibration.models.items()], "numbers")


def _with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """Return a value to the digits its sigma allows, with the sigma; "given" where it was not estimated."""
    if not sigma > _ROUNDING * max(abs(value), 1.0):
        return f"{value:.6g}{unit} <i>given</i>"
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}{unit}"


def cameras_table(rig: StereoRig) -> str:
    """Return intrinsics and distortion of both cameras with their sigmas."""
    sigma, n_left = np.sqrt(np.diag(rig.cov)), rig.left.parameters.size
    cells: dict[str, list[str]] = {}
    for k, (name, value) in enumerate(
        zip(rig.parameter_names, np.r_[rig.left.parameters, rig.right.parameters], strict=False)
    ):
        label = name.split(".", 1)[1].replace("_px", ", px")
        cells.setdefault(label, ["–", "–"])[k >= n_left] = _with_sigma(float(value), float(sigma[k]))
    rows = [("image, px", *("{} x {}".format(*camera.image_size_px) for camera in rig.cameras))]
    rows.append(("distortion model", *(text(camera.model) for camera in rig.cameras)))
    return table(("", "left", "right"), [*rows, *((name, *both) for name, both in cells.items())], "numbers")


def pose_table(rig: StereoRig) -> str:
    """Return the pose of the right camera in the left one's frame, mm and degrees, with sigmas."""
    cov, T = rig.cov[-6:, -6:], rig.T_left_right
    rotation, J = log_so3(T[:3, :3]), np.empty((3, 6))
    for k, axis in enumerate(np.eye(6)):
        ends = [log_so3((T @ exp_se3(h * axis))[:3, :3]) for h in (_STEP_RAD, -_STEP_RAD)]
        J[:, k] = (ends[0] - ends[1]) / (2 * _STEP_RAD)
    cov_t = T[:3, :3] @ cov[:3, :3] @ T[:3, :3].T  # the tangent's translation is along the right camera's axes
    sigma_mm, sigma_deg = 1e3 * np.sqrt(np.diag(cov_t)), np.degrees(np.sqrt(np.diag(J @ cov @ J.T)))
    toward = T[:3, 3] / max(rig.baseline_m, 1e-12)
    rows = [("baseline, mm", _with_sigma(1e3 * rig.baseline_m, 1e3 * float(np.sqrt(toward @ cov_t @ toward))))]
    rows += [
        (f"{axis}, mm", _with_sigma(1e3 * value, s)) for axis, value, s in zip("XYZ", T[:3, 3], sigma_mm, strict=True)
    ]
    rows.append(("angle between the optical axes, degrees", f"{rig.convergence_deg:.3f}"))
    rows += [
        (f"rotation vector {axis}, degrees", _with_sigma(float(np.degrees(value)), s))
        for axis, value, s in zip("XYZ", rotation, sigma_deg, strict=True)
    ]
    return table(("T_left_right", "value ± one sigma"), rows, "numbers")


def sigma_table(calibration: Calibration) -> str:
    """Return the predicted sigmas at the nearest, the middle and the farthest target."""
    middle = target_points(calibration).mean(axis=1)
    order = np.argsort(middle[:, 2])
    chosen: Array = middle[order[[0, len(order) // 2, -1]]]
    depth, lateral = predicted_sigmas(calibration.rig, chosen, corner_variance_px2(calibration))
    rows, what = [], target(calibration)
    for k, name in enumerate(("nearest", "middle", "farthest")):
        sigmas = [f"{1e3 * s[k]:.2g}" if np.isfinite(s[k]) else "not seen by both" for s in (*depth, *lateral)]
        rows.append((f"{name} {what}, Z {1e3 * chosen[k, 2]:.0f} mm", *sigmas))
    head = ("sigma, mm", *(f"{kind}: {share}" for kind in ("depth", "lateral") for share in SHARES))
    return table(head, rows, "numbers")


def provenance_table(provenance: Mapping[str, Any]) -> str:
    """Return how a rig was made, as its file records it."""
    rows = [
        (text(key), text(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)))
        for key, value in provenance.items()
    ]
    return table(("", ""), rows, "provenance") if rows else "<p>Nothing is recorded.</p>"


Figures = Mapping[str, str]
Section = Callable[[Calibration, Figures], str]


def _figure(figures: Figures, name: str, see: str, bad: str, opening: str = "You should see") -> str:
    """Return a figure with its caption: what one should see, and what would be bad."""
    caption = f"<p><b>{opening}</b> {see}</p><p><b>Bad would be</b> {bad}</p>"
    return f"<figure>{figures[name]}<figcaption>{caption}</figcaption></figure>\n"


def result(calibration: Calibration, figures: Figures) -> str:
    """Return the assessment, the held-out metrics, what is weak, and which pairs were rejected or used in part."""
    found = assess(calibration)
    parts = [
        f'<div class="assessment {found.grade}"><p class="headline">{text(found.headline)}</p>'
        f"<p>{text(found.meaning)}</p></div>\n"
    ]
    parts.append(headline_table(calibration))
    parts.append(
        "<p>Rely on the held-out column: a fit adapts to the pairs it is made from, the more so the fewer they are. The "
        "held-out metrics come from pairs that were not fitted, measured as later measurements are.</p>\n"
    )
    parts.append("<h3>Weak points, and what to do</h3>\n")
    weak = advice(calibration)
    parts.append(bullets(weak) if weak else "<p>None.</p>\n")
    used, pairs_found = len(calibration.pairs), calibration.pairs_found
    parts.append("<h3>Pairs that were not used</h3>\n")
    if calibration.rejected:
        reasons: dict[str, list[str]] = {}
        for pair in calibration.rejected:
            reasons.setdefault(pair.reason, []).append(pair.pair)
        rows = [(", ".join(text(name) for name in names), text(reason)) for reason, names in reasons.items()]
        parts.append(f"<p>{used} of {pairs_found} pairs were used.</p>\n" + table(("pair", "reason"), rows, "prose"))
    else:
        parts.append(f"<p>None: all {used} pairs were used.</p>\n")
    if calibration.notes:
        parts.append("<h3>Corrected, or used in part</h3>\n" + bullets(calibration.notes))
    return "".join(parts)


def coverage(calibration: Calibration, figures: Figures) -> str:
    """Return the coverage maps."""
    what = target(calibration)
    see = (
        f"points of the {what} (dots) in nearly all cells of both images, up to their corners. Colour: their number. The "
        f"percentages are counted in {COVERAGE_GRID} x {COVERAGE_GRID} cells, larger than those of the map."
    )
    bad = (
        "hatched cells where you want to measure: no point was seen there, so the lens model is extrapolated. Take more "
        f"pairs with the {what} there. (The dark rim around the image of a fisheye lens stays empty.)"
    )
    return _figure(figures, "coverage", see, bad)


def residuals(calibration: Calibration, figures: Figures) -> str:
    """Return the residual vectors."""
    sigma = np.sqrt(corner_variance_px2(calibration))
    see = (
        "above, short arrows in all directions, alike in both images, as random noise is: one sigma of a point along u or "
        f"v is {sigma[0]:.3g} px left and {sigma[1]:.3g} px right. Below, tiny arrows without a pattern. Note the scale "
        "over each panel."
    )
    bad = (
        "neighbours that point the same way, or a vortex or a star below: the lens differs from its model there, or the "
        f"{target(calibration)} from its drawing. Red arrows are more than {STANDS_OUT:g} times their own uncertainty. "
        "Longer arrows in one image than in the other: that camera is out of focus, moves, or has too little light."
    )
    return _figure(figures, "residuals", see, bad)


def pairs(calibration: Calibration, figures: Figures) -> str:
    """Return the held-out errors by pair."""
    see = "bars of similar length, all blue."
    shown = len(calibration.errors.pair)
    if shown > MOST_BARS:
        see += f" Of {shown} pairs the {MOST_BARS} with the largest rigid error are shown."
    see += " Pairs that were not used are named below them." if calibration.rejected else ""
    bad = (
        f"orange bars, more than {OUTSTANDING:g} times the median. A pair that stands out in the epipolar error moved "
        "between the two images or was taken at two moments; one that stands out in the rigid error only was blurred, "
        "far away or bent. Look at its images and take it again. Each pair was measured with a rig fitted without it."
    )
    return _figure(figures, "pairs", see, bad)


def volume(calibration: Calibration, figures: Figures) -> str:
    """Return the predicted sigma over the volume, and where the board was."""
    what = target(calibration)
    see = (
        f"one sigma of a triangulated point, in a slice through the middle of the {what}'s positions (dots): of 100 "
        "measurements of a point, 95 have an error of less than two sigma. Depth is along the line of sight, and its sigma "
        "grows with the square of the distance; lateral is across it, in the worse direction. The axes are the left "
        "camera's."
    )
    bad = (
        "a calibration's share above that of the pixel noise where you measure: more and better pairs help there, while "
        "a longer baseline, more pixels or nearer cameras help against the pixel noise. Beyond the dots the calibration "
        "is extrapolated."
    )
    known = (
        "<p>The calibration's share is common to all points and all shots: averaging does not reduce it, but it largely "
        "cancels between positions close to each other. The noise is that of a typical point of these images. The slice "
        f"extends {100 * BEYOND:.0f}% beyond the nearest and the farthest point. An error in the size given for the {what} "
        "adds to these errors.</p>\n"
    )
    if not calibration.rig.cov.any():
        known += "<p><b>The uncertainty of this calibration is unknown; its share is missing here.</b></p>\n"
    return _figure(figures, "volume", see, bad, "It shows") + sigma_table(calibration) + known


def target_shape(calibration: Calibration, figures: Figures) -> str:
    """Return the deviation of the target from its drawing, where it was estimated."""
    if "target" not in figures:
        return ""
    see = (
        f"the deviation of the target from its drawing, {1e3 * calibration.deviation_m:.2g} mm RMS: a few hundredths of a "
        "millimetre for a target on glass or aluminium, tenths for paper on card. It was estimated together with the "
        "cameras, so that it does not distort their parameters."
    )
    bad = (
        "a millimetre or more: a loose or bowed sheet, which also bends from pair to pair. Glue it to something stiff. "
        "(The cameras cannot measure the size of the whole target; it is the one you gave.)"
    )
    return _figure(figures, "target", see, bad, "It shows")


def numbers(calibration: Calibration, figures: Figures) -> str:
    """Return the parameters with their sigmas and the distortion models tried."""
    rig = calibration.rig
    parts = [
        cameras_table(rig),
        pose_table(rig),
        "<p>± is one sigma. T_left_right is the pose of the right camera in the left camera's frame: X right, Y down, Z "
        "forward. Parameters are correlated, so a single sigma may be large while a measured point is well known; the "
        f"rig file holds the whole covariance. Noise of a point beyond its detection's own: {rig.sigma_px:.3g} px.</p>\n",
    ]
    if calibration.models:
        parts.append("<h3>Distortion models tried</h3>\n" + models_table(calibration))
        parts.append(
            "<p>Evaluated on held-out pairs alone; of models that are about as good, the simplest is chosen.</p>\n"
        )
    return "".join(parts)


def provenance(calibration: Calibration, figures: Figures) -> str:
    """Return how the rig was made."""
    return provenance_table(calibration.rig.provenance)


#: Anchor -> title and text, in the page's order; a section without text is left out.
SECTIONS: dict[str, tuple[str, Section]] = {
    "result": ("Assessment", result),
    "coverage": ("Coverage of the images", coverage),
    "residuals": ("Residuals of the fit", residuals),
    "pairs": ("Held-out errors by pair", pairs),
    "volume": ("Predicted uncertainty of a measurement", volume),
    "target": ("Shape of the target", target_shape),
    "parameters": ("Parameters of the cameras", numbers),
    "provenance": ("Provenance", provenance),
}


#: Name -> the function that plots it (None where there is nothing to plot), and its description for who cannot see it.
FIGURES: dict[str, tuple[Callable[[Calibration], Figure | None], str]] = {
    "coverage": (coverage_figure, "Maps of both images: how many points were seen in which part"),
    "residuals": (residuals_figure, "Residual vectors over both images, every point and averaged by region"),
    "pairs": (pairs_figure, "Bars: held-out epipolar and rigid error of every pair"),
    "volume": (volume_figure, "Maps of the predicted depth and lateral sigma over a slice of the volume"),
    "target": (target_figure, "Map of the target's deviation from its drawing"),
}


#: Names of all files that a report may have.
REPORT_FILES = (PAGE, *(f"report-{name}.png" for name in FIGURES))


def write_report(calibration: Calibration, directory: str | Path) -> Path:
    """Write the report of a calibration.

    Args:
        calibration: what is reported on.
        directory: the folder; files of an earlier report in it are replaced, others stay.

    Returns:
        The page, report.html in the folder; every figure is beside it as report-NAME.png.

    Raises:
        InputError: matplotlib is missing, or the folder cannot be written to; then none of the report's files is new.
    """
    require_matplotlib()
    folder = writable_folder(directory, "no report")
    images: dict[str, bytes] = {}
    with drawing():
        for name, (draw, _) in FIGURES.items():
            figure = draw(calibration)
            if figure is not None:
                images[name] = png(figure)
    files = {f"report-{name}.png": data for name, data in images.items()}
    put_files(folder, {**files, PAGE: page(calibration, images).encode()})
    for name in FIGURES.keys() - images.keys():
        (folder / f"report-{name}.png").unlink(missing_ok=True)
    return folder / PAGE


def page(calibration: Calibration, images: dict[str, bytes]) -> str:
    """Return the page; ``images`` maps the names of figures to PNG data."""
    figures = {name: picture(data, FIGURES[name][1]) for name, data in images.items()}
    bodies = {anchor: make(calibration, figures) for anchor, (_, make) in SECTIONS.items()}
    shown = {anchor: SECTIONS[anchor][0] for anchor, body in bodies.items() if body}
    left, right = ("{} x {}".format(*camera.image_size_px) for camera in calibration.rig.cameras)
    size = f"{left} px" if left == right else f"{left} px left, {right} px right"
    used = f"{len(calibration.pairs)} of {calibration.pairs_found} pairs of images used"
    what = f"{calibration.body.name} · {used} · {size} · baseline {1e3 * calibration.rig.baseline_m:.1f} mm"
    sections = {anchor: (title, bodies[anchor]) for anchor, title in shown.items()}
    return html_page("armsight: calibration report", "Calibration of two cameras", what, sections)
