"""Plots of reports: style, canvas, arrows; matplotlib without a display, imported only when something is plotted."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import table_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Figure
    from matplotlib.figure import FigureBase as FigureBase
else:  # types of whoever plots: the library is imported where something is drawn
    Axes = Figure = FigureBase = Any

DPI = 150
WIDTH_IN = 10.0
_PACKED = 3  # of 9: a tenth larger than with the usual 6, in half of the time
INK, MUTED, BLUE, ORANGE, RED, EMPTY = "#1f2933", "#616e7c", "#2b6cb0", "#dd7a1f", "#b83232", "#fbe3d6"
STYLE: dict[str, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.edgecolor": "#9aa5b1",
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "white",
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
}


def bgr(colour: str) -> tuple[int, int, int]:
    """Return a colour such as #1f2933 as OpenCV takes it."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return blue, green, red


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Plot within this block in the style of the reports, whatever the user's matplotlib settings, without a display."""
    require_matplotlib()
    import matplotlib

    style: Any = STYLE
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a pair's name in a script the font lacks
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style)
        matplotlib.rcParams["svg.hashsalt"] = "armsight"  # the same figure, the same bytes
        yield


def require_matplotlib() -> None:
    """Raise an InputError with what to install unless matplotlib can be imported."""
    try:
        importlib.import_module("matplotlib.figure")
    except ImportError:
        raise InputError(
            'the report needs matplotlib, which is not installed: pip install "armsight[report]"'
        ) from None
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)


def new_figure(height_in: float) -> Figure:
    """Return an empty figure of the report's width on the Agg canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def subplots(height_in: float, rows: int = 1, columns: int = 1, **how: Any) -> tuple[Figure, Any]:  # noqa: ANN401 - matplotlib's
    """Return such a figure and its axes, as matplotlib's function of this name."""
    figure = new_figure(height_in)
    return figure, figure.subplots(rows, columns, **how)


def panels(figure: FigureBase, count: int, *, sharey: bool = False) -> list[Axes]:
    """Return axes for so many plots, in two rows."""
    grid = figure.subplots(2, -(-count // 2), sharey=sharey, squeeze=False).ravel()
    for empty in grid[count:]:
        empty.remove()
    return list(grid[:count])


def _lay_out(figure: Figure) -> None:
    """Compute the layout of a figure once; matplotlib would render it all for that, and again for every file."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def png(figure: Figure) -> bytes:
    """Render a figure; within :func:`drawing`."""
    _lay_out(figure)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DPI, metadata={"Software": None}, pil_kwargs={"compress_level": _PACKED})
    return data.getvalue()


def svg(figure: Figure) -> bytes:
    """Render a figure as lines that stay sharp however far one zooms in; within :func:`drawing`."""
    _lay_out(figure)
    data = io.BytesIO()
    figure.savefig(data, format="svg", dpi=DPI, metadata={"Date": None, "Creator": None})
    return data.getvalue()


def data_csv(figure: Figure) -> bytes:
    """Return what a figure shows as a CSV file: a row for each point, bar, arrow or cell, in the units of its axes.

    Columns: ``panel`` (number of the axes), its ``title``, the ``series`` (label of a line, otherwise empty), the ``x`` and
    ``y`` of the point, end of the bar or foot of the arrow, the titles of both axes, and ``value``: a point's or a cell's
    on the colour scale, or ``u`` and ``v`` of an arrow as it is drawn.
    """
    rows = []
    for panel, axes in enumerate(figure.axes, 1):
        if axes.get_label() == "<colorbar>":
            continue
        for series, columns in _series(axes):
            label = "" if series.startswith("_") else series
            ends = axes.get_xlabel(), axes.get_ylabel()
            for row in zip(*(np.asarray(c, float).ravel() for c in columns), strict=True):
                cells = ["" if np.isnan(v) else f"{v:.8g}" for v in row]
                title = axes.get_title("left") or axes.get_title()
                rows.append((panel, title, label, *cells, *[""] * (5 - len(cells)), *ends))
    names = ("panel", "title", "series", "x", "y", "value", "u", "v", "x axis", "y axis")
    return table_text(names, rows).encode()


def _series(axes: Axes) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Yield the label and the columns (x, y, value, u, v; the later may be missing) of all that is drawn from data."""
    from matplotlib.collections import PathCollection
    from matplotlib.container import BarContainer
    from matplotlib.quiver import Quiver

    for line in axes.lines:
        if line.get_transform() == axes.transData:  # a line across the axes is no data
            yield str(line.get_label()), tuple(np.asarray(line.get_xydata(), float).T)  # of names: their numbers
    for drawn in axes.collections:
        at: Array = np.ma.filled(np.ma.asarray(drawn.get_offsets(), float), np.nan)
        values = drawn.get_array()
        value = np.full(len(at), np.nan) if values is None or len(values) != len(at) else np.asarray(values)
        if isinstance(drawn, Quiver):
            yield str(drawn.get_label()), (*at.T, value, drawn.U, drawn.V)
        elif isinstance(drawn, PathCollection):
            yield str(drawn.get_label()), (*at.T, value)
    for bars in axes.containers:
        for bar in bars.patches if isinstance(bars, BarContainer) else ():
            middle, end = bar.get_x() + bar.get_width() / 2, bar.get_y() + bar.get_height()
            flat = getattr(bars, "orientation", "") == "horizontal"
            yield "", ([middle + bar.get_width() / 2], [end - bar.get_height() / 2]) if flat else ([middle], [end])
    for image in axes.images:
        cells = np.asarray(image.get_array(), float)
        if cells.ndim == 2:
            left, right, bottom, top = image.get_extent()
            first, last = (top, bottom) if image.origin == "upper" else (bottom, top)
            x, y = (
                a + (b - a) * (np.arange(n) + 0.5) / n
                for a, b, n in ((left, right, cells.shape[1]), (first, last, cells.shape[0]))
            )
            yield "", (*np.meshgrid(x, y), cells)


def plain_log(axis: Axis) -> None:
    """Give a logarithmic axis ticks at 1, 2 and 5, as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def plain(name: str, most: int = 60) -> str:
    """Return a name that can be printed anywhere: no broken Unicode, no control characters, shortened in its middle."""
    name = "".join(c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in name)
    return name if len(name) <= most else f"{name[: most // 2 - 1]}…{name[-(most // 2) :]}"


def nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power)


def arrows(
    axes: Axes,
    at: Array,
    vectors: Array,
    enlarged: float,
    colours: str | list[str],
    width: float,
    unit: str,
    above: float,
) -> None:
    """Plot enlarged vectors in the units of the axes, and a scale arrow above their right end.

    ``at``: (N, 2) feet of the vectors. ``vectors``: (N, 2) the vectors. ``enlarged``: factor of enlargement.
    ``colours``: one colour, or one for each vector. ``width``: of a shaft, as a share of the width of the axes.
    ``unit``: of the vectors, for the scale. ``above``: height of the scale above the axes, as a share of their height.
    """
    low, high = axes.get_xlim()
    scale = nice(0.09 * abs(high - low) / enlarged)
    style: Any = {"angles": "xy", "scale_units": "xy", "scale": 1 / enlarged, "clip_on": False}
    arrows_shown = axes.quiver(*at.T, *vectors.T, color=colours, width=width, **style)
    arrows_shown.set_in_layout(False)
    key: Any = {"labelpos": "E", "color": INK, "labelcolor": INK, "coordinates": "axes"}
    axes.quiverkey(arrows_shown, 0.87, 1 + above, scale, f"{scale:g} {unit}", **key)
