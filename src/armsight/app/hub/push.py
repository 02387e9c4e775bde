"""Runs of a cell into a store that fsspec knows, such as ``s3://bucket``: resumable, checked, slow enough for the network.

A run lies at ``STORE/SITE/DAY/CELL/RUN/``; its ``manifest.json``, written last, has each file's size and SHA-256: a
run without one is not complete, and is taken up again where it was.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from armsight.app.stream.cell_file import Cell
from armsight.app.stream.outbox import Outbox, state_folder
from armsight.errors import ArmsightError, InputError

#: bytes that are read and sent at once; half: more calls, double: a coarser limit of the rate.
_CHUNK = 1 << 20
#: bytes of a part of a store, and parts that S3 takes; half: S3 takes no less, double: slow networks are silent longer.
_PART, _PARTS = 5 << 20, 10_000
#: s that a store may take for an answer; half: a slow one is not used, double: a dead one keeps the cell longer.
_ANSWER_S = 30.0
#: bytes a second of the slowest network; half: a silent store is given up later, double: 1 Mbit/s is no network.
_SLOWEST = 50e3
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

    No command of the cell may run meanwhile; ``advance`` is called with the bytes sent so far. An InputError says that no
    runs are there, that the store is unknown, or that the cell is running; another ArmsightError that the store is full
    or cannot be written: what is complete stays.
    """
    import fsspec

    try:
        fsspec.get_filesystem_class(fsspec.utils.get_protocol(store))
    except (ImportError, ValueError) as error:  # the words of an ImportError say what to install
        known = "" if isinstance(error, ImportError) else "; expected a folder, or such as s3://bucket"
        raise InputError(f"{store}: {error}{known}") from None
    names = "run.mcap", "summary.json", "shots.csv"
    runs = sorted({path.parent for name in names for path in folder.glob(f"*/{name}")})
    if not runs:
        raise InputError(f"{folder}: no runs are here: expected folders with {', '.join(names)}")
    done, due_s = Pushed(), time.monotonic()

    def pace(count: int) -> None:
        nonlocal due_s
        time.sleep(max(0.0, due_s - time.monotonic()))
        due_s = max(due_s, time.monotonic()) + count / (1e6 * rate_mb_s)
        done.sent_bytes += count
        advance(done.sent_bytes)

    with closing(Outbox(state_folder() / "cells" / cell.site / cell.name, cell.name)):
        try:
            fs, root = fsspec.core.url_to_fs(store)
            # s3fs makes a bucket of a mistyped name.
            if (bucket := root.partition("/")[0]) and not _answer(fs.exists, bucket):
                raise InputError(f"{store}: no {bucket!r} is there, or it cannot be reached: is its name right?")
            for run in runs:
                day = datetime.fromtimestamp(min(each.stat().st_mtime for each in _files(run)), UTC)
                _push_run(fs, f"{root}/{cell.site}/{day:%Y-%m-%d}/{cell.name}/{run.name}", run, done, pace)
            return done
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{store}: {error}") from None
        except Exception as error:  # noqa: BLE001 - a store's library has errors of its own; our own code has its tests
            why = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise ArmsightError(f"{store}: {why}; started again it goes on where it was") from None


def _push_run(fs: Any, at: str, run: Path, done: Pushed, pace: Callable[[int], None]) -> None:  # noqa: ANN401 - of fsspec
    manifest = {}
    for path in _files(run):
        with path.open("rb") as source:
            manifest[path.relative_to(run).as_posix()] = _digest(source.read)
    expected = json.dumps({"files": manifest}, indent=1).encode()
    last = f"{at}/{_MANIFEST}"
    if _answer(fs.exists, last) and _answer(fs.cat_file, last) == expected:
        done.complete_before += 1
        return
    for name, digest in manifest.items():
        target, part = f"{at}/{name}", max(_PART, 2 * digest["bytes"] // _PARTS)
        slow_s = _ANSWER_S + part / _SLOWEST
        if _answer(fs.exists, target) and _answer(fs.size, target) == digest["bytes"]:
            with _answer(fs.open, target, "rb", block_size=part) as there:
                if _digest(partial(_answer, there.read, within_s=slow_s)) == digest:
                    continue
        _answer(fs.makedirs, target.rpartition("/")[0], exist_ok=True)
        with (run / name).open("rb") as source:
            sink = _answer(fs.open, target, "wb", block_size=part)
            while piece := source.read(_CHUNK):
                pace(len(piece))
                _answer(sink.write, piece, within_s=slow_s)
            _answer(sink.close, within_s=slow_s)  # not by `with`: that would wait for a store that is silent
        done.files += 1
    _answer(fs.pipe_file, last, expected)
    done.runs += 1


def _answer(call: Callable[..., Any], *given: Any, within_s: float | None = None, **named: Any) -> Any:  # noqa: ANN401 - of fsspec
    """Return what a call to the store returns; by themselves s3fs and its like wait for many minutes.

    A TimeoutError says that the store is silent; the call is left alone in its thread.
    """
    answer = Future[Any]()

    def work() -> None:
        try:
            answer.set_result(call(*given, **named))
        except BaseException as error:  # noqa: BLE001 - raised below
            answer.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    limit_s = within_s or _ANSWER_S
    if not wait([answer], limit_s).done:
        raise TimeoutError(f"no answer for {limit_s:.0f} s")
    return answer.result()


def _files(run: Path) -> list[Path]:
    return sorted(path for path in run.rglob("*") if path.is_file() and not path.is_symlink())


def _digest(read: Callable[[int], bytes]) -> dict[str, Any]:
    digest, count = hashlib.sha256(), 0
    while piece := read(_CHUNK):
        digest.update(piece)
        count += len(piece)
    return {"sha256": digest.hexdigest(), "bytes": count}
