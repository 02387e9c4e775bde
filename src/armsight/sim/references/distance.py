"""A draw-wire: true poses in, its length out; it hangs, its drum is too large and eccentric, it hooks now and then."""

from __future__ import annotations

import numpy as np

from armsight.data import Array

#: Noise and a count, m; how much it hangs, share of the length at a metre; the drum's error, one sigma, relative; its
#: revolution and how much that is off, m.
NOISE_M, STEP_M, HANGS, DRUM, REVOLUTION_M, ECCENTRIC_M = 1e-4, 5e-5, 2e-4, 1e-3, 0.2, 5e-5
#: It hooks so often, 1/s, for so long, s, and reads longer by so much at most, m.
HOOKS_HZ, HOOKED_S, HOOK_M = 0.02, 0.5, 0.02


class DrawWire:
    """A wire to the tool that is read as time passes; where it hangs is drawn."""

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._rng, self._period_s, self._next_s, self._hooked = rng, 1.0 / rate_hz, 0.0, (-np.inf, 0.0)
        self._anchor = np.array([0.8, 0.3, 0.9]) + rng.normal(0.0, 0.1, 3)
        self._offset_m, self._scale = rng.normal(0.0, 0.05), 1.0 + rng.normal(0.0, DRUM)

    def read(self, t_s: Array, Ts_base_sensor: Array) -> tuple[Array, Array]:
        """Return stamps (N,), s, and lengths (N, 1), m, at the poses (M, 4, 4) of times (M,), s, since the last call."""
        stamps, lengths = list[float](), list[float]()
        for t, T in zip(t_s.tolist(), Ts_base_sensor, strict=True):
            if t < self._next_s:
                continue
            self._next_s = t + self._period_s - 1e-9
            if self._rng.random() < HOOKS_HZ * self._period_s:
                self._hooked = t + HOOKED_S, HOOK_M * self._rng.random()
            far = float(np.linalg.norm(T[:3, 3] - self._anchor))
            z = self._offset_m + self._scale * far * (1.0 + HANGS * far**2) + self._rng.normal(0.0, NOISE_M)
            z += ECCENTRIC_M * np.sin(2 * np.pi * far / REVOLUTION_M) + (
                self._hooked[1] if t < self._hooked[0] else 0.0
            )
            stamps.append(t)
            lengths.append(round(z / STEP_M) * STEP_M)
        return np.array(stamps), np.array(lengths)[:, None]
