"""The report of an arm for its owner: one page, the same as a PDF, and one JSON that others can compare."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.app.arm.evaluate import SURE, VERSION, ArmReport, JointFigures
from armsight.app.show.page import PAGE, writable_folder
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, arrows, drawing, new_figure, panels
from armsight.app.show.report import Grade, Lines, Plot, Report, Section
from armsight.app.show.table import TextTable
from armsight.errors import InputError
from armsight.files import read_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure, FigureBase

FILES = (PAGE, "report.pdf", "report.json")


#: What the arm does: title, key of report.json, unit.
_NUMBERS = (
    ("distance from the command, RMS", "accuracy_rms_mm", "mm"),
    ("distance from the command, largest", "accuracy_max_mm", "mm"),
    ("RMS after base and tool were fitted", "placed_mm", "mm"),
    ("accuracy AP of poses that came again, mean", "pose_accuracy_mm", "mm"),
    ("repeatability RP, from one side", "one_side_mm", "mm"),
    ("between both sides, mean distance", "both_sides_mean_mm", "mm"),
    ("between both sides, largest", "both_sides_max_mm", "mm"),
    ("drift", "drift_mm_per_h", "mm/h"),
    ("sigma of the drift", "drift_sigma_mm_per_h", "mm/h"),
    ("command to motion", "latency_s", "s"),
    ("noise of vision, one shot", "noise_mm", "mm"),
)
#: Of a joint: title, what the record calls it, digits.
_OF_JOINT = (
    ("zero, deg", "zero_deg", 3),
    ("backlash, deg", "backlash_deg", 3),
    ("sides, deg", "hysteresis_deg", 3),
    ("droop, deg/m", "droop_deg_per_m", 2),
    ("most, deg", "droop_deg", 2),
    ("once per rev., deg", "once_per_revolution_deg", 3),
    ("latency, s", "latency_s", 3),
)


def _text(value: float | tuple[float, float] | None, digits: int = 3) -> str:
    """Return a number, or one with its sigma, as far as it is determined."""
    if value is None:
        return "–"
    if not isinstance(value, tuple):
        return f"{value:.{digits}f}"
    sigma = f"± {value[1]:.{digits}f}"
    shown = determined(value) or not float(sigma[2:])  # a sigma of 0.000 determines a value of 0.000
    return f"{value[0]:.{digits}f} {sigma}" if shown else f"not determined ({sigma})"


def determined(value: tuple[float, float] | None) -> bool:
    """Return whether a value is more than chance, by its sigma."""
    return value is not None and abs(value[0]) > SURE * value[1]


def tables(report: ArmReport, others: Mapping[str, dict[str, Any]]) -> list[TextTable]:
    """Return the tables of a report; ``others`` are the JSON objects of other arms by their names."""
    columns = [report.to_json(), *others.values()]
    does = tuple(
        (title, *("–" if each.get(key) is None else f"{each[key]:.3f} {unit}" for each in columns))
        for title, key, unit in _NUMBERS
        if any(each.get(key) is not None for each in columns)
    )
    parts = list[tuple[str, ...]]()
    for name, p in report.parts.items():
        known = f"{round(100 * p.share)} %", f"{p.rms_mm:.3f} ± {p.sigma_mm:.3f}"
        shown = known if p.determined else ("not determined", f"± {p.sigma_mm:.3f}")
        parts.append((name, *shown, f"{p.without_mm:.3f}" if p.remedy and p.determined else "–", p.remedy))
    joints = tuple(
        (j.name, *(_text(getattr(j, key), digits) if _shown(j, key) else "–" for _, key, digits in _OF_JOINT))
        for j in report.joints
    )
    title = f"What the {report.accuracy_mm[0]:.2f} mm are made of, and what each remedy alone would leave"
    return [
        TextTable(title, ("", "share", "itself, mm", "left by the remedy, mm", "remedy"), tuple(parts)),
        TextTable("What the arm does", ("", report.arm, *others), does),
        TextTable("Joints; sigma after ±", ("", *(title for title, *_ in _OF_JOINT)), joints),
    ]


def _shown(joint: JointFigures, key: str) -> bool:
    return key != "droop_deg" or determined(joint.droop_deg_per_m)  # a droop at most only where there is one


def remarks(report: ArmReport) -> list[str]:
    """Return what a reader must know beside the tables."""
    lines = [*(f"do not trust this recording: {line}" for line in report.health), *report.notes]
    lines += [
        "Zero: true angle less reading; that of the first and of the last joint looks like another base and another tool.",
        "Backlash: behind the joint's sensor. Sides: reading from above less from below, at the same command. Droop: "
        "reading less command for a metre of the gravity load's lever.",
        "What is smaller than twice its sigma is not determined: these poses distinguish it too little from zero, "
        "or from another part.",
        "Each part is what it moves the tool by, RMS, in the frames of the run; parts may cancel each other: then a "
        "share is negative. Controller: readings less commands, such as the droop under gravity.",
    ]
    lines += ["Drift has no temperature beside it: runs do not record any."] if report.drift_mm_per_h else []
    return lines + [f"backlash of {j.name}: {j.backlash_how}" for j in report.joints if j.backlash_deg is None]


def _map_figure(report: ArmReport, figure: FigureBase) -> None:
    at, off = 1e3 * report.at, 1e3 * report.off
    size = np.linalg.norm(off, axis=1)
    enlarged = 0.08 * float(np.ptp(at[:, :2], axis=0).max()) / max(float(np.quantile(size, 0.9)), 1e-6)
    both = figure.subplots(1, 2)
    for axes, (i, k), title in zip(both, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        shown = axes.scatter(at[:, i], at[:, k], c=size, s=18, cmap="viridis", vmin=0)
        axes.margins(0.15)
        axes.set_aspect("equal", adjustable="datalim")
        axes.locator_params(nbins=5)
        arrows(axes, at[:, [i, k]], off[:, [i, k]], enlarged, INK, 0.003, "mm", 0.05)
        axes.set(title=f"error, {title}", xlabel="x, mm", ylabel=f"{'xyz'[k]}, mm")
    figure.colorbar(shown, ax=both, label="mm", shrink=0.8)


def _parts_figure(report: ArmReport, figure: FigureBase) -> None:
    left, right = figure.subplots(1, 2)
    names = [name for name, part in report.parts.items() if part.determined][::-1]
    rows = np.arange(len(names))
    left.barh(rows, [100 * report.parts[name].share for name in names], color=BLUE, height=0.65)
    left.set_yticks(rows, names)
    left.set_xlabel("share of the mean square error, %")
    left_over = [part.without_mm if part.remedy else 0.0 for part in (report.parts[name] for name in names)]
    right.barh(rows, left_over, color=ORANGE, height=0.65)
    right.axvline(report.accuracy_mm[0], color=MUTED, linewidth=1)
    right.set_yticks(rows, [""] * len(rows))
    right.set_xlabel("RMS error with its remedy alone, mm (line: as it is)")


def _joints_figure(report: ArmReport, figure: FigureBase) -> None:
    for i, axes in enumerate(panels(figure, len(report.joints))):
        axes.scatter(1e3 * report.lever[:, i], np.degrees(report.lag[:, i]), s=8, color=BLUE)
        if (slope := report.joints[i].droop_deg_per_m) is not None:
            lever, mean = report.lever[:, i], float(np.degrees(report.lag[:, i].mean()))
            ends = np.array([lever.min(), lever.max()])
            axes.plot(1e3 * ends, mean + slope[0] * (ends - lever.mean()), color=RED, linewidth=1)
        axes.set(title=report.joints[i].name, xlabel="lever of the load, mm", ylabel="difference, deg")
        low, high = axes.get_xlim()
        if high - low < 1.0:  # a joint that gravity does not load: no digits of rounding
            axes.set_xlim((low + high) / 2 - 0.5, (low + high) / 2 + 0.5)


def _drift_figure(report: ArmReport, figure: FigureBase) -> None:
    axes = figure.subplots()
    axes.plot(60 * report.drift[:, 0], report.drift[:, 1], color=BLUE, marker="o", markersize=3)
    axes.set(title=f"one pose, {report.cycles} times", xlabel="min", ylabel="mm from the first visit")


#: Name -> caption, height in inches, and what draws it.
_FIGURES: dict[str, tuple[str, float, Callable[[ArmReport, FigureBase], None]]] = {
    "parts": ("What explains the error, and what each remedy alone would leave.", 3.2, _parts_figure),
    "map": ("The error over the workspace after base and tool were fitted, enlarged.", 4.6, _map_figure),
    "joints": ("What each joint lacks of its command by its sensor, against the gravity load.", 4.6, _joints_figure),
    "drift": ("The pose that came most often.", 2.8, _drift_figure),
}
_PAGE = 13.0  # height of a page of the PDF, inches


def arm_report(report: ArmReport, others: Mapping[str, dict[str, Any]]) -> Report:
    """Return what a run shows of an arm; ``others`` are the JSON objects of other arms by their names."""
    heading = f"{report.arm}: {report.accuracy_mm[0]:.2f} mm RMS, {report.placed_mm:.2f} with another base and tool"
    sub = f"{report.poses} poses, {report.rests} rests in {60 * report.hours:.2g} min; controller: {report.board}"
    plots = [Plot(name, partial(_figure, report, name), caption, caption) for name, (caption, *_) in _FIGURES.items()]
    sections: dict[str, Section] = {
        "figures": ("In numbers", tables(report, others)),
        "notes": ("Notes", [Lines(remarks(report))]),
        "plots": ("Figures", plots),
    }
    return Report("arm report", heading, sub, "", sections, values=report.to_json(), assessed=assess(report))


def assess(report: ArmReport) -> tuple[Grade, str]:
    """Return the grade of a report, and in one sentence how far the arm is off and which remedy to begin with."""
    off, most = report.accuracy_mm
    said = f"the arm is off by {off:.2f} mm RMS, {most:.2f} at most"
    if report.health:
        return "poor", f"Do not use this report: {report.health[0]}; mend that, and record the run again."
    known = [part for part in report.parts.values() if part.determined and part.remedy and part.without_mm < off]
    if not known:
        return "fair", f"Usable with care: {said}, and no remedy here would lower that for certain; record more poses."
    best = min(known, key=lambda part: part.without_mm)
    after = f"begin with this remedy, which alone leaves {best.without_mm:.2f} mm: {best.remedy}"
    if 2 * best.without_mm > off:
        return "fair", f"Usable: {said}, and no remedy alone halves it; {after}."
    return "good", f"Good: {said}, and most of that is explained; {after}."


def write_report(report: Report, found: ArmReport, folder: Path) -> None:
    """Write JSON, then page, figures and PDF into a folder."""
    write_text(writable_folder(folder, "no report") / "report.json", report.json_text())
    with drawing():
        pdf = _pdf([_text_page(report), _figures_page(found)])
    report.write(folder, {"report.pdf": pdf})


def _text_page(report: Report) -> Figure:
    figure = new_figure(_PAGE)
    figure.set_layout_engine(None)
    lines = "\n".join(textwrap.fill(line, 150, subsequent_indent="  ") for line in report.text().split("\n"))
    figure.text(0.04, 0.97, report.heading, fontsize=16, va="top", weight="bold")
    figure.text(0.04, 0.945, report.sub, fontsize=9, va="top", color=MUTED)
    figure.text(0.04, 0.915, lines, fontsize=7, va="top", family="monospace", linespacing=1.35)
    return figure


def _figure(report: ArmReport, name: str) -> Figure:
    _, height, draw = _FIGURES[name]
    figure = new_figure(height)
    draw(report, figure)
    return figure


def _figures_page(report: ArmReport) -> Figure:
    figure = new_figure(_PAGE)
    heights = [height for _, height, _ in _FIGURES.values()]
    parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights, hspace=0.05)[:, 0]
    for part, (caption, _, draw) in zip(parts, _FIGURES.values(), strict=True):
        draw(report, part)
        part.suptitle(caption, fontsize=9, color=MUTED)
    return figure


def _pdf(figures: Sequence[Figure]) -> bytes:
    from matplotlib.backends.backend_pdf import PdfPages

    data = io.BytesIO()
    nothing: dict[str, Any] = {"CreationDate": None, "Creator": "armsight", "Producer": None}
    with PdfPages(data, metadata=nothing) as book:
        for figure in figures:
            book.savefig(figure)
    return data.getvalue()


def read_report(path: Path) -> dict[str, Any]:
    """Read the report.json of another arm, or raise InputError: it is none, or of another version."""
    found = read_json(path)
    if not isinstance(found, dict) or found.get("kind") != "arm report":
        raise InputError(f"{path}: no report of an arm; armsight arm report RUN -o DIR writes DIR/report.json")
    if found.get("version") != VERSION:
        raise InputError(f"{path}: is of version {found.get('version')}; this armsight reads {VERSION}")
    return found
