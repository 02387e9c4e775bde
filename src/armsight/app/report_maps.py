"""Two maps of a calibration's report: predicted sigma over the volume, and the board against its drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import griddata

from armsight.app.report.plotting import (INK, MUTED, WIDTH_IN, arrows, new_figure, nice)
from armsight.app.calibrate.assessment import HELD_M, board_drawing
from armsight.app.report_volume import SHARES, Slice, board_points, volume_slice
from armsight.data import Array
from armsight.vision.calibrate.result import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

_MOST_DOTS = 4000
#: The board's longer in-plane deviations are drawn as long as this share of its width.
_ARROW_SHARE = 0.06
_LEAST_MM = 1e-4
_FINE = 150
#: Colours do not tell shares apart that are less than one part in this of the least sigma of all.
_HARDLY = 20.0
#: Over a greater range than this only the powers of ten are marked.
_MANY = 500.0


def volume_figure(calibration: Calibration) -> Figure:
    """Predicted depth and lateral sigma over a slice of the volume: pixel noise, calibration, both together."""
    shown = volume_slice(calibration)
    boards = board_points(calibration).reshape(-1, 3)
    boards = boards[:: len(boards) // _MOST_DOTS + 1]
    left, right, near, far = _limits(calibration, shown)
    shape = (far - near) / (right - left)
    figure = new_figure(float(np.clip(0.56 * WIDTH_IN * shape, 2.0, 11.0)) + 1.3)
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    panels[0, 0].set(xlim=(left, right), ylim=(near, far))
    for row, (kind, sigma) in enumerate((("depth", shown.sigma_depth_m), ("lateral", shown.sigma_lateral_m))):
        millimetres = 1e3 * sigma
        low, high = _range(millimetres)
        for column, share in enumerate(SHARES):
            axes = panels[row, column]
            filled = _contours(axes, shown, millimetres[column], low, high)
            _scene(axes, calibration, shown, boards)
            axes.set_title(f"{kind} sigma: {share}")
            if row == 1:
                axes.set_xlabel(f"{'XY'[shown.axis]}, mm")
            axes.locator_params(axis="x", nbins=5)
            if column == 0:
                axes.set_ylabel("Z, mm")
        bar = figure.colorbar(filled, ax=panels[row], ticks=round_steps(low, high), format="%g", aspect=18, pad=0.01)
        bar.set_label(f"{kind} sigma, mm")
        bar.minorticks_off()
    return figure


def _limits(calibration: Calibration, shown: Slice) -> list[float]:
    """Return what the map must show, sideways and in depth, mm: all that both cameras see, and the cameras."""
    centres = np.stack([np.zeros(3), calibration.rig.T_left_right[:3, 3]])
    sideways = np.r_[shown.sideways_m[shown.seen.any(axis=0)], centres[:, shown.axis]]
    depth = np.r_[shown.depth_m, centres[:, 2]]
    wide, deep = np.ptp(sideways), np.ptp(depth)
    limits = (sideways.min() - 0.05 * wide, sideways.max() + 0.05 * wide, depth.min() - 0.1 * deep, depth.max())
    return [1e3 * float(value) for value in limits]


def _range(millimetres: Array) -> tuple[float, float]:
    """Return the colours' range for sigmas (3, D, W), mm: all of them, but for shares that hardly matter."""
    seen = millimetres[:, np.isfinite(millimetres[0])]
    if not seen.size:
        return 0.1, 1.0
    high = float(seen[-1].max())
    return float(np.clip(seen.min(), seen[-1].min() / _HARDLY, 0.9 * high)), high


def _contours(axes: Axes, shown: Slice, millimetres: Array, low: float, high: float) -> QuadMesh:
    """Colour the slice by sigma, mm, on a logarithmic scale, with labelled lines at 1, 2, 5, 10 ..."""
    from matplotlib.colors import LogNorm
    from matplotlib.patheffects import withStroke

    x, z = 1e3 * shown.sideways_m, 1e3 * shown.depth_m
    masked = np.ma.masked_invalid(np.maximum(millimetres, low))
    filled = axes.pcolormesh(x, z, masked, cmap="viridis_r", norm=LogNorm(low, high), shading="nearest")
    inside = [level for level in round_steps(low, high) if masked.min() < level < masked.max()]
    if inside:
        lines = axes.contour(x, z, masked, levels=inside, colors="white", linewidths=0.9)
        for text in axes.clabel(lines, fmt="%g", fontsize=8, colors="white"):
            text.set_path_effects([withStroke(linewidth=2, foreground=INK)])
    return filled


def round_steps(low: float, high: float) -> list[float]:
    """Return the values 1, 2, 5 times a power of ten from ``low`` to ``high``; of many, the powers of ten alone."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    factors = (1, 2, 5) if high < _MANY * low else (1,)
    return [m * 10.0**k for k in powers for m in factors if low <= m * 10.0**k <= high]


def _scene(axes: Axes, calibration: Calibration, shown: Slice, boards: Array) -> None:
    """Draw where the boards and the cameras were."""
    axes.plot(1e3 * boards[:, shown.axis], 1e3 * boards[:, 2], ".", color=INK, markersize=0.8, alpha=0.35)
    centre = 1e3 * calibration.rig.T_left_right[:3, 3]
    outward = 1 if centre[shown.axis] >= 0 else -1
    for name, x, z, side in (("left", 0.0, 0.0, -outward), ("right", centre[shown.axis], centre[2], outward)):
        axes.plot(x, z, marker="s", color=INK, markersize=5)
        ha = "left" if side > 0 else "right"
        axes.annotate(name, (x, z), (6 * side, 0), textcoords="offset points", ha=ha, va="center", color=MUTED)
    axes.set_aspect("equal")


def board_figure(calibration: Calibration) -> Figure | None:
    """How the board as estimated differs from its drawing: colour out of the plane, arrows within it, mm; None without."""
    drawing = board_drawing(calibration)
    if drawing is None or calibration.deviation_m < HELD_M:
        return None
    at, off = 1e3 * drawing[:, :2], 1e3 * (calibration.body.points - drawing)
    extent = np.ptp(at, axis=0)
    figure = new_figure(float(np.clip(0.75 * WIDTH_IN * extent[1] / extent[0], 3.0, 9.0)) + 0.8)
    axes = figure.subplots()
    margin = 0.08 * extent.max()
    axes.set(xlim=(at[:, 0].min() - margin, at[:, 0].max() + margin), aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.set_ylim(at[:, 1].max() + margin, at[:, 1].min() - margin)
    most = max(float(np.abs(off[:, 2]).max()), _LEAST_MM)
    across, down = (np.linspace(at[:, k].min(), at[:, k].max(), _FINE) for k in (0, 1))
    z = griddata(at, off[:, 2], (across[None, :], down[:, None]), method="cubic")
    filled = axes.contourf(across, down, z, levels=np.linspace(-most, most, 21), cmap="RdBu_r", extend="both")
    axes.plot(*at.T, ".", color=INK, markersize=2)
    usual = max(float(np.quantile(np.linalg.norm(off[:, :2], axis=1), 0.9)), _LEAST_MM)
    enlarged = nice(_ARROW_SHARE * float(extent[0]) / usual)
    arrows(axes, at, off[:, :2], enlarged, INK, 0.003, "mm", 0.03)
    axes.set_title(f"colour: out of the plane; arrows: within it, x{enlarged:g}")
    bar = figure.colorbar(filled, ax=axes, label="z, mm (+ is into the board)", format="%.3g", aspect=25)
    bar.set_ticks(list(np.linspace(-most, most, 5)))
    return figure
