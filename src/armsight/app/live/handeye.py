"""The guided hand-eye calibration: which pose of the arm to take next, and how good the calibration is, in mm.

In: poses of the arm at rest, taken by a person or by the arm itself. Out: a :class:`HandEyeState` at any time, and a
:class:`~armsight.app.run.calibrate.HandEyeRun`, which the loop uses and ``handeye/`` of the session holds. The next pose
is the one of the candidates after which the predicted error is least: the RMS distance by which the covariance of the
calibration moves a measured position in the arm's base (as :mod:`~armsight.app.live.guide` does for the cameras).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armsight.app.run.calibrate import HandEyeRun, VisitedPose, handeye_of, handeye_poses, visit
from armsight.app.run.controllers import Planned
from armsight.app.run.folder import write_handeye
from armsight.app.run.loop import Loop
from armsight.app.run.record import RunSegment
from armsight.app.show.messages import Note
from armsight.data import Array, Missed
from armsight.errors import ArmsightError, CalibrationError, InputError
from armsight.files import write_text
from armsight.geometry.pose import inverse, log_se3, pose, transform
from armsight.geometry.rotation import skew
from armsight.loop.handeye.poses import Poses
from armsight.loop.identify.read import read_poses
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import point_to_point
from armsight.vision.rig import StereoRig

#: Poses before the first fit; the fewest of a calibration that is called good; the most that are asked for.
FIRST_FIT, LEAST_POSES, MOST_POSES = 6, 12, 30
#: Another pose that lowers the predicted error by less than this share is not worth taking.
LITTLE = 0.02
#: A pose is another one if a joint is so far from all that were taken, rad.
_OTHER_RAD = float(np.radians(3.0))
_CANDIDATES, _MARGIN_PX = 60, 60.0
#: Sigma of what joints cannot explain of a measured pose, m and rad; sigma of the error of a joint, rad.
_EXPLAINED, _JOINT_RAD = (3e-4, 5e-4), float(np.radians(1.0))


@dataclass(frozen=True)
class HandEyeProgress:
    """The errors after a pose.

    Attributes:
        poses: how many there were.
        heldout_mm: RMS distance of the body from where a fit to the other poses has it, mm.
        heldout_deg: RMS angle of the same, degrees.
        predicted_mm: predicted RMS error that the calibration leaves in a position, mm.
    """

    poses: int
    heldout_mm: float
    heldout_deg: float
    predicted_mm: float


@dataclass(frozen=True)
class HandEyeState:
    """What a page shows of the guided hand-eye calibration.

    Attributes:
        poses: how many were taken.
        fitting: whether a fit runs.
        next_deg: joint angles of the pose to take next, degrees; empty where none is known.
        then_mm: predicted error after it, mm; None before the first fit.
        progress: the errors after each fit.
        good: whether further poses would hardly lower the error.
        missing: what is missing, line by line.
        file: handeye.json; None before.
        command: the command line that does the same.
    """

    poses: int = 0
    fitting: bool = False
    next_deg: tuple[float, ...] = ()
    then_mm: float | None = None
    progress: tuple[HandEyeProgress, ...] = ()
    good: bool = False
    missing: tuple[str, ...] = ()
    file: str | None = None
    command: str = ""


class HandEyeGuide:
    """Chooses poses, collects them, and calibrates.

    Args:
        folder: of the session; files go to ``handeye`` in it.
        arm: the nominal arm.
        arm_spec: its name or file.
        say: called with a note for the person.

    Attributes:
        run: the newest calibration; None before.
    """

    def __init__(self, folder: Path, arm: Arm, arm_spec: str, say: Callable[[Note], None]) -> None:
        self.folder, self._say = folder / "handeye", say
        self._arm, self._spec = arm, arm_spec
        self._lock = threading.RLock()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="handeye")
        self.run: HandEyeRun | None = None
        self.clear()

    def clear(self) -> None:
        """Forget all poses."""
        with self._lock:
            self._visited: list[VisitedPose] = []
            self._tried: list[Array] = []
            self._missed: list[str] = []
            self._progress: list[HandEyeProgress] = []
            self._around: Array | None = None
            self._limits: tuple[Array, Array] | None = None
            self._next: tuple[Array, float] | None = None
            self._good, self._missing, self._fitting, self._file = False, (f"{LEAST_POSES} poses",), 0, None
            self.run = None

    _file: Path | None
    _missing: tuple[str, ...]

    def recall(self, rig: Path) -> None:
        """Take the poses that an earlier session stored, seen by a rig that is no newer than they are, and calibrate."""
        file = self.folder / "handeye_poses.csv"
        if not file.exists() or file.stat().st_mtime < rig.stat().st_mtime:
            return
        try:
            seen = read_poses(file).measured
            if seen.q.shape[1] != self._arm.joints or seen.R_rig_body is None or seen.cov is None:
                raise InputError(f"{file}: not full poses of an arm of {self._arm.joints} joints")
        except InputError as error:
            self._say(Note("warn", f"the stored poses of the hand-eye calibration are not used: {error}"))
            return
        approach = np.zeros_like(seen.q) if seen.approach is None else seen.approach
        rows = zip(seen.q, seen.p_rig[:, 0], seen.R_rig_body, seen.cov, approach, strict=True)
        with self._lock:
            self._visited = [VisitedPose(q, pose(R, p), cov, way) for q, p, R, cov, way in rows]
            self._tried = [each.q for each in self._visited]
        self._say(Note("good", f"the {len(seen.q)} poses of the hand-eye calibration stored in {file} are used"))
        self.fit_soon()

    def use_arm(self, arm: Arm, spec: str) -> None:
        """Take another model of the arm, and calibrate anew from the same poses."""
        with self._lock:
            self._arm, self._spec, self._next, self.run = arm, spec, None, None
            self._progress, self._good = [], False
        self.fit_soon()

    def begin(self, around: Array, limits: tuple[Array, Array] | None, rig: StereoRig) -> None:
        """Say where the arm can be.

        Args:
            around: (M, n) joint angles near which the body is in view, rad.
            limits: lower and upper limits (n,) of the joints, rad; None where only the arm's own are known.
            rig: the calibrated cameras.
        """
        with self._lock:
            self._around, self._limits, self._rig = around, limits, rig
            self._choose()

    @property
    def next_q(self) -> Array | None:
        """The joint angles (n,) of the pose to take next, rad; None where there is none, or none is needed."""
        with self._lock:
            return None if self._next is None or self._good else self._next[0]

    def add(self, pose: VisitedPose) -> None:
        """Take a pose.

        Raises:
            InputError: one like it was taken already.
        """
        with self._lock:
            if any(np.abs(pose.q - each.q).max() < _OTHER_RAD for each in self._visited):
                raise InputError("a pose like this one was taken already: rotate the tool further")
            self._visited.append(pose)
            self._tried.append(pose.q)

    def miss(self, q: Array, reason: str) -> None:
        """Note that the body was not seen at joint angles (n,), rad."""
        with self._lock:
            self._missed.append(reason)
            self._tried.append(q)

    def fit_soon(self) -> None:
        """Fit in the background."""
        with self._lock:
            self._fitting += 1
        self._pool.submit(self._fit_then)

    def _fit_then(self) -> None:
        try:
            self.fit()
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread
            self._say(Note("error", f"the hand-eye fit failed: {type(error).__name__}: {error}"))
        finally:
            with self._lock:
                self._fitting -= 1

    def fit(self) -> None:
        """Calibrate from the poses so far, write it, and choose the next pose; too few poses are no error."""
        with self._lock:
            visited, missed, arm = list(self._visited), tuple(self._missed), self._arm
        missing: tuple[str, ...] = ()
        for quick in (True, False):  # what variances leave open takes long, and only once it is good
            run: HandEyeRun | None = None
            if len(visited) >= FIRST_FIT:
                try:
                    run = handeye_of(arm, visited, missed, quick)
                except (CalibrationError, np.linalg.LinAlgError) as error:
                    missing = (f"the poses cannot be fitted yet: {error}",)
            with self._lock:
                if arm is not self._arm or len(self._visited) < len(visited):
                    return  # another arm, or all was cleared meanwhile
                if run is not None:
                    self._learn(run)
                self._choose()
                self._assess(missing)
            if not self._good:
                break
        if self.run is not None:
            self._write(self.run)

    def _learn(self, run: HandEyeRun) -> None:
        """Take in a fit."""
        self.run = run
        position_m, angle_rad = run.found.held_out.rms()
        error_m = float(_errors_m(run, run.found.cov[None])[0])
        new = HandEyeProgress(len(run.q), 1e3 * position_m, float(np.degrees(angle_rad)), 1e3 * error_m)
        self._progress = [*(each for each in self._progress if each.poses < new.poses), new]

    def _assess(self, missing: tuple[str, ...]) -> None:
        """Say what is missing."""
        lines, count = list(missing), len(self._visited)
        if count < LEAST_POSES:
            more = LEAST_POSES - count
            lines.append(f"{more} more pose{'s' if more > 1 else ''}, rotated about different axes")
        elif self.run is not None and self._next is not None and not missing:
            gain = 1.0 - self._next[1] / max(1e-3 * self._progress[-1].predicted_mm, 1e-9)
            if gain > LITTLE and count < MOST_POSES:
                lines.append(f"another pose lowers the predicted error by {100 * gain:.0f}%")
        self._missing, self._good = tuple(lines), not lines and self.run is not None

    def _write(self, run: HandEyeRun) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_handeye(self.folder, run)
            write_text(self.folder / "joints.csv", _joints_text(run.q))
        except (ArmsightError, OSError) as error:
            self._say(Note("error", f"the hand-eye calibration cannot be written: {error}"))
            return
        with self._lock:
            self._file = self.folder / "handeye.json"

    def _choose(self) -> None:
        """Choose the next pose."""
        self._next = None
        if self._around is None:
            return
        around = np.vstack([self._around, *(each.q for each in self._visited)])
        try:
            qs = handeye_poses(self._arm, around, _CANDIDATES, len(self._tried))
        except InputError:
            qs = self._around
        qs = qs[[min((np.abs(q - t).max() for t in self._tried), default=np.inf) > _OTHER_RAD for q in qs]]
        if self._limits is not None:
            low, high = self._limits
            qs = qs[((qs >= low) & (qs <= high)).all(axis=1)]
        if not len(qs):
            return
        if self.run is None:  # far from all that were taken
            far = [min((np.abs(q - t).sum() for t in self._tried), default=0.0) for q in qs]
            self._next = qs[int(np.argmax(far))], float("nan")
            return
        A = self._arm.forward(qs) @ inverse(self._arm.T_flange_tool)
        seen = self._in_view(self.run.found.predict(A))
        if seen.any():
            errors = _errors_after_m(self.run, A[seen])
            k = int(np.argmin(errors))
            self._next = qs[seen][k], float(errors[k])

    def _in_view(self, Ts_left_body: Array) -> Array:
        """Return (C,) whether both cameras see the body, away from their edges."""
        good, p = np.ones(len(Ts_left_body), bool), Ts_left_body[:, :3, 3]
        for camera, at in ((self._rig.left, p), (self._rig.right, transform(inverse(self._rig.T_left_right), p))):
            uv, size = camera.project(at), np.array(camera.image_size_px)
            with np.errstate(invalid="ignore"):
                good &= (at[:, 2] > 0) & ((uv > _MARGIN_PX) & (uv < size - _MARGIN_PX)).all(axis=1)
        return good

    @property
    def poses_file(self) -> Path | None:
        """The poses as ``armsight identify`` reads them; None before they are written."""
        return None if self._file is None else self.folder / "handeye_poses.csv"

    @property
    def state(self) -> HandEyeState:
        """What to show now."""
        with self._lock:
            q = self.next_q
            then = None if self._next is None else 1e3 * self._next[1]
            tables = f"--robot {self.folder}/joints.csv --seen {self.folder}/handeye_poses.csv"
            return HandEyeState(
                len(self._visited),
                self._fitting > 0,
                () if q is None else tuple(float(x) for x in np.degrees(q)),
                then if then is not None and np.isfinite(then) else None,
                tuple(self._progress),
                self._good,
                self._missing,
                None if self._file is None else str(self._file),
                f"armsight handeye {tables} --model {self._spec} --eye to-hand",
            )

    def close(self) -> None:
        """End the thread."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _joints_text(q: Array) -> str:
    """Return joint angles (N, n), rad, as a table."""
    head = ",".join(f"q{k + 1}_rad" for k in range(q.shape[1]))
    return "\n".join([head, *(",".join(f"{x:.9f}" for x in row) for row in q)]) + "\n"


def _errors_m(run: HandEyeRun, covs: Array) -> Array:
    """Return (C,) the RMS distance by which covariances (C, 12, 12) of a calibration move the positions seen, m."""
    p = run.Ts_left_body[:, :3, 3]
    J = np.concatenate([np.tile(np.eye(3), (len(p), 1, 1)), np.array([-skew(each) for each in p])], axis=2)
    W = np.einsum("nki,nkj->ij", J, J) / len(p)
    return np.asarray(np.sqrt(np.einsum("ij,cji->c", W, covs[:, :6, :6])))


def _errors_after_m(run: HandEyeRun, Ts_base_flange: Array) -> Array:
    """Return (C,) the predicted error after one more of the poses (C, 4, 4) of the flange, m."""
    covs = np.tile(run.covs.mean(axis=0), (len(Ts_base_flange), 1, 1))
    poses = Poses(Ts_base_flange, run.found.predict(Ts_base_flange), covs, False, np.zeros(3))
    known = np.linalg.inv(run.found.cov) + (J := run.found.whitened(poses)).swapaxes(1, 2) @ J
    return _errors_m(run, np.asarray(np.linalg.inv(known), float))


def visit_poses(loop: Loop, guide: HandEyeGuide, start: Array, progress: Callable[[str], None]) -> None:
    """Move an arm from pose to pose, each chosen by those before, until the calibration is good; and back to the start.

    Args:
        loop: runs the motions.
        guide: chooses the poses and takes them.
        start: (n,) joint angles at which the arm stands, rad.
        progress: called with a line about what is being done.

    Raises:
        DeviceError: the board or a camera failed.
    """
    q, setup = start, loop.setup
    for number in range(1, MOST_POSES + 1):
        goal = guide.next_q
        if goal is None:
            break
        progress(f"hand-eye: pose {number}")
        found = visit(loop, setup.arm, q, goal, setup.gravity, f"hand-eye {number}")
        q = goal
        if isinstance(found, Missed):
            guide.miss(goal, found.reason)
        else:
            guide.add(found)
        loop.compute(guide.fit)
    progress("to the start")
    back = point_to_point(setup.arm, q, start)
    segment = RunSegment("calibration", "to the start", "joints", False, trajectory=back)
    loop.run(Planned(back, loop.t_s, setup.gravity), back.duration_s + 0.3, segment, watch=False)


def likely_joint_errors(arm: Arm, q: Array, T_base_tool: Array) -> Array:
    """Return the errors of joint readings q (n,), rad, that most likely explain a measured pose (4, 4) of the tool.

    The maximum a posteriori with a prior about zero: near a singular pose an exact inverse explains a fraction of a
    millimetre by tens of degrees.
    """
    weights = np.repeat(1.0 / np.square(_EXPLAINED), 3)
    J, xi = arm.jacobian(q, "tool"), log_se3(inverse(arm.forward(q)) @ T_base_tool)
    JW = J.T * weights
    return np.asarray(np.linalg.solve(JW @ J + np.eye(len(q)) / _JOINT_RAD**2, JW @ xi))
