"""The figures of a calibration's report: predicted sigma, shape of the target, coverage, residuals, errors by pair."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import griddata

from armsight.app.calibrate.assessment import HELD_M, SHARES, target_points, volume_slice
from armsight.app.show.plotting import BLUE, EMPTY, INK, MUTED, ORANGE, RED, WIDTH_IN, arrows, new_figure, nice, plain
from armsight.data import SIDES, Array
from armsight.vision.calibrate.result import Calibration
from armsight.vision.calibrate.weak import COVERAGE_GRID, coverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_DOTS = 4000
#: Cells of the coverage map along the longer side of the image, of the mean residuals, and of the target's map.
COVERAGE_CELLS, MEAN_CELLS, _FINE = 16, 9, 150
#: A cell's mean residual is plotted from this many corners on, and stands out beyond this many of its standard errors.
_LEAST_IN_CELL, STANDS_OUT = 5, 4.0
#: The longer residuals are plotted as long as this share of the image's width; deviations, of the target's.
_ARROW_SHARE, _MAP_ARROW_SHARE, _LEAST_MM = 0.035, 0.06, 1e-4
#: Of more pairs, and of more residuals, than these only the worst, and a random choice, are plotted.
MOST_BARS, MOST_ARROWS = 60, 3000
#: A pair whose error is this many times the median stands out.
OUTSTANDING = 2.5
#: Sigmas below the least total sigma divided by this all have one colour.
_NEGLIGIBLE = 20.0
#: Over a greater range than this only the powers of ten are marked.
_WIDE_RANGE = 500.0


def volume_figure(calibration: Calibration) -> Figure:
    """Plot the predicted depth and lateral sigma over a slice of the volume: pixel noise, calibration, both together."""
    from matplotlib.colors import LogNorm
    from matplotlib.patheffects import withStroke

    shown, points = volume_slice(calibration), target_points(calibration).reshape(-1, 3)
    points = 1e3 * points[:: len(points) // _MOST_DOTS + 1]
    x, z, centre = 1e3 * shown.sideways_m, 1e3 * shown.depth_m, 1e3 * calibration.rig.T_left_right[:3, 3]
    sides, depths = np.r_[x[shown.seen.any(axis=0)], 0.0, centre[shown.axis]], np.r_[z, 0.0, centre[2]]
    left, right = sides.min() - 0.05 * np.ptp(sides), sides.max() + 0.05 * np.ptp(sides)
    near, far = depths.min() - 0.1 * np.ptp(depths), z.max()
    figure = new_figure(float(np.clip(0.56 * WIDTH_IN * (far - near) / (right - left), 2.0, 11.0)) + 1.3)
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    panels[0, 0].set(xlim=(left, right), ylim=(near, far))
    outward = 1 if centre[shown.axis] >= 0 else -1
    for row, (kind, sigma) in enumerate((("depth", shown.sigma_depth_m), ("lateral", shown.sigma_lateral_m))):
        low, high = _range(1e3 * sigma)
        for column, share in enumerate(SHARES):
            axes, masked = panels[row, column], np.ma.masked_invalid(np.maximum(1e3 * sigma[column], low))
            colours = {"cmap": "viridis_r", "norm": LogNorm(low, high)}
            colours |= {"shading": "nearest", "rasterized": True}  # as paths 12 MB of SVG
            filled = axes.pcolormesh(x, z, masked, **colours)
            if inside := [level for level in round_steps(low, high) if masked.min() < level < masked.max()]:
                lines = axes.contour(x, z, masked, levels=inside, colors="white", linewidths=0.9)
                for text in axes.clabel(lines, fmt="%g", fontsize=8, colors="white"):
                    text.set_path_effects([withStroke(linewidth=2, foreground=INK)])
            axes.plot(points[:, shown.axis], points[:, 2], ".", color=INK, markersize=0.8, alpha=0.35)
            for name, at, side in (("left", (0.0, 0.0), -outward), ("right", (centre[shown.axis], centre[2]), outward)):
                axes.plot(*at, marker="s", color=INK, markersize=5)
                ha = "left" if side > 0 else "right"
                axes.annotate(name, at, (6 * side, 0), textcoords="offset points", ha=ha, va="center", color=MUTED)
            axes.set(aspect="equal", title=f"{kind} sigma: {share}", ylabel="" if column else "Z, mm")
            axes.set_xlabel(f"{'XY'[shown.axis]}, mm" if row else "")
            axes.locator_params(axis="x", nbins=5)
        bar = figure.colorbar(filled, ax=panels[row], ticks=round_steps(low, high), format="%g", aspect=18, pad=0.01)
        bar.set_label(f"{kind} sigma, mm")
        bar.minorticks_off()
    return figure


def _range(millimetres: Array) -> tuple[float, float]:
    """Return the range of the colours for sigmas (3, D, W), mm: all of them, except for negligible shares."""
    seen = millimetres[:, np.isfinite(millimetres[0])]
    if not seen.size:
        return 0.1, 1.0
    high = float(seen[-1].max())
    return float(np.clip(seen.min(), seen[-1].min() / _NEGLIGIBLE, 0.9 * high)), high


def round_steps(low: float, high: float) -> list[float]:
    """Return the values 1, 2, 5 times a power of ten from ``low`` to ``high``; of many, the powers of ten alone."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    factors = (1, 2, 5) if high < _WIDE_RANGE * low else (1,)
    return [m * 10.0**k for k in powers for m in factors if low <= m * 10.0**k <= high]


def target_figure(calibration: Calibration) -> Figure | None:
    """Plot the target's estimated deviation from its drawing, mm: colour out of the plane, arrows within; None without."""
    drawing = calibration.drawing
    if drawing is None or calibration.deviation_m < HELD_M:
        return None
    at, off = 1e3 * drawing[:, :2], 1e3 * (calibration.body.points - drawing)
    extent, margin = np.ptp(at, axis=0), 0.08 * np.ptp(at, axis=0).max()
    figure = new_figure(float(np.clip(0.75 * WIDTH_IN * extent[1] / extent[0], 3.0, 9.0)) + 0.8)
    axes = figure.subplots()
    axes.set(xlim=(at[:, 0].min() - margin, at[:, 0].max() + margin), aspect="equal", xlabel="x, mm", ylabel="y, mm")
    axes.set_ylim(at[:, 1].max() + margin, at[:, 1].min() - margin)
    most = max(float(np.abs(off[:, 2]).max()), _LEAST_MM)
    across, down = (np.linspace(at[:, k].min(), at[:, k].max(), _FINE) for k in (0, 1))
    z = griddata(at, off[:, 2], (across[None, :], down[:, None]), method="cubic")
    filled = axes.contourf(across, down, z, levels=np.linspace(-most, most, 21), cmap="RdBu_r", extend="both")
    axes.plot(*at.T, ".", color=INK, markersize=2)
    enlarged = _enlargement([off[:, :2]], _MAP_ARROW_SHARE * float(extent[0]), _LEAST_MM)
    arrows(axes, at, off[:, :2], enlarged, INK, 0.003, "mm", 0.03)
    axes.set_title(f"colour: out of the plane; arrows: within it, x{enlarged:g}")
    bar = figure.colorbar(filled, ax=axes, label="z, mm (+ is into the target)", format="%.3g", aspect=25)
    bar.set_ticks(list(np.linspace(-most, most, 5)))
    return figure


def corners(calibration: Calibration, side: int) -> tuple[Array, Array]:
    """Return the positions (N, 2) of one camera's corners and their residuals (N, 2), px."""
    rows = calibration.observations.camera == side
    return calibration.observations.uv[rows], calibration.solution.residuals_px[rows]


def grid_counts(calibration: Calibration, side: int, cells: int = COVERAGE_CELLS) -> tuple[Array, Array, Array]:
    """Count one camera's corners in square cells; return (R, C) counts, (C + 1,) u and (R + 1,) v edges, px."""
    size = np.array(calibration.rig.cameras[side].image_size_px)
    counts = np.maximum(np.round(cells * size / size.max()).astype(int), 2)
    u, v = (np.linspace(-0.5, length - 0.5, count + 1) for length, count in zip(size, counts, strict=True))
    uv, _ = corners(calibration, side)
    return np.histogram2d(uv[:, 1], uv[:, 0], bins=(v, u))[0], u, v


def _image_axes(axes: Axes, calibration: Calibration, side: int, title: str) -> None:
    width, height = calibration.rig.cameras[side].image_size_px
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", title=title)
    axes.set(xlabel="u, px", ylabel="" if side else "v, px")
    axes.spines[["top", "right"]].set_visible(True)


def _tall(calibration: Calibration) -> float:
    return 0.46 * WIDTH_IN * max(h / w for w, h in (camera.image_size_px for camera in calibration.rig.cameras))


def coverage_figure(calibration: Calibration) -> Figure:
    """Plot the number of corners in each region of both images; empty cells stand out."""
    figure = new_figure(_tall(calibration) + 0.7)
    panels, grids = figure.subplots(1, 2), [grid_counts(calibration, side) for side in (0, 1)]
    most = max(counts.max() for counts, _, _ in grids)
    for side, (axes, (counts, u, v)) in enumerate(zip(panels, grids, strict=True)):
        empty = 100 * float((coverage(calibration, side, COVERAGE_GRID) == 0).mean())
        title = f"{SIDES[side]} image: {empty:.0f}% of {COVERAGE_GRID} x {COVERAGE_GRID} cells saw no point"
        _image_axes(axes, calibration, side, title)
        axes.set_facecolor(EMPTY)
        axes.patch.set(hatch="////", edgecolor="#e9a57f")
        colours = {"cmap": "GnBu", "vmin": -0.15 * most, "vmax": most}
        mesh = axes.pcolormesh(u, v, np.ma.masked_equal(counts, 0), edgecolors="white", linewidth=0.6, **colours)
        axes.plot(*corners(calibration, side)[0].T, ".", color=INK, markersize=1.2, alpha=0.45)
    bar = figure.colorbar(mesh, ax=panels, label="points in a cell", shrink=0.8, aspect=25)
    bar.ax.set_ylim(1, max(most, 2))
    bar.outline.set_visible(False)
    return figure


def mean_residuals(calibration: Calibration, side: int) -> tuple[Array, Array, Array]:
    """Return of a camera's cells mean positions (C, 2), residuals (C, 2), px, and their length over its sigma (C,)."""
    uv, residuals = corners(calibration, side)
    _, edges_u, edges_v = grid_counts(calibration, side, MEAN_CELLS)
    cell = np.digitize(uv[:, 0], edges_u) * (len(edges_v) + 1) + np.digitize(uv[:, 1], edges_v)
    rows = [r for k in np.unique(cell) if len(r := np.flatnonzero(cell == k)) >= _LEAST_IN_CELL]
    mean = np.array([residuals[r].mean(axis=0) for r in rows]).reshape(-1, 2)
    error = np.array([np.sqrt(residuals[r].var(axis=0, ddof=1).sum() / len(r)) for r in rows])
    at = np.array([uv[r].mean(axis=0) for r in rows]).reshape(-1, 2)
    return at, mean, np.linalg.norm(mean, axis=1) / np.maximum(error, 1e-12)


def residuals_figure(calibration: Calibration) -> Figure:
    """Plot residual vectors over both images: every corner above, the mean of every region below, both enlarged."""
    figure = new_figure(2 * _tall(calibration) + 1.6)
    panels, width = figure.subplots(2, 2), _ARROW_SHARE * calibration.rig.left.image_size_px[0]
    every = [corners(calibration, side) for side in (0, 1)]
    means = [mean_residuals(calibration, side) for side in (0, 1)]
    enlarged = _enlargement([residuals for _, residuals in every], width)
    enlarged_mean = _enlargement([mean for _, mean, _ in means], 2 * width)
    for side, name in enumerate(SIDES):
        uv, residuals = every[side]
        rms = float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else float("nan")
        shown = np.random.default_rng(0).permutation(len(uv))[:MOST_ARROWS]
        which = "every point" if len(shown) == len(uv) else f"{MOST_ARROWS} points"
        _image_axes(panels[0, side], calibration, side, f"{name}, {which}, x{enlarged:g} (RMS {rms:.3f} px)")
        arrows(panels[0, side], uv[shown], residuals[shown], enlarged, BLUE, 0.0016, "px", 0.045)
        uv, mean, errors = means[side]
        out = errors > STANDS_OUT
        title = f"{name}, regional mean, x{enlarged_mean:g} ({out.sum()} of {len(out)} stand out)"
        _image_axes(panels[1, side], calibration, side, title)
        colours = [RED if o else MUTED for o in out]
        panels[1, side].scatter(*uv.T, s=6, c=colours, linewidths=0)
        arrows(panels[1, side], uv, mean, enlarged_mean, colours, 0.004, "px", 0.045)
    return figure


def _enlargement(vectors: list[Array], length: float, least: float = 1e-9) -> float:
    """Return a round factor that makes the longer vectors so long; ``least`` bounds them from below."""
    lengths = np.linalg.norm(np.concatenate(vectors), axis=1)
    return nice(length / max(float(np.quantile(lengths, 0.9)) if len(lengths) else 0.0, least))


def pairs_figure(calibration: Calibration) -> Figure:
    """Plot the held-out errors of every pair, one bar each."""
    errors, heldout = calibration.errors, calibration.held_out
    order = np.sort(np.argsort(-errors.rigid_m)[:MOST_BARS])
    names = [plain(calibration.pairs[int(errors.pair[k])], 28) for k in order]
    figure = new_figure(1.1 + 0.19 * len(names))
    panels = figure.subplots(1, 2, sharey=True)
    shown = (
        (errors.epipolar_px, heldout.epipolar_rms_px, "epipolar error, px"),
        (1e3 * errors.rigid_m, 1e3 * heldout.rigid_rms_m, "rigid error, mm"),
    )
    for axes, (value, mean, label) in zip(panels, shown, strict=True):
        colours = [ORANGE if v > OUTSTANDING * float(np.median(value)) else BLUE for v in value[order]]
        axes.barh(range(len(names)), value[order], color=colours, height=0.7)
        axes.plot([mean, mean], [-0.6, len(names) - 0.4], color=INK, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.set_xlim(0, 1.06 * max(value.max(), mean))
        axes.set_title(f"held-out {label} (dashed: RMS of all, {mean:.3g})")
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="x", color="#e4e7eb", linewidth=0.7)
        axes.set_axisbelow(True)
        axes.spines["left"].set_visible(False)
    panels[0].set_yticks(range(len(names)), names, parse_math=False)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
    return figure
