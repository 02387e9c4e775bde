"""Is a body good before it is built: which discs may be taken for which, how well it fixes a pose, what to change.

A layout and a rig go in, figures and findings in words come out; ``armsight body check`` prints them.
"""

from __future__ import annotations

import numpy as np

from armsight.app.body_faults import in_view, neighbours, pose_findings, sizes
from armsight.app.body_swaps import SEARCHED, ambiguities, find_swaps, seen_together, single_camera
from armsight.app.body.finding import (Finding, Grade, Outlook, Swap, Verdict)
from armsight.vision.discs.predict import pose_covariance, view
from armsight.vision.markers.body_layout import Layout
from armsight.vision.rig import StereoRig

#: Standard deviation of a disc's place in its image, px: what the fit reaches on a clean print.
IMAGE_SIGMA_PX = 0.02


def judge(layout: Layout, rig: StereoRig, distances_m: tuple[float, ...]) -> Verdict:
    """Judge a body by its drawing.

    Args:
        layout: the body.
        rig: the cameras that are to see it.
        distances_m: where it is to be used.
    """
    outlooks = tuple(outlook(layout, rig, distance) for distance in distances_m)
    findings = [*neighbours(layout), *in_view(layout, rig, outlooks), *sizes(layout, rig, outlooks)]
    swaps: tuple[Swap, ...] = ()
    discs = layout.discs
    if discs is not None and layout.disc_count > SEARCHED:
        text = f"{layout.disc_count} discs: which may be taken for which is not looked into above {SEARCHED}"
        grade: Grade = "note" if layout.coded else "bad"
        findings.append(Finding(grade, "ambiguous", text, "" if layout.coded else "take fewer discs, or add a tag"))
    elif discs is not None and layout.disc_count >= 3 and not any(f.kind in ("view", "overlap") for f in findings):
        swaps = tuple(s for seen in seen_together(discs) for s in find_swaps(rig, discs, distances_m, seen))
        findings += ambiguities(rig, discs, distances_m, swaps, layout.coded)
        findings += [] if layout.coded else single_camera(discs)
    return Verdict(outlooks, swaps, (*findings, *pose_findings(layout, outlooks)))


def sigma_px(rig: StereoRig) -> float:
    """Return the standard deviation of a disc's place with a rig, px: the image's share and the rig's own."""
    return float(np.hypot(IMAGE_SIGMA_PX, rig.sigma_px))


def outlook(layout: Layout, rig: StereoRig, distance_m: float) -> Outlook:
    """Predict how well a body that faces the cameras is known at a distance."""
    points = layout.body.points
    seen = view(rig, points, layout.normals, distance_m)
    cov = pose_covariance(rig, points, seen, sigma_px(rig))
    diameters = np.array([np.nan, np.nan])
    if layout.discs is not None:
        d = 2 * layout.discs.radii_m * rig.left.intrinsics[0] / distance_m
        diameters = np.array([d.min(), d.max()])
    forward = seen.T_left_body[:3, :3].T @ seen.forward
    return Outlook(distance_m, np.full((6, 6), np.nan) if cov is None else cov, forward, diameters)
