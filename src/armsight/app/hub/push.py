"""Runs of a cell into a store that fsspec knows, such as ``s3://bucket``: resumable, checked, slow enough for the network.

A run lies at ``STORE/SITE/DAY/CELL/RUN/``; its ``manifest.json``, written last, has each file's size and SHA-256: a
run without one is not complete, and is taken up again where it was.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from armsight.app.stream.cell_file import Cell
from armsight.app.stream.outbox import Outbox, state_folder
from armsight.errors import ArmsightError, InputError

#: bytes that are read and sent at once; half: more calls, double: a coarser limit of the rate.
_CHUNK = 1 << 20
_MANIFEST = "manifest.json"


@dataclass
class Pushed:
    """What was done: counts of runs and files, and bytes sent."""

    runs: int = 0
    complete_before: int = 0
    files: int = 0
    sent_bytes: int = 0


def push(cell: Cell, folder: Path, store: str, rate_mb_s: float, advance: Callable[[int], None]) -> Pushed:
    """Copy the runs of a folder, those first that are oldest; one that is complete in the store is passed over.

    Args:
        cell: whose runs they are; none of its commands may run meanwhile.
        folder: holds run folders, each with a summary.json, a run.mcap or a shots.csv.
        store: URL of a folder.
        rate_mb_s: MB/s at most.
        advance: is called with the bytes sent so far, before each piece.

    Raises:
        InputError: no runs are there, the store is unknown, or the cell is running.
        ArmsightError: the store is full or cannot be written; what is complete stays.
    """
    import fsspec

    runs = sorted(
        {path.parent for name in ("run.mcap", "summary.json", "shots.csv") for path in folder.glob(f"*/{name}")}
    )
    if not runs:
        raise InputError(f"{folder}: no runs are here: expected folders with run.mcap, summary.json or shots.csv")
    resting = Outbox(
        state_folder() / "cells" / cell.site / cell.name, cell.name
    )  # no command of this cell may run meanwhile
    try:
        fs, root = fsspec.core.url_to_fs(store)
        if (bucket := root.partition("/")[0]) and not fs.exists(bucket):  # s3fs would make one of a mistyped name
            raise InputError(f"{store}: no {bucket!r} is there, or it cannot be reached: is its name right?")
        done, pace = Pushed(), _Pace(rate_mb_s, advance)
        for run in runs:
            day = datetime.fromtimestamp(min(each.stat().st_mtime for each in _files(run)), UTC)
            _push_run(fs, f"{root}/{cell.site}/{day:%Y-%m-%d}/{cell.name}/{run.name}", run, done, pace)
        return done
    except InputError:
        raise
    except (ImportError, ValueError) as error:
        raise InputError(f"{store}: {error}") from None
    except Exception as error:  # noqa: BLE001 - a store's library has errors of its own; our own code has its tests
        why = error.strerror if isinstance(error, OSError) else None
        raise ArmsightError(f"{store}: {why or error}; started again it goes on where it was") from None
    finally:
        resting.close()


class _Pace:
    """Keeps a rate."""

    def __init__(self, rate_mb_s: float, advance: Callable[[int], None]) -> None:
        self._rate, self._advance, self._due, self._sent = 1e6 * rate_mb_s, advance, time.monotonic(), 0

    def wait(self, size: int) -> None:
        """Wait until so many bytes more may be sent."""
        now = time.monotonic()
        time.sleep(max(0.0, self._due - now))
        self._due = max(self._due, now) + size / self._rate
        self._sent += size
        self._advance(self._sent)


def _push_run(fs: Any, at: str, run: Path, done: Pushed, pace: _Pace) -> None:  # noqa: ANN401 - of fsspec
    files = _files(run)
    manifest = {path.relative_to(run).as_posix(): _digest(path) for path in files}
    expected = json.dumps({"files": manifest}, indent=1).encode()
    if fs.exists(f"{at}/{_MANIFEST}") and fs.cat_file(f"{at}/{_MANIFEST}") == expected:
        done.complete_before += 1
        return
    for path in files:
        target = f"{at}/{path.relative_to(run).as_posix()}"
        size = path.stat().st_size
        if not (fs.exists(target) and fs.size(target) == size and _remote_digest(fs, target) == _digest(path)):
            fs.makedirs(target.rpartition("/")[0], exist_ok=True)
            with path.open("rb") as source, fs.open(target, "wb") as sink:
                while piece := source.read(_CHUNK):
                    pace.wait(len(piece))
                    sink.write(piece)
            done.files += 1
            done.sent_bytes += size
    fs.pipe_file(f"{at}/{_MANIFEST}", expected)
    done.runs += 1


def _files(run: Path) -> list[Path]:
    return sorted(path for path in run.rglob("*") if path.is_file() and not path.is_symlink())


def _digest(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": path.stat().st_size}


def _remote_digest(fs: Any, path: str) -> dict[str, Any]:  # noqa: ANN401 - of fsspec
    with fs.open(path, "rb") as file:
        return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": int(fs.size(path))}
