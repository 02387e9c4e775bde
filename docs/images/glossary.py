"""Draw the ten words that every page uses: ``python docs/images/glossary.py`` writes glossary.svg beside itself."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, FancyArrowPatch, Polygon, Rectangle

INK, BLUE, RED, PALE = "#333333", "#1f6fb4", "#c8401f", "#d9e6f2"


def _line(axes: Axes, x: list[float], y: list[float], color: str = INK, width: float = 1.5, style: str = "-") -> None:
    axes.plot(x, y, style, color=color, lw=width, solid_capstyle="round")


def _arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], color: str = RED, both: bool = False
) -> None:
    axes.add_patch(
        FancyArrowPatch(start, end, arrowstyle="<->" if both else "->", mutation_scale=11, color=color, lw=1.4)
    )


def _words(axes: Axes, x: float, y: float, text: str, color: str = INK) -> None:
    axes.text(x, y, text, ha="center", va="center", fontsize=8.5, color=color)


def _camera(axes: Axes, x: float, y: float) -> None:
    axes.add_patch(Rectangle((x - 0.06, y - 0.05), 0.12, 0.1, fc=PALE, ec=INK))
    axes.add_patch(
        Polygon([[x - 0.03, y + 0.05], [x + 0.03, y + 0.05], [x + 0.05, y + 0.1], [x - 0.05, y + 0.1]], fc=INK)
    )


def _plate(axes: Axes, x: float, y: float, size: float) -> None:
    axes.add_patch(Rectangle((x - size, y - size), 2 * size, 2 * size, fc=INK))
    for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.45, 0.35)):
        axes.plot(x + size * dx, y + size * dy, "o", color="white", ms=22 * size)


def _rig(axes: Axes) -> None:
    _camera(axes, 0.25, 0.3)
    _camera(axes, 0.75, 0.3)
    _line(axes, [0.25, 0.75], [0.2, 0.2])
    _arrow(axes, (0.25, 0.1), (0.75, 0.1), both=True)
    _words(axes, 0.5, 0.03, "baseline", RED)
    for x in (0.25, 0.75):
        _line(axes, [x, 0.5], [0.42, 0.85], BLUE, 1.0, "--")
    axes.plot(0.5, 0.85, "o", color=BLUE)


def _body(axes: Axes) -> None:
    _plate(axes, 0.5, 0.5, 0.3)
    _arrow(axes, (0.35, 0.35), (0.65, 0.35), both=True)
    _words(axes, 0.5, 0.1, "distances are known", RED)


def _shot(axes: Axes) -> None:
    for x, dx, name in ((0.27, 0.04, "left"), (0.73, -0.04, "right")):
        axes.add_patch(Rectangle((x - 0.2, 0.32), 0.4, 0.36, fc=PALE, ec=INK))
        _plate(axes, x + dx, 0.5, 0.08)
        _words(axes, x, 0.24, name)
    _words(axes, 0.5, 0.85, "12:00:00.033", RED)


def _held_out(axes: Axes) -> None:
    for row in range(5):
        for column in range(5):
            left = row == column
            axes.add_patch(
                Rectangle(
                    (0.12 + 0.15 * column, 0.75 - 0.13 * row), 0.13, 0.1, fc=RED if left else PALE, ec=INK, lw=0.8
                )
            )
    _words(axes, 0.5, 0.12, "blue: fit; red: evaluated")


def _sigma(axes: Axes) -> None:
    x = np.linspace(-3, 3, 121)
    y = 0.2 + 0.6 * np.exp(-(x**2) / 2)
    axes.fill_between(0.5 + x * 0.15, 0.2, y, where=np.abs(x) <= 1, color=PALE)
    _line(axes, list(0.5 + x * 0.15), list(y))
    _arrow(axes, (0.5, 0.56), (0.65, 0.56), both=True)
    _words(axes, 0.58, 0.49, r"$\sigma$", RED)
    _words(axes, 0.5, 0.1, "68 % lie within")


def _nees(axes: Axes) -> None:
    axes.add_patch(Ellipse((0.42, 0.5), 0.6, 0.3, angle=25, fc=PALE, ec=INK))
    axes.plot(0.42, 0.5, "o", color=BLUE, ms=4)
    axes.plot(0.78, 0.77, "x", color=RED)
    _arrow(axes, (0.42, 0.5), (0.775, 0.765))
    _words(axes, 0.83, 0.87, "truth", RED)
    _words(axes, 0.5, 0.1, "error over claimed sigma")


def _epipolar(axes: Axes) -> None:
    axes.add_patch(Rectangle((0.02, 0.3), 0.44, 0.45, fc="white", ec=INK))
    axes.add_patch(Rectangle((0.54, 0.3), 0.44, 0.45, fc="white", ec=INK))
    axes.plot(0.25, 0.55, "o", color=BLUE, ms=5)
    _line(axes, [0.54, 0.98], [0.45, 0.62], BLUE)
    axes.plot(0.76, 0.64, "o", color=BLUE, ms=5)
    _arrow(axes, (0.76, 0.535), (0.755, 0.645))
    _words(axes, 0.5, 0.15, "distance from the line", RED)


def _hand_eye(axes: Axes) -> None:
    _line(axes, [0.2, 0.2, 0.55, 0.78], [0.1, 0.5, 0.78, 0.6], INK, 5)
    _line(axes, [0.08, 0.32], [0.1, 0.1], INK, 4)
    _plate(axes, 0.85, 0.5, 0.08)
    _camera(axes, 0.6, 0.15)
    _camera(axes, 0.85, 0.15)
    _arrow(axes, (0.25, 0.14), (0.53, 0.17))
    _arrow(axes, (0.8, 0.72), (0.95, 0.52))
    _words(axes, 0.4, 0.24, "1", RED)
    _words(axes, 0.94, 0.7, "2", RED)


def _backlash(axes: Axes) -> None:
    for x, color in ((0.28, PALE), (0.62, PALE)):
        axes.add_patch(Polygon([[x, 0.2], [x + 0.16, 0.2], [x + 0.12, 0.6], [x + 0.04, 0.6]], fc=color, ec=INK))
    axes.add_patch(Polygon([[0.41, 0.85], [0.57, 0.85], [0.53, 0.4], [0.45, 0.4]], fc="white", ec=INK))
    _arrow(axes, (0.52, 0.5), (0.66, 0.5), both=True)
    _words(axes, 0.5, 0.1, "free travel of the teeth", RED)


def _droop(axes: Axes) -> None:
    _line(axes, [0.1, 0.85], [0.7, 0.7], INK, 1.2, "--")
    _line(axes, [0.1, 0.83], [0.7, 0.5], INK, 5)
    axes.plot(0.1, 0.7, "o", color=INK, ms=9)
    _arrow(axes, (0.85, 0.7), (0.85, 0.5))
    _words(axes, 0.72, 0.8, "goal")
    _words(axes, 0.75, 0.36, "under load", RED)


PANELS = {
    "rig": _rig,
    "body": _body,
    "shot": _shot,
    "held out": _held_out,
    "sigma": _sigma,
    "NEES": _nees,
    "epipolar distance": _epipolar,
    "hand-eye calibration": _hand_eye,
    "backlash": _backlash,
    "droop": _droop,
}


def main() -> None:
    """Draw all panels and write the file."""
    mpl.rcParams["svg.hashsalt"] = "glossary"
    figure, axes = plt.subplots(2, 5, figsize=(11, 4.8), facecolor="white")
    for each, (name, draw) in zip(axes.flat, PANELS.items(), strict=True):
        each.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xticks=[], yticks=[])
        each.set_title(name, fontsize=10, fontweight="bold", color=INK)
        for spine in each.spines.values():
            spine.set_color("#cccccc")
        draw(each)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_suffix(".svg"), metadata={"Date": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
