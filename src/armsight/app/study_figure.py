"""The studies in one picture: measured errors with their intervals, and the curve the uncertainty model foretells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from armsight.app.report.plotting import BLUE, MUTED, new_figure
from armsight.app.demo.studies import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ACROSS = 3
_MM = 1e3


def studies_figure(studies: Sequence[Study]) -> Figure:
    """Draw one panel a study, both axes logarithmic."""
    down = -(-len(studies) // _ACROSS)
    figure = new_figure(2.9 * down)
    for number, study in enumerate(studies, start=1):
        plot = figure.add_subplot(down, _ACROSS, number)
        reach = _MM * np.abs(np.array([study.low_m, study.high_m]) - study.position_rms_m)
        plot.plot(study.values, _MM * study.predicted_m, color=MUTED, lw=1.4, label="foretold")
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
