"""Potentiometers and the converter behind them: from shaft angles to the counts that a board reads.

A potentiometer spans a joint's travel with nine tenths of its supply. What its wiper says differs from the straight line
by a smooth error and an offset; each conversion adds noise and is rounded to the converter's step, and a tick's conversions
are averaged: noise of a step or so makes up for the rounding.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.sim.workcell.arm import TrueArm

#: Shares of the supply at the ends of the travel.
LOW_SHARE, HIGH_SHARE = 0.05, 0.95
COUNTS = 65536  # of the supply, as the board gives them
_BLOCK = 256  # ticks whose noise is drawn at once

Counts = NDArray[np.uint32]


@numba.njit(cache=True, error_model="numpy")
def _errors(shaft: Array, offset: Array, sines: Array, low: Array, span: Array, out: Array) -> None:
    """Write what potentiometers say too much at shaft angles (N, 6) into out (N, 6)."""
    for n in range(shaft.shape[0]):
        for i in range(6):
            along = (shaft[n, i] - low[i]) / span[i]
            total = offset[i]
            for k in range(sines.shape[1]):
                total += sines[i, k, 0] * np.sin(2 * np.pi * sines[i, k, 1] * along + sines[i, k, 2])
            out[n, i] = total


@numba.njit(cache=True, error_model="numpy")
def _read(
    shaft: Array,
    offset: Array,
    sines: Array,
    low: Array,
    span: Array,
    noise: NDArray[np.float32],
    row: int,
    steps: float,
    counts: Counts,
) -> None:
    """Convert what wipers say at shaft angles (1, 6), with a row of noise (N, 6, n) in steps; averages into counts (6,)."""
    n, over = noise.shape[2], np.empty((1, 6))
    _errors(shaft, offset, sines, low, span, over)
    for i in range(6):
        said = shaft[0, i] + over[0, i]
        share = LOW_SHARE + (HIGH_SHARE - LOW_SHARE) * (said - low[i]) / span[i]
        total = 0.0
        for k in range(n):
            total += min(max(np.floor(share * steps + noise[row, i, k] + 0.5), 0.0), steps - 1.0)
        counts[i] = np.uint32(min(np.floor(total / n * (COUNTS / steps) + 0.5), COUNTS - 1.0))


class Potentiometers:
    """Six potentiometers on one converter."""

    def __init__(self, true: TrueArm, travel: Array, seed: int) -> None:
        """Make ready to read.

        Args:
            true: their errors.
            travel: (6, 2) joint angles at the ends of their travel, rad.
            seed: of the noise.
        """
        self._given = true.imperfections
        self._low, self._span = travel[:, 0].copy(), np.ptp(travel, axis=1)
        self._offset, self._sines = true.pot_offset_rad.copy(), true.pot_sines.copy()
        self._rng = np.random.default_rng([seed, 2])
        self._noise = np.zeros((0, 6, 0), np.float32)
        self._next = 0
        self._steps = float(1 << self._given.adc_bits)

    def error(self, shaft: Array) -> Array:
        """Return what they say too much at shaft angles (N, 6), rad."""
        out = np.empty(shaft.shape)
        _errors(np.ascontiguousarray(shaft), self._offset, self._sines, self._low, self._span, out)
        return out

    def read(self, shaft: Array) -> Counts:
        """Read them once.

        Args:
            shaft: (6,) shaft angles, rad.

        Returns:
            (6,) counts, uint32, 0 to 65535.
        """
        if self._next == len(self._noise):
            block = self._rng.standard_normal((_BLOCK, 6, self._given.oversampling), dtype=np.float32)
            self._noise, self._next = block * np.float32(self._given.pot_noise_lsb), 0
        counts = np.empty(6, np.uint32)
        errors = (self._offset, self._sines, self._low, self._span)
        _read(shaft[None], *errors, self._noise, self._next, self._steps, counts)
        self._next += 1
        return counts
