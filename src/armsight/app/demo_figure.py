"""The demo in one picture: the measured pose in the image, and the error of every shot inside its predicted band."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import norm

from armsight.app.demo import DemoResult
from armsight.app.report_draw import BLUE, MUTED, drawing, new_figure, png
from armsight.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BAND = float(norm.ppf(0.975))


def write_figure(result: DemoResult, path: Path) -> None:
    """Draw the run and write it as a PNG.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written.
    """
    with drawing():
        data = png(_figure(result))
    with replacing(path, "wb") as file:
        file.write(data)


def _figure(result: DemoResult) -> Figure:
    """Image on the left, error of x, y and z over time on the right."""
    figure = new_figure(3.9)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.3, 1.0))
    image = figure.add_subplot(grid[:, 0])
    image.imshow(result.picture[..., ::-1])
    image.set_axis_off()
    image.set_title("what the left camera sees, with the measured pose drawn in")
    t = result.truth.times_s
    for row, name in enumerate("xyz"):
        plot = figure.add_subplot(grid[row, 1])
        band, error = 1e3 * _BAND * result.sigmas[:, row], 1e3 * result.errors[:, row]
        plot.fill_between(t, -band, band, color="#cfe3f5", lw=0, label="predicted 95%")
        plot.plot(t, error, ".-", color=BLUE, lw=0.8, ms=4, label="error")
        plot.axhline(0.0, color=MUTED, lw=0.5)
        plot.set_ylabel(f"{name}, mm")
        plot.tick_params(labelbottom=row == 2)
        reach = 1.3 * float(np.nanmax(np.abs(np.append(band, error))))
        plot.set_ylim(-reach, reach)
        if row == 0:
            plot.set_title("error of the measured position against the truth")
            plot.legend(fontsize=7, loc="upper right", ncols=2)
    plot.set_xlabel("time, s")
    return figure
