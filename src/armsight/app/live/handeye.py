"""The guided hand-eye calibration: which pose of the arm to take next, and how good the calibration is, in mm.

The next pose is the one of the candidates after which the predicted error is least: the RMS distance by which the
calibration's covariance moves a measured position in the base (as :mod:`~armsight.vision.calibrate.guide` does).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armsight.app.identify.report import identify_report, write_results
from armsight.app.identify.run import run_identify
from armsight.app.live.step import Guided, GuidedState, PageStep, Shared
from armsight.app.run.folder import write_handeye
from armsight.app.show.plotting import require_matplotlib
from armsight.app.show.report import Report
from armsight.data import Array, Missed
from armsight.errors import ArmsightError, CalibrationError, InputError
from armsight.files import unused, write_text
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import skew
from armsight.loop.handeye.poses import Poses
from armsight.loop.identify.read import read_poses
from armsight.loop.running.calibrate import HandEyeRun, VisitedPose, handeye_of, handeye_poses, visit
from armsight.loop.running.log import RunSegment
from armsight.loop.running.loop import Loop
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Trajectory, point_to_point
from armsight.vision.rig import StereoRig

#: Poses before the first fit; the fewest of a calibration that is called good; the most that are asked for.
FIRST_FIT, LEAST_POSES, MOST_POSES = 6, 12, 30
#: Another pose that lowers the predicted error by less than this share is not worth taking.
LITTLE = 0.02
#: A pose is another one if a joint is so far from all that were taken, rad.
_OTHER_RAD = float(np.radians(3.0))
_CANDIDATES, _MARGIN_PX = 60, 60.0


@dataclass(frozen=True)
class HandEyeProgress:
    """The errors after a pose."""

    poses: int
    heldout_mm: float  # RMS distance of the body from where a fit to the other poses has it
    predicted_mm: float  # predicted RMS error that the calibration leaves in a position


@dataclass(frozen=True)
class HandEyeState(GuidedState):
    """What a page shows of the guided hand-eye calibration."""

    missing: tuple[str, ...] = (f"{LEAST_POSES} poses",)
    poses: int = 0
    next_deg: tuple[float, ...] = ()  # joint angles of the pose to take next; empty where none is known
    file: str | None = None  # handeye.json
    command: str = ""  # the command line that does the same


class HandEyeGuide(Guided[HandEyeState]):
    """Chooses poses, collects them, and calibrates; ``run`` is the newest calibration, None before."""

    what = "the hand-eye"

    def __init__(self, shared: Shared, arm: Arm, arm_spec: str) -> None:
        super().__init__(shared, HandEyeState())
        self.folder = shared.folder / "handeye"
        self._arm, self._spec = arm, arm_spec
        self.clear()

    def clear(self) -> None:
        """Forget all poses."""
        with self.lock:
            self._visited: list[VisitedPose] = []
            self._tried: list[Array] = []
            self._missed: list[str] = []
            self._around: Array | None = None
            self._limits: tuple[Array, Array] | None = None
            self._next: tuple[Array, float] | None = None
            self.run: HandEyeRun | None = None
            self.shown = HandEyeState(fitting=self.shown.fitting)

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
            self.say("warn", f"the stored poses of the hand-eye calibration are not used: {error}")
            return
        approach = np.zeros_like(seen.q) if seen.approach is None else seen.approach
        rows = zip(seen.q, seen.p_rig[:, 0], seen.R_rig_body, seen.cov, approach, strict=True)
        with self.lock:
            self._visited = [VisitedPose(q, pose(R, p), cov, way) for q, p, R, cov, way in rows]
            self._tried = [each.q for each in self._visited]
        self.say("good", f"the {len(seen.q)} poses of the hand-eye calibration stored in {file} are used")
        self.fit_soon()

    def use_arm(self, arm: Arm, spec: str) -> None:
        """Take another model of the arm, and calibrate anew from the same poses."""
        with self.lock:
            self._arm, self._spec, self._next, self.run = arm, spec, None, None
            self.show(progress=(), good=False)
        self.fit_soon()

    def begin(self, around: Array, limits: tuple[Array, Array] | None, rig: StereoRig) -> None:
        """Say where the arm can be: joint angles (M, n) near which the body is in view; the board's limits (n,); rad."""
        with self.lock:
            self._around, self._limits, self._rig = around, limits, rig
            self._choose()

    @property
    def next_q(self) -> Array | None:
        """The joint angles (n,) of the pose to take next, rad; None where there is none, or none is needed."""
        with self.lock:
            return None if self._next is None or self.shown.good else self._next[0]

    def add(self, pose: VisitedPose) -> None:
        """Take a pose, unless one like it was taken already."""
        with self.lock:
            if any(np.abs(pose.q - each.q).max() < _OTHER_RAD for each in self._visited):
                raise InputError("a pose like this one was taken already: rotate the tool further")
            self._visited.append(pose)
            self._tried.append(pose.q)

    def miss(self, q: Array, reason: str) -> None:
        """Note that the body was not seen at joint angles (n,), rad."""
        with self.lock:
            self._missed.append(reason)
            self._tried.append(q)

    def fit(self) -> None:
        """Calibrate from the poses so far, write it, and choose the next pose; too few poses are no error."""
        with self.lock:
            visited, missed, arm = list(self._visited), tuple(self._missed), self._arm
        missing: tuple[str, ...] = ()
        for quick in (True, False):  # what variances leave open takes long, and only once it is good
            run: HandEyeRun | None = None
            if len(visited) >= FIRST_FIT:
                try:
                    run = handeye_of(arm, visited, missed, quick)
                except (CalibrationError, np.linalg.LinAlgError) as error:
                    missing = (f"the poses cannot be fitted yet: {error}",)
            with self.lock:
                if arm is not self._arm or len(self._visited) < len(visited):
                    return  # another arm, or all was cleared meanwhile
                if run is not None:
                    self._learn(run)
                self._choose()
                lines = (*missing, *self._lacking(fitted=not missing))
                self.show(missing=lines, good=not lines and self.run is not None)
            if not self.shown.good:
                break
        if self.run is not None:
            self._write(self.run)

    def _learn(self, run: HandEyeRun) -> None:
        self.run = run
        error_m = float(_errors_m(run, run.found.cov[None])[0])
        heldout_mm = 1e3 * run.found.held_out.rms()[0]
        self.learned(len(run.q), HandEyeProgress(len(run.q), heldout_mm, 1e3 * error_m))

    def _lacking(self, *, fitted: bool) -> list[str]:
        count = len(self._visited)
        if count < LEAST_POSES:
            more = LEAST_POSES - count
            return [f"{more} more pose{'s' if more > 1 else ''}, rotated about different axes"]
        if self.run is None or self._next is None or not fitted or count >= MOST_POSES:
            return []
        gain = 1.0 - self._next[1] / max(1e-3 * self.shown.progress[-1].predicted_mm, 1e-9)
        return [f"another pose lowers the predicted error by {100 * gain:.0f}%"] if gain > LITTLE else []

    def _write(self, run: HandEyeRun) -> None:
        joints = [",".join(f"q{k + 1}_rad" for k in range(run.q.shape[1]))]
        joints += [",".join(f"{x:.9f}" for x in row) for row in run.q]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_handeye(self.folder, run)
            write_text(self.folder / "joints.csv", "\n".join(joints) + "\n")
            self.show(file=str(self.folder / "handeye.json"))
        except (ArmsightError, OSError) as error:
            self.say("error", f"the hand-eye calibration cannot be written: {error}")

    def _choose(self) -> None:
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
        good = np.ones(len(Ts_left_body), bool)
        for camera, T in zip(self._rig.cameras, (np.eye(4), inverse(self._rig.T_left_right)), strict=True):
            p = (T @ Ts_left_body)[:, :3, 3]
            uv, size = camera.project(p), np.array(camera.image_size_px)
            with np.errstate(invalid="ignore"):
                good &= (p[:, 2] > 0) & ((uv > _MARGIN_PX) & (uv < size - _MARGIN_PX)).all(axis=1)
        return good

    @property
    def poses_file(self) -> Path | None:
        """The poses as ``armsight identify`` reads them; None before they are written."""
        return None if self.shown.file is None else self.folder / "handeye_poses.csv"

    def now(self) -> HandEyeState:
        """Return what is shown, with the pose to take next."""
        q = self.next_q
        tables = f"--robot {self.folder}/joints.csv --seen {self.folder}/handeye_poses.csv"
        return replace(
            self.shown,
            poses=len(self._visited),
            next_deg=() if q is None else tuple(np.degrees(q).tolist()),
            command=f"armsight handeye {tables} --model {self._spec} --eye to-hand",
        )


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
    known = np.linalg.inv(run.found.cov) + (J := run.found.whitened(poses)[1]).swapaxes(1, 2) @ J
    return _errors_m(run, np.asarray(np.linalg.inv(known), float))


def visit_poses(loop: Loop, guide: HandEyeGuide, start: Array, progress: Callable[[str], None]) -> None:
    """Move an arm from ``start`` (n,), rad, to poses, each chosen by those before, until it is calibrated, and back."""
    q = start
    for number in range(1, MOST_POSES + 1):
        goal = guide.next_q
        if goal is None:
            break
        progress(f"hand-eye: pose {number}")
        found = visit(loop, q, goal, f"hand-eye {number}")
        q = goal
        if isinstance(found, Missed):
            guide.miss(goal, found.reason)
        else:
            guide.add(found)
        loop.compute(guide.fit)
    go(loop, point_to_point(loop.setup.arm, q, start), progress)


def go(loop: Loop, way: Trajectory, progress: Callable[[str], None]) -> None:
    """Move an arm to the start of its motions."""
    progress("to the start")
    loop.go(way, 0.3, RunSegment("calibration", "to the start", "joints"), watch=False)


@dataclass(frozen=True)
class IdentifyState:
    """What a page shows of the identification."""

    working: str | None = None  # what is being done
    headline: str = ""  # held-out errors of the nominal and of the identified arm
    lines: tuple[str, ...] = ()  # the result as ``armsight identify`` prints it
    corrected: str | None = None  # the corrected arm's file
    command: str = ""  # the command line that does the same


class IdentifyStep(PageStep[IdentifyState]):
    """Identifies one arm at a time; results go to ``identify``, ``identify-2``, ... in the folder of the session."""

    def start(self, arm_spec: str, poses: Path | None) -> None:
        """Identify an arm from a table of poses, in the background."""
        if poses is None:
            raise InputError("no poses yet: make the hand-eye calibration first, its poses are used")
        if self.shown.working is not None:
            raise InputError("an identification runs already")
        require_matplotlib()
        out = unused(self.folder / "identify")
        self.shown = IdentifyState("reading", command=f"armsight identify --arm {arm_spec} --data {poses} -o {out}")
        self.later("no arm was identified", self._identify, arm_spec, poses, out)

    def _identify(self, arm_spec: str, poses: Path, out: Path) -> None:
        try:
            read, arm = read_poses(poses), open_arm(arm_spec)
            progress = lambda line: self.show(working=line)  # noqa: E731
            run = run_identify(arm, read.measured, read.lines, None, notes=read.notes, progress=progress)
            report = identify_report(run)
            write_results(run, report, out)
        finally:
            self.show(working=None)
        lines = [*(f"note: {note}" for note in run.notes), *report.text().splitlines()]
        shown = tuple(line for line in lines if line != report.headline)
        self.show(headline=report.headline, lines=shown, corrected=str(out / "corrected.toml"))
        self.later("the report was not drawn", self._draw, report, out)  # what was found is shown before

    def _draw(self, report: Report, out: Path) -> None:
        report.write(out)
        self.say("good", f"identified: {report.headline}; written to {out}")
