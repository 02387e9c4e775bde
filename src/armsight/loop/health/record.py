"""What a health monitor found: the record, its JSON and its line for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any, Literal

from scipy.special import chdtri, fdtri

#: rig: one camera against the other; body: the body, or what looks the same; fixed: the rig against the arm's base;
#: time: shots that are not of one time; lens: what the model of the cameras cannot express; joint: a potentiometer that
#: slipped, backlash that grew; estimator: measurements that contradict what it had learned, without another cause; host:
#: images that are delivered twice.
Cause = Literal["rig", "body", "fixed", "time", "lens", "joint", "estimator", "host"]
#: Probability of a false alarm of each test within a minute, while its noise model holds.
FALSE_ALARMS_PER_MINUTE = 1e-4


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

    def to_json(self) -> dict[str, Any]:
        """Return the object that summary.json and ``--json`` hold."""
        return asdict(self)

    def line(self) -> str:
        """Return the finding as one line for people."""
        since = "" if self.since_s is None else f" since {self.since_s:.1f} s"
        right = "" if self.corrected_s is None else f", put right at {self.corrected_s:.1f} s"
        return f"{self.cause}: {self.what}{since}{right}; {self.advice}"


def health_lines(health: Sequence[HealthFinding]) -> list[str]:
    """Return the lines for a log, a terminal or a report: none where nothing was found."""
    return [
        f"do not trust {'this result' if found.corrected_s is None else 'what was measured meanwhile'}: {found.line()}"
        for found in health
    ]


def unseen_lines(names: Sequence[str]) -> list[str]:
    """Return the lines for a log or a terminal on fixed bodies that could not be watched."""
    return [
        f"the fixed body {name} was seen too rarely to be watched: both cameras must see it, as its file describes it"
        for name in names
    ]


def alarm_limit(freedom: int, tests_per_s: float, hypotheses: int = 1, estimated: int | None = None) -> float:
    """Return the chi-square of an alarm, so that FALSE_ALARMS_PER_MINUTE bounds the false ones (Bonferroni).

    Args:
        freedom: degrees of freedom.
        tests_per_s: how often the test is made.
        hypotheses: how many are tested each time.
        estimated: degrees of freedom from which the noise was estimated; None where it is known.
    """
    chance = FALSE_ALARMS_PER_MINUTE / (60.0 * tests_per_s * hypotheses)
    if estimated is None:
        return float(chdtri(freedom, chance))
    # The reciprocal of F, since chance is far below what 1 resolves.
    return freedom / float(fdtri(estimated, freedom, chance))
