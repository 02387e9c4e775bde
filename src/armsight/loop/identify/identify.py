"""Identify an arm: every parameter of it with its sigma.

In: the nominal arm and :class:`Measured`. Out: :class:`Identified`. The steps: check that the poses are of this arm;
estimate base and tool; find which parameters are observable; fit the table; select the error sources by the error on
poses left out (forward selection); run the final fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError, nearest
from armsight.estimate.change import StateChange
from armsight.geometry.pose import left_jacobian
from armsight.loop.handeye.poses import HeldOut
from armsight.loop.identify.fit import (
    Mask,
    Solution,
    by_joints,
    covariance,
    fit,
    joint_noise,
    prior_sigma,
    with_joint_noise,
)
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.misread import check_plausible, without_tool
from armsight.loop.identify.model import PLENTY, SENSOR, SHOWN_IN, Model, Parameter
from armsight.loop.identify.observable import Observed, observed
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.selection import PLACEMENT, TOGETHER, SelectionStep, forward_selection, scaled_prior
from armsight.plots import new_figure
from armsight.robot.arm_file import undetermined
from armsight.robot.kinematics.arm import Arm

MIN_POSES = 6  # fewest poses: what base and tool need, with some to spare
ALIKE = 0.02  # joints that move less than this, rad, do not move
MAX_SELECTION_POSES = 4000  # most poses that the error sources are selected on; the final fit is to all of them
ROUNDS = 3  # rounds of fitting everything and attributing what is left to the joints
POSES = 300  # over which the tool's displacement is averaged; half, double: its sigma is 4%, 2% uncertain
CORRELATED = 0.9  # correlations larger than this are reported
_TABLE = ("offset", "d", "a", "alpha", "beta")


class Validation(NamedTuple):
    """Nominal and identified arm on one set of poses."""

    nominal: HeldOut  #: errors of the nominal arm, its base and tool fitted to the same poses as the identified one's
    identified: HeldOut  #: errors of the identified arm
    placement_refitted: bool  #: whether base and tool were fitted to these very poses
    residual_over_predicted: float  #: RMS residual over the predicted sigma; 1 where the sigmas are honest

    def gain(self) -> tuple[float, float]:
        """Return by how much less the identified arm is off, mean over the poses, and its standard error, m."""
        gained = (self.nominal.position_m - self.identified.position_m).mean(axis=1)
        return float(gained.mean()), float(np.std(gained, ddof=1) / np.sqrt(len(gained))) if len(gained) > 1 else np.inf

    def __repr__(self) -> str:
        """Return the mean errors of both arms, mm, and whether the sigmas are honest."""
        mean, nominal = (1e3 * each.mean()[0] for each in (self.identified, self.nominal))
        return (
            f"Validation({len(self.identified.position_m)} poses: {mean:.3f} mm mean, nominal arm {nominal:.3f} mm; "
            f"residual over sigma {self.residual_over_predicted:.2f})"
        )


class LeftOut(NamedTuple):
    """How an identified arm does on poses that it was not fitted to."""

    validation: Validation  #: nominal and identified arm on those
    q: Array  #: (H, n) their joint angles, rad
    how: str  #: which poses those are, as text
    scale: float = 1.0  #: by how much their residuals made all sigmas larger; 1 where chance explains them

    def __repr__(self) -> str:
        """Return the errors, and on which poses."""
        return f"LeftOut({self.validation!r}, {self.how})"


@dataclass(frozen=True, eq=False)
class Identified(Record):
    """An identified arm: every number of its table, base and tool, and the error sources that lower the held-out error.

    Attributes:
        model: the nominal arm with every parameter.
        nominal: (P,) base and tool fitted, the rest nominal.
        solution: the fit.
        reasons: name -> why a parameter is not fitted, or what its value shares.
        steps: of the forward selection.
        singular_values: of the Jacobian of the observable parameters, in units of prior sigmas.
        prior: (P,) prior sigmas, those of the error sources as large as the data show them to be.
        cov: (P, P) covariance of all that may be off, fitted or not: a fitted number's sigma includes what the error
            sources that were not selected, or hardly show, could still be, and how far leaving them out has moved it.
            That of predicted poses is :meth:`pose_cov`; where the poses are, most of it cancels.
            ``solution.cov`` is that of the fitted ones, the rest taken for nominal.
        cov_everything: (P, P) covariance of all that may be off in the fit of all of it, ``solution.x - moved``.
        moved: (P,) fitted numbers less those of the fit of everything that can be observed: what the selection has
            moved.
        joint_sigma_rad: (n,) scatter of each joint from pose to pose, rad; zero where the instrument's covariance is
            not known, because the joints' and the instrument's share cannot be separated then.
        held_out: how it does on poses left out; None where none were.
        notes: what a person should know, such as why none were.
        lacks: those of them that say what else would explain the data far better.
        change: how base, tool or a joint's zero changed while the poses were taken, which ``cov`` allows for; None where
            they did not.
    """

    model: Model
    nominal: Array
    solution: Solution
    reasons: Mapping[str, str]
    steps: tuple[SelectionStep, ...]
    singular_values: Array
    prior: Array
    cov: Array
    cov_everything: Array
    moved: Array
    joint_sigma_rad: Array
    held_out: LeftOut | None = None
    notes: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    change: StateChange | None = None

    def __repr__(self) -> str:
        """Return how many numbers were fitted, and from how many poses."""
        used, free, weak = self.solution.used, self.solution.free, undetermined(*self.moved_all_over())
        left_out = self.held_out and f"; left out: {self.held_out.validation!r}"
        notes = "".join(f"; {note}" for note in self.notes)
        return (
            f"Identified({self.model.arm.name}, {int(free.sum())} of {len(free)} numbers fitted, {int(used.sum())} of "
            f"{len(used)} poses used{weak and f'; {weak}'}{left_out or ''}{notes}; columns() lists them)"
        )

    def __str__(self) -> str:
        """Return the same, and a line for each fitted number: value, sigma and what the nominal arm has."""
        lines = [repr(self)]
        for k in np.flatnonzero(self.solution.free):
            p, (value, sigma) = self.model.parameters[k], self.value(self.model.names[k])
            why = self.reasons.get(p.name, "")
            lines.append(f"{p.name:<16} {value_text(p, value):>16} +- {value_text(p, sigma)}  {why}".rstrip())
        return "\n".join(lines)

    @property
    def left_out(self) -> NDArray[np.int64]:
        """Return the rows that were taken for mistakes."""
        return np.asarray(np.flatnonzero(~self.solution.used), np.int64)

    def value(self, name: str) -> tuple[float, float]:
        """Return value and sigma of a parameter, m or rad; sigma is NaN where it was not fitted and stays nominal.

        Rotations of base and tool are rotation vectors, of the base in the rig and of the body in the last frame.

        Raises:
            InputError: the arm has no such parameter.
        """
        if name not in self.model.names:
            raise InputError(f"{self.model.arm.name} has no parameter {name}; it has {nearest(name, self.model.names)}")
        k = self.model.names.index(name)
        value, variance = self.solution.x[k], self.cov[k, k]
        for first, rotation, side in self.model.rotations(self.solution.x):
            if first <= k < first + 3:
                value, by = rotation[k - first], np.linalg.inv(left_jacobian(side * rotation))[k - first]
                variance = by @ self.cov[first : first + 3, first : first + 3] @ by
        return float(value), float(np.sqrt(variance)) if self.solution.free[k] else np.nan

    def pose_cov(self, measured: Measured) -> Array:
        """Return the covariance (N, M, M) of predicted poses, in the axes of :class:`Measured`.

        It is J cov J^T, J by all parameters. Beyond the readings fitted a sensor's curve is as unknown as before any were.
        """
        arm, J = self.model.arm, self.model.linearised(self.solution.x, measured)[1]
        B = by_joints(self.model, J) @ (arm.direction[:, None] * arm.coupling)
        beyond = self.model.beyond(measured.q, self.prior)[:, None]
        return np.asarray(J @ self.cov @ J.swapaxes(1, 2) + (B * beyond) @ B.swapaxes(1, 2))

    def moved_all_over(self) -> tuple[float, float]:
        """Return how far the tool is from the nominal arm's, m, RMS all over the joint limits, and its sigma."""
        arm, full = self.model.arm, self.model.full
        rng, ends = np.random.default_rng(0), (np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi))
        q = rng.uniform(*ends, (POSES, arm.joints))
        T, T_nominal = (
            self.model.T_rig_base(x) @ self.model.tool_in_base(x, q, None) for x in (self.solution.x, self.nominal)
        )
        at = Measured(q, np.repeat(T[:, None, :3, 3], self.model.points, axis=1), T[:, :3, :3] if full else None)
        square = np.trace(self.pose_cov(at)[:, :3, :3].mean(axis=0))
        return float(np.sqrt(np.sum((T - T_nominal)[:, :3, 3] ** 2) / POSES)), float(np.sqrt(square))

    def columns(self) -> dict[str, Array | list[str]]:
        """Return a table of all parameters, m or rad; sigma is NaN where one was not fitted, and ``reason`` says why."""
        names = list(self.model.names)
        values, sigmas = np.array([self.value(name) for name in names]).T
        reasons = [self.reasons.get(name, "") for name in names]
        return {"name": names, "value": values, "nominal": self.model.nominal(), "sigma": sigmas, "reason": reasons}

    def plot(self) -> Any:  # noqa: ANN401 - matplotlib is no dependency
        """Draw by how much each fitted number is off its nominal value, with two sigmas; return matplotlib's figure.

        Base and tool, which the nominal arm does not have, are left out.

        Raises:
            InputError: matplotlib is not installed, or nothing but base and tool was fitted.
        """
        fitted = np.flatnonzero(self.solution.free & ~_of(self.model, PLACEMENT))
        units = [unit for unit in SHOWN_IN if any(self.model.parameters[k].unit == unit for k in fitted)]
        if not units:
            raise InputError("nothing to draw: nothing but base and tool was fitted")
        figure, axes = new_figure(len(units), 1, squeeze=False, figsize=(6.4, 2.4 * len(units) + 0.6))
        for unit, ax in zip(units, axes[:, 0], strict=True):
            (scale, shown), rows = SHOWN_IN[unit], [k for k in fitted if self.model.parameters[k].unit == unit]
            off, sigma = (
                scale * (self.solution.x - self.model.nominal())[rows],
                scale * np.sqrt(np.diag(self.cov)[rows]),
            )
            ax.errorbar([self.model.names[k] for k in rows], off, 2 * sigma, fmt="o", capsize=3)
            ax.axhline(0.0, color="gray", linewidth=0.8)
            ax.tick_params(axis="x", rotation=90)
            ax.set_ylabel(f"off nominal, {shown}")
        axes[0, 0].set_title(f"{self.model.arm.name}: {len(fitted)} numbers fitted, with two sigmas")
        return figure

    def correlation(self, rows: NDArray[np.int64]) -> Array:
        """Return the correlations (R, R) of fitted parameters: how badly these poses distinguish them.

        They are those of the fit, without what the choice of the model moves.
        """
        sigma = self.solution.sigma()[rows]
        return np.asarray(self.solution.cov[np.ix_(rows, rows)] / np.outer(sigma, sigma))

    def correlated(self) -> list[tuple[str, str, float]]:
        """Return the pairs of fitted parameters whose correlation is over 0.9, strongest first."""
        rows = np.flatnonzero(self.solution.free)
        C = self.correlation(rows)
        i, j = np.nonzero(np.triu(np.abs(C) > CORRELATED, 1))
        names = self.model.names
        pairs = [(names[rows[a]], names[rows[b]], float(C[a, b])) for a, b in zip(i, j, strict=True)]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))


def value_text(p: Parameter, value: float) -> str:
    """Return a value in mm, deg, deg/m or %."""
    scale, shown = SHOWN_IN[p.unit]
    return f"{scale * value:.{3 if p.unit == 'm' else 4}f} {shown}"


def identify(
    arm: Arm,
    measured: Measured,
    *,
    priors: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Identified:
    """Identify an arm from all poses, as :func:`~armsight.loop.identify.validate.identify_held_out` does from a part.

    Raises:
        InputError: too few poses, or data that cannot be of this arm; the message says what would make them fit.
        CalibrationError: poses so alike that not even base and tool are observable.
    """
    model, x, prior, seen = _begun(arm, measured, priors, progress)
    progress("base and tool")
    placement = _of(model, PLACEMENT) & seen.free
    start = fit(model, x, measured, placement, prior)
    return _identified(model, start, measured, prior, placement, progress)


def begun(arm: Arm, measured: Measured) -> tuple[Model, Array, Array]:
    """Return the model, the vector (P,) of the nominal arm with base and tool estimated, and prior sigmas (P,).

    Raises:
        InputError: too few poses, or data that cannot be of this arm.
        CalibrationError: poses so alike that not even base and tool are observable.
    """
    model, x, prior, seen = _begun(arm, measured, None, lambda line: None)
    lost = [model.names[k] for k in np.flatnonzero(_of(model, PLACEMENT) & ~seen.free)]
    if lost:
        raise CalibrationError(
            f"the poses are too alike: {', '.join(lost)} cannot be distinguished from the others; move every joint between "
            "poses, by 20 degrees and more"
        )
    return model, x, prior


def _begun(
    arm: Arm, measured: Measured, priors: Mapping[str, float] | None, progress: Callable[[str], None]
) -> tuple[Model, Array, Array, Observed]:
    """Return what :func:`begun` does, and which parameters of base and tool the poses show."""
    if len(measured) < MIN_POSES:
        raise InputError(
            f"{len(measured)} poses are fewer than {MIN_POSES}, which base and tool alone need; 50 and more are advised"
        )
    if np.ptp(measured.q, axis=0).max() < ALIKE:
        raise CalibrationError("the poses are too alike: no joint moves; move every joint by 20 degrees and more")
    arm = without_tool(arm)
    progress("is this the arm")
    if measured.length_m is None:
        check_plausible(arm, measured)
    else:  # a sphere has no directions: the rig's axes are the base's
        priors = {**dict.fromkeys(("base_rx", "base_ry", "base_rz"), 0.0), **(priors or {})}
    sides = measured.approach is not None and bool(measured.approach.any())
    model, x = with_placement(Model.of(arm, measured, backlash=sides), measured)
    still = np.ptp(measured.q, axis=0) < ALIKE  # the curve of a joint that does not move is its zero
    curves = np.array([p.kind in SENSOR and bool(still[p.joint]) for p in model.parameters])
    prior = np.where(curves, 0.0, prior_sigma(model, priors))
    at = fit(model, x, measured, np.arange(len(x)) == 0, prior)  # for the noise of the closed form's residuals
    placement = np.where(_of(model, PLACEMENT), prior, 0.0)
    return model, at.x, prior, observed(model, at.x, measured, placement, at.noise, why=False)


def _identified(
    model: Model, start: Solution, measured: Measured, prior: Array, placement: Mask, progress: Callable[[str], None]
) -> Identified:
    """Identify everything, from base and tool fitted."""
    rows = np.linspace(0, len(measured) - 1, min(MAX_SELECTION_POSES, len(measured))).astype(np.int64)
    part = measured.rows(rows)
    progress("lengths, angles and zeros")
    table = observed(model, start.x, part, prior, start.noise, why=False).free & _of(model, (*PLACEMENT, *_TABLE))
    geometric = fit(model, start.x, part, table, prior)
    progress("every error source at once")
    whole, prior, observable, scatter_rad = _everything(model, start, geometric, part, prior)
    part, measured = (with_joint_noise(model, whole.x, m, scatter_rad) for m in (part, measured))
    progress("which error sources lower the held-out error")
    # A curve's harmonics and a joint's loads are selected together: each alone may hardly show at these poses.
    candidates = observable.free | (observable.possible & _of(model, TOGETHER))
    few = len(part) * part.size < PLENTY * len(model.parameters)
    together = _of(model, TOGETHER) & few
    selection = forward_selection(model, whole, part, candidates if few else observable.free, prior, together, progress)
    x = np.where(selection.free, whole.x, np.where(np.isfinite(prior), model.nominal(), whole.x))
    progress("the fit")
    solution = fit(model, x, measured, selection.free, prior, noise=whole.noise)
    nominal = fit(model, start.x, measured, placement, prior, used=solution.used)
    kept_together = {model.names[k] for k in np.flatnonzero(selection.free & ~observable.free)}
    reasons = {**{n: why for n, why in observable.reasons.items() if n not in kept_together}, **selection.reasons}
    model = model.with_seen(measured.q[solution.used])
    everything = covariance(model, solution, measured, observable.possible, prior)
    moved = solution.x - whole.x
    cov = everything + np.outer(moved, moved)
    found = (model, nominal.x, solution, reasons, selection.steps, observable.singular_values)
    return Identified(*found, prior, cov, everything, moved, scatter_rad)


def _everything(
    model: Model, start: Solution, geometric: Solution, measured: Measured, prior: Array
) -> tuple[Solution, Array, Observed, Array]:
    """Fit all that may be off, in rounds: each fit's noise gives the size of the error sources and the joints' scatter."""
    noise, whole, scaled = geometric.noise, geometric, prior
    weighted, scatter_rad = measured, np.zeros(model.arm.joints)
    for _ in range(ROUNDS if measured.cov is not None else 2):
        seen = observed(model, start.x, weighted, prior, noise, why=False)
        whole = fit(model, whole.x, weighted, seen.possible, scaled, noise=noise)
        if measured.cov is not None:
            scatter_rad = joint_noise(model, whole, scaled, measured).sigma_rad
            weighted = with_joint_noise(model, whole.x, measured, scatter_rad)
        noise, scaled = whole.noise, scaled_prior(model, whole, weighted, seen.possible, prior)
    return whole, scaled, observed(model, start.x, weighted, scaled, noise), scatter_rad


def _of(model: Model, kinds: tuple[str, ...]) -> Mask:
    return np.array([p.kind in kinds for p in model.parameters])


def contributions(found: Identified, measured: Measured) -> dict[str, float]:
    """Return by how much each error source moves the tool, RMS over the poses, m.

    The sources are taken in the order of their selection, each beyond what base and tool and the sources before it explain,
    so that what two could explain is counted once; the squares add up.
    """
    model, s = found.model, found.solution
    _, J = model.linearised(s.x, measured)
    J = J[:, : 3 * measured.points].reshape(-1, len(s.x))
    left = J @ np.where(_of(model, PLACEMENT), 0.0, s.x - found.nominal)
    out: dict[str, float] = {}
    Q = np.zeros((len(J), 0))
    for step in found.steps:
        names = [name for name in step.names if s.free[model.names.index(name)]]
        if step.source.startswith("-") or not names:
            continue
        columns = J[:, [model.names.index(name) for name in names]]
        for _ in range(2):  # twice is enough against rounding
            columns = columns - Q @ (Q.T @ columns)
        new = np.linalg.qr(columns)[0]
        taken = new @ (new.T @ left)
        left, Q = left - taken, np.column_stack([Q, new])
        if any(model.parameters[model.names.index(name)].kind not in PLACEMENT for name in names):
            out[step.source] = float(np.sqrt(np.sum(taken**2) / (len(measured) * measured.points)))
    return out
