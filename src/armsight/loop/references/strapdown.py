"""Strapdown navigation beside the joints' errors: what an inertial unit on the tool says of its motion between two times.

In: samples of a gyro and an accelerometer, the tool's pose by the joints at the begin and the end of a window, with the
filter's covariances. Out: the filter's state after the window. The samples between the two times are preintegrated
(Forster, Carlone, Dellaert and Scaramuzza, IEEE Trans. Robotics 33, 2017); their rotation and displacement constrain how
the tool's pose changed. The pose at the begin hangs on what the joints' errors were then: that is a stochastic clone
(Roumeliotis and Burdick, ICRA 2002), which in one step from begin to end needs no rows of its own. Velocity, delay and
parameters of the unit are estimated beside the arm's errors; nothing is integrated anywhere else.

With R, p, v the sensor's attitude, position and velocity at the begin, R', p', v' at the end, u up, D the window's length

    rotation      log(dR' R^T R')                                     = 0
    displacement  R^T (p' - p - v D + g u D^2 / 2) - dp               = 0
    velocity      v' = v - g u D + R dv

the errors of which are first-order in those of the tool's poses, of v, of the unit's parameters and of its clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import left_jacobian
from armsight.geometry.rotation import exp_so3, skew
from armsight.kernels import kernel
from armsight.loop.references.inertial import BIASES, MOUNTING, Inertial
from armsight.loop.references.reference import STANDARD_GRAVITY_M_S2

#: Samples further apart than this are not integrated over, s; half: late ones count as lost, double: motion is missed.
GAP_S = 0.03
#: The newest sample holds for so long after it, s: of motion at 10 rad/s2 that leaves 0.1 mrad.
HELD_S = 0.005
#: Samples that are kept; at 1 kHz 8 s.
_ROWS = 8192
#: Velocity before anything was integrated, one sigma beside that by the joints, m/s; half, double: nothing.
START_M_S = 0.1
#: Averaging time, s, from which on a bias wanders more than noise; half: biases are learned anew faster, double: slower.
CORNER_S = 6.0
#: Rows of what is estimated beside the arm: velocity, delay, and the unit's parameters.
_V, _DELAY, _PARAMETERS = slice(0, 3), 3, 4
_BIASES = np.arange(_PARAMETERS + BIASES.start, _PARAMETERS + BIASES.stop)


@dataclass(frozen=True, eq=False)
class Samples(Record):
    """Samples of an inertial unit, in order of time.

    Attributes:
        t_s: (N,) when, s, as its clock stamps them; its delay is still in them.
        z: (N, 6) angular velocity, rad/s, and specific force, m/s2, as read.
        density: (6,) of their noise, per sqrt(Hz).
    """

    t_s: Array
    z: Array
    density: Array


class Navigated(NamedTuple):
    """What is estimated beside the arm's errors.

    Attributes:
        t_s: when its velocity was, s; of another time than the state's the velocity is not known.
        y: (B,) velocity of the sensor, base, m/s; then how much the delay and the parameters are off.
        C: (K, B) covariance of the arm's errors with its.
        Y: (B, B) its covariance.
    """

    t_s: float
    y: Array
    C: Array
    Y: Array

    def measured(self, kept: Array, H: Array, HP: Array, z: Array, S: Array) -> Navigated:
        """Return it after a measurement of the arm's errors.

        Args:
            kept: (K,) what motion had kept of these.
            H: (m, K) derivative of the measurement.
            HP: (m, K) product of it and their covariance.
            z: (m,) residual.
            S: (m, m) covariance of that.
        """
        C = self.C * kept[:, None]
        HC = H @ C
        gain = np.linalg.solve(S, HC).T
        return Navigated(self.t_s, self.y + gain @ z, C - HP.T @ gain.T, self.Y - gain @ HC)


class Window(NamedTuple):
    """What the unit felt between two times, in its axes at the first.

    Attributes:
        length_s: between them, s.
        R: (3, 3) rotation.
        dv: (3,) integral of the specific force, m/s.
        dp: (3,) and that of it, m.
        mean: (6,) of angular velocity and specific force.
        change: (6,) of them from begin to end.
        density: (6,) of the noise.
    """

    length_s: float
    R: Array
    dv: Array
    dp: Array
    mean: Array
    change: Array
    density: Array


class Advanced(NamedTuple):
    """A filter's state at the end of a window, the window used.

    Attributes:
        x: (K,) the arm's error.
        P: (K, K) its covariance.
        beside: velocity and parameters.
        gain: (K, 6) what of the residual was added to x.
        by: (6, K) derivative of the residual by the state before.
        z: (6,) residual: felt minus predicted.
        S: (6, 6) its covariance.
    """

    x: Array
    P: Array
    beside: Navigated
    gain: Array
    by: Array
    z: Array
    S: Array


@kernel("f8[::1], f8[:, ::1], i8, i8, f8, f8, f8[::1]")
def _preintegrate(t: Array, z: Array, first: int, count: int, begin: float, end: float, out: Array) -> None:
    """Write R (9), dv, dp (3 each), and the values at begin and end (6 each) of rows first.. of t (N,), z (N, 6) to out."""
    R, a, b = np.eye(3), np.empty(6), np.empty(6)
    v, p, rotated = np.zeros(3), np.zeros(3), np.empty((3, 3))
    k = first + np.searchsorted(t[first : first + count], begin, side="right")
    at = begin
    for i in range(6):
        a[i] = z[k - 1, i] + (z[k, i] - z[k - 1, i]) * (begin - t[k - 1]) / (t[k] - t[k - 1])
        out[15 + i] = a[i]
    while at < end:
        to = min(t[k], end)
        for i in range(6):
            b[i] = z[k - 1, i] + (z[k, i] - z[k - 1, i]) * (to - t[k - 1]) / (t[k] - t[k - 1])
        h = to - at
        x, y, w = 0.5 * h * (a[0] + b[0]), 0.5 * h * (a[1] + b[1]), 0.5 * h * (a[2] + b[2])
        # The force in the axes of the middle, rotated by half the rotation, to second order.
        f0, f1, f2 = 0.5 * (a[3] + b[3]), 0.5 * (a[4] + b[4]), 0.5 * (a[5] + b[5])
        c0, c1, c2 = 0.5 * (y * f2 - w * f1), 0.5 * (w * f0 - x * f2), 0.5 * (x * f1 - y * f0)
        f0, f1, f2 = f0 + c0, f1 + c1, f2 + c2
        for i in range(3):
            push = R[i, 0] * f0 + R[i, 1] * f1 + R[i, 2] * f2
            p[i] += h * (v[i] + 0.5 * h * push)
            v[i] += h * push
        angle = math.sqrt(x * x + y * y + w * w)
        s = 1.0 - angle * angle / 6.0 if angle < 1e-3 else math.sin(angle) / angle
        g = 0.5 - angle * angle / 24.0 if angle < 1e-3 else (1.0 - math.cos(angle)) / (angle * angle)
        for i in range(3):
            r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
            rotated[i, 0] = r0 * (1.0 - g * (y * y + w * w)) + r1 * (s * w + g * x * y) + r2 * (g * x * w - s * y)
            rotated[i, 1] = r0 * (g * x * y - s * w) + r1 * (1.0 - g * (x * x + w * w)) + r2 * (s * x + g * y * w)
            rotated[i, 2] = r0 * (s * y + g * x * w) + r1 * (g * y * w - s * x) + r2 * (1.0 - g * (x * x + y * y))
        R[:] = rotated
        a[:] = b
        at = to
        k += 1
    for i in range(9):
        out[i] = R[i // 3, i % 3]
    for i in range(3):
        out[9 + i], out[12 + i] = v[i], p[i]
    for i in range(6):
        out[21 + i] = a[i]


class Strapdown:
    """An inertial unit's samples of the last seconds, and how they bear on the filter.

    Args:
        sensor: the unit, as its calibration says; the mounting must be known.
    """

    def __init__(self, sensor: Inertial) -> None:
        self.sensor, self._density = sensor, np.zeros(6)
        self._t, self._z = np.empty(_ROWS + 1), np.empty((_ROWS + 1, 6))  # and the one that is held
        self._first = self._count = 0
        self._R, self._lever = sensor.T_tool_sensor[:3, :3], sensor.T_tool_sensor[:3, 3]
        tilt = np.append(sensor.tilt, 0.0)
        self._up = exp_so3(tilt)[:, 2]
        self._up_by_tilt = (-skew(self._up) @ left_jacobian(tilt))[:, :2]

    @property
    def newest_s(self) -> float:
        """Time of the newest sample, s, the delay removed; minus infinity before the first."""
        return float(self._t[self._first + self._count - 1]) if self._count else -np.inf

    def add(self, samples: Samples) -> None:
        """Take samples.

        Raises:
            InputError: wrong shapes, NaN, or times that do not rise.
        """
        t, z = np.asarray(samples.t_s, float) - self.sensor.delay_s, np.asarray(samples.z, float)
        steps = np.diff(t, prepend=self.newest_s)
        if z.shape != (len(t), 6) or not np.isfinite(z).all() or not (steps > 0.0).all():
            raise InputError(
                f"{self.sensor.name}: expected samples (N, 6), numbers, at times that rise from {self.newest_s:.4f} s on; "
                f"given are {z.shape} from {t[0] if len(t) else np.nan:.4f} s on"
            )
        t, z, self._density = t[-_ROWS // 2 :], z[-_ROWS // 2 :], samples.density
        if self._first + self._count + len(t) >= _ROWS:
            kept = slice(self._first + max(self._count - _ROWS // 2, 0), self._first + self._count)
            self._count = kept.stop - kept.start
            self._t[: self._count], self._z[: self._count] = self._t[kept].copy(), self._z[kept].copy()
            self._first = 0
        rows = slice(self._first + self._count, self._first + self._count + len(t))
        self._t[rows], self._z[rows] = t, self.sensor.felt(z)
        self._count += len(t)

    def window(self, begin_s: float, end_s: float) -> Window | None:
        """Return what was felt between two times, s; None where samples are missing."""
        t = self._t[self._first : self._first + self._count]
        low, high = int(np.searchsorted(t, begin_s, side="right")) - 1, int(np.searchsorted(t, end_s))
        if high == len(t) and low >= 0 and end_s < t[-1] + HELD_S:
            self._t[self._first + high], self._z[self._first + high] = end_s, self._z[self._first + high - 1]
            t = self._t[self._first : self._first + high + 1]
        if low < 0 or high >= len(t) or end_s <= begin_s or (t[low + 1 : high + 1] - t[low:high]).max() > GAP_S:
            return None
        out, length = np.empty(27), end_s - begin_s
        _preintegrate(self._t, self._z, self._first, len(t), begin_s, end_s, out)
        R, dv, dp, a, b = out[:9].reshape(3, 3), out[9:12], out[12:15], out[15:21], out[21:]
        return Window(length, R, dv, dp, (a + b) / 2, b - a, self._density)

    def started(self, before: Navigated | None, t_s: float, T: Array, twist: Array, rows: int) -> Navigated:
        """Return velocity and parameters where a window begins and the velocity is known by the joints alone.

        Args:
            before: what was known; None: nothing.
            t_s: when, s.
            T: (4, 4) pose of the tool.
            twist: (6,) its motion by the joints, tool axes.
            rows: of the arm's state, K.
        """
        size = _PARAMETERS + len(self.sensor.cov)
        y, C, Y = np.zeros(size), np.zeros((rows, size)), np.zeros((size, size))
        if before is None:
            Y[_DELAY, _DELAY], Y[_PARAMETERS:, _PARAMETERS:] = self.sensor.sigma_delay_s**2, self.sensor.cov
        else:
            y[_DELAY:], C[:, _DELAY:], Y[_DELAY:, _DELAY:] = (
                before.y[_DELAY:],
                before.C[:, _DELAY:],
                before.Y[_DELAY:, _DELAY:],
            )
        y[_V] = T[:3, :3] @ (twist[:3] + np.cross(twist[3:], self._lever))
        Y[_V, _V] = START_M_S**2 * np.eye(3)
        return Navigated(t_s, y, C, Y)

    def advanced(
        self,
        window: Window,
        beside: Navigated,
        state: tuple[Array, Array],
        step: tuple[Array, Array],
        poses: tuple[Array, Array],
        fixed: int,
    ) -> Advanced:
        """Use a window.

        Args:
            window: what was felt.
            beside: velocity and parameters at its begin.
            state: the arm's error (K,) there, and its covariance (K, K).
            step: what motion makes of it: factors (K,) and variances (K,) that are added.
            poses: of the tool at begin and end (2, 4, 4), and their derivatives (2, 6, K) by the arm's error then.
            fixed: row of the arm's error that no reading changes.
        """
        (x, P), (kept, added), (_, y, C, Y) = state, step, beside
        r, at, by_y = self._constraint(window, poses[0], y)
        H0, ends = poses[1][0], at[:6, 6:] @ poses[1][1]
        D = at[:, :6] @ H0
        D[:6] += ends * kept
        DP, DC = D @ P + by_y @ C.T, D @ C + by_y @ Y
        W = DP @ D.T + DC @ by_y.T + self._noise(window, poses[0][0])
        W[:6, :6] += (ends * added) @ ends.T
        # The state at the end: the arm's errors, the new velocity and the parameters, before the constraints.
        C, Y, y = C * kept[:, None], Y.copy(), y.copy()
        C[:, _V], Y[_V], Y[:, _V], Y[_V, _V], y[_V] = (DP[6:] * kept).T, DC[6:], DC[6:].T, W[6:, 6:], r[6:]
        Y[_BIASES, _BIASES] += (window.density / CORNER_S) ** 2 * window.length_s
        by_x, by_beside = DP[:6] * kept + ends * added, DC[:6]
        by_beside[:, _V] = W[:6, 6:]
        S, z = W[:6, :6], -r[:6]
        gain, gain_y = np.linalg.solve(S, by_x).T, np.linalg.solve(S, by_beside).T
        forgets = np.flatnonzero(kept != 1.0)
        P = P.copy()
        if len(forgets):  # they stand side by side
            rows = slice(forgets[0], forgets[-1] + 1)
            P[rows] *= kept[rows, None]
            P[:, rows] *= kept[rows]
        P.flat[:: len(P) + 1] += added
        P -= gain @ by_x
        P[fixed, fixed] += gain[fixed] @ by_x[:, fixed]
        gain[fixed] = 0.0
        C -= by_x.T @ gain_y.T
        Y -= gain_y @ by_beside
        after = Navigated(beside.t_s + window.length_s, y + gain_y @ z, C, (Y + Y.T) / 2)
        return Advanced(x * kept + gain @ z, P, after, gain, D[:6], z, S)

    def _constraint(self, window: Window, Ts: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return residual and velocity at the end (9,); derivatives by the tool's tangents (9, 12) and by y (9, B)."""
        D, gravity = window.length_s, STANDARD_GRAVITY_M_S2 * self._up
        R_tool_sensor, r = self._R, skew(self._lever)
        R0, R1 = Ts[0, :3, :3] @ R_tool_sensor, Ts[1, :3, :3] @ R_tool_sensor
        p0, p1 = Ts[:, :3, :3] @ self._lever + Ts[:, :3, 3]
        s = R0.T @ (p1 - p0 - y[_V] * D + 0.5 * D * D * gravity)
        rotated = window.R.T @ R0.T @ R1
        out = np.empty(9)
        out[:3] = 0.5 * np.array(
            [rotated[2, 1] - rotated[1, 2], rotated[0, 2] - rotated[2, 0], rotated[1, 0] - rotated[0, 1]]
        )
        out[3:6], out[6:] = s - window.dp, y[_V] - D * gravity + R0 @ window.dv
        by, by_y, there = np.zeros((9, 12)), np.zeros((9, len(y))), R0.T @ Ts[1, :3, :3]
        by[:3, 3:6], by[:3, 9:] = -R1.T @ R0 @ R_tool_sensor.T, R_tool_sensor.T
        by[3:6, :3], by[3:6, 3:6] = -R_tool_sensor.T, R_tool_sensor.T @ r + skew(s) @ R_tool_sensor.T
        by[3:6, 6:9], by[3:6, 9:] = there, -there @ r
        by[6:, 3:6] = -R0 @ skew(window.dv) @ R_tool_sensor.T
        by_y[3:6, _V], by_y[6:, _V] = -D * R0.T, np.eye(3)
        spin, push = window.change[:3], window.change[3:]
        by_y[:3, _DELAY], by_y[3:6, _DELAY], by_y[6:, _DELAY] = -spin, -0.5 * D * push, R0 @ push
        felt = self.sensor.felt_by(window.mean)
        by_y[:3, _PARAMETERS:], by_y[3:6, _PARAMETERS:] = -D * felt[:3], -0.5 * D * D * felt[3:]
        by_y[6:, _PARAMETERS:] = D * R0 @ felt[3:]
        mount, lever, tilt = (slice(_PARAMETERS + rows.start, _PARAMETERS + rows.stop) for rows in MOUNTING)
        by_y[:3, mount], by_y[3:6, mount] = np.eye(3) - R1.T @ R0, skew(s)
        by_y[6:, mount], by_y[3:6, lever] = -R0 @ skew(window.dv), there - R_tool_sensor.T
        by_up = STANDARD_GRAVITY_M_S2 * D * self._up_by_tilt
        by_y[3:6, tilt], by_y[6:, tilt] = 0.5 * D * R0.T @ by_up, -by_up
        return out + by_y[:, _DELAY:] @ y[_DELAY:], by, by_y

    def _noise(self, window: Window, T: Array) -> Array:
        """Return the covariance (9, 9) of what the samples' noise makes of residual and velocity."""
        D, (gyro, force) = window.length_s, window.density.reshape(2, 3) ** 2
        R0, out = T[:3, :3] @ self._R, np.zeros((9, 9))
        out[:3, :3], out[3:6, 3:6] = np.diag(gyro * D), np.diag(force * D**3 / 3)
        out[3:6, 6:] = -force[:, None] * (D * D / 2) * R0.T
        out[6:, 3:6], out[6:, 6:] = out[3:6, 6:].T, R0 * (force * D) @ R0.T
        return out
