"""What may be wrong with cameras and body: a table of causes, each with its directions and its words.

In: the parameters of :mod:`armsight.loop.health.shots`. Out: D directions of what may change, in units of wide priors: of
the right camera's pose five (translation across the baseline, which does not change the scale, and rotation), the size of
the body over the baseline, the skew, the focal lengths against each other and together, each point, and smooth
deformations of the body (elongation, shear, bending). A cause is some of these directions; size of body and length of
baseline have the same effect, so which of them is wrong cannot be distinguished.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from armsight.data import Array, Body, Ids
from armsight.estimate.change import Hypotheses
from armsight.loop.finding import HealthFinding
from armsight.loop.health.shots import FURTHEST_M, UNKNOWN_SHARE, ShotModel, free_directions

Kind = Literal["rig", "body", "time", "focal", "focals", "point", "smooth", "seven", "points"]

#: Rows of the directions: the right camera's rotation, the size, the skew, the focal lengths, the first point.
ROTATION, SCALED, SKEWED, FOCAL, POINTS = slice(2, 5), 5, 6, 7, 9
#: Priors so wide that they decide nothing: m, rad, scale, s; of the focal lengths, as a share.
_WIDE, _WIDE_FOCAL = (0.1, 0.1, 1.0, 1.0, 1.0, 1.0, 0.1), 0.05
#: Shares of the wide priors that are tried, the one of the largest evidence counts; half: a decade apart, small changes are
#: named a test later.
_WIDTHS = (1.0, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0003)
#: Strain, shear and what bending adds at the body's edge, as a share of its radius: widths of their priors; half: an
#: elongation of 0.3 % is found later, double: one of 0.1 % is.
_STRAINS = (1e-3, 4e-3)
#: All points may be displaced by about so much, m: they widen poses.
_BENT_M = (2e-4, 1e-3)
#: Probability, before a test, that it is the first one after any change; that something is wrong from the beginning, as a
#: calibration or a print is.
_RARE, _WRONG = 1e-4, 0.1


class Cause(NamedTuple):
    """A row of the table.

    Attributes:
        kind: what changes.
        hypotheses: its directions and the widths that are tried; of points one for each.
        wrong: probability that it is so from the beginning.
        lasting: whether it must be seen from several directions, and in two tests, before it is said.
        said: whether it is said; else it widens poses only.
    """

    kind: Kind
    hypotheses: Hypotheses
    wrong: float = _RARE
    lasting: bool = False
    said: bool = True

    def chance(self, *, begins: bool) -> float:
        """Return the probability of it before anything is seen, where it began in a run, or stands from its beginning."""
        return _RARE if begins and self.kind != "smooth" else self.wrong


@dataclass(frozen=True, eq=False)
class Table:
    """The causes, and their directions.

    Attributes:
        causes: they.
        F: (K, D) what the directions change of the parameters, in units of the priors.
        wide: (D,) widths of the priors: m, rad, shares, s.
        names: of the points.
        smooth: (3 N, 27) smooth deformations of the points, m.
    """

    causes: tuple[Cause, ...]
    F: Array
    wide: Array
    names: tuple[str, ...]
    smooth: Array

    @classmethod
    def of(cls, shots: ShotModel, body: Body, *, printed: bool) -> Table:
        """Return the table of cameras and a body; of a print whose shape was calibrated no points are tested."""
        count, n = shots.rig.parameter_count, len(shots.points)
        first = POINTS + 3 * n
        wide = np.array([*_WIDE, _WIDE_FOCAL, _WIDE_FOCAL, *[FURTHEST_M] * (3 * n), *[1.0] * 27])
        F = np.zeros((shots.size, len(wide)))
        F[:count, :5] = free_directions(shots.rig)
        F[count, SCALED] = F[-1, SKEWED] = 1.0
        F[:, FOCAL : FOCAL + 2] = focal_changes(shots)
        F[count + 1 : count + 1 + 3 * n, POINTS:first] = np.eye(3 * n)
        smooth = _smooth(np.asarray(body.points, float)[shots.points])
        F[count + 1 : count + 1 + 3 * n, first:] = smooth

        def one(rows: Sequence[int] | Ids, widths: Sequence[float] = _WIDTHS) -> Hypotheses:
            return Hypotheses(np.tile(np.asarray(rows, int), (len(widths), 1)), np.array(widths))

        every = np.arange(POINTS, first)
        causes = [
            Cause("rig", one(range(5)), _WRONG),
            Cause("body", one([SCALED]), _WRONG),
            Cause("time", one([SKEWED]), _WRONG),
            Cause("focal", one([FOCAL]), _WRONG, said=False),  # compared with what passes, and said there
            Cause("focals", one([FOCAL + 1]), _WRONG, lasting=True),
            Cause("seven", one(range(7)), _WRONG, said=False),
        ]
        if not printed:
            causes += [
                Cause("smooth", one(first + np.arange(9), _STRAINS), _WRONG, lasting=True),
                Cause("smooth", one(first + np.arange(27), _STRAINS), _WRONG, lasting=True),
            ]
        if not printed and len(body.points) == n:
            causes += [
                Cause("point", Hypotheses(every.reshape(n, 3), np.ones(n)), lasting=True),
                Cause("points", one(every, [each / FURTHEST_M for each in _BENT_M]), said=False),
            ]
        names = tuple(body.point_names[k] for k in shots.points)
        return cls(tuple(causes), F * wide, wide, names, smooth)


def focal_changes(shots: ShotModel) -> Array:
    """Return (K, 2) what relative changes of the focal lengths change: against each other by half each, and of both."""
    rig, changes = shots.rig, np.zeros((shots.size, 2))
    right = rig.left.parameters.size
    changes[:2], changes[right : right + 2] = rig.left.intrinsics[:2, None], rig.right.intrinsics[:2, None]
    return changes * [0.5, 1.0] * np.where(np.arange(shots.size) < right, 1.0, [[-1.0], [1.0]]).T


def _smooth(points: Array) -> Array:
    """Return (3 N, 27) smooth deformations of points (N, 3), m: strains (9: by coordinate, direction) and bends (18).

    The former are motions of rows of a matrix that multiplies the points, the latter products of two coordinates; each is
    a share of the body's radius at a point so far out.
    """
    from_middle = points - points.mean(axis=0)
    radius = float(np.linalg.norm(from_middle, axis=1).max())
    u = from_middle / radius
    i, k = np.triu_indices(3)
    bends = u[:, i] * u[:, k]
    by = np.hstack([u, bends - bends.mean(axis=0)])
    return np.asarray(radius * np.einsum("nk,ij->nikj", by, np.eye(3)).reshape(3 * len(points), -1))


class Found(NamedTuple):
    """Causes that were found to explain what changed, the one that explains most first.

    Attributes:
        kinds: of them, and of a point its row among the points (else 0).
        value: (D,) of all directions, m, rad, shares, s.
        cov: (D, D) its covariance.
        begin_s: since when, s.
        alike: what explains nearly as much as the first: kind and row of a point.
        evidence: twice the log-evidence of the first.
        lasting: whether it had to be seen in two tests.
    """

    kinds: tuple[tuple[Kind, int], ...]
    value: Array
    cov: Array
    begin_s: float
    alike: tuple[tuple[Kind, int], ...]
    evidence: float
    lasting: bool


#: What cannot be excluded besides.
_OTHER: dict[Kind, str] = {
    "rig": "a rotation of one camera",
    "body": "a body of another size",
    "time": "cameras that expose apart",
    "focals": "focal lengths that changed alike",
}
_CAUSES: dict[Kind, Any] = {"focals": "lens", "point": "body", "smooth": "body", "points": "body"}


def findings(
    found: Found, table: Table, since_s: float | None, cost_mm: Callable[[Sequence[int]], float]
) -> list[HealthFinding]:
    """Return what is said of causes; ``cost_mm`` returns by how much rows of the directions displace poses, mm."""
    said = list[HealthFinding]()
    points = [row for kind, row in found.kinds if kind == "point"]
    for kind in dict.fromkeys(kind for kind, _ in found.kinds):
        words, rows = _WORDS[kind]
        one = words(found, table, points)
        columns = np.concatenate([_point(each) for each in points]) if kind == "point" else np.r_[rows]
        others = [each for each, _ in found.alike if each not in ("point", kind)] if len(found.kinds) == 1 else []
        unsure = " or ".join(dict.fromkeys(_OTHER[each] for each in others if each in _OTHER))
        causes = (*one.alternatives, *(_CAUSES.get(each, each) for each in others))
        alternatives = tuple(dict.fromkeys(each for each in causes if each != one.cause))
        what = f"{one.what}; {unsure} cannot be excluded" if unsure else one.what
        said.append(replace(one, what=what, since_s=since_s, alternatives=alternatives, cost_mm=cost_mm(list(columns))))
    return said


def _point(row: int) -> Ids:
    """Return the directions of a point."""
    return POINTS + 3 * row + np.arange(3)


def _along(found: Found, rows: slice | Ids) -> tuple[float, float]:
    """Return the length of some directions together, and its standard deviation."""
    value = found.value[rows]
    size = float(np.linalg.norm(value))
    along = value / size if size > 0.0 else value
    return size, float(np.sqrt(along @ found.cov[rows][:, rows] @ along))


def _sized(found: Found, row: int) -> tuple[float, float]:
    """Return a direction and its standard deviation."""
    return float(found.value[row]), float(np.sqrt(found.cov[row, row]))


def _rig(found: Found, table: Table, points: Sequence[int]) -> HealthFinding:
    size, sigma = np.degrees(_along(found, ROTATION)).tolist()
    moved_mm = 1e3 * float(np.linalg.norm(found.value[:2]))
    what = (
        f"the right camera is rotated by {size:.3f} deg and shifted by {moved_mm:.2f} mm against the left one, compared "
        "with the calibration"
    )
    return HealthFinding("rig", what, None, size, sigma, "deg", "fasten the cameras and calibrate the rig again")


def _body(found: Found, table: Table, points: Sequence[int]) -> HealthFinding:
    size, sigma = (100.0 * each for each in _sized(found, SCALED))
    what = (
        f"the body looks {abs(size):.2f} % {'larger' if size > 0 else 'smaller'} than its file says: the body file or the "
        "baseline of the rig is wrong, and the two cannot be distinguished"
    )
    advice = "measure the distances on the body with calipers; if they agree with its file, calibrate the rig again"
    return HealthFinding("body", what, None, size, sigma, "%", advice)


def _time(found: Found, table: Table, points: Sequence[int]) -> HealthFinding:
    size, sigma = (1e3 * each for each in _sized(found, SKEWED))
    what = (
        f"the right camera exposes {abs(size):.2f} ms {'later' if size > 0 else 'earlier'} than is known, against the left "
        "one"
    )
    advice = "trigger both cameras together; in a recording --skew find moves the detections to one time"
    # The velocity is that of measured poses.
    sigma = float(np.hypot(sigma, 0.5 * UNKNOWN_SHARE * size))
    return HealthFinding("time", what, None, size, sigma, "ms", advice)


def _focals(found: Found, table: Table, points: Sequence[int]) -> HealthFinding:
    share, sigma = (100.0 * each for each in _sized(found, FOCAL + 1))
    what = f"the focal lengths of both cameras are {abs(share):.3f} % {'longer' if share > 0 else 'shorter'} than calibrated"
    advice = "fasten focus and zoom of both lenses, let the cameras warm up, and calibrate the rig again"
    return HealthFinding("lens", what, None, abs(share), sigma, "%", advice)


def _points(found: Found, table: Table, points: Sequence[int]) -> HealthFinding:
    sizes = {row: _along(found, _point(row)) for row in points}
    largest = max(points, key=lambda row: sizes[row][0])
    size, sigma = (1e3 * each for each in sizes[largest])
    if len(points) > 1:
        names = ", ".join(f"{table.names[row]} by {1e3 * each:.2f} mm" for row, (each, _) in sizes.items())
        what = f"the body is bent, or points of it moved: against the others {names} are not where its file says"
    else:
        others = [table.names[row] for kind, row in found.alike if kind == "point"]
        unsure = f"; it may be {' or '.join(others)} instead" if others else ""
        what = (
            f"{table.names[points[0]]} is displaced by {size:.2f} mm on the body against its file: it moved, or is partly "
            f"covered{unsure}"
        )
    advice = "look at these points; clean or fasten them, and measure the body again (armsight body)"
    return HealthFinding("body", what, None, size, sigma, "mm", advice)


def _strained(found: Found, table: Table, points: Sequence[int]) -> HealthFinding:
    """Of a body that is strained or bent: how far a point is displaced at most, motions apart."""
    n = len(table.names)
    value, basis = table.smooth @ found.value[-27:], table.smooth[:, :9]
    cov = table.smooth @ found.cov[-27:, -27:] @ table.smooth.T
    rigid = np.linalg.lstsq(basis, value, rcond=1e-9)[0].reshape(3, 3)
    spin = (basis @ (0.5 * (rigid - rigid.T)).ravel()).reshape(-1, 3)
    shifts = value.reshape(n, 3) - spin
    shifts -= shifts.mean(axis=0)
    sizes = np.linalg.norm(shifts, axis=1)
    k = int(sizes.argmax())
    along = shifts[k] / sizes[k]
    strain = 50.0 * float(np.ptp(np.linalg.eigvalsh(rigid + rigid.T)))
    what = (
        f"the body is elongated, sheared or bent against its file: its lengths differ by {strain:.2f} % from one direction "
        f"to another, {table.names[k]} is displaced by {1e3 * sizes[k]:.2f} mm"
    )
    advice = (
        "measure the body along two directions and both diagonals with calipers, or take its shape from images (armsight "
        "body); printers are off along one axis"
    )
    sigma = float(np.sqrt(along @ cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ along))
    return HealthFinding("body", what, None, 1e3 * float(sizes[k]), 1e3 * sigma, "mm", advice)


_WORDS: dict[Kind, tuple[Callable[[Found, Table, Sequence[int]], HealthFinding], slice]] = {
    "rig": (_rig, slice(0, 5)),
    "body": (_body, slice(SCALED, SCALED + 1)),
    "time": (_time, slice(SKEWED, SKEWED + 1)),
    "focals": (_focals, slice(FOCAL + 1, FOCAL + 2)),
    "point": (_points, slice(0)),
    "smooth": (_strained, slice(-27, 0)),
}


def nod_finding(cov: Array, cost_m: float) -> HealthFinding:
    """Return the finding of a camera that nods, of the covariance (3, 3) of its rotation, rad."""
    size = float(np.degrees(np.sqrt(np.trace(cov))))
    what = (
        f"a camera nods: within a second the right one rotates by {size:.3f} deg (RMS) to and fro against the left one; "
        "which of the two moves cannot be distinguished"
    )
    sigma = 0.1 * float(np.degrees(np.sqrt(np.linalg.eigvalsh(cov)[-1])))
    advice = "fasten the cameras on one stiff bar, away from what vibrates; poses have this in their sigma"
    return HealthFinding("rig", what, None, size, sigma, "deg", advice, cost_mm=1e3 * cost_m)


def breathing_finding(cov: Array, cost_m: float) -> HealthFinding:
    """Return the finding of a lens that breathes, of the covariance (4, 4) of rotation and focal length."""
    size = 100.0 * float(np.sqrt(cov[3, 3]))
    what = (
        f"a lens breathes: within a second the focal length of one camera changes by {size:.3f} % (RMS) to and fro against "
        "that of the other; which of the two cannot be distinguished"
    )
    advice = "switch autofocus and image stabilisation off, fasten focus and zoom; poses have this in their sigma"
    return HealthFinding("lens", what, None, size, 0.1 * size, "%", advice, ("rig",), cost_mm=1e3 * cost_m)


def lens_finding(size_px: tuple[float, float], needed: Sequence[Any], cost_m: float) -> HealthFinding:
    """Return the finding of camera models that lack something: RMS and sigma, and the causes that are needed besides."""
    besides = "; a change of the cameras, the body or their times cannot be excluded" if needed else ""
    what = (
        f"residuals of {size_px[0]:.3f} px RMS depend on the position in the images alone, which the model of the cameras "
        f"cannot express{besides}"
    )
    advice = (
        "calibrate again with a richer lens model and with targets over the whole of both images; look for a lens that is "
        "loose or behind a window"
    )
    return HealthFinding("lens", what, None, *size_px, "px", advice, tuple(needed), cost_mm=1e3 * cost_m)


def of_one_pose(found: HealthFinding) -> HealthFinding:
    """Return a finding that rests on one pose, with what looks the same."""
    same = "or the two images do not belong together (another pair's, or the body moved between them); one pose leaves both open"
    advice = f"measure more poses; if all say so, {found.advice}"
    return replace(found, what=f"{found.what}; {same}", advice=advice, alternatives=("time",))
