"""Forward selection of error sources by cross-validation, and the scale of their priors by evidence.

:func:`scaled_prior` finds how large the error sources beyond the table are in this arm: one factor per kind on the prior
sigmas, that of the greatest evidence. A servo's wave of half a degree and an industrial arm's of a hundredth need different
priors, and hundreds of measurements determine which. The evidence of a linear model with Gaussian priors is closed (MacKay,
"Bayesian interpolation", Neural Computation 4, 1992); on one linearisation it costs one factorisation of P x P.

:func:`forward_selection` starts with base and tool alone, adds one error source at a time as long as that lowers the error
on poses left out by more than chance, and removes again what does not lower it. Where numbers are few, a sensor's curve is
added as a whole, as its harmonics hide each other at few poses; then every harmonic is removed that is not worth its price,
and so is every load of a compliance. The price (PRICE) is on top of held-out errors: of two models that predict alike, the
smaller one stands. Then what the whole curves hid may be added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.linalg import solve_triangular
from scipy.special import stdtr

from armsight.data import Array
from armsight.estimate.change import StateChange, changed, robust
from armsight.estimate.select import Folds, Mask, Removal
from armsight.estimate.solve import condensed, regression, solve, whitened
from armsight.estimate.variance import restricted
from armsight.loop.identify.fit import Solution, by_joints, linear_of, variances_of
from armsight.loop.identify.measured import Measured, visits
from armsight.loop.identify.model import Model

#: The kinds whose priors are scaled: they differ most from arm to arm.
SCALED = ("gain", "wave", "ripple", "backlash", "gravity_backlash", "compliance")
#: Least and greatest factor: a sharper prior than a hundredth is none, and none is widened.
MIN_FACTOR, MAX_FACTOR = 0.01, 1.0
#: The factor is taken where twice the log of the evidence fell by so much from its best, and so far above it at least.
FALLEN, WIDER = 1.0, 1.5


def scaled_prior(model: Model, start: Solution, measured: Measured, free: Mask, prior: Array) -> Array:
    """Return prior sigmas (P,) with each kind of error source scaled to this arm.

    ``start``: a fit to linearise at, with the poses used and the noise. ``free``: (P,) what may be off. ``prior``: (P,)
    prior sigmas.
    """
    kinds = [kind for kind in SCALED if any(p.kind == kind and f for p, f in zip(model.parameters, free, strict=True))]
    if not kinds:
        return prior
    of = np.array([kinds.index(p.kind) if p.kind in kinds else -1 for p in model.parameters])
    linear = linear_of(model, start.x, measured.rows(start.used), free, prior)
    scaled, unit = of[free] >= 0, prior[free]
    shared = {kind: linear.J[:, :, of[free] == k] * unit[of[free] == k] for k, kind in enumerate(kinds)}
    at = np.where(scaled, linear.at, 0.0)  # what is scaled is about zero, at the nominal arm
    rest = (linear.J[:, :, ~scaled], linear.known[~scaled], linear.at[~scaled])
    linear = replace(linear, e=linear.e - linear.J @ at, J=rest[0], known=rest[1], at=rest[2], shared=shared)
    few = condensed(linear, variances_of(linear, start.noise))
    best = restricted(few, np.full(len(kinds), 0.04), MIN_FACTOR, MAX_FACTOR)
    logs = _upper_ends(lambda logs: 2 * solve(few, np.exp(2 * logs)).cost, 0.5 * np.log(best))
    return np.where(of < 0, prior, prior * np.exp(np.minimum(logs, np.log(MAX_FACTOR)))[of])


def _upper_ends(cost: Callable[[Array], float], best: Array) -> Array:
    """Return the logs of the factors at the upper end of what the evidence allows, each with the others at their best."""
    out, allowed = best.copy(), cost(best) + FALLEN
    for k in range(len(best)):
        for log in np.arange(np.log(MAX_FACTOR), max(best[k], np.log(MIN_FACTOR)), -0.2)[::-1]:
            tried = best.copy()
            tried[k] = log
            if cost(tried) > allowed:
                break
            out[k] = log
        out[k] = max(out[k], best[k] + np.log(WIDER))
    return out


#: Folds; each is a random union of clusters of poses, of which there are at most so many, of a few poses each.
FOLDS, CLUSTERS, CLUSTER = 20, 200, 3
#: What a harmonic's or load's coefficient costs in the log of held-out squares; none: chance keeps half as many again.
PRICE = 1.0
#: Chance of lengths that are off in proportion, the share of residuals that a coupling explains, and how large it may be,
#: rad/rad. Half: large scales, or small couplings, are not named; double: ordinary arms are.
PROPORTIONAL, EXPLAINS, LINEAR = 5e-3, 0.3, 0.25
MATTERS = 1e-6  # m, rad; least sigma to assess a coupling by; half, double: it counts for exact data only
PLACEMENT = ("base", "tool")  # the kinds that say where the arm is: base in the rig, tool on the flange
#: A sensor's harmonics make one curve, the links' loads one compliance: they may be added together.
CURVE = ("wave", "ripple")
TOGETHER = (*CURVE, "compliance")
_GROUPS = {"offset": "joint zeros", "d": "lengths", "a": "lengths", "alpha": "axis angles", "beta": "axis angles"}


class SelectionStep(NamedTuple):
    """One step of the forward selection."""

    source: str  #: the error source that was added or, with a minus, removed
    names: tuple[str, ...]  #: its parameters
    rms: float  #: held-out RMS of the weighted residuals after it: the geometric mean over the folds


class Selection(NamedTuple):
    """The parameters selected."""

    free: Mask  #: (P,) the parameters kept
    steps: tuple[SelectionStep, ...]  #: of the selection, in order
    reasons: dict[str, str]  #: name -> why a parameter was not kept


def folds_of(q: Array, folds: int = FOLDS) -> NDArray[np.int64]:
    """Return the fold (N,) of every pose: near poses, and visits of one, are left out together."""
    which = visits(q)
    _, first = np.unique(which, return_index=True)
    k = min(CLUSTERS, len(first) // CLUSTER)
    if k < folds:
        return np.asarray((np.random.default_rng(0).permutation(len(first)) % min(folds, len(first)))[which])
    at = np.concatenate([np.cos(q[first]), np.sin(q[first])], axis=1)
    _, labels = kmeans2(at, k, iter=5, minit="++", seed=np.random.default_rng(0))
    found, labels = np.unique(labels, return_inverse=True)
    return np.asarray((np.random.default_rng(1).permutation(len(found)) % folds)[labels[which]])


def forward_selection(
    model: Model,
    start: Solution,
    measured: Measured,
    free: Mask,
    prior: Array,
    together: Mask,
    progress: Callable[[str], None] = lambda line: None,
) -> Selection:
    """Select error sources, starting from base and tool alone.

    ``model``: the arm with every error source. ``start``: a fit to linearise at, with the poses used and the noise.
    ``free``: (P,) the candidates. ``prior``: (P,) prior sigmas. ``together``: (P,) harmonics
    and loads that may also be added as a whole. ``progress``: called with a line of text after each step.
    """
    part = measured.rows(start.used)
    linear = linear_of(model, start.x, part, np.ones(len(prior), bool), prior)
    folds = Folds.of(linear, variances_of(linear, start.noise), folds_of(part.q))
    groups = _groups(model, free, together)
    kept = free & np.array([p.kind in PLACEMENT for p in model.parameters])
    losses = folds.losses(kept)
    steps = [SelectionStep("base and tool", _named(model, kept), folds.rms(losses))]
    kept = _added(model, folds, groups, kept, steps, progress)
    if together.any():
        kept = _together(model, folds, groups, kept, steps)
    kept, removed = _pruned(model, folds, kept, together, steps)
    if together.any():  # what the whole curves hid may show now
        again = _added(model, folds, groups, kept, steps, progress)
        if (again != kept).any():
            kept, removed_again = _pruned(model, folds, again, together, steps)
            removed |= removed_again
    return Selection(kept, tuple(steps), _reasons(model, folds, kept, groups, removed))


def _added(
    model: Model,
    folds: Folds,
    groups: dict[str, Mask],
    kept: Mask,
    steps: list[SelectionStep],
    progress: Callable[[str], None],
) -> Mask:
    """Add the group that lowers the held-out error most, as long as one lowers it; it leaves ``groups``."""
    losses = folds.losses(kept)
    while groups:
        tried = folds.losses_with(kept, groups)
        improving = [name for name in tried if folds.improves(losses, tried[name])]
        if not improving:
            break
        name = min(improving, key=lambda n: folds.rms(tried[n]))
        added = groups.pop(name)
        kept, losses = kept | added, tried[name]
        steps.append(SelectionStep(name, _named(model, added), folds.rms(losses)))
        progress(f"held-out error {steps[-1].rms / steps[0].rms:.2f} of nominal with {name}")
    return kept


def _together(model: Model, folds: Folds, groups: dict[str, Mask], kept: Mask, steps: list[SelectionStep]) -> Mask:
    """Add all that is left where it lowers the error only together, as two sources that hide each other do."""
    if not groups:
        return kept
    whole: Mask = kept | np.any(list(groups.values()), axis=0)
    losses = folds.losses(whole)
    if not folds.improves(folds.losses(kept), losses):
        return kept
    steps.append(SelectionStep(", ".join(groups), _named(model, whole & ~kept), folds.rms(losses)))
    groups.clear()
    return whole


def _reasons(
    model: Model, folds: Folds, kept: Mask, groups: dict[str, Mask], removed: dict[str, Array]
) -> dict[str, str]:
    """Return name -> why a parameter was not kept."""
    rms = folds.rms(folds.losses(kept))
    reasons: dict[str, str] = {}
    for name, losses in (folds.losses_with(kept, groups) if groups else {}).items():
        why = _not_improving(losses, folds, rms)
        reasons |= {model.names[k]: why for k in np.flatnonzero(groups[name])}
    return reasons | {name: _not_improving(losses, folds, rms) for name, losses in removed.items()}


def _named(model: Model, mask: Mask) -> tuple[str, ...]:
    return tuple(model.names[k] for k in np.flatnonzero(mask))


def _groups(model: Model, free: Mask, together: Mask) -> dict[str, Mask]:
    """Return the error sources that can be added: name -> mask (P,) of its parameters."""
    groups: dict[str, Mask] = {}
    for k, p in enumerate(model.parameters):
        if not free[k] or p.kind in PLACEMENT:
            continue
        name = _GROUPS.get(p.kind, f"{p.kind} of joint {p.joint + 1}")
        if p.kind in CURVE:
            name = f"sensor curve of joint {p.joint + 1}"
            harmonic = p.name.removeprefix(f"{p.kind}{p.joint + 1}_")[3:]  # of "sin12" or "cos2"
            name += "" if together[k] else f", {harmonic} a revolution"
        groups.setdefault(name, np.zeros(len(free), bool))[k] = True
    return groups


def _pruned(
    model: Model, folds: Folds, kept: Mask, together: Mask, steps: list[SelectionStep]
) -> tuple[Mask, dict[str, Array]]:
    """Remove, one at a time, parameters and harmonics without which the held-out error is no worse than their price."""
    removed: dict[str, Array] = {}
    units = _units(model, kept, together)
    now = Removal(folds, kept)
    while True:
        units = [mask for mask in units if (mask & now.kept).any()]
        doubtful = now.doubtful(units)
        if not doubtful:
            return now.kept, removed
        losses, tried = now.losses(), now.losses_without(doubtful)
        rise = [
            folds.score(t) - folds.score(losses) - PRICE * (mask & together).sum()
            for t, mask in zip(tried, doubtful, strict=True)
        ]
        best = int(np.argmin(rise))
        if rise[best] > 0:
            return now.kept, removed
        now.remove(doubtful[best])
        names = _named(model, doubtful[best])
        removed |= dict.fromkeys(names, losses)
        steps.append(SelectionStep(f"-{_common(names)}", names, folds.rms(tried[best])))


def _units(model: Model, kept: Mask, together: Mask) -> list[Mask]:
    """Return what is removed at once: sine and cosine of a harmonic where curves are whole, else single parameters."""
    units: dict[str, Mask] = {}
    for k, p in enumerate(model.parameters):
        if kept[k] and p.kind not in PLACEMENT:
            name = p.name.replace("cos", "sin") if together[k] and p.kind in CURVE else p.name
            units.setdefault(name, np.zeros(len(kept), bool))[k] = True
    return list(units.values())


def _common(names: Sequence[str]) -> str:
    """Return the name of one parameter, or of a harmonic's two."""
    return names[0] if len(names) == 1 else f"{names[0].split('_')[0]}_{names[0].split('_')[1][3:]}"


def _not_improving(losses_with: Array, folds: Folds, rms: float) -> str:
    change = folds.rms(losses_with) / rms - 1
    text = f"falls by {-100 * change:.2g} %, no more than chance" if change < 0 else f"rises by {100 * change:.2g} %"
    text = text if abs(change) > 1e-6 else "stays as it is"
    return f"not selected: with it the held-out error {text}"


def change_at(
    model: Model, x: Array, measured: Measured, free: Mask, prior: Array, noise: tuple[float, float]
) -> StateChange | None:
    """Return how the arm's state changed, in the order of the rows; its unknowns are all parameters (P,).

    ``free``: (P,) what may be off. ``noise``: beyond the covariance given.
    """
    linear = linear_of(model, x, measured, free, prior)
    e, J = robust(*whitened(linear, variances_of(linear, noise)))
    column, ways = np.cumsum(free) - 1, dict[str, list[int]]()
    for k in np.flatnonzero(free):
        p = model.parameters[k]
        if p.kind in (*PLACEMENT, "offset"):
            ways.setdefault(p.kind if p.kind in PLACEMENT else p.name, []).append(int(column[k]))
    named = {name: np.array(columns) for name, columns in ways.items()}
    found = changed(-e, J, named, measured.q, known=linear.known, at=linear.at)
    return None if found is None else found.over_all(free)


def lacking(
    model: Model, x: Array, measured: Measured, free: Mask, prior: Array, noise: tuple[float, float]
) -> tuple[str, ...]:
    """Return what else would explain a fit far better: all lengths by one factor, or a joint that moves with another.

    Arguments as of :func:`change_at`. The residuals' score says by how much any reading, times a number, moves a joint.
    """
    found = list[str]()
    lengths = np.array([p.kind in ("a", "d") for p in model.parameters]) & free & (abs(model.nominal()) > 1e-3)
    nominal = model.nominal()[lengths]
    if len(nominal) > 2:
        (scale,), (sigma,) = regression(nominal[:, None], x[lengths] - nominal, None)
        if 2 * stdtr(len(nominal) - 1, -abs(scale) / max(sigma, 1e-12)) < PROPORTIONAL:
            found.append(
                f"all lengths come out {100 * scale:+.2g} % off, in proportion: is it the instrument's scale, such as the "
                "square size of its calibration?"
            )
    linear = linear_of(model, x, measured, np.ones(len(x), bool), prior)
    e, J = robust(*whitened(linear, variances_of(linear, (max(noise[0], MATTERS), max(noise[1], MATTERS)))))
    by = (by_joints(model, J)[..., None] * (measured.q - measured.q.mean(axis=0))[:, None, None]).reshape(e.size, -1)
    rows, known = J[:, :, free].reshape(e.size, -1), linear.known[free]
    beside = np.column_stack([rows.T @ by, rows.T @ e.ravel() + known * linear.at[free]])
    slope = solve_triangular(np.linalg.cholesky(rows.T @ rows + np.diag(known)), beside, lower=True)
    squares = np.maximum((by**2).sum(axis=0) - (slope[:, :-1] ** 2).sum(axis=0), 1e-9 * (by**2).sum(axis=0)) + 1e-300
    pull = (slope[:, -1] @ slope[:, :-1] - e.ravel() @ by) / squares
    k = int(np.argmax(pull**2 * squares * (abs(pull) < LINEAR)))
    i, j = divmod(k, model.arm.joints)
    # of few numbers chance explains much, and of residuals far below the sigmas all is chance
    if pull[k] ** 2 * squares[k] > max(max(EXPLAINS, 30 / e.size) * (e**2).sum(), 30.0):
        of = "its own reading" if i == j else f"the reading of joint {j + 1}"
        part = pull[k] * model.arm.direction[i]  # as of the arm's coupling
        found.append(f"joint {i + 1} seems to move by {part:+.3g} of {of} beside the model: is it coupled, or geared?")
    return tuple(found)


def change_text(model: Model, change: StateChange) -> str:
    """Return what changed, by how much."""
    step = change.step[[k for k, p in enumerate(model.parameters) if change.way in (p.kind, p.name)]]
    if change.way not in PLACEMENT:
        joint = change.way.removeprefix("offset")
        said = f"the zero of joint {joint} changed by {np.degrees(step[0]):+.2f} deg (it slipped, or lost steps)"
        return said + (", or the base was rotated" if joint == "1" else "")
    whose = "the base, or the instrument," if change.way == "base" else "the tool, or what is seen of it,"
    points = step[:3] if model.full or change.way == "base" else step  # of several points the largest shift
    mm = 1e3 * np.linalg.norm(points.reshape(-1, 3), axis=1).max()
    size = f"{mm:.{1 if mm >= 1 else 3}f} mm"
    size += f" and {np.degrees(np.linalg.norm(step[3:])):.3f} deg" if model.full or change.way == "base" else ""
    return f"{whose} was displaced by {size}"


def changed_from(model: Model, change: StateChange, first: str) -> str:
    """Return a note of a change from a pose on, by its name or number."""
    unsure = "" if change.sure else ", or the model lacks what depends on the pose"
    return (
        f"from {first} on the poses are of another state: {change_text(model, change)}{unsure}; the arm is of neither, "
        "and its sigmas allow for that"
    )
