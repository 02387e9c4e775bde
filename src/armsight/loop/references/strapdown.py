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
from armsight.geometry.matrix import applied, product, solved
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
#: The delay is known no better, s, as each run converts the clock anew; half: more units are dropped, double: found later.
DELAY_S = 1e-3
#: Full scales of chips (6, 12), rad/s and m/s2: 125 to 4000 deg/s, 143 to 4588 by ST's rounded sensitivities, 2 to 64 g.
_LEAST = np.array([np.radians([125.0, 143.36]), np.full(2, 2.0 * STANDARD_GRAVITY_M_S2)])
FULL_SCALES = np.kron(np.repeat(_LEAST, 3, axis=0), 2.0 ** np.arange(6))
#: A value that near to a full scale, relative, of so many of its axis's least steps (32768 of 16 bits; of a chip of twice
#: the range half as many), that is the same twice is clipped. Drivers round sensitivities and gravity. Half of ROUNDED:
#: those of 16.4 per deg/s are not found, double: nothing; half of STEPS: steady motion is lost, double: none are found.
ROUNDED, STEPS = 1.5e-3, 2e4
#: A window's noise is at most so many times its class's; half: hard motions claim too much, double: impacts are noise.
SCATTER = 30.0
#: Rows of what is estimated beside the arm: velocity, delay, and the unit's parameters.
_V, _DELAY, _PARAMETERS = slice(0, 3), 3, 4
_MOUNTED, _LEVERED, _TILTED = (_PARAMETERS + rows.start for rows in MOUNTING)
_BIASED = _PARAMETERS + BIASES.start


@dataclass(frozen=True, eq=False)
class Samples(Record):
    """Samples of an inertial unit, in order of time."""

    t_s: Array  #: (N,) when, s, as its clock stamps them; its delay is still in them
    z: Array  #: (N, 6) angular velocity, rad/s, and specific force, m/s2, as read
    density: Array  #: (6,) of their noise, per sqrt(Hz)


class Navigated(NamedTuple):
    """What is estimated beside the arm's errors."""

    t_s: float  #: when its velocity was, s; of another time than the state's the velocity is not known
    y: Array  #: (B,) velocity of the sensor, base, m/s; then how much the delay and the parameters are off
    C: Array  #: (K, B) covariance of the arm's errors with its
    Y: Array  #: (B, B) its covariance


class Advanced(NamedTuple):
    """A filter's state at the end of a window, the window used."""

    x: Array  #: (K,) the arm's error
    P: Array  #: (K, K) its covariance
    beside: Navigated  #: velocity and parameters
    gain: Array  #: (K + B, 6) what of the residual was added to x, and to what is beside
    by: Array  #: (6, K) derivative of the residual by the state before
    z: Array  #: (6,) residual: felt minus predicted
    S: Array  #: (6, 6) its covariance
    by_y: Array  #: (6, B) derivative of the residual by what is beside
    velocity: Array  #: (3, K + B) derivative of the velocity at the end by the state before, and by what is beside


@kernel
def _raise_density(t: Array, z: Array, first: int, newest: int, end: float, out: Array) -> None:
    """Raise a window's densities to what samples before ``end`` scatter about lines through those beside.

    Motion and vibration that are too fast for the samples are integrated as wrongly as noise is.
    """
    bends, count = np.zeros(6), 0
    for row in range(first, newest):
        if t[row - 1] < end:
            for i in range(6):
                bends[i] += (z[row + 1, i] - 2.0 * z[row, i] + z[row - 1, i]) ** 2 * (t[row + 1] - t[row - 1]) / 12.0
            count += 1
    for i in range(6):
        if bends[i] > count * out[28 + i] ** 2:
            out[28 + i] = min(math.sqrt(bends[i] / count), SCATTER * out[28 + i])


@kernel("f8[::1], f8[:, ::1], i8, i8, f8, f8, f8[::1]")
def _preintegrate(t: Array, z: Array, first: int, last: int, begin: float, end: float, out: Array) -> bool:
    """Write a window, see :meth:`Strapdown.window`, of rows first to last of t (N,), z (N, 6), if complete."""
    R, a, b = np.eye(3), np.empty(6), np.empty(6)
    v, p, rotated = np.zeros(3), np.zeros(3), np.empty((3, 3))
    if last < first or begin < t[first] or end <= begin or end >= t[last] + HELD_S:
        return False
    newest = last
    if end > t[last]:
        last += 1
        t[last], z[last] = end, z[last - 1]
    k = last
    while t[k - 1] > begin:
        k -= 1
    _raise_density(t, z, max(k - 1, first + 1), newest, end, out)
    at = begin
    for i in range(6):
        a[i] = z[k - 1, i] + (z[k, i] - z[k - 1, i]) * (begin - t[k - 1]) / (t[k] - t[k - 1])
        out[16 + i] = a[i]
    while at < end:
        if t[k] - t[k - 1] > GAP_S:
            return False
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
    out[0] = end - begin
    for i in range(9):
        out[1 + i] = R[i // 3, i % 3]
    for i in range(3):
        out[10 + i], out[13 + i] = v[i], p[i]
    for i in range(6):
        out[16 + i], out[22 + i] = (a[i] + out[16 + i]) / 2, a[i] - out[16 + i]
    return True


@kernel
def _times_skew(A: Array, a: Array) -> Array:
    """Return the product (3, 3) of A (3, 3) and the cross product matrix of a (3,)."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            out[i, j] = A[i, k] * a[m] - A[i, m] * a[k]
    return out


@kernel
def _skew_times(a: Array, A: Array) -> Array:
    """Return the product (3, 3) of the cross product matrix of a (3,) and A (3, 3)."""
    out = np.empty((3, 3))
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            out[i, j] = a[k] * A[m, j] - a[m] * A[k, j]
    return out


@kernel("f8[::1], f8[:, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1]")
def _constraint(felt: Array, mount: Array, Ts: Array, y: Array, by: Array, by_y: Array, r: Array, noise: Array) -> None:
    """Write residual and velocity at the end (9,), and their noise (9, 9); derivatives by the tool's tangents, and by y.

    ``felt``: (34,) a window. ``mount``: (9, 3) rotation of the mounting; lever; up, and its derivative by the tilt,
    both times gravity. ``by``: (9, 12) to be written, zero.
    """
    D, dv, dp, mean, change, density = felt[0], felt[10:13], felt[13:16], felt[16:22], felt[22:28], felt[28:34]
    M, lever, up = mount[:3], mount[3], mount[4]
    Mt, R0, R1 = M.T.copy(), product(Ts[0, :3, :3], M), product(Ts[1, :3, :3], M)
    R0t, p = R0.T.copy(), 0.5 * D * D * up - D * y[:3]
    for i in range(3):
        p[i] += Ts[1, i, 3] - Ts[0, i, 3]
        for j in range(3):
            p[i] += (Ts[1, i, j] - Ts[0, i, j]) * lever[j]
    s, there, across = applied(R0t, p), product(R0t, Ts[1, :3, :3].copy()), product(R1.T.copy(), R0)
    rotated, push = product(felt[1:10].copy().reshape(3, 3).T.copy(), across.T.copy()), change[3:]
    pushed, by_push, by_dv = _times_skew(R0, dv), applied(R0, push), applied(R0, dv)
    ends, swept = (product(across, Mt), _skew_times(s, Mt)), product(pushed, Mt)
    swung, levered = _times_skew(Mt, lever), _times_skew(there, lever)
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        r[i], r[3 + i], r[6 + i] = 0.5 * (rotated[m, k] - rotated[k, m]), s[i] - dp[i], y[i] - D * up[i] + by_dv[i]
        by_y[i, 3], by_y[3 + i, 3], by_y[6 + i, 3], by_y[6 + i, i] = -change[i], -0.5 * D * push[i], by_push[i], 1.0
        noise[i, i], noise[3 + i, 3 + i] = density[i] ** 2 * D, density[3 + i] ** 2 * D**3 / 3
        for j in range(3):
            by[i, 3 + j], by[i, 9 + j], by[3 + i, j] = -ends[0][i, j], Mt[i, j], -Mt[i, j]
            by[3 + i, 3 + j], by[3 + i, 6 + j] = swung[i, j] + ends[1][i, j], there[i, j]
            by[3 + i, 9 + j], by[6 + i, 3 + j] = -levered[i, j], -swept[i, j]
            by_y[i, _MOUNTED + j], by_y[6 + i, _MOUNTED + j] = -across[i, j], -pushed[i, j]
            by_y[3 + i, j], by_y[3 + i, _LEVERED + j] = -D * R0[j, i], there[i, j] - Mt[i, j]
            noise[3 + i, 6 + j] = noise[6 + j, 3 + i] = -(density[3 + i] ** 2) * (D * D / 2) * R0[j, i]
            for n in range(3):
                noise[6 + i, 6 + j] += R0[i, n] * density[3 + n] ** 2 * D * R0[j, n]
        by_y[i, _MOUNTED + i] += 1.0
        by_y[3 + i, _MOUNTED + m], by_y[3 + i, _MOUNTED + k] = s[k], -s[m]
        for j in range(2):
            by_y[6 + i, _TILTED + j] = -D * mount[5 + j, i]
            for n in range(3):
                by_y[3 + i, _TILTED + j] += 0.5 * D * D * R0[n, i] * mount[5 + j, n]
    _by_parameters(mean, D, R0, by_y)
    for i in range(9):
        for j in range(3, len(y)):
            r[i] += by_y[i, j] * y[j]


@kernel
def _by_parameters(mean: Array, D: float, R0: Array, by_y: Array) -> None:
    """Add what biases, scales and sensitivity do to angular velocity and force in a window."""
    at = _PARAMETERS + 6
    for row in range(3):
        by_y[row, at + row] = D
        for j in range(3):
            by_y[row, at + 12 + 3 * row + j], by_y[row, at + 21 + 3 * row + j] = D * mean[j], D * mean[3 + j]
    column = at + 6
    for row in range(3):
        for j in range(row - 1, 3):
            # First the bias, then the row of the upper triangle.
            where, value = (at + 3 + row, 1.0) if j < row else (column, mean[3 + j])
            column += j >= row
            by_y[3 + row, where] = 0.5 * D * D * value
            for i in range(3):
                by_y[6 + i, where] = -D * R0[i, row] * value


@kernel
def _add(A: Array, B: Array, out: Array) -> None:
    """Add the product of A (n, m) and B (m, k) to out (n, k)."""
    for j in range(A.shape[1]):
        for i in range(A.shape[0]):
            factor = A[i, j]
            if factor != 0.0:
                for k in range(B.shape[1]):
                    out[i, k] += factor * B[j, k]


@kernel(fastmath={"contract", "reassoc", "nsz"})
def _add_transposed(A: Array, B: Array, out: Array) -> None:
    """Add the product of A (n, m) and the transpose of B (k, m) to out (n, k)."""
    for i in range(A.shape[0]):
        for k in range(B.shape[0]):
            total = 0.0
            for j in range(A.shape[1]):
                total += A[i, j] * B[k, j]
            out[i, k] += total


@kernel(
    "f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[::1], f8[::1], i8, f8[::1], f8[:, ::1], f8[::1], f8[:, ::1], "
    "f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1]",
    fastmath={"contract"},
)
def _advance(
    felt: Array,
    mount: Array,
    Ts: Array,
    Hs: Array,
    kept: Array,
    added: Array,
    fixed: int,
    x: Array,
    P: Array,
    y: Array,
    C: Array,
    Y: Array,
    gain: Array,
    D: Array,
    by_y: Array,
    z: Array,
    S: Array,
) -> None:
    """Overwrite x, P, y, C, Y by the state after a window; write gain, D, by_y, residual and S."""
    K, B = len(x), len(y)
    r, by, W, ends = np.empty(9), np.zeros((9, 12)), np.zeros((9, 9)), np.zeros((6, K))
    D[:] = by_y[:] = 0.0
    _constraint(felt, mount, Ts, y, by, by_y, r, W)
    _add(by[:, :6], Hs[0], D)
    _add(by[:6, 6:], Hs[1], ends)
    for i in range(6):
        for k in range(K):
            D[i, k] += ends[i, k] * kept[k]
    DP, DC, ends_added = np.zeros((9, K)), np.zeros((9, B)), ends * added
    _add(D, P, DP)
    _add_transposed(by_y, C, DP)
    _add(D, C, DC)
    _add(by_y, Y, DC)
    _add_transposed(DP, D, W)
    _add_transposed(DC, by_y, W)
    _add_transposed(ends_added, ends, W[:6, :6])
    # The state at the end: the arm's errors, the new velocity and the parameters, before the constraints.
    right = np.empty((6, K + B + 1))
    for i in range(6):
        right[i, K + B] = z[i] = -r[i]
        for k in range(K):
            right[i, k] = DP[i, k] * kept[k] + ends_added[i, k]
        for j in range(B):
            right[i, K + j] = W[i, 6 + j] if j < 3 else DC[i, j]
    for k in range(K):
        for j in range(B):
            C[k, j] = (DP[6 + j, k] if j < 3 else C[k, j]) * kept[k]
    for i in range(3):
        y[i], Y[i], Y[:, i] = r[6 + i], DC[6 + i], DC[6 + i]
    for i in range(3):
        for j in range(3):
            Y[i, j] = W[6 + i, 6 + j]
    for i in range(6):
        Y[_BIASED + i, _BIASED + i] += (felt[28 + i] / CORNER_S) ** 2 * felt[0]
    S[:] = W[:6, :6]
    solution = solved(S, right)
    for k in range(K):
        if kept[k] != 1.0:
            for j in range(K):
                P[k, j] *= kept[k]
                P[j, k] *= kept[k]
    _subtract(solution, right, z, fixed, kept, added, (x, P, y, C, Y, gain))


@kernel(fastmath={"contract"})
def _subtract(
    solution: Array,
    right: Array,
    z: Array,
    fixed: int,
    kept: Array,
    added: Array,
    state: tuple[Array, Array, Array, Array, Array, Array],
) -> None:
    """Use the constraints: what they do to the arm's errors (K,), to what is beside (B,), and to their covariances."""
    x, P, y, C, Y, gain = state
    K, B = len(x), len(y)
    for k in range(K):
        x[k] *= kept[k]
        P[k, k] += added[k]
        whole = P[k, k]
        for i in range(6):
            gain[k, i] = factor = solution[i, k]
            for j in range(K):
                P[k, j] -= factor * right[i, j]
            for j in range(B):
                C[k, j] -= factor * right[i, K + j]
            if k != fixed:
                x[k] += factor * z[i]
        if k == fixed:  # its row is as it was
            P[k, k] = whole
            gain[k] = 0.0
    for k in range(B):
        for i in range(6):
            gain[K + k, i] = factor = solution[i, K + k]
            y[k] += factor * z[i]
            for j in range(B):
                Y[k, j] -= factor * right[i, K + j]
    for k in range(B):
        for j in range(k):
            Y[k, j] = Y[j, k] = (Y[k, j] + Y[j, k]) / 2


class Strapdown:
    """An inertial unit's samples of the last seconds, and how they bear on the filter."""

    def __init__(self, sensor: Inertial) -> None:
        self.sensor, self._density = sensor, np.zeros(6)
        self._t, self._z = np.empty(_ROWS + 1), np.empty((_ROWS + 1, 6))  # and the one that is held
        self._read, self._step = np.zeros((1, 6)), np.full(6, np.inf)  # the newest as read, the least change so far
        self._first = self._count = 0
        self._lever, tilt = sensor.T_tool_sensor[:3, 3], np.append(sensor.values[-2:], 0.0)
        up = exp_so3(tilt)[:, 2]
        gravity = STANDARD_GRAVITY_M_S2 * np.vstack([up, (-skew(up) @ left_jacobian(tilt)).T[:2]])
        self._mount = np.vstack([sensor.T_tool_sensor[:3, :3], self._lever, gravity])

    @property
    def newest_s(self) -> float:
        """Time of the newest sample, s, the delay removed; minus infinity before the first."""
        return float(self._t[self._first + self._count - 1]) if self._count else -np.inf

    def add(self, samples: Samples) -> None:
        """Take samples, nothing of clipped ones; wrong shapes, NaN, or times that do not rise are an InputError."""
        t, z = np.asarray(samples.t_s, float) - self.sensor.delay_s, np.asarray(samples.z, float)
        steps = np.diff(t, prepend=self.newest_s)
        if z.shape != (len(t), 6) or not np.isfinite(z).all() or not (steps > 0.0).all():
            raise InputError(
                f"{self.sensor.name}: expected samples (N, 6), numbers, at times that rise from {self.newest_s:.4f} s on; "
                f"given are {z.shape} from {t[0] if len(t) else np.nan:.4f} s on"
            )
        changes, sizes = np.abs(np.diff(z, axis=0, prepend=self._read)), np.abs(z)
        self._step = np.where(changes > 0.0, changes, np.inf).min(axis=0, initial=np.inf).clip(max=self._step)
        full = (np.abs(sizes[..., None] / FULL_SCALES - 1.0) < ROUNDED).any(axis=2) & (sizes > STEPS * self._step)
        clipped = ((changes == 0.0) & full).any(axis=1)
        self._read, clipped = z[-1:] if len(z) else self._read, np.append(clipped, False)
        z = np.where((clipped[:-1] | clipped[1:])[:, None], np.nan, self.sensor.felt(z))
        t, z, self._density = t[-_ROWS // 2 :], z[-_ROWS // 2 :], samples.density
        if clipped[0] and self._count:
            self._z[self._first + self._count - 1] = np.nan
        if self._first + self._count + len(t) >= _ROWS:
            kept = slice(self._first + max(self._count - _ROWS // 2, 0), self._first + self._count)
            self._count = kept.stop - kept.start
            self._t[: self._count], self._z[: self._count] = self._t[kept].copy(), self._z[kept].copy()
            self._first = 0
        rows = slice(self._first + self._count, self._first + self._count + len(t))
        self._t[rows], self._z[rows] = t, z
        self._count += len(t)

    def window(self, begin_s: float, end_s: float) -> Array | None:
        """Return what was felt between two times, s, (34,); None where samples are missing, NaN in it where clipped.

        In the axes at the first time: length, s; rotation (9); integral of the specific force, m/s, and of that, m; mean of
        angular velocity and specific force, their change from begin to end, and the density of the noise (6 each).
        """
        felt, rows = np.empty(34), (self._first, self._first + self._count - 1)
        felt[28:] = self._density
        there = _preintegrate(self._t, self._z, *rows, begin_s, end_s, felt)
        return felt if there else None

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
            Y[_DELAY, _DELAY] = max(self.sensor.sigma_delay_s, DELAY_S) ** 2
            Y[_PARAMETERS:, _PARAMETERS:] = self.sensor.cov
        else:
            known = slice(_DELAY, None)
            y[known], C[:, known], Y[known, known] = before.y[known], before.C[:, known], before.Y[known, known]
        y[_V] = T[:3, :3] @ (twist[:3] + np.cross(twist[3:], self._lever))
        Y[_V, _V] = START_M_S**2 * np.eye(3)
        return Navigated(t_s, y, C, Y)

    def advanced(
        self,
        window: Array,
        beside: Navigated,
        state: tuple[Array, Array],
        step: tuple[Array, Array],
        poses: tuple[Array, Array],
        fixed: int,
    ) -> Advanced:
        """Use a window.

        Args:
            window: (34,) what was felt.
            beside: velocity and parameters at its begin.
            state: the arm's error (K,) there, and its covariance (K, K).
            step: what motion makes of it: factors (K,) and variances (K,) that are added.
            poses: of the tool at begin and end (2, 4, 4), and their derivatives (2, 6, K) by the arm's error then.
            fixed: row of the arm's error that no reading changes.
        """
        x, P, y, C, Y = (each.copy() for each in (*state, *beside[1:]))
        gain, D, by_y = np.empty((len(x) + len(y), 6)), np.empty((9, len(x))), np.empty((9, len(y)))
        z, S = np.empty(6), np.empty((6, 6))
        _advance(window, self._mount, *poses, *step, fixed, x, P, y, C, Y, gain, D, by_y, z, S)
        after = Navigated(beside.t_s + float(window[0]), y, C, Y)
        return Advanced(x, P, after, gain, D[:6], z, S, by_y[:6], np.hstack([D[6:], by_y[6:]]))
