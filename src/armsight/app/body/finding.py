"""What is said of a body before it is built, as records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armsight.data import Array, Record
from armsight.vision.discs.symmetry import Relabeling

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
class Outlook(Record):
    """How well a body is known at a distance.

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
    def turn_deg(self) -> tuple[float, float]:
        """Standard deviation of the rotation, degrees: the worst axis across (tilt), and about the direction of depth."""
        return _across_and_along(self.cov[3:, 3:] * np.degrees(1.0) ** 2, self.forward)


@dataclass(frozen=True, eq=False)
class Swap(Record):
    """Discs that may be taken for others.

    Attributes:
        relabeling: which for which.
        told: (D,) by how many standard deviations it misses at each distance; infinite where the discs' faces tell, NaN
            where these discs are not in view.
        behind: whether it shows the other side of a flat body, so that normals settle it.
    """

    relabeling: Relabeling
    told: Array
    behind: bool

    @property
    def by_side(self) -> bool:
        """Whether the normals alone settle it."""
        return bool(np.isinf(self.told).any() and not np.isfinite(self.told).any())


@dataclass(frozen=True, eq=False)
class Verdict(Record):
    """All that is said of a body.

    Attributes:
        outlooks: one for each distance.
        swaps: what may be taken for what where all discs of a side are in view, whether or not it is told apart.
        findings: in words.
    """

    outlooks: tuple[Outlook, ...]
    swaps: tuple[Swap, ...]
    findings: tuple[Finding, ...]

    @property
    def word(self) -> str:
        """The verdict: usable, ambiguous or unusable."""
        bad = {finding.kind for finding in self.findings if finding.grade == "bad"}
        return "unusable" if bad - {"ambiguous"} else "ambiguous" if bad else "usable"


def _across_and_along(cov: Array, forward: Array) -> tuple[float, float]:
    """Return the largest standard deviation square to a direction, and that along it."""
    if not np.isfinite(cov).all():
        return np.nan, np.nan
    P = np.eye(3) - np.outer(forward, forward)
    across = np.linalg.eigvalsh(P @ cov @ P)[-1]
    return float(np.sqrt(max(across, 0.0))), float(np.sqrt(forward @ cov @ forward))
