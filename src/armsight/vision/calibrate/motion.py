"""How far the board moves between the two exposures of a pair: a random effect, learned from the pairs themselves.

Cameras that are not synchronised see a board in the hand at two positions. Each pair has its own motion, small for most
and large for a few: normal with a variance of the pair's own, whose inverse is gamma distributed, which makes motions
of Student's t distribution (Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989).
Scale and weights are found by EM, with MacKay's step for the scale, which reaches zero where nothing moves. A pair that
moved far pulls less on the relative pose of the cameras, and none on what is inside them.

And whether the cameras changed between two pairs (:func:`change_of`): refocused, zoomed, cropped, shifted, knocked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.estimate.chance import chi_square_limit
from armsight.estimate.change import changed, matters
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.pose.bundle import CAUCHY_SCALE, BundleSolution, free_parameters, minimise, whiteners
from armsight.vision.pose.projection import BundleModel, Observations, predict
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Degrees of freedom of the motions' distribution: four leave the variance finite, and let one pair move five times as
#: far as the rest.
TAIL = 4.0
#: What changes if a board of another size is shown, and the share of a cost that is left if that explains it. Half: an
#: error of twice the corners' noise is not named; double: other changes may be.
SIZE, _OTHER_COST = "the board's size over the cameras' distance", 0.25
#: A motion of one standard deviation at first, as a share of the board's diagonal, and the least it may be.
START_SHARE, _LEAST = 1e-3, 1e-8
#: Chance that white noise shows corners that are off together; half and double: another rate of false alarms.
_BY_CHANCE = 1e-4
_SINGULAR = 1e-14  # eigenvalue of a scaled information that is rounding; half and double: nothing


@dataclass(frozen=True, eq=False)
class ExposureMotion(Record):
    """How boards move between the exposures: the motion's scale, and how each of S pairs departs from it."""

    #: (2,) scale of the translation of the board's middle along each axis, m, and of the rotation about each, rad
    scales: Array
    #: (S,) by how much each pair's variance is smaller than the scale's square: 1 usual, near 0 moved far
    weights: Array
    rms: Array  #: (2,) root mean square of both over all pairs, m and rad: the prediction for a new pair

    @staticmethod
    def guessed(points: Array, count: int) -> ExposureMotion:
        """Return the motion to begin with for a board of points (M, 3), m, in ``count`` pairs."""
        scales = START_SHARE * np.array([np.linalg.norm(np.ptp(points, axis=0)), 2.0])
        return ExposureMotion(scales, np.ones(count), scales)

    @property
    def rms_m(self) -> float:
        """Root mean square of the translation along an axis, m."""
        return float(self.rms[0])

    @property
    def sigmas(self) -> Array:
        """(S, 6) standard deviation of every pair's motion, as a model of bundle adjustment takes it."""
        return np.asarray(np.repeat(self.scales, 3) / np.sqrt(self.weights)[:, None])

    @property
    def variance(self) -> Array:
        """(6,) variance of a new pair's motion."""
        return np.repeat(self.rms**2, 3)

    def shots(self, rows: NDArray[np.intp]) -> ExposureMotion:
        """Return the motion of some of the pairs only."""
        return replace(self, weights=self.weights[rows])

    def scaled(self, factor: float) -> ExposureMotion:
        """Return the motion with every standard deviation multiplied."""
        return replace(self, scales=factor * self.scales, rms=factor * self.rms)

    def seen_from(self, T_camera_board: Array, middle: Array) -> Array:
        """Return the (6, 6) covariance of a new pair's motion as a tangent [translation; rotation] in a camera's frame.

        ``T_camera_board``: (4, 4) pose of the board; ``middle``: (3,) middle of the board in its own frame, m.
        """
        R, centre = T_camera_board[:3, :3], transform(T_camera_board, middle)
        A = np.block([[R, skew(centre) @ R], [np.zeros((3, 3)), R]])
        return np.asarray(A * self.variance @ A.T)

    def updated(self, solution: BundleSolution) -> tuple[ExposureMotion, float]:
        """Learn from an adjustment under this motion: the better motion, and how many freedoms the pairs' motions took."""
        estimate, unsure = solution.state.motions**2, np.diagonal(solution.cov_motions, axis1=1, axis2=2)
        q = ((estimate + unsure) / np.repeat(self.scales, 3) ** 2).sum(axis=1)
        weights = (TAIL + 6) / (TAIL + q)
        freed = 3 * len(q) - (unsure / self.sigmas**2).reshape(-1, 2, 3).sum(axis=(0, 2))
        moved = (weights[:, None, None] * estimate.reshape(-1, 2, 3)).sum(axis=(0, 2))
        scales = np.maximum(np.sqrt(moved / np.maximum(freed, 1e-3)), _LEAST)
        rms = np.sqrt((estimate + unsure).reshape(-1, 2, 3).mean(axis=(0, 2)))
        return ExposureMotion(scales, weights, rms), float(freed.sum())


@dataclass(frozen=True, eq=False)
class CameraChange(Record):
    """What changed in the cameras between two pairs."""

    row: int  #: the first pair after it
    what: str  #: the part that changed, and by how much: "the right focal length by +1.0 %"; empty: or the lens model
    off: Array  #: (2, P) the rig's parameters before and after it less those of the fit to all pairs
    shift_m: float  #: by how much it displaces the points that the pairs measured, median, m


def of_shots(model: BundleModel, solution: BundleSolution, seen: Observations) -> Array:
    """Return (S, Q + 1, Q + 1) what each shot says of the Q shared parameters and, last, their residual, whitened."""
    uv, by_shared, by_own = predict(model, solution.state, seen)
    W = whiteners(seen, solution.sigma_px)
    white = (W @ (seen.uv - uv)[..., None])[..., 0]
    weigh = 1.0 / np.sqrt(1.0 + np.einsum("ni,ni->n", white, white) / CAUCHY_SCALE**2)[:, None]
    J = np.concatenate([W @ by_own, W @ by_shared, white[..., None]], axis=2) * weigh[..., None]
    own, total = by_own.shape[2], np.empty((seen.shot_count, J.shape[2], J.shape[2]))
    for shot in range(seen.shot_count):
        rows = J[seen.shot == shot].reshape(-1, J.shape[2])
        total[shot] = rows.T @ rows
    if own > 6:  # the motion between the exposures has a prior
        still, ours = model.motion_sigmas**-2.0, np.arange(6, own)
        total[:, ours, ours] += still
        pull = still * solution.state.motions
        total[:, ours, -1] -= pull
        total[:, -1, ours] -= pull
        total[:, -1, -1] += (pull * solution.state.motions).sum(axis=1)
    by_own = np.linalg.solve(total[:, :own, :own], total[:, :own, own:])
    return np.asarray(total[:, own:, own:] - total[:, own:, :own] @ by_own)


def _condensed(
    model: BundleModel, solution: BundleSolution, each: Array, free: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Return P + 1 whitened residuals of each shot, (S, P + 1), that say all it says of the rig, and their derivative.

    By the P free parameters of the rig, the shape held; ``each`` is :func:`of_shots`. The axes of the relative position are
    :func:`baseline_axes`.
    """
    free = np.ones(each.shape[2] - 1 - len(model.modes), bool) if free is None else free
    left = each[:, (kept := np.append(np.flatnonzero(free), -1))][:, :, kept]
    unit = 1 / np.sqrt(np.maximum(np.einsum("sii->i", left), 1e-300))
    values, axes = np.linalg.eigh(unit[:, None] * left * unit)
    rows = np.sqrt(np.maximum(values, 0.0))[..., None] * axes.swapaxes(1, 2) / unit
    rows[:, :, -7:-4] = rows[:, :, -7:-4] @ baseline_axes(solution.state.T_left_right)
    return rows[:, :, -1], rows[:, :, :-1]


def baseline_axes(T_left_right: Array) -> Array:
    """Return orthonormal columns (3, 3), the first along the baseline, in the axes of the relative pose's tangent."""
    along = (T_left_right[:3, :3].T @ T_left_right[:3, 3])[:, None]
    axes = np.linalg.qr(np.column_stack([along, np.eye(3)]))[0]
    return np.asarray(axes * np.sign(axes[:, :1].T @ along))


def other_size(model: BundleModel, start: BundleSolution, seen: Observations, pairs: int) -> tuple[int, float] | None:
    """Return from which of the first ``pairs`` shots on the board is so many times as large; None where one size fits.

    Each pair shows its board's size beside the distance of the cameras alone. That the start leaves less than half of its
    error if the later boards may be of another size shows it.
    """
    state, count = start.state, len(model.points)
    e, J = _condensed(model, start, of_shots(model, start, seen))
    found = changed(e, J, {SIZE: np.array([J.shape[2] - 6])}, state.Ts_left_body[:pairs, :3, 3], count=pairs)
    if found is None:
        return None
    points, modes = np.vstack([model.points] * 2), np.vstack([0 * model.points, model.points])[None]
    both, state = replace(model, points=points, modes=modes, shape_sigma_m=1.0), replace(state, shape=np.zeros(1))
    seen = replace(seen, point=seen.point + count * (seen.shot >= found.row))
    for sigma_px in (5.0, start.sigma_px):
        fitted = minimise(both, state, seen, sigma_px, covariance=False)
        state = fitted.state
    return (found.row, float(1 + state.shape[0])) if fitted.cost < _OTHER_COST * start.cost else None


def change_of(
    model: BundleModel, solution: BundleSolution, each: Array, rig: StereoRig, pairs: int
) -> CameraChange | None:
    """Return how the cameras changed among the first ``pairs`` shots; later ones are of one camera alone.

    ``each``: what each shot says, :func:`of_shots`.
    """
    count = rig.left.parameters.size
    left, right, both = np.arange(2), count + np.arange(2), np.array([0, 1, count, count + 1])
    focal = {"the left focal length": left, "the right focal length": right, "both focal lengths": both}
    names = "the left image's position", "the right image's position", "the positions of both images"
    named = focal | dict(zip(names, (left + 2, right + 2, both + 2), strict=True))
    named["the relative pose of the cameras"] = np.arange(len(rig.cov) - 6, len(rig.cov))
    named[SIZE] = named["the relative pose of the cameras"][:1]  # in axes of which the first is the baseline's
    free = np.diag(rig.cov) > 0
    column_of, named = np.cumsum(free) - 1, {name: p for name, p in named.items() if free[p].all()}
    ways = {name: column_of[p] for name, p in named.items()}
    middle = transform(solution.state.Ts_left_body, model.body(np.zeros(len(model.modes))).mean(axis=0))
    sight = middle[:, :2] / middle[:, 2:]
    off_axis = np.linalg.norm(sight - sight[:pairs].mean(axis=0), axis=1)
    poses = np.column_stack([sight, np.log(middle[:, 2]), solution.state.Ts_left_body[:, :2, 2], off_axis])
    if (found := changed(*_condensed(model, solution, each, free), ways, poses, count=pairs)) is None:
        return None
    off, axes = found.off.copy(), baseline_axes(rig.T_left_right)
    off[:, -6:-3] = off[:, -6:-3] @ axes.T
    if not matters(found := replace(found, off=off).over_all(free), rig.cov):
        return None
    off, p = found.off, named[found.way]
    points = transform(solution.state.Ts_left_body[:pairs, None], model.body(solution.state.shape)).reshape(-1, 3)
    views = points, transform(inverse(rig.T_left_right), points)
    uv = np.stack([camera.project(p) for camera, p in zip(rig.cameras, views, strict=True)], axis=1)
    by_rig = optimal_points(rig, uv, np.broadcast_to(np.eye(2), (len(uv), 2, 2, 2)))[2]
    shift_m = float(np.nanmedian(np.linalg.norm(by_rig @ (off[1] - off[0]), axis=1)))
    step = (off[1] - off[0])[p] if found.way != SIZE else -axes.T[:1] @ (off[1] - off[0])[-6:-3] / rig.baseline_m
    what = f"{found.way} by {_amount(rig, p, step)}" if found.sure else ""
    return CameraChange(found.row, what, off, shift_m)


def spread_of(model: BundleModel, solution: BundleSolution, each: Array, count: int) -> Array | None:
    """Return what is added to the covariance of the rig's ``count`` parameters as corners of a shot are off together.

    Each shot may be of a rig of its own, spread as the covariance is, by the variance that makes the squares of the shots'
    gradients as expected (MINQUE; Rao, "Estimation of variance components", 1972). None where noise may have larger ones.
    ``each``: what each shot says, :func:`of_shots`.
    """
    free = free_parameters(model, solution.state)
    A = each[:, :-1, :-1] * free * free[:, None]
    H = A.sum(axis=0) + np.diag(np.append(np.zeros(count), np.full(len(model.modes), model.shape_sigma_m**-2.0)))
    unit = 1 / np.sqrt(np.where(free, np.diag(H), 1.0))
    values, axes = np.linalg.eigh(unit[:, None] * H * unit)
    root = unit[:, None] * axes[:, values > _SINGULAR] / np.sqrt(values[values > _SINGULAR])
    rig, (half_d2, density) = root[:count], np.polynomial.laguerre.laggauss(40)
    own, gain = rig.T @ A[:, :count, :count] @ rig, rig.T @ A[:, :count] @ root
    less, whole = gain @ gain.swapaxes(1, 2), (gain.swapaxes(1, 2) @ gain).sum(axis=0)
    w = 1.0 / (1.0 + 2 * half_d2 / CAUCHY_SCALE**2)  # of white noise: the variance of a gradient is less than A
    squares = ((each[:, :count, -1] @ rig) ** 2).sum() * (density @ w) / (density @ (half_d2 * w**2))
    usual, spread = np.einsum("sii->", own - less), (own * (own - 2 * less)).sum() + (whole**2).sum()
    if squares * usual <= chi_square_limit(usual**2 / spread, _BY_CHANCE) * spread:
        return None
    return np.asarray((squares - usual) / spread * rig @ whole @ rig.T)


def _amount(rig: StereoRig, p: NDArray[np.intp], step: Array) -> str:
    """Write a step of the rig's parameters ``p``: focal lengths, principal points, the relative pose, or a share."""
    if len(p) == 1:
        return f"{100 * step[0]:+.2g} % ({1e3 * abs(step[0]) * rig.baseline_m:.2g} mm of the baseline)"
    if len(p) == 6:
        return f"{1e3 * np.linalg.norm(step[:3]):.2g} mm and {np.degrees(np.linalg.norm(step[3:])):.2g} degrees"
    if p[0] in (0, rig.left.parameters.size):
        focal = np.concatenate([rig.left.parameters, rig.right.parameters])[p]
        return " and ".join(f"{100 * share:+.2g} %" for share in (step / focal).reshape(-1, 2).mean(axis=1))
    return " and ".join(f"{np.linalg.norm(each):.2g} px" for each in step.reshape(-1, 2))
