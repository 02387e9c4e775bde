"""How much play each joint has, put together from all that shows it, or why these poses do not show it.

JointBacklash shows where a joint comes to rest on both of its sides. Friction leaves a joint without weight on the side it came
from (``backlash``), at its stop or a little short of it; weight lays a joint on the side it pulls to (``slack``),
whichever way it came; a joint that neither holds lies anywhere between its stops, and its play is read from how far apart
it was found. A joint that weight holds on one side at all poses shows none: its play is a part of its zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri

from armsight.data import Array
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.joint_noise import by_joints, joint_noise, with_joint_noise
from armsight.loop.identify.measured import Measured

#: A joint lies anywhere in its play where its chance is more than this many times as large as what one pose tells of it,
LOOSE = 2.0
#: and more than this part of what its two sides differ by: evenly anywhere between the stops it would be 0.29.
LOOSE_SHARE = 0.12
#: Of a pose's side: less than this part of the poses on one side are too few to show it.
BOTH_SIDES = 0.02
#: A fitted play of fewer sigmas does not show.
SURE = 3.0


class JointBacklash(NamedTuple):
    """The play of a joint, stop to stop.

    Attributes:
        joint: 0 to 5.
        value_rad: how much; NaN where it cannot be told.
        sigma_rad: its sigma; NaN likewise.
        how: what showed it, or why it does not show.
    """

    joint: int
    value_rad: float
    sigma_rad: float
    how: str


def plays(found: Identified, measured: Measured) -> tuple[JointBacklash, ...]:
    """Return the play of every joint.

    Args:
        found: the identified arm.
        measured: the poses that it was identified from.
    """
    x, model = found.solution.x, found.model
    phi = model.feature_values(measured.q, measured.approach)
    off = None
    if found.joint_sigma_rad.any():
        weighed = with_joint_noise(model, x, measured, found.joint_sigma_rad)
        off = joint_noise(model, found.solution, weighed, measured)
    out = []
    for i in range(6):
        columns = [k for k, f in enumerate(model.features) if f.joint == i and f.kind in ("backlash", "slack")]
        carries = bool(phi[:, [k for k in columns if model.features[k].kind == "slack"]].any())
        fitted = float(np.abs(x[[model.sources_at + k for k in columns]]).max(initial=0.0))
        chance = float(found.joint_sigma_rad[i])
        known = np.inf if off is None else LOOSE * float(np.median(off.sigma_off_rad[:, i]))
        if off is not None and not carries and chance > max(known, LOOSE_SHARE * fitted):
            # What was expected of it is taken back out of where it was found (Kalman's gain), and its own noise stays.
            left = off.sigma_off_rad[:, i] ** 2
            gain = 1 - left / chance**2
            side = phi[:, columns] @ x[[model.sources_at + k for k in columns]]
            noise = left / gain + _by_parameters(found, weighed, i)
            out.append(_between_stops(i, off.off_rad[:, i] / gain + side, np.sqrt(noise)))
        else:
            fit = _fitted(found, i, columns, phi)
            told = 0.0 if off is None else float(np.median(off.sigma_off_rad[:, i]))
            out.append(fit if carries else _to_the_stops(fit, chance, told, _come_from(i, found, measured)))
    return tuple(out)


def _come_from(joint: int, found: Identified, measured: Measured) -> tuple[int, int]:
    """Return how many of the poses used a joint came to from below, and from above."""
    if measured.approach is None:
        return 0, 0
    side = measured.approach[found.solution.used, joint]
    return int((side > 0).sum()), int((side < 0).sum())


def _to_the_stops(play: JointBacklash, chance: float, told: float, sides: tuple[int, int]) -> JointBacklash:
    """Widen the play of a joint that friction holds near its stops, by how far short of them it was found.

    Where a link came to rest scatters, as the shaft goes back a little when it stops and leaves the link behind. A link is
    never beyond its stops, so that at each stop the furthest of the n poses that came to it is nearest to where it is: by
    the expected largest of n normal numbers (Blom, Statistical Estimates and Transformed Beta-Variables, 1958). Only what
    single poses resolve of the scatter is added. What is true may be anything from none to twice of what all of the scatter
    would make.

    Args:
        play: the mean distance between where it was found from its two sides.
        chance: sigma of where it was found from one side, rad.
        told: how well a single pose tells it, rad.
        sides: how many poses came to it from either side; one or none on a side tell nothing of its scatter.
    """
    furthest = sum(float(ndtri((n - 0.375) / (n + 0.25))) for n in sides if n > 1)
    short, most = furthest * float(np.sqrt(max(chance**2 - told**2, 0.0))), furthest * chance
    variance = play.sigma_rad**2 + most**2 / 3 + (most - short) ** 2
    return play._replace(value_rad=play.value_rad + short, sigma_rad=float(np.sqrt(variance)))


def _by_parameters(found: Identified, weighed: Measured, joint: int) -> Array:
    """Return the variance (N,), rad^2, of where a joint stood that comes from the fitted parameters' own.

    What the choice of the model moves is common to the poses, and no scatter of them.
    """
    assert weighed.cov is not None  # for the type checker: a joint's chance is known only with it
    model = found.model
    J = model.linearised(found.solution.x, weighed, model.feature_values(weighed.q, weighed.approach))[1]
    B = by_joints(model, J)[:, :, joint]
    pull = np.linalg.solve(weighed.cov + 1e-18 * np.eye(weighed.size), B[..., None])[..., 0]
    row = np.einsum("nm,nmp->np", pull, J) / np.einsum("nm,nm->n", pull, B)[:, None]
    return np.asarray(np.einsum("np,pq,nq->n", row, found.solution.cov, row))


def _between_stops(joint: int, stood: Array, noise: Array) -> JointBacklash:
    """Read the play of a joint that lies at its stops or anywhere between, by the greatest likelihood.

    Args:
        joint: which.
        stood: (N,) where it stood, rad.
        noise: (N,) sigma of these.
    """

    def cost(at: Array) -> float:
        middle, half, stops = at[0], np.exp(at[1]), 1 / (1 + np.exp(-at[2]))  # the share that lies at a stop
        left, right = (middle - half - stood) / noise, (middle + half - stood) / noise
        between = (ndtr(right) - ndtr(left)) / (2 * half)
        ends = (np.exp(-0.5 * left**2) + np.exp(-0.5 * right**2)) / np.sqrt(2 * np.pi) / (2 * noise)
        return -float(np.log(stops * ends + (1 - stops) * between + 1e-12 / noise).sum())

    extent = float(np.ptp(stood))
    start = np.array([float(np.median(stood)), np.log(extent / 2), 0.0])
    best = minimize(cost, start, method="Nelder-Mead", tol=1e-6)
    half, step = float(np.exp(best.x[1])), 0.02

    def beside(by: float) -> float:
        """Return the least cost with another play, the rest free."""

        def other(v: Array) -> float:
            return cost(np.array([v[0], best.x[1] + by, v[1]]))

        return float(minimize(other, best.x[[0, 2]], method="Nelder-Mead", tol=1e-6).fun)

    around = [beside(-step), beside(step)]
    curve = max((sum(around) - 2 * best.fun) / step**2, 1e-3)
    told = "how far apart it was found, as nothing holds it on one side"
    return JointBacklash(joint, 2 * half, 2 * half / float(np.sqrt(curve)), told)


def _fitted(found: Identified, joint: int, columns: list[int], phi: Array) -> JointBacklash:
    """Read the play from what was fitted, or say why it was not."""
    model, x = found.model, found.solution.x
    at = {model.features[k].kind: k for k in columns}
    fitted = {kind: k for kind, k in at.items() if found.solution.free[model.sources_at + k]}
    rows = np.array([model.sources_at + k for k in fitted.values()], np.int64)
    value = float(np.sum(x[rows]))
    # Play is not negative, and what chance makes of none is none.
    if value > SURE * float(np.sqrt(found.cov[np.ix_(rows, rows)].sum())):
        how = " and ".join(
            {"backlash": "the side it came from", "slack": "the side weight pulls to"}[kind] for kind in fitted
        )
        return JointBacklash(joint, value, float(np.sqrt(found.cov[np.ix_(rows, rows)].sum())), how)
    side = phi[:, at["slack"]]
    if np.abs(side).max(initial=0.0) > 0 and min(np.mean(side > 0), np.mean(side < 0)) < BOTH_SIDES:
        how = "cannot be told: at all these poses weight holds it on one side, and its play is a part of its zero"
    elif "backlash" not in at and not side.any():
        how = "cannot be told: from which side it came is not known"
    else:
        how = found.reasons.get(f"slack{joint + 1}", found.reasons.get(f"backlash{joint + 1}", "does not show"))
    return JointBacklash(joint, float("nan"), float("nan"), how)
