"""A run in one picture: what the camera sees, who is right over time, and what closing the loop gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armsight.app.report.plotting import (BLUE, ORANGE, new_figure, plain_log)
from armsight.app.run_data import RunData
from armsight.app.run_figures import GREEN
from armsight.app.run.metrics import judge, rest_errors
from armsight.app.run_tracks import errors
from armsight.data import Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MM = 1e3
_EVERY = 12  # of the readings are drawn


def overview_figure(picture: Image, before: RunData, after: RunData) -> Figure | None:
    """Draw it; None without a truth.

    Args:
        picture: (H, W, 3) BGR, with the measured pose drawn in.
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
    image.set_title("the left camera's image, the measured pose drawn in")
    _over_time(figure.add_subplot(grid[0, 1]), before)
    _at_rest(figure.add_subplot(grid[1, 1]), before, after)
    return figure


def _over_time(plot: Axes, run: RunData) -> None:
    """Draw the errors of potentiometers, vision and both over time."""
    assert run.truth is not None
    start = run.t_s[0]
    for track, name, colour, every in (
        (run.potentiometers, "potentiometers", ORANGE, _EVERY),
        (run.fused, "fused", GREEN, _EVERY),
        (run.vision, "vision", BLUE, 1),
    ):
        shown = track[np.arange(0, len(track), every)]
        off = _MM * np.linalg.norm(errors(shown, run.truth)[:, :3], axis=1)
        off[1:][np.diff(shown.t_s) > 0.2] = np.nan  # no line where nothing was seen
        plot.plot(shown.t_s - start, off, color=colour, lw=0.8, label=name)
    plot.set_yscale("log")
    plot.set_ylim(bottom=5e-3)
    plain_log(plot.yaxis)
    plot.set_title("error of the measured position against the truth, mm")
    plot.set_xlabel("time, s", fontsize=7)
    plot.legend(fontsize=6.5, ncols=3, loc="lower right")


def _at_rest(plot: Axes, before: RunData, after: RunData) -> None:
    """Draw the errors at rest, before and after."""
    for shift, run, name, colour in (
        (-0.2, before, "potentiometers alone", ORANGE),
        (0.2, after, "loop closed on vision", GREEN),
    ):
        found = rest_errors(run, judge(run))
        plot.bar(np.arange(len(found)) + shift, _MM * np.array(list(found.values())), 0.38, color=colour, label=name)
    plot.set_xticks(range(len(found)), list(found), rotation=30, ha="right", fontsize=6)
    plot.set_yscale("log")
    plain_log(plot.yaxis)
    low, high = plot.get_ylim()
    plot.set_ylim(low, 3 * high)  # room for the legend
    plot.set_title("distance of the arm at rest from where it was sent, mm")
    plot.legend(fontsize=6.5, loc="upper right", ncols=2)
