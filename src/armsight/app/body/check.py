"""Assess a body before it is built: its markers, its predicted pose, and which discs may be taken for which.

In: a body's layout, a stereo rig and distances. Out: an ``Assessment``; ``armsight body check`` prints it.

From top to bottom: :func:`assess`; findings about the markers themselves (overlaps, visibility, sizes) and about the
predicted pose; ambiguities of discs, whether they are separated, and what would separate them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from armsight.app.body.finding import (
    Ambiguity,
    Assessment,
    Finding,
    Grade,
    Prediction,
    ambiguity_text,
    axis_text,
    pair_text,
)
from armsight.data import Array, Ids
from armsight.geometry.rotation import skew
from armsight.vision.discs.pairing import SIZE_TOLERANCE, UNMODELLED_PX, UNMODELLED_SHARE
from armsight.vision.discs.symmetry import Symmetry, flat, other_side, symmetries
from armsight.vision.markers.body_file import collinear
from armsight.vision.markers.body_layout import Layout
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.pose.predict import FACING, look_direction, pose_covariance, separation, view
from armsight.vision.rig import StereoRig

#: A disc's diameter in an image that can be used, px.
DISC_PX = (5.0, 150.0)
#: The plain surround that a disc's edge needs, as a share of its radius.
SURROUND = 0.5
#: A face whose cosine to the direction of sight is above this is seen by both cameras wherever it is in their images.
_WELL_FACING = 0.7
#: A wrong assignment is separated from the right one where it misses by this many standard deviations: the odds of a
#: million that identification asks for take five, chance may favour the wrong one by three.
SEPARATED_SIGMAS = 8.0
#: More discs than this are not searched for ambiguities.
SEARCHED = 25
#: More discs than this are not searched with one of them hidden.
SEARCHED_HIDDEN = 10
#: Of more discs than this none is moved to find a better position.
SEARCHED_MOVES = 6
#: Symmetries that are examined, the closest first.
_LOOKED_INTO = 60
#: Moves of a disc that are tried, mm, the smallest first.
_MOVES_MM = (2, 3, 4, 6, 8, 10, 15, 20, 30, 40)
#: A body is flat whose discs are within this of one plane, m.
_FLAT_M = 1e-4
#: Standard deviation of a disc's position in its image, px: what the fit reaches on a clean print.
IMAGE_SIGMA_PX = 0.02


def assess(layout: Layout, rig: StereoRig, distances_m: tuple[float, ...]) -> Assessment:
    """Assess a body by its layout.

    Args:
        layout: the body.
        rig: the cameras that are to see it.
        distances_m: where it is to be used.
    """
    predictions = tuple(predict_at(layout, rig, distance) for distance in distances_m)
    findings = [*neighbours(layout), *in_view(layout, rig, predictions), *sizes(layout, rig, predictions)]
    found: tuple[Ambiguity, ...] = ()
    discs = layout.discs
    if discs is not None and layout.disc_count > SEARCHED:
        text = f"{layout.disc_count} discs: ambiguities are not searched above {SEARCHED}"
        grade: Grade = "note" if layout.coded else "bad"
        findings.append(Finding(grade, "ambiguous", text, "" if layout.coded else "take fewer discs, or add a tag"))
    elif discs is not None and layout.disc_count >= 3 and not any(f.kind in ("view", "overlap") for f in findings):
        found = tuple(s for seen in seen_together(discs) for s in find_symmetries(rig, discs, distances_m, seen))
        findings += ambiguity_findings(rig, discs, distances_m, found, layout.coded)
        findings += [] if layout.coded else single_camera(discs)
    return Assessment(predictions, found, (*findings, *pose_findings(layout, predictions)))


def sigma_px(rig: StereoRig) -> float:
    """Return the standard deviation of a disc's position with a rig, px: the image's share and the rig's own."""
    return float(np.hypot(IMAGE_SIGMA_PX, rig.sigma_px))


def predict_at(layout: Layout, rig: StereoRig, distance_m: float) -> Prediction:
    """Predict the pose of a body that faces the cameras at a distance."""
    points = layout.body.points
    seen = view(rig, points, layout.normals, distance_m)
    cov = pose_covariance(rig, points, seen, sigma_px(rig))
    diameters = np.array([np.nan, np.nan])
    if layout.discs is not None:
        d = 2 * layout.discs.radii_m * rig.left.intrinsics[0] / distance_m
        diameters = np.array([d.min(), d.max()])
    forward = seen.T_left_body[:3, :3].T @ seen.forward
    return Prediction(distance_m, np.full((6, 6), np.nan) if cov is None else cov, forward, diameters)


def neighbours(layout: Layout) -> list[Finding]:
    """Say which discs overlap, or leave each other no plain surround."""
    if layout.discs is None:
        return []
    findings = []
    points, normals, radii = layout.discs.body.points, layout.discs.normals, layout.discs.radii_m
    names = layout.discs.body.point_names
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            if normals[i] @ normals[j] < FACING:
                continue
            gap = float(np.linalg.norm(points[i] - points[j]) - radii[i] - radii[j])
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
    for mounted in () if layout.boards is None else layout.boards.boards:
        flat_points = mounted.board.body.points[:, :2]
        squares.append(
            (mounted.name, mounted.T_body_board, np.stack([flat_points.min(axis=0), flat_points.max(axis=0)]))
        )
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


def in_view(layout: Layout, rig: StereoRig, predictions: tuple[Prediction, ...]) -> list[Finding]:
    """Say where too few points are seen together."""
    points, normals = layout.body.points, layout.normals
    cosine = normals @ look_direction(points, normals)
    facing, well = ~(cosine <= FACING), ~(cosine <= _WELL_FACING)
    if facing.sum() < 3 or collinear(points[facing]):
        text = f"at most {facing.sum()} points are seen together from any side, and 3 off one line are needed"
        return [Finding("bad", "view", text, "put 3 or more markers on one side")]
    findings = []
    for one in predictions:
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


def sizes(layout: Layout, rig: StereoRig, predictions: tuple[Prediction, ...]) -> list[Finding]:
    """Say which discs are too small or too large in the images."""
    if layout.discs is None:
        return []
    findings = []
    low, high = DISC_PX
    for one in predictions:
        per_px = 1e3 * one.distance_m / rig.left.intrinsics[0] / 2
        advice = f"radii of {low * per_px:.1f} to {high * per_px:.1f} mm suit {one.distance_m:g} m"
        if one.disc_px[0] < low:
            text = f"at {one.distance_m:g} m the smallest disc is {one.disc_px[0]:.1f} px across, below {low:g}"
            findings.append(Finding("bad", "size", text, advice))
        if one.disc_px[1] > high:
            text = f"at {one.distance_m:g} m the largest disc is {one.disc_px[1]:.0f} px across, above {high:g}"
            findings.append(Finding("bad", "size", text, advice))
    return findings


def pose_findings(layout: Layout, predictions: tuple[Prediction, ...]) -> list[Finding]:
    """Say which rotation is known least, what would help, and what else weakens the pose."""
    findings = []
    known = [one for one in predictions if np.isfinite(one.cov).all()]
    if known:
        one = known[len(known) // 2]
        values, vectors = np.linalg.eigh(one.cov[3:, 3:])
        axis, sigma = vectors[:, -1], np.degrees(np.sqrt(values[-1]))
        facing = ~(layout.normals @ look_direction(layout.body.points, layout.normals) <= FACING)
        p = layout.body.points[facing]
        reach = float(np.linalg.norm(np.cross(p - p.mean(axis=0), axis), axis=1).max())
        alike = values[-1] < 1.3 * values[-2]
        about = "any axis across the direction of sight" if alike else axis_text(axis, one.forward, layout)
        text = (
            f"known least: the rotation about {about}, {sigma:.2g} deg at {one.distance_m:g} m: the markers reach "
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
                f"the body's origin lies {1e3 * lever:.0f} mm from the markers' middle, so rotations move it: its position "
                f"is known {worse:.1f} times worse than the middle's"
            )
            findings.append(Finding("weak", "origin", text, "put markers around the point that matters"))
    if layout.disc_count == 3 and not layout.coded:
        text = "three discs leave nothing over: where one is hidden there is no pose"
        findings.append(Finding("note", "spare", text, "a fourth disc, best off the plane of the three"))
    return findings


def _moved_origin(cov: Array, to: Array) -> Array:
    """Return the covariance (6, 6) of the same pose about another origin (3,), body frame."""
    A = np.eye(6)
    A[:3, 3:] = -skew(to)
    return np.asarray(A @ cov @ A.T)


def identification_sigma_px(rig: StereoRig, discs: DiscTarget, distance_m: float) -> float:
    """Return the sigma that identification assumes of a disc's position, px: noise, and a body not built exactly so."""
    made_m = UNMODELLED_SHARE * float(np.linalg.norm(np.ptp(discs.body.points, axis=0)))
    return float(np.hypot(np.hypot(rig.sigma_px, UNMODELLED_PX), made_m * rig.left.intrinsics[0] / distance_m))


def alike(discs: DiscTarget) -> NDArray[np.bool_]:
    """(M, M) whether two discs look alike: in brightness, and in size as far as identification relies on it."""
    same = discs.bright[:, None] == discs.bright[None]
    ratio = discs.radii_m[:, None] / discs.radii_m[None]
    most = (1 + SIZE_TOLERANCE) / (1 - SIZE_TOLERANCE)
    return np.asarray(same & (ratio <= most) & (ratio >= 1 / most))


def search_tolerance_m(rig: StereoRig, discs: DiscTarget, distances_m: tuple[float, ...]) -> float:
    """Return how much two lengths may differ and still be worth a closer look, m: by far more than is separated."""
    f, sigma = rig.left.intrinsics[0], identification_sigma_px(rig, discs, max(distances_m))
    depth = np.sqrt(2) * sigma * max(distances_m) ** 2 / (f * rig.baseline_m)
    size = float(pdist(discs.body.points).max())
    return float(min(SEPARATED_SIGMAS * depth, 0.5 * size))


def seen_together(discs: DiscTarget) -> list[Ids]:
    """Return which discs are seen from in front of each face, and from where most are: rows, three or more off a line."""
    points, normals = discs.body.points, discs.normals
    known = normals[np.isfinite(normals[:, 0])]
    found: dict[tuple[int, ...], Ids] = {}
    for direction in np.vstack([look_direction(points, normals), known]):
        rows = np.flatnonzero(~(normals @ direction <= FACING))
        if len(rows) >= 3 and not collinear(points[rows]):
            found.setdefault(tuple(rows), rows)
    return list(found.values())


def find_symmetries(
    rig: StereoRig, discs: DiscTarget, distances_m: tuple[float, ...], seen: Ids, hidden: int = -1
) -> tuple[Ambiguity, ...]:
    """Find what may be taken for what where no distance separates it, or only the normals do.

    Args:
        rig: the cameras.
        discs: the body's discs.
        distances_m: where the body is to be used.
        seen: rows of the discs in view.
        hidden: a disc that something hides; none where below zero.
    """
    points, normals = discs.body.points, discs.normals
    far = max(distances_m)
    sigma = identification_sigma_px(rig, discs, far)
    ambiguities = []
    found = symmetries(points, alike(discs), seen, search_tolerance_m(rig, discs, distances_m))
    for one in found[:_LOOKED_INTO]:
        sigmas = separation(rig, points, normals, one, far, sigma, hidden)
        by_side = np.isinf(sigmas) and _sideless(rig, points, one, far, sigma) < SEPARATED_SIGMAS
        if sigmas < SEPARATED_SIGMAS or by_side:
            each = [
                separation(rig, points, normals, one, d, identification_sigma_px(rig, discs, d), hidden)
                for d in distances_m
            ]
            ambiguities.append(Ambiguity(one, np.array(each), flat(points[seen], _FLAT_M) and other_side(one, points)))
    return tuple(ambiguities)


def _sideless(rig: StereoRig, points: Array, one: Symmetry, distance_m: float, sigma: float) -> float:
    """Return by how many standard deviations discs taken for each other miss if their normals were unknown."""
    if set(one.seen.tolist()) != set(one.taken_for.tolist()):
        return np.inf
    count = len(one.seen)
    here = Symmetry(np.arange(count), np.searchsorted(one.seen, one.taken_for), one.T, one.mirrored, one.off_m)
    return separation(rig, points[one.seen], np.full((count, 3), np.nan), here, distance_m, sigma)


def ambiguity_findings(
    rig: StereoRig, discs: DiscTarget, distances_m: tuple[float, ...], ambiguities: tuple[Ambiguity, ...], coded: bool
) -> list[Finding]:
    """Say what may be taken for what, what settles it, and what would; ``coded``: whether a tag or a board is there too."""
    names, points = discs.body.point_names, discs.body.points
    unsettled = [one for one in ambiguities if (one.separation_sigmas < SEPARATED_SIGMAS).any()]
    findings = [_ambiguity_finding(rig, discs, distances_m, one, coded) for one in unsettled[:4]]
    if len(unsettled) > 4:
        findings.append(Finding("note", "ambiguity", f"and {len(unsettled) - 4} more ways to take discs for others"))
    if unsettled and not coded:
        findings.append(Finding("note", "change", "", _what_separates(rig, discs, distances_m, unsettled)))
    for one in ambiguities:
        if one.by_side:
            text = f"{ambiguity_text(one.symmetry, names)} would fit, but seen from behind: the normals settle it"
            findings.append(Finding("note", "behind", text))
    most = seen_together(discs)[0]
    if unsettled or coded or not 4 <= len(most) <= SEARCHED_HIDDEN:
        return findings
    for hidden in most:
        seen = most[most != hidden]
        if collinear(points[seen]):
            findings.append(Finding("weak", "hidden", f"where {names[hidden]} is hidden, the others lie on one line"))
            continue
        lost = [
            one
            for one in find_symmetries(rig, discs, distances_m, seen, int(hidden))
            if (one.separation_sigmas < SEPARATED_SIGMAS).any()
        ]
        if lost:
            what = ambiguity_text(lost[0].symmetry, names)
            at = distances_m[int(np.flatnonzero(lost[0].separation_sigmas < SEPARATED_SIGMAS)[0])]
            text = f"where {names[hidden]} is hidden, {what} fits as well or nearly from {at:g} m on: it may be missed"
            findings.append(Finding("weak", "hidden", text))
    return findings


def _ambiguity_finding(
    rig: StereoRig, discs: DiscTarget, distances_m: tuple[float, ...], one: Ambiguity, coded: bool
) -> Finding:
    """Say what one way to take discs for others means."""
    what = ambiguity_text(one.symmetry, discs.body.point_names) + (", seen from behind," if one.behind else "")
    if one.symmetry.off_m < 1e-6:
        text = f"{what} is the same body"
    else:
        k = int(np.flatnonzero(one.separation_sigmas < SEPARATED_SIGMAS)[-1])
        sigma = identification_sigma_px(rig, discs, distances_m[k])
        enough = (
            f"; {1e3 * one.symmetry.off_m * SEPARATED_SIGMAS / one.separation_sigmas[k]:.1f} mm would do"
            if one.separation_sigmas[k] > 0.1
            else ""
        )
        lengths = pair_text(one.symmetry, discs.body)
        known = f"{sigma * one.separation_sigmas[k] / SEPARATED_SIGMAS:.2g} px (assumed: {sigma:.2g} px){enough}"
        only = f"distinguished at {distances_m[k]:g} m only if a disc's position is known to {known}"
        text = f"{what.rstrip(',')}: {lengths}, {only}"
    if coded:
        return Finding("note", "ambiguity", f"{text}; a tag or a board in view settles it")
    return Finding("bad", "ambiguous", text)


def _what_separates(
    rig: StereoRig, discs: DiscTarget, distances_m: tuple[float, ...], ambiguities: list[Ambiguity]
) -> str:
    """Say how the discs can be distinguished: by normals, or by moving one of them as little as will do."""
    points, names = discs.body.points, discs.body.point_names
    unknown = np.isnan(discs.normals)
    normals = np.where(unknown, look_direction(points, discs.normals), discs.normals)
    given = "give every disc its normal and " if unknown.any() else ""
    if unknown.any() and _separate(rig, discs, max(distances_m), points, normals):
        return "give every disc its normal: then its side distinguishes them"
    pairs = [(int(i), int(j)) for s in ambiguities for i, j in zip(s.symmetry.seen, s.symmetry.taken_for, strict=True)]
    moved = sorted({i for i, j in pairs if i != j})
    for step in _MOVES_MM if len(points) <= SEARCHED_MOVES else ():
        for i in moved:
            for direction in np.vstack([np.eye(3), -np.eye(3)]):
                if abs(direction @ normals[i]) > FACING:
                    continue
                trial = points.copy()
                trial[i] += 1e-3 * step * direction
                if _separate(rig, discs, max(distances_m), trial, normals):
                    axis = f"{'+' if direction.sum() > 0 else '-'}{'xyz'[int(np.abs(direction).argmax())]}"
                    return f"{given}move {names[i]} by {step} mm along {axis}: then the distances differ enough"
    return f"{given}arrange the discs so that no two distances are alike, or add a tag"


def _separate(rig: StereoRig, discs: DiscTarget, distance_m: float, points: Array, normals: Array) -> bool:
    """Whether no disc may be taken for another at a distance, with a margin of a tenth, were they at other positions."""
    if float(pdist(points).min()) < (2 + SURROUND) * float(discs.radii_m.max()):
        return False
    tolerance, sigma = search_tolerance_m(rig, discs, (distance_m,)), identification_sigma_px(rig, discs, distance_m)
    return all(
        separation(rig, points, normals, one, distance_m, sigma) >= 1.1 * SEPARATED_SIGMAS
        for seen in seen_together(discs)
        for one in symmetries(points, alike(discs), seen, tolerance)
    )


def single_camera(discs: DiscTarget) -> list[Finding]:
    """Say what one camera alone cannot distinguish."""
    points = discs.body.points
    if flat(points, _FLAT_M):
        text = "a flat body has two poses that one camera alone hardly distinguishes; two cameras do"
        return [Finding("note", "single", text)]
    everything = np.arange(len(points))
    mirrored = symmetries(points, alike(discs), everything, 1e-3, mirrored=True)
    if not mirrored:
        return []
    what = ambiguity_text(mirrored[0], discs.body.point_names)
    return [Finding("note", "mirror", f"{what} is its mirror image: harmless to two cameras, not to one alone")]
