"""What ``armsight body check`` says: an assessment in, a Report out. Lengths in mm, angles in degrees."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from armsight.app.body.check import Assessment, Prediction, ambiguity_text, sigma_px
from armsight.app.show.report import Block, Fact, Report
from armsight.app.show.table import TextTable
from armsight.vision.markers.targets import Composite
from armsight.vision.rig import StereoRig

#: More distances between discs than this are printed by the closest pairs only.
_DISTANCES = 15


def _cameras(rig: StereoRig, path: str | None) -> str:
    (width, height), f = rig.left.image_size_px, rig.left.intrinsics[0]
    name = "two perfect cameras" if path is None else path
    uncertain = "" if path is None or rig.cov.any() else ", its calibration taken as perfect"
    return (
        f"{name}, {width}x{height} px, f {f:.0f} px, {rig.baseline_m:.3g} m apart, "
        f"positions known to {sigma_px(rig):.2g} px{uncertain}"
    )


def _distances(layout: Composite) -> list[tuple[str, str, float]]:
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


def body_report(path: str, layout: Composite, rig: StereoRig, rig_path: str | None, assessment: Assessment) -> Report:
    """Return what an assessment says: mm, degrees, px; ``rig_path`` None: two perfect cameras."""
    count = {
        "disc": layout.disc_count,
        "tag": 0 if layout.tags is None else len(layout.tags.tags),
        "board": 0 if layout.boards is None else len(layout.boards.boards),
    }
    kinds = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in count.items() if n)
    size = np.ptp(layout.body.points, axis=0) * 1e3
    distances, cameras = _distances(layout), _cameras(rig, rig_path)
    listed = "distances, mm: " + ", ".join(f"{a}-{b} {1e3 * d:.2f}" for a, b, d in distances)
    values = {
        "body": path,
        "name": layout.name,
        "sigma_px": sigma_px(rig),
        "points": len(layout.body.points),
        "discs": layout.disc_count,
        "coded": bool(layout.parts),
        "ambiguities": _ambiguities(layout, assessment),
        "findings": [{**vars(f), "text": f.text or None, "change": f.change or None} for f in assessment.findings],
    }
    head = ("distance", "across", "depth", "tilt", "about sight", "disc across")
    blocks: list[Block] = [
        Fact(f"assessment: {assessment.grade}", {"assessment": assessment.grade}),
        Fact(f"unique: {_unique(layout, assessment)}"),
        Fact(
            listed if 0 < len(distances) <= _DISTANCES else "",
            {"distances_mm": [{"from": a, "to": b, "mm": 1e3 * d} for a, b, d in distances]},
        ),
        Fact("closest: " + "; ".join(_closest(distances)) if len(distances) > 1 else ""),
        Fact("", {"cameras": cameras, "expected": [_expected(one) for one in assessment.predictions]}),
        TextTable(f"expected sigma: {cameras}; the body faces them", head, tuple(map(_row, assessment.predictions))),
    ]
    grades = {"bad": "bad ", "weak": "weak", "note": "note"}
    for finding in sorted(assessment.findings, key=lambda f: list(grades).index(f.grade)):
        blocks.append(Fact(f"{grades[finding.grade]}  {finding.text}" if finding.text else ""))
        blocks.append(Fact(f"      change: {finding.change}" if finding.change else ""))
    headline = f"{path}: {layout.name}: {kinds}; {' x '.join(f'{s:.1f}' for s in size)} mm"
    return Report("body", "Assessment of a body", path, headline, {"result": ("Result", blocks)}, values=values)


def _unique(layout: Composite, assessment: Assessment) -> str:
    if layout.parts:
        return "yes, where a tag or a board is in view"
    if any(f.grade == "bad" and f.kind == "ambiguous" for f in assessment.findings):
        return "no"
    unseen = all(np.isnan(one.cov).any() for one in assessment.predictions)
    if unseen or any(f.kind in ("view", "overlap") for f in assessment.findings):
        return "not assessed"
    if any(f.kind == "behind" for f in assessment.findings):
        return "yes, by distances and normals"
    return "yes, by distances"


def _row(one: Prediction) -> tuple[str, ...]:
    (across, depth), (tilt, roll) = one.position_mm, one.rotation_deg
    known = (f"{across:.3f} mm", f"{depth:.3f} mm", f"{tilt:.4f} deg", f"{roll:.4f} deg")
    return f"{one.distance_m:g} m", *(("no pose", "", "", "") if np.isnan(one.cov).any() else known), _pixels(one)


def _pixels(one: Prediction) -> str:
    low, high = one.disc_px
    if np.isnan(low):
        return ""
    return f"{low:.1f} px" if high - low < 0.05 else f"{low:.1f} to {high:.1f} px"


def _ambiguities(layout: Composite, assessment: Assessment) -> list[dict[str, Any]]:
    return [
        {
            "seen": [layout.body.point_names[i] for i in one.symmetry.seen],
            "taken_for": [layout.body.point_names[i] for i in one.symmetry.taken_for],
            "description": ambiguity_text(one.symmetry, layout.body.point_names),
            "off_mm": 1e3 * one.symmetry.off_m,
            "from_behind": one.behind,
            "settled_by_normals": one.by_side,
            "separation_sigmas": one.separation_sigmas,
            "distinguishable": not len(one.unsettled),
        }
        for one in assessment.ambiguities
    ]


def _expected(one: Prediction) -> dict[str, Any]:
    (across, depth), (tilt, roll) = one.position_mm, one.rotation_deg
    return {
        "distance_m": one.distance_m,
        "sigma_across_mm": across,
        "sigma_depth_mm": depth,
        "sigma_tilt_deg": tilt,
        "sigma_about_sight_deg": roll,
        "disc_px": None if np.isnan(one.disc_px).any() else one.disc_px,
    }
