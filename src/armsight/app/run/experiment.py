"""The chapter's experiment: calibrate, find where everything is, drive the arm, see who is right, and close the loop.

One sequence for the workcell and for real devices (:class:`~armsight.app.run.setup.Station`). What a device failure or
an interrupt leaves is a :class:`Outcome` with everything measured until then; the arm is stopped first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from armsight.app.interrupts import uninterrupted
from armsight.app.run.motion_file import MotionPlan
from armsight.app.run_beside import steady
from armsight.app.run.calibrate import HandEyeRun, find_delay, find_mounting
from armsight.app.run.record import Log, Segment
from armsight.app.run.loop import PERIOD_S, Loop
from armsight.app.run.controllers import Planned
from armsight.app.run_passes import closed_on, drive, planned
from armsight.app.run_ready import enable, rehearse
from armsight.app.run.setup import Station
from armsight.data import Array, Body, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, DeviceError
from armsight.loop.estimators import Delay, KalmanEstimator, Prior
from armsight.loop.servo import PoseServo, Timing
from armsight.robot.trajectories import point_to_point
from armsight.vision.follow.follower import Follower
from armsight.vision.rig import StereoRig

Progress = Callable[[str], None]
#: Sigma of the delay before it is measured, s.
_UNKNOWN_DELAY = Delay(0.02, 0.02)
#: So many shots are kept as images: a recording for whoever wants to try the stages on them.
KEPT_SHOTS = 12
#: Links of an arm that stands creep in their backlash, unseen by the potentiometers: half a gap of 0.2 degree in seconds.
PRIOR = Prior(creep_rad=float(np.deg2rad(0.05)))
#: From an image's arrival to its command: our own time, and the wait for the loop's next turn, s.
_OWN_S = 0.002 + PERIOD_S / 2
_STALE_S = 0.05


@dataclass
class Outcome:
    """What a run has come to.

    Attributes:
        body: that was looked for.
        log: everything, as it came.
        handeye: where cameras and body are; None before they were found.
        delay: how late the cameras' stamps are.
        open_s: when the pass with potentiometers alone began and ended, board's clock; None before.
        closed_s: the same of the pass with the loop closed.
        covered_s: when the body was hidden on purpose, from and to; None where it was not.
        kept: the first shots of the motions.
        picture: the first image with the body found in motion, and the pose.
        ended_by: what ended the run early; None where it ran to its end.
        interrupted: whether that was the keyboard.
    """

    body: Body
    log: Log = field(default_factory=Log)
    handeye: HandEyeRun | None = None
    delay: Delay = _UNKNOWN_DELAY
    open_s: tuple[float, float] | None = None
    closed_s: tuple[float, float] | None = None
    covered_s: tuple[float, float] | None = None
    kept: list[Shot] = field(default_factory=list)
    picture: tuple[Shot, PoseEstimate] | None = None
    ended_by: ArmsightError | None = None
    interrupted: bool = False

    @property
    def delay_found(self) -> bool:
        """Whether the delay was measured."""
        return self.delay is not _UNKNOWN_DELAY

    @property
    def said(self) -> str | None:
        """What ended the run early, in words; None where it ran to its end."""
        return "interrupted" if self.interrupted else None if self.ended_by is None else str(self.ended_by)


def run_experiment(
    station: Station,
    rig: StereoRig,
    plan: MotionPlan,
    targets: Array,
    *,
    progress: Progress,
    cover: Callable[[float, float], None] | None = None,
    close_loop: bool = True,
) -> Outcome:
    """Run the experiment.

    Args:
        station: where.
        rig: its calibrated cameras.
        plan: the motions; the arm stands at their start.
        targets: (N, 6) joint angles of the hand-eye poses.
        progress: called with a line about what is being done.
        cover: hides the body from one time to another; None where nobody can.
        close_loop: whether the motions are made a second time with the loop closed.

    Returns:
        All that was measured, also where something ended it early.
    """
    outcome = Outcome(station.target.body)
    with steady(in_time=station.clock is not None):
        _run(station, rig, plan, targets, outcome, progress, cover, close_loop)
    return outcome


def _run(
    station: Station,
    rig: StereoRig,
    plan: MotionPlan,
    targets: Array,
    outcome: Outcome,
    progress: Progress,
    cover: Callable[[float, float], None] | None,
    close_loop: bool,
) -> None:
    """Run the experiment; what ends it early is told in the outcome, and the arm is stopped."""
    loop: Loop | None = None
    try:
        progress("making ready to follow the body")
        follower = Follower(rig, station.target)
        if station.clock is not None:
            rehearse(station.arm)
            station.board.receive(_STALE_S)  # what lay in the wire's buffer meanwhile
        loop = Loop(station, follower, outcome.log, KalmanEstimator(station.arm, prior=PRIOR, delay=_UNKNOWN_DELAY))
        enable(station.board)
        _require_seen(loop, station, plan)
        _prepare(loop, station, plan, targets, outcome, progress)
        _passes(loop, station, plan, outcome, progress, cover, close_loop)
    except (ArmsightError, KeyboardInterrupt) as error:
        outcome.interrupted = isinstance(error, KeyboardInterrupt)
        outcome.ended_by = error if isinstance(error, ArmsightError) else None
    finally:  # whatever it was, a mistake of ours among it: the arm stops
        if loop is not None:
            with uninterrupted() as again:  # who presses Ctrl-C twice wants the arm stopped no less
                _stopped(loop)
                loop.close_record()
            outcome.interrupted = outcome.interrupted or bool(again)


def _stopped(loop: Loop) -> None:
    """Bring the arm to rest, whatever else does not answer any more."""
    try:
        loop.stop()
    except ArmsightError:
        return  # told what it must, or gone: then its own silence reaction holds or releases the arm


def _require_seen(loop: Loop, station: Station, plan: MotionPlan) -> None:
    """Raise where the body is not in view at the start: everything after would be for nothing."""
    here = plan.start if station.clock is None else loop.log.joints[-1].q[-1]  # a real arm stands about there
    there = point_to_point(station.arm, np.clip(here, station.arm.q_min, station.arm.q_max), plan.start)
    look_s = there.duration_s + max(0.3, 3.0 / station.rate_hz)
    loop.run_until_seen(Planned(there, loop.t_s, station.gravity), look_s, Segment("calibration", "", "", False))
    results = [result for _, _, result in loop.log.poses]
    if any(isinstance(result, PoseEstimate) for result in results):
        return
    if not results:
        raise DeviceError("no shot came while the arm stood: are the cameras running?")
    missed = next(result for result in results if isinstance(result, Missed))
    raise ArmsightError(
        f"the body {station.target.body.name} is not seen where the arm stands ({missed.reason}): bring it into the view "
        "of both cameras before the run"
    )


def _prepare(
    loop: Loop, station: Station, plan: MotionPlan, targets: Array, outcome: Outcome, progress: Progress
) -> None:
    """Find where cameras and body are, and how late the images come; the arm ends at the plan's start."""
    arm, gravity = station.arm, station.gravity
    outcome.handeye = find_mounting(loop, arm, plan.start, targets, gravity, progress)
    loop.mounting = outcome.handeye.mounting
    progress("how late the images come: a sweep of the joints")
    middle = plan.motions[0].trajectory.at(plan.motions[0].trajectory.duration_s).q
    outcome.delay = find_delay(loop, arm, targets[-1], middle, gravity)
    back = point_to_point(arm, middle, plan.start)
    there = Segment("calibration", "to the start", "joints", False, trajectory=back)
    loop.begin(KalmanEstimator(arm, prior=PRIOR, delay=outcome.delay, learns_delay=False))
    loop.run(Planned(back, loop.t_s, gravity), back.duration_s + 0.5, there)


def _passes(
    loop: Loop,
    station: Station,
    plan: MotionPlan,
    outcome: Outcome,
    progress: Progress,
    cover: Callable[[float, float], None] | None,
    close_loop: bool,
) -> None:
    """Make the motions with potentiometers alone, and with the loop closed."""

    def started(motion: str, kind: str, duration_s: float) -> None:
        if cover is not None and kind == "circle" and outcome.covered_s is None:
            begin = loop.t_s + 0.4 * duration_s
            outcome.covered_s = (begin, begin + 0.5)
            cover(*outcome.covered_s)

    def seen(shot: Shot, result: PoseEstimate | Missed) -> None:
        outcome.kept.append(shot)
        if isinstance(result, PoseEstimate) and outcome.picture is None:
            outcome.picture = (shot, result)
        if len(outcome.kept) >= KEPT_SHOTS:
            loop.on_shot = lambda shot, result: None

    loop.on_shot = seen
    begin = loop.t_s
    outcome.open_s = (begin, begin)
    try:
        drive(loop, plan, planned(station.gravity), closed=False, progress=progress, started=started)
    finally:
        outcome.open_s = (begin, loop.t_s)
    if not close_loop:
        return
    _to_start(loop, station, plan)
    servo = PoseServo(station.arm, timing(station, outcome.delay))
    begin = loop.t_s
    try:
        drive(loop, plan, closed_on(servo, station.gravity), closed=True, progress=progress)
    finally:
        outcome.closed_s = (begin, loop.t_s)


def _to_start(loop: Loop, station: Station, plan: MotionPlan) -> None:
    """Take the arm from the end of the motions to their start: they need not end where they began."""
    last = plan.motions[-1].trajectory
    end = last.at(last.duration_s).q
    if np.allclose(end, plan.start, rtol=0.0, atol=1e-6):
        return
    back = point_to_point(station.arm, end, plan.start)
    there = Segment("calibration", "back to the start", "joints", False, trajectory=back)
    loop.run(Planned(back, loop.t_s + PERIOD_S, station.gravity), back.duration_s + 0.5, there)


def timing(station: Station, delay: Delay) -> Timing:
    """Return the loop's timing as measured: its gain follows from it."""
    return Timing(PERIOD_S, 1.0 / station.rate_hz, max(delay.delay_s, 0.0) + _OWN_S)
