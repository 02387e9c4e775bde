"""The health monitor: every measured pose goes through it, and it says at the end what no longer holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from armsight.data import Array, Body, PoseEstimate, Shot
from armsight.geometry.pose import transform
from armsight.loop.estimators import Outcome
from armsight.loop.finding import HealthFinding, Trust, displacement_m, make_finding
from armsight.loop.frame_clock import FrameClock
from armsight.loop.health.change import (
    DATED_S,
    Change,
    ToolView,
    doubtful,
    finding,
    happened_besides,
    suspected,
    thinned,
)
from armsight.loop.health.fixed import FixedWatch, ShakeWatch
from armsight.loop.health.host import HostWatch
from armsight.loop.health.landmarks import LandmarkWatch
from armsight.loop.health.rig import TEST_S, RigWatch
from armsight.vision.rig import StereoRig

if TYPE_CHECKING:
    from armsight.loop.estimators import Innovation, KalmanEstimator, Mounting, PoseMeasurement, Remembered
    from armsight.loop.estimators.clock import ClockFollower
    from armsight.loop.health.base_motion import BaseMotion, KeptMeasurement, Measurements
    from armsight.loop.health.closure import ClosureWatch
    from armsight.loop.health.follow import RigCorrection
    from armsight.loop.health.scene import SceneWatch
    from armsight.robot.kinematics.arm import Arm

#: So long after measurements contradicted what was learned the cause is open, s: the tests need some shots to find it.
DOUBT_S = 2.0
#: Knowledge is kept every so often, s, to go on from: all of the newest seconds, older ones each older by this factor.
#: half of what the factor exceeds 1 by: 5 MB more, double: what was learned just before an old change is lost.
_KEEP_S, _ALL_S, _RATIO = 1.0, 20.0, 1.2
#: Stamps that ran fast are put right to so much, s; half: joints are blamed, double: moving poses are too wide.
_RIGHT_S = 3e-3
#: While a clock is known no better than this, s, the arm's tests wait; half: too long, double: joints are blamed.
_KNOWN_S = 6e-4
#: Rate and offset of a clock are said beyond so many sigmas.
_CLOCK_SIGMAS = 4.0


class HealthMonitor:
    """Watches a measurement.

    Args:
        rig: the calibrated pair; the pose of its cameras cannot be tested if it has no covariance.
        sync_s: standard deviation of the time between the two exposures of a shot, s.
        printed: whether the body is a print whose shape a calibration found: its points are not tested.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float, *, printed: bool = False) -> None:
        self._body, self._sync_s, self._printed = body, sync_s, printed
        self._rig = RigWatch(rig, body, sync_s, printed=printed) if rig.cov.any() else None
        self._cameras = rig
        self._scene: SceneWatch | None = None
        self._p_left: Array | None = None  # where the body was seen last (3,), m
        self._host = HostWatch()
        self.stamps: FrameClock | None = None
        self._stamps_right = False
        self._landmarks: LandmarkWatch | None = None
        self._fixed: FixedWatch | None = None
        self._closure: ClosureWatch | None = None
        self._shakes = ShakeWatch()
        self._suspected: Array | None = None  # what the newest tested shot adds to the covariance of a pose
        self._newest_s, self._doubted_s = 0.0, -np.inf
        self._poses: list[tuple[PoseEstimate, float | None]] = []
        self._innovations: list[Innovation] = []
        self._rejected: list[Innovation] = []
        self._clock: ClockFollower | None = None
        self._clock_cost_m = 0.0  # by how much a clock that went wrong displaced the tool at most
        self._names: tuple[str, ...] = ()
        self._estimator: KalmanEstimator | None = None
        self._arm: Arm | None = None
        self._seen: ToolView | None = None
        self._cameras_s = np.inf  # since when the cameras are found to have moved, s
        self._known: list[tuple[float, Remembered]] = []
        self._measurements: Measurements | None = None
        # What was found before a correction: what it put right, and what else.
        self._kept: tuple[HealthFinding, ...] = ()
        self._found: dict[tuple[str, str], HealthFinding] = {}  # what was found last, by its subject
        self._past: tuple[Change, ...] = ()

    def received(self, pose: PoseEstimate, t_s: float | None) -> PoseEstimate:
        """Do as :meth:`measured` with what was suspected of the shots before; :meth:`work` makes the tests."""
        self._poses.append((pose, t_s))
        return self._widened(pose)

    def work(self) -> None:
        """Make the tests of everything that was received since the last call."""
        for pose, t_s in self._poses:
            self._take(pose, t_s)
        self._poses.clear()
        due = not self._known or self._newest_s - self._known[-1][0] >= _KEEP_S
        if self._estimator is not None and due and self.trust is not Trust.NONE:
            rows = thinned([t_s for t_s, _ in self._known], self._newest_s, _ALL_S, _RATIO)
            self._known = [*(self._known[k] for k in rows), (self._newest_s, self._estimator.remembered())]
        if self._fixed is not None and self._closure is not None and self._measurements is not None:
            for innovation in self._innovations:
                if agreed := self._agreed(innovation):
                    self._fixed.take(agreed)
                    self._closure.take(agreed)
                self._shakes.take(innovation)
                self._measurements.take(innovation)
            self._innovations.clear()
        if self._rig is not None and self._rig.wrong_at_rest and self._cameras_s == np.inf:
            begins = [each.since_s for each in self._rig.findings() if each.since_s is not None]
            self._cameras_s = min(begins, default=-np.inf) - TEST_S

    def _agreed(self, innovation: Innovation) -> list[Innovation]:
        """Return a measurement, after rejected ones with which so many agree that they count: else those are mistakes."""
        if innovation.outcome is Outcome.OUTLIER:
            self._rejected.append(innovation)
            return []
        again, self._rejected = self._rejected if innovation.outcome is Outcome.REOPENED else [], []
        return [*again, innovation]

    def measured(self, pose: PoseEstimate, t_s: float | None) -> PoseEstimate:
        """Take a measured pose, in order of time; return it with what is suspected added to its covariance.

        ``pose``: as it was measured. ``t_s``: time of its shot, s; None where it has none.
        """
        self._take(pose, t_s)
        return self._widened(pose)

    def _widened(self, pose: PoseEstimate) -> PoseEstimate:
        """Return a pose with what is suspected of cameras and body in its covariance."""
        if self._suspected is None or self._rig is None:
            return pose
        return replace(pose, cov=pose.cov + self._suspected, cov_noise=pose.cov_noise + self._rig.noise)

    def _take(self, pose: PoseEstimate, t_s: float | None) -> None:
        self._p_left = pose.T_left_body[:3, 3]
        if t_s is not None:
            self._host.take(pose, t_s)
        if self._rig is not None:
            added = self._rig.take(pose, t_s)
            self._suspected = added if added.any() else None

    def period_began(self, t_s: float, late_s: float) -> None:
        """Take by how much, s, a period of the control loop began late, at a time, s."""
        self._host.began(t_s, late_s)

    def watch_fixed(self, names: Sequence[str]) -> None:
        """Watch bodies in view that do not move, from now on."""
        self._landmarks, self._fixed_names = LandmarkWatch(names), tuple(names)

    def fixed_measured(self, row: int, pose: PoseEstimate, t_s: float | None) -> None:
        """Take the measured pose of the fixed body of a row, in order of time, s (None: the shots have no times)."""
        assert self._landmarks is not None
        self._landmarks.take(row, pose, t_s)

    def scene_seen(self, shot: Shot, t_s: float) -> None:
        """Look at the background of a shot, in order of time, s."""
        from armsight.loop.health.scene import SceneWatch  # not above: what measures a pair does not look at it

        if shot.left is not None:
            self._scene = scene = self._scene or SceneWatch(self._cameras)
            scene.take(shot, t_s, self._p_left)  # another thread may begin anew meanwhile

    @property
    def fixed_never_seen(self) -> tuple[str, ...]:
        """Names of the fixed bodies that were seen too rarely to say anything."""
        return () if self._landmarks is None else self._landmarks.never_seen

    def follow(self, estimator: KalmanEstimator, arm: Arm, mounting: Mounting | None = None) -> None:
        """Watch from now on, by what an estimator makes of the poses, whether rig, body and joints stay as they are."""
        from armsight.loop.health.base_motion import Measurements  # not above: what measures a pair needs no filter

        self._estimator, self._arm = estimator, arm
        if mounting is not None:
            self._seen = ToolView(mounting.T_base_rig, transform(mounting.T_tool_body, self._body.points))
        self._known.clear()
        self._measurements = Measurements()
        estimator.keep_reference()
        self._begin(estimator, arm)

    def _begin(self, estimator: KalmanEstimator, arm: Arm) -> None:
        """Begin the tests of what an estimator makes of the poses."""
        from armsight.loop.health.closure import ClosureWatch

        self._fixed = FixedWatch(arm.joints)
        self._closure = ClosureWatch(estimator.sigmas, arm.joints, self._seen)
        self._innovations, self._rejected, self._clock, self._names = [], [], estimator.clock, arm.joint_names
        estimator.on_innovation = self._note

    def _note(self, innovation: Innovation) -> None:
        """Keep what became of a measurement for the tests; a contradiction counts at once."""
        if innovation.clock is None or innovation.clock.sigma_s < _KNOWN_S:
            self._innovations.append(innovation)
        self._newest_s = innovation.t_s
        if innovation.clock is not None:
            self._clock_cost_m = max(self._clock_cost_m, float(displacement_m(innovation.clock.in_z)))
        if innovation.outcome is Outcome.REOPENED:
            self._doubted_s = innovation.t_s

    @property
    def follows(self) -> bool:
        """Whether what an estimator makes of the poses is watched."""
        return self._fixed is not None

    def cameras_moved(self) -> RigWatch | None:
        """Return a copy of the watch of the cameras that found a change, for another thread; None where it found none."""
        return self._rig.copied() if self._rig is not None and self._rig.wrong_at_rest else None

    def rig_moved(self) -> tuple[float, Array, Array] | None:
        """Return since when, s, and by which motion (6,), with covariance, fixed bodies show that both cameras moved."""
        marks = self._landmarks
        motion, cameras = (
            (None, None) if marks is None else (marks.motion, marks.of_cameras)
        )  # a thread may change them
        if motion is None or cameras is None or cameras.since_s is None:
            return None
        return cameras.since_s, *motion

    def recalibrated(self, correction: RigCorrection) -> None:
        """Begin the tests of cameras and bodies anew, once cameras were put right; what has another cause stays found."""
        self._kept += self._left(correction)
        self._renew(correction)

    def times_found(self) -> None:
        """Begin the tests of the cameras anew: when they expose was not known before, which looks like what moved."""
        self.work()
        if self._rig is not None:
            self._watch_cameras(self._rig.rig)

    def put_right(self, correction: RigCorrection) -> Remembered | None:
        """Begin anew after a correction; what was found stays. Return what the estimator goes on with, if there is one."""
        at_s, since_s = correction.at_s, correction.since_s
        self.work()
        right = [each for each in self._tested(correction) if self._explained(each, correction)]
        self._kept += (*(replace(each, corrected_s=at_s) for each in right), *self._left(correction))
        self._past += tuple(replace(each, until_s=at_s) for each in self.changes)
        self._renew(correction)
        return self._go_back(since_s)

    @property
    def stamps_ran(self) -> bool:
        """Whether stamps were found to have run fast, and what the estimator took of them is not yet taken back."""
        return self.stamps is not None and self.stamps.rate != 0.0 and not self._stamps_right

    def stamps_right(self) -> Remembered | None:
        """Go back to before stamps ran fast: what they displaced is taken back; return what the estimator knew then."""
        assert self.stamps is not None
        assert self.stamps.stepped is not None
        self._stamps_right = True
        self.work()
        since_s = self.stamps.stepped[0]
        if self._estimator is None or self._clock is None:
            return None
        if self._known and self._known[0][0] < since_s - DATED_S:  # else as little would be known as at the beginning
            self._go_back(since_s)
        self._clock.jumped(self._newest_s, _RIGHT_S)
        return self._estimator.remembered()

    def _go_back(self, since_s: float) -> Remembered | None:
        self._doubted_s = -np.inf
        if self._estimator is None or self._arm is None:
            return None
        self._known = [each for each in self._known if each[0] < since_s - DATED_S]
        before = self._known[-1][1] if self._known else self._estimator.nothing_known()
        self._estimator.restore(before)
        self._begin(self._estimator, self._arm)
        return before

    def _tested(self, correction: RigCorrection) -> tuple[HealthFinding, ...]:
        """Return what those tests found that begin anew after a correction."""
        cameras = () if self._rig is None or correction.update is None else self._rig.findings()
        return (*cameras, *self._moved())

    def _left(self, correction: RigCorrection) -> tuple[HealthFinding, ...]:
        """Return what else they found: that goes on though its test does not know of it any more.

        Cameras that moved against each other displace all poses, which arm and bodies then seem to explain.
        """
        left, cause = list[HealthFinding](), correction.cause
        for each in self._tested(correction):
            if self._explained(each, correction):
                continue
            if each.since_s is not None and each.since_s < correction.since_s - DATED_S:
                left.append(each)
            elif correction.update is None or each.cause == "joint":
                left.append(replace(each, alternatives=tuple(dict.fromkeys((*each.alternatives, cause)))))
        return tuple(left)

    def _explained(self, found: HealthFinding, correction: RigCorrection) -> bool:
        """Return whether a correction puts right what was found: not a body that others prove not to be fixed."""
        marks = self._landmarks
        if marks is not None and found in marks.not_fixed:
            return False
        return correction.cause in (found.cause, *found.alternatives)

    def _renew(self, correction: RigCorrection) -> None:
        if correction.update is not None:
            self._watch_cameras(correction.update.rig)
        self._scene = None
        if self._landmarks is not None:
            self._landmarks = LandmarkWatch(self._fixed_names)

    def _watch_cameras(self, rig: StereoRig) -> None:
        self._rig, self._cameras = RigWatch(rig, self._body, self._sync_s, printed=self._printed), rig
        self._suspected, self._cameras_s = None, np.inf

    @property
    def measurements(self) -> tuple[KeptMeasurement, ...]:
        """Some of the newest measurements that the estimator used."""
        return () if self._measurements is None else self._measurements.newest()

    def base_motion(self, begin_s: float, *, slow: bool) -> BaseMotion:
        """Return what estimates a motion of the rig that began at a time, s, and goes on where it is slow."""
        from armsight.loop.health.base_motion import BaseMotion

        assert self._estimator is not None
        nothing = -np.inf, self._estimator.nothing_known()
        known = next((each for each in reversed(self._known) if each[0] < begin_s - DATED_S), nothing)
        return BaseMotion(self._estimator, known, begin_s, slow=slow)

    @property
    def trust(self) -> Trust:
        """How far a loop may rely on the measured poses now."""
        cameras_moved = self._landmarks is not None and self._landmarks.cameras_moved
        if doubtful(self.changes) or cameras_moved or (self._rig is not None and self._rig.wrong_at_rest):
            return Trust.NONE
        return Trust.DOUBTED if self._newest_s - self._doubted_s < DOUBT_S else Trust.FULL

    @property
    def before(self) -> KalmanEstimator | None:
        """The estimator with what it knew before measured poses became wrong; None where that is not known."""
        since_s = [each.begin_s for each in self.changes if doubtful([each])]
        marks = self._landmarks
        if marks is not None and marks.cameras_moved and marks.of_cameras is not None:
            since_s.append(-np.inf if marks.of_cameras.since_s is None else marks.of_cameras.since_s)
        if self._rig is not None and self._rig.wrong_at_rest:
            since_s.append(self._cameras_s)
        until_s = min(since_s, default=np.inf) - DATED_S
        known = next((state for t_s, state in reversed(self._known) if t_s < until_s), None)
        return None if known is None or self._estimator is None else self._estimator.as_before(known)

    @property
    def changes(self) -> tuple[Change, ...]:
        """The hypotheses that explain what the estimator saw of a change, the best first; empty where there is none."""
        changes = self._every_change
        return () if self._clocks(changes) else changes

    @property
    def _every_change(self) -> tuple[Change, ...]:
        # The closure knows more causes than the innovations within a second, and sizes them better.
        if self._closure is None or self._fixed is None:
            return ()
        noticed = self._fixed.changes or self._fixed.reopened[0]
        changes = self._closure.changes or (noticed and self._closure.explained) or self._fixed.changes
        if not changes or changes is self._fixed.changes or any(each.besides for each in changes):
            return changes
        later = [each for each in self._fixed.changes if each.begin_s > changes[0].begin_s]
        return (*changes, *happened_besides(later, changes[0]))

    def _clocks(self, changes: Sequence[Change]) -> bool:
        """Return whether a clock that is followed explains hypotheses as well."""
        followed = self._clock is not None and self._clock.since_s is not None
        return followed and any(each.suspect.cause == "time" for each in changes)

    def _changed(self) -> tuple[HealthFinding, ...]:
        """Return what the estimator saw of a change: its hypotheses, or that it dropped what it had learned."""
        changes = self._every_change
        if changes:
            return () if self._clocks(changes) else (finding(changes, self._names),)
        return () if self._fixed is None else self._fixed.findings()

    def _moved(self) -> tuple[HealthFinding, ...]:
        """Return what the estimator and the fixed bodies say: one finding of cameras that moved, where both saw it."""
        changed, marks = self._changed(), self._landmarks
        seen = () if marks is None else marks.findings()
        if marks is None or marks.of_cameras is None or not changed:
            return (*changed, *seen)
        (arm,), cameras = changed, marks.of_cameras
        if "fixed" not in (arm.cause, *arm.alternatives) and not (arm.cause == "estimator" and marks.cameras_moved):
            return (*changed, *seen)
        begins = [each.since_s for each in (arm, cameras) if each.since_s is not None]
        what = (
            cameras.what if marks.cameras_moved else f"{cameras.what}; the poses of the arm show that the cameras did"
        )
        if (arm.cause, arm.unit) == ("fixed", "mm"):
            what += f": the tool appears displaced by {arm.size:.2f} mm"
        return (
            replace(cameras, what=what, since_s=min(begins, default=None)),
            *(each for each in seen if each is not cameras),
        )

    def suspected(self, measurement: PoseMeasurement) -> Array | None:
        """Return the covariance (6, 6) of what may have moved a pose measurement of the tool; None where nothing is."""
        return suspected(measurement, self._widening)

    @property
    def every_change(self) -> tuple[Change, ...]:
        """What explains the changes of a whole run: those that were put right, and those that were not."""
        return (*self._past, *self._widening)

    @property
    def _widening(self) -> tuple[Change, ...]:
        """What widens poses now: what is certain, also where it is smaller than is reported."""
        small = () if self._closure is None or self._clocks(self._closure.certain) else self._closure.certain
        changes = self.changes or small
        return changes if self._shakes.change is None else (*changes, self._shakes.change)

    def findings(self, *, ends: bool = True) -> tuple[HealthFinding, ...]:
        """Return what was found so far; where it ``ends``, the newest second is tested at once."""
        self.work()
        sigma_s = 0.0 if self._estimator is None else self._estimator.settings[1].sigma_s
        late = () if self._clock is None else _clock_findings(self._clock, self._newest_s, sigma_s, self._clock_cost_m)
        if self.stamps is not None and self.stamps.stepped is not None:
            late = (_stamps_finding(*self.stamps.stepped, self.stamps.rate),)
        now = (
            *(() if self._rig is None else self._rig.findings(ends=ends)),
            *self._moved(),
            *self._shakes.findings(),
            *late,
            *self._host.findings(),
        )
        now = _with_scene(now, () if self._scene is None else self._scene.findings())
        sigma_m = None if self._rig is None else self._rig.pose_sigma_m
        sigma_mm = None if sigma_m is None else 1e3 * sigma_m
        now = tuple(replace(each, pose_sigma_mm=sigma_mm).since(self._found.get(each.subject)) for each in now)
        self._found = {each.subject: each for each in now}
        again = {each.subject for each in now}
        kept = (each for each in self._kept if each.corrected_s is not None or each.subject not in again)
        return (*kept, *now)


def _with_scene(found: tuple[HealthFinding, ...], scene: tuple[HealthFinding, ...]) -> tuple[HealthFinding, ...]:
    """Return findings with what the background shows: in the same finding where body or arm say it, too."""
    for seen in scene:
        same = next((each for each in found if seen.cause in (each.cause, *each.alternatives)), None)
        if same is None:
            found = (*found, seen)
        else:
            both = replace(same, what=f"{same.what}; the background says: {seen.what}")
            found = tuple(both if each is same else each for each in found)
    return found


def _clock_findings(clock: ClockFollower, t_s: float, sigma_s: float, cost_m: float) -> tuple[HealthFinding, ...]:
    """Return what is wrong with the cameras' clock at a time, s; nothing while its delay is as measured, to a sigma, s."""
    if clock.since_s is None:
        return ()
    offset_s, (rate, sigma) = clock.offset_s(t_s), clock.rate
    drifts = f", and drift by {1e6 * rate:.0f} +- {1e6 * sigma:.0f} ppm" if abs(rate) > _CLOCK_SIGMAS * sigma else ""
    if not drifts and abs(offset_s) < _CLOCK_SIGMAS * sigma_s:  # the delay was known no better
        return ()
    return (
        make_finding(
            "time",
            (offset_s, clock.sigma_s),
            clock.since_s,
            cost_m=cost_m or None,
            words={"more": f"{drifts}; it was followed"},
        ),
    )


def _stamps_finding(since_s: float, shifted_s: float, rate: float) -> HealthFinding:
    """Return the finding of stamps of images that were shifted, s, of a clock that runs fast by a share."""
    runs = f"runs {abs(100.0 * rate):.2f} % {'fast' if rate > 0 else 'slow'}"
    jumped = f"jumped {'back' if shifted_s > 0 else 'ahead'} by {abs(shifted_s):.3f} s"
    how = " and ".join([*([jumped] if shifted_s else []), *([runs] if rate else [])])
    size, unit = (shifted_s, "ms") if shifted_s else (rate, "%")
    return make_finding("stamps", (size, 0.0), since_s, unit=unit, words={"how": how})
