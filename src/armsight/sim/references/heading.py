"""A magnetometer: true poses in, the field that it reads out; iron, noise, a chip's step, a motor that disturbs it."""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import exp_so3

#: The Earth's field in the base, T, and the moment of a motor's dipole, one sigma, A m2: 0.4 uT at 0.5 m.
EARTH_T, MOTOR_A_M2 = np.array([17e-6, 9e-6, -42e-6]), 0.5
#: The motor stands at the base's axis so high, m; its current changes within so many seconds.
MOTOR_M, CHANGES_S = 0.3, 0.5
NOISE_T, STEP_T = 0.5e-6, 0.15e-6


class MagneticUnit:
    """A magnetometer that is read as time passes; its iron is drawn."""

    def __init__(self, rng: np.random.Generator, rate_hz: float) -> None:
        self._rng, self._period_s, self._next_s = rng, 1.0 / rate_hz, 0.0
        iron = rng.normal(0.0, 0.05, (3, 3))
        self._soft, self._hard = np.eye(3) + (iron + iron.T) / 2, rng.normal(0.0, 30e-6, 3)
        self._mounting, self._moment = exp_so3(rng.normal(0.0, 1.0, 3)), MOTOR_A_M2 * rng.normal(size=3)

    def read(self, t_s: Array, Ts_base_sensor: Array) -> tuple[Array, Array]:
        """Return stamps (N,), s, and fields (N, 3), T, at the poses (M, 4, 4) of times (M,), s, since the last call."""
        stamps, fields = list[float](), list[Array]()
        kept = np.exp(-self._period_s / CHANGES_S)
        for t, T in zip(t_s.tolist(), Ts_base_sensor, strict=True):
            if t < self._next_s:
                continue
            self._next_s = t + self._period_s - 1e-9
            self._moment = kept * self._moment + np.sqrt(1.0 - kept**2) * MOTOR_A_M2 * self._rng.normal(size=3)
            apart = T[:3, 3] - [0.0, 0.0, MOTOR_M]
            far = np.linalg.norm(apart)
            field = EARTH_T + 1e-7 * (3 * apart * (apart @ self._moment) / far**2 - self._moment) / far**3
            z = self._soft @ (T[:3, :3] @ self._mounting).T @ field + self._hard + self._rng.normal(0.0, NOISE_T, 3)
            stamps.append(t)
            fields.append(np.round(z / STEP_T) * STEP_T)
        return np.array(stamps), np.array(fields).reshape(-1, 3)
