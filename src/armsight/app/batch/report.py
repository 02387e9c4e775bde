"""``armsight batch report``: which cells, arms or rigs differ from their siblings, and which change from day to day.

In: the tables of a batch. Out: a row a number and cell, arm or rig of a site: its median over the runs, how far it is off
the siblings', and how it changes a day; each with a chance that counts how many comparisons were made (Holm, Scand. J.
Statist. 6, 1979).
"""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau, theilslopes

from armsight.app.batch.run import RECORDINGS, SHOTS
from armsight.data import Array
from armsight.errors import InputError
from armsight.estimate.chance import chance_among
from armsight.files import as_input_error

#: Chance that a report names any cell of a site in which none differs; half: a difference must be larger, double: one
#: report in ten names one.
CHANCE = 0.05
#: cells that a spread needs; half: a spread of two values says nothing, double: small sites have no comparison.
_CELLS = 4
#: runs on different days that a trend needs; half: any two days make one, double: a week without a word.
_DAYS = 5
#: Where `armsight hub push` puts a run: SITE/DAY/CELL/RUN.
_PUSHED = re.compile(r"([^/]+)/(\d{4}-\d\d-\d\d)/([^/]+)/[^/]+(?:/[^/]+)?$")
#: Numbers of a shot -> what a run's median of them is called, and its unit's factor.
_OF_SHOTS = {
    "residual_rms_m": ("residual_mm", 1e3),
    "reprojection_rms_px": ("reprojection_px", 1.0),
    "misfit": ("misfit", 1.0),
}
MISSED = "missed"
#: By what runs are compared.
BY = ("cell", "arm", "rig")
#: Site, what of BY it is, and its name; and the numbers of their runs.
_Group = tuple[str, str, str]
_Groups = Mapping[_Group, Sequence[int]]


@dataclass(frozen=True)
class Compared:
    """One number of one cell, arm or rig; chances count the comparisons."""

    site: str
    by: str  #: one of BY
    name: str  #: of the cell or arm, or day and checksum of the rig
    metric: str  #: the number's name, with its unit
    runs: int  #: how many runs have it
    median: float  #: over its runs
    siblings: float | None  #: median of the others' medians
    chance: float | None  #: how probable a difference as large is where none differs; None without siblings
    per_day: float | None  #: its change a day; None where there are too few days
    chance_trend: float | None  #: how probable a change as steep is where none is

    @property
    def least(self) -> float:
        """The smaller chance of the two."""
        return min((each for each in (self.chance, self.chance_trend) if each is not None), default=1.0)

    @property
    def named(self) -> bool:
        """Whether somebody should look."""
        return self.least < CHANCE


@dataclass(frozen=True)
class _PushedRun:
    """One run: where it was made, its numbers, and how many of its shots missed."""

    site: str
    names: dict[str, str]  # of BY -> its name; an arm or a rig that is not known is left out
    day: int
    values: dict[str, float]
    missed: int
    shots: int


def report(folder: Path) -> list[Compared]:
    """Compare the cells, arms and rigs of a batch; the rows that name one are first.

    Arms or rigs are left out where they part the runs as cells do: the rows would be the same.

    Raises:
        InputError: it is no batch, or its recordings have no cells.
    """
    runs = list(_runs(folder))
    if not runs:
        raise InputError(
            f"{folder}: no recording lies as SITE/DAY/CELL/RUN, as armsight hub push has it: nothing to compare"
        )
    metrics, kinds = sorted({name for run in runs for name in run.values}), _grouped(runs)
    rows = [row for metric in metrics for groups in kinds for row in _compared(runs, metric, groups)]
    chances = _holm([*(row.chance for row in rows), *(row.chance_trend for row in rows)])
    rows = [replace(row, chance=chances[n], chance_trend=chances[n + len(rows)]) for n, row in enumerate(rows)]
    return sorted(rows, key=lambda row: (not row.named, row.least, row.metric, BY.index(row.by), row.name))


def _grouped(runs: Sequence[_PushedRun]) -> Collection[_Groups]:
    """Return the runs of each cell, of each arm and of each rig; none that parts them as one before."""
    found = dict[frozenset[tuple[int, ...]], _Groups]()
    for by in BY:
        groups = defaultdict[_Group, list[int]](list)
        for n, run in enumerate(runs):
            if by in run.names:
                groups[run.site, by, run.names[by]].append(n)
        found.setdefault(frozenset(map(tuple, groups.values())), groups)
    return found.values()


def _runs(folder: Path) -> Iterator[_PushedRun]:
    """Read the runs of a batch, in its order."""
    from pyarrow import parquet

    with as_input_error(f"{folder}: no results of armsight batch are here", OSError, ValueError, why=True):
        recordings = parquet.read_table(folder / RECORDINGS).to_pylist()
        shots = parquet.read_table(folder / SHOTS)
    rows: dict[str, list[int]] = defaultdict(list)
    for number, name in enumerate(shots["recording"].to_pylist() if "recording" in shots.column_names else ()):
        rows[name].append(number)
    columns = {name: shots[name].to_numpy() for name in _OF_SHOTS if name in shots.column_names}
    status = np.array(shots["status"].to_pylist()) if "status" in shots.column_names else np.zeros(0, str)
    for recording in recordings:
        where = _PUSHED.search(recording["recording"])
        if where is None or recording["status"] != "ok":
            continue
        own = rows[recording["recording"]]
        values = {
            name: factor * float(np.nanmedian(columns[key][own]))
            for key, (name, factor) in _OF_SHOTS.items()
            if key in columns and own and np.isfinite(columns[key][own]).any()
        }
        values |= _of_result(json.loads(recording.get("result") or "{}"))
        missed = int((status[own] != "ok").sum())
        if own:
            values[MISSED] = missed / len(own)
        names = {"cell": where[3], **{by: recording[by] for by in BY[1:] if recording.get(by)}}
        yield _PushedRun(where[1], names, date.fromisoformat(where[2]).toordinal(), values, missed, len(own))


def _of_result(found: Any, name: str = "") -> dict[str, float]:  # noqa: ANN401 - whatever JSON holds
    """Return the numbers of a result by their names, joined by dots; of one with its uncertainty the number alone."""
    if isinstance(found, dict):
        found = found.get("clean", found.get("value", found))
    if isinstance(found, dict):
        return {k: x for key, each in found.items() for k, x in _of_result(each, f"{name}.{key}".strip(".")).items()}
    known = isinstance(found, int | float) and not isinstance(found, bool) and math.isfinite(found)
    return {name: float(found)} if known else {}


def _compared(runs: Sequence[_PushedRun], metric: str, groups: _Groups) -> Iterator[Compared]:
    """Compare one number of the cells, arms or rigs of each site."""
    having = {key: [runs[n] for n in own if metric in runs[n].values] for key, own in groups.items()}
    cells = {key: own for key, own in having.items() if own}
    medians = {key: _median(own, metric) for key, own in cells.items()}
    for key, own in sorted(cells.items()):
        others = [each for each in medians if each[0] == key[0] and each != key]
        values, least = np.array([medians[key], *(medians[each] for each in others)]), 0.0
        if metric == MISSED:  # an angle whose scatter by chance alone does not depend on the share (Anscombe)
            values, least = np.arcsin(np.sqrt(values)), 0.5 / math.sqrt(sum(run.shots for run in own))
        chance = _chance(float(values[0]), values[1:], least) if len(others) >= _CELLS - 1 else None
        siblings = float(np.median([medians[each] for each in others])) if others else None
        yield Compared(*key, metric, len(own), medians[key], siblings, chance, *_trend(own, metric))


def _median(own: Sequence[_PushedRun], metric: str) -> float:
    """Return the median of runs; of missed shots the share of all together."""
    if metric == MISSED:
        return sum(run.missed for run in own) / sum(run.shots for run in own)
    return float(np.median([run.values[metric] for run in own]))


def _chance(value: float, others: Array, least: float) -> float | None:
    """Return how probable a value as far off its siblings (N,) is; ``least``: sigma of the value by itself."""
    middle = float(np.median(others))
    off = (value - middle) / math.sqrt(1.0 + math.pi / (2 * len(others)))  # the median is uncertain, too
    sigma, chance = chance_among(off, others - middle, least)
    return chance if sigma > 0.0 else None


def _trend(own: Sequence[_PushedRun], metric: str) -> tuple[float | None, float | None]:
    """Return a number's change a day, by the median of slopes of the days' medians, and its chance by Kendall's tau."""
    days: dict[int, list[float]] = defaultdict(list)
    for run in own:
        days[run.day].append(run.values[metric])
    day, value = np.array(sorted(days), float), np.array([float(np.median(days[each])) for each in sorted(days)])
    if len(day) < _DAYS or not np.ptp(value) > 0.0:
        return None, None
    return float(theilslopes(value, day)[0]), float(kendalltau(day, value).pvalue)


def _holm(chances: Sequence[float | None]) -> list[float | None]:
    """Return chances with the number of comparisons taken into account."""
    known = sorted((chance, n) for n, chance in enumerate(chances) if chance is not None and not math.isnan(chance))
    found: list[float | None] = [None] * len(chances)
    largest = 0.0
    for rank, (chance, n) in enumerate(known):
        largest = max(largest, min(1.0, chance * (len(known) - rank)))
        found[n] = largest
    return found


def lines(rows: Sequence[Compared], most: int = 30) -> list[str]:
    """Return the report for a terminal."""
    cells, named = {(row.site, row.name) for row in rows if row.by == "cell"}, [row for row in rows if row.named]
    runs = max(row.runs for row in rows if row.by == "cell")
    said = [f"{len(cells)} cells, up to {runs} runs each, {len(rows)} comparisons: {len(named)} rows differ or change"]
    for row in named[:most]:
        off = (
            f"{row.median:.4g}, its siblings {row.siblings:.4g} (chance {row.chance:.1g})"
            if row.chance is not None
            else ""
        )
        trend = f"{row.per_day:+.3g} a day (chance {row.chance_trend:.1g})" if row.chance_trend is not None else ""
        name = row.name if row.by == "cell" else f"{row.by} {row.name}"
        said.append(f"{row.site}/{name} {row.metric}: {'; '.join(filter(None, (off, trend)))}")
    others = " or ".join(by for by in BY if any(row.by == by for row in rows))
    return said if named else [*said, f"no {others} differs from its siblings by more than chance"]


def to_json(rows: Sequence[Compared]) -> dict[str, Any]:
    """Return the report for programs."""
    return {"rows": [{**asdict(row), "named": row.named} for row in rows], "chance": CHANCE}
