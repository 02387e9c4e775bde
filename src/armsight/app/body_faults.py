"""What is wrong or weak about a body's markers themselves: overlaps, sizes, what is in view, what its pose lacks."""

from __future__ import annotations

import numpy as np

from armsight.app.body.finding import Finding, Outlook
from armsight.app.body_words import axis_words
from armsight.data import Array
from armsight.geometry.rotation import skew
from armsight.vision.discs.predict import FACING, look_direction, view
from armsight.vision.markers.body_check import on_one_line
from armsight.vision.markers.body_layout import Layout
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.rig import StereoRig

#: A disc's diameter in an image that can be used, px.
DISC_PX = (5.0, 60.0)
#: The plain surround that a disc's edge wants, as a share of its radius.
SURROUND = 0.5
#: A face turned away by less than this is seen by both cameras wherever it is in their images, cosine.
_WELL_FACING = 0.7


def neighbours(layout: Layout) -> list[Finding]:
    """Say which discs overlap, or leave each other no plain surround."""
    if layout.discs is None:
        return []
    findings = []
    places, normals, radii = layout.discs.body.points, layout.discs.normals, layout.discs.radii_m
    names = layout.discs.body.point_names
    for i in range(len(places)):
        for j in range(i + 1, len(places)):
            if normals[i] @ normals[j] < FACING:
                continue
            gap = float(np.linalg.norm(places[i] - places[j]) - radii[i] - radii[j])
            apart = f"move them at least {1e3 * (SURROUND * max(radii[i], radii[j]) - gap):.1f} mm further apart"
            if gap < 0:
                text = f"{names[i]} and {names[j]} overlap by {-1e3 * gap:.1f} mm"
                findings.append(Finding("bad", "overlap", text, apart))
            elif gap < SURROUND * max(radii[i], radii[j]):
                text = f"{names[i]} and {names[j]} leave only {1e3 * gap:.1f} mm of plain surround between them"
                findings.append(Finding("weak", "surround", text, apart))
    return findings + _on_squares(layout, layout.discs)


def _on_squares(layout: Layout, discs: DiscTarget) -> list[Finding]:
    """Say which discs lie on a tag or on a board, or near one."""
    squares: list[tuple[str, Array, Array]] = []
    for tag in () if layout.tags is None else layout.tags.tags:
        half = np.full(2, tag.size_m / 2)
        squares.append((tag.name, tag.T_body_tag, np.stack([-half, half])))
    for placed in () if layout.boards is None else layout.boards.boards:
        flat_points = placed.board.body.points[:, :2]
        squares.append((placed.name, placed.T_body_board, np.stack([flat_points.min(axis=0), flat_points.max(axis=0)])))
    findings = []
    for name, T, (low, high) in squares:
        p = (discs.body.points - T[:3, 3]) @ T[:3, :3]
        outside = np.linalg.norm(np.maximum(0.0, np.maximum(low - p[:, :2], p[:, :2] - high)), axis=1)
        for i in np.flatnonzero(np.abs(p[:, 2]) < discs.radii_m):
            disc, radius = discs.body.point_names[i], float(discs.radii_m[i])
            gap = float(outside[i]) - radius
            apart = f"move {disc} {1e3 * (SURROUND * radius - gap):.1f} mm or more away from {name}"
            if gap < 0:
                findings.append(Finding("bad", "overlap", f"the disc {disc} lies on {name}", apart))
            elif gap < SURROUND * radius:
                text = f"{disc} and {name} leave only {1e3 * gap:.1f} mm of plain surround between them"
                findings.append(Finding("weak", "surround", text, apart))
    return findings


def in_view(layout: Layout, rig: StereoRig, outlooks: tuple[Outlook, ...]) -> list[Finding]:
    """Say where too few points are seen together."""
    points, normals = layout.body.points, layout.normals
    cosine = normals @ look_direction(points, normals)
    facing, well = ~(cosine <= FACING), ~(cosine <= _WELL_FACING)
    if facing.sum() < 3 or on_one_line(points[facing]):
        text = f"at most {facing.sum()} points are seen together from any side, and 3 off one line are needed"
        return [Finding("bad", "view", text, "put 3 or more markers on one side")]
    findings = []
    for one in outlooks:
        lost_rows = np.flatnonzero(well & ~view(rig, points, normals, one.distance_m).seen.all(axis=1))
        lost = [layout.body.point_names[i] for i in lost_rows]
        if lost:
            few = "" if len(lost) <= 3 else f" and {len(lost) - 3} more"
            text = f"at {one.distance_m:g} m {', '.join(lost[:3])}{few} are not in both images"
            findings.append(
                Finding(
                    "bad" if np.isnan(one.cov).any() else "weak", "image", text, "make the body smaller, or go farther"
                )
            )
    return findings


def sizes(layout: Layout, rig: StereoRig, outlooks: tuple[Outlook, ...]) -> list[Finding]:
    """Say which discs are too small or too large in the images."""
    if layout.discs is None:
        return []
    findings = []
    low, high = DISC_PX
    for one in outlooks:
        per_px = 1e3 * one.distance_m / rig.left.intrinsics[0] / 2
        wanted = f"radii of {low * per_px:.1f} to {high * per_px:.1f} mm suit {one.distance_m:g} m"
        if one.disc_px[0] < low:
            text = f"at {one.distance_m:g} m the smallest disc is {one.disc_px[0]:.1f} px across, below {low:g}"
            findings.append(Finding("bad", "size", text, wanted))
        if one.disc_px[1] > high:
            text = f"at {one.distance_m:g} m the largest disc is {one.disc_px[1]:.0f} px across, above {high:g}"
            findings.append(Finding("bad", "size", text, wanted))
    return findings


def pose_findings(layout: Layout, outlooks: tuple[Outlook, ...]) -> list[Finding]:
    """Say which turn is known least, what would help, and what else weakens the pose."""
    findings = []
    known = [one for one in outlooks if np.isfinite(one.cov).all()]
    if known:
        one = known[len(known) // 2]
        values, vectors = np.linalg.eigh(one.cov[3:, 3:])
        axis, sigma = vectors[:, -1], np.degrees(np.sqrt(values[-1]))
        facing = ~(layout.normals @ look_direction(layout.body.points, layout.normals) <= FACING)
        p = layout.body.points[facing]
        reach = float(np.linalg.norm(np.cross(p - p.mean(axis=0), axis), axis=1).max())
        alike = values[-1] < 1.3 * values[-2]
        about = "any axis across the direction of sight" if alike else axis_words(axis, one.forward, layout)
        text = (
            f"known least: the turn about {about}, {sigma:.2g} deg at {one.distance_m:g} m: the markers reach "
            f"{1e3 * reach:.0f} mm from that axis"
        )
        lopsided = values[-1] > 9 * values[-2]
        change = f"a marker {2e3 * reach:.0f} mm from that axis would about halve it"
        findings.append(Finding("weak" if lopsided else "note", "weakest", text, change))
        lever = float(np.linalg.norm(p.mean(axis=0)))
        at_middle = _moved_origin(one.cov, p.mean(axis=0))
        worse = float(np.sqrt(np.trace(one.cov[:3, :3]) / np.trace(at_middle[:3, :3])))
        if worse > 2:
            text = (
                f"the body's origin lies {1e3 * lever:.0f} mm from the markers' middle, so turns move it: its position is "
                f"known {worse:.1f} times worse than the middle's"
            )
            findings.append(Finding("weak", "origin", text, "put markers around the place that matters"))
    if layout.disc_count == 3 and not layout.coded:
        text = "three discs leave nothing over: where one is hidden there is no pose"
        findings.append(Finding("note", "spare", text, "a fourth disc, best off the plane of the three"))
    return findings


def _moved_origin(cov: Array, to: Array) -> Array:
    """Return the covariance (6, 6) of the same pose about another origin (3,), body frame."""
    A = np.eye(6)
    A[:3, 3:] = -skew(to)
    return np.asarray(A @ cov @ A.T)
