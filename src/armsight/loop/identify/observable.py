"""Which parameters the poses can tell apart at all, before anything is fitted.

The columns of the whitened Jacobian are taken one after the other, in the order in which one would like to keep them, each
freed from those kept before it (Gram-Schmidt on the triangle of its QR decomposition, which has the same singular values).
What nothing is left of is tied: it cannot be told from the others. What too little is left of to beat the prior is frozen:
these poses do not show it. So Hayati's angle is kept where neighbouring axes are parallel, without being told.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.identify import model as chain
from armsight.loop.identify.fit import Mask, weighted
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model

#: Less than this part of a column left over counts as nothing: rounding leaves 1e-12, the nearest real case 1e-4.
NOTHING = 1e-7
#: A parameter is worth fitting where the data alone would tell it better than this many prior sigmas.
WORTH = 1.0
#: What moves the tool by less than this part of the noise, a prior sigma off, moves nothing at all.
STILL = 1e-6
_MOVES_NOTHING = "it moves nothing at these poses"
#: A tie names the parameters that take at least this part of it.
NAMED = 0.02
#: Poses over the joints' whole range that tell what no poses can show.
PROBES = 300
#: Poses looked at; more change nothing.
MOST_POSES = 3000
#: Kinds that belong to no row of the table.
ERROR_SOURCES = ("gain", "wave", "ripple", "backlash", "slack", "sag")
_ORDER = ("base", "tool", "offset", "a", "alpha", "d", "beta", *ERROR_SOURCES)


class Observed(NamedTuple):
    """What can be fitted.

    Attributes:
        free: (P,) whether a parameter can be told.
        possible: (P,) what may be off though it cannot all be told: ``free``, what moves the tool too little, and causes
            that are tied to others, which only their priors tell apart.
        reasons: name -> why it cannot, or with what its value is shared.
        singular_values: of the Jacobian of what can, each column in units of a prior sigma (base and tool: 1 m, 1 rad).
    """

    free: Mask
    possible: Mask
    reasons: dict[str, str]
    singular_values: Array


def observed(model: Model, x: Array, measured: Measured, prior: Array, noise: tuple[float, float]) -> Observed:
    """Find what can be told from poses.

    Args:
        model: the arm.
        x: (P,) base and tool in place, the rest nominal.
        measured: the poses.
        prior: (P,) prior sigmas; 0 freezes.
        noise: sigmas of the instrument.
    """
    T = _triangle(model, x, measured, prior, noise)
    order = _order(model, x)
    kept, ties, weak = _gram_schmidt(T, order, prior)
    anywhere = _ties_anywhere(model, x, measured, prior, noise, order)
    reasons = {model.names[k]: "kept at its nominal value: a prior of zero" for k in np.flatnonzero(prior == 0)}
    reasons |= _told(model, ties, anywhere)
    for k, sigma in weak.items():
        unit = model.parameters[k].unit
        told = f"these poses tell it to {sigma:.2g} {unit} at best, worse than it is known before"
        reasons[model.names[k]] = f"kept at its nominal value: {told}"
    free = np.zeros(len(x), bool)
    free[kept] = True
    possible = free.copy()
    possible[[*weak, *(k for k in ties if model.parameters[k].kind in ERROR_SOURCES)]] = True
    return Observed(free, possible, reasons, np.asarray(np.linalg.svd(T[:, free], compute_uv=False)))


def _told(model: Model, ties: dict[int, list[int]], anywhere: dict[int, list[int]]) -> dict[str, str]:
    """Say what is tied to what, on both sides."""
    reasons: dict[str, str] = {}
    holds: dict[int, list[str]] = {}
    for k, others in ties.items():
        name, names = model.names[k], ", ".join(model.names[i] for i in others)
        if not others:
            reasons[name] = f"kept at its nominal value: {_MOVES_NOTHING}"
        elif model.parameters[k].kind == "beta":
            told = "tells" if len(others) == 1 else "together tell"
            reasons[name] = f"not needed: {names} {told} the same where neighbouring axes are not parallel"
        elif k in anywhere:
            reasons[name] = f"kept at its nominal value: no pose can tell it from {names}"
        else:
            reasons[name] = f"kept at its nominal value: these poses do not tell it from {names}"
        if model.parameters[k].kind != "beta":
            for i in others:
                holds.setdefault(i, []).append(name)
    return reasons | {
        model.names[i]: f"tied: its value also holds what is off in {', '.join(h)}" for i, h in holds.items()
    }


def _order(model: Model, x: Array) -> Array:
    """Return the parameters in the order in which one would like to keep them: of two d, the larger one."""
    table = model.table(x)
    rank = []
    for k, p in enumerate(model.parameters):
        size = -abs(table[p.joint, chain.D]) if p.kind == "d" else 0.0
        rank.append((_ORDER.index(p.kind), size, k))
    return np.array([k for _, _, k in sorted(rank)])


def _triangle(model: Model, x: Array, measured: Measured, prior: Array, noise: tuple[float, float]) -> Array:
    """Return the triangle (P, P) of the whitened Jacobian, columns in units of the prior sigma."""
    if len(measured) > MOST_POSES:
        measured = measured.rows(np.linspace(0, len(measured) - 1, MOST_POSES).astype(int))
    phi = model.feature_values(measured.q, measured.approach)
    _, J = weighted(model, x, measured, phi, noise)
    unit = np.where(np.isfinite(prior), prior, 1.0)
    J = J.reshape(-1, len(x)) * unit
    rows = max(len(x) - len(J), 0)
    return np.asarray(np.linalg.qr(np.concatenate([J, np.zeros((rows, len(x)))]), mode="r"))


def _gram_schmidt(T: Array, order: Array, prior: Array) -> tuple[list[int], dict[int, list[int]], dict[int, float]]:
    """Return what is kept, what is tied to what, and what is too weak with the sigma it would have."""
    kept: list[int] = []
    ties: dict[int, list[int]] = {}
    weak: dict[int, float] = {}
    Q = np.zeros((len(T), 0))
    for k in order:
        if prior[k] == 0:
            continue
        column = T[:, k]
        left = column - Q @ (Q.T @ column)
        left -= Q @ (Q.T @ left)
        size, rest = np.linalg.norm(column), np.linalg.norm(left)
        if rest <= NOTHING * size or size < STILL:
            share = (
                np.linalg.lstsq(T[:, kept], column, rcond=None)[0] if kept and size >= STILL else np.zeros(len(kept))
            )
            parts = np.abs(share) * np.linalg.norm(T[:, kept], axis=0)
            ties[int(k)] = [kept[i] for i in np.flatnonzero(parts > NAMED * max(parts.max(initial=0.0), 1e-300))]
        elif np.isfinite(prior[k]) and 1 / rest > WORTH:
            weak[int(k)] = float(prior[k] / rest)
        else:
            kept.append(int(k))
            Q = np.column_stack([Q, left / rest])
    return kept, ties, weak


def _ties_anywhere(
    model: Model, x: Array, measured: Measured, prior: Array, noise: tuple[float, float], order: Array
) -> dict[int, list[int]]:
    """Return the ties that poses over the whole range would not loosen."""
    rng = np.random.default_rng(0)
    q = rng.uniform(np.maximum(model.arm.q_min, -np.pi), np.minimum(model.arm.q_max, np.pi), (PROBES, 6))
    approach = rng.choice([-1.0, 1.0], (PROBES, 6))
    m = model.motion(x, q, model.feature_values(q, approach))
    p = m.o[:, None] + (m.R @ model.tool_points(x).T).swapaxes(1, 2)
    R = m.R @ model.T_6_body(x)[:3, :3] if measured.R_rig_body is not None else None
    probes = Measured(q, p, R, None, approach)
    _, ties, _ = _gram_schmidt(_triangle(model, x, probes, prior, (noise[0] + 1e-4, noise[1] + 1e-4)), order, prior)
    return ties
