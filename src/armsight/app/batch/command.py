"""``armsight batch``: measure, replay, identify or check many recordings."""

from __future__ import annotations

from pathlib import Path

import click

from armsight.app.options import ESTIMATOR, JSON, argument, declared, option, out
from armsight.app.show.messages import print_answer, say
from armsight.errors import InputError

OPERATIONS = ("measure", "replay", "identify", "check")
REPORT = "report"
_REASONS = 3  # why recordings failed, on the terminal; half: a second mistake is not seen, double: a long list


@click.command("batch")
@declared
def command(
    operation: str = argument(choices=(*OPERATIONS, REPORT)),
    recordings: tuple[str, ...] = argument("'GLOB'...", required=True),
    output: Path | None = out("DIR", "Folder of the results; report needs none."),
    rig: str | None = option(
        "The rig, where the recordings have no camera_info, or instead of it.", metavar="RIG.json"
    ),
    target: str | None = option("The board or body that is measured.", metavar="SPEC|BODY"),
    arm: str | None = option("The arm model.", metavar="ARM"),
    estimator: str = ESTIMATOR,
    workers: str | None = option(
        "Processes, by default as many as this machine has cores; or a Dask cluster that exists.",
        metavar="N|tcp://HOST:PORT",
    ),
    as_json: bool = JSON,
) -> None:
    """Measure many recordings, on all cores or on a cluster; started again it goes on where it was.

    Quote the GLOB: ``'archive/**/*.mcap'``, ``'s3://bucket/**/*.bag'``. A recording that fails is a row with its
    reason, is tried again when the batch is started again, and makes the exit code 1. identify takes tables of poses
    (armsight identify -h), check folders of runs (armsight check -h), measure and replay recordings (armsight replay -h).

    ``report DIR`` reads the results of a batch whose recordings lie as SITE/DAY/CELL/RUN (armsight hub push): which cells,
    arms and rigs differ from their siblings, and which change from day to day.
    """
    from armsight.app.batch.run import Batch, run_batch
    from armsight.app.batch.work import BatchOptions

    if operation == REPORT:
        _report(recordings, as_json)
        return
    if output is None:
        raise InputError("the results need a folder: give -o DIR")
    if workers is not None and "://" not in workers and not (workers.isdecimal() and int(workers) > 0):
        raise InputError(f"--workers {workers}: expected a number of processes, or the address of a Dask cluster")
    if operation == "identify" and arm is None:
        raise InputError("batch identify needs the nominal arm: give --arm, a name, .toml or .urdf")
    options = BatchOptions(operation, _absolute(rig), _absolute(target), _absolute(arm), estimator)
    batch = Batch(recordings, output.expanduser(), options, workers)
    done = run_batch(batch, say)
    said = [
        f"{done.recordings} recordings: {done.ok} done, {done.before} of them before, {done.failed} failed; "
        f"{done.shots} shots; written to {output}"
    ]
    said += [f"  failed {count} times: {reason}" for reason, count in list(done.reasons.items())[:_REASONS]]
    more = f"  {output}/recordings.parquet has every reason; started again, the batch tries these again"
    print_answer(as_json, done.to_json(), *said, *([more] if done.failed else []))
    if done.failed:
        click.get_current_context().exit(1)


def _report(folders: tuple[str, ...], as_json: bool) -> None:
    """Print which cells of a batch differ."""
    from armsight.app.batch.report import lines, report, to_json
    from armsight.app.batch.run import require_dask

    require_dask()
    if len(folders) != 1:
        raise InputError("batch report reads the results of one batch: give its folder")
    rows = report(Path(folders[0]).expanduser())
    print_answer(as_json, to_json(rows), *lines(rows))


def _absolute(name: str | None) -> str | None:
    """Return the absolute path of a file, by which other processes find it; names of other things stay."""
    return str(Path(name).resolve()) if name is not None and Path(name).is_file() else name
