"""What ``armsight body check`` prints: an assessment in, text and JSON out. Lengths in mm, angles in degrees."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from armsight.app.body.check import SEPARATED_SIGMAS, sigma_px
from armsight.app.body.finding import Assessment, Prediction, ambiguity_text
from armsight.vision.markers.body_layout import Layout
from armsight.vision.rig import StereoRig

#: More distances between discs than this are printed by the closest pairs only.
_DISTANCES = 15


def cameras_text(rig: StereoRig, path: str | None) -> str:
    """Say which cameras the numbers are for."""
    (width, height), f = rig.left.image_size_px, rig.left.intrinsics[0]
    name = "two perfect cameras" if path is None else path
    uncertain = "" if path is None or rig.cov.any() else ", its calibration taken as perfect"
    return (
        f"{name}, {width}x{height} px, f {f:.0f} px, {rig.baseline_m:.3g} m apart, "
        f"positions known to {sigma_px(rig):.2g} px{uncertain}"
    )


def _distances(layout: Layout) -> list[tuple[str, str, float]]:
    """Return all distances between discs, m, the shortest first."""
    if layout.discs is None:
        return []
    p, names = layout.discs.body.points, layout.discs.body.point_names
    i, j = np.triu_indices(len(p), 1)
    lengths = np.linalg.norm(p[j] - p[i], axis=1)
    return [(names[i[k]], names[j[k]], float(lengths[k])) for k in np.argsort(lengths, kind="stable")]


def _closest(distances: list[tuple[str, str, float]]) -> list[str]:
    """Say which distances between discs are closest to each other."""
    gaps = [(b[2] - a[2], a, b) for a, b in pairwise(distances)]
    return [
        f"{a[0]}-{a[1]} and {b[0]}-{b[1]} differ by {1e3 * gap:.2f} mm"
        for gap, a, b in sorted(gaps, key=lambda g: g[0])[:3]
    ]


def assessment_lines(path: str, layout: Layout, cameras: str, assessment: Assessment) -> list[str]:
    """Return the assessment as lines of text: mm, degrees, px."""
    count = {
        "disc": layout.disc_count,
        "tag": 0 if layout.tags is None else len(layout.tags.tags),
        "board": 0 if layout.boards is None else len(layout.boards.boards),
    }
    kinds = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in count.items() if n)
    size = np.ptp(layout.body.points, axis=0) * 1e3
    lines = [
        f"{path}: {layout.name}: {kinds}; {' x '.join(f'{s:.1f}' for s in size)} mm",
        f"assessment: {assessment.grade}",
    ]
    lines += [f"unique: {_unique(layout, assessment)}"]
    if distances := _distances(layout):
        if len(distances) <= _DISTANCES:
            lines.append("distances, mm: " + ", ".join(f"{a}-{b} {1e3 * d:.2f}" for a, b, d in distances))
        if len(distances) > 1:
            lines.append("closest: " + "; ".join(_closest(distances)))
    lines += ["", f"expected sigma: {cameras}; the body faces them", *_table(assessment), ""]
    grades = {"bad": "bad ", "weak": "weak", "note": "note"}
    for finding in sorted(assessment.findings, key=lambda f: list(grades).index(f.grade)):
        if finding.text:
            lines.append(f"{grades[finding.grade]}  {finding.text}")
        if finding.change:
            lines.append(f"      change: {finding.change}")
    return lines


def _unique(layout: Layout, assessment: Assessment) -> str:
    """Say whether the body can be identified, in one line."""
    if layout.coded:
        return "yes, where a tag or a board is in view"
    if any(f.grade == "bad" and f.kind == "ambiguous" for f in assessment.findings):
        return "no"
    unseen = all(np.isnan(one.cov).any() for one in assessment.predictions)
    if unseen or any(f.kind in ("view", "overlap") for f in assessment.findings):
        return "not assessed"
    if any(f.kind == "behind" for f in assessment.findings):
        return "yes, by distances and normals"
    return "yes, by distances"


def _table(assessment: Assessment) -> list[str]:
    """Return the expected sigma at each distance."""
    rows = [("distance", "across", "depth", "tilt", "about sight", "disc across")]
    for one in assessment.predictions:
        if np.isnan(one.cov).any():
            rows.append((f"{one.distance_m:g} m", "no pose", "", "", "", _pixels(one)))
            continue
        (across, depth), (tilt, roll) = one.position_mm, one.rotation_deg
        rows.append(
            (
                f"{one.distance_m:g} m",
                f"{across:.3f} mm",
                f"{depth:.3f} mm",
                f"{tilt:.4f} deg",
                f"{roll:.4f} deg",
                _pixels(one),
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  " + "  ".join(entry.rjust(width) for entry, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _pixels(one: Prediction) -> str:
    """Return the discs' diameters in the image."""
    low, high = one.disc_px
    if np.isnan(low):
        return ""
    return f"{low:.1f} px" if high - low < 0.05 else f"{low:.1f} to {high:.1f} px"


def assessment_json(path: str, layout: Layout, rig: StereoRig, cameras: str, assessment: Assessment) -> dict[str, Any]:
    """Return the assessment as JSON has it."""
    ambiguities = [
        {
            "seen": [layout.body.point_names[i] for i in one.symmetry.seen],
            "taken_for": [layout.body.point_names[i] for i in one.symmetry.taken_for],
            "description": ambiguity_text(one.symmetry, layout.body.point_names),
            "off_mm": 1e3 * one.symmetry.off_m,
            "from_behind": one.behind,
            "settled_by_normals": one.by_side,
            "separation_sigmas": [_number(sigmas) for sigmas in one.separation_sigmas],
            "distinguishable": not bool((one.separation_sigmas < SEPARATED_SIGMAS).any()),
        }
        for one in assessment.ambiguities
    ]
    return {
        "body": path,
        "name": layout.name,
        "assessment": assessment.grade,
        "cameras": cameras,
        "sigma_px": sigma_px(rig),
        "points": len(layout.body.points),
        "discs": layout.disc_count,
        "coded": layout.coded,
        "distances_mm": [{"from": a, "to": b, "mm": 1e3 * d} for a, b, d in _distances(layout)],
        "ambiguities": ambiguities,
        "expected": [_expected(one) for one in assessment.predictions],
        "findings": [
            {"grade": f.grade, "kind": f.kind, "text": f.text or None, "change": f.change or None}
            for f in assessment.findings
        ],
    }


def _expected(one: Prediction) -> dict[str, Any]:
    """Return the expected sigma at a distance as JSON."""
    (across, depth), (tilt, roll) = one.position_mm, one.rotation_deg
    return {
        "distance_m": one.distance_m,
        "sigma_across_mm": _number(across),
        "sigma_depth_mm": _number(depth),
        "sigma_tilt_deg": _number(tilt),
        "sigma_about_sight_deg": _number(roll),
        "disc_px": None if np.isnan(one.disc_px).any() else one.disc_px.tolist(),
    }


def _number(value: float) -> float | None:
    """Return a number, or None where it is none or infinite: JSON knows neither."""
    return float(value) if np.isfinite(value) else None
