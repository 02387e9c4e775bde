"""The tables of a replay: poses.csv and live.csv, with all digits, so that two replays can be compared to the last one."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armsight.app.replay.run import LiveRow, Replayed
from armsight.data import Array
from armsight.files import write_text
from armsight.vision.pose.shot_pose import UPPER, ShotPose, csv_text
from armsight.vision.sources.bag.states import JointStream

POSES, LIVE = "poses.csv", "live.csv"
LIVE_COLUMNS = (
    "t_s",
    "status",
    "vision_age_s",
    *(f"{axis}_m" for axis in "xyz"),
    *(f"q{axis}" for axis in "wxyz"),
    *(f"cov_{i}{j}" for i, j in UPPER),
)


def write_tables(folder: Path, replayed: Replayed) -> list[Path]:
    """Write the tables to a folder, which is made; return their files."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / POSES, with_joints(csv_text(replayed.poses), replayed.poses, replayed.joints))
    if not replayed.live:
        return [folder / POSES]
    write_text(folder / LIVE, live_text(replayed.live))
    return [folder / POSES, folder / LIVE]


def live_text(rows: Sequence[LiveRow]) -> str:
    """Return the CSV of the live track."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(LIVE_COLUMNS)
    for row in rows:
        seen = np.isfinite(row.vision_age_s)
        cells = [row.t_s, "ok" if seen else "predicted", row.vision_age_s if seen else ""]
        cells += [*row.position_m.tolist(), *row.quaternion_wxyz.tolist(), *(float(row.cov[i, j]) for i, j in UPPER)]
        writer.writerow(cells)
    return output.getvalue()


def with_joints(text: str, poses: Sequence[ShotPose], joints: JointStream | None) -> str:
    """Return the table of poses with the joint angles at the time of each, as ``armsight identify`` reads them."""
    if joints is None or any(pose.t_s is None for pose in poses):
        return text
    q: Array = joints.at(np.array([pose.t_s for pose in poses], float))
    rows = list(csv.reader(io.StringIO(text)))
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow([*rows[0], *(f"q{k + 1}_rad" for k in range(q.shape[1]))])
    for row, angles in zip(rows[1:], q.tolist(), strict=True):
        writer.writerow([*row, *("" if angle != angle else angle for angle in angles)])
    return output.getvalue()
