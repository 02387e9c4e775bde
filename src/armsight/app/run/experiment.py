"""The experiment: hand-eye calibration, camera delay, the motions in open loop, the motions with the loop closed.

In: a :class:`~armsight.loop.running.setup.Setup` (the workcell or real devices), a calibrated rig and a motion plan. Out: a
:class:`RunResult`. After a device failure or an interrupt it has everything measured until then; the arm is stopped first.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.interrupts import uninterrupted
from armsight.app.run.motion_file import MotionPlan
from armsight.data import Array, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.loop.estimators import Delay, KalmanEstimator, Prior
from armsight.loop.health import HealthFinding, HealthMonitor
from armsight.loop.health.change import Change
from armsight.loop.health.follow import RigFollower
from armsight.loop.running.calibrate import HandEyeRun, Progress, find_delay, find_mounting
from armsight.loop.running.controllers import PERIOD_S, Closed, Controller, Planned
from armsight.loop.running.data import EventDatum, Fanout, Publisher, estimator_event
from armsight.loop.running.log import Log, RunSegment
from armsight.loop.running.loop import Loop, steady
from armsight.loop.running.setup import Setup
from armsight.loop.servo import JointLoops, LoopTiming, PoseServo
from armsight.loop.sync_led import SyncLedWatch, led_findings
from armsight.robot.boards.codes import STATE_TEXTS, BoardState, Command, Fault
from armsight.robot.boards.contract import Abilities, MotionBoard
from armsight.robot.trajectories import Tabled, Trajectory, point_to_point
from armsight.vision.follow.follower import Follower
from armsight.vision.rig import Shutters, StereoRig

#: Largest difference of the joints from the motion's start, rad; and where another controller, as an SO-101's, droops.
_START_RAD, _START_ALONE_RAD = float(np.radians(2.0)), float(np.radians(5.0))
#: How long to wait for a board that is stopping its arm, s.
_SLOWS_S = 3.0
_STEP_S = 0.05
#: Delay of the cameras and its sigma before it is measured, s.
_UNKNOWN_DELAY = Delay(0.02, 0.02)
#: Number of shots that are kept as images: a recording to try the stages on.
KEPT_SHOTS = 12
#: Links of an arm at rest creep within their backlash, unmeasured: by half of a gap of 0.2 degree within seconds.
PRIOR = Prior(creep_rad=float(np.deg2rad(0.05)))
#: Time from an image's arrival to its command, s: computing time, and the mean wait for the next iteration.
_OWN_S = 0.002 + PERIOD_S / 2
#: Longest rest in open loop, s, beyond what the board lags: there is no correction that has to settle.
OPEN_REST_S = 0.5
#: Makes a controller from a trajectory, the time at which it begins, board's clock, s, and how long the arm then rests, s.
Control = Callable[[Trajectory, float, float], Controller]


def enable(board: MotionBoard) -> None:
    """Switch the drives on; an arm held since an earlier host went silent is taken over; other faults are a DeviceError."""
    waited_s = 0.0
    while board.status.state is BoardState.STOPPING and waited_s < _SLOWS_S:
        board.receive(_STEP_S)
        waited_s += _STEP_S
    faults = board.status.faults
    if faults and all(each.fault is Fault.HOST_SILENT for each in faults):
        board.confirm(board.command(Command.CLEAR_FAULTS))
    elif faults or board.status.state is BoardState.STOPPED:
        found = "; ".join(str(fault) for fault in faults) or "the emergency stop was pressed"
        mend = "remove the cause, and switch the board off and on again"
        raise DeviceError(f"the board is not ready: {STATE_TEXTS[board.status.state]} ({found}): {mend}")
    if board.status.state is not BoardState.ENABLED:  # a held arm is taken over without releasing it
        board.enable()


def start_rad(abilities: Abilities) -> float:
    """Return how far a joint may be from the start of a motion before it moves, rad."""
    return _START_ALONE_RAD if abilities.own_controller else _START_RAD


def require_start(setup: Setup, plan: MotionPlan, targets: Array) -> None:
    """Check that the arm is where the motion starts, and that the board allows all joint angles, ``targets`` (N, n) too."""
    states = setup.board.receive(0.2)
    if not len(states.q):
        raise DeviceError("the board reports no joint angles: is the baud rate of its serial port right?")
    q = states.q[-1]
    off = np.abs(q - plan.start)
    if off.max() > start_rad(setup.board.abilities):
        joint = int(off.argmax())
        raise InputError(
            f"joint {joint + 1} reads {np.degrees(q[joint]):.1f} deg, the motion starts at "
            f"{np.degrees(plan.start[joint]):.1f}: bring the arm to the start, or give start_deg; if it is there, "
            f"--arm {setup.arm.name} does not match the board's joint sensors (armsight board monitor)"
        )
    require_range(setup, np.vstack([targets, *(passed(m.trajectory) for m in plan.motions)]))


def require_followed(rig: StereoRig, path: Path) -> None:
    """Reject a rig that cannot be followed, as its file does not say how well it is known."""
    if not rig.cov.any():
        mend = "calibrate it (armsight calibrate), or leave out --follow-rig"
        raise InputError(f"--follow-rig: {path} has no covariance: a moved rig looks like one poorly known: {mend}")


def passed(way: Trajectory) -> Array:
    """Return joint angles (N, n) that a motion passes, rad."""
    return way.at(np.linspace(0.0, way.duration_s, 200)).q


def require_range(setup: Setup, q: Array) -> None:
    """Reject joint angles (N, n), rad, beyond the board's own limits: it would stop the joint on the way."""
    low, high = setup.board.soft_limits()
    beyond = np.maximum(q.max(axis=0) - high, low - q.min(axis=0))
    if beyond.max() > 1e-3:
        joint = int(beyond.argmax())
        raise InputError(
            f"joint {joint + 1} is to go from {np.degrees(q[:, joint].min()):.1f} to {np.degrees(q[:, joint].max()):.1f} "
            f"deg, the board allows {np.degrees(low[joint]):.1f} to {np.degrees(high[joint]):.1f}: change the motion or "
            f"the board's soft limits; or is --arm {setup.arm.name} another arm than the board's?"
        )


@dataclass
class RunResult:
    """What a run was of, and what it measured."""

    setup: Setup  #: the devices
    rig: StereoRig  #: the calibrated cameras
    plan: MotionPlan  #: the motions
    #: what the run was of, as summary.json names it: arm, board, seed, cameras.
    properties: Mapping[str, Any] = field(default_factory=dict)
    began: float = field(default_factory=time.perf_counter)  #: when it began, s
    log: Log = field(default_factory=Log)  #: everything that was measured and commanded
    handeye: HandEyeRun | None = None  #: the hand-eye calibration; None before it was made
    delay: Delay = _UNKNOWN_DELAY  #: delay of the cameras' time stamps
    #: when the cameras expose, given or found by the sweep; None where they do at one time.
    shutters: Shutters | None = None
    #: begin and end of the pass with potentiometers alone, board's clock, s; None before.
    open_s: tuple[float, float] | None = None
    closed_s: tuple[float, float] | None = None  #: begin and end of the pass with the loop closed
    #: begin and end of the time the body was hidden on purpose; None where it was not.
    covered_s: tuple[float, float] | None = None
    kept: list[Shot] = field(default_factory=list)  #: the first shots of the motions
    #: the first shot in motion in which the body was found, and its pose.
    picture: tuple[Shot, PoseEstimate] | None = None
    health: tuple[HealthFinding, ...] = ()  #: why the result must not be trusted; empty where nothing says so
    changes: tuple[Change, ...] = ()  #: what explains a motion of the rig or the body; empty where none was found
    fixed_unseen: tuple[str, ...] = ()  #: names of the fixed bodies that were seen too rarely to be watched
    #: why what was found of a rig that is followed was not put right; None where nothing was left.
    not_corrected: str | None = None
    led: SyncLedWatch | None = None  #: what followed the cameras' clock by the sync LED; None without one
    ended_by: ArmsightError | None = None  #: the error that ended the run early; None where there was none
    interrupted: bool = False  #: whether the keyboard ended the run

    @property
    def delay_found(self) -> bool:
        """Whether the delay was measured."""
        return self.delay is not _UNKNOWN_DELAY

    @property
    def ended_text(self) -> str | None:
        """What ended the run early, as text; None where it ran to its end."""
        return "interrupted" if self.interrupted else None if self.ended_by is None else str(self.ended_by)

    def ended(self, error: BaseException) -> None:
        """Note what ended the run early."""
        self.interrupted = isinstance(error, KeyboardInterrupt)
        self.ended_by = error if isinstance(error, ArmsightError) else None


def run_experiment(
    setup: Setup,
    rig: StereoRig,
    plan: MotionPlan,
    targets: Array,
    *,
    progress: Progress,
    cover: Callable[[float, float], None] | None = None,
    close_loop: bool = True,
    begun: Callable[[Loop], None] = lambda loop: None,
    publisher: Publisher | None = None,
    handeye: HandEyeRun | None = None,
    follow_rig: bool = False,
) -> RunResult:
    """Run the experiment.

    ``plan``: the motions; the arm stands at their start. ``targets``: (N, n) joint angles of the hand-eye poses, rad.
    ``cover``: hides the body from one time to another, board's clock, s; None where that is not possible.
    ``close_loop``: whether the motions are made a second time with the loop closed. ``begun``: called with the loop
    before the drives are switched on. ``handeye``: a hand-eye calibration of this set-up; None to make one by visiting
    the targets. ``follow_rig``: whether a rig that moved is put right where the evidence suffices; it needs a
    covariance.
    """
    result = RunResult(setup, rig, plan, handeye=handeye)

    def work(loop: Loop) -> None:
        loop.rig_follower = RigFollower(rig, setup.target.body) if follow_rig else None
        _prepare(loop, result, targets, progress)
        _passes(loop, result, progress, cover, close_loop)

    return run_visits(result, work, progress, begun, publisher)


def run_visits(
    result: RunResult,
    work: Callable[[Loop], None],
    progress: Progress,
    begun: Callable[[Loop], None],
    publisher: Publisher | None = None,
    *,
    look: bool = True,
) -> RunResult:
    """Switch the drives on, look, and do the work; what ends it early is stored in the result, and the arm is stopped."""
    loop: Loop | None = None
    setup, publisher = result.setup, publisher or Fanout()
    with steady(in_time=setup.clock is not None):
        try:
            progress("preparing to follow the body")
            follower = Follower(result.rig, setup.target, setup.sync_s)
            if setup.clock is not None:
                setup.board.receive(0.05)  # what arrived in the port's buffer meanwhile
            first = KalmanEstimator(setup.arm, prior=prior_of(setup.board), delay=_UNKNOWN_DELAY)
            publisher.put(EventDatum(0.0, estimator_event(first, anew=False)))
            loop = Loop.open(setup, follower, result.log, first, publisher)
            begun(loop)
            enable(setup.board)
            if look:
                _require_seen(loop, result.plan)
            work(loop)
        except (ArmsightError, KeyboardInterrupt) as error:
            result.ended(error)
        finally:  # after any exception, a programming error too: the arm stops
            if loop is not None:
                _close(loop, result)
    return result


def _close(loop: Loop, result: RunResult) -> None:
    with uninterrupted() as again:  # a second Ctrl-C must not keep the arm from stopping
        with contextlib.suppress(ArmsightError):  # the board is gone: it reacts to the silence itself
            loop.stop()
        loop.close_record()
        result.health, result.changes = loop.health.findings(), loop.health.every_change
        result.not_corrected = None if loop.rig_follower is None else loop.rig_follower.rejected
        if loop.led is not None:
            result.led, result.health = loop.led, (*result.health, *led_findings(loop.led))
        result.fixed_unseen = loop.health.fixed_never_seen
    result.interrupted = result.interrupted or bool(again)


def _require_seen(loop: Loop, plan: MotionPlan) -> None:
    setup = loop.setup
    here = plan.start if setup.clock is None else loop.log.joints[-1].q[-1]  # a real arm is only near the start
    there = point_to_point(setup.arm, np.clip(here, setup.arm.q_min, setup.arm.q_max), plan.start)
    look_s = there.duration_s + max(0.3, 3.0 / setup.rate_hz)
    loop.run_until_seen(Planned(there, loop.t_s, setup.gravity), look_s, RunSegment())
    results = [result for _, _, result in loop.log.poses]
    if any(isinstance(result, PoseEstimate) for result in results):
        return
    if not results:
        raise DeviceError("no shot came while the arm stood: are the cameras running?")
    missed = next(result for result in results if isinstance(result, Missed))
    mend = "bring it into the view of both cameras before the run"
    raise ArmsightError(f"the body {setup.target.body.name} is not seen where the arm stands ({missed.reason}): {mend}")


def _prepare(loop: Loop, result: RunResult, targets: Array, progress: Progress) -> None:
    setup, plan, stands = loop.setup, result.plan, result.plan.start
    if loop.led is not None:
        progress("looking for the sync LED")
        loop.find_led()
    if result.handeye is None:
        result.handeye = find_mounting(loop, plan.start, targets, progress)
        stands = targets[-1]
    loop.mounting = result.handeye.mounting
    progress("measuring the delay of the images: a sweep of the joints")
    middle = plan.motions[0].trajectory.at(plan.motions[0].trajectory.duration_s).q
    result.delay = find_delay(loop, stands, middle)
    result.shutters = loop.shutters
    loop.begin(KalmanEstimator(setup.arm, prior=prior_of(setup.board), delay=result.delay, learns_delay=False))
    loop.go(point_to_point(setup.arm, middle, plan.start), 0.5, RunSegment("calibration", "to the start", "joints"))


def _passes(
    loop: Loop, result: RunResult, progress: Progress, cover: Callable[[float, float], None] | None, close_loop: bool
) -> None:
    setup, plan = loop.setup, result.plan

    def started(kind: str, duration_s: float) -> None:
        if cover is not None and kind == "circle" and result.covered_s is None:
            begin = loop.t_s + 0.4 * duration_s
            result.covered_s = (begin, begin + 0.5)
            cover(*result.covered_s)

    def seen(shot: Shot, found: PoseEstimate | Missed) -> None:
        result.kept.append(shot)
        if isinstance(found, PoseEstimate) and result.picture is None:
            result.picture = (shot, found)
        if len(result.kept) >= KEPT_SHOTS:
            loop.on_shot = lambda shot, found: None

    loop.on_shot = seen
    begin = loop.t_s
    result.open_s = (begin, begin)
    try:
        alone: Control = lambda way, start_s, rest_s: Planned(way, start_s, setup.gravity)  # noqa: E731
        drive(loop, plan, alone, closed=False, progress=progress, started=started)
    finally:
        result.open_s = (begin, loop.t_s)
    if not close_loop:
        return
    _to_start(loop, plan)
    servo = PoseServo(setup.arm, timing(setup, result.delay), joint_loops(setup))
    begin = loop.t_s
    try:
        drive(loop, plan, closed_on(servo, lambda: loop.health, setup.gravity), closed=True, progress=progress)
    finally:
        result.closed_s = (begin, loop.t_s)


def drive(
    loop: Loop,
    plan: MotionPlan,
    control: Control,
    *,
    closed: bool,
    progress: Progress = lambda line: None,
    started: Callable[[str, float], None] = lambda kind, duration_s: None,
) -> None:
    """Make all motions of a plan, with its rests; the arm stands at its start.

    ``control`` makes the controller of each motion, closed on vision or not; ``started`` is called with kind and duration,
    s, of each as it begins.
    """
    phase, open_s = "closed_loop" if closed else "open_loop", OPEN_REST_S + 2.0 * loop.setup.board.abilities.latency_s
    for motion in plan.motions:
        progress(f"{'loop closed on vision' if closed else 'joint sensors alone'}: {motion.name}")
        controller = control(Tabled(motion.trajectory), loop.t_s, motion.rest_s)
        segment = RunSegment(phase, motion.name, motion.kind, closed, trajectory=motion.trajectory)
        started(motion.kind, motion.trajectory.duration_s)
        loop.run(controller, motion.trajectory.duration_s, segment)
        loop.run(controller, motion.rest_s if closed else min(motion.rest_s, open_s), replace(segment, phase="rest"))


def closed_on(servo: PoseServo, health: Callable[[], HealthMonitor], gravity: Callable[[Array], Array]) -> Control:
    """Return the control that follows the plan with the loop closed on vision, as far as that may be relied on."""
    return lambda trajectory, start_s, rest_s: Closed(servo, health, trajectory, start_s, gravity, rest_s)


def _to_start(loop: Loop, plan: MotionPlan) -> None:
    last = plan.motions[-1].trajectory
    end = last.at(last.duration_s).q
    if not np.allclose(end, plan.start, rtol=0.0, atol=1e-6):
        back = point_to_point(loop.setup.arm, end, plan.start)
        loop.go(back, 0.5, RunSegment("calibration", "back to the start", "joints"), late_s=PERIOD_S)


def prior_of(board: MotionBoard) -> Prior:
    """Return how far an arm may be off whose joints a board reads."""
    return replace(PRIOR, rounded_rad=board.abilities.rounded_rad)


def timing(setup: Setup, delay: Delay) -> LoopTiming:
    """Return the timing of the loop with the measured delay; the servo's gain follows from it."""
    latency_s, response_s = max(delay.delay_s, 0.0) + _OWN_S, setup.board.abilities.response_s
    return LoopTiming(PERIOD_S, 1.0 / setup.rate_hz, latency_s, response_s)


def joint_loops(setup: Setup) -> JointLoops | None:
    """Return what the servo must know of the joints' own controllers; None where they are ours, with an integral."""
    abilities = setup.board.abilities
    steps_rad = abilities.steps_rad or (0.0,) * setup.arm.joints
    return JointLoops(steps_rad, abilities.rest_rad_s) if abilities.own_controller else None
