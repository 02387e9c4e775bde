"""The backlash of each joint, estimated from everything that shows it, or the reason why these poses do not show it.

In: an identified arm and the poses it was identified from. Out: one :class:`JointBacklash` per joint, stop to stop.

Backlash shows where a joint comes to rest on both of its sides. There are three cases:

1. Gravity loads the joint: the load lays it on the side it pulls to, whichever way the joint came (error source
   ``gravity_backlash``). The fitted coefficient is the backlash.
2. Friction holds the joint on the side it came from (error source ``backlash``), at its stop or a little short of it. The
   fitted coefficient, widened by how far short of the stops the joint was found, is the backlash.
3. Neither holds the joint: it lies anywhere between its stops, and the spread of where it was found shows the backlash.

A joint that gravity holds on one side at all poses shows none: its backlash is then a part of its zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from armsight.data import Array
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.joint_noise import JointNoise, by_joints, joint_noise, with_joint_noise
from armsight.loop.identify.measured import Measured

#: A joint is loose (case 3) where its scatter is more than this many times as large as the sigma of one pose's estimate,
LOOSE = 2.0
#: and more than this part of the fitted distance between its two sides: evenly anywhere between the stops it would be 0.29.
LOOSE_SHARE = 0.12
#: Where gravity holds the joint on one of its sides at less than this part of the poses, they are too few to show it.
BOTH_SIDES = 0.02
#: A fitted backlash of fewer sigmas than this does not show.
SURE = 3.0
_SHOWN_BY = {"backlash": "the side it came from", "gravity_backlash": "the side gravity pulls to"}


class JointBacklash(NamedTuple):
    """The backlash of a joint, stop to stop.

    Attributes:
        joint: 0 to 5.
        value_rad: the estimate, rad; NaN where the poses do not show it.
        sigma_rad: its sigma, rad; NaN likewise.
        how: what showed it, or why it does not show.
    """

    joint: int
    value_rad: float
    sigma_rad: float
    how: str


class _Scatter(NamedTuple):
    """The joints' scatter from pose to pose; ``weighted`` are the poses with this scatter in their covariance."""

    noise: JointNoise
    weighted: Measured

    def pose_sigma_rad(self, joint: int) -> float:
        """Return the median sigma of a single pose's estimate of how far a joint is off, rad."""
        return float(np.median(self.noise.sigma_off_rad[:, joint]))


def joint_backlashes(found: Identified, measured: Measured) -> tuple[JointBacklash, ...]:
    """Return the backlash of every joint.

    Args:
        found: the identified arm.
        measured: the poses that it was identified from.
    """
    phi = found.model.feature_values(measured.q, measured.approach)
    scatter = None
    if found.joint_sigma_rad.any():
        weighted = with_joint_noise(found.model, found.solution.x, measured, found.joint_sigma_rad)
        scatter = _Scatter(joint_noise(found.model, found.solution, found.prior, measured), weighted)
    return tuple(_of_joint(i, found, measured, phi, scatter) for i in range(found.model.arm.joints))


def _of_joint(joint: int, found: Identified, measured: Measured, phi: Array, scatter: _Scatter | None) -> JointBacklash:
    """Return the backlash of one joint: see the three cases above.

    Args:
        joint: 0 to 5.
        found: the identified arm.
        measured: the poses.
        phi: (N, F) what one unit of each error source adds to its joint's angle.
        scatter: of the joints; None where the instrument's covariance is unknown.
    """
    model, x = found.model, found.solution.x
    columns = [k for k, f in enumerate(model.features) if f.joint == joint and f.kind in _SHOWN_BY]
    under_gravity = [k for k in columns if model.features[k].kind == "gravity_backlash"]
    loaded = bool(phi[:, under_gravity].any())
    coefficients = x[[model.sources_at + k for k in columns]]
    sigma = float(found.joint_sigma_rad[joint])
    pose_sigma = 0.0 if scatter is None else scatter.pose_sigma_rad(joint)
    if scatter is not None and not loaded:
        resolved = LOOSE * pose_sigma
        if sigma > max(resolved, LOOSE_SHARE * float(np.abs(coefficients).max(initial=0.0))):
            return _loose(joint, found, scatter, phi[:, columns] @ coefficients)
    fit = _fitted(found, joint, columns, phi)
    return fit if loaded else _widened(fit, sigma, pose_sigma, _approach_counts(joint, found, measured))


def _loose(joint: int, found: Identified, scatter: _Scatter, modelled: Array) -> JointBacklash:
    """Return the backlash of a joint that lies anywhere between its stops.

    The estimates of where it was found are shrunk towards the model (Kalman's gain); here the shrinkage is undone, so that
    each pose stands with its own noise.

    Args:
        joint: 0 to 5.
        found: the identified arm.
        scatter: of the joints.
        modelled: (N,) what the fitted error sources said of its side, rad.
    """
    left = scatter.noise.sigma_off_rad[:, joint] ** 2
    gain = 1 - left / float(found.joint_sigma_rad[joint]) ** 2
    stood = scatter.noise.off_rad[:, joint] / gain + modelled
    variance = left / gain + _by_parameters(found, scatter.weighted, joint)
    return _between_stops(joint, stood, np.sqrt(variance))


def _approach_counts(joint: int, found: Identified, measured: Measured) -> tuple[int, int]:
    """Return at how many of the poses used a joint's angle grew before it came to rest, and at how many it fell."""
    if measured.approach is None:
        return 0, 0
    side = measured.approach[found.solution.used, joint]
    return int((side > 0).sum()), int((side < 0).sum())


def _widened(fit: JointBacklash, sigma: float, pose_sigma: float, sides: tuple[int, int]) -> JointBacklash:
    """Widen the fitted backlash of a joint that friction holds near its stops, by how far short of them it was found.

    Where a link comes to rest scatters, because the shaft goes back a little when it stops and leaves the link behind. A
    link is never beyond its stops; so the furthest of the n poses at a stop is nearest to it. Its distance from the mean is
    that of the expected largest of n normal numbers (Blom, Statistical Estimates and Transformed Beta-Variables, 1958).
    Only the scatter that single poses resolve is added. The truth may be anything from no widening to twice the widening
    that all of the scatter would give; the sigma covers that.

    Args:
        fit: the mean distance between where the joint was found on its two sides.
        sigma: of where it was found on one side, rad.
        pose_sigma: of a single pose's estimate of that, rad.
        sides: how many poses came to rest from either side; one or none on a side shows nothing of its scatter.
    """
    furthest = sum(float(ndtri((n - 0.375) / (n + 0.25))) for n in sides if n > 1)
    short, most = furthest * float(np.sqrt(max(sigma**2 - pose_sigma**2, 0.0))), furthest * sigma
    variance = fit.sigma_rad**2 + most**2 / 3 + (most - short) ** 2
    return fit._replace(value_rad=fit.value_rad + short, sigma_rad=float(np.sqrt(variance)))


def _by_parameters(found: Identified, weighted: Measured, joint: int) -> Array:
    """Return the variance (N,), rad^2, of where a joint stood that comes from the fitted parameters' own.

    What the choice of the model moves is common to the poses, and is no scatter of them.
    """
    assert weighted.cov is not None  # for the type checker: a joint's scatter is known only with it
    model = found.model
    J = model.linearised(found.solution.x, weighted, model.feature_values(weighted.q, weighted.approach))[1]
    B = by_joints(model, J)[:, :, joint]
    pull = (np.linalg.inv(weighted.cov + 1e-18 * np.eye(weighted.size)) @ B[..., None])[..., 0]
    row = np.einsum("nm,nmp->np", pull, J) / np.einsum("nm,nm->n", pull, B)[:, None]
    return np.asarray(np.einsum("np,pq,nq->n", row, found.solution.cov, row))


def _between_stops(joint: int, stood: Array, noise: Array) -> JointBacklash:
    """Estimate the backlash of a joint that lies at its stops or anywhere between, by maximum likelihood.

    Args:
        joint: 0 to 5.
        stood: (N,) where it stood, rad.
        noise: (N,) sigmas of these, rad.
    """
    from scipy.optimize import minimize

    def cost(at: Array) -> float:
        """Return minus the log likelihood of (middle, log of half the backlash, logit of the share at a stop)."""
        middle, half, at_stop = at[0], np.exp(at[1]), 1 / (1 + np.exp(-at[2]))
        left, right = (middle - half - stood) / noise, (middle + half - stood) / noise
        between = (ndtr(right) - ndtr(left)) / (2 * half)
        ends = (np.exp(-0.5 * left**2) + np.exp(-0.5 * right**2)) / np.sqrt(2 * np.pi) / (2 * noise)
        return -float(np.log(at_stop * ends + (1 - at_stop) * between + 1e-12 / noise).sum())

    extent = float(np.ptp(stood))
    start = np.array([float(np.median(stood)), np.log(extent / 2), 0.0])
    best = minimize(cost, start, method="Nelder-Mead", tol=1e-6)
    half, step = float(np.exp(best.x[1])), 0.02

    def profile(by: float) -> float:
        """Return the least cost with the log of the half backlash changed by a number, the other two free."""

        def other(v: Array) -> float:
            return cost(np.array([v[0], best.x[1] + by, v[1]]))

        return float(minimize(other, best.x[[0, 2]], method="Nelder-Mead", tol=1e-6).fun)

    around = [profile(-step), profile(step)]
    curvature = max((sum(around) - 2 * best.fun) / step**2, 1e-3)
    how = "how far apart it was found, as nothing holds it on one side"
    return JointBacklash(joint, 2 * half, 2 * half / float(np.sqrt(curvature)), how)


def _fitted(found: Identified, joint: int, columns: list[int], phi: Array) -> JointBacklash:
    """Return the backlash that was fitted, or say why none was."""
    model, x = found.model, found.solution.x
    at = {model.features[k].kind: k for k in columns}
    fitted = {kind: k for kind, k in at.items() if found.solution.free[model.sources_at + k]}
    rows = np.array([model.sources_at + k for k in fitted.values()], np.int64)
    value = float(np.sum(x[rows]))
    # Backlash is not negative, and an insignificant value is not reported.
    if value > SURE * float(np.sqrt(found.cov[np.ix_(rows, rows)].sum())):
        how = " and ".join(_SHOWN_BY[kind] for kind in fitted)
        return JointBacklash(joint, value, float(np.sqrt(found.cov[np.ix_(rows, rows)].sum())), how)
    side = phi[:, at["gravity_backlash"]]
    if np.abs(side).max(initial=0.0) > 0 and min(np.mean(side > 0), np.mean(side < 0)) < BOTH_SIDES:
        how = "not observable: at all these poses gravity holds it on one side, and its backlash is a part of its zero"
    elif "backlash" not in at and not side.any():
        how = "not observable: from which side it came is not known"
    else:
        names = (f"gravity_backlash{joint + 1}", f"backlash{joint + 1}")
        how = found.reasons.get(names[0], found.reasons.get(names[1], "does not show"))
    return JointBacklash(joint, float("nan"), float("nan"), how)
