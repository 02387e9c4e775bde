"""Least-squares fit of an arm's parameters to measured poses, with priors, outlier rejection and sigmas.

Gauss-Newton (:mod:`armsight.estimate.solve`). Where the instrument's covariance is given, what the residuals show beyond it
(the arm's repeatability, what the model does not know) is estimated by restricted likelihood and added: one sigma of
position, one of rotation. A pose further from the model than chance allows is left out; the median sets the scale for that.
What a pose's own covariance explains is never left out.

Scatter of the joints from pose to pose (backlash that nothing holds on one side, jitter; :func:`joint_noise`): what the
residuals show beyond the instrument's covariance is attributed to the joints, each of which moves the body along its own
column of the Jacobian, so that a joint that lies anywhere in its backlash affects nothing but its own direction.

The prior sigmas say how far each number can plausibly be off before anything is measured, in its own unit. Those of the
table: what cheap arms are made to and published identifications of them find (some mm, a degree). Those of the error
sources: a conductive-plastic potentiometer's data sheet (linearity 0.5 to 1 %, of which a part is scale), gears of hobby
servos (backlash up to a degree), and compliance that lets a joint droop half a degree under the gravity load of a link of
0.25 m. A prior pulls at most as strongly as one measurement of that sigma; with tens of poses the data override it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.estimate.linear import Linear
from armsight.estimate.solve import Solved, by_chance, covariances, solve, whitened
from armsight.estimate.variance import restricted
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import COLUMNS, OFFSET, Model

#: Kind of parameter -> prior sigma of its deviation from nominal, m, rad or its own unit; base and tool have no prior.
SIGMA: dict[str, float] = {
    "base": np.inf,
    "tool": np.inf,
    "offset": np.deg2rad(3.0),
    "d": 0.01,
    "a": 0.01,
    "alpha": np.deg2rad(2.0),
    "beta": np.deg2rad(2.0),
    "gain": 0.01,
    "wave": np.deg2rad(0.5),
    "ripple": np.deg2rad(0.1),
    "backlash": np.deg2rad(1.0),
    "gravity_backlash": np.deg2rad(1.0),
    "compliance": np.deg2rad(0.5) / 0.25,
}


def prior_sigma(model: Model, named: Mapping[str, float] | None = None) -> Array:
    """Return the prior sigma (P,) of every parameter.

    ``named``: sigma by name of a parameter ("a2") or a kind ("alpha"), instead of those of SIGMA; 0 keeps it as it is.

    Raises:
        InputError: an unknown name, or a sigma below zero.
    """
    named = named or {}
    known = {*SIGMA, *model.names}
    for name, sigma in named.items():
        if name not in known:
            raise InputError(
                f"prior of {name!r}: no such parameter; kinds are {', '.join(SIGMA)}; names are such as a2"
            )
        if not sigma >= 0:
            raise InputError(f"prior of {name!r}: sigma is {sigma}; it must be 0 or more")
    return np.array([named.get(p.name, named.get(p.kind, SIGMA[p.kind])) for p in model.parameters])


Mask = NDArray[np.bool_]
CHANCE = 1e-7  # a pose whose residual has a smaller chance than this is taken for a mistake
STEPS, SMALL_STEP = 25, 1e-3  # Gauss-Newton steps at most; it stops when no step is more than this part of a sigma
ROUNDS = 6  # rounds of leaving out gross errors and estimating the noise
#: Where a fit has left less than this part of the residuals' degrees of freedom, they do not determine their noise.
MIN_FREEDOM = 0.1
#: Noise below this, m or rad, is none: what rounding of a printed file leaves; and above this it is no noise.
MIN_NOISE, MAX_NOISE = 1e-9, 1e3


@dataclass(frozen=True, eq=False)
class Solution(Record):
    """A fitted model."""

    x: Array  #: (P,) the vector
    free: Mask  #: (P,) which of its numbers were fitted
    cov: Array  #: (P, P) their covariance; zero where not fitted
    #: sigma, beyond the covariance given, of the position along one axis, m, and of the rotation about one, rad
    noise: tuple[float, float]
    used: Mask  #: (N,) whether a pose was used
    history: tuple[float, ...]  #: RMS of the weighted residuals after every step

    def sigma(self) -> Array:
        """Return the sigma (P,) of every parameter."""
        return np.sqrt(np.diag(self.cov))


def linear_of(model: Model, x: Array, measured: Measured, free: Mask, prior: Array, phi: Array | None = None) -> Linear:
    """Return the residuals of poses near a vector by the free parameters, with noise of position and of rotation.

    ``x``: (P,) the vector. ``free``: (P,) what may be off. ``prior``: (P,) sigma about the nominal arm's values; infinite
    where nothing is known. ``phi``: :meth:`Model.feature_values` of the poses, where they are known already.
    """
    e, J = model.linearised(x, measured, phi)
    each = np.broadcast_to(np.eye(measured.size), (len(e), measured.size, measured.size))
    own = {"position": each} if measured.R_rig_body is None else {"position": each[..., :3], "rotation": each[..., 3:]}
    given = np.zeros_like(each) if measured.cov is None else measured.cov
    known = np.where(np.isfinite(prior) & (prior > 0), prior, np.inf) ** -2.0
    at = np.where(np.isfinite(prior), x - model.nominal(), 0.0)
    return Linear(e, J[:, :, free], given, own, {}, known[free], at[free])


def variances_of(linear: Linear, noise: tuple[float, float]) -> Array:
    """Return the variances of the sources of noise."""
    return np.square(noise[: len(linear.own)])


def fit(
    model: Model,
    x: Array,
    measured: Measured,
    free: Mask,
    prior: Array,
    *,
    used: Mask | None = None,
    noise: tuple[float, float] | None = None,
) -> Solution:
    """Fit the free parameters.

    ``x``: (P,) start. ``free``: (P,) what to fit; the rest stays as in ``x``. ``prior``: (P,) sigma about the nominal
    arm's values; infinite where nothing is known. ``used``: (N,) poses to use; None: outliers are found and left out.
    ``noise``: to start from; None: from the residuals at the start.
    """
    phi = model.feature_values(measured.q, measured.approach)
    noise = robust_noise(model.residuals(x, measured, phi)) if noise is None else noise
    keep = _sane(model, x, measured, phi, noise) if used is None else used
    history: list[float] = []

    def newton(x: Array, noise: tuple[float, float]) -> tuple[Array, Linear, Solved]:
        """Return the best vector, and the residuals and the solution before the last step to it."""
        part = measured.rows(keep)
        for _ in range(STEPS):
            linear = linear_of(model, x, part, free, prior, phi[keep])
            s = solve(linear, variances_of(linear, noise))
            x = x.copy()
            x[free] += s.x
            history.append(float(np.sqrt(np.einsum("ni,nij,nj->", linear.e, s.W, linear.e) / linear.e.size)))
            if (np.abs(s.x) < SMALL_STEP * np.linalg.norm(s.root, axis=1)).all():
                break
        return x, linear, s

    for _ in range(ROUNDS):
        x, linear, s = newton(x, noise)
        before = noise
        taken = len(s.x) - float(linear.known @ (s.root**2).sum(axis=1))  # parameters, less what priors determine
        if linear.e.size - taken >= MIN_FREEDOM * linear.e.size:
            # What is not there shrinks; from far below the residuals nothing would grow.
            start = np.fmax(noise, robust_noise(linear.e))
            sigmas = np.sqrt(restricted(linear, np.square(start[: len(linear.own)]), MIN_NOISE, MAX_NOISE))
            noise = (float(sigmas[0]), float(sigmas[1]) if len(sigmas) > 1 else 0.0)
        kept, keep = keep, (_sane(model, x, measured, phi, noise) if used is None else keep)
        if (kept == keep).all() and np.allclose(before, noise, rtol=1e-2, atol=MIN_NOISE):
            break
    x, _, s = newton(x, noise)
    return Solution(x, free, _spread(s, free), noise, keep, tuple(history))


def covariance(model: Model, s: Solution, measured: Measured, free: Mask, prior: Array) -> Array:
    """Return the covariance (P, P) of the free parameters at a solution, with its noise; zero for the others."""
    part = measured.rows(s.used)
    linear = linear_of(model, s.x, part, free, prior)
    return _spread(solve(linear, variances_of(linear, s.noise)), free)


def _spread(s: Solved, free: Mask) -> Array:
    """Return the covariance (P, P) of all parameters; zero for those that are not free."""
    cov = np.zeros((len(free), len(free)))
    cov[np.ix_(free, free)] = s.root @ s.root.T
    return cov


def robust_noise(e: Array) -> tuple[float, float]:
    """Return sigmas along one axis from median residuals."""
    if e.shape[1] == 1:
        return max(float(np.median(np.abs(e)) / np.sqrt(chdtri(1, 0.5))), MIN_NOISE), MIN_NOISE
    middle = np.sqrt(chdtri(3, 0.5))
    positions = e[:, :3] if e.shape[1] == 6 else e.reshape(-1, 3)
    angle = float(np.median(np.linalg.norm(e[:, 3:], axis=1)) / middle) if e.shape[1] == 6 else 0.0
    return max(float(np.median(np.linalg.norm(positions, axis=1)) / middle), MIN_NOISE), max(angle, MIN_NOISE)


def _sane(model: Model, x: Array, measured: Measured, phi: Array, noise: tuple[float, float]) -> Mask:
    """Return which poses (N,) are no outliers: by the scale of the median, or as their own covariance explains them."""
    linear = linear_of(model, x, measured, np.zeros(len(x), bool), np.full(len(x), np.inf), phi)
    variances = variances_of(linear, noise)
    far, given = ((whitened(linear, v)[0] ** 2).sum(axis=1) for v in (variances, 0.0 * variances))
    return np.asarray(by_chance(far, measured.size, CHANCE) | (given <= chdtri(measured.size, CHANCE)))


START_RAD, START_M = 1e-3, 1e-4  # where the search starts, rad and m: what is not there shrinks from it


class JointNoise(NamedTuple):
    """What is off by chance."""

    sigma_rad: Array  #: (n,) of each joint
    off_rad: Array  #: (N, n) by how much each joint was off at each pose, as far as the residuals show it
    sigma_off_rad: Array  #: (N, n) their sigmas


def joint_noise(model: Model, solution: Solution, prior: Array, measured: Measured) -> JointNoise:
    """Attribute residuals beyond the instrument's covariance to the joints.

    ``solution``: a fit of it. ``prior``: (P,) the prior sigmas of that fit.
    """
    phi = model.feature_values(measured.q, measured.approach)
    with_sides = with_joint_noise(model, solution.x, measured, np.zeros(model.arm.joints))
    linear = linear_of(model, solution.x, with_sides, solution.free, prior, phi)
    B = by_joints(model, model.linearised(solution.x, measured, phi)[1])
    joints = {f"joint {i + 1}": B[:, :, [i]] for i in range(model.arm.joints)}
    linear = replace(linear, own=joints | linear.own)
    start = np.array([START_RAD] * len(joints) + [START_M, START_RAD][: len(linear.own) - len(joints)]) ** 2
    variances = restricted(linear.rows(np.flatnonzero(solution.used)), start, MIN_NOISE, MAX_NOISE)
    of = variances[: len(joints)]
    gain = of[:, None] * B.swapaxes(1, 2) @ np.linalg.inv(covariances(linear, variances))
    spread = np.maximum(of - np.einsum("nkm,nmk->nk", gain, B * of), 0.0)
    return JointNoise(np.sqrt(of), (gain @ linear.e[..., None])[..., 0], np.sqrt(spread))


def with_joint_noise(model: Model, x: Array, measured: Measured, sigma_rad: Array) -> Measured:
    """Return the poses with the joints' scatter added to their covariance.

    Also the uncertainty on which side of its backlash a joint lies where gravity and friction are about as strong.
    """
    if measured.cov is None:
        return measured
    phi = model.feature_values(measured.q, measured.approach)
    variance = np.tile(sigma_rad**2, (len(phi), 1))
    for k, f in enumerate(model.features):  # of a side of +-1 it is 1 - mean^2, whatever closes the backlash
        if f.kind in ("backlash", "gravity_backlash"):
            half = 0.5 * x[model.sources_at + k]
            variance[:, f.joint] += half**2 * (1 - (2 * phi[:, k]) ** 2) * phi[:, k].any()
    if not variance.any():
        return measured
    B = by_joints(model, model.linearised(x, measured, phi)[1]) * np.sqrt(variance)[:, None]
    return replace(measured, cov=measured.cov + B @ B.swapaxes(1, 2))


def by_joints(model: Model, J: Array) -> Array:
    """Return the derivative (N, M, n) by the joints' angles, from that by all parameters (N, M, P)."""
    return np.asarray(J[:, :, model.table_at + OFFSET : model.sources_at : len(COLUMNS)])
