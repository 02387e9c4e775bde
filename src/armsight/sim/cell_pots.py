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
from armsight.sim.cell_arm import TrueArm

#: Shares of the supply at the ends of the travel.
LOW_SHARE, HIGH_SHARE = 0.05, 0.95
COUNTS = 65536  # of the supply, as the board gives them
_BLOCK = 256  # ticks whose noise is drawn at once

Counts = NDArray[np.uint32]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _converted(share: Array, noise: NDArray[np.float32], steps: float, counts: Counts) -> None:
    """Convert wiper voltages (6,), shares of the supply, with noise (6, n) in steps; averages into counts (6,)."""
    n = noise.shape[1]
    for i in range(6):
        total = 0.0
        for k in range(n):
            total += min(max(np.floor(share[i] * steps + noise[i, k] + 0.5), 0.0), steps - 1.0)
        counts[i] = np.uint32(min(np.floor(total / n * (65536.0 / steps) + 0.5), 65535.0))


class Potentiometers:
    """Six potentiometers on one converter."""

    def __init__(self, true: TrueArm, travel: Array, seed: int) -> None:
        """Make ready to read.

        Args:
            true: their errors.
            travel: (6, 2) joint angles at the ends of their travel, rad.
            seed: of the noise.
        """
        self._true, self._travel = true, travel
        self._span = np.ptp(travel, axis=1)
        self._rng = np.random.default_rng([seed, 2])
        self._noise = np.zeros((0, 6, 0), np.float32)
        self._next = 0
        self._steps = float(1 << true.imperfections.adc_bits)

    def error(self, shaft: Array) -> Array:
        """Return what they say too much at shaft angles (..., 6), rad."""
        amplitude, cycles, phase = np.moveaxis(self._true.pot_sines, 2, 0)
        along = (shaft - self._travel[:, 0]) / self._span
        return np.asarray(
            self._true.pot_offset_rad + (amplitude * np.sin(2 * np.pi * cycles * along[..., None] + phase)).sum(axis=-1)
        )

    def read(self, shaft: Array) -> Counts:
        """Read them once.

        Args:
            shaft: (6,) shaft angles, rad.

        Returns:
            (6,) counts, uint32, 0 to 65535.
        """
        if self._next == len(self._noise):
            given = self._true.imperfections
            block = self._rng.standard_normal((_BLOCK, 6, given.oversampling), dtype=np.float32)
            self._noise, self._next = block * np.float32(given.pot_noise_lsb), 0
        said = shaft + self.error(shaft)
        share = LOW_SHARE + (HIGH_SHARE - LOW_SHARE) * (said - self._travel[:, 0]) / self._span
        counts = np.empty(6, np.uint32)
        _converted(share, self._noise[self._next], self._steps, counts)
        self._next += 1
        return counts
