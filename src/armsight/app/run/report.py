"""The report of a run: one page that holds its figures, to be zoomed with the wheel, and each as a PNG beside it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from armsight.app.report.page import html_page, put_files
from armsight.app.report.plotting import drawing, png, svg
from armsight.app.report_tables import bullets, table, text
from armsight.app.run_data import RunData
from armsight.app.run_figures import errors_figure, joints_figure, latency_figure, loop_figure, path_figure
from armsight.app.run_overview import overview_figure
from armsight.app.demo.studies import Study
from armsight.app.study_figure import studies_figure
from armsight.data import Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.html"
#: Names of the figures; each is a PNG beside the page.
FIGURES = ("joints", "path", "errors", "loop", "latency", "studies", "overview")
_DEG = float(np.degrees(1.0))
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
_NAMES = {"fused": "fused, smoothed (0.6 s later)", "live": "fused, live"}
_BOX = '<div class="zoom" style="overflow:hidden;cursor:grab;touch-action:none">{}</div>'
_IMG = '<img src="data:image/{};base64,{}" alt="{}" style="transform-origin:0 0" draggable="false">'


@dataclass(frozen=True)
class RunReport:
    """What a report is made of.

    Attributes:
        summary: the run's figures (summary.json).
        run: all of it.
        before: the motions with potentiometers alone; None where they were not made.
        after: the same with the loop closed; None likewise.
        studies: error against one thing after the other.
        picture: (H, W, 3) BGR, the left image with the measured pose drawn in; None without.
        cell: (H, W, 3) BGR, the workcell seen from aside; None on a real arm.
        notes: what was used, what was thrown away and why, a line each.
    """

    summary: Mapping[str, Any]
    run: RunData
    before: RunData | None
    after: RunData | None
    studies: Sequence[Study]
    picture: Image | None
    cell: Image | None
    notes: Sequence[str]


def write_run_report(report: RunReport, folder: Path) -> Path:
    """Write the page and its PNGs.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written; then none of them is new.
    """
    files: dict[str, bytes] = {}
    embedded: dict[str, str] = {}
    for name, image in (("pose", report.picture), ("cell", report.cell)):
        if image is not None:
            files[f"{name}.png"] = cv2.imencode(".png", image)[1].tobytes()
            embedded[name] = _box("png", files[f"{name}.png"], name)
    with drawing():
        for name, figure in _figures(report).items():
            if figure is not None:
                files[f"{name}.png"] = png(figure)
                embedded[name] = _box("svg+xml", svg(figure), name) if name != "overview" else ""
    put_files(folder, {**files, PAGE: _page(report, embedded).encode()})
    return folder / PAGE


def _figures(report: RunReport) -> dict[str, Figure | None]:
    """Draw everything there is to draw."""
    both = report.before is not None and report.after is not None
    return {
        "joints": joints_figure(report.run),
        "path": path_figure(report.run),
        "errors": errors_figure(report.run),
        "loop": loop_figure(report.before, report.after) if both else None,  # type: ignore[arg-type]
        "latency": latency_figure(report.run),
        "studies": studies_figure(report.studies) if report.studies else None,
        "overview": overview_figure(report.picture, report.before, report.after)
        if report.picture is not None and report.before is not None and report.after is not None
        else None,
    }


def _box(kind: str, data: bytes, name: str) -> str:
    """Return a figure as HTML that holds its own data and can be zoomed."""
    return _BOX.format(_IMG.format(kind, base64.b64encode(data).decode("ascii"), text(name)))


def _page(report: RunReport, figures: Mapping[str, str]) -> str:
    """Return the page."""
    s = report.summary

    def shown(name: str, caption: str) -> str:
        return f"<figure>{figures[name]}<figcaption><p>{caption}</p></figcaption></figure>" if name in figures else ""

    sections = {
        "result": ("Result", _tracks(s) + _loop(s) + bullets(report.notes)),
        "seen": (
            "What was seen",
            shown("pose", "The left camera's image with the measured pose drawn in.")
            + shown("cell", "The cell from aside."),
        ),
        "motion": (
            "The chapter's figures",
            shown(
                "joints",
                "Figure 18.8: the six joint angles, potentiometers and reference; the arm rests where it is shaded.",
            )
            + shown("path", "Figure 18.9: the tool's path from potentiometers, from vision, from both, and as it was."),
        ),
        "errors": (
            "What the chapter left out",
            shown(
                "errors",
                "Errors against the truth, and the band that the fused estimate claims for its own.",
            ),
        ),
        "loop": (
            "The loop closed",
            shown("loop", "The same motions with potentiometers alone and with vision in the loop."),
        ),
        "latency": (
            "From image to command",
            shown("latency", "Our time; decoding and the camera's own delay come on top."),
        ),
        "studies": (
            "What the error depends on",
            shown(
                "studies",
                "Measured, with the interval that the number of shots allows, and what the covariance foretold.",
            ),
        ),
    }
    kept = {anchor: section for anchor, section in sections.items() if section[1]}
    sub = f"{s['arm']} · {s['cameras']} · seed {s['seed']}" if "seed" in s else str(s.get("arm", ""))
    return html_page("armsight: run", "What the arm really did", sub, kept, _ZOOM)


def _tracks(s: Mapping[str, Any]) -> str:
    """Return the table of the three tracks."""
    rows = []
    for name in ("potentiometers", "vision", "fused", "live"):
        t = s.get(name)
        if t is None or "position_rms_m" not in t:
            continue
        sigma = (
            f"{1e3 * t['position_sigma_rms_m']:.3f} mm, {_DEG * t['orientation_sigma_rms_rad']:.3f} deg"
            if "position_sigma_rms_m" in t
            else "–"
        )
        inside = f"{100 * t['inside_95_share']:.0f}%" if "inside_95_share" in t else "–"
        rows.append(
            (
                _NAMES.get(name, name),
                f"<b>{1e3 * t['position_rms_m']:.3f}</b>",
                f"{1e3 * t['position_max_m']:.3f}",
                f"<b>{_DEG * t['orientation_rms_rad']:.3f}</b>",
                f"{_DEG * t['orientation_max_rad']:.3f}",
                sigma,
                inside,
            )
        )
    head = (
        "against the truth, in motion",
        "RMS, mm",
        "max, mm",
        "RMS, deg",
        "max, deg",
        "sigma claimed",
        "truth inside 95%",
    )
    return table(head, rows, "numbers") if rows else ""


def _loop(s: Mapping[str, Any]) -> str:
    """Return the table of what closing the loop gained."""
    c = s.get("closed_loop")
    if not c:
        return ""
    rows = [
        (
            what,
            f"{1e3 * c[f'{key}_error_before_m']:.3f}",
            f"<b>{1e3 * c[f'{key}_error_after_m']:.3f}</b>",
            f"{c[f'{key}_error_before_m'] / c[f'{key}_error_after_m']:.1f}",
        )
        for what, key in (("at rest", "rest"), ("along the path", "path"))
        if f"{key}_error_after_m" in c
    ]
    return table(
        ("error of the tool, RMS", "potentiometers alone, mm", "loop closed, mm", "times smaller"), rows, "numbers"
    )
