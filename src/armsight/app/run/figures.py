"""The figures of a run: joint angles, path, errors against the truth, the loop, latency, an overview, studies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from armsight.app.run.metrics import PassErrors, Study
from armsight.app.run.tracks import Part, ToolTrack, errors
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, Axes, Figure, new_figure, plain_log, subplots
from armsight.data import Array, Image

GREEN, SOFT_GREEN = "#2f7d4f", "#cfe8d8"
_MM, _DEG = 1e3, float(np.degrees(1.0))
_BAND = float(ndtri(0.975))
_ALONE, _CLOSED = ("joint sensors alone", ORANGE), ("closed on vision", GREEN)
_ACROSS = 3  # panels of studies
#: Kind, columns of a tangent, factor and unit of errors.
_KINDS: tuple[tuple[str, slice, float, str], ...] = (
    ("position", slice(0, 3), _MM, "mm"),
    ("orientation", slice(3, 6), _DEG, "deg"),
)


def joints_figure(run: Part) -> Figure:
    """Plot the joint angles over time: their sensors and reference."""
    joints = run.q.shape[1]
    down = (joints + 1) // 2
    figure = new_figure(0.2 + 2.0 * down)
    plots = figure.subplots(down, 2, sharex=True).T.ravel()
    for plot in plots[joints:]:
        plot.set_visible(False)
    for joint, plot in enumerate(plots[:joints]):
        plot.plot(run.t_s, _DEG * run.q_ref[:, joint], color=ORANGE, lw=2.4, label="reference")
        plot.plot(run.t_s, _DEG * run.q[:, joint], color=BLUE, lw=0.9, label="joint sensor")
        plot.set_ylabel(f"joint {joint + 1}, deg")
        _shade(plot, run, named=joint in (0, down))
        if joint in (down - 1, joints - 1):
            plot.set_xlabel("time, s")
            plot.tick_params(labelbottom=True)  # also where the plot below is left out
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=7, ncols=2, loc="outside upper left")
    return figure


def path_figure(run: Part) -> Figure:
    """Plot the tool's path in space: from potentiometers, vision, both fused, and the truth."""
    figure = new_figure(6.4)
    axes = figure.add_subplot(projection="3d")
    truth = None if run.truth is None else run.named("truth")
    if truth is not None and len(run.fused):  # from the first estimate on
        truth = truth[truth.t_s >= run.fused.t_s[0]]
    for track, name, style in (
        (truth, "truth", {"color": INK, "lw": 2.6, "alpha": 0.35}),
        (run.potentiometers, "joint sensors", {"color": ORANGE, "lw": 1.0}),
        (run.fused, "fused", {"color": GREEN, "lw": 1.0}),
        (run.vision, "vision", {"color": BLUE, "lw": 0.0, "marker": ".", "ms": 2.5}),
    ):
        if track is not None and len(track):
            axes.plot(*_MM * track.Ts_base_tool[:, :3, 3].T, label=name, **style)
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.set_zlabel("z, mm")
    spans = np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1)
    axes.set_box_aspect(spans, zoom=0.9)  # equal scales; labels of the axes stay on the page
    for axis, share in zip("xyz", spans / spans.max(), strict=True):
        axes.locator_params(axis=axis, nbins=max(2, round(8 * share)))
    axes.legend(loc="upper left", fontsize=8)
    return figure


def errors_figure(run: Part) -> Figure | None:
    """Plot the error of each track against the truth over time, position and orientation, with the claimed 95% bands."""
    if run.truth is None:
        return None
    figure, plots = subplots(6.8, 4, 1, sharex=True)
    alone = run.potentiometers
    off = errors(alone, run.truth)
    seen = [(name, colour, t, errors(t, run.truth)) for name, colour, t in _measured(run) if len(t)]
    for (name, part, factor, unit), above, below in zip(_KINDS, plots[::2], plots[1::2], strict=True):
        above.plot(alone.t_s, factor * np.linalg.norm(off[:, part], axis=1), color=ORANGE, lw=1.0)
        above.set_title("joint sensors and the nominal arm's forward kinematics", fontsize=9)
        above.set_ylim(bottom=0)
        _own(below, seen, part, factor)
        for plot in (above, below):
            plot.set_ylabel(f"{name}, {unit}")
    for plot in plots:
        _shade(plot, run, named=plot is plots[-1])  # the one without a title
    plots[1].set_title("vision and fused; shaded: at least 95% of the fused errors should lie below", fontsize=9)
    plots[1].legend(fontsize=7, ncols=3, loc="upper right")
    plots[3].set_xlabel("time, s")
    return figure


def _measured(run: Part) -> list[tuple[str, str, ToolTrack]]:
    return [("vision", BLUE, run.vision), ("fused", GREEN, run.fused)]


def _own(plot: Axes, seen: list[tuple[str, str, ToolTrack, Array]], part: slice, factor: float) -> None:
    """Plot the norms of tracks' errors, and the 95% band that the fused one claims: (name, colour, track, errors) each."""
    high = [1.0]
    for name, colour, track, error in seen:
        size = factor * np.linalg.norm(error[:, part], axis=1)
        style: dict[str, Any] = {"marker": ".", "ms": 2.0, "lw": 0.0} if name == "vision" else {"lw": 0.9}
        if name == "fused" and track.covs is not None:
            sigma = np.sqrt(np.einsum("nii->ni", track.covs)[:, part].sum(axis=1))
            plot.fill_between(track.t_s, 0.0, factor * _BAND * sigma, color=SOFT_GREEN, lw=0)
        plot.plot(track.t_s, size, color=colour, label=name, **style)
        high.extend(size.tolist())
    plot.set_ylim(0.0, 1.4 * float(np.nanpercentile(high[1:] or high, 99.8)))


def loop_figure(passes: tuple[PassErrors, PassErrors] | None) -> Figure | None:
    """Plot the distance of the tool from its reference, with potentiometers alone and with the loop closed."""
    if passes is None:
        return None
    figure, (rests, paths) = subplots(4.6, 1, 2)
    _at_rest(rests, passes, _CLOSED[0])
    for found, (name, colour) in zip(passes, (_ALONE, _CLOSED), strict=True):
        for number, (motion, (since_s, distance_m)) in enumerate(found.paths.items()):
            style = "--" if number else "-"
            paths.plot(since_s, _MM * distance_m, style, color=colour, lw=1.0, label=f"{motion}, {name}")
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


def _at_rest(plot: Axes, passes: tuple[PassErrors, PassErrors], closed: str) -> None:
    for shift, each, (name, colour) in zip((-0.2, 0.2), passes, (_ALONE, (closed, GREEN)), strict=True):
        found = {**each.rests, **each.singular}
        plot.bar(np.arange(len(found)) + shift, _MM * np.array(list(found.values())), 0.38, color=colour, label=name)
    plot.set_xticks(range(len(found)), list(found), rotation=30, ha="right", fontsize=7)


def latency_figure(latency_s: Array) -> Figure | None:
    """Plot the histogram of the computing time from an image to its command."""
    if not len(latency_s):
        return None
    figure, plot = subplots(2.8)
    times = 1e3 * np.asarray(latency_s)
    plot.hist(times, bins=np.linspace(0.0, max(2.2, float(np.percentile(times, 99.5))), 90).tolist(), color=BLUE)
    for share, colour, height in ((50, INK, 0.94), (99, RED, 0.8)):
        value = float(np.percentile(times, share))
        plot.axvline(value, color=colour, lw=1.0)
        _label(plot, f"p{share} {value:.2f} ms", (value, height), (4, 0), color=colour, fontsize=8)
    plot.set(xlabel=f"ms from the image (decoded) to the command; longest {times.max():.1f} ms", ylabel="shots")
    return figure


def _label(plot: Axes, text: str, at: tuple[float, float], off: tuple[float, float], **style: Any) -> None:  # noqa: ANN401 - matplotlib's
    plot.annotate(text, at, off, xycoords=("data", "axes fraction"), textcoords="offset points", **style)


def _shade(plot: Axes, run: Part, *, named: bool) -> None:
    """Shade the rests, and mark where the loop is closed; ``named`` adds a label above the plot."""
    for segment in run.segments:
        if segment.phase == "rest":
            plot.axvspan(segment.begin_s, segment.end_s, color="#f0f2f5", lw=0, zorder=0)
    closed = [s.begin_s for s in run.segments if s.closed]
    if closed and not run.segments[0].closed:
        plot.axvline(min(closed), color=MUTED, lw=0.8, ls=":")
        if named:
            _label(plot, "loop closed", (min(closed), 1.0), (0, 2), ha="center", fontsize=6, color=MUTED)


def overview_figure(
    picture: Image | None, run: Part | None, passes: tuple[PassErrors, PassErrors] | None
) -> Figure | None:
    """Plot the run in one figure: a camera image, errors over time, errors at rest; None without a truth."""
    if picture is None or run is None or run.truth is None or passes is None:
        return None
    figure = new_figure(3.9)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    image = figure.add_subplot(grid[:, 0])
    image.imshow(picture[..., ::-1])
    image.set_axis_off()
    image.set_title("the left camera's image with the measured pose")
    over_time, at_rest = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
    vision, fused = _measured(run)
    for name, colour, track in (("joint sensors", ORANGE, run.potentiometers), fused, vision):
        off = _MM * np.linalg.norm(errors(track, run.truth)[:, :3], axis=1)
        off[1:][np.diff(track.t_s) > 0.2] = np.nan  # no line over a gap in time
        over_time.plot(track.t_s - run.t_s[0], off, color=colour, lw=0.8, label=name)
    over_time.set_title("error of the measured position against the truth, mm")
    over_time.set_xlabel("time, s", fontsize=7)
    _at_rest(at_rest, passes, "loop closed on vision")
    at_rest.set_title("distance of the tool at rest from its reference, mm")
    for plot in (over_time, at_rest):
        plot.set_yscale("log")
        plain_log(plot.yaxis)
    over_time.legend(fontsize=6.5, ncols=3, loc="lower right")
    at_rest.legend(fontsize=6.5, ncols=2, loc="upper right")
    over_time.set_ylim(bottom=5e-3)
    low, high = at_rest.get_ylim()
    at_rest.set_ylim(low, 3 * high)  # room for the legend
    return figure


def studies_figure(studies: Sequence[Study]) -> Figure | None:
    """Plot one panel a study, both axes logarithmic: measured errors with their 95% intervals, and the predicted curve."""
    if not studies:
        return None
    down = -(-len(studies) // _ACROSS)
    figure = new_figure(2.9 * down)
    style: dict[str, Any] = {"fmt": "o", "color": BLUE, "ms": 4, "lw": 1, "capsize": 2, "label": "measured, 95%"}
    for number, study in enumerate(studies, start=1):
        plot = figure.add_subplot(down, _ACROSS, number)
        reach = _MM * np.abs(np.array([study.low_m, study.high_m]) - study.position_rms_m)
        plot.plot(study.values, _MM * study.predicted_m, color=MUTED, lw=1.4, label="predicted")
        plot.errorbar(study.values, _MM * study.position_rms_m, reach, **style)
        plot.set(xscale="log", yscale="log")
        plot.set_xticks(study.values, [f"{value:g}" for value in study.values])
        plot.minorticks_off()
        ticks = _decades(np.concatenate([study.low_m, study.high_m, study.predicted_m]) * _MM)
        plot.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        plot.set_title(f"{study.name}, {study.unit}")
        plot.set_ylabel("position error RMS, mm", fontsize=8)
        plot.grid(axis="y", color="#e4e7eb", lw=0.6)
        if number == 1:
            plot.legend(fontsize=7)
    return figure


def _decades(values: np.ndarray) -> list[float]:
    good = values[np.isfinite(values) & (values > 0)]
    low, high = (float(np.log10(bound)) for bound in (good.min(), good.max()))
    steps = (1.0, 2.0, 5.0) if high - low < 1.5 else (1.0, 3.0) if high - low < 2.5 else (1.0,)
    ticks = [m * 10.0**k for k in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in steps]
    return [tick for tick in ticks if 0.8 * good.min() <= tick <= 1.25 * good.max()]
