"""What a health monitor found: the record, its JSON and its line for people."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from typing import Any, Literal

import numpy as np

from armsight.data import Array
from armsight.estimate.chance import chi_square_limit

#: rig: one camera against the other; body: the body, or what looks the same; fixed: the rig against the arm's base;
#: time: shots that are not of one time; lens: what the model of the cameras cannot express; joint: a potentiometer that
#: slipped, backlash that grew; estimator: measurements that contradict what it had learned, without another cause; host:
#: images that are delivered twice.
Cause = Literal["rig", "body", "fixed", "time", "lens", "joint", "estimator", "host"]
#: Probability of a false alarm of each test within a minute, while its noise model holds.
FALSE_ALARMS_PER_MINUTE = 1e-4
#: Chance of a test below which it widens poses; half: a change costs NEES for longer, double: healthy poses are too
#: wide.
SUSPECTED = 0.02
#: What displaces the tool by less, m, forbids no result. Half: webcams' processing is said, double: a stand's shaking
#: not.
COSTS_M = 1e-4
#: A rotation counts by what it does at this distance from the body's origin, m.
LEVER_M = 0.1

#: What changes in the words of a finding while it is the same: 1.24, and 3 of 9; the number of a joint does not.
_MEASURED = re.compile(r"\d+\.\d+|\d+ of \d+")


class Trust(Enum):
    """How far a loop may rely on the poses that vision measures."""

    FULL = "nothing is suspected"
    DOUBTED = "measured poses contradict what was learned, and the cause is not known yet"
    NONE = "what vision measures is wrong: the cameras, the rig or the body moved"


@dataclass(frozen=True)
class HealthFinding:
    """Something that no longer holds, and because of which results must not be trusted.

    Attributes:
        cause: what is wrong: rig, body, fixed, time, lens, joint, estimator, host.
        what: what was found, one sentence.
        since_s: since when, s on the clock of the shots; None where the shots have no times.
        size: by how much, in ``unit``.
        sigma: standard deviation of the size.
        unit: deg, mm, px, %, ms, or measurements.
        advice: what to do.
        alternatives: other causes that explain it nearly as well.
        corrected_s: when it was put right, s; None where it was not.
        cost_mm: by how much it displaces the tool, or what is measured, at most so far, mm; None where that is not known.
        pose_sigma_mm: sigma of measured positions, as without what was found, the least since, mm; None without a pose.
    """

    cause: Cause
    what: str
    since_s: float | None
    size: float
    sigma: float
    unit: str
    advice: str
    alternatives: tuple[Cause, ...] = ()
    corrected_s: float | None = None
    cost_mm: float | None = None
    pose_sigma_mm: float | None = None

    @property
    def subject(self) -> tuple[str, str]:
        """What it is about: its cause, and its words before it says by how much, without measured numbers and counts."""
        return self.cause, _MEASURED.sub("", self.what.partition(" by ")[0])

    def since(self, before: HealthFinding | None) -> HealthFinding:
        """Return it with the largest cost and the least sigma since it was found before: ``forbids`` does not flicker."""
        if before is None:
            return self
        costs, sigmas = (
            [each for each in both if each is not None]
            for both in ((self.cost_mm, before.cost_mm), (self.pose_sigma_mm, before.pose_sigma_mm))
        )
        cost_mm = None if self.cost_mm is None else max(costs)
        return replace(self, cost_mm=cost_mm, pose_sigma_mm=min(sigmas, default=None))

    @property
    def forbids(self) -> bool:
        """Whether results must not be trusted because of it: not where it displaces them by less than is known of them."""
        return self.cost_mm is None or self.cost_mm > max(1e3 * COSTS_M, self.pose_sigma_mm or 0.0)

    def to_json(self) -> dict[str, Any]:
        """Return the object that summary.json and ``--json`` hold."""
        return asdict(self)

    def line(self) -> str:
        """Return the finding as one line for people."""
        since = "" if self.since_s is None else f" since {self.since_s:.1f} s"
        right = "" if self.corrected_s is None else f", put right at {self.corrected_s:.1f} s"
        costs = "" if self.cost_mm is None else f", which displaces poses by up to {self.cost_mm:.2f} mm"
        sigma = "" if not costs or self.pose_sigma_mm is None else f" (sigma {self.pose_sigma_mm:.2f} mm)"
        return f"{self.cause}: {self.what}{since}{costs}{sigma}{right}; {self.advice}"


def sized(x: Array, cov: Array) -> tuple[float, float]:
    """Return the length of a vector (n,), and its standard deviation by its covariance (n, n)."""
    size = float(np.linalg.norm(x))
    along = x / max(size, 1e-12)
    return size, float(np.sqrt(along @ cov @ along))


def displacement_m(shift: Array) -> Array:
    """Return by how much tangents (..., 6), or roots of variances, displace the tool, m: rotations at ``LEVER_M``."""
    return np.asarray(np.linalg.norm(shift[..., :3], axis=-1) + LEVER_M * np.linalg.norm(shift[..., 3:], axis=-1))


def health_lines(health: Sequence[HealthFinding]) -> list[str]:
    """Return the lines for a log, a terminal or a report: none where nothing was found."""
    meanwhile = {True: "this result", False: "what was measured meanwhile"}
    return [
        f"do not trust {meanwhile[found.corrected_s is None]}: {found.line()}"
        if found.forbids
        else f"note: {found.line()}"
        for found in health
    ]


def unseen_lines(names: Sequence[str]) -> list[str]:
    """Return the lines for a log or a terminal on fixed bodies that could not be watched."""
    return [
        f"the fixed body {name} was seen too rarely to be watched: both cameras must see it, as its file describes it"
        for name in names
    ]


def alarm_limit(freedom: int, tests_per_s: float, hypotheses: int = 1, estimated: int | None = None) -> float:
    """Return the chi-square of an alarm (Bonferroni); ``estimated``: degrees of freedom of the noise, if unknown."""
    chance = FALSE_ALARMS_PER_MINUTE / (60.0 * tests_per_s * hypotheses)
    if estimated is None:
        return chi_square_limit(freedom, chance)
    from scipy.special import fdtri  # not above: SciPy takes longer than a pair of images

    # The reciprocal of F, since chance is far below what 1 resolves.
    return freedom / float(fdtri(estimated, freedom, chance))
