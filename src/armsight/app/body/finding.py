"""The records of a body's assessment: findings, predictions, ambiguities; the text for ambiguities, distances, axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armsight.data import Array, Body, Record
from armsight.vision.discs.symmetry import Symmetry
from armsight.vision.markers.body_layout import Layout

#: Within this angle a direction is given the name of an axis, cosine.
_ALONG = float(np.cos(np.radians(8.0)))


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


def axis_text(axis: Array, forward: Array, layout: Layout) -> str:
    """Name a direction (3,) of the body: one of its axes, the line of two markers, or numbers."""
    found = []
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if abs(axis @ unit) > _ALONG:
            found.append(f"the body's {name} axis")
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


Grade = Literal["bad", "weak", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing about a body.

    Attributes:
        grade: "bad" where the body cannot be used as it is, "weak" where it could be better, or "note".
        kind: what it is about, one word.
        text: what it is.
        change: what to do about it; empty where nothing need be done.
    """

    grade: Grade
    kind: str
    text: str
    change: str = ""


@dataclass(frozen=True, eq=False)
class Prediction(Record):
    """The predicted pose of a body at a distance.

    Attributes:
        distance_m: from the cameras, the body facing them.
        cov: (6, 6) predicted covariance of the pose, perturbation on the right; NaN where no pose is fixed.
        forward: (3,) direction of depth, body frame.
        disc_px: (2,) smallest and largest disc's diameter in the image; NaN where there are no discs.
    """

    distance_m: float
    cov: Array
    forward: Array
    disc_px: Array

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
    """Discs that may be taken for others.

    Attributes:
        symmetry: which for which.
        separation_sigmas: (D,) by how many standard deviations it misses at each distance; infinite where the discs' faces
            separate it, NaN where these discs are not in view.
        behind: whether it shows the other side of a flat body, so that normals settle it.
    """

    symmetry: Symmetry
    separation_sigmas: Array
    behind: bool

    @property
    def by_side(self) -> bool:
        """Whether the normals alone settle it."""
        return bool(np.isinf(self.separation_sigmas).any() and not np.isfinite(self.separation_sigmas).any())


@dataclass(frozen=True, eq=False)
class Assessment(Record):
    """The assessment of a body.

    Attributes:
        predictions: one for each distance.
        ambiguities: what may be taken for what where all discs of a side are in view, whether or not it is separated.
        findings: as text.
    """

    predictions: tuple[Prediction, ...]
    ambiguities: tuple[Ambiguity, ...]
    findings: tuple[Finding, ...]

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
