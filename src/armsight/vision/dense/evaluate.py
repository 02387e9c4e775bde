"""Evaluate a disparity map by the metrics of the Middlebury benchmark.

Scharstein and Szeliski, "A taxonomy and evaluation of dense two-frame stereo correspondence algorithms", IJCV 47, 2002,
and the benchmark's third version (Scharstein et al., GCPR 2014): shares of pixels that are off by more than a
threshold, mean, RMS and quantiles of the error, over all pixels with a truth and over those that both cameras see. A
pixel without a disparity is bad at every threshold, and left out of mean, RMS and quantiles. Disparities are evaluated
as they are, never rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.kernels import kernel

THRESHOLDS_PX = (0.5, 1.0, 2.0, 4.0)
QUANTILES = (50, 90, 95, 99)


@dataclass(frozen=True)
class DisparityErrors:
    """The errors over one set of pixels, px.

    ``bad_percent``: share that is off by more than each of THRESHOLDS_PX; ``quantiles_px``: A50, A90, A95 and A99.
    """

    pixels: int
    bad_percent: tuple[float, ...]
    average_px: float
    rms_px: float
    quantiles_px: tuple[float, ...]

    def to_json(self) -> dict[str, float]:
        """Return the metrics by name."""
        names = [f"bad_{t:g}_percent" for t in THRESHOLDS_PX]
        quantiles = [f"a{q}_px" for q in QUANTILES]
        return {
            "pixels": self.pixels,
            **dict(zip(names, self.bad_percent, strict=True)),
            "average_px": self.average_px,
            "rms_px": self.rms_px,
            **dict(zip(quantiles, self.quantiles_px, strict=True)),
        }


@dataclass(frozen=True, eq=False)
class TrueDisparity(Record):
    """The true disparities (H, W) of a left image, px, NaN where unknown; ``seen``: by the right camera, too."""

    disparity: Array
    seen: NDArray[np.bool_]

    @property
    def known(self) -> NDArray[np.bool_]:
        """(H, W) where there is a truth."""
        return np.asarray(np.isfinite(self.disparity))


def evaluate_disparity(
    disparity: NDArray[np.floating[Any]], truth: TrueDisparity, among: NDArray[np.bool_]
) -> DisparityErrors:
    """Evaluate a disparity map (H, W), px, NaN or infinite where there is none, ``among`` some of its pixels."""
    chosen = among & truth.known
    error = np.abs(np.asarray(disparity, np.float64)[chosen] - truth.disparity[chosen])
    given = error[np.isfinite(error)]
    count, missing = error.size, error.size - given.size
    if not given.size:
        nothing = float("nan")
        return DisparityErrors(count, (100.0,) * 4 if count else (nothing,) * 4, nothing, nothing, (nothing,) * 4)
    return DisparityErrors(
        count,
        tuple(100 * float((given > t).sum() + missing) / count for t in THRESHOLDS_PX),
        float(given.mean()),
        float(np.sqrt((given**2).mean())),
        tuple(float(q) for q in np.percentile(given, QUANTILES)),
    )


@kernel("f8[:, ::1]")
def seen_by_right(disparity: Array) -> NDArray[np.bool_]:
    """Return which pixels of a true disparity map (H, W) the right camera sees.

    A pixel is hidden outside of its image, and where a surface that is nearer by more than a pixel covers it.
    """
    height, width = disparity.shape
    out = np.zeros((height, width), np.bool_)
    nearest = np.empty(width, np.float64)
    for y in range(height):
        nearest[:] = -1
        for x in range(width):
            right = x - disparity[y, x]
            if right >= 0:
                k = int(right + 0.5)
                nearest[k] = max(nearest[k], disparity[y, x])
        for x in range(width):
            right = x - disparity[y, x]
            if right >= 0:
                out[y, x] = nearest[int(right + 0.5)] <= disparity[y, x] + 1
    return out
