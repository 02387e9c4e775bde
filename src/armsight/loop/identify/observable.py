"""Observability: which parameters the poses can distinguish at all, before anything is fitted.

The columns of the whitened Jacobian are taken one after the other, in order of preference, each orthogonalised against
those kept before it (Gram-Schmidt on the triangle of its QR decomposition, which has the same singular values). A
column of which nothing is left is tied: it cannot be distinguished from the others. One of which too little is left to
beat the prior is
frozen: these poses do not show it. So Hayati's angle is kept where neighbouring axes are parallel, without any setting.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.estimate.solve import whitened
from armsight.loop.identify import model as chain
from armsight.loop.identify.fit import Mask, linear_of, variances_of
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import SHOWN_IN, Model

#: Less than this part of a column left over counts as nothing: rounding leaves 1e-12, the nearest real case 1e-4.
NOTHING = 1e-7
WORTH = 1.0  # a parameter is worth fitting where the data alone would give it a sigma below this many prior sigmas
STILL = 1e-6  # what moves the tool by less than this part of the noise, a prior sigma off, moves nothing at all
_MOVES_NOTHING = "it moves nothing at these poses"
NAMED = 0.02  # a tie names the parameters that contribute at least this part of it
PROBES = 300  # poses over the joints' whole range that reveal which ties no poses can resolve
MAX_POSES = 3000  # poses looked at; more change nothing
#: Kinds that belong to no row of the table.
ERROR_SOURCES = ("gain", "wave", "ripple", "backlash", "gravity_backlash", "compliance")
_PREFERENCE = ("base", "tool", "offset", "a", "alpha", "d", "beta", *ERROR_SOURCES)


class Observed(NamedTuple):
    """What can be fitted."""

    free: Mask  #: (P,) whether a parameter is observable
    #: (P,) what may be off though not all of it is observable: ``free``, what moves the tool too little, and tied
    #: sources
    possible: Mask
    reasons: dict[str, str]  #: name -> why it is not observable, or with what its value is shared
    #: of the Jacobian of the free parameters, each column in units of a prior sigma (base and tool: 1 m, 1 rad)
    singular_values: Array


def observed(
    model: Model, x: Array, measured: Measured, prior: Array, noise: tuple[float, float], *, why: bool = True
) -> Observed:
    """Find which parameters are observable from poses.

    ``x``: (P,) base and tool estimated, the rest nominal. ``prior``: (P,)
    prior sigmas; 0 freezes. ``noise``: sigmas of the instrument. ``why``: whether the reasons are needed.
    """
    T = _triangle(model, x, measured, prior, noise)
    d = np.abs(model.table(x)[:, chain.D])  # of two d the larger one is preferred
    rank = [(_PREFERENCE.index(p.kind), -d[p.joint] * (p.kind == "d")) for p in model.parameters]
    preference = np.array(sorted(range(len(rank)), key=rank.__getitem__))
    kept, ties, weak = _gram_schmidt(T, preference, prior)
    reasons = {model.names[k]: "kept at its nominal value: a prior of zero" for k in np.flatnonzero(prior == 0)}
    if why:
        reasons |= _tie_texts(model, ties, _ties_anywhere(model, x, measured, prior, noise, preference))
    for k, sigma in weak.items():
        scale, unit = SHOWN_IN[model.parameters[k].unit]
        best = f"these poses determine it to {scale * sigma:.2g} {unit} at best, worse than its prior"
        reasons[model.names[k]] = f"kept at its nominal value: {best}"
    free = np.zeros(len(x), bool)
    free[kept] = True
    possible = free.copy()
    possible[[*weak, *(k for k in ties if model.parameters[k].kind in ERROR_SOURCES)]] = True
    return Observed(free, possible, reasons, np.asarray(np.linalg.svd(T[:, free], compute_uv=False)))


def _tie_texts(model: Model, ties: dict[int, list[int]], anywhere: dict[int, list[int]]) -> dict[str, str]:
    """Return name -> what a parameter is tied to, for both sides of each tie."""
    reasons: dict[str, str] = {}
    holds: dict[int, list[str]] = {}
    for k, others in ties.items():
        name, names = model.names[k], ", ".join(model.names[i] for i in others)
        if not others:
            reasons[name] = f"kept at its nominal value: {_MOVES_NOTHING}"
        elif model.parameters[k].kind == "beta":
            verb = "describes" if len(others) == 1 else "together describe"
            reasons[name] = f"not needed: {names} {verb} the same where neighbouring axes are not parallel"
        elif k in anywhere:
            reasons[name] = f"kept at its nominal value: no pose can distinguish it from {names}"
        else:
            reasons[name] = f"kept at its nominal value: these poses do not distinguish it from {names}"
        if model.parameters[k].kind != "beta":
            for i in others:
                holds.setdefault(i, []).append(name)
    return reasons | {
        model.names[i]: f"tied: its value also holds what is off in {', '.join(h)}" for i, h in holds.items()
    }


def _triangle(model: Model, x: Array, measured: Measured, prior: Array, noise: tuple[float, float]) -> Array:
    """Return the triangle (P, P) of the whitened Jacobian, columns in units of the prior sigma."""
    if len(measured) > MAX_POSES:
        measured = measured.rows(np.linspace(0, len(measured) - 1, MAX_POSES).astype(int))
    linear = linear_of(model, x, measured, np.ones(len(x), bool), prior)
    _, J = whitened(linear, variances_of(linear, noise))
    J = J.reshape(-1, len(x)) * np.where(np.isfinite(prior), prior, 1.0)
    rows = max(len(x) - len(J), 0)
    return np.asarray(np.linalg.qr(np.concatenate([J, np.zeros((rows, len(x)))]), mode="r"))


def _gram_schmidt(
    T: Array, preference: Array, prior: Array
) -> tuple[list[int], dict[int, list[int]], dict[int, float]]:
    """Return the parameters kept; those tied, with what; and those too weak, with the sigma they would have."""
    kept: list[int] = []
    ties: dict[int, list[int]] = {}
    weak: dict[int, float] = {}
    Q = np.zeros((len(T), 0))
    for k in preference:
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
    model: Model, x: Array, measured: Measured, prior: Array, noise: tuple[float, float], preference: Array
) -> dict[int, list[int]]:
    """Return the ties that poses over the whole range would not resolve."""
    rng = np.random.default_rng(0)
    q = rng.uniform(np.maximum(model.arm.q_min, -np.pi), np.minimum(model.arm.q_max, np.pi), (PROBES, model.arm.joints))
    approach = rng.choice([-1.0, 1.0], q.shape)
    m = model.motion(x, q, model.feature_values(q, approach))
    p = m.o[:, None] + (m.R @ model.tool_points(x).T).swapaxes(1, 2)
    R = m.R @ model.T_6_body(x)[:3, :3] if measured.R_rig_body is not None else None
    length = None if measured.length_m is None else np.linalg.norm(p[:, 0], axis=1)
    probes = Measured(q, p, R, None, approach, length_m=length)
    _, ties, _ = _gram_schmidt(
        _triangle(model, x, probes, prior, (noise[0] + 1e-4, noise[1] + 1e-4)), preference, prior
    )
    return ties
