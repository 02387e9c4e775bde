"""Figures of a test's report: the poses' scatter, errors over the workspace, drift, paths, the circle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from armsight.app.check.rows import Row
from armsight.app.check_words import direction
from armsight.app.report.plotting import (BLUE, INK, MUTED, ORANGE, RED, new_figure, nice)
from armsight.data import Array
from armsight.loop.iso9283.paths import square_to

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

#: Poses that are shown with their scatter.
_MOST = 6
_VIEWS = ((0, 1, "from above"), (0, 2, "from the side"))


def scatter_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw the attained places of each pose about their middle, coloured by when, and RP as a circle."""
    from matplotlib.ticker import MaxNLocator

    names = list(facts.get("poses", {}))[:_MOST]
    if not names:
        return None
    figure = new_figure(4.6)
    panels = figure.subplots(2, len(names), squeeze=False, sharex=True, sharey=True)
    reach = 0.0
    for column, name in enumerate(names):
        p = _places(rows, name)
        off, middle = p - p.mean(axis=0), facts["poses"][name]
        RP = middle["RP_m"]["clean"]
        reach = max(reach, 1.15 * float(np.abs(off).max()), 1.1 * (RP or 0.0))
        for row, (i, j, view) in enumerate(_VIEWS):
            ax = panels[row, column]
            dots = ax.scatter(
                1e3 * off[:, i], 1e3 * off[:, j], c=np.arange(len(off)) + 1, cmap="viridis", s=13, zorder=3
            )
            ax.axhline(0, color="#e4e7eb", lw=0.8, zorder=0)
            ax.axvline(0, color="#e4e7eb", lw=0.8, zorder=0)
            _ring(ax, 1e3 * (RP if RP is not None else middle["RP_m"]["high"]), dotted=RP is None)
            ax.set_aspect("equal")
            if row == 0:
                ax.set_title(f"{name}: command is\n{1e3 * middle['AP_m']['raw']:.2f} mm off")
            if row == 1:
                ax.set_xlabel("x, mm")
            if column == 0:
                ax.set_ylabel(f"{'xyz'[j]}, mm ({view})")
    panels[0, 0].set_xlim(-1e3 * reach, 1e3 * reach)
    panels[0, 0].set_ylim(-1e3 * reach, 1e3 * reach)
    bar = figure.colorbar(dots, ax=panels, label="time round", shrink=0.7)
    bar.locator = MaxNLocator(integer=True)
    bar.update_ticks()
    return figure


def _ring(ax: Axes, radius: float, *, dotted: bool) -> None:
    a = np.linspace(0, 2 * np.pi, 120)
    ax.plot(radius * np.cos(a), radius * np.sin(a), color=ORANGE, lw=1.2, ls=":" if dotted else "-")


def _places(rows: Sequence[Row], name: str) -> Array:
    return np.array([row.T[:3, 3] for row in rows if row.test == "pose" and row.pose == name])


def anywhere_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw where in the workspace the error is how large."""
    if "anywhere" not in facts:
        return None
    chosen = [row for row in rows if row.test == "pose"]
    at = np.array([row.T_command[:3, 3] for row in chosen])
    error = 1e3 * np.linalg.norm([(row.T - row.T_command)[:3, 3] for row in chosen], axis=1)
    figure = new_figure(3.6)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1))
    for ax, (i, j, view) in zip(panels, _VIEWS, strict=False):
        dots = ax.scatter(at[:, i], at[:, j], c=error, s=26, cmap="viridis", vmin=0)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(view)
        ax.set_xlabel(f"{'xyz'[i]}, m")
        ax.set_ylabel(f"{'xyz'[j]}, m")
    figure.colorbar(dots, ax=list(panels[:2]), label="error, mm", shrink=0.8)
    panels[2].hist(error, bins=15, color=BLUE)
    panels[2].set_xlim(left=0)
    panels[2].set_title("poses")
    panels[2].set_xlabel("error, mm")
    return figure


def drift_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw where the first pose was attained over time, and the wander of its middle."""
    if "drift" not in facts:
        return None
    d = facts["drift"]
    chosen = [row for row in rows if row.test == "pose" and row.pose == d["pose"] and row.t_s is not None]
    t = np.array([row.t_s for row in chosen], float)
    p = np.array([row.T[:3, 3] for row in chosen])
    figure = new_figure(3.2)
    ax = figure.subplots()
    for i, colour in enumerate((RED, "#2f7d4f", BLUE)):
        ax.plot(t - t.min(), 1e3 * (p - p.mean(axis=0))[:, i], ".-", lw=0.7, ms=4, color=colour, label="xyz"[i])
    ax.plot(np.array(d["t_s"]) - t.min(), 1e3 * np.array(d["dAP_m"]), "s-", color=INK, ms=5, label="dAP")
    ax.axhline(0, color="#e4e7eb", lw=0.8, zorder=0)
    ax.set_xlabel("s")
    ax.set_ylabel(f"{d['pose']} about its middle, mm")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
    return figure


def paths_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw how far off each path is along it."""
    if "paths" not in facts:
        return None
    figure = new_figure(3.2)
    ax = figure.subplots()
    for (name, p), colour in zip(
        facts["paths"].items(), (BLUE, ORANGE, MUTED, RED) * len(facts["paths"]), strict=False
    ):
        share = 100 * (np.arange(len(p["off_m"])) + 1) / (len(p["off_m"]) + 1)
        ax.plot(share, 1e3 * np.array(p["off_m"]), color=colour, label=name)
        cycles = {row.cycle for row in rows if row.test == "path" and (row.approach or "path") == name}
        for cycle in sorted(cycles):
            chosen = [r for r in rows if r.test == "path" and (r.approach or "path") == name and r.cycle == cycle]
            off = np.array([(row.T - row.T_command)[:3, 3] for row in chosen])
            off = (square_to(np.array([row.T_command[:3, 3] for row in chosen])) @ off[..., None])[..., 0]
            ax.plot(share, 1e3 * np.linalg.norm(off, axis=1), color=colour, lw=0.5, alpha=0.5)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("of the way, %")
    ax.set_ylabel("distance from the path, mm\n(thick: of the mean path)")
    ax.legend()
    return figure


def circle_figure(facts: Mapping[str, Any], rows: Sequence[Row]) -> Figure | None:
    """Draw the circle, its deviations enlarged, both ways, with the play that its quadrants show."""
    if "circle" not in facts:
        return None
    c = facts["circle"]
    angle = np.radians(np.append(c["angle_deg"], c["angle_deg"][0]))
    radii = 1e3 * np.array(c["radii_m"])
    span = max(float(np.abs(radii).max()), 1e-6)
    figure = new_figure(6.4)
    ax = cast("PolarAxes", figure.subplots(subplot_kw={"projection": "polar"}))
    for way, name, colour in ((0, "counter-clockwise", BLUE), (1, "clockwise", ORANGE)):
        ax.plot(angle, np.append(radii[way], radii[way][0]), color=colour, lw=1.4, label=name)
    ax.plot(np.linspace(0, 2 * np.pi, 200), np.zeros(200), color=MUTED, lw=0.9, ls="--", label="fitted circle")
    ax.set_ylim(-3 * span, 1.6 * span)
    step = nice(span / 1.5)
    ax.set_yticks([-step, 0, step], ["", "", ""])
    ax.set_thetagrids([0, 90, 180, 270], [f"{a} deg" for a in (0, 90, 180, 270)])
    for k in range(4):
        jumps = " / ".join(f"{1e3 * s[k]:+.3f}" for s in c["steps_m"])
        ax.annotate(
            f"jump, mm\n{jumps}", (np.radians(90 * k), -1.5 * span), ha="center", va="center", color=INK, fontsize=8
        )
    told: list[float] = []
    for turn in c["turns"]:
        if any(abs((turn["angle_deg"] - other + 180) % 360 - 180) < 5 for other in told):
            continue  # the same joints, the other way
        told.append(turn["angle_deg"])
        at = np.radians(turn["angle_deg"])
        ax.plot([at, at], [-0.2 * span, 1.1 * span], color=RED, lw=0.8, ls=":")
        label = "J" + ",".join(map(str, turn["joints"]))
        ax.annotate(label, (at, 1.3 * span), ha="center", va="center", color=RED, fontsize=8)
    first, second = (direction(axis) for axis in c["axes"])
    ax.set_title(
        f"radius {1e3 * c['radius_m']:.1f} mm, grey rings {step:g} mm off; 0 deg is along {first}, 90 deg along {second}"
    )
    ax.legend(loc="lower left", bbox_to_anchor=(-0.35, -0.02))
    return figure
