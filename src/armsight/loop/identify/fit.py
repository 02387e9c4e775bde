"""Least-squares fit of an arm's parameters to measured poses, with priors, outlier rejection and sigmas.

Gauss-Newton on whitened residuals, with the priors as further measurements. Where the instrument's covariance is given,
what the residuals show beyond it (the arm's repeatability, what the model does not know) is estimated and added: one
sigma of position, one of rotation. A pose further from the model than chance allows is left out; the median sets the
scale for that.

The prior sigmas say how far each number can plausibly be off before anything is measured, in its own unit. Those of the
table: what cheap arms are made to and published identifications of them find (some mm, a degree). Those of the error
sources: a conductive-plastic potentiometer's data sheet (linearity 0.5 to 1 %, of which a part is scale), gears of hobby
servos (backlash up to a degree), and compliance that lets a joint droop half a degree under the gravity load of a link of
0.25 m. A prior pulls at most as strongly as one measurement of that sigma; with tens of poses the data override it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import brentq
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model

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

    Args:
        model: the arm with its parameters.
        named: sigma by name of a parameter ("a2") or a kind ("alpha"), instead of those of SIGMA; 0 keeps it as it is.

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
#: A pose whose residual has a smaller chance than this is taken for a mistake.
CHANCE = 1e-7
#: Gauss-Newton steps at most; it stops when no step is more than this part of a sigma.
STEPS, SMALL_STEP = 25, 1e-3
#: Rounds of leaving out gross errors and estimating the noise.
ROUNDS = 6
#: Where a fit has left less than this part of the residuals' degrees of freedom, they do not determine their noise.
MIN_FREEDOM = 0.1
#: Added to a normal matrix of unit diagonal, so that rounding leaves it positive: far below what the data determine.
ROUNDING = 1e-12
#: Noise below this, m or rad, is none: what rounding of a printed file leaves.
MIN_NOISE = 1e-9


@dataclass(frozen=True, eq=False)
class Solution(Record):
    """A fitted model.

    Attributes:
        x: (P,) the vector.
        free: (P,) which of its numbers were fitted.
        cov: (P, P) their covariance; zero where not fitted.
        noise: sigma, beyond the covariance given, of the position along one axis, m, and of the rotation about
            one, rad.
        used: (N,) whether a pose was used.
        history: RMS of the weighted residuals after every step.
    """

    x: Array
    free: Mask
    cov: Array
    noise: tuple[float, float]
    used: Mask
    history: tuple[float, ...]

    def sigma(self) -> Array:
        """Return the sigma (P,) of every parameter."""
        return np.sqrt(np.diag(self.cov))


def noise_cov(measured: Measured, noise: tuple[float, float]) -> Array:
    """Return the covariance (N, M, M) of residuals."""
    variances = np.full(measured.size, noise[0] ** 2)
    if measured.R_rig_body is not None:
        variances[3:] = noise[1] ** 2
    base = np.zeros((len(measured), measured.size, measured.size)) if measured.cov is None else measured.cov
    return np.asarray(base + np.diag(variances))


def whitener(measured: Measured, noise: tuple[float, float]) -> Array:
    """Return W (N, M, M) or, where all poses are alike, (M, M), with W^T W the inverse covariance."""
    if measured.cov is None:
        return np.diag(1 / np.sqrt(np.diag(noise_cov(measured.rows(np.arange(1)), noise)[0])))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(noise_cov(measured, noise))))


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

    Args:
        model: the arm.
        x: (P,) start.
        measured: the poses.
        free: (P,) what to fit; the rest stays as in ``x``.
        prior: (P,) sigma about the nominal arm's values; infinite where nothing is known.
        used: (N,) poses to use; None: outliers are found and left out.
        noise: to start from; None: from the residuals at the start.
    """
    phi = model.feature_values(measured.q, measured.approach)
    keep = np.ones(len(measured), bool) if used is None else used
    noise = _robust_noise(model.residuals(x, measured, phi)) if noise is None else noise
    history: list[float] = []
    for _ in range(ROUNDS):
        part, part_phi = measured.rows(keep), phi[keep]
        x, H = _newton(model, x, part, part_phi, free, prior, noise, history)
        e = model.residuals(x, measured, phi)
        taken, before = _taken(H, free, prior), noise
        if e[keep].size - taken >= MIN_FREEDOM * e[keep].size:
            noise = _noise(part, e[keep], taken)
        kept, keep = keep, (_sane(measured, e, noise) if used is None else keep)
        if (kept == keep).all() and np.allclose(before, noise, rtol=1e-2, atol=MIN_NOISE):
            break
    part = measured.rows(keep)
    x, H = _newton(model, x, part, phi[keep], free, prior, noise, history)
    cov = np.zeros((len(x), len(x)))
    cov[np.ix_(free, free)] = np.linalg.inv(H)
    return Solution(x, free, cov, noise, keep, tuple(history))


def weighted(model: Model, x: Array, measured: Measured, phi: Array, noise: tuple[float, float]) -> tuple[Array, Array]:
    """Return whitened residuals (N, M) and their derivative (N, M, P)."""
    e, J = model.linearised(x, measured, phi)
    W = whitener(measured, noise)
    return (W @ e[..., None])[..., 0], W @ J


def covariance(
    model: Model,
    x: Array,
    measured: Measured,
    phi: Array,
    free: Mask,
    prior: Array,
    noise: tuple[float, float],
) -> Array:
    """Return the covariance (P, P) of the free parameters at a vector; zero for the others."""
    _, J = _free(model, x, measured, phi, free, noise)
    cov = np.zeros((len(x), len(x)))
    cov[np.ix_(free, free)] = np.linalg.inv(J.T @ J + np.diag(_pull(prior, free)))
    return cov


def _free(
    model: Model, x: Array, measured: Measured, phi: Array, free: Mask, noise: tuple[float, float]
) -> tuple[Array, Array]:
    """Return whitened residuals (N M,) and their derivative (N M, F) by the free parameters."""
    e, J = weighted(model, x, measured, phi, noise)
    return e.ravel(), J[:, :, free].reshape(-1, int(free.sum()))


def _pull(prior: Array, free: Mask) -> Array:
    """Return the information (F,) that the priors of the free parameters add."""
    return np.asarray(np.where(np.isfinite(prior) & (prior > 0), prior, np.inf)[free] ** -2.0)


def _newton(
    model: Model,
    x: Array,
    measured: Measured,
    phi: Array,
    free: Mask,
    prior: Array,
    noise: tuple[float, float],
    history: list[float],
) -> tuple[Array, Array]:
    """Return the best vector, and the information (F, F) about its free parameters."""
    nominal, pull = _nominal(model, x, prior), _pull(prior, free)
    for _ in range(STEPS):
        e, J = _free(model, x, measured, phi, free, noise)
        H, g = J.T @ J + np.diag(pull), J.T @ e + pull * (x - nominal)[free]
        scale = 1 / np.sqrt(np.diag(H))
        factor = cho_factor(scale[:, None] * H * scale + ROUNDING * np.eye(len(H)))
        step = scale * cho_solve(factor, scale * g)
        x = x.copy()
        x[free] -= step
        history.append(float(np.sqrt(np.mean(e**2))))
        if np.abs(step / scale).max(initial=0.0) < SMALL_STEP:
            break
    return x, H


def _nominal(model: Model, x: Array, prior: Array) -> Array:
    """Return what the priors pull towards: the nominal arm; base and tool are not pulled."""
    return np.where(np.isfinite(prior), model.nominal(), x)


def _taken(H: Array, free: Mask, prior: Array) -> float:
    """Return how many measurements' freedom the fit has taken: parameters, less the share that priors determine."""
    p = prior[free]
    return float(len(H) - np.sum(np.diag(np.linalg.inv(H)) / np.where(p > 0, p, np.inf) ** 2))


def _robust_noise(e: Array) -> tuple[float, float]:
    """Return sigmas along one axis from median residuals."""
    middle = np.sqrt(chdtri(3, 0.5))
    positions = e[:, :3] if e.shape[1] == 6 else e.reshape(-1, 3)
    angle = float(np.median(np.linalg.norm(e[:, 3:], axis=1)) / middle) if e.shape[1] == 6 else 0.0
    return max(float(np.median(np.linalg.norm(positions, axis=1)) / middle), MIN_NOISE), max(angle, MIN_NOISE)


def _noise(measured: Measured, e: Array, taken: float) -> tuple[float, float]:
    """Return the sigmas that make the weighted squares as large as their number allows."""
    share = max(1 - taken / e.size, 0.5 / len(e))
    if measured.R_rig_body is None:
        return _extra(e, measured.cov, share), 0.0
    covs = (None, None) if measured.cov is None else (measured.cov[:, :3, :3], measured.cov[:, 3:, 3:])
    return _extra(e[:, :3], covs[0], share), _extra(e[:, 3:], covs[1], share)


def _extra(e: Array, cov: Array | None, share: float) -> float:
    """Return sigma with sum e^T (cov + sigma^2)^-1 e = share x their number; the least where cov is already enough."""
    whole = float(np.sqrt(np.mean(e**2) / share))
    if cov is None:
        return max(whole, MIN_NOISE)
    values, vectors = np.linalg.eigh(cov)
    squares = np.einsum("nji,nj->ni", vectors, e) ** 2

    def over(sigma: float) -> float:
        return float((squares / (np.maximum(values, 0) + sigma**2)).sum() - share * e.size)

    if over(MIN_NOISE) <= 0 or whole <= MIN_NOISE:
        return MIN_NOISE
    return float(brentq(over, MIN_NOISE, whole * 1.01))


def squares(measured: Measured, e: Array, noise: tuple[float, float]) -> Array:
    """Return the squared Mahalanobis lengths (N,) of residuals."""
    return np.asarray((((whitener(measured, noise) @ e[..., None])[..., 0]) ** 2).sum(axis=1))


def _sane(measured: Measured, e: Array, noise: tuple[float, float]) -> Mask:
    """Return which poses (N,) are no outliers, by the scale of the median."""
    far = squares(measured, e, noise)
    scale = max(float(np.median(far)) / chdtri(measured.size, 0.5), 1e-300)
    return np.asarray(far / scale < chdtri(measured.size, CHANCE))
