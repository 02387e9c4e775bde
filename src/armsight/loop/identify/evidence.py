"""How large the causes beyond the table are in this arm: one factor a kind on the prior sigmas, of the greatest evidence.

A servo's wave of half a degree and an industrial arm's of a hundredth need different priors, and hundreds of measurements
tell which. The evidence of a linear model with Gaussian priors is closed (MacKay, "Bayesian interpolation", Neural
Computation 4, 1992); on one linearisation it costs one factorisation of P x P.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from armsight.data import Array
from armsight.loop.identify.fit import Mask, Solution, weighted
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model

#: The kinds whose priors are scaled: what is known of them before differs most from arm to arm.
SCALED = ("gain", "wave", "ripple", "backlash", "slack", "sag")
#: Least and greatest factor: a sharper prior than a hundredth is none, and none is widened.
LEAST, MOST = 0.01, 1.0
#: The factor is itself told by a handful of numbers; it is taken at the upper end of what they allow, where twice the log
#: of the evidence has fallen by so much from its best (one sigma), and this far above the best at least. The other kinds
#: are held at their best meanwhile: the interval is conditional, narrower than the profile's, in which they give way.
FALLEN, WIDER = 1.0, 1.5
_ROUNDED = 1e-12


def scaled_prior(model: Model, start: Solution, measured: Measured, free: Mask, prior: Array) -> Array:
    """Return prior sigmas (P,) with each kind of cause scaled to this arm.

    Args:
        model: the arm with every cause.
        start: a fit to linearise at, with the poses used and the noise.
        measured: the poses.
        free: (P,) what may be off.
        prior: (P,) prior sigmas.
    """
    kinds = [kind for kind in SCALED if any(p.kind == kind and f for p, f in zip(model.parameters, free, strict=True))]
    if not kinds:
        return prior
    of = np.array([kinds.index(p.kind) if p.kind in kinds else -1 for p in model.parameters])
    H, b = _normal(model, start, measured, free, prior)
    flat = ~np.isfinite(prior[free])
    own = np.where(flat, 1.0, prior[free])
    still = _ROUNDED * np.eye(len(own))  # where there is no noise, nothing but rounding holds what cannot be told

    def cost(logs: Array) -> float:
        sigma = own * _factors(of[free], logs)
        D = np.where(flat, 0.0, sigma**-2.0)
        A = H + np.diag(D)
        scale = 1 / np.sqrt(np.diag(A))
        factor = cho_factor(scale[:, None] * A * scale + still, lower=True)
        size = 2 * np.log(np.diag(factor[0])).sum() - 2 * np.log(scale).sum()
        return float(size + 2 * np.log(sigma[~flat]).sum() - b @ (scale * cho_solve(factor, scale * b)))

    best = minimize(cost, np.full(len(kinds), np.log(0.2)), method="Nelder-Mead", options={"xatol": 0.05, "fatol": 0.1})
    return np.asarray(prior * _factors(of, _upper_ends(cost, best.x)))


def _upper_ends(cost: Callable[[Array], float], best: Array) -> Array:
    """Return the logs of the factors at the upper end of what the evidence allows, each with the others at their best."""
    out, allowed = best.copy(), cost(best) + FALLEN
    for k in range(len(best)):
        for log in np.arange(np.log(MOST), max(best[k], np.log(LEAST)), -0.2):
            tried = best.copy()
            tried[k] = log
            if cost(tried) <= allowed:
                out[k] = log
                break
        out[k] = max(out[k], best[k] + np.log(WIDER))
    return out


def _factors(of: Array, logs: Array) -> Array:
    """Return the factor of every parameter; ``of`` is the kind's number, -1 for what is not scaled."""
    return np.where(of < 0, 1.0, np.exp(np.clip(logs, np.log(LEAST), np.log(MOST)))[of])


def _normal(model: Model, start: Solution, measured: Measured, free: Mask, prior: Array) -> tuple[Array, Array]:
    """Return J^T J and J^T e of the free parameters, e being extrapolated to the nominal arm."""
    part = measured.rows(start.used)
    e, J = weighted(model, start.x, part, model.feature_values(part.q, part.approach), start.noise)
    J = J[:, :, free].reshape(-1, int(free.sum()))
    off = np.where(np.isfinite(prior), start.x - model.nominal(), 0.0)[free]
    H = J.T @ J
    return H, J.T @ e.ravel() - H @ off
