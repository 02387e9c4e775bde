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
from armsight.loop.identify.fit import by_joints, joint_noise, with_joint_noise
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.measured import Measured

#: A joint is loose (case 3) where its scatter exceeds this many sigmas of a pose, and this share of its backlash.
LOOSE, LOOSE_SHARE = 2.0, 0.12
#: Where gravity holds the joint on one of its sides at less than this part of the poses, they are too few to show it.
BOTH_SIDES = 0.02
SURE = 3.0  # a fitted backlash of fewer sigmas than this does not show
_SHOWN_BY = {"backlash": "the side it came from", "gravity_backlash": "the side gravity pulls to"}


class JointBacklash(NamedTuple):
    """The backlash of a joint, stop to stop."""

    joint: int  #: from 0
    value_rad: float  #: the estimate, rad; NaN where the poses do not show it
    sigma_rad: float  #: its sigma, rad; NaN likewise
    how: str  #: what showed it, or why it does not show


def joint_backlashes(found: Identified, measured: Measured) -> tuple[JointBacklash, ...]:
    """Return the backlash of every joint."""
    model, x, n = found.model, found.solution.x, found.model.arm.joints
    phi = model.feature_values(measured.q, measured.approach)
    off, left, by_fit = np.zeros((len(phi), n)), np.zeros((len(phi), n)), np.zeros((len(phi), n))
    if found.joint_sigma_rad.any():  # else the instrument's covariance is unknown
        noise = joint_noise(model, found.solution, found.prior, measured)
        off, left = noise.off_rad, noise.sigma_off_rad
        by_fit = _by_parameters(found, with_joint_noise(model, x, measured, found.joint_sigma_rad))
    return tuple(_of_joint(i, found, measured, phi, off[:, i], left[:, i], by_fit[:, i]) for i in range(n))


def _of_joint(
    joint: int, found: Identified, measured: Measured, phi: Array, off: Array, left: Array, by_fit: Array
) -> JointBacklash:
    """Return the backlash of one joint, by the three cases above.

    ``phi``: (N, F) what one unit of each error source adds to its joint's angle. ``off``: (N,) by how much the joint
    was off at each pose, rad, shrunk towards the model by its scatter. ``left``: (N,) sigma of that, rad. ``by_fit``:
    (N,) its variance by the fitted parameters, rad^2.
    """
    model, x = found.model, found.solution.x
    columns = [k for k, f in enumerate(model.features) if f.joint == joint and f.kind in _SHOWN_BY]
    coefficients = x[[model.sources_at + k for k in columns]]
    fit = _fitted(found, joint, columns, phi)
    if any(phi[:, k].any() for k in columns if model.features[k].kind == "gravity_backlash"):
        return fit
    sigma, pose_sigma = float(found.joint_sigma_rad[joint]), float(np.median(left))
    if sigma > max(LOOSE * pose_sigma, LOOSE_SHARE * float(np.abs(coefficients).max(initial=0.0))):
        gain = 1 - left**2 / sigma**2  # Kalman's: undone here, so that each pose stands with its own noise
        return _between_stops(joint, off / gain + phi[:, columns] @ coefficients, np.sqrt(left**2 / gain + by_fit))
    sides = np.zeros(0) if measured.approach is None else measured.approach[found.solution.used, joint]
    return _widened(fit, sigma, pose_sigma, (int((sides > 0).sum()), int((sides < 0).sum())))


def _widened(fit: JointBacklash, sigma: float, pose_sigma: float, sides: tuple[int, int]) -> JointBacklash:
    """Widen the fitted backlash of a joint that friction holds near its stops, by how far short of them it was found.

    Where a link comes to rest scatters, because the shaft goes back a little when it stops and leaves the link behind. A
    link is never beyond its stops; so the furthest of the n poses at a stop is nearest to it. Its distance from the mean is
    that of the expected largest of n normal numbers (Blom, Statistical Estimates and Transformed Beta-Variables, 1958).
    """
    furthest = sum(float(ndtri((n - 0.375) / (n + 0.25))) for n in sides if n > 1)
    short, most = furthest * float(np.sqrt(max(sigma**2 - pose_sigma**2, 0.0))), furthest * sigma
    variance = fit.sigma_rad**2 + most**2 / 3 + (most - short) ** 2
    return fit._replace(value_rad=fit.value_rad + short, sigma_rad=float(np.sqrt(variance)))


def _by_parameters(found: Identified, weighted: Measured) -> Array:
    """Return the variance (N, n), rad^2, of where joints stood by the fitted parameters; their choice is no scatter."""
    assert weighted.cov is not None  # for the type checker: a joint's scatter is known only with it
    model, s = found.model, found.solution
    J = model.linearised(s.x, weighted)[1]
    B = by_joints(model, J)
    pull = np.linalg.inv(weighted.cov + 1e-18 * np.eye(weighted.size)) @ B
    rows = pull.swapaxes(1, 2) @ J / np.einsum("nmj,nmj->nj", pull, B)[..., None]
    return np.asarray(np.einsum("njp,pq,njq->nj", rows, s.cov, rows, optimize=True))


def _between_stops(joint: int, stood: Array, noise: Array) -> JointBacklash:
    """Estimate the backlash of a joint that stood (N,), rad, with sigmas (N,) at its stops or anywhere between."""
    from scipy.optimize import minimize

    def cost(at: Array) -> float:
        """Return minus the log likelihood of (middle, logit of the share at a stop, log of half the backlash)."""
        middle, at_stop, half = at[0], 1 / (1 + np.exp(-at[1])), np.exp(at[2])
        left, right = (middle - half - stood) / noise, (middle + half - stood) / noise
        between = (ndtr(right) - ndtr(left)) / (2 * half)
        ends = (np.exp(-0.5 * left**2) + np.exp(-0.5 * right**2)) / np.sqrt(2 * np.pi) / (2 * noise)
        return -float(np.log(at_stop * ends + (1 - at_stop) * between + 1e-12 / noise).sum())

    start = np.array([float(np.median(stood)), 0.0, np.log(float(np.ptp(stood)) / 2)])
    best = minimize(cost, start, method="Nelder-Mead", tol=1e-6)

    def profile(by: float) -> float:
        """Return the least cost with the log of the half backlash changed by a number, the other two free."""

        def other(v: Array) -> float:
            return cost(np.append(v, best.x[2] + by))

        return float(minimize(other, best.x[:2], method="Nelder-Mead", tol=1e-6).fun)

    step = 0.02
    curvature = max((profile(-step) + profile(step) - 2 * float(best.fun)) / step**2, 1e-3)
    full = 2 * float(np.exp(best.x[2]))
    how = "how far apart it was found, as nothing holds it on one side"
    return JointBacklash(joint, full, full / float(np.sqrt(curvature)), how)


def _fitted(found: Identified, joint: int, columns: list[int], phi: Array) -> JointBacklash:
    """Return the backlash that was fitted, or say why none was."""
    model = found.model
    at = {model.features[k].kind: k for k in columns}
    fitted = [kind for kind, k in at.items() if found.solution.free[model.sources_at + k]]
    rows = np.array([model.sources_at + at[kind] for kind in fitted], np.int64)
    value, sigma = float(np.sum(found.solution.x[rows])), float(np.sqrt(found.cov[np.ix_(rows, rows)].sum()))
    if value > SURE * sigma:  # backlash is not negative, and an insignificant value is not reported
        return JointBacklash(joint, value, sigma, " and ".join(_SHOWN_BY[kind] for kind in fitted))
    side = phi[:, at["gravity_backlash"]]
    if np.abs(side).max(initial=0.0) > 0 and min(np.mean(side > 0), np.mean(side < 0)) < BOTH_SIDES:
        how = "not observable: at all these poses gravity holds it on one side, and its backlash is a part of its zero"
    elif "backlash" not in at and not side.any():
        how = "not observable: from which side it came is not known"
    else:
        names = (f"gravity_backlash{joint + 1}", f"backlash{joint + 1}")
        how = found.reasons.get(names[0], found.reasons.get(names[1], "does not show"))
    return JointBacklash(joint, float("nan"), float("nan"), how)
