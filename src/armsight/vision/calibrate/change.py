"""Whether the cameras changed while the pairs were taken: refocused, zoomed, cropped, shifted, knocked.

In: an adjustment of all pairs, in the order in which they were taken. Out: between which two the cameras changed, what
changed and by how much; None where one state fits all. Each way to change and each split of the pairs is a score test
(Rao, 1948) in which every shot's own parameters are eliminated. The same test of the pairs in random orders shows what
chance and outliers do (a permutation test; Good, 2005), and in orders by the boards' poses what the lens model lacks does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.geometry.pose import inverse, transform
from armsight.vision.pose.bundle import CAUCHY_SCALE, BundleSolution, solve_scaled, whiteners
from armsight.vision.pose.projection import BundleModel, Observations, predict
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Least pairs on either side of a change, and the least share of all; half: more that chance offers, double: later found.
_LEAST, _LEAST_SHARE = 3, 0.15
#: Random orders, as many by pose, and the share of the first that may look as changed; half and double: another rate of
#: false alarms.
_ORDERS, _CHANCE = 200, 0.005
#: Least square of a change in sigmas of the rig, per parameter; half: changes that sigmas hold are named, double: fewer.
_MATTERS = 4.0
_RIDGE = 1e-10  # of a scaled system whose pairs leave a direction open; half and double: nothing


@dataclass(frozen=True, eq=False)
class CameraChange(Record):
    """What changed in the cameras between two pairs."""

    row: int  #: the first pair after it
    what: str  #: the part that changed, and by how much: "the right focal length by +1.0 %"; empty: or the lens model
    off: Array  #: (2, P) the rig's parameters before and after it less those of the fit to all pairs
    shift_m: float  #: by how much it displaces the points that the pairs measured, median, m


def _scores(model: BundleModel, solution: BundleSolution, seen: Observations) -> tuple[Array, Array]:
    """Return each shot's information about the rig's parameters (S, P, P), and its gradient (S, P), its own eliminated."""
    uv, by_shared, by_own = predict(model, solution.state, seen)
    W, count = whiteners(seen, solution.sigma_px), by_shared.shape[2] - len(model.modes)
    white = (W @ (seen.uv - uv)[..., None])[..., 0]
    weigh = 1.0 / np.sqrt(1.0 + np.einsum("ni,ni->n", white, white) / CAUCHY_SCALE**2)[:, None]
    J = np.concatenate([W @ by_own, W @ by_shared[:, :, :count], white[..., None]], axis=2) * weigh[..., None]
    own, total = by_own.shape[2], np.empty((seen.shot_count, J.shape[2], J.shape[2]))
    for shot in range(seen.shot_count):
        rows = J[seen.shot == shot].reshape(-1, J.shape[2])
        total[shot] = rows.T @ rows
    if own > 6:  # the motion between the exposures has a prior
        still, ours = model.motion_sigmas**-2.0, np.arange(6, own)
        total[:, ours, ours] += still
        total[:, ours, -1] -= still * solution.state.motions
    left = total[:, own:, own:] - total[:, own:, :own] @ np.linalg.solve(total[:, :own, :own], total[:, :own, own:])
    return left[:, :-1, :-1], left[:, :-1, -1]


def _gains(H: Array, g: Array, whole: tuple[Array, Array], ways: list[NDArray[np.intp]]) -> tuple[Array, list[Array]]:
    """Return by how much each way to change lowers the squares (W, K), at each of K splits, and its steps (K, p)."""
    information, gradient = whole
    after_H, after_g = (np.cumsum(x[::-1], axis=0)[-2::-1] for x in (H, g))
    kept = after_H @ np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    M, v = after_H - kept @ after_H, after_g - kept @ gradient
    blocks = [(M[:, p[:, None], p] + _RIDGE * np.eye(len(p)), v[:, p]) for p in ways]
    steps = [np.asarray(np.linalg.solve(block, slope[..., None])[..., 0], np.float64) for block, slope in blocks]
    return np.array([(slope * step).sum(axis=1) for (_, slope), step in zip(blocks, steps, strict=True)]), steps


def _by_pose(Ts: Array, model: BundleModel) -> NDArray[np.intp]:
    """Return orders (K, N) of N pairs by the poses of their boards: by where, how far and how tilted, and by mixtures."""
    middle = transform(Ts, model.body(np.zeros(len(model.modes))).mean(axis=0))
    sight = middle[:, :2] / middle[:, 2:]
    off_axis = np.linalg.norm(sight - sight.mean(axis=0), axis=1)
    poses = np.column_stack([sight, np.log(middle[:, 2]), Ts[:, :2, 2], off_axis])
    poses = (poses - poses.mean(axis=0)) / np.maximum(poses.std(axis=0), 1e-300)
    mixtures = np.random.default_rng(1).standard_cauchy((_ORDERS - poses.shape[1], poses.shape[1]))
    return np.argsort(np.concatenate([np.eye(poses.shape[1]), mixtures]) @ poses.T, axis=1)


def change_of(
    model: BundleModel, solution: BundleSolution, seen: Observations, rig: StereoRig, pairs: int
) -> CameraChange | None:
    """Return how the cameras changed among the first ``pairs`` shots; later ones are of one camera alone."""
    count, least = rig.left.parameters.size, max(_LEAST, int(np.ceil(_LEAST_SHARE * pairs)))
    if pairs < 2 * least:
        return None
    left, right, both = np.arange(2), count + np.arange(2), np.array([0, 1, count, count + 1])
    focal = {"the left focal length": left, "the right focal length": right, "both focal lengths": both}
    names = "the left image's position", "the right image's position", "the positions of both images"
    named = focal | dict(zip(names, (left + 2, right + 2, both + 2), strict=True))
    named["the relative pose of the cameras"] = np.arange(len(rig.cov) - 6, len(rig.cov))
    free = np.diag(rig.cov) > 0
    column_of, named = np.cumsum(free) - 1, {name: p for name, p in named.items() if free[p].all()}
    ways = [column_of[p] for p in named.values()]
    H, g = _scores(model, solution, seen)
    H, g = H[:, free][:, :, free], g[:, free]
    unit = 1.0 / np.sqrt(np.maximum(np.diag(H.sum(axis=0)), 1e-300))
    H, g = H * unit[:, None] * unit, g * unit
    whole, inner = (H.sum(axis=0), g.sum(axis=0)), slice(least - 1, pairs - least)
    H, g = H[:pairs], g[:pairs]
    gains, steps = _gains(H, g, whole, ways)
    random, by_pose = np.random.default_rng(0), _by_pose(solution.state.Ts_left_body[:pairs], model)
    by_chance, by_lens = (
        np.array([_gains(H[order], g[order], whole, ways)[0][:, inner].max(axis=1) for order in orders])
        for orders in ([random.permutation(pairs) for _ in range(_ORDERS)], by_pose)
    )
    usual = np.maximum(by_chance.mean(axis=0), 1e-300)
    over = (gains[:, inner] / usual[:, None]).max()
    if over <= np.quantile((by_chance / usual).max(axis=1), 1 - _CHANCE):
        return None
    beyond = gains[:, inner] - usual[:, None]
    way, column = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    (name, p), split = list(named.items())[way], int(column) + least
    step, off = np.zeros(len(unit)), np.zeros((2, len(free)))
    step[ways[way]] = steps[way][split - 1]
    drawn = np.linalg.lstsq(whole[0], H[split:].sum(axis=0) @ step, rcond=1e-12)[0]  # the fit to all, by the later ones
    off[:, free] = np.stack([-drawn, step - drawn]) * unit
    if max(each @ solve_scaled(rig.cov[np.ix_(free, free)], each) for each in off[:, free]) < _MATTERS * free.sum():
        return None
    sure = over > (by_lens / usual).max()
    points = transform(solution.state.Ts_left_body[:pairs, None], model.body(solution.state.shape)).reshape(-1, 3)
    views = points, transform(inverse(rig.T_left_right), points)
    uv = np.stack([camera.project(p) for camera, p in zip(rig.cameras, views, strict=True)], axis=1)
    by_rig = optimal_points(rig, uv, np.broadcast_to(np.eye(2), (len(uv), 2, 2, 2)))[2]
    shift_m = float(np.nanmedian(np.linalg.norm(by_rig @ (off[1] - off[0]), axis=1)))
    return CameraChange(
        split, f"{name} by {_amount(rig, p, (off[1] - off[0])[p])}" if sure else "", off * sure, shift_m
    )


def _amount(rig: StereoRig, p: NDArray[np.intp], step: Array) -> str:
    """Write a step of the rig's parameters ``p``: focal lengths, principal points, or the relative pose."""
    if len(p) == 6:
        return f"{1e3 * np.linalg.norm(step[:3]):.2g} mm and {np.degrees(np.linalg.norm(step[3:])):.2g} degrees"
    if p[0] in (0, rig.left.parameters.size):
        focal = np.concatenate([rig.left.parameters, rig.right.parameters])[p]
        return " and ".join(f"{100 * share:+.2g} %" for share in (step / focal).reshape(-1, 2).mean(axis=1))
    return " and ".join(f"{np.linalg.norm(each):.2g} px" for each in step.reshape(-1, 2))
