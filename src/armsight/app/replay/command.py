"""``armsight replay``: measuring and the estimators again, on a recording."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.options import ESTIMATOR, JSON, REFERENCES, STREAM, argument, declared, option, out
from armsight.app.show.messages import print_answer, say

if TYPE_CHECKING:
    from armsight.app.replay.run import Replayed

#: Reasons of missed shots that are printed, the most frequent ones.
_REASONS = 3


@click.command("replay")
@declared
def command(
    recording: str = argument("RUN|BAG"),
    output: Path | None = out("DIR", "Write the tables to this folder.", report=True),
    rig: str | None = option("Another rig: needs images or tags in the recording.", metavar="RIG.json"),
    target: str | None = option("Another body: needs images or tags in the recording.", metavar="SPEC|BODY"),
    arm: str | None = option("Another arm model.", metavar="ARM"),
    estimator: str = ESTIMATOR,
    references: Path | None = REFERENCES,
    rate: float = option("1 is real time; by default as fast as possible.", min=0, default=0.0, show_default=False),
    stream: tuple[str, ...] = STREAM,
    other: Path | None = option("Show what differs from the tables in this folder.", "--compare", metavar="DIR"),
    as_json: bool = JSON,
) -> None:
    """Measure and estimate again what was recorded, also with another rig, body, arm or estimator.

    RUN is the folder of armsight run, demo or record, or its run.mcap. BAG is a recording of ROS or Foxglove,
    FILE[,left=TOPIC,right=TOPIC], with images or tags of two cameras; its camera_info is the rig where they are of a stereo
    pair. Without changes the answers of a run's estimators are the same to the last digit, and the command says so.
    """
    from armsight.app.replay.open import Request, replay
    from armsight.app.replay.tables import LIVE, POSES, compare, write_tables
    from armsight.files import check_folder

    if output is not None:
        check_folder(
            output, holding=(POSES, LIVE), signs=(LIVE,), apart_from=[other and other / name for name in (POSES, LIVE)]
        )
    request = Request(recording, rig, target, arm, estimator, rate, references, stream)
    replayed = replay(request, say)
    answer, lines = described(recording, replayed)
    if output is not None:
        write_tables(output.expanduser(), replayed)
        lines.append(f"written to {output}")
    if other is not None:
        with tempfile.TemporaryDirectory() as temporary:
            write_tables(Path(temporary), replayed)
            found = compare(other, Path(temporary))
        answer["compared"] = [each.to_json() for each in found]
        lines += [line for each in found for line in each.lines()]
    print_answer(as_json, answer, *lines)


def described(recording: str, replayed: Replayed) -> tuple[dict[str, object], list[str]]:
    """Return what was replayed, for ``--json`` and for the terminal."""
    measured = sum(pose.ok for pose in replayed.poses)
    reasons = Counter(pose.reason for pose in replayed.poses if not pose.ok)
    answer: dict[str, object] = {
        "recording": recording,
        "shots": len(replayed.poses),
        "measured": measured,
        "missed": [{"reason": reason, "shots": count} for reason, count in reasons.most_common()],
        "estimates": len(replayed.live),
        "differences": replayed.differences,
        "same": None if replayed.differences is None else not any(replayed.differences.values()),
    }
    lines = [f"{measured} of {len(replayed.poses)} shots measured, {len(replayed.live)} estimates"]
    lines += [f"  missed {count}: {reason}" for reason, count in reasons.most_common(_REASONS)]
    if len(reasons) > _REASONS:
        lines.append(f"  and {len(reasons) - _REASONS} other reasons: poses.csv has that of each shot")
    if replayed.differences is not None:
        lines.append(
            "the estimates are those of the run, to the last digit"
            if answer["same"]
            else "the estimates differ from those of the run by at most "
            + ", ".join(f"{name} {value:.3g}" for name, value in replayed.differences.items())
        )
    if replayed.odometry is not None:
        answer["odometry"] = replayed.odometry._asdict()
        lines.append(replayed.odometry.line)
    if (row := replayed.beside) is not None:
        answer["reference"] = asdict(row)
        lines.append(row.line)
    return answer, lines
