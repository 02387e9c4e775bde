"""Hand-eye calibration whose noise has a structure: whose error it is, and whether neighbouring poses share it.

In: :class:`~armsight.loop.handeye.poses.Poses`, and where there are streams their times and speeds. Out:
:class:`HandEye`: both transforms with a covariance that allows for the structure, the sources of the error, and
the error of poses left out. In order:

1. A robust start: closed forms from all poses and from small parts (:func:`~armsight.loop.handeye.poses.starts`), then
   least squares with the weights of Student's t; what is further than chance allows is left out as a blunder.
2. Motions that leave a direction open are rejected (:func:`require_rotations`, :func:`require_known`).
3. For every structure of noise the variances of the greatest restricted likelihood; poses left out decide between the
   structures (:mod:`armsight.loop.handeye.noise`).

The rows are put into an order of their own first (by time, else by content), so that theirs changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri
from scipy.stats import f as f_distribution

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, mean_pose, transform
from armsight.geometry.rotation import skew
from armsight.loop.handeye.noise import (
    OF_THE_ARM,
    SHARED,
    SHARED_MAPS,
    STRUCTURES,
    Linear,
    blocks,
    error_maps,
    freedom,
    held_out,
    jackknife,
    left_out_squares,
    own_squares,
    pose_kernel,
    reml,
    solve,
    time_kernel,
    walk_gathered,
    wiener_kernel,
)
from armsight.loop.handeye.poses import (
    CHANCE,
    CLEARLY,
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

#: Poses that a fit comes from at most, evenly spread. The structure is chosen from as many: what is claimed of many poses
#: must have been looked for in as many.
MAX_FIT = 1000
#: With a shared error, poses that variances and held-out likelihoods come from at most, and the transforms.
MAX_SHARED, MAX_SHARED_FIT = 40, 120
#: Fewest poses for a structure with shared errors.
MIN_SHARED = 12
#: Numbers left of the residuals for each variance at least: fewer do not determine it.
PER_VARIANCE = 8
#: Parts that are left out, one after the other; of so few poses each one by itself.
FOLDS, FEW = 5, 24
#: Rotation about a second axis must exceed the noise of rotations by this factor, and this angle, rad.
CLEARLY_ROTATED, LEAST_ROTATION = 3.0, np.radians(0.5)
#: Rotations of half of the poses that differ by more than this, rad, are not of one motion.
CONTRADICTS = np.radians(10.0)
#: A sigma of a transform beyond this (m, rad) is no answer; beyond that, it is none to close a loop with: as much at a
#: reach of half a metre. half: mountings from few small rotations are rejected, double: a tool 40 mm off may be driven.
OPEN_M, OPEN_RAD = 0.5, 0.5
TRUSTED_M, TRUSTED_RAD = 0.02, 0.04
#: What a further pose is uncertain by at least, m and rad: where hardly anything scattered, one would determine all.
LEAST_M, LEAST_RAD = 1e-5, 1e-5
#: Degrees of freedom of Student's t in the robust start.
FREEDOM = 4.0
#: A scale must be off by this many sigmas to be taken, and has settled where a step is below this share of one: where the
#: flange hardly moves it runs away.
SURELY, SETTLED = 5.0, 0.1
#: Neighbours' residuals hang together where Moran's statistic, in sigmas of chance, is above this.
HANGING = 1.0
#: The structure that weights positions alone, and by how many sigmas its squared errors must be lower.
POSITIONS, SURELY_LOWER = "positions alone", 3.0
#: The structures whose links are off, whose transforms go with the true arm; that of an arm whose error is a smooth
#: function of the pose, whose transforms are the mounting that suits its model; and all of an arm that is not as its model.
GEOMETRY = ("robot's geometry off", "robot's geometry and time stamps off")
SMOOTH = "robot drifting over its poses"
NOT_AS_MODELLED = (*GEOMETRY, SMOOTH)
#: Those whose scale walks.
SCALE_WALKING = ("camera's scale walking", "camera and its scale walking")
#: Draws by which structures are weighted, and the weight below which one is not true.
DRAWS, HARDLY_TRUE = 400, 0.02
#: Rounds of least squares and of leaving out.
ROUNDS = 6


@dataclass(frozen=True, eq=False)
class HandEye(Record):
    """A hand-eye calibration.

    Attributes:
        eye: "to_hand": the rig stands still and the flange carries the body; "in_hand": the other way round.
        T_base_still: (4, 4) what stands still, in the base: the rig, or in_hand the body.
        T_flange_held: (4, 4) what the flange carries: the body, or in_hand the rig.
        cov: (12, 12) covariance of the right tangents of T_base_still and T_flange_held, m and rad.
        scale: true lengths over those of the measured body; 1 where it was taken as given.
        sigma_scale: its sigma; zero where it was not fitted.
        step_s: what is left of the time offset, s, to be added to the eye's times; sigma_step_s its sigma; zero without.
        structure: of the noise, one of ``STRUCTURES``.
        sigmas: source -> sigma of one axis, m, rad, s, or a factor.
        likelihoods: structure -> mean logarithm of the probability density of a pose left out.
        arm_m: what the arm's error moves the body's middle by, RMS of the distance, m.
        camera_m: what vision's error does, m.
        held_out: the error on poses left out of the fit, of transforms found as these were, the arm as its model is. Where
            the structure says that the arm's geometry is off (``GEOMETRY``) they go with the true arm, not with the model.
        held_out_nominal: the same with the mounting that suits the arm's nominal model; another only with ``GEOMETRY``.
        held_out_geometry: the same as held_out where the arm's error, as the other poses show it, is taken into account:
            its geometry with ``links``, else, where the structure has it, its smooth error over its poses; None where
            there is neither, or from too few poses.
        used: (N,) whether a pose was used, and not taken for a blunder.
        distance: (N,) Mahalanobis distance of each pose's residual, in units of its expectation.
        common: (K,) the errors that all poses share (``Poses.common``), as found, in sigmas.
        common_m: what they move the body's middle by, RMS of the distance, m.
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
    arm_m: float
    camera_m: float
    held_out: HeldOut
    held_out_nominal: HeldOut
    held_out_geometry: HeldOut | None
    used: NDArray[np.bool_]
    distance: Array
    common: Array
    common_m: float

    @property
    def T_base_rig(self) -> Array:
        """(4, 4) the rig in the base; eye to hand only."""
        return self._of("to_hand", "T_base_rig", self.T_base_still)

    @property
    def T_flange_body(self) -> Array:
        """(4, 4) the body on the flange; eye to hand only."""
        return self._of("to_hand", "T_flange_body", self.T_flange_held)

    @property
    def T_flange_rig(self) -> Array:
        """(4, 4) the rig on the flange; eye in hand only."""
        return self._of("in_hand", "T_flange_rig", self.T_flange_held)

    @property
    def T_base_body(self) -> Array:
        """(4, 4) the body in the base; eye in hand only."""
        return self._of("in_hand", "T_base_body", self.T_base_still)

    def _of(self, eye: Eye, name: str, T: Array) -> Array:
        if self.eye != eye:
            raise InputError(f"{name} is not constant with the eye {self.eye!r}; it belongs to {eye!r}")
        return T

    @property
    def sigma_flange(self) -> tuple[float, float]:
        """Error of the flange by the joints from pose to pose: sigmas along one axis, m, and about one, rad."""
        return self.sigmas.get("flange_m", 0.0), self.sigmas.get("flange_rad", 0.0)

    def informations(self, poses: Poses) -> Array:
        """Return the information (N, 12, 12) about the right tangents that each of further poses would give."""
        e, J, carry = residuals(poses, self.T_base_still, self.T_flange_held)
        maps, C = error_maps(poses, 0 * e, carry, None), poses.cov + np.diag(np.repeat([LEAST_M**2, LEAST_RAD**2], 3))
        for name in STRUCTURES[self.structure]:
            if (of := SHARED_MAPS.get(name, name)) in maps:
                C = C + self.sigmas[name] ** 2 * maps[of] @ np.swapaxes(maps[of], 1, 2)
        return np.asarray(np.swapaxes(J, 1, 2) @ np.linalg.solve(C, J))

    def predict(self, Ts_base_flange: Array) -> Array:
        """Return T_rig_body (..., 4, 4) at poses of the flange (..., 4, 4)."""
        if self.eye == "in_hand":
            return np.asarray(inverse(Ts_base_flange @ self.T_flange_held) @ self.T_base_still)
        return np.asarray(inverse(self.T_base_still) @ Ts_base_flange @ self.T_flange_held)


@dataclass(frozen=True, eq=False)
class _Guess(Record):
    """Transforms, scale, what is left of the time offset, and errors that vision shares between poses, in sigmas.

    Lengths are in the unit of the measured body, in which a scale that is fitted is not drawn to small values by the
    body's noise: ``per_m`` of them make one metre.
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

    def linear(self, guess: _Guess) -> Linear:
        """Return the residuals at a guess, with what noise does to them; no shared sources.

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
        before, shared = J.shape[2], guess.common.size
        if shared and poses.common is not None:
            J = np.concatenate([J, poses.common if poses.in_hand else -poses.common], axis=2)
        known, at = np.repeat([0.0, 1.0], [before, shared]), np.append(np.zeros(before), guess.common)
        return Linear(e, J, poses.cov, error_maps(poses, e, carry, self.speed, self.links), {}, {}, known, at)

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

    def shared(self, linear: Linear, guess: _Guess, gathered: dict[str, Array]) -> Linear:
        """Add the correlations of shared sources to residuals of the same rows."""
        kernel = {SMOOTH: pose_kernel(self.poses.A)}
        if self.t_s is not None:
            kernel["robot drifting over time"] = time_kernel(self.t_s)
            walked = wiener_kernel(self.t_s)
            kernel |= {"robot walking over time": walked, **dict.fromkeys(SCALE_WALKING, walked)}
        return replace(linear, kernel=kernel, walk=gathered)


def calibrate_handeye(
    Ts_base_flange: ArrayLike,
    Ts_rig_body: ArrayLike,
    covs: ArrayLike | None = None,
    *,
    eye: Eye = "to_hand",
    centre: ArrayLike | None = None,
    structures: Sequence[str] = tuple(STRUCTURES),
    progress: Callable[[str], None] = lambda line: None,
) -> HandEye:
    """Calibrate the two constant transforms of rig, body and arm.

    Args:
        Ts_base_flange: (N, 4, 4) the flange in the base, from the joints, m; it must rotate about two axes at least.
        Ts_rig_body: (N, 4, 4) the body in the rig at the same instants, m (``PoseEstimate.T_left_body``).
        covs: (N, 6, 6) covariance of the latter, right tangent (``PoseEstimate.cov``); None: not known.
        eye: "to_hand" where the rig stands still and the arm carries the body, "in_hand" where the arm carries the rig.
        centre: (3,) the middle of the body's points, body frame, m: errors of vision rotate the body about it.
            None: the body's origin.
        structures: of the noise, names to choose from; fewer take less time.
        progress: called with the name of each step as it begins.

    Raises:
        InputError: wrong shapes, NaN, no rigid motions, fewer than 4 poses.
        CalibrationError: the motions leave a direction open.
    """
    poses = checked_poses(Ts_base_flange, Ts_rig_body, covs, eye, np.zeros(3) if centre is None else centre)
    return calibrate_structured(poses, structures=structures, progress=progress)


def calibrate_structured(
    poses: Poses,
    *,
    t_s: Array | None = None,
    speed: Array | None = None,
    links: Array | None = None,
    scale: bool = False,
    structures: Sequence[str] = tuple(STRUCTURES),
    progress: Callable[[str], None] = lambda line: None,
) -> HandEye:
    """Calibrate hand and eye, with the structure of the noise that poses left out support best.

    Args:
        poses: four or more.
        t_s: (N,) times of the poses, s, where they are known: what drifts over time, or walks, needs them.
        speed: (N, 6) twist of the flange, right tangent, m/s and rad/s, of streams: the rest of the time offset is fitted.
        links: (N, L, 4, 4) T_link_flange of every link, m, where the joints and a model are known.
        scale: whether the size of the target may be wrong (one camera that moves has none): fitted, and kept where it is
            surely not 1.
        structures: names to choose from.
        progress: called with the name of each step as it begins.

    Raises:
        InputError: fewer than four poses.
        CalibrationError: the motions leave a direction open.
    """
    n = len(poses.A)
    if n < MIN_POSES:
        raise InputError(f"hand-eye calibration needs {MIN_POSES} or more poses, got {n}; 15 and more are advised")
    order = _own_order(poses, t_s)
    whole = _Problem(poses, t_s, speed, (False, speed is not None), links).rows(order)
    progress("hand-eye: start")
    if scale:
        whole, guess, used = _with_scale(whole)
    else:
        guess, used = _robust(whole, _first(whole))
    require_rotations(whole.poses.rows(used), whole.linear(guess).e[used])
    if poses.common is not None:
        guess = replace(guess, common=np.zeros(poses.common.shape[2]))
    found, used = _chosen(whole, guess, used, structures, progress)
    used_rows, distance = np.zeros(n, bool), np.full(n, np.nan)
    used_rows[order], distance[order] = used, found.distance
    geometry = None if found.held_out_geometry is None else _unsorted(found.held_out_geometry, order)
    return replace(
        found,
        used=used_rows,
        distance=distance,
        held_out=_unsorted(found.held_out, order),
        held_out_nominal=_unsorted(found.held_out_nominal, order),
        held_out_geometry=geometry,
    )


def _unsorted(of: HeldOut, order: NDArray[np.int64]) -> HeldOut:
    """Return the errors of poses in their own order in that in which they were given."""
    back = np.argsort(order)
    return HeldOut(of.position_m[back], of.angle_rad[back])


def _own_order(poses: Poses, t_s: Array | None) -> NDArray[np.int64]:
    """Return an order of the rows that does not depend on theirs: by time, else by what they hold."""
    keys = np.concatenate([poses.B[:, :3].reshape(len(poses.B), -1), poses.A[:, :3].reshape(len(poses.A), -1)], axis=1)
    if t_s is not None:
        keys = np.concatenate([keys, t_s[:, None]], axis=1)
    return np.asarray(np.lexsort(keys.T))


def _spread(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return at most this many of the rows, evenly spread."""
    if len(rows) <= most:
        return rows
    return np.asarray(rows[np.linspace(0, len(rows) - 1, most).round().astype(int)])


def _first(problem: _Problem) -> list[_Guess]:
    """Return closed-form starts, most plausible first."""
    part = problem.rows(_spread(np.arange(len(problem.poses.A)), 300)).poses
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
    rows = _spread(np.arange(len(problem.poses.A)), MAX_FIT)
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
    known, used_known = _robust(problem, _first(problem))
    free = replace(problem, free=(True, problem.free[1]))
    per_m = 1 / scale_between(problem.poses)
    scaled = replace(problem, poses=problem.scaled(_Guess(np.eye(4), np.eye(4), per_m)))
    guesses = [replace(guess, per_m=per_m) for guess in _first(scaled)]
    found, used = _robust(free, guesses)
    rows = _spread(np.flatnonzero(used), MAX_FIT)
    at, sure = found, False
    for _ in range(ROUNDS):
        linear = free.rows(rows).linear(at)
        b = blocks(linear, "robot and camera")
        solved = solve(b, reml(b, _start_variances(linear, "robot and camera")))
        at, sigma = at.moved(solved.x, free.free), np.sqrt(solved.cov[12, 12])
        sure = abs(np.log(at.per_m)) > SURELY * sigma and abs(solved.x[12]) < sigma
        if abs(solved.x[12]) < SETTLED * sigma:
            break
    (before_m, before_rad), (after_m, after_rad) = (
        _middle_sigmas(p.rows(rows).linear(g).e) for p, g in ((problem, known), (free, found))
    )
    gained = 3 * float(np.log(before_m / after_m * before_rad / after_rad))  # log density of a pose
    if ((sure and gained > -1) or gained > 1) and 1e-4 < found.per_m < 1e4:  # sure, but far worse: of blunders
        return free, found, used
    return problem, known, used_known


def scale_between(poses: Poses) -> float:
    """Return true lengths over those of the measured body, by closed forms from small parts of the poses.

    Of the parts' answers it is that whose best residuals, of the share MIDDLE, are smallest.
    """
    p = poses.rows(_spread(np.arange(len(poses.A)), 300))
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
    """Return how far the flange rotates, and how far it must for both transforms to be determined.

    Args:
        poses: the poses used.
        e: (N, 6) their residuals, which say how large the noise of rotations is.

    Returns:
        Root mean squares (3,) of the rotations about each principal axis, rad, largest first; these axes (3, 3), columns,
        smallest first, in the flange; the noise of rotations about one axis, rad; the least that the second must be, rad.
    """
    rotated = log_se3(inverse(mean_pose(poses.A)) @ poses.A)[:, 3:]
    values, axes = np.linalg.eigh(rotated.T @ rotated / len(rotated))
    noise = _middle_sigmas(e)[1]
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes, noise, max(CLEARLY_ROTATED * noise, LEAST_ROTATION)


def require_rotations(poses: Poses, e: Array) -> None:
    """Reject motions whose rotations are about one axis only, as far as the noise shows.

    Args:
        poses: the poses used.
        e: (N, 6) their residuals, which say how large the noise of rotations is.

    Raises:
        CalibrationError: the open direction, by name.
    """
    spread, axes, noise, least = rotations_of(poses, e)
    held = _held(poses)
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


def require_known(found: HandEye, most_m: float, most_rad: float) -> None:
    """Reject a result one of whose directions is known so badly that it is no calibration.

    Args:
        found: the result.
        most_m: largest sigma of a translation, m.
        most_rad: largest sigma of a rotation, rad.

    Raises:
        CalibrationError: the open direction, by name.
    """
    held, still = ("flange-rig", "base-body") if found.eye == "in_hand" else ("flange-body", "base-rig")
    for name, T, block in (
        (held, found.T_flange_held, found.cov[6:, 6:]),
        (still, found.T_base_still, found.cov[:6, :6]),
    ):
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


def _held(poses: Poses) -> str:
    return "flange-rig" if poses.in_hand else "flange-body"


def _start_variances(linear: Linear, structure: str) -> Array:
    """Return variances to begin at: what the residuals are, shared evenly between the sources."""
    position, rotation = _middle_sigmas(linear.e)
    sources = STRUCTURES[structure]
    small = {"time_s": 1e-6, "image": 1.0, "scale_walk": 1e-4}
    small |= {"walk_m": 0.01 * position**2, "walk_rad": 0.01 * rotation**2}
    even = {name: (position if name.endswith("_m") else rotation) ** 2 / 2 for name in sources}
    return np.asarray(np.maximum([small.get(name, even[name]) for name in sources], 1e-13))


def _allowed(structure: str, problem: _Problem, count: int, covered: bool) -> bool:
    """Return whether a structure can be determined from these poses."""
    sources = STRUCTURES[structure]
    if len(sources) > 2 and len(sources) > (6 * count - 12) / PER_VARIANCE:
        return False
    if "image" in sources:
        return covered
    if "link_m" in sources:
        timed = "time_s" not in sources or problem.speed is not None
        return problem.links is not None and count >= MIN_SHARED and timed
    if "time_s" in sources:
        return problem.speed is not None
    if structure in SHARED and structure != SMOOTH:
        walks = "walk_m" not in sources or problem.poses.in_hand
        scaled = "scale_walk" not in sources or problem.free[0]
        return problem.t_s is not None and count >= MIN_SHARED and walks and scaled
    return structure not in SHARED or count >= MIN_SHARED


def _chosen(
    whole: _Problem,
    guess: _Guess,
    used: NDArray[np.bool_],
    structures: Sequence[str],
    progress: Callable[[str], None],
) -> tuple[HandEye, NDArray[np.bool_]]:
    """Try the structures, leave out blunders by the covariance of the best, and fit with it."""
    covered = bool((np.abs(whole.poses.cov).reshape(len(used), -1).max(axis=1) > 0).all())
    names = [name for name in structures if _allowed(name, whole, int(used.sum()), covered)]
    if not names:
        raise InputError(f"none of the structures {', '.join(structures)} can be determined from these poses")
    gathered = walk_gathered(whole.scaled(guess)) if whole.t_s is not None and whole.poses.in_hand else {}
    simple = "robot and camera" if "robot and camera" in names else names[0]
    guess, used, variances = _settled(whole, guess, used, simple, gathered)
    hanging = _hanging(whole, guess, used, simple, variances, gathered)
    trials = {}
    for name in names:
        if name in SHARED and name not in hanging:
            continue
        progress(f"hand-eye: poses left out ({name})")
        trials[name] = _trial(whole, guess, used, name, gathered)
    best, geometries = _best(whole, trials), [trials[name] for name in GEOMETRY if name in trials]
    if best == SMOOTH:
        geometries.append(trials[best])
    geometry = max(geometries, key=lambda trial: float(trial.density.mean()), default=None)
    as_modelled = {name: trial for name, trial in trials.items() if name not in NOT_AS_MODELLED}
    nominal = trials[best] if best not in NOT_AS_MODELLED or not as_modelled else trials[_best(whole, as_modelled)]
    given = nominal if best == SMOOTH else trials[best]
    progress(f"hand-eye: fitting ({best})")
    guess, used, variances = _settled(whole, guess, used, best, gathered)
    rows = _spread(np.flatnonzero(used), MAX_SHARED_FIT if best in SHARED else MAX_FIT)
    linear = _linear(whole, guess, rows, best, gathered)
    x, cov = _student(whole, guess, used, best, variances, gathered)
    weights = _weights(trials, best)
    mixed = weights[best] * cov
    for name in weights.keys() - {best}:  # what the other structures that may be true as well would answer
        other, spread = _student(whole, guess, used, name, trials[name].variances, gathered)
        mixed = mixed + weights[name] * (spread + np.outer(other - x, other - x))
    cov = mixed
    if (
        best == SMOOTH and as_modelled
    ):  # the arm is used by its model: how far its mounting is from the true one is in cov
        name = _best(whole, as_modelled)
        suits, _ = _student(whole, guess, used, name, trials[name].variances, gathered)
        cov, x = cov + np.outer(suits - x, suits - x), suits
    guess = guess.moved(x, whole.free)
    metric, cov = whole.metric(guess, cov)
    sigmas = {name: float(np.sqrt(v)) for name, v in zip(STRUCTURES[best], variances, strict=True)}
    arm, camera = _displacements(whole, linear, best, variances, guess)
    rest = np.sqrt(np.diag(cov)[12:]).tolist()
    sigma_scale = rest.pop(0) if whole.free[0] else 0.0
    distance = _distances(whole, guess, best, variances, gathered)
    found = HandEye(
        eye="in_hand" if whole.poses.in_hand else "to_hand",
        T_base_still=metric.Z,
        T_flange_held=metric.X,
        cov=cov[:12, :12],
        scale=1 / guess.per_m,
        sigma_scale=sigma_scale / guess.per_m,
        step_s=guess.step_s,
        sigma_step_s=rest.pop(0) if whole.free[1] else 0.0,
        structure=best,
        sigmas=sigmas,
        likelihoods={name: float(trial.density.mean()) for name, trial in trials.items()},
        arm_m=arm,
        camera_m=camera,
        held_out=_held_out_errors(whole, guess, given.residual, given.rows),
        held_out_nominal=_held_out_errors(whole, guess, nominal.residual, nominal.rows),
        held_out_geometry=None if geometry is None else _held_out_errors(whole, guess, geometry.left, geometry.rows),
        used=used,
        distance=distance,
        common=guess.common,
        common_m=_common_m(whole.poses, guess),
    )
    require_known(found, OPEN_M, OPEN_RAD)
    return found, used


def _common_m(poses: Poses, guess: _Guess) -> float:
    """Return the RMS distance by which vision's shared errors move the body's middle, m."""
    off = transform(poses.corrected(guess.common).B, poses.centre) - transform(poses.B, poses.centre)
    return float(np.sqrt((off**2).sum(axis=-1).mean())) / guess.per_m if guess.common.size else 0.0


@dataclass(frozen=True, eq=False)
class _Trial(Record):
    """A structure on poses left out.

    Attributes:
        density: (N,) logarithm of the probability density of each pose left out.
        residual: (N, 6) their residuals under transforms fitted without them.
        left: (N, 6) what is left of them with shared errors predicted.
        rows: (N,) which rows they are.
        variances: (K,) of the sources, from all of them.
    """

    density: Array
    residual: Array
    left: Array
    rows: NDArray[np.int64]
    variances: Array


def _weights(trials: dict[str, _Trial], best: str) -> dict[str, float]:
    """Return how probable the structures are that poses left out do not exclude, the best among them.

    By the densities of poses left out, smoothed by what their sum is uncertain (pseudo-BMA+; Yao et al., Bayesian Analysis
    13, 2018). Positions alone are chosen by another rule, and have none.
    """
    if best == POSITIONS:
        return {best: 1.0}
    names = [best, *(name for name in trials if name not in (best, POSITIONS))]
    of = trials[best]
    sums, sigmas = np.zeros(len(names)), np.zeros(len(names))
    for k, name in enumerate(names[1:], 1):
        other = trials[name]
        n = min(len(of.rows), len(other.rows))
        sums[k] = n * (other.density.mean() - of.density.mean())
        if np.array_equal(of.rows, other.rows):
            sigmas[k] = np.sqrt(n) * float((other.density - of.density).std())
    drawn = sums + sigmas * np.random.default_rng(0).standard_normal((DRAWS, len(names)))
    odds = np.exp(drawn - drawn.max(axis=1, keepdims=True))
    shares = (odds / odds.sum(axis=1, keepdims=True)).mean(axis=0)
    kept = {
        name: float(share) for name, share in zip(names, shares, strict=True) if name == best or share > HARDLY_TRUE
    }
    return {name: share / sum(kept.values()) for name, share in kept.items()}


def _student(
    whole: _Problem,
    guess: _Guess,
    used: NDArray[np.bool_],
    structure: str,
    variances: Array,
    gathered: dict[str, Array],
) -> tuple[Array, Array]:
    """Return the step (P,) from a guess to the least squares of a structure, and its covariance (P, P).

    Where leaving out poses shows a larger one than the structure does, mean of a block of three, it is that. Residuals say
    little about some variances: it is Student's ellipsoid in place of the normal one (Hotelling).
    """
    rows = _spread(np.flatnonzero(used), MAX_SHARED_FIT if structure in SHARED else MAX_FIT)
    few = _spread(rows, MAX_SHARED if structure in SHARED else MAX_FIT)
    linear = _linear(whole, guess, rows, structure, gathered)
    b, own = blocks(linear, structure), linear.J.shape[2]
    solved = solve(b, variances)
    cov = solved.cov[:own, :own]
    if structure not in SHARED:
        shown, grow = jackknife(b, solved)[:own, :own], np.ones(own)
        for part in (slice(k, k + 3) for k in range(0, 12, 3)):
            grow[part] = np.sqrt(max(float(np.trace(np.linalg.solve(cov[part, part], shown[part, part]))) / 3, 1.0))
        cov = cov * np.outer(grow, grow)
    estimated = blocks(_linear(whole, guess, few, structure, gathered), structure)
    known = freedom(estimated, variances, lambda v: solve(b, v).cov, 12)
    known = min(known, max(6 * len(rows) // 2 - 9, 3))  # of positions, whose fit also rotates the frames
    return solved.x[:own], cov * float(6 * f_distribution.ppf(0.95, 6, known) / chdtri(6, 0.05))


def _best(whole: _Problem, trials: dict[str, _Trial]) -> str:
    """Return the structure that poses left out are most probable under.

    Positions alone never win so: they do where they predict positions left out better, clearly and surely.
    """
    others = {name: trial for name, trial in trials.items() if name != POSITIONS} or trials
    best = max(others, key=lambda name: others[name].density.mean())
    if POSITIONS not in trials or best in (*SHARED, *GEOMETRY, POSITIONS):
        return best
    of, alone = (
        np.sum((e[:, :3] - np.cross(whole.poses.centre, e[:, 3:])) ** 2, axis=1)
        for e in (trials[best].residual, trials[POSITIONS].residual)
    )
    lower = of - alone
    sure = lower.mean() > SURELY_LOWER * lower.std() / np.sqrt(len(lower))
    return POSITIONS if sure and of.mean() > CLEARLY**2 * alone.mean() else best


def _hanging(
    whole: _Problem,
    guess: _Guess,
    used: NDArray[np.bool_],
    structure: str,
    variances: Array,
    gathered: dict[str, Array],
) -> set[str]:
    """Return the structures with shared errors that the residuals of neighbours speak for.

    Moran's test of the residuals of a regression, which have lost what the unknowns fit (Cliff and Ord, "Spatial
    Processes", 1981, chapter 8): a kernel that is wide beside the poses' spread is mostly lost so.
    """
    rows = _spread(np.flatnonzero(used), MAX_SHARED_FIT)
    if structure in SHARED or len(rows) < MIN_SHARED:
        return set(SHARED)
    part = whole.rows(rows)
    linear = part.shared(part.linear(guess), guess, {})
    n, C = len(rows), blocks(linear, structure).covariance(variances)
    L = np.linalg.cholesky(C)
    white = np.linalg.solve(L, linear.e[..., None]).reshape(-1)
    fitted, _ = np.linalg.qr(np.linalg.solve(L, linear.J).reshape(6 * n, -1))
    white = white - fitted @ (fitted.T @ white)
    kernels, index = dict(linear.kernel), np.arange(n)
    beside = np.asarray(np.abs(index[:, None] - index[None]) == 1, dtype=float)
    if gathered:
        kernels["camera walking"] = beside
    kernels |= dict.fromkeys(kernels.keys() & {"robot walking over time", *SCALE_WALKING}, beside)
    found = set()
    for name, K in kernels.items():
        W = np.kron(K - np.diag(np.diag(K)), np.eye(6))
        W = W - fitted @ (fitted.T @ W)
        W = W - (W @ fitted) @ fitted.T
        moran = float(white @ W @ white - np.trace(W)) / np.sqrt(2 * float((W**2).sum()))
        if moran > HANGING:
            found.add(name)
    return found


def _linear(
    whole: _Problem, guess: _Guess, rows: NDArray[np.int64], structure: str, gathered: dict[str, Array]
) -> Linear:
    """Return the residuals of rows, with what the structure needs."""
    part = whole.rows(rows)
    linear = part.linear(guess)
    if structure not in SHARED:
        return linear
    return part.shared(linear, guess, {name: W[rows] for name, W in gathered.items()})


def _settled(
    whole: _Problem, guess: _Guess, used: NDArray[np.bool_], structure: str, gathered: dict[str, Array]
) -> tuple[_Guess, NDArray[np.bool_], Array]:
    """Alternate variances, transforms and blunders until they stay."""
    variances: Array | None = None
    for _ in range(ROUNDS):
        few = _spread(np.flatnonzero(used), MAX_SHARED if structure in SHARED else MAX_FIT)
        linear = _linear(whole, guess, few, structure, gathered)
        if variances is None:
            variances = reml(blocks(linear, structure), _start_variances(linear, structure))
        else:
            variances = reml(blocks(linear, structure), variances, 10)
        rows = _spread(np.flatnonzero(used), MAX_SHARED_FIT if structure in SHARED else MAX_FIT)
        linear = _linear(whole, guess, rows, structure, gathered)
        b = blocks(linear, structure)
        solved = solve(b, variances)
        x = solved.x[: linear.J.shape[2]]
        if structure in GEOMETRY:
            far = own_squares(blocks(whole.linear(guess), structure), variances, solved.x)
        guess = guess.moved(x, whole.free)
        if structure in SHARED:
            far = left_out_squares(b, solved)
            keep = used.copy()
            keep[rows[(far > chdtri(6, CHANCE)) & (far > 0.3 * far.max())]] = False
        elif structure in GEOMETRY:
            keep = far < chdtri(6, CHANCE)
        else:
            keep = 6 * _distances(whole, guess, structure, variances, gathered) < chdtri(6, CHANCE)
        if keep.sum() < max(MIN_POSES, len(keep) // 3):
            keep = used
        settled = bool((keep == used).all()) and float(np.abs(x[:12]).max()) < 1e-5
        used = keep
        if settled:
            break
    assert variances is not None
    return guess, used, variances


def _distances(whole: _Problem, guess: _Guess, structure: str, variances: Array, gathered: dict[str, Array]) -> Array:
    """Return the squared Mahalanobis length (N,) of each pose's own residual, over 6."""
    linear = whole.linear(guess)
    C = np.array(linear.given) * (0.0 if "image" in STRUCTURES[structure] else 1.0)
    for name, variance in zip(STRUCTURES[structure], variances, strict=True):
        if name == "image":
            C += variance * linear.given
        elif name in gathered:
            C += variance * gathered[name]
        else:
            M = linear.maps[SHARED_MAPS.get(name, name)]
            C += variance * M @ np.swapaxes(M, 1, 2)
    C += 1e-16 * np.eye(6)
    return np.asarray(np.einsum("ni,ni->n", linear.e, np.linalg.solve(C, linear.e[..., None])[..., 0]) / 6)


def _trial(
    whole: _Problem, guess: _Guess, used: NDArray[np.bool_], structure: str, gathered: dict[str, Array]
) -> _Trial:
    """Leave out poses under a structure."""
    rows = _spread(np.flatnonzero(used), MAX_SHARED if structure in SHARED else MAX_FIT)
    linear = _linear(whole, guess, rows, structure, gathered)
    b = blocks(linear, structure)
    variances = reml(b, _start_variances(linear, structure))
    n = len(rows)
    order = np.arange(n) if whole.t_s is not None else np.random.default_rng(0).permutation(n)
    parts = [np.sort(part) for part in np.array_split(order, n if n <= FEW and structure not in SHARED else FOLDS)]
    density, residual, left = held_out(linear, structure, variances, parts)
    return _Trial(density, residual, left, rows, variances)


def _held_out_errors(whole: _Problem, guess: _Guess, residual: Array, rows: NDArray[np.int64]) -> HeldOut:
    """Return the distances of the body's middle and the angles, of the rows that were left out in turn."""
    n = len(whole.poses.A)
    position, angle = np.full(n, np.nan), np.full(n, np.nan)
    moved = (residual[:, :3] - np.cross(whole.poses.centre, residual[:, 3:])) / guess.per_m
    position[rows], angle[rows] = np.linalg.norm(moved, axis=1), np.linalg.norm(residual[:, 3:], axis=1)
    return HeldOut(position, angle)


def _displacements(
    whole: _Problem, linear: Linear, structure: str, variances: Array, guess: _Guess
) -> tuple[float, float]:
    """Return the RMS distances by which the arm's and vision's errors move the body's middle, m."""
    middle = np.concatenate([np.eye(3), -skew(whole.poses.centre)], axis=1) / guess.per_m
    arm = camera = 0.0
    for name, variance in zip(STRUCTURES[structure], variances, strict=True):
        if name == "image":
            size = float(np.einsum("ai,nij,aj->n", middle, linear.given, middle).mean())
        elif name in linear.walk:
            size = float(np.einsum("ai,nij,aj->n", middle, linear.walk[name], middle).mean())
        else:
            M = middle @ linear.maps[SHARED_MAPS.get(name, name)]
            walked = np.diag(linear.kernel[structure]) if name == "scale_walk" else 1.0
            size = float((walked * np.einsum("nij,nij->n", M, M)).mean())
        if name in OF_THE_ARM:
            arm += variance * size
        else:
            camera += variance * size
    if "image" not in STRUCTURES[structure]:
        camera += float(np.einsum("ai,nij,aj->n", middle, linear.given, middle).mean())
    return float(np.sqrt(arm)), float(np.sqrt(camera))
