"""The report of a run: one page that holds its figures, which the mouse wheel zooms, and each figure as a PNG beside it.

In: a :class:`RunReport`. In order: the figures of the run (joint angles, the tool's path, errors against the truth, the
loop, latency); the overview, one figure of all; the studies of vision; the page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.special import ndtri

from armsight.app.run.metrics import Study, evaluated_track, path_errors, rest_errors
from armsight.app.run.record import RunData, ToolTrack, errors
from armsight.app.run.summary import RunSummary, loop_table, track_table
from armsight.app.show.page import PAGE, bullets, html_page, picture, put_files
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, drawing, new_figure, plain_log, png, svg
from armsight.app.show.table import html_table
from armsight.data import Array, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GREEN, SOFT_GREEN = "#2f7d4f", "#cfe8d8"
_MM, _DEG = 1e3, float(np.degrees(1.0))
_BAND = float(ndtri(0.975))
_POINTS = 4000  # of a line in a figure: more cannot be seen


def joints_figure(run: RunData) -> Figure:
    """Plot the joint angles over time: their sensors and reference."""
    joints = run.q.shape[1]
    down = (joints + 1) // 2
    figure = new_figure(0.2 + 2.0 * down)
    rows = _thinned(len(run.t_s))
    plots = figure.subplots(down, 2, sharex=True).T.ravel()
    for plot in plots[joints:]:
        plot.set_visible(False)
    for joint, plot in enumerate(plots[:joints]):
        plot.plot(run.t_s[rows], _DEG * run.q_ref[rows, joint], color=ORANGE, lw=2.4, label="reference")
        plot.plot(run.t_s[rows], _DEG * run.q[rows, joint], color=BLUE, lw=0.9, label="joint sensor")
        plot.set_ylabel(f"joint {joint + 1}, deg")
        _shade(plot, run, named=joint in (0, down))
        if joint in (down - 1, joints - 1):
            plot.set_xlabel("time, s")
            plot.tick_params(labelbottom=True)  # also where the plot below is left out
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=7, ncols=2, loc="outside upper left")
    return figure


def path_figure(run: RunData) -> Figure:
    """Plot the tool's path in space: from potentiometers, vision, both fused, and the truth."""
    figure = new_figure(6.4)
    axes = figure.add_subplot(projection="3d")
    shown: list[tuple[ToolTrack | None, str, str, float, str]] = [
        (run.truth, "truth", INK, 2.6, "-"),
        (run.potentiometers, "joint sensors", ORANGE, 1.0, "-"),
        (run.fused, "fused", GREEN, 1.0, "-"),
        (run.vision, "vision", BLUE, 0.0, "."),
    ]
    for track, name, colour, width, marker in shown:
        if track is None or not len(track):
            continue
        if track is run.truth and len(run.fused):  # from the first estimate on
            track = track[track.t_s >= run.fused.t_s[0]]
        p = _MM * track.Ts_base_tool[_thinned(len(track)), :3, 3]
        if marker == ".":
            axes.plot(*p.T, marker, color=colour, ms=2.5, label=name)
        else:
            axes.plot(*p.T, color=colour, lw=width, alpha=0.35 if name == "truth" else 1.0, label=name)
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_zlabel("z, mm")
    spans = np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1)
    axes.set_box_aspect(spans, zoom=0.9)  # equal scales; labels of the axes stay on the page
    for axis, share in zip("xyz", spans / spans.max(), strict=True):
        axes.locator_params(axis=axis, nbins=max(2, round(8 * share)))
    axes.legend(loc="upper left", fontsize=8)
    return figure


def errors_figure(run: RunData) -> Figure | None:
    """Plot the error of each track against the truth over time, position and orientation, with the claimed 95% bands."""
    if run.truth is None:
        return None
    figure = new_figure(6.8)
    plots = figure.subplots(4, 1, sharex=True)
    alone = run.potentiometers[_thinned(len(run.potentiometers))]
    off = errors(alone, run.truth)
    for plot, part, factor, name in ((plots[0], slice(0, 3), _MM, "mm"), (plots[2], slice(3, 6), _DEG, "deg")):
        plot.plot(alone.t_s, factor * np.linalg.norm(off[:, part], axis=1), color=ORANGE, lw=1.0)
        plot.set_ylabel(f"{'position' if name == 'mm' else 'orientation'}, {name}")
        plot.set_title("joint sensors and the nominal arm's forward kinematics", fontsize=9)
        plot.set_ylim(bottom=0)
    shown = {"vision": (run.vision, BLUE), "fused": (run.fused, GREEN)}
    thin = {name: (track[_thinned(len(track))], colour) for name, (track, colour) in shown.items() if len(track)}
    seen = [(name, colour, track, errors(track, run.truth)) for name, (track, colour) in thin.items()]
    for plot, part, factor, name in ((plots[1], slice(0, 3), _MM, "mm"), (plots[3], slice(3, 6), _DEG, "deg")):
        _own(plot, seen, part, factor)
        plot.set_ylabel(f"{'position' if name == 'mm' else 'orientation'}, {name}")
    for plot in plots:
        _shade(plot, run, named=plot is plots[-1])  # the one without a title
    plots[1].set_title(
        "vision and fused; shaded: at least 95% of the fused estimate's errors should lie below", fontsize=9
    )
    plots[1].legend(fontsize=7, ncols=3, loc="upper right")
    plots[3].set_xlabel("time, s")
    return figure


def _own(plot: Axes, seen: list[tuple[str, str, ToolTrack, Array]], part: slice, factor: float) -> None:
    """Plot the norms of tracks' errors, and the 95% band that the fused one claims: (name, colour, track, errors) each."""
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
    """Plot the distance of the tool from its reference, with potentiometers alone and with the loop closed."""
    truth_before, truth_after = evaluated_track(before), evaluated_track(after)
    figure = new_figure(4.6)
    rests, paths = figure.subplots(1, 2)
    for shift, run, truth, name, colour in (
        (-0.2, before, truth_before, "joint sensors alone", ORANGE),
        (0.2, after, truth_after, "closed on vision", GREEN),
    ):
        found = rest_errors(run, truth)
        rests.bar(np.arange(len(found)) + shift, _MM * np.array(list(found.values())), 0.38, color=colour, label=name)
        for number, (motion, (since_s, distance_m)) in enumerate(path_errors(run, truth).items()):
            style = "--" if number else "-"
            paths.plot(since_s, _MM * distance_m, style, color=colour, lw=1.0, label=f"{motion}, {name}")
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
    """Plot the histogram of the computing time from an image to its command."""
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
    """Shade the rests, and mark where the loop is closed; ``named`` adds a label above the plot."""
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
    """Return the rows to plot, (M,)."""
    return np.unique(np.linspace(0, count - 1, min(count, _POINTS)).astype(int))


_EVERY = 12  # one reading of this many is plotted


def overview_figure(picture: Image, before: RunData, after: RunData) -> Figure | None:
    """Plot the run in one figure: a camera image, errors over time, errors at rest; None without a truth.

    Args:
        picture: (H, W, 3) BGR, with the measured pose overlaid.
        before: the motions with potentiometers alone.
        after: the same with the loop closed.
    """
    if before.truth is None:
        return None
    figure = new_figure(3.9)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    image = figure.add_subplot(grid[:, 0])
    image.imshow(picture[..., ::-1])
    image.set_axis_off()
    image.set_title("the left camera's image with the measured pose")
    _over_time(figure.add_subplot(grid[0, 1]), before)
    _at_rest(figure.add_subplot(grid[1, 1]), before, after)
    return figure


def _over_time(plot: Axes, run: RunData) -> None:
    """Plot the errors of potentiometers, vision and both fused over time."""
    assert run.truth is not None
    start = run.t_s[0]
    for track, name, colour, every in (
        (run.potentiometers, "joint sensors", ORANGE, _EVERY),
        (run.fused, "fused", GREEN, _EVERY),
        (run.vision, "vision", BLUE, 1),
    ):
        shown = track[np.arange(0, len(track), every)]
        off = _MM * np.linalg.norm(errors(shown, run.truth)[:, :3], axis=1)
        off[1:][np.diff(shown.t_s) > 0.2] = np.nan  # no line over a gap in time
        plot.plot(shown.t_s - start, off, color=colour, lw=0.8, label=name)
    plot.set_yscale("log")
    plot.set_ylim(bottom=5e-3)
    plain_log(plot.yaxis)
    plot.set_title("error of the measured position against the truth, mm")
    plot.set_xlabel("time, s", fontsize=7)
    plot.legend(fontsize=6.5, ncols=3, loc="lower right")


def _at_rest(plot: Axes, before: RunData, after: RunData) -> None:
    """Plot the errors at rest, with potentiometers alone and with the loop closed."""
    for shift, run, name, colour in (
        (-0.2, before, "joint sensors alone", ORANGE),
        (0.2, after, "loop closed on vision", GREEN),
    ):
        found = rest_errors(run, evaluated_track(run))
        plot.bar(np.arange(len(found)) + shift, _MM * np.array(list(found.values())), 0.38, color=colour, label=name)
    plot.set_xticks(range(len(found)), list(found), rotation=30, ha="right", fontsize=6)
    plot.set_yscale("log")
    plain_log(plot.yaxis)
    low, high = plot.get_ylim()
    plot.set_ylim(low, 3 * high)  # room for the legend
    plot.set_title("distance of the tool at rest from its reference, mm")
    plot.legend(fontsize=6.5, loc="upper right", ncols=2)


_ACROSS = 3


def studies_figure(studies: Sequence[Study]) -> Figure:
    """Plot one panel a study, both axes logarithmic: measured errors with their 95% intervals, and the predicted curve."""
    down = -(-len(studies) // _ACROSS)
    figure = new_figure(2.9 * down)
    for number, study in enumerate(studies, start=1):
        plot = figure.add_subplot(down, _ACROSS, number)
        reach = _MM * np.abs(np.array([study.low_m, study.high_m]) - study.position_rms_m)
        plot.plot(study.values, _MM * study.predicted_m, color=MUTED, lw=1.4, label="predicted")
        plot.errorbar(
            study.values,
            _MM * study.position_rms_m,
            reach,
            fmt="o",
            color=BLUE,
            ms=4,
            lw=1,
            capsize=2,
            label="measured, 95%",
        )
        plot.set_xscale("log")
        plot.set_yscale("log")
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
    """Return ticks 1, 2, 5 times powers of ten over the values."""
    good = values[np.isfinite(values) & (values > 0)]
    low, high = (float(np.log10(bound)) for bound in (good.min(), good.max()))
    steps = (1.0, 2.0, 5.0) if high - low < 1.5 else (1.0, 3.0) if high - low < 2.5 else (1.0,)
    ticks = [m * 10.0**k for k in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in steps]
    return [tick for tick in ticks if 0.8 * good.min() <= tick <= 1.25 * good.max()]


#: Names of the figures; each is a PNG beside the page.
NAMES = ("joints", "path", "errors", "loop", "latency", "studies", "overview")
#: Wheel zooms about the pointer, dragging moves, a double click shows the whole again.
_ZOOM = """
for (const box of document.querySelectorAll(".zoom")) {
  const img = box.firstElementChild; let k = 1, x = 0, y = 0, from = null;
  const show = () => { img.style.transform = `translate(${x}px,${y}px) scale(${k})`; };
  box.addEventListener("wheel", e => { e.preventDefault();
    const r = box.getBoundingClientRect(), px = e.clientX - r.left, py = e.clientY - r.top;
    const n = Math.min(40, Math.max(1, k * Math.exp(-e.deltaY / 400)));
    x = n > 1 ? px - (px - x) * n / k : 0; y = n > 1 ? py - (py - y) * n / k : 0; k = n; show(); }, {passive: false});
  box.addEventListener("pointerdown", e => { from = [e.clientX - x, e.clientY - y]; box.setPointerCapture(e.pointerId); });
  box.addEventListener("pointermove", e => {
    if (from && k > 1) { x = e.clientX - from[0]; y = e.clientY - from[1]; show(); } });
  box.addEventListener("pointerup", () => { from = null; });
  box.addEventListener("dblclick", () => { k = 1; x = y = 0; show(); });
}
"""
_BOX = '<div class="zoom" style="overflow:hidden;cursor:grab;touch-action:none">{}</div>'
_ZOOMED = 'style="transform-origin:0 0" draggable="false"'

#: Figures by name, as PNG and as SVG; and what waits for some of them.
_Files = dict[str, tuple[bytes, bytes | None]]
Beside = Callable[[], _Files]


@dataclass(frozen=True)
class RunReport:
    """The contents of a report.

    Attributes:
        summary: the run in numbers.
        run: all tracks of the motions.
        before: the motions with potentiometers alone; None where they were not made.
        after: the same with the loop closed; None likewise.
        picture: (H, W, 3) BGR, the left image with the measured pose overlaid; None without.
        workcell: (H, W, 3) BGR, the workcell from aside; None on a real arm.
        notes: what was used, and what was left out and why, a line each.
    """

    summary: RunSummary
    run: RunData
    before: RunData | None
    after: RunData | None
    picture: Image | None
    workcell: Image | None
    notes: Sequence[str]


def write_run_report(report: RunReport, folder: Path, beside: Beside | None = None) -> Path:
    """Write the page and its PNGs.

    Args:
        report: the contents.
        folder: of the run.
        beside: waits for the figures that :func:`drawn_beside` has begun; None without one.

    Returns:
        The page, report.html.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written; then none of them is new.
    """
    files: dict[str, bytes] = {}
    embedded: dict[str, str] = {}
    for name, image in (("pose", report.picture), ("workcell", report.workcell)):
        if image is not None:
            files[f"{name}.png"] = cv2.imencode(".png", image)[1].tobytes()
            embedded[name] = _box("png", files[f"{name}.png"], name)
    for name, (pixels, lines) in _drawn(report, beside).items():
        files[f"{name}.png"] = pixels
        embedded[name] = "" if lines is None else _box("svg+xml", lines, name)
    put_files(folder, {**files, PAGE: _page(report, embedded).encode()})
    return folder / PAGE


def drawn_beside(report: RunReport, second: Callable[..., Any]) -> Beside:
    """Begin to draw about half of the figures in another process.

    Args:
        report: the contents; the picture of the workcell is not needed.
        second: calls a function in that process.

    Returns:
        What waits for them.
    """
    before, after = (None if run is None else _without_ways(run) for run in (report.before, report.after))
    shown = replace(report, run=_without_ways(report.run), before=before, after=after, workcell=None, notes=())
    pool = ThreadPoolExecutor(1)
    others = pool.submit(second, _files, shown, _BESIDE)
    pool.shutdown(wait=False)
    return others.result


def _drawn(report: RunReport, beside: Beside | None) -> _Files:
    """Return the figures by name, in their order: as PNG, and as SVG where the page shows them."""
    if beside is None:
        return _files(report, NAMES)
    found = _files(report, [name for name in NAMES if name not in _BESIDE]) | beside()
    return {name: found[name] for name in NAMES if name in found}


def _without_ways(run: RunData) -> RunData:
    """Return a run without its trajectories: another process gets none, and no figure shows one."""
    return replace(run, segments=tuple(replace(segment, trajectory=None) for segment in run.segments))


def _files(report: RunReport, names: Sequence[str]) -> _Files:
    """Draw figures by their names; those that the run has nothing for are left out."""
    found: _Files = {}
    with drawing():
        for name in names:
            figure = _figure(report, name)
            if figure is not None:
                found[name] = png(figure), None if name == "overview" else svg(figure)
    return found


def _figure(report: RunReport, name: str) -> Figure | None:
    """Return a figure; None where the run has nothing to plot."""
    before, after = report.before, report.after
    if name in _OF_RUN:
        return _OF_RUN[name](report.run)
    if name == "studies":
        return studies_figure(report.summary.studies) if report.summary.studies else None
    if before is None or after is None:
        return None
    if name == "loop":
        return loop_figure(before, after)
    return None if report.picture is None else overview_figure(report.picture, before, after)


#: Figures of all tracks of a run.
_OF_RUN: dict[str, Callable[[RunData], Figure | None]] = {
    "joints": joints_figure,
    "path": path_figure,
    "errors": errors_figure,
    "latency": latency_figure,
}
#: What a second process draws: about half of the work.
_BESIDE = ("path", "errors", "overview")


def _box(kind: str, data: bytes, name: str) -> str:
    """Return a figure as HTML that holds its own data and can be zoomed."""
    return _BOX.format(picture(data, name, kind=kind, attributes=_ZOOMED))


def _page(report: RunReport, figures: Mapping[str, str]) -> str:
    """Return the page; ``figures`` maps names to HTML images."""
    s = report.summary

    def shown(name: str, caption: str) -> str:
        return f"<figure>{figures[name]}<figcaption><p>{caption}</p></figcaption></figure>" if name in figures else ""

    tables = [html_table(each) for each in (track_table(s), loop_table(s)) if each is not None]
    sections = {
        "health": ("Do not trust this result", bullets([found.line() for found in s.health]) if s.health else ""),
        "result": ("Result", "".join(tables) + bullets(report.notes)),
        "images": (
            "Images",
            shown("pose", "The left camera's image with the measured pose.")
            + shown("workcell", "The workcell from aside."),
        ),
        "motion": (
            "Joint angles and tool path",
            shown("joints", "The joint angles over time, by their sensors, and reference; shaded: the arm rests.")
            + shown("path", "The tool's path: from the joint sensors, from vision, from both fused, and the truth."),
        ),
        "errors": (
            "Errors against the truth",
            shown("errors", "The error of each track over time, and the 95% band that the fused estimate claims."),
        ),
        "loop": (
            "Open loop and closed loop",
            shown("loop", "The same motions with the joint sensors alone and with vision in the loop."),
        ),
        "latency": (
            "Latency",
            shown(
                "latency",
                "Computing time from a decoded image to its command while the body is followed; decoding and the camera's "
                "own delay are not in it, nor are searches of a lost body, beside which commands continue.",
            ),
        ),
        "studies": (
            "What the error depends on",
            shown(
                "studies",
                "Measured errors with their 95% intervals (from the number of shots), and those the covariance predicts.",
            ),
        ),
    }
    kept = {anchor: section for anchor, section in sections.items() if section[1]}
    p = s.properties
    sub = f"{p['arm']} · {p['cameras']} · seed {p['seed']}" if "seed" in p else str(p.get("arm", ""))
    return html_page("armsight: run", "A run of the arm, measured", sub, kept, _ZOOM)
