"""The figures of a run: the chapter's 18.8 and 18.9, and what it left out: errors against the truth, with their bands."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from armsight.app.report.plotting import (BLUE, INK, MUTED, ORANGE, RED, new_figure, plain_log)
from armsight.app.run_data import RunData
from armsight.app.run.metrics import judge, path_errors, rest_errors
from armsight.app.run_tracks import ToolTrack, errors
from armsight.data import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GREEN, SOFT_BLUE, SOFT_GREEN = "#2f7d4f", "#cfe3f5", "#cfe8d8"
_MM, _DEG = 1e3, float(np.degrees(1.0))
_BAND = float(ndtri(0.975))
_POINTS = 4000  # of a line in a figure: more cannot be seen


def joints_figure(run: RunData) -> Figure:
    """Draw figure 18.8: the six joint angles over time, what the potentiometers say and what was wanted."""
    figure = new_figure(6.2)
    rows = _thinned(len(run.t_s))
    for joint, plot in enumerate(figure.subplots(3, 2, sharex=True).T.flat):
        plot.plot(run.t_s[rows], _DEG * run.q_wanted[rows, joint], color=ORANGE, lw=2.4, label="reference")
        plot.plot(run.t_s[rows], _DEG * run.q[rows, joint], color=BLUE, lw=0.9, label="potentiometer")
        plot.set_ylabel(f"joint {joint + 1}, deg")
        _shade(plot, run, named=joint in (0, 3))
        if joint in (2, 5):
            plot.set_xlabel("time, s")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=7, ncols=2, loc="outside upper left")
    return figure


def path_figure(run: RunData) -> Figure:
    """Draw figure 18.9: the tool's path in space from potentiometers, vision, both fused, and as it was."""
    figure = new_figure(6.4)
    axes = figure.add_subplot(projection="3d")
    drawn: list[tuple[ToolTrack | None, str, str, float, str]] = [
        (run.truth, "truth", INK, 2.6, "-"),
        (run.potentiometers, "potentiometers", ORANGE, 1.0, "-"),
        (run.fused, "fused", GREEN, 1.0, "-"),
        (run.vision, "vision", BLUE, 0.0, "."),
    ]
    for track, name, colour, width, marker in drawn:
        if track is None or not len(track):
            continue
        if track is run.truth and len(run.fused):  # not where it was before
            track = track[track.t_s >= run.fused.t_s[0]]
        p = _MM * track.Ts_base_tool[_thinned(len(track)), :3, 3]
        if marker == ".":
            axes.plot(*p.T, marker, color=colour, ms=2.5, label=name)
        else:
            axes.plot(*p.T, color=colour, lw=width, alpha=0.35 if name == "truth" else 1.0, label=name)
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_zlabel("z, mm")
    axes.set_aspect("equal")
    axes.legend(loc="upper left", fontsize=8)
    return figure


def errors_figure(run: RunData) -> Figure | None:
    """Draw how far each track is from the truth over time, position and orientation, with the 95% bands claimed."""
    if run.truth is None:
        return None
    figure = new_figure(6.8)
    plots = figure.subplots(4, 1, sharex=True)
    alone = run.potentiometers[_thinned(len(run.potentiometers))]
    off = errors(alone, run.truth)
    for plot, part, factor, name in ((plots[0], slice(0, 3), _MM, "mm"), (plots[2], slice(3, 6), _DEG, "deg")):
        plot.plot(alone.t_s, factor * np.linalg.norm(off[:, part], axis=1), color=ORANGE, lw=1.0)
        plot.set_ylabel(f"{'position' if name == 'mm' else 'turn'}, {name}")
        plot.set_title("potentiometers through the arm's table", fontsize=9)
        plot.set_ylim(bottom=0)
    shown = {"vision": (run.vision, BLUE), "fused": (run.fused, GREEN)}
    thin = {name: (track[_thinned(len(track))], colour) for name, (track, colour) in shown.items() if len(track)}
    seen = [(name, colour, track, errors(track, run.truth)) for name, (track, colour) in thin.items()]
    for plot, part, factor, name in ((plots[1], slice(0, 3), _MM, "mm"), (plots[3], slice(3, 6), _DEG, "deg")):
        _own(plot, seen, part, factor)
        plot.set_ylabel(f"{'position' if name == 'mm' else 'turn'}, {name}")
    for plot in plots:
        _shade(plot, run, named=plot is plots[0])
    plots[1].set_title(
        "vision and fused; shaded: at least 95% of the fused estimate's errors are to lie below", fontsize=9
    )
    plots[1].legend(fontsize=7, ncols=3, loc="upper right")
    plots[3].set_xlabel("time, s")
    return figure


def _own(plot: Axes, seen: list[tuple[str, str, ToolTrack, Array]], part: slice, factor: float) -> None:
    """Draw the sizes of tracks' errors, and the band that the fused one claims: names, colours, tracks, errors."""
    for name, colour, track, error in seen:
        size = factor * np.linalg.norm(error[:, part], axis=1)
        style = {"marker": ".", "ms": 2.0, "lw": 0.0} if name == "vision" else {"lw": 0.9}
        if name == "fused" and track.covs is not None:
            sigma = np.sqrt(np.einsum("nii->ni", track.covs)[:, part].sum(axis=1))
            plot.fill_between(track.t_s, 0.0, factor * _BAND * sigma, color=SOFT_GREEN, lw=0)
        plot.plot(track.t_s, size, color=colour, label=name, **style)
    shown = [line.get_ydata() for line in plot.get_lines()]
    high = float(np.nanpercentile(np.concatenate([np.asarray(y, float) for y in shown]), 99.8)) if shown else 1.0
    plot.set_ylim(0.0, 1.4 * high)


def loop_figure(before: RunData, after: RunData) -> Figure | None:
    """Draw how far the tool was from where it was to be, with potentiometers alone and with the loop closed."""
    truth_before, truth_after = judge(before), judge(after)
    figure = new_figure(4.6)
    rests, paths = figure.subplots(1, 2)
    for shift, run, truth, name, colour in (
        (-0.2, before, truth_before, "potentiometers alone", ORANGE),
        (0.2, after, truth_after, "closed on vision", GREEN),
    ):
        found = rest_errors(run, truth)
        rests.bar(np.arange(len(found)) + shift, _MM * np.array(list(found.values())), 0.38, color=colour, label=name)
        for number, (motion, (along_s, away_m)) in enumerate(path_errors(run, truth).items()):
            style = "--" if number else "-"
            paths.plot(along_s, _MM * away_m, style, color=colour, lw=1.0, label=f"{motion}, {name}")
    rests.set_xticks(range(len(found)), list(found), rotation=30, ha="right", fontsize=7)
    for plot, title in ((rests, "error at rest, mm"), (paths, "distance from the path, mm")):
        plot.set_yscale("log")
        plain_log(plot.yaxis)
        plot.set_title(title)
        plot.grid(axis="y", color="#e4e7eb", lw=0.6)
        plot.set_axisbelow(True)
        low, high = plot.get_ylim()
        plot.set_ylim(low, high * (high / low) ** 0.15)  # room for the legend
        if plot.get_legend_handles_labels()[0]:
            plot.legend(fontsize=7)
    paths.set_xlabel("time on the path, s")
    return figure


def latency_figure(run: RunData) -> Figure | None:
    """Draw the histogram of our time from an image to its command."""
    if not len(run.latency_s):
        return None
    figure = new_figure(2.8)
    plot = figure.subplots()
    times = 1e3 * run.latency_s
    plot.hist(times, bins=np.linspace(0.0, max(2.2, float(np.percentile(times, 99.5))), 90).tolist(), color=BLUE)
    for share, colour in ((50, INK), (99, RED)):
        value = float(np.percentile(times, share))
        plot.axvline(value, color=colour, lw=1.0)
        plot.annotate(
            f"p{share} {value:.2f} ms",
            (value, 0.94 if share == 50 else 0.8),
            (4, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            color=colour,
            fontsize=8,
        )
    plot.set_xlabel(f"ms from the image (decoded) to the command; longest {times.max():.1f} ms")
    plot.set_ylabel("shots")
    return figure


def _shade(plot: Axes, run: RunData, *, named: bool) -> None:
    """Shade the rests, and mark where the loop is closed; say so above the plot where that is wanted."""
    for segment in run.segments:
        if segment.phase == "rest":
            plot.axvspan(segment.begin_s, segment.end_s, color="#f0f2f5", lw=0, zorder=0)
    closed = [s.begin_s for s in run.segments if s.closed]
    if closed and not run.segments[0].closed:
        plot.axvline(min(closed), color=MUTED, lw=0.8, ls=":")
        if named:
            plot.annotate(
                "loop closed",
                (min(closed), 1.0),
                (0, 2),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                ha="center",
                fontsize=6,
                color=MUTED,
            )


def _thinned(count: int) -> Array:
    """Return the rows to draw."""
    return np.unique(np.linspace(0, count - 1, min(count, _POINTS)).astype(int))


#: Name -> how it is drawn and what it shows.
FIGURES: dict[str, tuple[Callable[[RunData], Figure | None], str]] = {
    "joints": (
        joints_figure,
        "Figure 18.8: the six joint angles over time, potentiometers and reference; rests shaded",
    ),
    "path": (path_figure, "Figure 18.9: the tool's path from potentiometers, vision, both fused, and as it was"),
    "errors": (errors_figure, "Error of each against the truth over time, with the 95% band the estimate claims"),
    "latency": (latency_figure, "Our time from image to command"),
}
