"""What runs for one recording, in a worker process: options and a path in, its rows out.

The result depends on nothing but the recording, the files that the options name and the version: so it does not matter
which worker computes it, or when.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from armsight.errors import ArmsightError

#: What is printed is redirected for the whole process: one command at a time, where a worker has several threads.
_PRINTS = threading.Lock()
#: What is compared of a run's summary.json.
_SUMMARY = ("camera_delay_s", "closed_loop", "handeye", "latency_s")
#: Rows of a table: column -> value.
Row = dict[str, Any]


@dataclass(frozen=True)
class BatchOptions:
    """What is done with every recording."""

    operation: str  #: measure, replay, identify or check
    rig: str | None = None  #: rig file
    target: str | None = None  #: board or body
    arm: str | None = None  #: arm model
    estimator: str = "kalman"  #: a name of ESTIMATORS

    def to_json(self) -> dict[str, Any]:
        """Return them as JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Done:
    """What came out of one recording."""

    recording: Row  #: its row
    shots: list[Row]  #: its shots' rows; none where it failed, or has no shots


def work(path: str, options: BatchOptions) -> Done:
    """Do the operation on one recording; a mistake in it is a row with its reason."""
    try:
        with _local(path) as local:
            row, shots = OPERATIONS[options.operation](local, options)
            row |= _made_with(local)
            row.setdefault("result", _summary(path))
    except (ArmsightError, OSError) as error:
        return Done({"recording": path, "status": "failed", "reason": " ".join(str(error).split())}, [])
    except Exception as error:  # noqa: BLE001 - one recording must not end the batch
        return Done({"recording": path, "status": "failed", "reason": f"{type(error).__name__}: {error}"}, [])
    return Done({"recording": path, "status": "ok", "reason": None, **row}, [{"recording": path, **s} for s in shots])


@contextlib.contextmanager
def _local(path: str) -> Iterator[str]:
    """Give the block a local copy of a recording, itself where it is local."""
    if "://" not in path:
        yield path
        return
    import fsspec

    with tempfile.TemporaryDirectory() as folder:
        fs, name = fsspec.core.url_to_fs(path)
        local = Path(folder) / Path(name).name
        fs.get(name, str(local), recursive=fs.isdir(name))
        yield str(local)


def _made_with(path: str) -> Row:
    """Return arm and rig of a run, by which a report compares, too; nothing where a recording does not name them."""
    from armsight.app.replay.recorded import run_file
    from armsight.app.stream.mcap_file import ARM
    from armsight.vision.sources.bag import Bag
    from armsight.vision.sources.bag.camera_info import METADATA, RIG

    file, found = run_file(path), Row()
    with contextlib.suppress(ArmsightError, ValueError, KeyError, TypeError, AttributeError):  # metadata of others
        texts = {} if file is None else Bag(file).metadata.get(METADATA, {})
        if ARM in texts:
            found["arm"] = str(json.loads(texts[ARM])["name"])
        if RIG in texts:  # the day it was made, and which one of that day
            made = str(json.loads(texts[RIG])["provenance"].get("made_utc", ""))[:10]
            found["rig"] = f"{made} {hashlib.sha256(texts[RIG].encode()).hexdigest()[:8]}".strip()
    return found


def _summary(path: str) -> str | None:
    """Return what a report compares of the summary.json beside a run, as JSON; None where there is none."""
    import fsspec

    fs, name = fsspec.core.url_to_fs(path)
    with contextlib.suppress(OSError, ValueError, AttributeError):  # none is there, or it is of another program
        found = json.loads(fs.cat_file(f"{name if fs.isdir(name) else name.rpartition('/')[0]}/summary.json"))
        return json.dumps({key: found[key] for key in _SUMMARY if found.get(key)}, sort_keys=True)
    return None


def _replay(path: str, options: BatchOptions) -> tuple[Row, list[Row]]:
    """Replay a recording."""
    from armsight.app.replay.open import Request, replay
    from armsight.files import read_table
    from armsight.vision.pose.shot_pose import csv_text

    notes: list[str] = []
    request = Request(path, options.rig, options.target, options.arm, options.estimator)
    replayed = replay(request, notes.append)
    with tempfile.TemporaryDirectory() as folder:  # the columns are those of measure's table
        table = Path(folder) / "poses.csv"
        table.write_text(csv_text(replayed.poses), encoding="utf-8")
        header, *rows = read_table(table)
    shots = [{name: _cell(name, cell) for name, cell in zip(header, row, strict=True)} for row in rows]
    row: Row = {
        "shots": len(shots),
        "measured": sum(pose.ok for pose in replayed.poses),
        "estimates": len(replayed.live),
        "notes": "; ".join(note.removeprefix("note: ") for note in notes) or None,
    }
    return row, shots


def _cell(name: str, text: str) -> str | float | None:
    """Return a cell as text where its column holds text, else as a number."""
    if name in ("shot", "status", "reason"):
        return text or None
    return float(text) if text else None


def _by_command(path: str, options: BatchOptions) -> tuple[Row, list[Row]]:
    """Run a command of one recording, and take the JSON that it prints."""
    import importlib

    arguments = {"identify": ["--data", path, "--arm", str(options.arm)], "check": [path]}[options.operation]
    command = importlib.import_module(f"armsight.app.{options.operation}.command").command
    printed = io.StringIO()
    quiet = contextlib.redirect_stderr(io.StringIO())
    with _PRINTS, contextlib.redirect_stdout(printed), quiet:
        command.main([*arguments, "--json"], standalone_mode=False)
    return {"result": json.dumps(json.loads(printed.getvalue()), sort_keys=True)}, []


#: Operation -> what does it.
OPERATIONS: dict[str, Callable[[str, BatchOptions], tuple[Row, list[Row]]]] = {
    "measure": _replay,
    "replay": _replay,
    "identify": _by_command,
    "check": _by_command,
}
