"""Hand the recordings out to Dask's workers, and collect what comes back.

A few recordings a worker are handed out at a time, the next when one is done: so the scheduler holds the same however many
there are. Each result is stored in ``parts`` as it comes, as JSON; a batch that is started again skips those whose
recording and options are the same, and tries again what failed. A worker that dies loses the recordings it had in hand:
Dask hands them to another.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

from armsight import __version__
from armsight.app.batch.work import BatchOptions, Done, work
from armsight.app.progress import bar
from armsight.app.show.messages import require
from armsight.errors import InputError
from armsight.files import (
    alone_in,
    as_input_error,
    check_folder,
    made_folder,
    parsed_json,
    read_bytes,
    read_text,
    replacing,
    write_text,
)
from armsight.robot.arm_file import open_arm
from armsight.vision.markers.targets import open_body, open_target
from armsight.vision.sources import open_rig

#: Files of a batch.
SHOTS, RECORDINGS, ABOUT, PARTS = "shots.parquet", "recordings.parquet", "batch.json", "parts"
#: Recordings in hand a worker: one that it works on, and the next.
_IN_HAND = 2
_PART_MB = 512  # largest result of one recording; half: 12 hours of shots are too many; double: twice the memory
_Client: TypeAlias = Any


@dataclass(frozen=True)
class Batch:
    """What is to be done."""

    recordings: Sequence[str]  #: paths with wildcards
    output: Path  #: folder of the results
    options: BatchOptions  #: what is done with each
    workers: str | None = None  #: how many processes, or the address of a cluster; None is one process a core


@dataclass(frozen=True)
class BatchDone:
    """What came out."""

    recordings: int  #: how many there are
    ok: int  #: how many were done
    failed: int  #: how many failed
    before: int  #: how many were done before the batch was started again
    shots: int  #: how many shots they have
    reasons: dict[str, int]  #: why recordings failed, and how many each, the most frequent first

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return asdict(self)


def require_dask() -> None:
    """Raise an InputError with what to install unless Dask, fsspec and pyarrow are."""
    require("batch", "batch", "distributed", "fsspec", "pyarrow")


def found_recordings(patterns: Sequence[str]) -> dict[str, str]:
    """Return the recordings that patterns match, sorted, local ones as absolute paths; and the state of each.

    The state, size and time, comes with the search: asking a store for each of 100,000 files would take hours.

    Raises:
        InputError: a pattern matches nothing, or its store cannot be read.
    """
    import fsspec

    found: dict[str, str] = {}
    for pattern in patterns:
        try:
            fs, path = fsspec.core.url_to_fs(os.path.expanduser(pattern))
            names: dict[str, dict[str, Any]] = fs.glob(path, detail=True)
        except Exception as error:  # noqa: BLE001 - a store's library has errors of its own
            raise InputError(f"{pattern}: cannot be searched: {error}") from None
        if not names:
            raise InputError(f"{pattern}: no such recording; quote the pattern to keep the shell off it")
        for name, about in names.items():
            changed = next(
                (about[key] for key in ("mtime", "LastModified", "last_modified", "ETag") if key in about), None
            )
            found[name if "://" not in pattern else fs.unstrip_protocol(name)] = f"{about.get('size')} {changed}"
    return dict(sorted(found.items()))


def _keys(paths: dict[str, str], options: BatchOptions) -> dict[str, str]:
    """Return for each recording a name that changes with its state, the options, the files they name and the version."""
    files = [Path(name) for name in (options.rig, options.target, options.arm) if name is not None]
    contents = [hashlib.sha256(read_bytes(file)).hexdigest() for file in files if file.is_file()]
    common = json.dumps([options.to_json(), contents, __version__])
    return {
        path: hashlib.sha256(json.dumps([path, state, common]).encode()).hexdigest()[:32]
        for path, state in paths.items()
    }


def run_batch(batch: Batch, say: Callable[[str], None]) -> BatchDone:
    """Run a batch.

    What all recordings share, rig, target and arm, is opened first: a mistake in it is one line, not a row each.

    Args:
        batch: what is to be done.
        say: is given the address of the dashboard, and notes.

    Raises:
        InputError: no recordings, a package is missing, or the folder cannot be written to.
    """
    require_dask()
    paths = found_recordings(batch.recordings)
    for name, open_one in (
        (batch.options.rig, open_rig),
        (batch.options.target, _opened_target),
        (batch.options.arm, open_arm),
    ):
        if name is not None:
            open_one(name)
    check_folder(batch.output, problem="no batch can be written here")
    with alone_in(batch.output, "batch"):
        return _run_batch(batch, paths, say)


def _run_batch(batch: Batch, paths: dict[str, str], say: Callable[[str], None]) -> BatchDone:
    """Run a batch whose folder is checked."""
    parts = made_folder(batch.output / PARTS)
    keys = _keys(paths, batch.options)
    left = [path for path in paths if not (parts / keys[path]).is_file()]
    failed: dict[str, Done] = {}
    about = {"version": __version__, "options": batch.options.to_json(), "recordings": list(batch.recordings)}
    write_text(batch.output / ABOUT, json.dumps(about, indent=1) + "\n")
    if left:
        with _client(batch, len(left), say) as (client, workers), bar("recordings", len(left)) as advance:
            for path, done in _results(client, left, batch.options, _IN_HAND * workers):
                if done.recording["status"] == "ok":
                    write_text(parts / keys[path], json.dumps(asdict(done)))
                else:
                    failed[path] = done
                advance()
    recordings, shots = _write(batch.output, [failed.get(path, parts / keys[path]) for path in paths])
    ok = sum(row["status"] == "ok" for row in recordings)
    why = (str(row["reason"]).removeprefix(f"{row['recording']}: ") for row in recordings if row["status"] != "ok")
    reasons = Counter(why)
    return BatchDone(len(paths), ok, len(paths) - ok, len(paths) - len(left), shots, dict(reasons.most_common()))


def _opened_target(spec: str) -> object:
    """Open a target; of points in a CSV file no images are measured, but tags."""
    return open_body(spec) if spec.lower().endswith(".csv") else open_target(spec)


@contextlib.contextmanager
def _client(batch: Batch, count: int, say: Callable[[str], None]) -> Iterator[tuple[_Client, int]]:
    """Give the block a client and the number of workers."""
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.ERROR)
    with contextlib.ExitStack() as stack:
        if "://" in (batch.workers or ""):
            with as_input_error(
                f"--workers {batch.workers}: no cluster answers there", OSError, ValueError, TimeoutError, why=True
            ):
                client = stack.enter_context(Client(batch.workers, timeout=10))
        else:
            workers = min(int(batch.workers or len(os.sched_getaffinity(0))), count)
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
            )
            client = stack.enter_context(Client(stack.enter_context(cluster)))
        say(f"dashboard: {client.dashboard_link}")
        yield client, max(1, len(client.scheduler_info()["workers"]))


def _results(client: _Client, paths: list[str], options: BatchOptions, in_hand: int) -> Iterator[tuple[str, Done]]:
    """Yield what comes back, in any order."""
    from distributed import as_completed

    waiting = iter(paths)

    def submitted(path: str) -> Any:  # noqa: ANN401 - a future of the library
        future = client.submit(work, path, options, pure=False, retries=1)
        names[future.key] = path
        return future

    names: dict[str, str] = {}
    first = [path for _, path in zip(range(in_hand), waiting, strict=False)]
    completed = as_completed([submitted(path) for path in first])
    for future in completed:
        path = names.pop(future.key)
        try:
            done = future.result()
        except Exception as error:  # noqa: BLE001 - workers that die again and again at one recording
            done = Done({"recording": path, "status": "failed", "reason": f"{type(error).__name__}: {error}"}, [])
        future.release()
        yield path, done
        following = next(waiting, None)
        if following is not None:
            completed.add(submitted(following))


def _write(folder: Path, parts: list[Path | Done]) -> tuple[list[dict[str, Any]], int]:
    """Write both tables from the parts, in the order of the recordings; return the recordings' rows, and the shots."""
    import pyarrow as pa
    from pyarrow import parquet

    rows: list[dict[str, Any]] = []
    columns: dict[str, None] = {}
    for part in parts:  # first the columns: recordings may differ in them
        recording, shots = _load(part)
        rows.append(recording)
        columns |= dict.fromkeys(shots[0] if shots else ())
    names = list({name: None for row in rows for name in row})
    with replacing(folder / RECORDINGS, "wb") as file:
        parquet.write_table(pa.table({name: [row.get(name) for row in rows] for name in names}), file)
    count = 0
    kinds = [
        (name, pa.string() if name in ("recording", "shot", "status", "reason") else pa.float64()) for name in columns
    ]
    with replacing(folder / SHOTS, "wb") as file, parquet.ParquetWriter(file, pa.schema(kinds)) as writer:
        for part in parts:
            _, shots = _load(part)
            count += len(shots)
            if shots:
                data = {name: [shot.get(name) for shot in shots] for name, _ in kinds}
                writer.write_table(pa.table(data, schema=pa.schema(kinds)))
    return rows, count


def _load(part: Path | Done) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the rows of a recording, stored or in hand."""
    if isinstance(part, Done):
        return part.recording, part.shots
    stored = parsed_json(read_text(part, _PART_MB), part, "a result of armsight batch; remove it")
    with as_input_error(f"{part}: not a result of armsight batch: remove it", KeyError, TypeError, ValueError):
        return dict(stored["recording"]), list(stored["shots"])
