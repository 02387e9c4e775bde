"""What a run must know before it: the cameras, where they and the body are, and how late the images come."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from armsight.app.run.record import Segment
from armsight.app.run.loop import Loop
from armsight.app.run.controllers import Planned, Sweep
from armsight.data import Array, JointStates, PoseEstimate, Record, Shot
from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import inverse, mean_pose, pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.delay import LEAST, estimate_delay
from armsight.loop.estimators import Delay, Mounting, Prior
from armsight.loop.handeye.handeye import HandEye, calibrate_handeye
from armsight.robot.arm import Arm
from armsight.robot.trajectories import point_to_point
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.result import Calibration
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board

Progress = Callable[[str], None]
#: How long the arm stands before it is measured, and for how long at least, s.
SETTLE_S, LOOK_S = 0.25, 0.1
DELAY_REST_S = 1.0  # before and after the sweep
#: The sweep lasts so long, s, and longer where slow cameras would not take so many shots meanwhile: some may be missed.
SWEEP_S, SWEEP_SHOTS = 4.0, LEAST + 6
#: In the sweep joints keep their side of the backlash: what they are off beside what can be learned changes little.
STEADY = Prior(rest_rad=float(np.deg2rad(0.02)), rest_travel_rad=0.5, flip_rad=0.0, flip_float_rad=0.0)
_DRAWS = 50  # for each pose wanted
_NEAR = np.radians(70.0)  # a joint that turned further has gone over to another configuration


def calibrated(board_spec: str, shots: Iterable[Shot], progress: Progress) -> Calibration:
    """Calibrate a rig from shots of a board."""
    board = open_board(board_spec)
    pairs, sizes = [], None
    for shot in shots:
        assert shot.left is not None
        assert shot.right is not None
        left, right = grey(shot.left), grey(shot.right)
        sizes = ((left.shape[1], left.shape[0]), (right.shape[1], right.shape[0]))
        pairs.append(Pair(shot.name, board.detect(left), board.detect(right)))
        progress(f"looking for the board: {len(pairs)} pairs")
    if sizes is None:
        raise CalibrationError("no shot of the board")
    return calibrate_boards(board, pairs, sizes, progress=progress)


def handeye_poses(arm: Arm, around: Array, count: int, seed: int) -> Array:
    """Draw joint angles (count, 6) that show the body from many sides: around given ones, near where it is seen.

    They come in the order of a short way: from the first of ``around`` always on to the nearest.

    Args:
        arm: the nominal arm.
        around: (M, 6) joint angles at which the body is in view.
        count: how many.
        seed: of the draws.

    Raises:
        InputError: the arm hardly reaches such poses.
    """
    rng = np.random.default_rng([seed, 20])
    found: list[Array] = []
    for _ in range(_DRAWS * count):
        if len(found) == count:
            break
        weights = rng.dirichlet(np.full(len(around), 0.7))
        T = arm.forward(weights @ around)
        turn = np.radians(20.0) * rng.uniform(-1, 1, 3)
        q = arm.inverse(
            pose(T[:3, :3] @ exp_so3(turn), T[:3, 3] + rng.uniform(-0.03, 0.03, 3)), near=weights @ around
        ).best
        if q is not None and np.abs(q - weights @ around).max() < _NEAR:
            found.append(q)
    if len(found) < count:
        raise InputError(
            f"{arm.name} reaches {len(found)} of {_DRAWS * count} poses drawn around those of the motion, {count} are "
            "needed: choose poses further from the limits of its joints"
        )
    way = [around[0]]
    while found:
        way.append(found.pop(int(np.argmin([np.abs(q - way[-1]).max() for q in found]))))
    return np.array(way[1:])


@dataclass(frozen=True, eq=False)
class HandEyeRun(Record):
    """What the hand-eye motions found.

    Attributes:
        mounting: where cameras and body are. This is what base and tool mean from here on: an arm that is off has no base
            of its own to better than it is off by. So the covariance is zero; how well the arm agrees stands in ``found``.
        found: the hand-eye calibration.
        q: (N, 6) potentiometers at rest at each pose that was used, rad.
        Ts_left_body: (N, 4, 4) where the body was seen there.
        covs: (N, 6, 6) covariances of these.
        approach: (N, 6) from which side each joint came: 1 while its angle grew, -1 while it fell, 0 unmoved.
        missed: poses that the body was not seen at, and why.
    """

    mounting: Mounting
    found: HandEye
    q: Array
    Ts_left_body: Array
    covs: Array
    approach: Array
    missed: tuple[str, ...]


def find_mounting(
    loop: Loop, arm: Arm, q_start: Array, targets: Array, gravity: Callable[[Array], Array], progress: Progress
) -> HandEyeRun:
    """Visit poses, look at the body at rest, and find where cameras and body are.

    Args:
        loop: to run motions in.
        arm: the nominal arm.
        q_start: (6,) where the arm stands.
        targets: (N, 6) joint angles to visit.
        gravity: gives the duty that carries the arm at joint angles.
        progress: called with a line about what is being done.

    Raises:
        CalibrationError: too few poses were seen.
        DeviceError: the board or a camera failed.
    """
    q_seen, Ts, covs, approach, missed = [], [], [], [], []
    q_from, look_s = q_start, max(LOOK_S, 3.0 / loop.setup.rate_hz)
    for n, q_to in enumerate(targets):
        progress(f"hand-eye: pose {n + 1} of {len(targets)}")
        way = point_to_point(arm, q_from, q_to)
        segment = Segment("calibration", f"hand-eye {n + 1}", "joints", False, trajectory=way)
        loop.run(Planned(way, loop.t_s, gravity), way.duration_s + SETTLE_S, segment, watch=False)
        looked = len(loop.log.poses)
        heard = len(loop.log.joints)
        stands = Planned(way, loop.t_s - way.duration_s, gravity)
        loop.run_until_seen(stands, look_s, Segment("calibration", "", "", False))
        results = [result for _, _, result in loop.log.poses[looked:]]
        good = [r for r in results if isinstance(r, PoseEstimate)]
        if good:
            q_seen.append(np.concatenate([s.q for s in loop.log.joints[heard:]]).mean(axis=0))
            Ts.append(mean_pose(np.array([r.T_left_body for r in good])))
            covs.append(
                np.mean([r.cov - r.cov_noise for r in good], axis=0)
                + np.mean([r.cov_noise for r in good], axis=0) / len(good)
            )
            approach.append(np.sign(np.where(np.abs(q_to - q_from) > np.radians(0.5), q_to - q_from, 0.0)))
        else:
            missed.append(
                f"hand-eye {n + 1}: " + (str(getattr(results[-1], "reason", "")) if results else "no shot came")
            )
        q_from = q_to
    if len(q_seen) < 12:
        raise CalibrationError(
            f"the body was seen at {len(q_seen)} of {len(targets)} poses of the arm; 12 at least are needed: "
            + (missed[0] if missed else "move it into the view of both cameras")
        )
    progress("hand-eye: where cameras and body are")
    q, Ts_left_body, cov = np.array(q_seen), np.array(Ts), np.array(covs)
    Ts_base_flange = arm.forward(q) @ inverse(arm.T_flange_tool)
    found = loop.compute(lambda: calibrate_handeye(Ts_base_flange, Ts_left_body, cov))
    mounting = replace(Mounting.of(found, arm), cov=np.zeros((12, 12)))
    return HandEyeRun(mounting, found, q, Ts_left_body, cov, np.array(approach), tuple(missed))


def find_delay(loop: Loop, arm: Arm, q_start: Array, q_middle: Array, gravity: Callable[[Array], Array]) -> Delay:
    """Sweep the joints to and fro about a place and find how late the cameras' stamps are.

    Args:
        loop: to run motions in, its mounting known.
        arm: the nominal arm.
        q_start: (6,) where the arm stands.
        q_middle: (6,) about which to sweep; there the arm stands afterwards.
        gravity: gives the duty that carries the arm at joint angles.

    Raises:
        CalibrationError: the sweep tells no delay.
        DeviceError: the board or a camera failed.
    """
    way = point_to_point(arm, q_start, q_middle)
    there = Segment("calibration", "sweep's start", "joints", False, trajectory=way)
    loop.run(Planned(way, loop.t_s, gravity), way.duration_s + DELAY_REST_S, there, watch=False)
    sweep = Sweep(arm, q_middle, duration_s=max(SWEEP_S, SWEEP_SHOTS / loop.setup.rate_hz))
    looked = len(loop.log.poses)
    controller = Planned(sweep, loop.t_s, gravity)
    loop.run(controller, sweep.duration_s, Segment("calibration", "sweep", "joints", False, trajectory=sweep))
    assert loop.mounting is not None
    seen = [loop.mounting.pose_measurement(p, t) for _, t, p in loop.log.poses[looked:] if isinstance(p, PoseEstimate)]
    loop.run(controller, DELAY_REST_S, Segment("calibration", "", "", False), watch=False)
    states = JointStates(
        np.concatenate([s.t_s for s in loop.log.joints]), np.concatenate([s.q for s in loop.log.joints])
    )
    newest = states.t_s > states.t_s[-1] - sweep.duration_s - 2 * DELAY_REST_S
    swept = JointStates(states.t_s[newest], states.q[newest])
    if len(seen) < LEAST:
        raise CalibrationError(
            f"the body was seen {len(seen)} times in {sweep.duration_s:.1f} s of sweep, {LEAST} times at least are needed "
            f"to tell how late the images come: are the cameras slower than {loop.setup.rate_hz:g} Hz, or is the body "
            "out of view near the end of the first motion?"
        )
    sync_s = loop.setup.sync_s
    return loop.compute(lambda: estimate_delay(arm, swept, seen, prior=STEADY, sync_s=sync_s))
