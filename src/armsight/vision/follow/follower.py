"""Follow a body of discs from shot to shot: after the first pose, only its predicted surroundings are searched.

The pose is extrapolated with the velocity of the last two; each disc is searched within a margin that adapts to the
errors of the last predictions, and everything from pixels to covariance is one compiled call
(:mod:`~armsight.vision.follow.kernel`). A shot that does not fit, and any first shot, is measured by
:func:`~armsight.vision.pose.measure.measure`, which searches the whole image and uses no prediction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeGuard

import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Correspondences, Dropped, Missed, Points, PoseEstimate, Record, Shot
from armsight.errors import InputError
from armsight.geometry.pose import inverse, log_se3
from armsight.vision.follow.kernel import (
    ASTRAY,
    FACING_AWAY,
    NOT_THERE,
    OTHER_SIZE,
    OUTSIDE,
    SEEN,
    DiscMeasurement,
    DiscScene,
    follow_pair,
    velocity,
)
from armsight.vision.image import grey
from armsight.vision.markers.disc import search
from armsight.vision.markers.disc.fit import REASONS, workspace
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.locate import misfit_limit
from armsight.vision.pose.measure import measure
from armsight.vision.pose.posefit import moved
from armsight.vision.pose.shutter import LOOSE_PX
from armsight.vision.rig import StereoRig

#: A prediction expires after so many shots, or so many times the time between the last two poses; poses less than so
#: many seconds apart give no velocity.
_OLDEST_SHOTS, _OLDEST_STEPS, LEAST_S = 3, 4.0, 1e-6


@dataclass(frozen=True, eq=False)
class BodyTrack(Record):
    """The motion of a body between shots: where it should be next.

    Attributes:
        T_left_body: (4, 4) last pose.
        twist: (6,) its velocity in the body's axes, per second, or per shot where shots carry no time.
        t_s: time of the last pose, or the number of its shot.
        shots: number of shots since then.
        margin_px: largest error of a prediction, px.
        step_s: from the pose before to the last; infinite where the twist is unknown.
        proven: whether the motion has predicted a pose before; a pose far from the prediction is then a jump.
    """

    T_left_body: Array
    twist: Array
    t_s: float
    shots: int
    margin_px: float
    step_s: float
    proven: bool

    def predicts(self, t_s: float) -> bool:
        """Whether there is a prediction for a time: not before the last pose, nor too long after."""
        since = t_s - self.t_s
        return self.shots < _OLDEST_SHOTS and LEAST_S <= since < math.inf and since <= _OLDEST_STEPS * self.step_s

    def predicted(self, t_s: float) -> Array:
        """Return the pose (4, 4) at a time."""
        T = np.empty((4, 4))
        moved(self.T_left_body, self.twist * (t_s - self.t_s), T)
        return T


def measurer(rig: StereoRig, target: Target, apart_s: float = 0.0) -> Callable[[Shot], PoseEstimate | Missed]:
    """Return what measures a target shot by shot: a follower where it can be followed, else :func:`measure`."""
    return Follower(rig, target, apart_s).measure if follows(target) else partial(measure, rig, target)


Way = Literal["followed", "searched", "lost"]

#: How far discs may be from where they are predicted, px: after a search, when nothing is known of the velocity; at the
#: least and at the most; and in sizes of the last errors of prediction.
_MARGIN_FIRST_PX, _MARGIN_LEAST_PX, _MARGIN_MOST_PX, _MARGIN_ERRORS = 60.0, 6.0, 120.0, 4.0
#: Exposures so far apart, s, move a body by more than a gate allows: a search then lets larger gaps pass.
APART_S = 5e-4
#: A pose from another source is taken back by so much, s, to be predicted from there.
_BEFORE_S = 1e-3
#: While it is searched where it is expected, the whole image is searched once in so many shots.
_SEARCH_EVERY = 8
#: A pose found by searching that differs from the prediction by more than this is reported as a jump: rad; image px.
_JUMP_RAD, _JUMP_PX = 0.35, 2 * _MARGIN_FIRST_PX
_TEXTS = {
    **REASONS,
    FACING_AWAY: "facing away from the camera",
    OUTSIDE: "outside the image",
    NOT_THERE: "not where it is predicted",
    OTHER_SIZE: "not of the predicted size",
    ASTRAY: "not where the body's other discs say",
}


class Follower:
    """Measures a body of discs shot after shot.

    Attributes:
        way: how the last shot was measured.
        jump: what was implausible about the last pose, given the ones before; None where nothing was.
    """

    way: Way
    jump: str | None

    def __init__(self, rig: StereoRig, target: Target, apart_s: float = 0.0) -> None:
        """Prepare to follow.

        ``target``: a body whose markers are discs and nothing else, with the normals of all known; ``apart_s``: standard
        deviation of the time between the two exposures of a shot, s: by as much as a moving body moves in it, its images
        may contradict each other.
        """
        self.way, self.jump = "lost", None
        self._track: BodyTrack | None = None
        self._count = self._vain = 0
        if not follows(target):
            raise InputError(
                f"{target.body.name} cannot be followed: it needs three discs or more with known normals, and no "
                "coded markers; measure and measure_all take it"
            )
        discs = target.discs
        assert discs is not None
        self.target = target
        self._describe(rig)
        self.expose_apart(apart_s)
        self._found = _buffers(len(discs.radii_m), rig.parameter_count)
        self._cov_noise, self._rows = np.empty((6, 6)), np.arange(len(discs.radii_m))
        self._limits = np.array([misfit_limit(2 * n - 6) for n in range(2 * len(discs.radii_m) + 1)])
        self._work, self._outline = workspace(), search.workspace()

    def _describe(self, rig: StereoRig) -> None:
        discs = self.target.discs
        assert discs is not None
        self.rig = rig
        kernel = [camera.kernel_arguments() for camera in rig.cameras]
        sizes = [camera.parameters.size for camera in rig.cameras]
        self._scene = DiscScene(
            np.array([k[0] for k in kernel]),
            np.stack([k[1] for k in kernel]),
            np.stack([k[2] for k in kernel]),
            np.array([0, sizes[0]]),
            np.array(sizes),
            inverse(rig.T_left_right),
            np.array(rig.cov),
            max(rig.sigma_px, 1e-6) ** 2,
            np.array(discs.body.points),
            discs.bias_normals,
            np.isfinite(discs.normals[:, 0]),
            np.array(discs.radii_m),
            np.where(discs.bright, 1, -1),
            0.0,
            np.array(rig.disc_variance_factors),
        )

    def recalibrate(self, rig: StereoRig) -> None:
        """Go on with another calibration of the same cameras: the body is followed as before."""
        apart_s = self._scene.apart_s
        self._describe(rig)
        self.expose_apart(apart_s)

    def expose_apart(self, apart_s: float) -> None:
        """Replace the standard deviation of the time between the two exposures of a shot, s."""
        self._scene = self._scene._replace(apart_s=apart_s)
        self._loose = replace(self.rig, sigma_px=max(self.rig.sigma_px, LOOSE_PX)) if apart_s > APART_S else self.rig

    def measure(self, shot: Shot, expected: Array | None = None, twist: Array | None = None) -> PoseEstimate | Missed:
        """Measure one shot; shots must come in the order of their time.

        ``shot``: the pair of images. ``expected``: T_left_body (4, 4) from another source, such as an arm's joints, used
        while the body is lost: it is searched there, and in the whole image only once in several shots, for that takes
        long. ``twist``: (6,) velocity of the body there, m/s and rad/s, in its own axes; at rest by default.
        """
        self._count += 1
        t_s = float(self._count) if shot.t_s is None else shot.t_s
        self.jump = None
        result: PoseEstimate | Missed | None = None
        track = self._track
        usable = shot.left is not None and shot.right is not None and shot.problem is None
        if usable and track is not None and track.predicts(t_s):
            result = self._followed(shot, track, t_s)
        lost = self.way == "lost"
        if usable and result is None and lost and expected is not None:
            result = self._expected(shot, expected, np.zeros(6) if twist is None else twist, t_s)
        if isinstance(result, PoseEstimate):
            self.way, self._vain = "followed", 0
            return result
        if lost and expected is not None and 0 < self._vain < _SEARCH_EVERY:
            result = Missed(
                "not where it was lost, nor where it is expected; the whole image was searched shortly before"
            )
        else:
            result, self._vain = measure(self._loose, self.target, shot), 0
        if isinstance(result, Missed):
            self.way = "lost"
            self._vain += 1
            if track is not None:
                self._track = replace(track, shots=track.shots + 1, margin_px=_MARGIN_MOST_PX)
            return result
        self.way = "searched"
        self._begin(shot, result, track, t_s)
        return result

    def _begin(self, shot: Shot, result: PoseEstimate, track: BodyTrack | None, t_s: float) -> None:
        """Start the track at a pose that was found by searching."""
        assert shot.left is not None
        self._noise = search.noise_of(grey(shot.left))
        self._found.contrast[:] = 0.0
        if track is not None and track.proven and track.predicts(t_s):
            before = track.predicted(t_s)
            xi = log_se3(inverse(before) @ result.T_left_body)
            away_m = max(float(result.T_left_body[2, 3]), 1e-3)
            px = self.rig.left.intrinsics[0] * float(np.linalg.norm(xi[:3])) / away_m
            rotated_rad = float(np.linalg.norm(xi[3:]))
            if rotated_rad > _JUMP_RAD or px > _JUMP_PX:
                self.jump = (
                    f"jumped {1e3 * np.linalg.norm(xi[:3]):.0f} mm and {np.degrees(rotated_rad):.0f} degrees from where it "
                    "was predicted"
                )
        twist, step_s = np.zeros(6), math.inf
        if track is not None and track.shots == 0 and LEAST_S <= t_s - track.t_s < math.inf and self.jump is None:
            step_s = t_s - track.t_s  # two poses found by searching give the velocity as well
            velocity(track.T_left_body, result.T_left_body, step_s, twist)
        self._track = BodyTrack(result.T_left_body, twist, t_s, 0, _MARGIN_FIRST_PX, step_s, False)

    def _expected(self, shot: Shot, T_left_body: Array, twist: Array, t_s: float) -> PoseEstimate | None:
        """Measure around a pose from another source; None where that gives no plausible pose."""
        assert shot.left is not None
        self._noise = search.noise_of(grey(shot.left))
        self._found.contrast[:] = 0.0
        before = np.empty((4, 4))
        moved(T_left_body, -_BEFORE_S * twist, before)
        track = BodyTrack(before, twist, t_s - _BEFORE_S, 0, _MARGIN_FIRST_PX, math.inf, False)
        result = self._followed(shot, track, t_s)
        if result is not None:  # one pose gives no velocity
            self._track = BodyTrack(result.T_left_body, twist, t_s, 0, _MARGIN_FIRST_PX, math.inf, False)
        return result

    def _followed(self, shot: Shot, track: BodyTrack, t_s: float) -> PoseEstimate | None:
        """Measure around the predicted pose; None where that gives no plausible pose."""
        assert shot.left is not None
        assert shot.right is not None
        left, right = grey(shot.left), grey(shot.right)
        for camera, image in zip(self.rig.cameras, (left, right), strict=True):
            if (image.shape[1], image.shape[0]) != camera.image_size_px:
                return None
        twist = track.twist.copy()
        seen, chi_square, wrong = self._pair(left, right, track.T_left_body, twist, t_s - track.t_s, track.margin_px)
        if not seen:
            return None
        margin = min(max(_MARGIN_ERRORS * wrong, 0.7 * track.margin_px, _MARGIN_LEAST_PX), _MARGIN_MOST_PX)
        T = self._found.T.copy()
        self._track = BodyTrack(T, twist, t_s, 0, margin, t_s - track.t_s, True)
        return self._estimate(T, seen, chi_square)

    def _pair(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], T: Array, twist: Array, seconds: float, margin: float
    ) -> tuple[int, float, float]:
        least = max(search.LEAST_CONTRAST, 5.0 * self._noise)
        arguments = (self._limits, self._found, self._cov_noise, self._work, self._outline)
        return follow_pair(left, right, T, twist, seconds, self._scene, margin, self._noise, least, *arguments)

    def _estimate(self, T: Array, count: int, chi_square: float) -> PoseEstimate:
        """Make the record of the compiled call's result: ``count`` ellipses."""
        found = self._found
        misfit = max(chi_square / (2 * count - 6), 1.0) if chi_square > self._limits[count] else 1.0
        uv, cov_uv = found.uv - found.bias, found.cov_uv.copy()
        dropped: tuple[Dropped, ...] = ()
        seen = both = self._rows
        p_left, cov_p, by_rig = found.p_left.copy(), found.cov_p.copy(), found.by_rig.copy()
        if count < 2 * len(seen):
            fits = found.codes == SEEN
            good = fits | (found.codes == ASTRAY)
            seen, both = np.flatnonzero(good.any(axis=1)), np.flatnonzero(fits.all(axis=1))
            uv[~good], cov_uv[~good], dropped = np.nan, 0.0, self._dropped(fits)
            uv, cov_uv = uv[seen], cov_uv[seen]
            p_left, cov_p, by_rig = p_left[both], cov_p[both], by_rig[both]
        noise, (rms_m, rms_px) = self._cov_noise * misfit, np.sqrt(found.squares / (len(both), count))
        correspondences = Correspondences(seen, uv, cov_uv, dropped, found.common.copy())
        points = Points(both, p_left, cov_p, by_rig, correspondences, dropped)
        return PoseEstimate(
            T, found.cov + noise, noise, float(rms_m), float(rms_px), math.sqrt(misfit), points, dropped
        )

    def _dropped(self, good: NDArray[np.bool_]) -> tuple[Dropped, ...]:
        """Return which discs which camera did not see, and why."""
        names = self.target.body.point_names
        return tuple(
            Dropped(names[m], f"{side}: {_TEXTS[int(self._found.codes[m, c])]}", self._found.codes[m, c] == ASTRAY)
            for c, side in enumerate(SIDES)
            for m in np.flatnonzero(~good[:, c])
        )


def follows(target: Target) -> TypeGuard[Composite]:
    """Whether a target can be followed: three discs or more and no coded points, their normals known or not needed."""
    discs = target.discs  # only a Composite has discs
    if discs is None or len(discs.body.points) < len(target.body.points):
        return False
    return len(discs.radii_m) >= 3 and bool(np.isfinite(discs.bias_normals).all())


def _buffers(count: int, parameters: int) -> DiscMeasurement:
    return DiscMeasurement(
        np.full((count, 2), NOT_THERE),
        np.zeros((count, 2, 2)),
        np.zeros((count, 2, 2, 2)),
        np.zeros((count, 2, 3)),
        np.zeros((count, 2, 2)),
        np.zeros((count, 2)),
        np.zeros((count, 2, 2)),
        np.eye(4),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        np.zeros((count, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3, parameters)),
        np.zeros(4 * count),
        np.zeros((4 * count, 6)),
        np.zeros((4 * count, parameters)),
        np.zeros((count, 2, 2)),
        np.zeros(2),
        np.zeros((2, 2, 3)),
    )
