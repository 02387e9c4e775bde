"""What a hub keeps: events in a database, each once; states as Parquet by day and cell.

``DIR/events.sqlite`` has the tables ``events`` and ``cells``. ``DIR/states/day=.../cell=SITE.CELL/*.parquet`` is read
by DuckDB in one line (docs/howto/cells.md).
"""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections import defaultdict
from contextlib import ExitStack, closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from armsight.app.hub.cells import NUMBERS, CellView, number
from armsight.errors import InputError
from armsight.files import alone_in, as_input_error, replacing

#: s between two files of states of a cell; half: twice as many files, double: a crash loses twice as much history.
FLUSH_S = 600.0
#: s that a search may take; half: fewer old events are found, double: a tab costs twice.
_SEARCH_S = 1.0
#: events of a search at most; half: scroll less, double: a larger page.
_FOUND = 200
#: events that are kept; half: half the history and disk (0.3 GB), double: both twice.
_MOST = 1_000_000
#: Who reads does not wait, other programs too.
_BEGIN = """PRAGMA journal_mode = WAL;
CREATE TABLE IF NOT EXISTS events (site TEXT, cell TEXT, outbox TEXT, n INTEGER, t REAL, arrived REAL, kind TEXT,
    level TEXT, text TEXT, PRIMARY KEY (site, cell, outbox, n)) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS by_arrival ON events (arrived);
CREATE TABLE IF NOT EXISTS cells (site TEXT, cell TEXT, about TEXT, PRIMARY KEY (site, cell))"""


class Store:
    """Keeps events and states in a folder; an InputError says that it cannot, or that another hub uses it."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self._problems = {"events": "", "states": ""}
        with ExitStack() as opened:
            with as_input_error(f"{folder}: nothing can be kept here", sqlite3.Error, OSError, why=True):
                opened.enter_context(alone_in(folder, "hub"))
                self._db = sqlite3.connect(folder / "events.sqlite", timeout=5.0, check_same_thread=False)
                opened.callback(self._db.close)
                self._db.executescript(_BEGIN)
            self._opened = opened.pop_all()

    @property
    def problem(self) -> str:
        """What cannot be kept now, and why; empty where all is."""
        return "; ".join(filter(None, self._problems.values()))

    def add_events(self, site: str, cell: str, message: Any, arrived_s: float) -> int:  # noqa: ANN401 - whatever JSON holds
        """Store events of a cell, each once; return the number up to which they are stored, 0 where none is."""
        rows, last = [], 0
        try:
            outbox, events = str(message["outbox"])[:40], list(message["events"])
        except (KeyError, TypeError):
            return 0
        for each in events:
            # From 2^53 on a float skips numbers.
            if not isinstance(each, dict) or (n := number(each.get("n"))) is None or not 0 < n < 2**53:
                continue
            last = max(last, int(n))
            texts = (str(each.get(key, ""))[:most] for key, most in (("kind", 20), ("level", 20), ("text", 2000)))
            rows.append((site, cell, outbox, int(n), number(each.get("t")) or arrived_s, arrived_s, *texts))
        try:
            with self._lock, self._db:
                self._db.executemany("INSERT OR IGNORE INTO events VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
        except sqlite3.Error as error:
            self._problems["events"] = f"events are not stored, the cells keep them: {error}"
            return 0
        self._problems["events"] = ""
        return last

    def keep_about(self, cell: CellView) -> None:
        """Remember who a cell is."""
        with suppress(sqlite3.Error), self._lock, self._db:
            row = cell.site, cell.name, json.dumps(cell.about)
            self._db.execute("INSERT OR REPLACE INTO cells VALUES (?, ?, ?)", row)

    def known(self) -> list[CellView]:
        """Return the cells of earlier days; one whose last event is not that it ended was lost."""
        query = (
            "SELECT c.site, c.cell, about, kind, level, text, arrived FROM cells c LEFT JOIN"
            " (SELECT *, row_number() OVER (PARTITION BY site, cell ORDER BY arrived DESC, n DESC) AS row FROM events"
            " WHERE kind IN ('began', 'ended')) e ON e.site = c.site AND e.cell = c.cell AND row = 1"
        )
        with self._lock:
            rows = self._db.execute(query).fetchall()
        cells = []
        for site, cell, about, kind, level, text, at_s in rows:
            cells.append(CellView(site, cell, json.loads(about), lost_s=at_s))
            if kind is not None:
                cells[-1].end("" if kind == "began" else text, level)
        return cells

    def events(self, words: str = "", site: str = "", cell: str = "") -> list[dict[str, Any]]:
        """Return the events that hold all words, of one cell where it is named, in the order of their arrival."""
        where, values = ["1"], list[str]()
        for word in words.split()[:8]:
            where.append("(text || ' ' || kind || ' ' || level || ' ' || site || ' ' || cell) LIKE ? ESCAPE '\\'")
            values.append("%" + word.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_") + "%")
        for key, value in (("site", site), ("cell", cell)):
            if value:
                where.append(f"{key} = ?")
                values.append(value)
        names = "site, cell, n, t, arrived, kind, level, text"
        query = f"SELECT {names} FROM events WHERE {' AND '.join(where)} ORDER BY arrived DESC, n DESC LIMIT {_FOUND}"
        found: list[dict[str, Any]] = []
        with closing(sqlite3.connect(self._folder / "events.sqlite", timeout=0.2)) as db:
            end, db.row_factory = time.monotonic() + _SEARCH_S, sqlite3.Row
            db.set_progress_handler(lambda: time.monotonic() > end, 10_000)
            with suppress(sqlite3.Error):  # the time is over: what was found until then
                found.extend(map(dict, db.execute(query, values)))
        return found

    def count(self) -> int:
        """Return how many events there are."""
        with self._lock:
            return int(self._db.execute("SELECT count(*) FROM events").fetchone()[0])

    def add_state(self, cell: CellView, row: dict[str, Any]) -> None:
        """Keep a state until the next :meth:`flush`."""
        self._rows[f"{cell.site}.{cell.name}"].append(row)

    def flush(self) -> None:
        """Write the states since the last time, and forget old events; on a full disk states are lost, and that is said."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows, self._rows, self._problems["states"] = self._rows, defaultdict(list), ""
        numbers = [(key, pa.float64()) for key in ("t", "arrived", *NUMBERS)]
        schema = pa.schema([*numbers, ("mode", pa.string()), ("health", pa.list_(pa.string()))])
        for cell, states in rows.items():
            at = datetime.fromtimestamp(states[0]["arrived"], UTC)
            path = self._folder / "states" / f"day={at:%Y-%m-%d}" / f"cell={cell}" / f"{at:%H%M%S}.parquet"
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                with replacing(path, "wb") as file:
                    pq.write_table(pa.Table.from_pylist(states, schema), file)
            except (OSError, InputError, ValueError) as error:  # ValueError: of pyarrow, too
                self._problems["states"] = f"states are not stored: {error}"
        oldest = "SELECT arrived FROM events ORDER BY arrived DESC LIMIT 1 OFFSET ?"
        with suppress(sqlite3.Error), self._lock, self._db:
            self._db.execute(f"DELETE FROM events WHERE arrived <= ({oldest})", (_MOST,))

    def close(self) -> None:
        """Write what waits."""
        self.flush()
        with self._lock:
            self._opened.close()
