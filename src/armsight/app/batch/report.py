"""``armsight batch report``: which cells of a batch differ from their siblings, and which change from day to day.

In: the tables of a batch. Out: a row a number and cell: its median over the runs, how far it is off the siblings', and
how it changes a day; each with a chance that counts how many comparisons were made (Holm, Scand. J. Statist. 6, 1979).
"""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
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


@dataclass(frozen=True)
class CellRow:
    """One number of one cell.

    Attributes:
        site: of the cell.
        cell: its name.
        metric: the number's name, with its unit.
        runs: how many runs have it.
        median: over its runs.
        siblings: median of the other cells' medians.
        chance: how probable a difference as large is where no cell differs, comparisons counted; None without siblings.
        per_day: its change a day; None where there are too few days.
        chance_trend: how probable a change as steep is where none is, comparisons counted.
    """

    site: str
    cell: str
    metric: str
    runs: int
    median: float
    siblings: float | None
    chance: float | None
    per_day: float | None
    chance_trend: float | None

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
    cell: str
    day: int
    values: dict[str, float]
    missed: int
    shots: int


def report(folder: Path) -> list[CellRow]:
    """Compare the cells of a batch; the rows that name one are first.

    Raises:
        InputError: it is no batch, or its recordings have no cells.
    """
    runs = list(_runs(folder))
    if not runs:
        raise InputError(
            f"{folder}: no recording lies as SITE/DAY/CELL/RUN, as armsight hub push has it: nothing to compare"
        )
    rows = [row for metric in sorted({name for run in runs for name in run.values}) for row in _compared(runs, metric)]
    chances = _holm([*(row.chance for row in rows), *(row.chance_trend for row in rows)])
    rows = [replace(row, chance=chances[n], chance_trend=chances[n + len(rows)]) for n, row in enumerate(rows)]
    return sorted(rows, key=lambda row: (not row.named, row.least, row.metric, row.cell))


def _runs(folder: Path) -> Iterator[_PushedRun]:
    """Read the runs of a batch, in its order."""
    from pyarrow import parquet

    try:
        recordings = parquet.read_table(folder / RECORDINGS).to_pylist()
        shots = parquet.read_table(folder / SHOTS)
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: no results of armsight batch are here: {error}") from None
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
        values |= _of_result(recording.get("result"))
        missed = int((status[own] != "ok").sum())
        if own:
            values[MISSED] = missed / len(own)
        yield _PushedRun(where[1], where[3], date.fromisoformat(where[2]).toordinal(), values, missed, len(own))


def _of_result(text: str | None) -> dict[str, float]:
    """Return the numbers at the top of a result of check or identify, and of its tables by name."""
    found: dict[str, float] = {}
    for key, value in json.loads(text or "{}").items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            found[key] = float(value)
        elif isinstance(value, dict):
            inner = {f"{key}.{name}": each for name, each in value.items()}
            found |= {
                name: float(x) for name, x in inner.items() if isinstance(x, int | float) and not isinstance(x, bool)
            }
    return found


def _compared(runs: Sequence[_PushedRun], metric: str) -> Iterator[CellRow]:
    """Compare one number of the cells of each site."""
    cells: dict[tuple[str, str], list[_PushedRun]] = defaultdict(list)
    for run in runs:
        if metric in run.values:
            cells[run.site, run.cell].append(run)
    medians = {key: float(np.median([run.values[metric] for run in own])) for key, own in cells.items()}
    if metric == MISSED:  # of all shots together
        medians = {key: sum(r.missed for r in own) / sum(r.shots for r in own) for key, own in cells.items()}
    for (site, cell), own in sorted(cells.items()):
        others = [key for key in medians if key[0] == site and key[1] != cell]
        values, least = np.array([medians[site, cell], *(medians[key] for key in others)]), 0.0
        if metric == MISSED:  # an angle whose scatter by chance alone does not depend on the share (Anscombe)
            values, least = np.arcsin(np.sqrt(values)), 0.5 / math.sqrt(sum(run.shots for run in own))
        chance = _chance(float(values[0]), values[1:], least) if len(others) >= _CELLS - 1 else None
        siblings = float(np.median([medians[key] for key in others])) if others else None
        slope, chance_trend = _trend(own, metric)
        yield CellRow(site, cell, metric, len(own), medians[site, cell], siblings, chance, slope, chance_trend)


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


def lines(rows: Sequence[CellRow], most: int = 30) -> list[str]:
    """Return the report for a terminal."""
    cells, named = {(row.site, row.cell) for row in rows}, [row for row in rows if row.named]
    runs = max(row.runs for row in rows)
    said = [f"{len(cells)} cells, up to {runs} runs each, {len(rows)} comparisons: {len(named)} rows differ or change"]
    for row in named[:most]:
        off = (
            f"{row.median:.4g}, its siblings {row.siblings:.4g} (chance {row.chance:.1g})"
            if row.chance is not None
            else ""
        )
        trend = f"{row.per_day:+.3g} a day (chance {row.chance_trend:.1g})" if row.chance_trend is not None else ""
        said.append(f"{row.site}/{row.cell} {row.metric}: {'; '.join(filter(None, (off, trend)))}")
    return said if named else [*said, "no cell differs from its siblings by more than chance"]


def to_json(rows: Sequence[CellRow]) -> dict[str, Any]:
    """Return the report for programs."""
    return {"rows": [{**asdict(row), "named": row.named} for row in rows], "chance": CHANCE}
