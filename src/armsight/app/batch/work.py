"""What runs for one recording, in a worker process: options and a path in, its rows out.

The result depends on nothing but the recording, the files that the options name and the version: so it does not matter
which worker computes it, or when.
"""

from __future__ import annotations

import contextlib
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
#: Rows of a table: column -> value.
Row = dict[str, Any]


@dataclass(frozen=True)
class BatchOptions:
    """What is done with every recording.

    Attributes:
        operation: measure, replay, identify or check.
        rig: rig file.
        target: board or body.
        arm: arm model.
        estimator: a name of ESTIMATORS.
    """

    operation: str
    rig: str | None = None
    target: str | None = None
    arm: str | None = None
    estimator: str = "kalman"

    def to_json(self) -> dict[str, Any]:
        """Return them as JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Done:
    """What came out of one recording.

    Attributes:
        recording: its row.
        shots: its shots' rows; none where it failed, or has no shots.
    """

    recording: Row
    shots: list[Row]


def work(path: str, options: BatchOptions) -> Done:
    """Do the operation on one recording; a mistake in it is a row with its reason."""
    try:
        with _local(path) as local:
            row, shots = OPERATIONS[options.operation](local, options)
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
