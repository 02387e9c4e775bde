"""What a running loop publishes: a record of a shot, of a batch of joint readings, of an event; and to whom.

docs/reference/data.md lists the names of their JSON. Numbers are SI.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partialmethod
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from armsight.data import Array, Body, Correspondences, JointStates, Missed, Points, PoseEstimate, Record, Shot
from armsight.geometry.pose import left_axes
from armsight.vision.pose.shot_pose import shot_pose

if TYPE_CHECKING:
    from armsight.loop.estimators import KalmanEstimator, Mounting, Remembered
    from armsight.loop.finding import HealthFinding
    from armsight.loop.references.strapdown import Samples

#: The points of a pose that was recorded without them.
NO_POINTS = Points(
    np.zeros(0, np.int64),
    np.zeros((0, 3)),
    np.zeros((0, 3, 3)),
    np.zeros((0, 3, 0)),
    Correspondences(np.zeros(0, np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, 2, 2))),
)


@dataclass(frozen=True, eq=False)
class ShotDatum(Record):
    """One shot and its result."""

    shot: Shot  #: the images
    result: PoseEstimate | Missed | None  #: what was measured in it; None where it was recorded alone
    arrival_s: float | None = None  #: when the result was there, s, on the clock of the shot's time
    sigma_t_s: float | None = None  #: standard deviation of the time of the exposure, s; None where it is unknown
    outcome: str | None = None  #: what the estimator did with the pose; None without one
    T_base_rig: Array | None = None  #: (4, 4) the rig in the base of the arm; None before the hand-eye calibration
    T_base_tool: Array | None = None  #: (4, 4) the tool as vision measured it; None before
    #: (6, 6) what the health monitor added to the common covariance of the tool's pose; None for nothing.
    suspected: Array | None = None

    @property
    def time_s(self) -> float:
        """The time by which the datum is sorted, s: of the exposure, or of the arrival; 0 without either."""
        return next((t for t in (self.shot.t_s, self.arrival_s) if t is not None), 0.0)

    @property
    def age_s(self) -> float | None:
        """Time from the exposure to the result, s."""
        return None if self.shot.t_s is None or self.arrival_s is None else self.arrival_s - self.shot.t_s

    def to_json(self, body: Body) -> dict[str, Any]:
        """Return the object that every form holds; docs/reference/data.md describes its keys."""
        result = self.result if self.result is not None else Missed(self.shot.problem or "not measured")
        found = shot_pose(self.shot.name, self.shot.t_s, body, result).to_json()
        if self.result is None and self.shot.problem is None:
            found |= {"status": "recorded", "reason": None}
        found |= {"sigma_t_s": self.sigma_t_s, "arrival_s": self.arrival_s, "age_s": self.age_s}
        if isinstance(result, PoseEstimate):
            found |= {
                "T_left_body": result.T_left_body.tolist(),
                "covariance_precision_body": result.cov_noise.tolist(),
                "points": len(result.points.ids),
            }
        if self.outcome is not None:
            found["outcome"] = self.outcome
        if self.T_base_tool is not None:
            found["T_base_tool"] = self.T_base_tool.tolist()
        if self.suspected is not None:
            found["covariance_suspected"] = self.suspected.tolist()
        return found


@dataclass(frozen=True, eq=False)
class JointsDatum(Record):
    """One batch of joint readings, and the estimate that followed from it."""

    states: JointStates  #: the readings
    #: (4, 4) estimated pose of the tool at the newest reading; None without an estimator
    T_base_tool: Array | None = None
    cov: Array | None = None  #: (6, 6) its covariance, right tangent [m; rad]
    vision_age_s: float = np.inf  #: time since the newest measurement used, s; infinite before the first
    #: name and samples of the reference that came after these readings; None without.
    felt: tuple[str, Samples] | None = None

    @property
    def time_s(self) -> float:
        """Time of the newest reading, s."""
        return float(self.states.t_s[-1])

    def to_json(self, body: Body) -> dict[str, Any]:
        """Return the object that every form holds; ``body`` is not needed."""
        found: dict[str, Any] = {"t_s": self.states.t_s.tolist(), "q_rad": self.states.q.tolist()}
        if self.T_base_tool is not None and self.cov is not None:
            T = self.T_base_tool
            found |= {
                "status": "ok" if np.isfinite(self.vision_age_s) else "predicted",
                "vision_age_s": self.vision_age_s,
                "tool_position_m": T[:3, 3].tolist(),
                "tool_quaternion_wxyz": quaternion(T[:3, :3]),
                "tool_covariance": left_axes(T, self.cov).tolist(),
            }
        return found


@dataclass(frozen=True)
class NoteDatum:
    """A line for the log: what was rejected and why, what began."""

    time_s: float  #: when, s
    text: str  #: the line
    level: str = "info"  #: info, warning or error
    #: of a health monitor, those that hold now; None where it says nothing of them
    findings: tuple[str, ...] | None = None

    def to_json(self, body: Body) -> dict[str, Any]:
        """Return the object that streams hold; ``body`` is not needed."""
        return {"t_s": self.time_s, "level": self.level, "text": self.text}


@dataclass(frozen=True)
class EventDatum:
    """Something that replay needs besides shots and joints: a new estimator, a new mounting."""

    time_s: float  #: when, s
    content: Mapping[str, Any]  #: JSON

    def to_json(self, body: Body) -> dict[str, Any]:
        """Return the content; ``body`` is not needed."""
        return dict(self.content)


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Return the quaternion w x y z of a rotation (3, 3), w not below zero.

    As :func:`~armsight.geometry.rotation.quaternion_wxyz` to the rounding, at a fiftieth of the time for a single one:
    many are published a second. Shepperd, J. Guidance and Control 1(3), 1978: the largest of the four is found first.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    found = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    best = max(range(4), key=lambda k: found[k][k])
    w, x, y, z = found[best]
    scale = math.copysign(0.5 / math.sqrt(found[best][best]), w)
    return w * scale, x * scale, y * scale, z * scale


def mounting_event(mounting: Mounting) -> dict[str, Any]:
    """Return the content of the event that a mounting is known."""
    return {
        "event": "mounting",
        "T_base_rig": mounting.T_base_rig.tolist(),
        "T_tool_body": mounting.T_tool_body.tolist(),
        "covariance": mounting.cov.tolist(),
    }


def estimator_event(estimator: KalmanEstimator, *, anew: bool) -> dict[str, Any]:
    """Return the content of the event that an estimator begins; ``anew``: it is given all measured before first."""
    prior, delay, learns_delay = estimator.settings
    given = {"prior": asdict(prior), "delay": asdict(delay), "learns_delay": learns_delay}
    return {"event": "estimator", "anew": anew, **given}


def restored_event(state: Remembered) -> dict[str, Any]:
    """Return the content of the event that an estimator went on from an earlier state."""
    clock = None if state.clock is None else [None if np.isnan(value) else value for value in state.clock.tolist()]
    return {"event": "restored", "state": state.x.tolist(), "covariance": state.P.tolist(), "clock": clock}


def remeasured_event(poses: Sequence[tuple[float, PoseEstimate | Missed]]) -> dict[str, Any]:
    """Return the content of the event that shots were measured again with another rig: time, s, and result of each."""
    rows: list[dict[str, Any]] = []
    for t_s, pose in poses:
        rows.append({"t_s": t_s, "T_left_body": None})
        if isinstance(pose, PoseEstimate):
            named = {"T_left_body": pose.T_left_body, "covariance_body": pose.cov}
            named |= {"covariance_precision_body": pose.cov_noise}
            rows[-1] |= {name: value.tolist() for name, value in named.items()}
    return {"event": "remeasured", "shots": rows}


Datum = ShotDatum | JointsDatum | NoteDatum | EventDatum


class HealthNotes:
    """Makes a note of each finding of a health monitor: when it begins, forbids results, is put right, or is taken back."""

    def __init__(self) -> None:
        self._before: dict[tuple[object, ...], HealthFinding] = {}

    def of(self, time_s: float, findings: Sequence[HealthFinding]) -> Iterator[NoteDatum]:
        """Yield what changed at a time, s: a warning where results must not be trusted because of it."""
        now: dict[tuple[object, ...], HealthFinding]
        now = {(each.subject, each.forbids, each.corrected_s): each for each in findings}
        before, self._before = self._before, now
        lines = tuple(each.line() for each in findings if each.forbids and each.corrected_s is None)
        for key in (each for each in now if each not in before):  # in the order of the findings
            wrong = now[key].forbids and now[key].corrected_s is None
            yield NoteDatum(time_s, now[key].line(), "warning" if wrong else "info", lines)
        for gone in (before[key] for key in before if key not in now):
            if gone.subject not in {each.subject for each in findings}:
                yield NoteDatum(time_s, f"no longer found: {gone.line()}", "info", lines)


class Publisher(Protocol):
    """Takes data and returns at once."""

    def put(self, datum: Datum) -> None:
        """Take a datum."""

    def pause(self) -> None:
        """Leave the interpreter to the caller until :meth:`resume`: begin to publish no other datum. Returns at once."""

    def resume(self) -> None:
        """Publish again."""

    def close(self) -> None:
        """Publish what was taken, and end."""


class Fanout:
    """Publishes to several sinks; with none it does nothing."""

    def __init__(self, sinks: Iterable[Publisher] = ()) -> None:
        self.sinks = tuple(sinks)

    def put(self, datum: Datum) -> None:
        """Hand a datum to every sink."""
        for sink in self.sinks:
            sink.put(datum)

    def _every(self, what: str) -> None:
        for sink in self.sinks:
            getattr(sink, what)()

    pause = partialmethod(_every, "pause")
    resume = partialmethod(_every, "resume")
    close = partialmethod(_every, "close")
