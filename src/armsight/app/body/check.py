"""Assess a body before it is built: its markers, its predicted pose, and which discs may be taken for which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from armsight.data import Array, Body, Ids, Record
from armsight.geometry.rigid import collinear
from armsight.geometry.rotation import skew
from armsight.vision.discs.pairing import SIZE_TOLERANCE, UNMODELLED_PX, UNMODELLED_SHARE
from armsight.vision.discs.symmetry import Symmetry, flat, other_side, symmetries
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.predict import FACING, look_direction, pose_covariance, separation, view
from armsight.vision.rig import StereoRig

#: Within this angle a direction is given the name of an axis, cosine.
_ALONG = float(np.cos(np.radians(8.0)))
#: A disc's diameter in an image that can be used, px.
DISC_PX = (5.0, 150.0)
#: The plain surround that a disc's edge needs, as a share of its radius.
SURROUND = 0.5
#: A face whose cosine to the direction of sight is above this is seen by both cameras wherever it is in their images.
_WELL_FACING = 0.7
#: A wrong assignment is separated where it misses by so many standard deviations: five for a million, three for chance.
SEPARATED_SIGMAS = 8.0
#: More discs than these are not searched for ambiguities, not with one of them hidden, and none is moved elsewhere.
SEARCHED, SEARCHED_HIDDEN, SEARCHED_MOVES = 25, 10, 6
#: Symmetries that are examined, the closest first.
_LOOKED_INTO = 60
#: Moves of a disc that are tried, mm, the smallest first.
_MOVES_MM = (2, 3, 4, 6, 8, 10, 15, 20, 30, 40)
#: A body is flat whose discs are within this of one plane, m.
_FLAT_M = 1e-4
#: Standard deviation of a disc's position in its image, px: what the fit reaches on a clean print.
IMAGE_SIGMA_PX = 0.02


Grade = Literal["bad", "weak", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing about a body."""

    grade: Grade  #: "bad" where the body cannot be used as it is, "weak" where it could be better, or "note"
    kind: str  #: what it is about, one word
    text: str  #: what it is
    change: str = ""  #: what to do about it; empty where nothing need be done


@dataclass(frozen=True, eq=False)
class Prediction(Record):
    """The predicted pose of a body at a distance."""

    distance_m: float  #: from the cameras, the body facing them
    cov: Array  #: (6, 6) predicted covariance of the pose, perturbation on the right; NaN where no pose is fixed
    forward: Array  #: (3,) direction of depth, body frame
    disc_px: Array  #: (2,) smallest and largest disc's diameter in the image; NaN where there are no discs

    @property
    def position_mm(self) -> tuple[float, float]:
        """Standard deviation of the body's origin, mm: the worst direction across, and depth."""
        return _across_and_along(self.cov[:3, :3] * 1e6, self.forward)

    @property
    def rotation_deg(self) -> tuple[float, float]:
        """Standard deviation of the rotation, degrees: the worst axis across (tilt), and about the direction of depth."""
        return _across_and_along(self.cov[3:, 3:] * np.degrees(1.0) ** 2, self.forward)


@dataclass(frozen=True, eq=False)
class Ambiguity(Record):
    """Discs that may be taken for others."""

    symmetry: Symmetry  #: which for which
    #: (D,) by how many standard deviations it misses at each distance; infinite by the faces, NaN where not in view
    separation_sigmas: Array
    behind: bool  #: whether it shows the other side of a flat body, so that normals settle it

    @property
    def by_side(self) -> bool:
        """Whether the normals alone settle it."""
        return bool(np.isinf(self.separation_sigmas).any() and not np.isfinite(self.separation_sigmas).any())

    @property
    def unsettled(self) -> NDArray[np.int64]:
        """The distances, by number, at which nothing separates it."""
        return np.flatnonzero(self.separation_sigmas < SEPARATED_SIGMAS)


@dataclass(frozen=True, eq=False)
class Assessment(Record):
    """The assessment of a body."""

    predictions: tuple[Prediction, ...]  #: one for each distance
    ambiguities: tuple[Ambiguity, ...]  #: of all discs of a side in view, whether or not separated
    findings: tuple[Finding, ...]  #: as text

    @property
    def grade(self) -> str:
        """The body as a whole: usable, ambiguous or unusable."""
        bad = {finding.kind for finding in self.findings if finding.grade == "bad"}
        return "unusable" if bad - {"ambiguous"} else "ambiguous" if bad else "usable"


def _across_and_along(cov: Array, forward: Array) -> tuple[float, float]:
    """Return the largest standard deviation square to a direction, and that along it."""
    if not np.isfinite(cov).all():
        return np.nan, np.nan
    P = np.eye(3) - np.outer(forward, forward)
    across = np.linalg.eigvalsh(P @ cov @ P)[-1]
    return float(np.sqrt(max(across, 0.0))), float(np.sqrt(forward @ cov @ forward))


def ambiguity_text(symmetry: Symmetry, names: Sequence[str]) -> str:
    """Return which discs are taken for which: "P1 and P2 exchanged", "P1 P2 P3 taken for P2 P3 P1"."""
    pairs = [(i, j) for i, j in zip(symmetry.seen.tolist(), symmetry.taken_for.tolist(), strict=True) if i != j]
    if len(pairs) == 2 and pairs[0] == pairs[1][::-1]:
        return f"{names[pairs[0][0]]} and {names[pairs[0][1]]} exchanged"
    shown, more = pairs[:6], " ..." if len(pairs) > 6 else ""
    return f"{' '.join(names[i] for i, _ in shown)}{more} taken for {' '.join(names[j] for _, j in shown)}{more}"


def pair_text(symmetry: Symmetry, body: Body) -> str:
    """Return which distance separates an ambiguity best: "P1-P3 is 63.20 mm and P2-P3 63.60 mm, 0.40 mm apart"."""
    p = body.points
    seen, taken = symmetry.seen, symmetry.taken_for
    own = np.linalg.norm(p[seen][:, None] - p[seen][None], axis=2)
    other = np.linalg.norm(p[taken][:, None] - p[taken][None], axis=2)
    a, b = np.unravel_index(int(np.abs(own - other).argmax()), own.shape)
    first = f"{body.point_names[seen[a]]}-{body.point_names[seen[b]]}"
    second = f"{body.point_names[taken[a]]}-{body.point_names[taken[b]]}"
    return (
        f"{first} is {1e3 * own[a, b]:.2f} mm and {second} {1e3 * other[a, b]:.2f} mm, "
        f"{1e3 * abs(own[a, b] - other[a, b]):.2f} mm apart"
    )


def axis_text(axis: Array, forward: Array, layout: Composite) -> str:
    """Name a direction (3,) of the body: one of its axes, the line of two markers, or numbers."""
    found = [f"the body's {name} axis" for name, along in zip("xyz", axis, strict=True) if abs(along) > _ALONG]
    if not found and layout.discs is not None:
        p, names = layout.discs.body.points, layout.discs.body.point_names
        i, j = np.triu_indices(len(p), 1)
        along = np.abs((p[j] - p[i]) @ axis) / np.maximum(np.linalg.norm(p[j] - p[i], axis=1), 1e-12)
        if len(along) and along.max() > _ALONG:
            best = int(along.argmax())
            found.append(f"the line {names[i[best]]}-{names[j[best]]}")
    if not found:
        found.append(f"the body's direction ({', '.join(f'{c:.2f}' for c in axis + 0.0)})")
    if abs(axis @ forward) > _ALONG:
        found.append("the direction of sight")
    return found[0] + (f" ({found[1]})" if len(found) > 1 else "")


def assess(layout: Composite, rig: StereoRig, distances_m: tuple[float, ...]) -> Assessment:
    """Assess a body by its layout."""
    predictions = tuple(_predicted(layout, rig, distance) for distance in distances_m)
    findings = [*_neighbours(layout), *_in_view(layout, rig, predictions), *_sizes(layout, rig, predictions)]
    found: tuple[Ambiguity, ...] = ()
    discs = layout.discs
    if discs is not None and layout.disc_count > SEARCHED:
        text = f"{layout.disc_count} discs: ambiguities are not searched above {SEARCHED}"
        grade: Grade = "note" if layout.parts else "bad"
        findings.append(Finding(grade, "ambiguous", text, "" if layout.parts else "take fewer discs, or add a tag"))
    elif discs is not None and layout.disc_count >= 3 and not any(f.kind in ("view", "overlap") for f in findings):
        search = _Search(rig, discs, distances_m, bool(layout.parts))
        found = tuple(one for seen in search.seen_together for one in search.ambiguities(seen))
        findings += search.findings(found)
        findings += [] if layout.parts else _single_camera(search)
    return Assessment(predictions, found, (*findings, *_pose_findings(layout, predictions)))


def sigma_px(rig: StereoRig) -> float:
    """Return the standard deviation of a disc's position with a rig, px: the image's share and the rig's own."""
    return float(np.hypot(IMAGE_SIGMA_PX, rig.sigma_px))


def _predicted(layout: Composite, rig: StereoRig, distance_m: float) -> Prediction:
    seen = view(rig, layout.body.points, layout.normals, distance_m)
    cov = pose_covariance(rig, layout.body.points, seen, sigma_px(rig))
    diameters = np.array([np.nan, np.nan])
    if layout.discs is not None:
        d = 2 * layout.discs.radii_m * rig.left.intrinsics[0] / distance_m
        diameters = np.array([d.min(), d.max()])
    forward = seen.T_left_body[:3, :3].T @ seen.forward
    return Prediction(distance_m, np.full((6, 6), np.nan) if cov is None else cov, forward, diameters)


def _neighbours(layout: Composite) -> list[Finding]:
    if layout.discs is None:
        return []
    findings = []
    points, normals, radii = layout.discs.body.points, layout.discs.normals, layout.discs.radii_m
    names = layout.discs.body.point_names

    def beside(gap: float, need: float, overlap: str, both: str, move: str) -> None:
        apart = move.format(f"{1e3 * (need - gap):.1f} mm")
        if gap < 0:
            findings.append(Finding("bad", "overlap", overlap, apart))
        elif gap < need:
            text = f"{both} leave only {1e3 * gap:.1f} mm of plain surround between them"
            findings.append(Finding("weak", "surround", text, apart))

    for i, j in zip(*np.triu_indices(len(points), 1), strict=True):
        if not normals[i] @ normals[j] < FACING:
            gap = float(np.linalg.norm(points[i] - points[j]) - radii[i] - radii[j])
            both, overlap = f"{names[i]} and {names[j]}", f"overlap by {-1e3 * gap:.1f} mm"
            need = SURROUND * float(max(radii[i], radii[j]))
            beside(gap, need, f"{both} {overlap}", both, "move them at least {} further apart")
    squares: list[tuple[str, Array, Array]] = []
    for tag in () if layout.tags is None else layout.tags.tags:
        squares.append((tag.name, tag.T_body_tag, np.array([[-1.0, -1.0], [1.0, 1.0]]) * tag.size_m / 2))
    for mounted in () if layout.boards is None else layout.boards.boards:
        on_board = mounted.board.body.points[:, :2]
        squares.append((mounted.name, mounted.T_body_board, np.stack([on_board.min(axis=0), on_board.max(axis=0)])))
    for name, T, (low, high) in squares:
        p = (points - T[:3, 3]) @ T[:3, :3]
        outside = np.linalg.norm(np.maximum(0.0, np.maximum(low - p[:, :2], p[:, :2] - high)), axis=1)
        for i in np.flatnonzero(np.abs(p[:, 2]) < radii):
            gap, move = float(outside[i] - radii[i]), f"move {names[i]} {{}} or more away from {name}"
            overlap = f"the disc {names[i]} lies on {name}"
            beside(gap, SURROUND * float(radii[i]), overlap, f"{names[i]} and {name}", move)
    return findings


def _in_view(layout: Composite, rig: StereoRig, predictions: tuple[Prediction, ...]) -> list[Finding]:
    points, normals = layout.body.points, layout.normals
    cosine = normals @ look_direction(points, normals)
    facing, well = ~(cosine <= FACING), ~(cosine <= _WELL_FACING)
    if facing.sum() < 3 or collinear(points[facing]):
        text = f"at most {facing.sum()} points are seen together from any side, and 3 off one line are needed"
        return [Finding("bad", "view", text, "put 3 or more markers on one side")]
    findings = []
    for one in predictions:
        lost_rows = np.flatnonzero(well & ~view(rig, points, normals, one.distance_m).seen.all(axis=1))
        if lost := [layout.body.point_names[i] for i in lost_rows]:
            few = "" if len(lost) <= 3 else f" and {len(lost) - 3} more"
            text = f"at {one.distance_m:g} m {', '.join(lost[:3])}{few} are not in both images"
            grade: Grade = "bad" if np.isnan(one.cov).any() else "weak"
            findings.append(Finding(grade, "image", text, "make the body smaller, or go farther"))
    return findings


def _sizes(layout: Composite, rig: StereoRig, predictions: tuple[Prediction, ...]) -> list[Finding]:
    findings = []
    low, high = DISC_PX
    for one in predictions if layout.discs is not None else ():
        at, per_px = f"at {one.distance_m:g} m", 1e3 * one.distance_m / rig.left.intrinsics[0] / 2
        advice = f"radii of {low * per_px:.1f} to {high * per_px:.1f} mm suit {one.distance_m:g} m"
        if one.disc_px[0] < low:
            text = f"{at} the smallest disc is {one.disc_px[0]:.1f} px across, below {low:g}"
            findings.append(Finding("bad", "size", text, advice))
        if one.disc_px[1] > high:
            text = f"{at} the largest disc is {one.disc_px[1]:.0f} px across, above {high:g}"
            findings.append(Finding("bad", "size", text, advice))
    return findings


def _pose_findings(layout: Composite, predictions: tuple[Prediction, ...]) -> list[Finding]:
    """Say which rotation is known least, what would help, and what else weakens the pose."""
    findings = []
    known = [one for one in predictions if np.isfinite(one.cov).all()]
    if known:
        one = known[len(known) // 2]
        values, vectors = np.linalg.eigh(one.cov[3:, 3:])
        axis, sigma = vectors[:, -1], np.degrees(np.sqrt(values[-1]))
        p = layout.body.points[~(layout.normals @ look_direction(layout.body.points, layout.normals) <= FACING)]
        middle = p.mean(axis=0)
        reach = float(np.linalg.norm(np.cross(p - middle, axis), axis=1).max())
        even = values[-1] < 1.3 * values[-2]
        about = "any axis across the direction of sight" if even else axis_text(axis, one.forward, layout)
        text = (
            f"known least: the rotation about {about}, {sigma:.2g} deg at {one.distance_m:g} m: the markers reach "
            f"{1e3 * reach:.0f} mm from that axis"
        )
        grade: Grade = "weak" if values[-1] > 9 * values[-2] else "note"
        findings.append(
            Finding(grade, "weakest", text, f"a marker {2e3 * reach:.0f} mm from that axis would about halve it")
        )
        A = np.block([[np.eye(3), -skew(middle)], [np.zeros((3, 3)), np.eye(3)]])  # to the markers' middle
        worse = float(np.sqrt(np.trace(one.cov[:3, :3]) / np.trace((A @ one.cov @ A.T)[:3, :3])))
        if worse > 2:
            text = (
                f"the body's origin lies {1e3 * float(np.linalg.norm(middle)):.0f} mm from the markers' middle, so "
                f"rotations move it: its position is known {worse:.1f} times worse than the middle's"
            )
            findings.append(Finding("weak", "origin", text, "put markers around the point that matters"))
    if layout.disc_count == 3 and not layout.parts:
        text = "three discs leave nothing over: where one is hidden there is no pose"
        findings.append(Finding("note", "spare", text, "a fourth disc, best off the plane of the three"))
    return findings


@dataclass
class _Search:
    """What may be taken for what, of a body's discs before cameras."""

    rig: StereoRig
    discs: DiscTarget
    distances_m: tuple[float, ...]
    coded: bool  #: whether a tag or a board is there too

    def __post_init__(self) -> None:
        """Compute which discs look alike: in brightness, and in size as far as identification relies on it."""
        self.points, self.normals, self.names = self.discs.body.points, self.discs.normals, self.discs.body.point_names
        ratio = self.discs.radii_m[:, None] / self.discs.radii_m[None]
        most, same = (1 + SIZE_TOLERANCE) / (1 - SIZE_TOLERANCE), self.discs.bright[:, None] == self.discs.bright[None]
        self.alike = np.asarray(same & (ratio <= most) & (ratio >= 1 / most))
        self.far_m = max(self.distances_m)
        # Two lengths that differ by so much are worth a closer look, m: by far more than is separated.
        depth = (
            np.sqrt(2) * self.sigma_px(self.far_m) * self.far_m**2 / (self.rig.left.intrinsics[0] * self.rig.baseline_m)
        )
        self.tolerance_m = float(min(SEPARATED_SIGMAS * depth, 0.5 * float(pdist(self.points).max())))

    def sigma_px(self, distance_m: float) -> float:
        """Return the sigma that identification assumes of a disc's position, px: noise, and a body not built exactly so."""
        made_m = UNMODELLED_SHARE * float(np.linalg.norm(np.ptp(self.points, axis=0)))
        by_body = made_m * self.rig.left.intrinsics[0] / distance_m
        return float(np.hypot(np.hypot(self.rig.sigma_px, UNMODELLED_PX), by_body))

    @cached_property
    def seen_together(self) -> list[Ids]:
        """Discs seen from in front of each face, and from where most are: rows, three or more off a line."""
        known = self.normals[np.isfinite(self.normals[:, 0])]
        found: dict[tuple[int, ...], Ids] = {}
        for direction in np.vstack([look_direction(self.points, self.normals), known]):
            rows = np.flatnonzero(~(self.normals @ direction <= FACING))
            if len(rows) >= 3 and not collinear(self.points[rows]):
                found.setdefault(tuple(rows), rows)
        return list(found.values())

    def separation(self, one: Symmetry, distance_m: float, hidden: int = -1) -> float:
        """Return by how many standard deviations discs taken for each other miss at a distance, m."""
        sigma = self.sigma_px(distance_m)
        return separation(self.rig, self.points, self.normals, one, distance_m, sigma, hidden)

    def _sideless(self, one: Symmetry) -> float:
        """Return the same at the farthest distance if their normals were unknown."""
        if set(one.seen.tolist()) != set(one.taken_for.tolist()):
            return np.inf
        here = Symmetry(
            np.arange(len(one.seen)), np.searchsorted(one.seen, one.taken_for), one.T, one.mirrored, one.off_m
        )
        points, unknown, sigma = self.points[one.seen], np.full((len(one.seen), 3), np.nan), self.sigma_px(self.far_m)
        return separation(self.rig, points, unknown, here, self.far_m, sigma)

    def ambiguities(self, seen: Ids, hidden: int = -1) -> list[Ambiguity]:
        """Find what may be taken for what, of discs ``seen``, where no distance separates it, or only the normals do."""
        found = []
        for one in symmetries(self.points, self.alike, seen, self.tolerance_m)[:_LOOKED_INTO]:
            sigmas = self.separation(one, self.far_m, hidden)
            if sigmas < SEPARATED_SIGMAS or (np.isinf(sigmas) and self._sideless(one) < SEPARATED_SIGMAS):
                each = np.array([self.separation(one, d, hidden) for d in self.distances_m])
                found.append(Ambiguity(one, each, flat(self.points[seen], _FLAT_M) and other_side(one, self.points)))
        return found

    def findings(self, ambiguities: tuple[Ambiguity, ...]) -> list[Finding]:
        """Say what may be taken for what, what settles it, and what would."""
        unsettled = [one for one in ambiguities if len(one.unsettled)]
        findings = [self._finding(one) for one in unsettled[:4]]
        if len(unsettled) > 4:
            text = f"and {len(unsettled) - 4} more ways to take discs for others"
            findings.append(Finding("note", "ambiguity", text))
        if unsettled and not self.coded:
            findings.append(Finding("note", "change", "", self._what_separates(unsettled)))
        for one in ambiguities:
            if one.by_side:
                what = ambiguity_text(one.symmetry, self.names)
                text = f"{what} would fit, but seen from behind: the normals settle it"
                findings.append(Finding("note", "behind", text))
        most = self.seen_together[0]
        if unsettled or self.coded or not 4 <= len(most) <= SEARCHED_HIDDEN:
            return findings
        for hidden in most:
            seen, where = most[most != hidden], f"where {self.names[hidden]} is hidden,"
            if collinear(self.points[seen]):
                findings.append(Finding("weak", "hidden", f"{where} the others lie on one line"))
                continue
            if lost := [one for one in self.ambiguities(seen, int(hidden)) if len(one.unsettled)]:
                what, at = ambiguity_text(lost[0].symmetry, self.names), self.distances_m[lost[0].unsettled[0]]
                text = f"{where} {what} fits as well or nearly from {at:g} m on: it may be missed"
                findings.append(Finding("weak", "hidden", text))
        return findings

    def _finding(self, one: Ambiguity) -> Finding:
        text = what = ambiguity_text(one.symmetry, self.names)
        if one.symmetry.off_m < 1e-6:
            text += f"{', seen from behind,' if one.behind else ''} is the same body"
        else:
            k = int(one.unsettled[-1])
            at, sigma = self.distances_m[k], self.sigma_px(self.distances_m[k])
            share = one.separation_sigmas[k] / SEPARATED_SIGMAS
            enough = f"; {1e3 * one.symmetry.off_m / share:.1f} mm would do" if one.separation_sigmas[k] > 0.1 else ""
            known = f"{sigma * share:.2g} px (assumed: {sigma:.2g} px){enough}"
            only = f"distinguished at {at:g} m only if a disc's position is known to {known}"
            behind = ", seen from behind" if one.behind else ""
            text = f"{what}{behind}: {pair_text(one.symmetry, self.discs.body)}, {only}"
        if self.coded:
            return Finding("note", "ambiguity", f"{text}; a tag or a board in view settles it")
        return Finding("bad", "ambiguous", text)

    def _what_separates(self, ambiguities: list[Ambiguity]) -> str:
        """Say how the discs can be distinguished: by normals, or by moving one of them as little as will do."""
        unknown = np.isnan(self.normals)
        normals = np.where(unknown, look_direction(self.points, self.normals), self.normals)
        given = "give every disc its normal and " if unknown.any() else ""
        if unknown.any() and self._separate(self.points, normals):
            return "give every disc its normal: then its side distinguishes them"
        pairs = [pair for s in ambiguities for pair in zip(s.symmetry.seen, s.symmetry.taken_for, strict=True)]
        moved = sorted({int(i) for i, j in pairs if i != j})
        for step in _MOVES_MM if len(self.points) <= SEARCHED_MOVES else ():
            for i in moved:
                for direction in np.vstack([np.eye(3), -np.eye(3)]):
                    if abs(direction @ normals[i]) > FACING:
                        continue
                    trial = self.points.copy()
                    trial[i] += 1e-3 * step * direction
                    if self._separate(trial, normals):
                        axis = f"{'+' if direction.sum() > 0 else '-'}{'xyz'[int(np.abs(direction).argmax())]}"
                        return (
                            f"{given}move {self.names[i]} by {step} mm along {axis}: then the distances differ enough"
                        )
        return f"{given}arrange the discs so that no two distances are alike, or add a tag"

    def _separate(self, points: Array, normals: Array) -> bool:
        """Whether no disc may be taken for another, with a margin of a tenth, were they at other positions."""
        if float(pdist(points).min()) < (2 + SURROUND) * float(self.discs.radii_m.max()):
            return False
        sigma = self.sigma_px(self.far_m)
        return all(
            separation(self.rig, points, normals, one, self.far_m, sigma) >= 1.1 * SEPARATED_SIGMAS
            for seen in self.seen_together
            for one in symmetries(points, self.alike, seen, self.tolerance_m)
        )


def _single_camera(search: _Search) -> list[Finding]:
    points = search.points
    if flat(points, _FLAT_M):
        text = "a flat body has two poses that one camera alone hardly distinguishes; two cameras do"
        return [Finding("note", "single", text)]
    if not (mirrored := symmetries(points, search.alike, np.arange(len(points)), 1e-3, mirrored=True)):
        return []
    what = ambiguity_text(mirrored[0], search.names)
    return [Finding("note", "mirror", f"{what} is its mirror image: harmless to two cameras, not to one alone")]
