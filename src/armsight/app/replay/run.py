"""Run again what was recorded: the estimators of a run, or the measurement of a recording's images or tags.

In: a :class:`~.recorded.RecordedRun`, or a rig, a target and a source. Out: :class:`Replayed`. The estimator is given what
it was given when the run was recorded, in the same order: where nothing was changed its answers are the same to the last
digit.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from armsight.app.replay.recorded import RecordedDatum, RecordedRun
from armsight.data import Array, Body, JointStates, Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.loop.estimators import (
    ArmEstimate,
    Delay,
    Estimator,
    KalmanEstimator,
    LatestEstimator,
    Mounting,
    Prior,
    Remembered,
)
from armsight.loop.identify.odometry import Odometry, odometry
from armsight.loop.running.beside import Fused, FusedRow, HeadingRow
from armsight.loop.running.data import EventDatum, JointsDatum, Publisher, ShotDatum
from armsight.robot.kinematics.arm import Arm
from armsight.vision.detections import SeenShot
from armsight.vision.follow.follower import Follower, follows
from armsight.vision.markers.marker import Target
from armsight.vision.pose.measure import measure, measure_seen
from armsight.vision.pose.shot_pose import ShotPose, shot_pose
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source
from armsight.vision.sources.bag.states import JointStream

_Seen = TypeVar("_Seen", Shot, SeenShot)
#: Every estimator; each takes the arm, and by name ``prior`` and ``delay``.
ESTIMATORS: dict[str, Callable[..., Estimator]] = {"kalman": KalmanEstimator, "latest": LatestEstimator}


@dataclass(frozen=True)
class Replayed:
    """What came out."""

    body: Body  #: what was measured
    poses: tuple[ShotPose, ...]  #: one a shot
    live: tuple[JointsDatum, ...] = ()  #: readings and estimate, one a batch; none without an estimator
    joints: JointStream | None = None  #: the joint readings that a bag holds; None without
    #: largest absolute difference of the estimates to those recorded, by name; none where not comparable.
    differences: dict[str, float] | None = None
    beside: FusedRow | HeadingRow | None = None  #: what a reference beside vision did; None without
    odometry: Odometry | None = None  #: joints alone against the estimates with fresh vision; None without


_FRESH_S = 0.1  # s; estimates that odometry is compared with have seen the body since


class Pace:
    """Waits so that recorded times pass at a rate, in seconds of the recording a second; at 0 it does not."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._began: tuple[float, float] | None = None

    def wait(self, t_s: float | None) -> None:
        """Wait until a time of the recording is due, s."""
        if self._rate <= 0.0 or t_s is None:
            return
        now = time.monotonic()
        if self._began is None or t_s < self._began[1]:
            self._began = (now, t_s)
        time.sleep(max(0.0, self._began[0] + (t_s - self._began[1]) / self._rate - now))


def replay_run(
    recorded: RecordedRun,
    arm: Arm,
    body: Body,
    *,
    estimator: str,
    pace: Pace,
    publisher: Publisher,
    changed: bool,
    beside: Fused | None = None,
    own: bool = False,
) -> Replayed:
    """Run the estimators of a run again, with an arm and a body; the publisher is given what comes out.

    ``changed``: whether arm or estimator are others, whose estimates are not compared with the recorded ones; ``beside``: a
    reference whose readings are fused; ``own``: whether these are the run's own, which it recorded.
    """
    state = _RunAgain(arm, estimator, changed, beside)
    poses, live, before = list[ShotPose](), list[JointsDatum](), list[RecordedDatum]()
    for each in recorded.data:
        if each.kind is EventDatum:
            state.event(each.content)
        elif each.kind is JointsDatum:
            states = each.states
            pace.wait(float(states.t_s[-1]))
            if (estimate := state.joints(states, each.felt if own else None)) is not None:
                live.append(JointsDatum(states, estimate.T_base_tool, estimate.cov, estimate.vision_age_s))
                before.append(each)
                publisher.put(live[-1])
        else:
            result, t_s, name = each.result, each.content["t_s"], str(each.content["shot"])
            outcome = state.vision(result, t_s, each.content)
            poses.append(shot_pose(name, t_s, body, result))
            shot = Shot(name, None, None, t_s)
            publisher.put(ShotDatum(shot, result, each.content["arrival_s"], each.content["sigma_t_s"], outcome))
    same = None if changed or (beside is not None and not own) else _differences(before, live, body)
    row = None if beside is None or own else _row(beside, before, live, body)
    seen = [each for each in live if each.vision_age_s < _FRESH_S]
    q, Ts = np.array([each.states.q[-1] for each in seen]), np.array([each.T_base_tool for each in seen])
    return Replayed(body, tuple(poses), tuple(live), None, same, row, odometry(arm, q, Ts) if seen else None)


def _row(beside: Fused, before: list[RecordedDatum], live: list[JointsDatum], body: Body) -> FusedRow | HeadingRow:
    """Return what a reference did to the estimates since the first of its windows."""
    rows = [(was, now) for was, now in zip(before, live, strict=True) if now.states.t_s[-1] >= beside.begin_s]
    fused = [now.to_json(body) for _, now in rows]
    p_was, cov_was = (np.array([was.content[key] for was, _ in rows]) for key in ("tool_position_m", "tool_covariance"))
    p, covs = (np.array([each[key] for each in fused]) for key in ("tool_position_m", "tool_covariance"))
    if not len(rows):
        return beside.row(covs)
    without = float(np.sqrt(np.einsum("nii->ni", cov_was)[:, :3].sum(axis=1).mean()))
    return beside.row(covs, (float(np.sqrt(((p - p_was) ** 2).sum(axis=1).mean())), without))


class _RunAgain:
    """The estimator of a run, and what was given to it."""

    def __init__(self, arm: Arm, name: str, changed: bool, beside: Fused | None = None) -> None:
        self._arm, self._name, self._changed, self._beside = arm, name, changed, beside
        self._estimator: Estimator | None = None
        self._mounting: Mounting | None = None
        self._batches: list[JointStates] = []
        self._seen: list[tuple[float, PoseEstimate]] = []

    def event(self, content: dict[str, Any]) -> None:
        if content["event"] == "mounting":
            self._mounting = Mounting(
                *(np.array(content[key], float) for key in ("T_base_rig", "T_tool_body", "covariance"))
            )
            return
        if content["event"] == "restored":
            if self._changed:  # it went on from a state of the run's estimator
                raise InputError(
                    "the rig was put right during this run (--follow-rig): it can be estimated again with the run's own "
                    "arm and estimator only; leave out --arm and --estimator"
                )
            if isinstance(self._estimator, KalmanEstimator):
                state, P, clock = (content.get(key) for key in ("state", "covariance", "clock"))
                known = None if clock is None else np.array(clock, float)
                self._estimator.restore(Remembered(np.array(state), np.array(P), known))
            return
        if content["event"] == "remeasured":  # with cameras that were put right
            again = {row["t_s"]: row for row in content["shots"]}
            self._seen = [
                (t_s, _with_pose(pose, again[t_s]) if t_s in again else pose)
                for t_s, pose in self._seen
                if t_s not in again or again[t_s]["T_left_body"] is not None
            ]
            return
        options: dict[str, Any] = {"prior": Prior(**content["prior"]), "delay": Delay(**content["delay"])}
        if self._name == "kalman":
            options["learns_delay"] = bool(content["learns_delay"])
        self._estimator = ESTIMATORS[self._name](self._arm, **options)
        if content["anew"] and self._mounting is not None:
            # As the loop does when it replaces its estimator: all that was measured before, in order of time.
            seen = list(self._seen)
            for states in self._batches:
                self._estimator.joints(states)
                while seen and seen[0][0] <= states.t_s[-1]:
                    t_s, pose = seen.pop(0)
                    self._estimator.vision(self._mounting.pose_measurement(pose, t_s))

    def joints(self, states: JointStates, felt: tuple[Array, Array] | None) -> ArmEstimate | None:
        self._batches.append(states)
        if self._estimator is None:
            return None
        self._estimator.joints(states)
        if self._beside is not None and felt is not None:
            self._beside.give(self._estimator, *felt)
        elif self._beside is not None:
            self._beside.poll(self._estimator, float(states.t_s[-1]))
        return self._estimator.estimate()

    def vision(self, result: PoseEstimate | Missed, t_s: float | None, content: dict[str, Any]) -> str | None:
        if not isinstance(result, PoseEstimate) or t_s is None:
            return None
        self._seen.append((t_s, result))
        if self._mounting is None or self._estimator is None or "outcome" not in content:
            return None
        measurement = self._mounting.pose_measurement(result, t_s)
        if "covariance_suspected" in content:
            suspected = np.array(content["covariance_suspected"], float)
            measurement = replace(measurement, cov_common=measurement.cov_common + suspected)
        return self._estimator.vision(measurement).value


def _with_pose(pose: PoseEstimate, row: dict[str, Any]) -> PoseEstimate:
    """Return a pose as it was measured again."""
    T, cov, noise = (np.array(row[f"{key}_body"]) for key in ("T_left", "covariance", "covariance_precision"))
    return replace(pose, T_left_body=T, cov=cov, cov_noise=noise)


def _differences(before: list[RecordedDatum], live: list[JointsDatum], body: Body) -> dict[str, float]:
    """Return the largest absolute differences of estimates to the recorded ones, by name with unit."""
    keys = {"position_m": "tool_position_m", "quaternion": "tool_quaternion_wxyz", "covariance": "tool_covariance"}
    found = dict.fromkeys(keys, 0.0)
    for was, now in zip(before, (datum.to_json(body) for datum in live), strict=True):
        for name, key in keys.items():
            found[name] = max(found[name], float(np.abs(np.subtract(was.content[key], now[key])).max()))
    return found


def replay_source(rig: StereoRig, target: Target, source: Source, *, pace: Pace, publisher: Publisher) -> Replayed:
    """Measure the images of a recording again."""
    measured = Follower(rig, target).measure if follows(target) else lambda shot: measure(rig, target, shot)
    with contextlib.closing(source):
        return _shots(((shot, shot) for shot in iter(source.read, None)), measured, target.body, pace, publisher)


def replay_tags(rig: StereoRig, body: Body, shots: Iterable[SeenShot], *, pace: Pace, publisher: Publisher) -> Replayed:
    """Measure the recorded tags again."""
    seen = ((Shot(shot.name, None, None, shot.t_s), shot) for shot in shots)
    return _shots(seen, lambda shot: measure_seen(rig, body, shot), body, pace, publisher)


def _shots(
    shots: Iterable[tuple[Shot, _Seen]],
    measured: Callable[[_Seen], PoseEstimate | Missed],
    body: Body,
    pace: Pace,
    publisher: Publisher,
) -> Replayed:
    poses = []
    for shot, seen in shots:
        pace.wait(shot.t_s)
        result = measured(seen)
        poses.append(shot_pose(shot.name, shot.t_s, body, result))
        publisher.put(ShotDatum(shot, result))
    if not poses:
        raise InputError("the recording ended without a single shot")
    return Replayed(body, tuple(poses))
