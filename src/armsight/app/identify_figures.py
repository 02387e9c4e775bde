"""Figures of an identification's report: error maps, residuals over joint angles, growth, correlations, causes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armsight.app.identify.run import Run
from armsight.app.report.plotting import (BLUE, INK, MUTED, ORANGE, new_figure)
from armsight.data import Array
from armsight.loop.identify.identify import contributions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points drawn at most: more only hide each other.
MOST_POINTS = 4000
#: Names fit beside a matrix up to this many.
MOST_NAMES = 60
_BINS = 12


def _shown(run: Run) -> tuple[Array, Array, Array, Array]:
    """Return tool positions in the base, m; joint angles; mean error of every pose before and after, m."""
    q = run.held_out_poses
    rows = np.linspace(0, len(q) - 1, min(MOST_POINTS, len(q))).astype(int)
    at = run.found.model.tool_in_base(run.found.solution.x, q[rows], None)[:, :3, 3]
    before, after = (e.position_m.mean(axis=1)[rows] for e in (run.held_out.nominal, run.held_out.identified))
    return at, q[rows], before, after


def map_figure(run: Run) -> Figure:
    """Draw the held-out errors over the workspace, from above and from the side, before and after."""
    at, _, before, after = _shown(run)
    figure = new_figure(7.6)
    axes = figure.subplots(2, 2)
    out = np.hypot(at[:, 0], at[:, 1])
    views = ((at[:, 0], at[:, 1], ("x", "y")), (out, at[:, 2], ("distance from axis 1", "z")))
    top = 1e3 * max(float(np.quantile(before, 0.98)), 1e-9)
    for column, (name, error) in enumerate((("nominal", before), ("identified", after))):
        order = np.argsort(error)
        for row, (x, y, labels) in enumerate(views):
            ax = axes[row, column]
            size = float(np.clip(2000 / len(x), 7, 25))  # few poses must not be lost on the page
            drawn = ax.scatter(
                x[order], y[order], c=1e3 * error[order], s=size, cmap="viridis", vmin=0, vmax=top, linewidths=0
            )
            ax.set_aspect("equal", adjustable="box")
            ax.set_xlabel(f"{labels[0]}, m")
            ax.set_ylabel(f"{labels[1]}, m")
            # No longer title: where a view is narrow it would run into the scale.
            ax.set_title(f"{name}, {'from above' if row == 0 else 'from the side'}")
    figure.colorbar(drawn, ax=axes, label="held-out error, mm", shrink=0.7)
    return figure


def joints_figure(run: Run) -> Figure:
    """Draw the held-out error over each joint's angle, before and after, with the mean in bins."""
    _, q, before, after = _shown(run)
    figure = new_figure(5.6)
    axes = figure.subplots(2, 3, sharey=True)
    for i, ax in enumerate(axes.ravel()):
        degrees = np.degrees(q[:, i])
        for name, error, colour in (("nominal", before, ORANGE), ("identified", after, BLUE)):
            ax.scatter(degrees, 1e3 * error, s=4, color=colour, alpha=0.25, linewidths=0)
            _binned(ax, degrees, 1e3 * error, colour, name)
        ax.set_title(run.arm.joint_names[i])
        ax.set_xlabel("deg")
        ax.set_ylim(0, 1e3 * float(np.quantile(before, 0.995)) * 1.05)
    axes[0, 0].set_ylabel("held-out error, mm")
    axes[1, 0].set_ylabel("held-out error, mm")
    axes[0, 2].legend(loc="upper right")
    return figure


def _binned(ax: Axes, x: Array, y: Array, colour: str, name: str) -> None:
    edges = np.linspace(x.min(), x.max() + 1e-9, _BINS + 1)
    at = np.digitize(x, edges) - 1
    filled = [k for k in range(_BINS) if (at == k).any()]
    middle = (edges[:-1] + edges[1:]) / 2
    ax.plot(middle[filled], [y[at == k].mean() for k in filled], color=colour, linewidth=2, label=name)


def growth_figure(run: Run) -> Figure:
    """Draw how the model grew by the error on poses left out, and how the final fit converged."""
    figure = new_figure(0.24 * len(run.found.steps) + 2.2)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    rms = [step.rms for step in run.found.steps]
    rows = np.arange(len(rms))
    left.barh(rows, rms, color=[BLUE if not s.cause.startswith("-") else MUTED for s in run.found.steps], height=0.7)
    left.set_yticks(
        rows, [s.cause if not s.cause.startswith("-") else f"without {s.cause[1:]}" for s in run.found.steps]
    )
    left.invert_yaxis()
    left.set_xlabel("held-out RMS, in sigmas of the noise")
    left.set_title("what was added, and given back (grey)")
    history = run.found.solution.history
    right.plot(np.arange(1, len(history) + 1), history, color=BLUE, marker="o", markersize=3)
    right.set_xlabel("step")
    right.set_ylabel("RMS, weighted")
    right.set_yscale("log")
    right.set_title("convergence of the final fit")
    return figure


def correlation_figure(run: Run) -> Figure:
    """Draw the correlations of what was fitted, base and tool apart."""
    model, found = run.found.model, run.found
    rows = np.array(
        [k for k in np.flatnonzero(found.solution.free) if model.parameters[k].kind not in ("base", "tool")]
    )
    figure = new_figure(9.0 if len(rows) else 1.5)
    ax = figure.subplots()
    if not len(rows):
        ax.set_axis_off()
        ax.text(0, 0.5, "nothing but base and tool was fitted", color=INK)
        return figure
    sigma = np.sqrt(np.diag(found.cov))[rows]
    drawn = ax.imshow(found.cov[np.ix_(rows, rows)] / np.outer(sigma, sigma), cmap="RdBu", vmin=-1, vmax=1)
    if len(rows) <= MOST_NAMES:
        names = [model.names[k] for k in rows]
        ax.set_xticks(range(len(rows)), names, rotation=90, fontsize=7)
        ax.set_yticks(range(len(rows)), names, fontsize=7)
    figure.colorbar(drawn, ax=ax, label="correlation", shrink=0.7)
    return figure


def causes_figure(run: Run) -> Figure:
    """Draw what each cause moves the tool by, the largest first."""
    parts = sorted(contributions(run.found, run.measured).items(), key=lambda part: part[1])
    figure = new_figure(0.32 * len(parts) + 1.2)
    ax = figure.subplots()
    ax.barh([kind for kind, _ in parts], [1e3 * size for _, size in parts], color=BLUE, height=0.65)
    for row, (_, size) in enumerate(parts):
        ax.text(1e3 * size, row, f" {1e3 * size:.3f}", va="center", color=INK)
    ax.set_xlabel("RMS displacement of the tool, mm, beyond what base, tool and the causes found before it take up")
    return figure
