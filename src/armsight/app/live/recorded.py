"""What was recorded: every table in the session's folder, any column of it over time, and all of it at one moment."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

from armsight.app.live.records import asked
from armsight.app.live.step import PageStep, Shared
from armsight.errors import InputError
from armsight.files import is_long, long_rows, read_table

MOST_FILES = 60  # newest tables that are listed; half: of many runs the first are missing, double: a long list
MOST_POINTS = 1000  # of a curve on the page; half: short events are missed, double: a slow page
_MOST_ROWS = 20_000  # of a long table; half: the slider is coarse, double: twice the memory
_LOOK_S = 2.0  # between two looks for new files; half, double: nothing
TIMES = ("t_s", "time_s")  # columns that are times, s; the first there is goes across


@dataclass(frozen=True)
class RecordedState:
    """What a page shows of a recording."""

    files: tuple[str, ...] = ()  # relative to the folder, the newest first
    file: str = ""
    fields: tuple[str, ...] = ()  # its columns of numbers
    field: str = ""  # the one that is drawn
    across: str = "row"  # what goes across
    points: tuple[tuple[float, float | None], ...] = ()  # of the field
    rows: int = 0
    row: int = 0  # the one whose values are shown
    at: float = 0.0  # where it is across
    values: tuple[tuple[str, str], ...] = ()  # of all columns in that row, as in the file
    command: str = ""  # the command line that draws the same


class RecordedStep(PageStep[RecordedState]):
    """Shows one table at a time."""

    def __init__(self, shared: Shared) -> None:
        super().__init__(shared, RecordedState())
        self._head: list[str] = []
        self._rows: list[list[str]] = []
        self._looked_s = -math.inf

    @asked("recorded")
    def open_recorded(self, file: str) -> None:
        """Open one of the tables in the folder."""
        if file not in self._files():
            raise InputError(f"no table {file[:80]!r} in {self.folder}")
        self.later(f"{file} is not shown", self._open, file)

    @asked("recorded")
    def plot_field(self, field: str) -> None:
        """Draw another column."""
        with self.lock:
            if field not in self.shown.fields:
                raise InputError(f"no column {field[:40]!r}; there are {', '.join(self.shown.fields) or 'none'}")
            self._draw(field)

    @asked("recorded")
    def show_row(self, row: float) -> None:
        """Show the values of a row, counted from 0."""
        with self.lock:
            if not 0 <= row < len(self._rows):
                raise InputError(f"no row {row:g}; there are {len(self._rows)}")
            k = int(row)
            values = tuple(zip(self._head, self._rows[k], strict=False))
            self.show(row=k, at=self._across(k), values=values)

    def now(self) -> RecordedState:
        """Return what is shown, with the files that have come meanwhile."""
        if time.monotonic() - self._looked_s > _LOOK_S:
            self._looked_s = time.monotonic()
            self.show(files=self._files())
        shown = self.shown
        over = "" if shown.across == "row" else f"x='{shown.across}', "
        drawn = f"plot({over}y='{shown.field}').figure.savefig('{shown.field}.png')"
        command = f"python -c \"import pandas; pandas.read_csv('{self.folder / shown.file}').{drawn}\""
        return replace(shown, command=command if shown.field else "")

    def _files(self) -> tuple[str, ...]:
        found = [path for form in ("*.csv", "*/*.csv") for path in self.folder.glob(form) if path.is_file()]
        newest = sorted(found, key=lambda path: (-path.stat().st_mtime, str(path)))[:MOST_FILES]
        return tuple(str(path.relative_to(self.folder)) for path in newest)

    def _open(self, file: str) -> None:
        head, *rows = _table(self.folder / file) or [[]]
        numeric = [any(_number(row, k) is not None for row in rows) for k in range(len(head))]
        fields = tuple(name for name, holds in zip(head, numeric, strict=True) if holds and name not in TIMES)
        with self.lock:
            self._head, self._rows = head, rows
            drawn = self.shown.field if self.shown.field in fields else (*fields, "")[0]
            across = next((name for name in TIMES if name in head), "row")
            self.show(file=file, fields=fields, rows=len(rows), across=across)
            self._draw(drawn)
            if rows:
                self.show_row(0.0)

    def _across(self, row: int) -> float:
        """Return where a row is across, its number where it has no time."""
        name = self.shown.across
        found = None if name == "row" else _number(self._rows[row], self._head.index(name))
        return float(row) if found is None else found

    def _draw(self, field: str) -> None:
        every = max(1, math.ceil(len(self._rows) / MOST_POINTS))
        k = self._head.index(field) if field else -1
        points = [(self._across(row), _number(self._rows[row], k)) for row in range(0, len(self._rows), every)]
        self.show(field=field, points=tuple(points) if field else ())


def _table(path: Path) -> list[list[str]]:
    if not is_long(path):
        return read_table(path)
    every = math.ceil(sum(1 for _ in long_rows(path)) / _MOST_ROWS)
    return list(itertools.islice(long_rows(path), 0, None, every))


def _number(row: list[str], column: int) -> float | None:
    try:
        value = float(row[column])
    except (ValueError, IndexError):
        return None
    return value if math.isfinite(value) else None
