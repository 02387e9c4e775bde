"""Events that wait on disk until a hub has stored them: numbered, and sent by one process alone."""

from __future__ import annotations

import json
import os
import secrets
import sqlite3
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from armsight.errors import InputError

#: events a second that are kept, and as many at once after a pause; half: bursts are thinned, double: twice the disk.
_RATE, _BURST = 10.0, 100.0
#: bytes that the number of an event takes in a message, its key included; half, double: nothing.
_NUMBER_BYTES = 20
#: events that wait at most; half: days without a hub become one, double: twice the disk (0.2 GB).
_MOST = 200_000


def state_folder() -> Path:
    """Return where programs keep their state for a user (XDG base directories)."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "armsight"


class Outbox:
    """The events of one cell, for one thread at a time; ``name``: which numbering it is, as a new disk begins at 1."""

    def __init__(self, folder: Path, cell: str) -> None:
        with ExitStack() as opened:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                how: Any = {"timeout": 0.2, "check_same_thread": False, "isolation_level": None}
                self._db = sqlite3.connect(folder / "events.sqlite", **how)
                opened.callback(self._db.close)
                self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
                self._db.execute("CREATE TABLE IF NOT EXISTS waiting (n INTEGER PRIMARY KEY AUTOINCREMENT, event TEXT)")
                self._db.execute("CREATE TABLE IF NOT EXISTS outbox (name TEXT)")
                found = self._db.execute("SELECT name FROM outbox").fetchone()
                self.name = str(found[0]) if found else secrets.token_hex(8)
                self._db.execute("DELETE FROM outbox")  # a write: it takes the lock even where nothing is new
                self._db.execute("INSERT INTO outbox VALUES (?)", (self.name,))
            except (sqlite3.Error, OSError) as error:
                other = "another command of this cell runs on this computer, or a push: each needs a name of its own"
                raise InputError(f"cell {cell}: {folder}: {other if 'locked' in str(error) else error}") from None
            opened.pop_all()
        self._left = _BURST
        self._at = time.monotonic()
        self.thinned = 0

    def add(self, event: dict[str, Any], *, thin: bool) -> None:
        """Keep an event; ``thin``: unless too many come at once. On a full disk it is lost, and counted."""
        now = time.monotonic()
        self._left = min(_BURST, self._left + (now - self._at) * _RATE)
        self._at = now
        if thin and self._left < 1.0:
            self.thinned += 1
            return
        self._left = max(self._left - 1.0, 0.0)
        try:
            if self.thinned and (self._left > 1.0 or not thin):
                text = f"{self.thinned} events or shots were left out: too many at once, or the disk is full"
                self._store({**event, "kind": "thinned", "level": "warning", "text": text})
                self.thinned = 0
            self._store(event)
        except sqlite3.Error:
            self.thinned += 1

    def _store(self, event: dict[str, Any]) -> None:
        self._db.execute("INSERT INTO waiting (event) VALUES (?)", (json.dumps(event),))
        self._db.execute("DELETE FROM waiting WHERE n <= (SELECT max(n) FROM waiting) - ?", (_MOST,))

    def waiting(self, most_bytes: int) -> list[dict[str, Any]]:
        """Return the oldest events that wait, each with its number ``n``: one at least, and no more than so many bytes."""
        found: list[dict[str, Any]] = []
        with suppress(sqlite3.Error):
            for n, event in self._db.execute("SELECT n, event FROM waiting ORDER BY n"):
                most_bytes -= len(event) + _NUMBER_BYTES
                if found and most_bytes < 0:
                    break
                found.append({**json.loads(event), "n": n})
        return found

    def confirm(self, n: int) -> None:
        """Forget the events up to a number: they are stored elsewhere."""
        with suppress(sqlite3.Error):
            self._db.execute("DELETE FROM waiting WHERE n <= ?", (n,))

    def close(self) -> None:
        """Leave it to the next process."""
        self._db.close()
