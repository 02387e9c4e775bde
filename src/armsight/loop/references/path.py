"""The tool's motion from measured poses: twist and acceleration by a local polynomial (Savitzky and Golay, 1964) on SE(3).

In: poses by vision or by an arm, with times. Out: a :class:`ToolMotion` at any time between them. About the pose sought the
poses nearby are a polynomial of time in its right tangent; there its first derivative is the twist, its second the
acceleration.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.references.reference import ToolMotion

#: Degree of the polynomial; half: corners are cut, double: noise of the acceleration four times as large.
DEGREE = 3
#: Poses that one is laid through at least, on both sides together, and the least span, s.
LEAST, SPAN_S = 6, 0.08
#: Longest gap between poses that is bridged, s.
GAP_S = 0.5


class PosePath:
    """Poses over time.

    Args:
        t_s: (N,) times, rising, s.
        Ts_base_tool: (N, 4, 4) the tool's poses, m.
        cov: (6, 6) covariance of each pose's right tangent [m; rad]; None: exact.

    Raises:
        InputError: fewer than ``LEAST`` poses, or times that do not rise.
    """

    def __init__(self, t_s: Array, Ts_base_tool: Array, cov: Array | None = None) -> None:
        if len(t_s) < LEAST or not (np.diff(t_s) > 0.0).all():
            raise InputError(f"{len(t_s)} poses were given; {LEAST} at least are needed, at times that rise")
        self._t, self._Ts, self._cov = t_s, Ts_base_tool, np.zeros((6, 6)) if cov is None else cov

    def covers(self, t_s: float, apart_s: float) -> bool:
        """Return whether there are poses around a time and so long before and after it."""
        low, high = np.searchsorted(self._t, [t_s - apart_s, t_s + apart_s])
        inside = self._t[0] <= t_s - apart_s and t_s + apart_s <= self._t[-1]
        return bool(inside and np.diff(self._t[max(low - 1, 0) : high + 1]).max(initial=0.0) <= GAP_S)

    def __call__(self, t_s: float) -> ToolMotion:
        """Return the motion at a time, s.

        Raises:
            InputError: no poses around it.
        """
        t = self._t
        k = int(np.searchsorted(t, t_s))
        low, high = max(k - LEAST // 2, 0), min(k + LEAST // 2, len(t))
        low, high = min(low, max(high - LEAST, 0)), max(high, min(low + LEAST, len(t)))
        low, high = (
            min(low, int(np.searchsorted(t, t_s - SPAN_S / 2))),
            max(high, int(np.searchsorted(t, t_s + SPAN_S / 2))),
        )
        if not t[0] <= t_s <= t[-1] or np.diff(t[max(k - 1, 0) : k + 1]).max(initial=0.0) > GAP_S:
            raise InputError(f"no pose within {GAP_S:g} s of {t_s:.3f} s; they are from {t[0]:.3f} to {t[-1]:.3f} s")
        u, T = t[low:high] - t_s, self._Ts[min(k, len(t) - 1)]
        powers = np.vander(u, DEGREE + 1, increasing=True)
        fit = np.linalg.pinv(powers)
        for _ in range(2):  # the second about the pose itself
            c = fit @ log_se3(inverse(T) @ self._Ts[low:high])
            T = T @ exp_se3(c[0])
        return ToolMotion(T, c[1], 2 * c[2], self._cov * float((fit[0] ** 2).sum()))
