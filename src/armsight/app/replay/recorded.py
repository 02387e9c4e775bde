"""What run.mcap holds of a run: its metadata, and every datum in the order it was published."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.stream.mcap_file import RUN_MCAP, TOPICS
from armsight.app.stream.ros import READINGS
from armsight.data import Array, JointStates, Missed, PoseEstimate
from armsight.errors import InputError
from armsight.loop.references.file import reading_of
from armsight.loop.running.data import NO_POINTS, EventDatum, JointsDatum
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.camera_info import METADATA

_KINDS = {topic: kind for kind, topic in TOPICS.items()}


@dataclass(frozen=True)
class RecordedDatum:
    """A datum as it stands in the file."""

    kind: type  #: ShotDatum, JointsDatum or EventDatum: what was published
    content: dict[str, Any]  #: its JSON; docs/reference/data.md describes the keys
    #: of joints: times (N,), s, and readings (N, m) of a reference that were given with them.
    felt: tuple[Array, Array] = (np.empty(0), np.empty((0, 6)))

    @property
    def result(self) -> PoseEstimate | Missed:
        """What was measured in a shot, with all digits; the points are not recorded."""
        if self.content["status"] != "ok":
            return Missed(str(self.content["reason"]))
        return PoseEstimate(
            np.array(self.content["T_left_body"]),
            np.array(self.content["covariance_body"]),
            np.array(self.content["covariance_precision_body"]),
            float("nan" if self.content["residual_rms_m"] is None else self.content["residual_rms_m"]),
            float(self.content["reprojection_rms_px"]),
            float(self.content["misfit"]),
            NO_POINTS,
        )

    @property
    def states(self) -> JointStates:
        """The readings of a batch."""
        t_s = np.array(self.content["t_s"], float)
        return JointStates(t_s, np.array(self.content["q_rad"], float).reshape(len(t_s), -1))


@dataclass(frozen=True)
class RecordedRun:
    """A run.mcap."""

    path: Path  #: of the file
    properties: dict[str, str]  #: its metadata: versions, rig file, body file, arm
    data: tuple[RecordedDatum, ...]  #: in the order they were published
    notes: tuple[str, ...] = field(default=())  #: what could not be read

    def of(self, kind: type) -> Iterator[RecordedDatum]:
        """Yield the data of one kind."""
        return (each for each in self.data if each.kind is kind)

    @property
    def has_estimator(self) -> bool:
        """Whether an estimator ran: there are joints and the event that it began."""
        return any(True for _ in self.of(JointsDatum)) and any(True for _ in self.of(EventDatum))


def run_file(path: str | Path) -> Path | None:
    """Return the run.mcap that a path names, the file itself or the one in a folder; None where it is no run."""
    given = Path(path).expanduser()
    if given.is_dir():
        given = given / RUN_MCAP
    return given if given.name.endswith(".mcap") and given.is_file() else None


def read_run(path: Path) -> RecordedRun | None:
    """Read a run.mcap; None where an MCAP file was not written by armsight."""
    bag = Bag(path)
    if METADATA not in bag.metadata:
        return None
    data, felt = list[RecordedDatum](), list[tuple[float, Array]]()
    readings = [topic for topic, *_ in READINGS.values()]
    for message in bag.messages([topic for topic in (*_KINDS, *readings) if topic in bag.topics]):
        if message.topic in readings:
            felt.append(reading_of(message))
            continue
        content = message.decode()
        if not isinstance(content, dict):
            raise InputError(f"{path}: a datum on {message.topic} is no JSON object")
        datum = RecordedDatum(_KINDS[message.topic], content)
        if felt and datum.kind is JointsDatum:
            datum = replace(datum, felt=(np.array([t for t, _ in felt]), np.array([z for _, z in felt])))
            felt.clear()
        data.append(datum)
    return RecordedRun(path, bag.metadata[METADATA], tuple(data), tuple(bag.notes))
