"""The variances of sources of error: the most probable ones, which sources there are, and what is not known about them.

Each sigma has an exponential prior whose mean says what the source may do (Simpson et al., Statistical Science 32, 2017).
It is looked for in the logarithm, where a source that no residual shows is not taken for absent. Whether one is taken up is
said by the score of a variance at zero, or by the evidence. What the residuals leave open about the variances is integrated
by draws about the most probable ones, weighted by their probability (importance sampling).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from scipy.special import chdtri, gammaln, ndtri

from armsight.data import Array
from armsight.estimate.linear import Linear
from armsight.estimate.solve import Solved, gradient, solve

#: Sigmas are looked for between these factors of their means before; half and double change nothing that residuals show.
LOW, HIGH = 1e-4, 1e2
#: Step of a log variance for the curvature; its sigma at most, where residuals say nothing; half: sources that hardly
#: show are taken as known, double: draws are spent on the impossible.
STEP, WIDEST = 0.1, 2.0
#: Draws, a power of two, the degrees of freedom of Student's t that they are of, and how many are taken again for all
#: measurements; half: the weights are noisy, double: twice the time.
DRAWS, FREEDOM, AGAIN = 64, 6.0, 12
#: A source is taken up where the score of its variance is above so many sigmas of chance; half: more that are none.
SPEAKS = 1.0


def _cost(logs: Array, linear: Linear, means: Array) -> tuple[float, Array]:
    """Return minus the log posterior of log variances (K,), and its gradient."""
    variances = np.exp(logs)
    s = solve(linear, variances)
    pulled = np.sqrt(variances) / means
    return s.cost + _prior(logs, means), gradient(linear, variances, s) + 0.5 * pulled - 0.5


def _prior(logs: Array, means: Array) -> float:
    return float((np.exp(0.5 * logs) / means - 0.5 * logs + np.log(2 * means)).sum())


def most_probable(
    linear: Linear, means: Mapping[str, float], start: Mapping[str, float] | None = None, steps: int = 60
) -> Array:
    """Return the variances (K,) of the sources, ``means`` being those of their sigmas before any residual."""
    from scipy.optimize import minimize

    of = np.array([means[name] for name in linear.sources])
    begin = np.log([(start or {}).get(name, 0.25 * means[name] ** 2) for name in linear.sources])
    bounds = np.log(of[:, None] ** 2) + 2 * np.log([LOW, HIGH])
    found = minimize(
        _cost,
        np.clip(begin, *bounds.T),
        args=(linear, of),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": steps, "ftol": 1e-6},
    )
    return np.asarray(np.exp(found.x))


def restricted(linear: Linear, start: Array, low: float, high: float) -> Array:
    """Return the variances (K,) of the greatest restricted likelihood, without a prior.

    Args:
        linear: residuals.
        start: (K,) variances to begin at.
        low: the least sigma.
        high: the greatest sigma.
    """
    from scipy.optimize import minimize

    numbers = [linear.e.size] * len(linear.own) + [F.shape[2] for F in linear.shared.values()]
    unit = np.sqrt(2 / np.array(numbers, float))  # about the sigma of a logarithm

    def cost(z: Array) -> tuple[float, Array]:
        variances = np.exp(unit * z)
        s = solve(linear, variances)
        return s.cost, unit * gradient(linear, variances, s)

    bounds = np.outer(1 / unit, 2 * np.log([low, high]))
    begin = np.clip(np.log(np.maximum(start, low**2)) / unit, *bounds.T)
    found = minimize(
        cost,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds.tolist(),
        options={"maxiter": 40, "ftol": 1e-9, "gtol": 0.02},
    )
    return np.asarray(np.exp(unit * found.x))


def posterior(linear: Linear, variances: Array, means: Mapping[str, float]) -> float:
    """Return minus the log posterior of the logarithms of variances (K,)."""
    of = np.array([means[name] for name in linear.sources])
    return solve(linear, variances).cost + _prior(np.log(variances), of)


def scores(linear: Linear, s: Solved, names: Collection[str]) -> dict[str, float]:
    """Return by how many sigmas of chance the residuals speak for shared sources, the variance of each at zero in s."""
    weighted = (s.W @ s.left[..., None])[..., 0]
    WR = s.W @ (s.A @ s.root)
    out = {}
    for name in names:
        F = linear.shared[name]
        across = np.tensordot(F, WR, axes=((0, 1), (0, 1)))
        FPF = np.tensordot(F, s.W @ F, axes=((0, 1), (0, 1))) - across @ across.T
        pull = np.einsum("nmc,nm->c", F, weighted)
        out[name] = float(pull @ pull - np.trace(FPF)) / float(np.sqrt(max(2 * (FPF**2).sum(), 1e-300)))
    return out


def integrate(
    linear: Linear, variances: Array, means: Mapping[str, float], whole: Linear | None = None
) -> tuple[Array, Array, float]:
    """Integrate over the variances, (K,) the most probable ones, ``means`` as in :func:`most_probable`.

    ``linear`` are the measurements that the variances come from, ``whole`` those of the unknowns, by default the same.
    Return the unknowns' step (P,) and covariance (P, P), and the logarithm of the evidence of these sources.
    """
    of = np.array([means[name] for name in linear.sources])
    logs, P, K = np.log(variances), linear.J.shape[2], len(variances)
    slopes = np.array([_cost(logs + d, linear, of)[1] - _cost(logs - d, linear, of)[1] for d in STEP * np.eye(K)])
    values, vectors = np.linalg.eigh((slopes + slopes.T) / (4 * STEP))
    values = np.maximum(values, WIDEST**-2)
    from scipy.stats import qmc  # takes half a second, which most programs never need

    uniform = np.clip(qmc.Sobol(K + 1, seed=0).random(DRAWS), 1e-6, 1 - 1e-6)
    z = ndtri(uniform[:, :K]) * np.sqrt(FREEDOM / chdtri(FREEDOM, uniform[:, K:]))
    drawn = np.clip(logs + (z / np.sqrt(values)) @ vectors.T, *(2 * np.log(of * r) for r in (LOW, HIGH)))
    proposed = 0.5 * float(np.log(values).sum()) - 0.5 * (FREEDOM + K) * np.log1p((z**2).sum(axis=1) / FREEDOM)
    proposed += gammaln((FREEDOM + K) / 2) - gammaln(FREEDOM / 2) - 0.5 * K * np.log(FREEDOM * np.pi)
    gained, steps, covs = np.empty(DRAWS), np.empty((DRAWS, P)), np.empty((DRAWS, P, P))
    for k, one in enumerate(drawn):
        s = solve(linear, np.exp(one))
        gained[k] = -s.cost - _prior(one, of) - proposed[k]
        steps[k], covs[k] = s.x[:P], s.root[:P] @ s.root[:P].T
    weights = np.exp(gained - gained.max())
    evidence = float(np.log(weights.mean()) + gained.max())
    weights = weights / weights.sum()
    if whole is not None:
        at = (np.arange(AGAIN) + 0.5) / AGAIN  # systematic resampling: as many of each draw as its weight says
        rows, counts = np.unique(np.searchsorted(weights.cumsum(), at), return_counts=True)
        weights = counts / AGAIN
        solutions = [solve(whole, np.exp(drawn[k])) for k in rows]
        steps = np.array([s.x[:P] for s in solutions])
        covs = np.array([s.root[:P] @ s.root[:P].T for s in solutions])
    x = weights @ steps
    off = steps - x
    cov = np.einsum("k,kij->ij", weights, covs) + np.einsum("k,ki,kj->ij", weights, off, off)
    return x, cov, evidence
