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
from typing import IO, Any

from armsight.app.stream.cell_file import Cell
from armsight.app.stream.outbox import Outbox, state_folder
from armsight.errors import ArmsightError, InputError

#: bytes that are read and sent at once; half: more calls, double: a coarser limit of the rate.
_CHUNK = 1 << 20
#: s that a store may take for its first answer; half: a slow one is not used, double: a dead one keeps the cell longer.
_ANSWER_S = 30.0
_MANIFEST = "manifest.json"


@dataclass
class Pushed:
    """What was done: counts of runs and files, and bytes sent."""

    runs: int = 0
    complete_before: int = 0
    files: int = 0
    sent_bytes: int = 0


def push(cell: Cell, folder: Path, store: str, rate_mb_s: float, advance: Callable[[int], None]) -> Pushed:
    """Copy the runs of a folder; one that is complete in the store is passed over.

    No command of the cell may run meanwhile; ``advance`` is called with the bytes sent so far.

    Raises:
        InputError: no runs are there, the store is unknown, or the cell is running.
        ArmsightError: the store is full or cannot be written; what is complete stays.
    """
    import fsspec

    names = "run.mcap", "summary.json", "shots.csv"
    runs = sorted({path.parent for name in names for path in folder.glob(f"*/{name}")})
    if not runs:
        raise InputError(f"{folder}: no runs are here: expected folders with {', '.join(names)}")
    done, due_s = Pushed(), time.monotonic()

    def pace(count: int) -> None:
        """Wait until so many bytes more may be sent, and count them."""
        nonlocal due_s
        time.sleep(max(0.0, due_s - time.monotonic()))
        due_s = max(due_s, time.monotonic()) + count / (1e6 * rate_mb_s)
        done.sent_bytes += count
        advance(done.sent_bytes)

    resting = Outbox(state_folder() / "cells" / cell.site / cell.name, cell.name)
    try:
        fs, root = fsspec.core.url_to_fs(store)
        # By itself s3fs waits for minutes, and the cell with it; and it makes a bucket of a mistyped name.
        waits = {"timeout": _ANSWER_S} if fs.async_impl else {}
        if (bucket := root.partition("/")[0]) and not fs.exists(bucket, **waits):
            raise InputError(f"{store}: no {bucket!r} is there, or it cannot be reached: is its name right?")
        for run in runs:
            day = datetime.fromtimestamp(min(each.stat().st_mtime for each in _files(run)), UTC)
            _push_run(fs, f"{root}/{cell.site}/{day:%Y-%m-%d}/{cell.name}/{run.name}", run, done, pace)
        return done
    except InputError:
        raise
    except (ImportError, ValueError) as error:
        raise InputError(f"{store}: {error}") from None
    except Exception as error:  # noqa: BLE001 - a store's library has errors of its own; our own code has its tests
        why = getattr(error, "strerror", None) or str(error) or f"no answer for {_ANSWER_S:.0f} s"
        raise ArmsightError(f"{store}: {why}; started again it goes on where it was") from None
    finally:
        resting.close()


def _push_run(fs: Any, at: str, run: Path, done: Pushed, pace: Callable[[int], None]) -> None:  # noqa: ANN401 - of fsspec
    manifest = {}
    for path in _files(run):
        with path.open("rb") as source:
            manifest[path.relative_to(run).as_posix()] = _digest(source)
    expected = json.dumps({"files": manifest}, indent=1).encode()
    if fs.exists(f"{at}/{_MANIFEST}") and fs.cat_file(f"{at}/{_MANIFEST}") == expected:
        done.complete_before += 1
        return
    for name, digest in manifest.items():
        target = f"{at}/{name}"
        if fs.exists(target) and fs.size(target) == digest["bytes"]:
            with fs.open(target, "rb") as there:
                if _digest(there) == digest:
                    continue
        fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        with (run / name).open("rb") as source, fs.open(target, "wb") as sink:
            while piece := source.read(_CHUNK):
                pace(len(piece))
                sink.write(piece)
        done.files += 1
    fs.pipe_file(f"{at}/{_MANIFEST}", expected)
    done.runs += 1


def _files(run: Path) -> list[Path]:
    return sorted(path for path in run.rglob("*") if path.is_file() and not path.is_symlink())


def _digest(file: IO[bytes]) -> dict[str, Any]:
    return {"sha256": hashlib.file_digest(file, "sha256").hexdigest(), "bytes": file.seek(0, 2)}  # type: ignore[arg-type]
