"""Limits of metrics: ``--limit AP=0.5mm`` says what an arm must hold, and every metric of that name passes or fails.

In: texts, and the metrics of a test as they are listed. Out: one :class:`LimitResult` a metric. The value that is compared
is the metric without the instrument's noise; of a metric that cannot be resolved the upper end of its interval, as no more
is known of it; without an interval the metric as measured.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from armsight.app.check.result import MEANINGS, MetricLine
from armsight.app.show.report import Fact
from armsight.errors import InputError

#: Unit -> how many of it are a metre.
_UNITS = {"m": 1.0, "mm": 1e3, "um": 1e6, "µm": 1e6}


@dataclass(frozen=True)
class LimitResult:
    """One metric against its limit; the fields are the keys of its JSON object.

    Attributes:
        metric: its name, a key of MEANINGS.
        of: what it is of.
        limit_m: the limit, m.
        value_m: what is compared with it, without its sign, m.
        passed: whether it is not above the limit.
        certain: whether all of the 95 % interval is on the same side of the limit; None where there is no interval.
    """

    metric: str
    of: str
    limit_m: float
    value_m: float
    passed: bool
    certain: bool | None

    def text(self) -> str:
        """Return the outcome as it stands behind the metric's line."""
        unsure = "" if self.certain is not False else ", within the interval"
        return f"{'PASS' if self.passed else 'FAIL'} (limit {1e3 * self.limit_m:g} mm{unsure})"


def read_limits(texts: Iterable[str]) -> dict[str, float]:
    """Read NAME=LENGTH texts, such as AP=0.5mm.

    Returns:
        Name of each metric -> its limit, m.

    Raises:
        InputError: an unknown name, a name given twice, or no positive length with a unit.
    """
    limits: dict[str, float] = {}
    for given in texts:
        name, _, length = given.partition("=")
        name = name.strip().replace("_", " ")
        if name not in MEANINGS:
            raise InputError(f"--limit {given}: unknown metric {name!r}; known are {', '.join(MEANINGS)}")
        if name in limits:
            raise InputError(f"--limit {given}: {name} has a limit already")
        match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(m|mm|um|µm)\s*", length)
        if match is None or not float(match[1]) > 0:
            raise InputError(f"--limit {given}: expected NAME=LENGTH with a unit, such as {name}=0.5mm")
        limits[name] = float(match[1]) / _UNITS[match[2]]
    return limits


def check_limits(lines: Sequence[MetricLine], limits: Mapping[str, float]) -> list[LimitResult | None]:
    """Compare metrics with their limits.

    Returns:
        An outcome for each line; None where its metric has no limit.

    Raises:
        InputError: a limit is of a metric that this test does not have.
    """
    known = list(dict.fromkeys(line.name for line in lines))
    for name in limits:
        if name not in known:
            raise InputError(f"--limit {name}: this test has no such metric; it has {', '.join(known)}")
    return [_compared(line, limits[line.name]) if line.name in limits else None for line in lines]


def _compared(line: MetricLine, limit_m: float) -> LimitResult:
    """Compare one metric with its limit."""
    m = line.metric
    ends = None if m.low is None or m.high is None else (m.low, m.high)
    known = m.raw if ends is None else max(map(abs, ends))
    value = abs(known if m.clean is None else m.clean)
    certain = None
    if ends is not None:
        largest = max(map(abs, ends))
        smallest = 0.0 if ends[0] <= 0 <= ends[1] else min(map(abs, ends))
        certain = largest <= limit_m or smallest > limit_m
    return LimitResult(line.name, line.what, limit_m, value, value <= limit_m, certain)


def all_compared(outcomes: Iterable[LimitResult | None]) -> Fact:
    """Return how many passed; nothing where there are no limits."""
    compared = [outcome for outcome in outcomes if outcome is not None]
    if not compared:
        return Fact()
    failed = sum(not each.passed for each in compared)
    said = f"\n{'FAIL' if failed else 'PASS'}: {failed} of {len(compared)} metrics with a limit are above it"
    return Fact(said, {"limits": compared, "passed": not failed})
