"""What a loop finds by moving the arm: the poses of cameras and body on it, the delay of the images, and the shutters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armsight.data import Array, JointStates, Missed, PoseEstimate, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import inverse, mean_pose, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.delay import MIN_MEASUREMENTS, estimate_delay
from armsight.loop.estimators import Delay, Mounting, Prior
from armsight.loop.handeye.handeye import TRUSTED_M, TRUSTED_RAD, HandEye, calibrate_handeye, require_known
from armsight.loop.identify.misread import require_fitting
from armsight.loop.running.controllers import Planned, Sweep
from armsight.loop.running.log import RunSegment, Seen
from armsight.loop.running.loop import Loop
from armsight.loop.sync_led import with_led
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import point_to_point
from armsight.vision.pose.shutter import TimedShot, estimate_shutters, measure_moving
from armsight.vision.rig import Shutters

Progress = Callable[[str], None]
#: How long the arm stands before it is measured, and the least duration of the measurement, s.
SETTLE_S, LOOK_S = 0.25, 0.1
DELAY_REST_S = 1.0  # before and after the sweep
#: Duration of the sweep, s, and the least number of shots in it: it lasts longer with slow cameras. Some may be missed.
SWEEP_S, SWEEP_SHOTS = 4.0, MIN_MEASUREMENTS + 6
#: In the sweep the joints stay on one side of their backlash, so their errors change little beyond what can be learned.
STEADY = Prior(rest_rad=float(np.deg2rad(0.02)), rest_travel_rad=0.5, flip_rad=0.0, flip_float_rad=0.0)
#: Skew and readout that count as found: so many sigmas from zero, and so many seconds (skew; readout).
_SHUTTER_SIGMAS, _SHUTTER_LEAST_S = 6.0, np.array([2e-4, 1e-3])
_SAMPLES = 50  # candidates for each pose
_NEAR = np.radians(70.0)  # a joint that rotated further has changed to another configuration of the arm


def handeye_poses(arm: Arm, around: Array, count: int, seed: int) -> Array:
    """Sample joint angles (count, n), rad, that show the body from many sides, near given ones (M, n) that have it in view.

    They are in the order of a short way: from the first of ``around`` always on to the nearest.

    Raises:
        InputError: the arm reaches too few such poses.
    """
    rng = np.random.default_rng([seed, 20])
    found: list[Array] = []
    for _ in range(_SAMPLES * count):
        if len(found) == count:
            break
        weights = rng.dirichlet(np.full(len(around), 0.7))
        T = arm.forward(weights @ around)
        rotation = np.radians(20.0) * rng.uniform(-1, 1, 3)
        q = arm.inverse(
            pose(T[:3, :3] @ exp_so3(rotation), T[:3, 3] + rng.uniform(-0.03, 0.03, 3)), near=weights @ around
        ).best
        if q is not None and np.abs(q - weights @ around).max() < _NEAR:
            found.append(q)
    if len(found) < count:
        raise InputError(
            f"{arm.name} reaches {len(found)} of {_SAMPLES * count} poses sampled around those of the motion, {count} "
            "are needed: choose poses further from the limits of its joints"
        )
    way = [around[0]]
    while found:
        way.append(found.pop(int(np.argmin([np.abs(q - way[-1]).max() for q in found]))))
    return np.array(way[1:])


@dataclass(frozen=True, eq=False)
class HandEyeRun(Record):
    """The result of the hand-eye motions."""

    #: poses of cameras and body on the arm. They define the base and the tool frame of the run: the geometry of a real arm
    #: defines its base only to within its errors. So their covariance is zero; how well the arm agrees is in ``found``.
    mounting: Mounting
    found: HandEye  #: the hand-eye calibration
    q: Array  #: (N, n) potentiometer readings at rest at each pose that was used, rad
    Ts_left_body: Array  #: (N, 4, 4) measured poses of the body in the left camera's frame
    covs: Array  #: (N, 6, 6) their covariances, right tangents [m; rad]
    approach: Array  #: (N, n) direction each joint came from: 1 with rising angle, -1 with falling angle, 0 unmoved
    missed: tuple[str, ...]  #: poses at which the body was not measured, and why

    @classmethod
    def of(
        cls, arm: Arm, found: HandEye, q: Array, Ts: Array, covs: Array, approach: Array, missed: tuple[str, ...]
    ) -> HandEyeRun:
        """Return the result of a calibration; the arguments are the attributes."""
        return cls(replace(Mounting.of(found, arm), cov=np.zeros((12, 12))), found, q, Ts, covs, approach, missed)


@dataclass(frozen=True, eq=False)
class VisitedPose(Record):
    """A pose of an arm at rest."""

    q: Array  #: (n,) potentiometer readings, rad
    T_left_body: Array  #: (4, 4) measured pose of the body in the left camera's frame
    cov: Array  #: (6, 6) its covariance, right tangent [m; rad]
    approach: Array  #: (n,) direction each joint came from: 1 with rising angle, -1 with falling angle, 0 unmoved

    @classmethod
    def of(cls, q: Array, seen: Sequence[PoseEstimate], moved: Array) -> VisitedPose:
        """Return the mean of the poses ``seen`` at readings q (n,), rad, reached by a motion of the joints (n,), rad."""
        cov = np.mean([r.cov - r.cov_noise for r in seen], axis=0)
        cov = cov + np.mean([r.cov_noise for r in seen], axis=0) / len(seen)
        approach = np.sign(np.where(np.abs(moved) > np.radians(0.5), moved, 0.0))
        return cls(q, mean_pose(np.array([r.T_left_body for r in seen])), cov, approach)


def find_mounting(loop: Loop, q_start: Array, targets: Array, progress: Progress) -> HandEyeRun:
    """Visit joint angles (N, n), rad, from where the arm stands (n,), measure the body at rest, calibrate hand and eye.

    Raises:
        CalibrationError: too few poses were seen.
        DeviceError: the board or a camera failed.
    """
    visited: list[VisitedPose] = []
    missed: list[str] = []
    rows: list[slice] = []
    q_from = q_start
    for n, q_to in enumerate(targets):
        progress(f"hand-eye: pose {n + 1} of {len(targets)}")
        before = len(loop.log.poses)
        found = visit(loop, q_from, q_to, f"hand-eye {n + 1}")
        if isinstance(found, Missed):
            missed.append(found.reason)
        else:
            visited.append(found)
            rows.append(slice(before, len(loop.log.poses)))
        q_from = q_to
    if len(visited) < 12:
        raise CalibrationError(
            f"the body was seen at {len(visited)} of {len(targets)} poses of the arm; 12 at least are needed: "
            + (missed[0] if missed else "move it into the view of both cameras")
        )
    progress("hand-eye: calibrating")
    if loop.put_cameras_right():
        visited = [_again(each, loop.log.poses[part]) for each, part in zip(visited, rows, strict=True)]
    return loop.compute(lambda: handeye_of(loop.setup.arm, visited, tuple(missed)))


def _again(visited: VisitedPose, shots: Sequence[Seen]) -> VisitedPose:
    """Return a pose of an arm with the shots of it that were measured anew."""
    seen = [pose for _, _, pose in shots if isinstance(pose, PoseEstimate)]
    return VisitedPose.of(visited.q, seen, visited.approach) if seen else visited


def visit(loop: Loop, q_from: Array, q_to: Array, name: str) -> VisitedPose | Missed:
    """Move from joint angles (n,), rad, to others, and measure the body at rest; ``name`` is the pose's in the log.

    Raises:
        DeviceError: the board or a camera failed.
    """
    way, log, setup = point_to_point(loop.setup.arm, q_from, q_to), loop.log, loop.setup
    settle_s = SETTLE_S + 2.0 * setup.board.abilities.latency_s
    loop.go(way, settle_s, RunSegment("calibration", name, "joints"), watch=False)
    shots, batches = len(log.poses), len(log.joints)
    stands = Planned(way, loop.t_s - way.duration_s, setup.gravity)
    loop.run_until_seen(stands, max(LOOK_S, 3.0 / setup.rate_hz), RunSegment())
    results = [result for _, _, result in log.poses[shots:]]
    good = [r for r in results if isinstance(r, PoseEstimate)]
    if not good:
        return Missed(f"{name}: " + (str(getattr(results[-1], "reason", "")) if results else "no shot came"))
    q = np.concatenate([s.q for s in log.joints[batches:]]).mean(axis=0)
    return VisitedPose.of(q, good, q_to - q_from)


def handeye_of(arm: Arm, visited: Sequence[VisitedPose], missed: tuple[str, ...], quick: bool = False) -> HandEyeRun:
    """Calibrate hand and eye of a nominal arm from four poses at least; ``missed``: where the body was not, and why.

    Raises:
        CalibrationError: the motions leave a direction open, or the arm's table is grossly wrong.
    """
    q = np.array([each.q for each in visited])
    Ts_left_body, cov = np.array([each.T_left_body for each in visited]), np.array([each.cov for each in visited])
    require_fitting(arm, q, Ts_left_body)
    found = calibrate_handeye(arm.forward(q) @ inverse(arm.T_flange_tool), Ts_left_body, cov, quick=quick)
    require_known(found, Ts_left_body, TRUSTED_M, TRUSTED_RAD)
    return HandEyeRun.of(arm, found, q, Ts_left_body, cov, np.array([each.approach for each in visited]), missed)


def find_delay(loop: Loop, q_start: Array, q_middle: Array) -> Delay:
    """Sweep the joints about a pose (n,), rad, where the arm then stands; estimate the images' delay and the shutters.

    The loop's mounting is known; its shutters and its delay are set.

    Raises:
        CalibrationError: the sweep does not determine the delay.
        DeviceError: the board or a camera failed.
    """
    arm, log = loop.setup.arm, loop.log
    way = point_to_point(arm, q_start, q_middle)
    loop.go(way, DELAY_REST_S, RunSegment("calibration", "sweep's start", "joints"), watch=False)
    sweep = Sweep(arm, q_middle, duration_s=max(SWEEP_S, SWEEP_SHOTS / loop.setup.rate_hz))
    before = len(log.poses)
    controller = Planned(sweep, loop.t_s, loop.setup.gravity)
    loop.run(controller, sweep.duration_s, RunSegment("calibration", "sweep", "joints", trajectory=sweep))
    shots = [(t, p) for _, t, p in log.poses[before:] if isinstance(p, PoseEstimate)]
    loop.run(controller, DELAY_REST_S, RunSegment(), watch=False)
    states = JointStates(np.concatenate([s.t_s for s in log.joints]), np.concatenate([s.q for s in log.joints]))
    newest = states.t_s > states.t_s[-1] - sweep.duration_s - 2 * DELAY_REST_S
    swept = JointStates(states.t_s[newest], states.q[newest])
    if len(shots) < MIN_MEASUREMENTS:
        raise CalibrationError(
            f"the body was seen {len(shots)} times in {sweep.duration_s:.1f} s of sweep, {MIN_MEASUREMENTS} times at "
            "least are needed to estimate the delay of the images: are the cameras slower than "
            f"{loop.setup.rate_hz:g} Hz, or is the body "
            "out of view near the end of the first motion?"
        )
    shutters, shots = loop.compute(lambda: _at_one_time(loop, shots))
    assert loop.mounting is not None
    seen = [loop.mounting.pose_measurement(pose, t) for t, pose in shots]
    sync_s = loop.setup.sync_s if shutters is None else 0.0  # what is not known of the shutters is in the covariances
    prior = replace(STEADY, rounded_rad=loop.setup.board.abilities.rounded_rad)
    delay = loop.compute(lambda: estimate_delay(arm, swept, seen, prior=prior, sync_s=sync_s))
    blinked = None if loop.led is None else loop.led.pooled()
    if loop.led is not None and blinked is not None and loop.led.row_shares is not None:
        by_sweep = delay
        delay, shutters = with_led(by_sweep, shutters, blinked, loop.led.row_shares, loop.led.reading)
        sigma_s = float(np.hypot(by_sweep.sigma_s, delay.sigma_s))
        loop.led.apart = (by_sweep.delay_s - delay.delay_s, sigma_s, loop.t_s)
    if loop.shutters is None and shutters is not None:
        loop.health.times_found()
    loop.shutters, loop.delay_s = shutters, delay.delay_s
    if shutters is not None:
        loop.follower.expose_apart(float(np.hypot(shutters.skew_s, shutters.jitter_s)))
    return delay


def _at_one_time(
    loop: Loop, shots: list[tuple[float, PoseEstimate]]
) -> tuple[Shutters | None, list[tuple[float, PoseEstimate]]]:
    """Return when the cameras expose, as known or as the sweep shows, and its poses moved to one time by it."""
    rig, body = loop.follower.rig, loop.setup.target.body
    timed = [TimedShot(t, pose.points.seen, pose.T_left_body) for t, pose in shots]
    shutters = loop.shutters or _visible(estimate_shutters(rig, body, timed, readout=True))
    shutters = shutters or _visible(estimate_shutters(rig, body, timed))
    if shutters is None:
        return None, shots
    moved = measure_moving(rig, body, timed, shutters)
    return shutters, [
        (t, pose) for (t, _), (pose, _) in zip(shots, moved, strict=True) if isinstance(pose, PoseEstimate)
    ]


def _visible(found: Shutters | Missed) -> Shutters | None:
    """Return shutters that differ from simultaneous ones by more than chance, and by enough to matter."""
    if isinstance(found, Missed):
        return None
    parameters = np.array([found.skew_s, found.readout_s])
    shown = np.abs(parameters) > np.maximum(_SHUTTER_SIGMAS * found.sigmas, _SHUTTER_LEAST_S)
    return found if shown.any() else None
