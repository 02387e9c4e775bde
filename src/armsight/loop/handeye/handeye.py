"""Hand-eye calibration, with the sources of its error weighed by the residuals themselves.

In: :class:`~armsight.loop.handeye.poses.Poses`, and where there are streams their times and speeds. Out:
:class:`HandEye`: both transforms with a covariance, the sources of the error, and the error of poses left out. In order:

1. A robust start: closed forms from all poses and from small parts (:func:`~armsight.loop.handeye.poses.starts`), then
   least squares with the weights of Student's t; what is further than chance allows is left out as a blunder.
2. Motions that leave a direction open are rejected (:func:`require_rotations`, :func:`require_known`).
3. Variances of the sources (:mod:`armsight.loop.handeye.sources`) and transforms in turn, blunders left out. What changes
   over time, or is off in the eye, is taken up by the score of its variance at zero.
4. Two models, an arm that is as its model says and one that is not (its links where the joints are known, and a smooth
   error over its poses), each integrated over what the residuals leave open about the variances, and weighted by their
   evidence (:mod:`armsight.estimate.variance`). An error that is the same in all poses is in no residual: what an arm's
   lengths may be off by (``LINK``, ``DRIFT``) is in the covariance by this weight alone.

The rows are put into an order of their own first (by time, else by content), so that theirs changes nothing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, expit, fdtri

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError, noted, require
from armsight.estimate.chance import squares_of
from armsight.estimate.change import StateChange, changed, matters, robust
from armsight.estimate.linear import Linear
from armsight.estimate.solve import Solved, covariances, left_out, log_density, solve
from armsight.estimate.variance import SPEAKS, integrate, most_probable, posterior, scores
from armsight.files import write_text
from armsight.geometry.convert import as_transforms
from armsight.geometry.pose import exp_se3, inverse, log_se3, mean_pose, transform
from armsight.geometry.rotation import skew
from armsight.loop.handeye.poses import (
    CHANCE,
    MIDDLE,
    MIN_POSES,
    PART,
    PARTS,
    Eye,
    HeldOut,
    Poses,
    checked_poses,
    kronecker,
    residuals,
    starts,
)
from armsight.loop.handeye.sources import (
    DRIFT,
    EYE,
    LINKS,
    MAP_OF,
    OF_THE_ARM,
    OVER_TIME,
    SAID,
    error_maps,
    over_poses,
    over_time,
)
from armsight.plots import new_figure
from armsight.tables.poses import PoseTable

#: Poses that the fit comes from at most, and the variances, evenly spread; half: less is known, double: twice the time.
MAX_FIT, MAX_VARIANCE = 1000, 120
#: Poses that sources over time are chosen from at most; half: walks are seen badly, double: eight times the time.
MAX_WALK = 60
MIN_SHARED = 12  # fewest poses for errors that poses share
#: Rotation about a second axis must exceed the noise of rotations by this factor, and this angle, rad.
CLEARLY_ROTATED, LEAST_ROTATION = 3.0, np.radians(0.5)
#: Rotations of half of the poses that differ by more than this, rad, are not of one motion.
CONTRADICTS = np.radians(10.0)
#: A sigma (m, rad) that is no answer. half: few small rotations are rejected, double: a tool 40 mm off may be driven.
OPEN_M, OPEN_RAD = 0.5, 0.5
TRUSTED_M, TRUSTED_RAD = 0.02, 0.04
#: What a further pose is uncertain by at least, m and rad: where hardly anything scattered, one would determine all.
LEAST_M, LEAST_RAD = 1e-5, 1e-5
#: Mean sigma of an arm's links, and of the smooth error all make, m and rad; and how probable that is. half: an arm a
#: few mm longer is not allowed for, double: few poses claim too little.
LINK, DRIFT_SIZE, ARM_OFF = (1e-3, 1e-3), (1e-3, 1e-3), 0.5
#: Sigma of rotations that have hardly any weight, rad; by how many sigmas, and by which factor, errors of positions left
#: out must be lower without them. half: chance weights positions alone, double: contradictions spoil the nominal arm's use.
HARDLY, SURELY_LOWER, CLEARLY = 0.005, 3.0, 1.1
DECISIVE = 5.0  # times a sigma grows without one pose; half: every tenth pose of few is named, double: hardly any
UNDETERMINED = 100.0  # times; half, double: another word from there on
FREEDOM = 4.0  # degrees of freedom of Student's t in the robust start
#: A scale must be off by so many sigmas to be taken, and has settled where a step is below this share of one.
SURELY, SETTLED = 5.0, 0.1
#: Times a position's error that the flange must spread for a scale. half: noise counts, double: a few cm are rejected.
STILL = 3.0
_TIMED = {name for pair in OVER_TIME for name in pair}  # sources that change over time
ROUNDS = 6  # rounds of least squares and of leaving out


def _transform_of(eye: Eye, name: str, field_name: str, what: str) -> property:
    """Return the property of a transform that is constant with one mounting of the eye only."""

    def of(self: HandEye) -> Array:
        if self.eye != eye:
            raise InputError(f"{name} is not constant with the eye {self.eye!r}; it belongs to {eye!r}")
        return np.asarray(getattr(self, field_name))

    return property(of, doc=f"(4, 4) {what}; eye {eye.replace('_', ' ')} only.")


@dataclass(frozen=True, eq=False)
class HandEye(Record):
    """A hand-eye calibration: two constant transforms, their covariance, and the error on poses left out of the fit.

    Attributes:
        eye: "to_hand": the rig stands still and the flange carries the body; "in_hand": the other way round.
        T_base_still: (4, 4) what stands still, in the base: the rig, or in_hand the body.
        T_flange_held: (4, 4) what the flange carries: the body, or in_hand the rig.
        cov: (12, 12) covariance of the right tangents of T_base_still and T_flange_held, m and rad.
        scale: true lengths over those of the measured body; 1 where it was taken as given.
        sigma_scale: its sigma; zero where it was not fitted.
        step_s: what is left of the time offset, s, to be added to the eye's times; sigma_step_s its sigma; zero
            without.
        structure: what is found beside independent errors, as people read it; "robot and camera" if nothing is.
        sigmas: source -> most probable sigma of one axis, m, rad, s, or a factor.
        likelihoods: sources -> mean logarithm of the probability density of a pose left out.
        arm_off: the probability that the arm is not as its model says, by the residuals; 0 where it was not asked.
        arm_m: what the arm's error moves the body's middle by, RMS of the distance, m.
        camera_m: what vision's error does, m.
        held_out: the error on poses left out of the fit, of transforms found as these were, the arm as its model is.
            Where the links are found to be off (``sigmas`` has them) they go with the true arm, not with the model.
        held_out_nominal: the same with the mounting that suits the arm's nominal model; another only with links.
        held_out_geometry: the same as held_out where the arm's error, as the other poses show it, is taken into
            account: its geometry with ``links``, else its smooth error over its poses; None where it is rather as its
            model.
        used: (N,) whether a pose was used, and not taken for a blunder.
        distance: (N,) Mahalanobis distance of each pose's residual, in units of its expectation.
        common: (K,) the errors that all poses share (``Poses.common``), as found, in sigmas.
        common_m: what they move the body's middle by, RMS of the distance, m.
        leverage: (N,) by which factor a sigma grows where that pose is left out, the worst direction's; 1 unused.
        eye_off: by which share what is seen is too near, or too far, and its sigma, by its source; where it was found.
        change: how what stands still, or what is held, was displaced while the poses were taken, which ``cov`` allows
            for; None where neither was.
    """

    eye: Eye
    T_base_still: Array
    T_flange_held: Array
    cov: Array
    scale: float
    sigma_scale: float
    step_s: float
    sigma_step_s: float
    structure: str
    sigmas: dict[str, float]
    likelihoods: dict[str, float]
    arm_off: float
    arm_m: float
    camera_m: float
    held_out: HeldOut
    held_out_nominal: HeldOut
    held_out_geometry: HeldOut | None
    used: NDArray[np.bool_]
    distance: Array
    common: Array
    common_m: float
    leverage: Array
    eye_off: dict[str, tuple[float, float]]
    change: StateChange | None = None

    def __repr__(self) -> str:
        """Return the error on poses left out of the fit, and both translations with one sigma, mm."""
        position_m, angle_rad = self.held_out.rms()
        shown, Ts = [], (self.T_base_still, self.T_flange_held)
        for name, T, sigma_mm in zip(("still", "held"), Ts, self.sigma_mm, strict=True):
            both = zip(1e3 * T[:3, 3], sigma_mm, strict=True)
            shown.append(f"{name} at {', '.join(f'{x:.2f} +- {sigma:.2f}' for x, sigma in both)} mm")
        return (
            f"HandEye({self.eye}, {int(self.used.sum())} of {len(self.used)} poses; held out {1e3 * position_m:.3f} mm "
            f"RMS, {np.degrees(angle_rad):.3f} deg; {'; '.join(shown)}{self.decided_by()}"
            f"{'; ' * (self.change is not None)}{self.changed_at()})"
        )

    def decided_by(self, names: Sequence[str] = ()) -> str:
        """Return a remark where one pose alone determines a direction, by its name or number; empty where none does."""
        k = int(np.argmax(self.leverage))
        if self.leverage[k] < DECISIVE:
            return ""
        size = "undetermined" if self.leverage[k] > UNDETERMINED else f"{self.leverage[k]:.0f} times less certain"
        return f"; one pose decides: without {names[k] if names else f'pose {k}'} a direction is {size}"

    def mistaken_eye(self) -> list[str]:
        """Return a remark for each source by which what is seen is surely too near or too far."""
        said = {
            "size": "the target's size and the robot's lengths do not agree{}: measure the target, or --scale",
            "focal": "depths that the camera saw are off{}, lateral distances are not: is its focal length right?",
        }
        off = {name: f" by {abs(x):.2%} ± {sigma:.2%}" for name, (x, sigma) in _sure(self.eye_off).items()}
        return [said[name].format(by) for name, by in off.items()]

    def changed_at(self, names: Sequence[str] = ()) -> str:
        """Return a remark where something was displaced between two poses, by name or number; empty where not."""
        if self.change is None:
            return ""
        to_hand = {"still": "the rig, or the robot's base,", "held": "the body on the flange"}
        in_hand = {"still": "the body, or the robot's base,", "held": "the rig on the flange"}
        step, row = self.change.step[self.change.columns], self.change.row
        first = names[row] if names else f"pose {row}"
        unsure = "" if self.change.sure else ", or arm or rig are off by what depends on the pose"
        return (
            f"from {first} on {(in_hand if self.eye == 'in_hand' else to_hand)[self.change.way]} stands elsewhere, by "
            f"{1e3 * np.linalg.norm(step[:3]):.1f} mm and {np.degrees(np.linalg.norm(step[3:])):.2f} deg{unsure}; the "
            "transforms are of neither state, and their sigmas allow for that: use one of both parts"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the transforms, their covariance and the errors on poses left out, as lists and numbers, SI units."""
        held, still = ("T_flange_rig", "T_base_body") if self.eye == "in_hand" else ("T_flange_body", "T_base_rig")
        found: dict[str, Any] = {
            "eye": self.eye,
            "change": None,
            held: self.T_flange_held.tolist(),
            still: self.T_base_still.tolist(),
            "cov_m_rad": self.cov.tolist(),
            "cov_order": [f"{still}: right tangent, translation then rotation", f"{held}: the same"],
        }
        if self.change is not None:
            found["change"] = self.change.to_dict() | {"way": {"still": still, "held": held}[self.change.way]}
        for name in ("held_out", "held_out_nominal", "held_out_geometry"):
            errors: HeldOut | None = getattr(self, name)
            found[f"{name}_rms_m"] = None if errors is None else errors.rms()[0]
            found[f"{name}_mean_m"] = None if errors is None else errors.mean()[0]
        return found | {"held_out_rms_rad": self.held_out.rms()[1]}

    def save(self, path: str | Path) -> None:
        """Write :meth:`to_dict` as JSON.

        Raises:
            InputError: it cannot be written; then nothing is.
        """
        write_text(Path(path), json.dumps(self.to_dict(), indent=1) + "\n")

    def plot(self) -> Any:  # noqa: ANN401 - matplotlib is no dependency
        """Draw the error of every pose when it was left out of the fit, mm and degrees; return matplotlib's figure.

        Raises:
            InputError: matplotlib is not installed.
        """
        figure, axes = new_figure(2, 1, sharex=True)
        axes[0].bar(range(len(self.used)), 1e3 * self.held_out.position_m)
        axes[1].bar(range(len(self.used)), np.degrees(self.held_out.angle_rad))
        axes[0].set(ylabel="position, mm", title="errors of poses left out of the fit")
        axes[1].set(ylabel="angle, deg", xlabel="pose")
        return figure

    T_base_rig = _transform_of("to_hand", "T_base_rig", "T_base_still", "the rig in the base")
    T_flange_body = _transform_of("to_hand", "T_flange_body", "T_flange_held", "the body on the flange")
    T_flange_rig = _transform_of("in_hand", "T_flange_rig", "T_flange_held", "the rig on the flange")
    T_base_body = _transform_of("in_hand", "T_base_body", "T_base_still", "the body in the base")

    @property
    def sigma_mm(self) -> Array:
        """(2, 3) sigmas of the translations in mm, of T_base_still along the base's axes, T_flange_held the flange's."""
        R = np.stack([self.T_base_still[:3, :3], self.T_flange_held[:3, :3]])
        cov = np.stack([self.cov[:3, :3], self.cov[6:9, 6:9]])
        return np.asarray(1e3 * np.sqrt(np.einsum("kij,kjl,kil->ki", R, cov, R)))

    @property
    def sigma_flange(self) -> tuple[float, float]:
        """Error of the flange by the joints from pose to pose: sigmas along one axis, m, and about one, rad."""
        return self.sigmas.get("flange_m", 0.0), self.sigmas.get("flange_rad", 0.0)

    def whitened(self, poses: Poses) -> tuple[Array, Array]:
        """Return residuals (N, 6) of poses over the root of their covariance, and their derivative (N, 6, 12)."""
        e, J, carry = residuals(poses, self.T_base_still, self.T_flange_held)
        maps, C = error_maps(poses, 0 * e, carry, None), poses.cov + np.diag(np.repeat([LEAST_M**2, LEAST_RAD**2], 3))
        for name, sigma in self.sigmas.items():
            if (M := maps.get(MAP_OF.get(name, name))) is not None:
                C = C + sigma**2 * M @ np.swapaxes(M, 1, 2)
        half = np.linalg.inv(np.linalg.cholesky(C))
        return (half @ e[..., None])[..., 0], half @ J

    def predict(self, Ts_base_flange: Array) -> Array:
        """Return T_rig_body (..., 4, 4) at poses of the flange (..., 4, 4)."""
        if self.eye == "in_hand":
            return np.asarray(inverse(Ts_base_flange @ self.T_flange_held) @ self.T_base_still)
        return np.asarray(inverse(self.T_base_still) @ Ts_base_flange @ self.T_flange_held)


@dataclass(frozen=True, eq=False)
class _Guess(Record):
    """Transforms, scale, what is left of the time offset, and errors that vision shares between poses, in sigmas.

    Lengths are in the unit of the measured body: ``per_m`` of them make one metre.
    """

    Z: Array
    X: Array
    per_m: float = 1.0
    step_s: float = 0.0
    common: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, x: Array, free: tuple[bool, bool]) -> _Guess:
        """Return the guess after a step (P,) of Z, X and what is free of scale and time."""
        rest = list(x[12:])
        per_m = self.per_m * float(np.exp(np.clip(rest.pop(0), -1, 1))) if free[0] else self.per_m
        step_s = self.step_s + float(np.clip(rest.pop(0), -0.05, 0.05)) if free[1] else self.step_s
        common = self.common + rest if rest else self.common  # none are free in the robust start
        return _Guess(self.Z @ exp_se3(x[:6]), self.X @ exp_se3(x[6:12]), per_m, step_s, common)


@dataclass(frozen=True, eq=False)
class _Problem(Record):
    """What is fitted: the poses in their own order, and what their streams say."""

    poses: Poses
    t_s: Array | None
    speed: Array | None
    free: tuple[bool, bool]
    links: Array | None = None

    def rows(self, rows: NDArray[np.int64]) -> _Problem:
        """Return a part of the rows."""
        t_s, speed, links = (None if a is None else a[rows] for a in (self.t_s, self.speed, self.links))
        return _Problem(self.poses.rows(rows), t_s, speed, self.free, links)

    def scaled(self, guess: _Guess) -> Poses:
        """Return the poses with the guess's time and vision's shared errors, the flange's lengths in the body's unit."""
        p = self.poses.corrected(guess.common) if guess.common.size else self.poses
        A = p.A.copy() if self.speed is None or guess.step_s == 0 else p.A @ exp_se3(guess.step_s * self.speed)
        A[:, :3, 3] *= guess.per_m
        return replace(p, A=A)

    def linear(self, guess: _Guess, names: Collection[str] = ()) -> Linear:
        """Return the residuals at a guess, with the sources of their error: the independent ones, and the shared ``names``.

        Vision's shared errors are unknowns where the guess has them.
        """
        poses = self.scaled(guess)
        e, J, carry = residuals(poses, guess.Z, guess.X)
        unit = np.repeat([guess.per_m, 1.0], 3)  # an error of the flange of 1 m, and of 1 rad
        if self.free[0]:
            way = np.zeros((len(e), 6, 1))
            way[:, :3] = np.swapaxes(poses.A[:, :3, :3], 1, 2) @ poses.A[:, :3, 3:]
            J = np.concatenate([J, carry @ way], axis=2)
        carry = carry * unit
        if self.free[1] and self.speed is not None:
            J = np.concatenate([J, carry @ self.speed[..., None]], axis=2)
        before, common = J.shape[2], guess.common.size
        if common and poses.common is not None:
            J = np.concatenate([J, poses.common if poses.in_hand else -poses.common], axis=2)
        known, at = np.repeat([0.0, 1.0], [before, common]), np.append(np.zeros(before), guess.common)
        maps, given = error_maps(poses, e, carry, self.speed, self.links), poses.cov
        own = {name: M for name, M in maps.items() if name not in (*LINKS, *EYE)}
        if self.covered:
            own["image"] = np.asarray(np.linalg.cholesky(given + 1e-18 * np.eye(6)))
            given = np.zeros_like(given)
        shared = {name: maps[name] for name in (*LINKS, *EYE[self.free[0] :]) if name in maps}
        if not {*DRIFT}.isdisjoint(names):
            shared |= over_poses(self.poses.A, maps)
        if not _TIMED.isdisjoint(names) and self.t_s is not None:
            shared |= over_time(self.t_s, poses, maps, self.free[0])
        shared = {name: F for name, F in shared.items() if name in names}
        return Linear(e, J, given, own, shared, known, at)

    @property
    def covered(self) -> bool:
        """Whether every pose has a covariance from vision."""
        return bool(self.poses.cov.any(axis=(1, 2)).all())

    def means(self, linear: Linear, guess: _Guess) -> dict[str, float]:
        """Return the mean of each source's sigma before it is looked for: what the residuals are, or what arms do."""
        position, rotation = _middle_sigmas(linear.e)
        lengths = dict.fromkeys(("flange_m", "time_drift_m", "time_walk_m"), position / guess.per_m)
        of = {name: position if name.endswith("_m") else rotation for name in linear.sources} | lengths
        of |= dict.fromkeys(("scale_walk", *EYE), 1e-2) | {"image": 1.0, "time_s": 1e-3}
        return of | dict(zip((*LINKS, *DRIFT), (*LINK, *DRIFT_SIZE), strict=True))

    def metric(self, guess: _Guess, cov: Array) -> tuple[_Guess, Array]:
        """Return Z and X in m, and the covariance (P, P) of what was fitted with them."""
        change = np.eye(len(cov))
        change[:3, :3] = change[6:9, 6:9] = np.eye(3) / guess.per_m
        Z, X = guess.Z.copy(), guess.X.copy()
        Z[:3, 3] /= guess.per_m
        X[:3, 3] /= guess.per_m
        if self.free[0]:
            change[:3, 12] = -Z[:3, :3].T @ Z[:3, 3]
            change[6:9, 12] = -X[:3, :3].T @ X[:3, 3]
        return replace(guess, Z=Z, X=X), change @ cov @ change.T


def calibrate_handeye(
    Ts_base_flange: ArrayLike | Sequence[object] | PoseTable,
    Ts_rig_body: ArrayLike | Sequence[object] | PoseTable,
    covs: ArrayLike | None = None,
    *,
    eye: Eye = "to_hand",
    centre: ArrayLike | None = None,
    quick: bool = False,
    progress: Callable[[str], None] = lambda line: None,
) -> HandEye:
    """Calibrate the two constant transforms of rig, body and arm.

    Args:
        Ts_base_flange: (N, 4, 4) the flange in the base, from the joints, m, or a list of what ``as_transform`` takes, or
            what ``read_pose_table`` returns; it must rotate about two axes at least.
        Ts_rig_body: the same of the body in the rig at the same instants, m (``T_left_body`` of what was measured).
        covs: (N, 6, 6) covariance of the latter, right tangent (``PoseEstimate.cov``); None: not known.
        eye: "to_hand" where the rig stands still and the arm carries the body, "in_hand" where the arm carries the rig.
        centre: (3,) the middle of the body's points, body frame, m: errors of vision rotate the body about it.
            None: the body's origin.
        quick: whether independent errors alone are weighed, at their most probable sizes: while poses are being taken.
        progress: called with the name of each step as it begins.

    Raises:
        InputError: wrong shapes, NaN, no rigid motions, fewer than 4 poses, poses of the other ``eye``.
        CalibrationError: the motions leave a direction open.
    """
    from armsight.loop.identify.misread import require_mounting

    for name, each in (("Ts_base_flange", Ts_base_flange), ("Ts_rig_body", Ts_rig_body)):
        fits = not isinstance(each, str | Path)
        require(
            "handeye(Ts_base_flange, Ts_rig_body)", name, each, fits, 'poses (N, 4, 4): read_pose_table("robot.csv")'
        )
    A, B = (
        each.Ts if isinstance(each, PoseTable) else each if isinstance(each, np.ndarray) else as_transforms(each)
        for each in (Ts_base_flange, Ts_rig_body)
    )
    with noted([note for each in (Ts_base_flange, Ts_rig_body) if isinstance(each, PoseTable) for note in each.notes]):
        poses = checked_poses(A, B, covs, eye, np.zeros(3) if centre is None else centre)
        require_mounting(poses)
        return calibrate_poses(poses, quick=quick, progress=progress)


def calibrate_poses(
    poses: Poses,
    *,
    t_s: Array | None = None,
    speed: Array | None = None,
    links: Array | None = None,
    scale: bool = False,
    quick: bool = False,
    progress: Callable[[str], None] = lambda line: None,
) -> HandEye:
    """Calibrate hand and eye.

    ``poses``: four or more. ``t_s``: (N,) times of the poses, s, where they are known: what drifts over time, or walks,
    needs them. ``speed``: (N, 6) twist of the flange, right tangent, m/s and rad/s, of streams: the rest of the time
    offset is fitted. ``links``: (N, L, 4, 4) T_link_flange of every link, m, where the joints and a model are known.
    ``scale``: whether the size of the target may be wrong (one camera that moves has none): fitted, and kept where it
    is surely not 1.

    Raises:
        CalibrationError: the motions leave a direction open.
    """
    n = len(poses.A)
    if n < MIN_POSES:
        raise InputError(f"hand-eye calibration needs {MIN_POSES} or more poses, got {n}; 15 and more are advised")
    keys = np.concatenate([poses.B[:, :3].reshape(n, -1), poses.A[:, :3].reshape(n, -1)], axis=1)
    order = np.lexsort(keys.T if t_s is None else np.vstack([keys.T, t_s]))  # one that does not depend on theirs
    whole = _Problem(poses, t_s, speed, (False, speed is not None), links).rows(order)
    progress("hand-eye: start")
    if scale:
        whole, guess, used = _with_scale(whole)
    else:
        guess, used = _robust(whole, _first(whole.poses))
    require_rotations(whole.poses.rows(used), whole.linear(guess).e[used])
    if poses.common is not None:
        guess = replace(guess, common=np.zeros(poses.common.shape[2]))
    found, back = _weighed(whole, guess, used, quick, progress), np.argsort(order)
    left = {name: getattr(found, name) for name in ("held_out", "held_out_nominal", "held_out_geometry")}
    as_given: dict[str, Any] = {name: None if each is None else each.rows(back) for name, each in left.items()}
    as_given |= {name: getattr(found, name)[back] for name in ("used", "distance", "leverage")}
    if not quick and (change := _change(found, poses)) is not None:
        as_given |= {"change": change, "cov": found.cov + change.off.T @ change.off}
    return replace(found, **as_given)


def _change(found: HandEye, poses: Poses) -> StateChange | None:
    """Return how what stands still, or is held, was displaced in the order of the poses; None where sources walk, too."""
    if not _TIMED.isdisjoint(found.sigmas):
        return None
    poses, ways = poses if poses.common is None else poses.corrected(found.common), np.arange(12).reshape(2, 6)
    B = poses.B.copy()
    B[:, :3, 3] *= found.scale
    e, J = robust(*found.whitened(replace(poses, B=B)))
    by_pose = log_se3(inverse(mean_pose(poses.A)) @ poses.A)
    change = changed(-e, J, dict(zip(("still", "held"), ways, strict=True)), by_pose)
    return change if change is not None and matters(change, found.cov) else None


def evenly(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return at most this many of the rows, evenly spread."""
    if len(rows) <= most:
        return rows
    return np.asarray(rows[np.linspace(0, len(rows) - 1, most).round().astype(int)])


def _first(poses: Poses) -> list[_Guess]:
    part = poses.rows(evenly(np.arange(len(poses.A)), 300))
    return [_Guess(Z, X) for X, Z in starts(part.A, part.right_side)[:3]]


def _middle_sigmas(e: Array) -> tuple[float, float]:
    """Return sigmas along one axis of position and rotation, from the length below which the share MIDDLE is."""
    middle = np.sqrt(chdtri(3, 1 - MIDDLE))
    lengths = (np.quantile(np.linalg.norm(p, axis=1), MIDDLE) for p in (e[:, :3], e[:, 3:]))
    position, rotation = (max(float(length) / middle, 1e-9) for length in lengths)
    return position, rotation


def _robust(problem: _Problem, guesses: list[_Guess]) -> tuple[_Guess, NDArray[np.bool_]]:
    """Refine starts with the weights of Student's t; return the best, and which rows are no blunders."""
    best: tuple[float, _Guess] | None = None
    rows = evenly(np.arange(len(problem.poses.A)), MAX_FIT)
    part = problem.rows(rows)
    for start in guesses:
        guess = start
        for _ in range(25):
            linear = part.linear(guess)
            position, rotation = _middle_sigmas(linear.e)
            white = np.repeat([1 / position, 1 / rotation], 3)
            e, J = linear.e * white, linear.J * white[:, None]
            weight = (FREEDOM + 6) / (FREEDOM + np.sum(e**2, axis=1))
            H = np.einsum("n,nki,nkj->ij", weight, J, J)
            x = -np.linalg.lstsq(H, np.einsum("n,nki,nk->i", weight, J, e), rcond=1e-14)[0]
            guess = guess.moved(x, problem.free)
            if np.abs(x).max() < 1e-7:
                break
        cost = float(np.sum(np.log(_middle_sigmas(part.linear(guess).e))))
        if best is None or cost < best[0] - 1e-6:
            best = (cost, guess)
    assert best is not None
    e = problem.linear(best[1]).e
    position, rotation = _middle_sigmas(e)
    far = np.sum((e / np.repeat([position, rotation], 3)) ** 2, axis=1)
    used = far < 3 * chdtri(6, CHANCE)  # generous: axes differ; the structure's own covariance decides later
    return best[1], used


def _with_scale(problem: _Problem) -> tuple[_Problem, _Guess, NDArray[np.bool_]]:
    """Return the problem, with the scale free where it is surely not 1, and its robust solution."""
    known, used_known = _robust(problem, _first(problem.poses))
    free = replace(problem, free=(True, problem.free[1]))
    per_m = 1 / scale_between(problem.poses)
    guesses = [replace(one, per_m=per_m) for one in _first(problem.scaled(_Guess(np.eye(4), np.eye(4), per_m)))]
    found, used = _robust(free, guesses)
    rows = evenly(np.flatnonzero(used), MAX_VARIANCE)
    at, sure = found, False
    for _ in range(ROUNDS):
        linear = free.rows(rows).linear(at)
        solved = solve(linear, most_probable(linear, free.means(linear, at), steps=30))
        at, sigma = at.moved(solved.x, free.free), float(np.linalg.norm(solved.root[12]))
        sure = abs(np.log(at.per_m)) > SURELY * sigma and abs(solved.x[12]) < sigma
        if abs(solved.x[12]) < SETTLED * sigma:
            break
    (before_m, before_rad), (after_m, after_rad) = (
        _middle_sigmas(p.rows(rows).linear(g).e) for p, g in ((problem, known), (free, found))
    )
    spread_m = float(problem.poses.A[used_known][:, :3, 3].std(axis=0).max())
    if spread_m < STILL * min(before_m, after_m / found.per_m):
        raise CalibrationError(
            f"the flange rotates, but hardly moves: its positions spread by {1e3 * spread_m:.1f} mm, no more than errors "
            "do; the mounting and the size of what is seen cannot be found together: move the flange by 100 mm and more, "
            "or, where the size is known, leave out --scale"
        )
    gained = 3 * float(np.log(before_m / after_m * before_rad / after_rad))  # log density of a pose
    if ((sure and gained > -1) or gained > 1) and 1e-4 < found.per_m < 1e4:  # sure, but far worse: of blunders
        return free, found, used
    return problem, known, used_known


def scale_between(poses: Poses) -> float:
    """Return true lengths over those of the measured body, by closed forms from small parts of the poses."""
    p = poses.rows(evenly(np.arange(len(poses.A)), 300))
    A, B = p.A, p.right_side
    rng = np.random.default_rng(0)
    best = (np.inf, 1.0)
    for k in range(PARTS + 1):
        part = np.arange(len(A)) if k == 0 or len(A) <= PART else rng.choice(len(A), PART, replace=False)
        _, Z = kronecker(A[part], B[part])
        M = np.concatenate(
            [A[:, :3, :3], np.broadcast_to(-np.eye(3), (len(A), 3, 3)), -(B[:, :3, 3] @ Z[:3, :3].T)[..., None]], axis=2
        )
        found = np.linalg.lstsq(M[part].reshape(-1, 7), -A[part, :3, 3].ravel(), rcond=None)[0]
        left = float(np.quantile(np.linalg.norm(M @ found + A[:, :3, 3], axis=1), MIDDLE))
        if found[6] > 0 and left < best[0]:
            best = (left, float(found[6]))
    return best[1]


def rotations_of(poses: Poses, e: Array) -> tuple[Array, Array, float, float]:
    """Return how far the flange of poses rotates, and how far it must for both transforms to be determined.

    ``e`` are their residuals (N, 6), which say how large the noise of rotations is.

    Returns:
        Root mean squares (3,) of the rotations about each principal axis, rad, largest first; these axes (3, 3), columns,
        smallest first, in the flange; the noise of rotations about one axis, rad; the least that the second must be, rad.
    """
    rotated = log_se3(inverse(mean_pose(poses.A)) @ poses.A)[:, 3:]
    values, axes = np.linalg.eigh(rotated.T @ rotated / len(rotated))
    noise = _middle_sigmas(e)[1]
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes, noise, max(CLEARLY_ROTATED * noise, LEAST_ROTATION)


def require_rotations(poses: Poses, e: Array) -> None:
    """Reject motions whose rotations are about one axis only, as far as the noise in the residuals e (N, 6) shows.

    Raises:
        CalibrationError: the open direction, by name.
    """
    spread, axes, noise, least = rotations_of(poses, e)
    held = "flange-rig" if poses.in_hand else "flange-body"
    if noise > CONTRADICTS and spread[0] > LEAST_ROTATION:
        raise CalibrationError(
            f"the rotations of both sides contradict each other by {np.degrees(noise):.0f} deg: they are not of the same "
            "motion, or one side is read wrongly (order and sense of joints, rotations, which row belongs to which)"
        )
    if spread[0] < least:
        raise CalibrationError(
            f"the flange hardly rotates (RMS {np.degrees(spread[0]):.2f} deg, noise {np.degrees(noise):.2f} deg): the "
            f"translation of {held} stays open in every direction; rotate the wrist about two axes, by 20 degrees and more"
        )
    if spread[1] < least:
        axis = axes[:, 2] * np.sign(axes[np.argmax(np.abs(axes[:, 2])), 2])
        named = " ".join(f"{value:.2f}" for value in axis)
        raise CalibrationError(
            f"the flange rotates about one axis only, [{named}] in the flange ({np.degrees(spread[0]):.1f} deg RMS; across "
            f"it {np.degrees(spread[1]):.2f} deg, the noise {np.degrees(noise):.2f} deg): the translation of {held} "
            "along this axis stays open; rotate about a second axis, by 20 degrees and more"
        )


def known_where_seen(found: HandEye, Ts_rig_body: Array) -> dict[str, tuple[Array, Array]]:
    """Return what the flange carries and what stands still, by name: transform (4, 4), and covariance (6, 6) where used.

    The rig's is that of a point at the mean of the positions of the body that were seen, Ts_rig_body (N, 4, 4): the rig is
    used there alone, and errors of an arm move the lens, a metre away, by more.
    """
    held, still = ("flange-rig", "base-body") if found.eye == "in_hand" else ("flange-body", "base-rig")
    to_body = np.eye(6)
    to_body[:3, 3:] = -skew(found.scale * Ts_rig_body[:, :3, 3].mean(axis=0))
    covs = {name: found.cov[rows, rows] for name, rows in ((held, slice(6, 12)), (still, slice(0, 6)))}
    covs = {name: to_body @ cov @ to_body.T if "rig" in name else cov for name, cov in covs.items()}
    return {held: (found.T_flange_held, covs[held]), still: (found.T_base_still, covs[still])}


def require_known(found: HandEye, Ts_rig_body: Array, most_m: float, most_rad: float) -> None:
    """Reject a result one of whose directions is known worse, where the body was seen, than by these sigmas, m and rad.

    Raises:
        CalibrationError: the open direction, by name.
    """
    for name, (T, block) in known_where_seen(found, Ts_rig_body).items():
        for kind, part, most, unit, times in (
            ("translation", block[:3, :3], most_m, "mm", 1e3),
            ("rotation", block[3:, 3:], most_rad, "deg", np.degrees(1.0)),
        ):
            values, vectors = np.linalg.eigh(part)
            sigma = float(np.sqrt(max(values[-1], 0.0)))
            if sigma < most:
                continue
            axis = T[:3, :3] @ vectors[:, -1]
            named = " ".join(f"{value:.2f}" for value in axis * np.sign(axis[np.argmax(np.abs(axis))]))
            raise CalibrationError(
                f"the motions leave the {kind} of {name} open: along or about [{named}] in the {name.split('-')[0]} its "
                f"sigma is {times * sigma:.0f} {unit}; rotate the flange about two axes that are not parallel, by 20 "
                "degrees and more, and take more poses"
            )


def _taken_up(problem: _Problem, guess: _Guess, pairs: Sequence[tuple[str, ...]]) -> dict[str, float]:
    """Return the sources of an arm that is as its model says, with their most probable variances.

    Of those of ``pairs`` whose scores speak, it is each time the one that makes the residuals most probable.
    """
    linear = problem.linear(guess, [name for pair in pairs for name in pair])
    means, pairs = problem.means(linear, guess), [pair for pair in pairs if pair[0] in linear.shared]

    start: dict[str, float] = {}

    def fitted(names: tuple[str, ...]) -> tuple[dict[str, float], float]:
        part = linear.of(names)
        variances = most_probable(part, means, start, 25)
        return dict(zip(part.sources, variances.tolist(), strict=True)), posterior(part, variances, means)

    best, cost = fitted(tuple(linear.own))
    while pairs:
        start |= best
        part = linear.of(best)
        z = scores(linear, solve(part, np.array(list(best.values()))), [name for pair in pairs for name in pair])
        pairs = [pair for pair in pairs if max(z[name] for name in pair) > SPEAKS]
        tried = [(*fitted((*best, *pair)), pair) for pair in pairs]
        found = min(tried, key=lambda one: one[1], default=None)
        if found is None or found[1] > cost:
            break
        best, cost, pair = found
        pairs.remove(pair)
    return best


def _settled(
    whole: _Problem, guess: _Guess, used: NDArray[np.bool_], pairs: Sequence[tuple[str, ...]]
) -> tuple[_Guess, NDArray[np.bool_], dict[str, float], int]:
    """Alternate variances, transforms and blunders until they stay."""
    few = whole.rows(evenly(np.flatnonzero(used), MAX_VARIANCE if whole.t_s is None else MAX_WALK))
    variances = _taken_up(few, guess, pairs)
    most = MAX_WALK if any("walk" in name for name in variances) else MAX_FIT
    for _ in range(ROUNDS):
        rows = evenly(np.flatnonzero(used), most)
        few, part = whole.rows(evenly(rows, min(most, MAX_VARIANCE))), whole.rows(rows)
        estimated, linear = (p.linear(guess, variances).of(variances) for p in (few, part))
        found = most_probable(estimated, few.means(estimated, guess), variances)
        variances = dict(zip(linear.sources, found.tolist(), strict=True))
        solved = solve(linear, found)
        far = _far(whole, guess, variances, rows, linear, solved)
        # Variances come from these residuals, too: Fisher's distribution in place of chi-square.
        limit = 6 / fdtri(max(6 * int(used.sum()) - 12, 6), 6, CHANCE)
        keep = (far < limit) | (used & (far < 0.3 * far[used].max()))
        if keep.sum() < max(MIN_POSES, len(keep) // 3):
            keep = used
        x = solved.x[: linear.J.shape[2]]
        settled = bool((keep == used).all()) and float(np.abs(x[:12]).max()) < 1e-5
        guess, used = guess.moved(x, whole.free), keep
        if settled:
            break
    return guess, used, variances, most


def _sure(off: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return the errors that are surely not 0, of errors with their sigmas."""
    return {name: (x, sigma) for name, (x, sigma) in off.items() if abs(x) > SURELY * sigma}


def _models(
    whole: _Problem, guess: _Guess, used: NDArray[np.bool_], quick: bool, progress: Callable[[str], None]
) -> tuple[_Guess, NDArray[np.bool_], NDArray[np.int64], _Model, _Model, float]:
    """Settle; return that, an arm that is as its model says, one that is not, and the probability of the latter.

    Of an arm that is not, what the eye seems to have may be, too: there only what is sure is left to the eye.
    """
    eye: Collection[str] = EYE
    while True:
        progress("hand-eye: sources of the error")
        pairs = () if quick or used.sum() < MIN_SHARED else (*OVER_TIME, *((name,) for name in eye))
        guess, used, variances, most = _settled(whole, guess, used, pairs)
        rows = evenly(np.flatnonzero(used), most)
        progress("hand-eye: an arm as its model")
        nominal = _Model.of(whole, guess, rows, variances, quick)
        if quick:
            return guess, used, rows, nominal, nominal, 0.0
        progress("hand-eye: an arm that is not")
        arms = (DRIFT,) if whole.links is None else (LINKS, (*LINKS, *DRIFT))
        begins = (variances | dict.fromkeys(arm, 0.0) for arm in arms)
        other = max((_Model.of(whole, guess, rows, start, quick) for start in begins), key=lambda one: one.evidence)
        arm_off = float(expit(other.evidence - nominal.evidence + np.log(ARM_OFF / (1 - ARM_OFF))))
        eye = _sure(off := other.eye_off())
        if arm_off <= 0.5 or len(eye) == len(off):
            return guess, used, rows, nominal, other, arm_off


def _weighed(
    whole: _Problem, guess: _Guess, used: NDArray[np.bool_], quick: bool, progress: Callable[[str], None]
) -> HandEye:
    """Settle, then weigh an arm that is as its model says against one that is not."""
    guess, used, rows, nominal, other, arm_off = _models(whole, guess, used, quick, progress)
    best = other if arm_off > 0.5 and len(rows) >= MIN_SHARED else nominal
    x, cov, likelihoods = nominal.x, nominal.cov, {_said(nominal.linear.sources): nominal.density}
    if not quick:
        likelihoods[_said(other.linear.sources)] = other.density
        for said, alone in (("robot", ("flange_m", "flange_rad")), ("camera", ("lateral_m", "depth_m", "seen_rad"))):
            likelihoods[said] = _Model.of(whole, guess, rows, dict.fromkeys(alone, 0.0), True).density
        # The arm is used by its model: where its links are not known, the mounting is the one that suits the model.
        suits, suits_left = _suiting(whole, guess, nominal)
        x = arm_off * other.x + (1 - arm_off) * nominal.x if whole.links is not None else suits
        cov = arm_off * other.about(x) + (1 - arm_off) * nominal.about(x)
    moved = guess.moved(x, whole.free)
    metric, cov = whole.metric(moved, cov)
    rest = np.sqrt(np.diag(cov)[12:]).tolist()
    sigma_scale = rest.pop(0) if whole.free[0] else 0.0
    frames = {name: len(used) - 1 for name in ("walk_m", "walk_rad")}  # those of a walk are a frame's
    sigmas = {name: float(np.sqrt(v / frames.get(name, 1))) for name, v in best.variances.items()}
    arm_m, camera_m = _displacements(whole, best, guess)
    off_common = np.subtract(*(transform(p.B, p.centre) for p in (whole.poses.corrected(moved.common), whole.poses)))
    left = [_alone(one.solved, one.linear) for one in (nominal, best)]
    left[0] = left[0] if quick else suits_left
    errors = [_held_out_errors(whole, moved, e, rows) for e in (*left, left_out(best.solved)[0])]
    found = HandEye(
        eye="in_hand" if whole.poses.in_hand else "to_hand",
        T_base_still=metric.Z,
        T_flange_held=metric.X,
        cov=cov[:12, :12],
        scale=1 / moved.per_m,
        sigma_scale=sigma_scale / moved.per_m,
        step_s=moved.step_s,
        sigma_step_s=rest.pop(0) if whole.free[1] else 0.0,
        structure=_said(best.linear.sources),
        sigmas=sigmas,
        likelihoods=likelihoods,
        arm_off=arm_off,
        arm_m=arm_m,
        camera_m=camera_m,
        held_out=errors[0 if whole.links is None else 1],
        held_out_nominal=errors[0],
        held_out_geometry=None if best is nominal else errors[2],
        used=used,
        distance=_far(whole, guess, nominal.variances, rows, nominal.linear, nominal.solved) / 6,
        common=moved.common,
        common_m=float(np.sqrt((off_common**2).sum(axis=-1).mean())) / moved.per_m if moved.common.size else 0.0,
        leverage=np.ones(len(whole.poses.A)),
        eye_off=best.eye_off(),
    )
    require_known(found, whole.poses.B, OPEN_M, OPEN_RAD)
    return replace(found, leverage=_leverage(found, whole.poses))


def _leverage(found: HandEye, poses: Poses) -> Array:
    """Return by which factor the sigma of some direction grows without each pose (N,): of the hat matrix (Belsley 1980)."""
    J = found.whitened(poses)[1] * found.used[:, None, None]
    share = np.linalg.eigvalsh(J @ np.linalg.pinv(np.einsum("nij,nik->jk", J, J)) @ np.swapaxes(J, 1, 2))[:, -1]
    return np.asarray(1 / np.sqrt(np.maximum(1 - share, UNDETERMINED**-2 / 4)))


@dataclass(frozen=True, eq=False)
class _Model(Record):
    """One choice of sources: residuals, most probable variances, the step (P,), its covariance, the log evidence."""

    linear: Linear
    variances: dict[str, float]
    solved: Solved
    x: Array
    cov: Array
    evidence: float

    @staticmethod
    def of(whole: _Problem, guess: _Guess, rows: NDArray[np.int64], start: dict[str, float], quick: bool) -> _Model:
        """Weigh the sources of ``start``, at these variances first where they are not 0; ``quick``: without integrating."""
        few, part = whole.rows(evenly(rows, MAX_VARIANCE)), whole.rows(rows)
        estimated, linear = (p.linear(guess, start).of(start) for p in (few, part))
        means = few.means(estimated, guess)
        probable = most_probable(estimated, means, {name: v for name, v in start.items() if v > 0})
        solved, P = solve(linear, probable), linear.J.shape[2]
        variances = dict(zip(linear.sources, probable.tolist(), strict=True))
        if quick:
            return _Model(linear, variances, solved, solved.x[:P], solved.root[:P] @ solved.root[:P].T, 0.0)
        more = linear if len(rows) > MAX_VARIANCE else None
        return _Model(linear, variances, solved, *integrate(estimated, probable, means, more))

    @property
    def density(self) -> float:
        """Mean logarithm of the probability density of a pose left out."""
        return float(log_density(*left_out(self.solved)).mean())

    def eye_off(self) -> dict[str, tuple[float, float]]:
        """Return the error of each source that is one number of the eye, and its sigma."""
        s, sources = self.solved, self.linear.sources
        at = {name: int(np.flatnonzero(s.of == sources.index(name))[0]) for name in EYE if name in sources}
        return {name: (float(s.x[k]), float(np.linalg.norm(s.root[k]))) for name, k in at.items()}

    def about(self, x: Array) -> Array:
        """Return the mean square (P, P) of the error of another step (P,)."""
        return np.asarray(self.cov + np.outer(self.x - x, self.x - x))


def _alone(s: Solved, linear: Linear) -> Array:
    """Return residuals (N, 6) of poses left out, without the shared errors that the others show."""
    P = linear.J.shape[2]
    AR = s.A @ s.root
    kept = np.linalg.inv(s.W) - AR @ np.swapaxes(AR, 1, 2) + 1e-18 * np.eye(6)
    away = (np.swapaxes(AR, 1, 2) @ np.linalg.solve(kept, s.left[..., None]))[..., 0]
    x = s.x[:P] + away @ s.root[:P].T
    return np.asarray(linear.e + np.einsum("nip,np->ni", linear.J, x))


def _suiting(whole: _Problem, guess: _Guess, nominal: _Model) -> tuple[Array, Array]:
    """Return the step (P,) to the mounting that suits the arm's model best, and its residuals (N, 6) of poses left out.

    Where rotations and positions contradict each other by more than either scatters, that is the one of positions alone.
    """
    linear, own = nominal.linear, nominal.linear.own
    middle = {"seen_m": np.concatenate([own["lateral_m"], own["depth_m"]], axis=2)}
    hardly = HARDLY**2 * own["seen_rad"] @ np.swapaxes(own["seen_rad"], 1, 2)
    positions = replace(linear, given=hardly, own=middle, shared={})
    s = solve(positions, most_probable(positions, {"seen_m": _middle_sigmas(linear.e)[0]}))
    found = [_alone(nominal.solved, linear), _alone(s, positions)]
    of, alone = (np.sum((e[:, :3] - np.cross(whole.poses.centre, e[:, 3:])) ** 2, axis=1) for e in found)
    lower = of - alone
    sure = lower.mean() > SURELY_LOWER * lower.std() / np.sqrt(len(lower)) and of.mean() > CLEARLY**2 * alone.mean()
    return (s.x, found[1]) if sure else (nominal.x, found[0])


def _said(names: tuple[str, ...]) -> str:
    """Return sources as people read them."""
    found = [SAID.get(name, SAID.get(name.rpartition("_")[0])) for name in names]
    return ", ".join(dict.fromkeys(name for name in found if name)) or "robot and camera"


def _far(
    whole: _Problem, guess: _Guess, variances: dict[str, float], rows: NDArray[np.int64], linear: Linear, solved: Solved
) -> Array:
    """Return the squared Mahalanobis length (N,) of each pose's residual: of those fitted, as predicted by all others."""
    everything = whole.linear(guess)
    C = covariances(everything, np.array([variances[name] for name in everything.sources]))
    for name, M in (linear.shared or {}).items():  # as far as the worst pose is moved by what all share
        C = C + variances[name] * np.einsum("nik,njk->nij", M, M).max(axis=0)
    P = everything.J.shape[2]
    C = C + (known := everything.J @ solved.root[:P]) @ np.swapaxes(known, 1, 2)
    moved = everything.e + everything.J @ solved.x[:P]
    far = squares_of(moved, C)
    far[rows] = squares_of(*left_out(solved))
    return far


def _held_out_errors(whole: _Problem, guess: _Guess, residual: Array, rows: NDArray[np.int64]) -> HeldOut:
    """Return the distances of the body's middle and the angles, of the rows that were left out in turn."""
    n = len(whole.poses.A)
    position, angle = np.full(n, np.nan), np.full(n, np.nan)
    moved = (residual[:, :3] - np.cross(whole.poses.centre, residual[:, 3:])) / guess.per_m
    position[rows], angle[rows] = np.linalg.norm(moved, axis=1), np.linalg.norm(residual[:, 3:], axis=1)
    return HeldOut(position, angle)


def _displacements(whole: _Problem, model: _Model, guess: _Guess) -> tuple[float, float]:
    """Return the RMS distances by which the arm's and vision's errors move the body's middle, m."""
    middle = np.concatenate([np.eye(3), -skew(whole.poses.centre)], axis=1) / guess.per_m
    linear = model.linear
    arm, camera = 0.0, float(np.einsum("ai,nij,aj->n", middle, linear.given, middle).mean())
    for name, variance in model.variances.items():
        M = middle @ (linear.own | linear.shared)[name]
        M = M - M.mean(axis=0) if name in linear.shared else M  # what is the same in all poses is in the mounting
        size = float(variance * np.einsum("nij,nij->n", M, M).mean())
        arm, camera = (arm + size, camera) if name in OF_THE_ARM else (arm, camera + size)
    return float(np.sqrt(arm)), float(np.sqrt(camera))
