"""A rig put right while it is used: the cameras against each other, and the rig against the base of the arm.

In: a :class:`~armsight.loop.health.HealthMonitor`, and the poses measured so far. Out: a :class:`RigCorrection` once the
evidence suffices, else the reason why it does not. Cameras: the estimate of :mod:`armsight.loop.health.update`, from shots
taken after the change; it is accepted when it leaves poses nearly as certain as the calibration did. Base: the motion
that fixed bodies in view show; without these the one that the arm's poses show, if nothing else explains them and the
tool's position is known well enough with it, wherever the arm went. That is refined as the arm shows more of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from armsight.data import Array, Body, Missed, PoseEstimate, Record
from armsight.estimate.chance import squares_of
from armsight.geometry.pose import adjoint, exp_se3, inverse, log_se3
from armsight.geometry.rotation import skew
from armsight.loop.estimators import Mounting
from armsight.loop.finding import Cause
from armsight.loop.health.base_motion import BaseMotion, KeptMeasurement, Moved
from armsight.loop.health.change import Change
from armsight.loop.health.residuals import differ
from armsight.loop.health.rig import TEST_S, RigWatch
from armsight.loop.health.update import LEAST_STAYS, RigUpdate, updated_rig
from armsight.vision.detections import SeenShot
from armsight.vision.match import gate
from armsight.vision.pose.locate import locate
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import triangulate

if TYPE_CHECKING:
    from armsight.loop.health.monitor import HealthMonitor

#: What is not known of a change of the cameras may be this share of what is not known of their calibration.
SHARE = 0.5
#: Most shots of an update; and after one that was rejected so large a share of its shots must be new.
_MOST_SHOTS, _NEW = 60, 0.25
#: Largest sigma of the tool's position by what is put right, m; and by how much what else moved may displace it, m.
MOST_SIGMA_M, MOST_APART_M = 2e-4, 2e-4
#: The same where the arm's poses show it, which is refined: without vision the tool is uncertain by 0.5 mm and more.
_MOST_BY_ARM_M = 4e-4
#: It is refined where its sigma fell to such a share, until it is so small, m.
_REFINED, _KNOWN_M = 0.85, 1e-4
#: Refined where what is left displaces the tool by more than this, squared sigmas of three numbers (chance of 1e-3).
_MORE = 16.3
#: A motion that began so much earlier or later than was thought is estimated anew, s.
_SAME_S = 0.3

Poses = Callable[[], Sequence[tuple[float, PoseEstimate]]]


@dataclass(frozen=True, eq=False)
class RigCorrection(Record):
    """Something of a rig that was put right."""

    #: cameras: the right camera's pose in the left one; base: the rig's pose in the base of the arm
    what: Literal["cameras", "base"]
    since_s: float  #: since when it was wrong, s on the clock of the shots
    at_s: float  #: from when on poses are measured with it, s
    by: Literal["body", "arm", "fixed bodies"]  #: what showed it: body, arm, fixed bodies
    update: RigUpdate | None  #: of the cameras; None of the base
    #: (6,) right tangent from the old pose of the rig in the base to the new one, [m; rad]; zero of the cameras
    motion: Array
    cov: Array  #: (6, 6) its covariance
    #: by how much that displaced the measured tool, where this is what the arm's poses show, and its sigma, m
    tool_m: tuple[float, float] | None = None
    refines: RigCorrection | None = None  #: the correction of the same motion that this one replaces

    @property
    def cause(self) -> Cause:
        """What a finding calls it."""
        return "rig" if self.what == "cameras" else "fixed"

    def mounting(self, old: Mounting) -> Mounting:
        """Return where the rig is, from where it was thought to be."""
        if self.what == "cameras":
            return old
        motion, cov = exp_se3(self.motion), old.cov.copy()
        if self.refines is not None:
            motion = inverse(exp_se3(self.refines.motion)) @ motion
            cov[:6, :6] -= self.refines.cov
        back = adjoint(inverse(motion))
        cov[:6] = back @ cov[:6]
        cov[:, :6] = cov[:, :6] @ back.T
        cov[:6, :6] += self.cov
        return Mounting(old.T_base_rig @ motion, old.T_tool_body, cov)

    def to_json(self) -> dict[str, Any]:
        """Return the object that summary.json holds."""
        found: dict[str, Any] = {"what": self.what, "since_s": self.since_s, "at_s": self.at_s, "by": self.by}
        if self.update is not None:
            return found | self.update.figures()
        if self.tool_m is not None:
            found |= {"tool_displaced_m": self.tool_m[0], "tool_displaced_sigma_m": self.tool_m[1]}
        if self.refines is not None:
            found |= {"refines_at_s": self.refines.at_s}
        sigmas = np.sqrt(np.diag(self.cov))
        return found | {
            "shift_m": self.motion[:3].tolist(),
            "shift_sigma_m": sigmas[:3].tolist(),
            "rotation_deg": np.degrees(self.motion[3:]).tolist(),
            "rotation_sigma_deg": np.degrees(sigmas[3:]).tolist(),
        }

    def line(self) -> str:
        """Return what was put right as one line for people."""
        if self.update is None:
            shift, rotation = (float(np.linalg.norm(part)) for part in (self.motion[:3], self.motion[3:]))
            tool_mm = None if self.tool_m is None else (1e3 * self.tool_m[0], 1e3 * self.tool_m[1])
            what = (
                f"it had moved against the base of the arm by {1e3 * shift:.2f} mm and {np.degrees(rotation):.3f} deg, "
            )
            what += "as fixed bodies show" if tool_mm is None else "the tool had appeared displaced by "
            what += "" if tool_mm is None else f"{tool_mm[0]:.2f} +- {tool_mm[1]:.2f} mm"
        else:
            what = "; ".join(self.update.lines())
        how = "put right" if self.refines is None else f"put right again (of {self.refines.at_s:.1f} s)"
        return f"rig {how} at {self.at_s:.1f} s, wrong since {self.since_s:.1f} s: {what}"


def correction_lines(corrections: Sequence[RigCorrection], rejected: str | None) -> list[str]:
    """Return the lines for a log or a terminal on what was put right, and why what else was found was not."""
    left = () if rejected is None else (f"the rig was not put right: {rejected}",)
    return [*(each.line() for each in corrections), *left]


class RigFollower:
    """Decides when a rig can be put right, and by how much."""

    def __init__(self, rig: StereoRig, body: Body) -> None:
        self._rig, self._body = rig, body
        self._tried, self._tried_s = 0, -math.inf  # differing shots of the last update that was rejected; the newest, s
        # What estimates a motion of the rig by the arm, and how it was put right with it.
        self._motion: BaseMotion | None = None
        self._put_right: RigCorrection | None = None
        #: why what was found is not put right yet; None where nothing was found, or all was put right
        self.rejected: str | None = None

    def look(
        self, monitor: HealthMonitor, poses: Poses, T_base_rig: Array, at_s: float
    ) -> Callable[[], RigCorrection | None] | None:
        """Return what computes a correction, or why there is none; None where nothing is found to have moved.

        ``monitor``: what was found. ``poses``: returns time, s, and pose of the newest shots, measured with the rig as
        it is, in order of time. ``T_base_rig``: (4, 4) the rig in the base as it is taken to be, m. ``at_s``: the time,
        s.
        """
        again = monitor.changes or monitor.rig_moved() is not None or monitor.cameras_moved() is not None
        if self._put_right is not None and again:
            self._motion = self._put_right = None
        if (watch := monitor.cameras_moved()) is not None:
            newest = poses()
            return lambda: self._of_watch(watch, newest, at_s)
        changes, moved = monitor.changes, monitor.rig_moved()
        by_arm = any(each.suspect.cause == "fixed" for each in changes)
        if moved is not None and (newest := poses()):
            p_left = newest[-1][1].T_left_body[:3, 3]
            found = self.base_by_bodies(moved[0], moved[1:], at_s, p_left)
            if found is not None or not by_arm:
                return lambda: found
        if by_arm:
            motion, measurements = self._motion_of(changes[0], monitor), monitor.measurements
            return lambda: self.base_by_arm(changes, T_base_rig, at_s, _moved(motion, measurements))
        if self._motion is None or self._put_right is None:
            return None
        motion, right, measurements = self._motion, self._put_right, monitor.measurements
        return lambda: self.refined(right, T_base_rig, at_s, _moved(motion, measurements))

    def put_right(self, correction: RigCorrection) -> None:
        """Go on after a correction that is in force from its time on; one that the arm's poses show may be refined."""
        if self._motion is None or correction.tool_m is None:
            self._motion = self._put_right = None
            return
        self._motion.put_right(correction.at_s)
        self._put_right = correction if correction.tool_m[1] > _KNOWN_M else None

    def _motion_of(self, best: Change, monitor: HealthMonitor) -> BaseMotion:
        """Return what estimates the motion of the rig that a hypothesis says."""
        slow, begin_s = best.suspect.slow, best.begin_s
        one = self._motion
        if one is None or one.slow is not slow or abs(one.begin_s - begin_s) > _SAME_S:
            one = self._motion = monitor.base_motion(begin_s, slow=slow)
        return one

    def _of_watch(
        self, watch: RigWatch, poses: Sequence[tuple[float, PoseEstimate]], at_s: float
    ) -> RigCorrection | None:
        """Return the cameras put right, where nothing else is found to have changed."""
        since_s = watch.moved_since_s()
        if since_s is None:
            if not watch.only_newest():
                self.rejected = "cameras: their pose alone does not explain what the body's detections show"
            return None
        return self.cameras(since_s, poses, at_s, mounted=True)

    def cameras(
        self, since_s: float, poses: Sequence[tuple[float, PoseEstimate]], at_s: float, mounted: bool = False
    ) -> RigCorrection | None:
        """Return the cameras put right; None where the poses do not suffice, as ``rejected`` says.

        ``since_s``: since when the cameras are found to have moved, s. ``poses``: time, s, and pose of shots measured
        with the rig as it is, in order of time. ``at_s``: the time, s. ``mounted``: whether hand-eye stands on the
        poses before: then only the change may be estimated, which needs them.
        """
        used = _differing([pose for t_s, pose in poses if t_s >= since_s + TEST_S])
        before = _differing([pose for t_s, pose in poses if t_s < since_s - TEST_S])
        new = _differing([pose for t_s, pose in poses if t_s > max(self._tried_s, since_s + TEST_S)])
        if len(used) < LEAST_STAYS or len(new) < _NEW * self._tried:
            few = f"cameras: {len(used)} shots since they moved differ, {LEAST_STAYS} are needed"
            self.rejected = self.rejected or few
            return None
        if mounted and len(before) < LEAST_STAYS:
            self.rejected = f"cameras: {len(before)} shots from before they moved differ, {LEAST_STAYS} are needed"
            return None
        self._tried, self._tried_s = len(used), poses[-1][0]
        before = before if len(before) >= LEAST_STAYS else []
        found = updated_rig(self._rig, self._body, _some(used), _some(before))
        if isinstance(found, Missed):
            self.rejected = f"cameras: {found.reason}"
            return None
        now_m, then_m = found.sigma_m
        by_m = math.sqrt(max(now_m**2 - then_m**2, 0.0))
        most_m = max(MOST_SIGMA_M, SHARE * then_m) if before else then_m
        if not by_m <= most_m:
            self.rejected = (
                f"cameras: their pose would leave the body uncertain by {1e3 * by_m:.2f} mm, at most {1e3 * most_m:.2f} mm "
                "are accepted: move the body through the whole view"
            )
            return None
        self._rig, self._tried, self._tried_s, self.rejected = found.rig, 0, -math.inf, None
        return RigCorrection("cameras", since_s, at_s, "body", found, np.zeros(6), np.zeros((6, 6)))

    def base_by_bodies(
        self, since_s: float, motion: tuple[Array, Array], at_s: float, p_left: Array
    ) -> RigCorrection | None:
        """Return the rig put right by what fixed bodies show; None where that does not suffice, as ``rejected`` says.

        ``since_s``: since when the cameras are found to have moved, s. ``motion``: (6,) of the cameras, right tangent
        in the left one's frame, [m; rad], and its covariance. ``at_s``: the time, s. ``p_left``: (3,) where the body on
        the tool is, in the left camera's frame, m.
        """
        at_body = np.hstack([np.eye(3), -skew(p_left)])
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(at_body @ motion[1] @ at_body.T)[-1]))
        if sigma_m > MOST_SIGMA_M:
            self.rejected = (
                f"base: the fixed bodies leave the body on the tool uncertain by {1e3 * sigma_m:.2f} mm, at most "
                f"{1e3 * MOST_SIGMA_M:g} mm are accepted: use more or larger ones, on all sides of the tool"
            )
            return None
        self.rejected = None
        return RigCorrection("base", since_s, at_s, "fixed bodies", None, *motion)

    def base_by_arm(
        self, changes: Sequence[Change], T_base_rig: Array, at_s: float, moved: Moved | None
    ) -> RigCorrection | None:
        """Return the rig put right by what the arm's poses show; None where they do not suffice, as ``rejected`` says.

        ``T_base_rig``: (4, 4) the rig as it was calibrated, m. ``moved``: the motion of the rig, if it is one; None
        where nothing was measured after it.
        """
        best = changes[0]
        others = [each for each in changes[1:] if each.suspect.cause != "fixed" and not each.besides]
        if best.suspect.cause != "fixed":
            self.rejected = f"base: a change of the {best.suspect.cause} explains the poses of the arm better"
            return None
        if moved is None:
            self.rejected = "base: no pose was measured since it moved"
            return None
        sigma_m = moved.sigma_m
        if sigma_m > _MOST_BY_ARM_M:
            self.rejected = (
                f"base: the tool would be uncertain by {1e3 * sigma_m:.2f} mm, at most {1e3 * _MOST_BY_ARM_M:g} mm are "
                "accepted: move the arm more, about all its joints"
            )
            return None
        T, t_s = best.T_base_tool, best.end_s
        shift, _ = best.displacement(T, t_s)
        apart = [float(np.linalg.norm((each.displacement(T, t_s)[0] - shift)[:3])) for each in others]
        if max(apart, default=0.0) > MOST_APART_M:
            self.rejected = f"base: {others[int(np.argmax(apart))].suspect.cause} cannot be excluded: move the arm more"
            return None
        self.rejected = None
        return self._by_arm(best.begin_s, T_base_rig, at_s, moved)

    def refined(
        self, right: RigCorrection, T_base_rig: Array, at_s: float, moved: Moved | None
    ) -> RigCorrection | None:
        """Return a correction by the arm's poses that replaces an earlier one; None where they hardly say more of it.

        ``right``: the earlier one. ``T_base_rig``: (4, 4) the rig as it was put right, m. ``at_s``: the time, s.
        ``moved``: what is left of the motion.
        """
        assert right.tool_m is not None
        if moved is None:
            return None
        by, cov = moved.at(moved.Ts_base_tool[-1])
        if moved.sigma_m > _REFINED * right.tool_m[1] and squares_of(by[:3], cov[:3, :3]) < _MORE:
            return None
        return self._by_arm(right.since_s, T_base_rig, at_s, moved, right)

    def _by_arm(
        self, since_s: float, T_base_rig: Array, at_s: float, moved: Moved, refines: RigCorrection | None = None
    ) -> RigCorrection:
        """Return the correction of a motion, or of what an earlier one left of it."""
        # What was measured is exp(xi) times the true pose, with xi in the base's frame.
        to_rig = adjoint(inverse(T_base_rig))
        motion, cov = -to_rig @ moved.xi, to_rig @ moved.cov @ to_rig.T
        T_rig_tool = inverse(T_base_rig) @ moved.Ts_base_tool[-1]
        if refines is not None:
            motion = log_se3(exp_se3(refines.motion) @ exp_se3(motion))
        displaced_m = float(np.linalg.norm((adjoint(inverse(T_rig_tool)) @ motion)[:3]))
        tool_m = displaced_m, moved.sigma_m
        return RigCorrection("base", since_s, at_s, "arm", None, motion, cov, tool_m, refines)


def _moved(motion: BaseMotion, measurements: Sequence[KeptMeasurement]) -> Moved | None:
    motion.take(measurements)
    return motion.moved


def remeasured(rig: StereoRig, body: Body, pose: PoseEstimate) -> PoseEstimate | Missed:
    """Measure a pose again from its detections, with another calibration of the cameras."""
    return locate(rig, body, triangulate(rig, body, gate(rig, body, pose.points.seen)))


def _differing(poses: Sequence[PoseEstimate]) -> list[PoseEstimate]:
    kept: list[PoseEstimate] = []
    for pose in poses:
        if not kept or differ(kept[-1].T_left_body, pose.T_left_body):
            kept.append(pose)
    return kept


def _some(poses: Sequence[PoseEstimate]) -> list[SeenShot]:
    shots = list[SeenShot]()
    for k, pose in enumerate(poses[:: -(-len(poses) // _MOST_SHOTS) or 1]):
        seen = pose.points.seen
        ids, uv = seen.ids[seen.paired], seen.uv[seen.paired]
        shots.append(SeenShot(str(k), (ids, ids), (uv[:, 0], uv[:, 1])))
    return shots
