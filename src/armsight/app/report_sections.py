"""The sections of a calibration's report, in the order a person needs them: verdict, images, pairs, volume, numbers.

Each is a function of the calibration and of its figures (name -> HTML image); what it says beside a figure is what one
should see there and what would be bad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from armsight.app.calibrate.figures import MOST_BARS, OUTSTANDING, STANDS_OUT
from armsight.app.calibrate.assessment import advice, target, verdict
from armsight.app.report_tables import (
    bullets,
    cameras_table,
    headline_table,
    models_table,
    pose_table,
    provenance_table,
    sigma_table,
    table,
    text,
)
from armsight.app.report_volume import BEYOND, corner_variance_px2
from armsight.vision.calibrate.result import Calibration

Figures = Mapping[str, str]
Section = Callable[[Calibration, Figures], str]


def _figure(figures: Figures, name: str, see: str, bad: str, opening: str = "You should see") -> str:
    """Return a figure with its caption: what one should see, and what would be bad."""
    caption = f"<p><b>{opening}</b> {see}</p><p><b>Bad would be</b> {bad}</p>"
    return f"<figure>{figures[name]}<figcaption>{caption}</figcaption></figure>\n"


def result(calibration: Calibration, figures: Figures) -> str:
    """Return the verdict, the held-out figures, what is weak, what was rejected, what was mended."""
    grade, headline, meaning = verdict(calibration)
    parts = [f'<div class="verdict {grade}"><p class="headline">{text(headline)}</p><p>{text(meaning)}</p></div>\n']
    parts.append(headline_table(calibration))
    parts.append(
        "<p>Believe the held-out column: a fit adapts to the very pairs it is made from, and the more so the fewer they "
        "are; the held-out figures come from pairs that were kept from it, by the very steps of a later measurement.</p>\n"
    )
    parts.append("<h3>What is weak, and what to do</h3>\n")
    weak = advice(calibration)
    parts.append(bullets(weak) if weak else "<p>Nothing stands out.</p>\n")
    used, found = len(calibration.pairs), calibration.pairs_found
    parts.append("<h3>Pairs that were not used</h3>\n")
    if calibration.rejected:
        reasons: dict[str, list[str]] = {}
        for pair in calibration.rejected:
            reasons.setdefault(pair.reason, []).append(pair.pair)
        rows = [(", ".join(text(name) for name in names), text(reason)) for reason, names in reasons.items()]
        parts.append(f"<p>{used} of {found} pairs were used.</p>\n" + table(("pair", "why not"), rows, "words"))
    else:
        parts.append(f"<p>None: all {used} pairs were used.</p>\n")
    if calibration.notes:
        parts.append("<h3>Mended, or used in part</h3>\n" + bullets(calibration.notes))
    return "".join(parts)


def coverage(calibration: Calibration, figures: Figures) -> str:
    """Return the coverage maps."""
    what = target(calibration)
    see = (
        f"points of the {what} (dots) in nearly all cells of both images, right into their corners. Colour counts them."
    )
    bad = (
        "hatched cells where you want to measure: nothing was ever seen there, so the lens is only guessed at. Take more "
        f"pairs with the {what} there. (The dark rim around the picture of a fisheye stays empty.)"
    )
    return _figure(figures, "coverage", see, bad)


def residuals(calibration: Calibration, figures: Figures) -> str:
    """Return the residual vectors."""
    sigma = np.sqrt(corner_variance_px2(calibration))
    see = (
        "above, short arrows in all directions, alike in both images, as noise is: one sigma of a point along u or v is "
        f"taken to be {sigma[0]:.3g} px left and {sigma[1]:.3g} px right. Below, tiny arrows without order. Mind the scale "
        "over each panel."
    )
    bad = (
        "neighbours that point the same way, or a whirl or a star below: the lens differs from its model there, or the "
        f"{target(calibration)} from its drawing. Red arrows are more than {STANDS_OUT:g} times their own uncertainty. "
        "Longer arrows in one image than in the other: that camera is out of focus, moves or is badly lit."
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
        f"one sigma of a triangulated point, in a slice through the middle of where the {what} was (dots): of 100 "
        "measurements of a point, 95 are off by less than two sigma. Depth is along the line of sight, and its sigma grows "
        "with the square of the distance; lateral is across it, in the worse direction. The axes are the left camera's."
    )
    bad = (
        "a calibration's share above that of the pixel noise where you measure: more and better pairs help there, while "
        "a longer baseline, more pixels or nearer cameras help against the pixel noise. Beyond the dots the calibration "
        "is extrapolated."
    )
    known = (
        "<p>The calibration's share is common to all points and all shots: averaging does not lessen it, but it largely "
        "cancels between places close to each other. The noise is that of a typical point of these images. The slice "
        f"reaches {100 * BEYOND:.0f}% beyond the nearest and the farthest point. An error in the size given for the {what} "
        "comes on top.</p>\n"
    )
    if not calibration.rig.cov.any():
        known += "<p><b>The uncertainty of this calibration is unknown; its share is missing here.</b></p>\n"
    return _figure(figures, "volume", see, bad, "It shows") + sigma_table(calibration) + known


def board(calibration: Calibration, figures: Figures) -> str:
    """Return how the estimated board differs from its drawing, where it was estimated."""
    if "board" not in figures:
        return ""
    see = (
        f"how the board differs from its drawing, {1e3 * calibration.deviation_m:.2g} mm RMS: a few hundredths of a "
        "millimetre for a board on glass or aluminium, tenths for paper on card. It was estimated with the cameras, so "
        "that it does not spoil them."
    )
    bad = (
        "a millimetre or more: a loose or bowed sheet, which also bends from pair to pair. Glue it to something stiff. "
        "(The size of the whole board cannot be seen by the cameras; it is the one you gave.)"
    )
    return _figure(figures, "board", see, bad, "It shows")


def numbers(calibration: Calibration, figures: Figures) -> str:
    """Return the parameters with their sigmas and the distortion models tried."""
    rig = calibration.rig
    parts = [
        cameras_table(rig),
        pose_table(rig),
        "<p>± is one sigma. T_left_right is the pose of the right camera in the left camera's frame: X right, Y down, Z "
        "forward. Parameters vary together, so a single sigma may look large while what is measured is well known; the "
        f"rig file holds the whole covariance. Noise of a point beyond what the image tells: {rig.sigma_px:.3g} px.</p>\n",
    ]
    if calibration.models:
        parts.append("<h3>Distortion models tried</h3>\n" + models_table(calibration))
        parts.append(
            "<p>Judged on held-out pairs alone; of models that are about as good, the simplest is chosen.</p>\n"
        )
    return "".join(parts)


def provenance(calibration: Calibration, figures: Figures) -> str:
    """Return where the rig comes from."""
    return provenance_table(calibration.rig.provenance)


#: Anchor -> title and text, in the page's order; a section without text is left out.
SECTIONS: dict[str, tuple[str, Section]] = {
    "result": ("Is it good?", result),
    "coverage": ("What the cameras have seen", coverage),
    "residuals": ("Residuals of the fit", residuals),
    "pairs": ("Held-out errors by pair", pairs),
    "volume": ("What to expect of a measurement", volume),
    "board": ("The board itself", board),
    "parameters": ("The cameras in numbers", numbers),
    "provenance": ("Where it comes from", provenance),
}
