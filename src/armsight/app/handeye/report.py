"""The page of a hand-eye calibration: one HTML file that holds its figures, and the figures as PNG files beside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armsight.app.handeye.result import (
    HandEyeAnswer,
    blunders,
    headline,
    names,
    plan_table,
    statements,
    transforms_table,
    untrusted,
)
from armsight.app.report.page import PAGE, bullets, html_page, picture, put_files, text
from armsight.app.report.plotting import BLUE, INK, MUTED, ORANGE, RED, drawing, new_figure, png
from armsight.app.report.table import html_table
from armsight.geometry.pose import inverse, log_se3, mean_pose, transform

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def errors_figure(run: HandEyeAnswer) -> Figure:
    """Plot the error of each pose left out, and how far each is from the others."""
    figure = new_figure(6.6)
    axes = figure.subplots(3, 1, sharex=True)
    found, n = run.found, len(run.found.used)
    lines = run.recording.robot.lines[run.recording.rows]
    by_line = run.offset_s is None and len(np.unique(lines)) == n
    at = np.asarray(lines if by_line else np.arange(n))
    width = 0.9 if n < 100 else 1.0
    axes[0].bar(at, 1e3 * np.nan_to_num(found.held_out.position_m), color=BLUE, width=width)
    axes[0].set_title("left out: distance of the target's middle, mm")
    axes[1].bar(at, np.degrees(np.nan_to_num(found.held_out.angle_rad)), color=BLUE, width=width)
    axes[1].set_title("left out: angle, deg")
    axes[2].bar(at, np.sqrt(found.distance), color=np.where(found.used, MUTED, RED), width=width)
    axes[2].set_yscale("log")
    axes[2].set_title("residual over its sigma; red: a blunder, left out of the fit")
    axes[2].set_xlabel("line of the robot's table" if by_line else "pose")
    axes[2].xaxis.get_major_locator().set_params(integer=True)
    return figure


def sigma_figure(run: HandEyeAnswer) -> Figure:
    """Plot the sigmas of both transforms."""
    figure = new_figure(3.0)
    axes = figure.subplots(1, 2)
    sigma = np.sqrt(np.diag(run.found.cov))
    held, still = names(run)
    at = np.arange(3)
    for ax, rows, factor, unit in ((axes[0], slice(0, 3), 1e3, "mm"), (axes[1], slice(3, 6), np.degrees(1.0), "deg")):
        ax.bar(at - 0.2, factor * sigma[6:][rows], width=0.38, color=BLUE, label=held)
        ax.bar(at + 0.2, factor * sigma[:6][rows], width=0.38, color=ORANGE, label=still)
        ax.set_xticks(at, ["x", "y", "z"])
        ax.set_title(f"sigma along or about the frame's own axes, {unit}")
    axes[0].margins(y=0.25)  # room above the bars
    axes[0].legend(loc="upper center", ncols=2)
    return figure


def structure_figure(run: HandEyeAnswer) -> Figure:
    """Plot how probable the poses left out are under each choice of sources."""
    ranked = sorted(run.found.likelihoods.items(), key=lambda one: one[1])
    figure = new_figure(0.34 * len(ranked) + 1.2)
    ax = figure.subplots()
    best = ranked[-1][1]
    ax.barh([name for name, _ in ranked], [value - best for _, value in ranked], color=BLUE, height=0.6)
    for row, (_, value) in enumerate(ranked):
        ax.text(value - best, row, f"{value - best:.2f} ", va="center", ha="right", color=INK)
    ax.margins(x=0.15)
    ax.set_xlabel("mean log density of a pose left out, less that of the best")
    return figure


def coverage_figure(run: HandEyeAnswer) -> Figure:
    """Plot which rotations the flange made, and where the target was seen."""
    figure = new_figure(3.6)
    left, right = figure.subplots(1, 2)
    p, used = run.recording.poses, run.found.used
    rotated = np.degrees(log_se3(inverse(mean_pose(p.A)) @ p.A)[:, 3:])
    for other, colour, label in ((1, BLUE, "x and y"), (2, ORANGE, "x and z")):
        left.scatter(rotated[used, 0], rotated[used, other], s=14, color=colour, label=label, linewidths=0)
    left.set_aspect("equal", adjustable="datalim")
    left.set_title("rotation vector from the mean pose, flange, deg")
    left.legend()
    seen = transform(p.B, p.centre)
    shown = right.scatter(
        1e3 * seen[used, 0], 1e3 * seen[used, 1], s=18, c=1e3 * seen[used, 2], cmap="viridis", linewidths=0
    )
    right.set_aspect("equal", adjustable="datalim")
    right.invert_yaxis()
    right.set_title("middle of the target in the camera: x, y, mm")
    figure.colorbar(shown, ax=right, label="depth, mm")
    return figure


#: Name -> the function that plots it, its title and its caption.
FIGURES: dict[str, tuple[Callable[[HandEyeAnswer], Figure], str, str]] = {
    "errors": (
        errors_figure,
        "Errors on poses left out",
        "Each was predicted by a fit to others. Where all is well none stands out, and nothing drifts from first to last.",
    ),
    "sigma": (
        sigma_figure,
        "How well the transforms are known",
        "A bar that stands out is the direction to rotate more in.",
    ),
    "structure": (
        structure_figure,
        "Whose error it is",
        "The longer the bar, the less these sources of error explain the poses left out. A difference below 0.2 is "
        "chance.",
    ),
    "coverage": (
        coverage_figure,
        "Motion and views",
        "Good: rotations spread in both colours, by 20 degrees and more; points on a line are rotations about one axis.",
    ),
}


def write_handeye_report(run: HandEyeAnswer, folder: Path) -> None:
    """Write report.html and its figures into an existing folder.

    Raises:
        InputError: matplotlib is missing, or the folder cannot be written to.
    """
    with drawing():
        images = {name: png(plot(run)) for name, (plot, _, _) in FIGURES.items()}
    doubts = "".join(f'<p class="headline">do not trust this result: {text(why)}</p>' for why in untrusted(run))
    result = (
        f'<div class="assessment">{doubts}<p class="headline">{text(headline(run))}</p></div>\n'
        + html_table(transforms_table(run))
        + bullets([*statements(run), *run.recording.notes])
    )
    sections = {"result": ("Result", result)}
    for name, (_, title, caption) in FIGURES.items():
        image = picture(images[name], title)
        sections[name] = (title, f"<figure>{image}<figcaption><p>{text(caption)}</p></figcaption></figure>\n")
    sections["blunders"] = ("Blunders", bullets(blunders(run) or ["none"]))
    if run.plan is not None:
        sections["plan"] = ("Poses to take next", html_table(plan_table(run.plan, run.recording.names)))
    sub = f"{run.recording.robot.path.name} · {len(run.found.used)} poses · eye {run.found.eye.replace('_', ' ')}"
    page = html_page("armsight: hand-eye calibration", "Hand-eye calibration", sub, sections)
    files = {f"report-{name}.png": data for name, data in images.items()}
    put_files(folder, {**files, PAGE: page.encode()})
