"""An inertial unit: true poses in, its readings out, with the errors of the chip, its clock and its mount.

The motion is differentiated from the poses alone, so that nothing is shared with the model of an estimator. Errors beyond
scale, bias and white noise: bias that walks and warms up, a range that ends, rounding, the chip's low-pass, sensitivity to
acceleration, a clock of its own, readings lost and repeated, a mount that resonates, the hum of motors.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import exp_se3, inverse, log_se3

_UP_M_S2 = np.array([0.0, 0.0, 9.80665])
_DAMPING = 0.05  # of a loose mount, of critical


def _none() -> Array:
    return np.zeros(6)


@dataclass(frozen=True, eq=False)
class InertialErrors(Record):
    """What is wrong with a unit: rows of six are gyro x, y, z, rad/s, then accelerometer x, y, z, m/s2."""

    noise: Array = field(default_factory=lambda: np.repeat([9e-5, 4e-3], 3))  #: (6,) density, per sqrt(Hz)
    bias: Array = field(default_factory=_none)  #: (6,) at power-on
    walk: Array = field(default_factory=_none)  #: (6,) of the bias, per sqrt(s)
    warming: Array = field(default_factory=_none)  #: (6,) change of the bias as the chip warms up
    warming_s: float = 60.0  #: time constant of that, s
    #: (6, 3) by how much the matrices of gyro and accelerometer differ from the identity, row by row
    scale: Array = field(default_factory=lambda: np.zeros((6, 3)))
    g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))  #: (3, 3) of the gyro, rad/s per m/s2
    largest: Array = field(default_factory=lambda: np.repeat([8.726, 39.22], 3))  #: (6,) end of the range
    step: Array = field(default_factory=lambda: np.repeat([2.7e-4, 1.2e-3], 3))  #: (6,) that values are rounded to
    bandwidth_hz: float = 42.0  #: of the chip's low-pass of second order
    rate_hz: float = 100.0  #: readings a second, by its own clock
    clock: float = 0.0  #: by how much that clock is slow, relative
    lost: float = 0.0  #: share of the readings that are missing
    repeated: float = 0.0  #: share of the readings that repeat the one before
    mount_hz: float = 0.0  #: resonance of a loose mount about the sensor's x axis; 0: rigid
    hum: Array = field(default_factory=_none)  #: (6,) amplitude of the motors' vibration
    hum_hz: float = 47.0  #: its frequency

    @staticmethod
    def typical(
        density: tuple[float, float],
        bias: tuple[float, float],
        scale: float,
        g_sensitivity: float,
        rng: np.random.Generator,
        *,
        good: bool = True,
        rate_hz: float = 1000.0,
    ) -> InertialErrors:
        """Return those of a unit of a class, drawn.

        Args:
            density: of the noise of gyro and accelerometer, per sqrt(Hz).
            bias: one sigma of both.
            scale: one sigma, relative.
            g_sensitivity: one sigma, rad/s per m/s2.
            rng: random numbers.
            good: whether the gyro is of the better sort: warms up less, is rounded less.
            rate_hz: readings a second.
        """
        noise = np.repeat(density, 3)
        return InertialErrors(
            noise,
            np.repeat(bias, 3) * rng.normal(size=6),
            noise / 10,
            np.repeat([2e-4 if good else 1e-3, 0.02], 3) * rng.normal(size=6),
            200.0,
            rng.normal(size=(6, 3)) * scale / 2,
            rng.normal(size=(3, 3)) * g_sensitivity / 2,
            step=np.repeat([7e-5 if good else 2.7e-4, 1.2e-3], 3),
            bandwidth_hz=rate_hz / 4,
            rate_hz=rate_hz,
            lost=0.002,
            hum=np.repeat([1e-3, 0.02], 3),
            hum_hz=97.0,
        )


class InertialUnit:
    """A unit that is read as time passes; its mount is not loose here."""

    def __init__(self, errors: InertialErrors, rng: np.random.Generator) -> None:
        self._errors, self._rng = errors, rng
        self._t_s, self._Ts = np.empty(0), np.empty((0, 4, 4))  # the newest two poses
        # The newest value behind the low-pass, its time; the filter's state; count of readings, the walk, the newest.
        self._felt, self._filter, self._begin_s = np.empty((0, 7)), np.empty(0), 0.0
        self._count, self._walk, self._newest = 0, np.zeros(6), np.empty((0, 6))

    def read(self, t_s: Array, Ts_base_sensor: Array) -> tuple[Array, Array]:
        """Return stamps (N,), s, and readings (N, 6) that came since the last call, but for the newest tick.

        Times (M,) since then are evenly spaced by a millisecond or less; poses (M, 4, 4) are true, z of the base is up.
        """
        t_s, Ts = np.append(self._t_s, t_s), np.concatenate([self._Ts, Ts_base_sensor])
        self._t_s, self._Ts = t_s[-2:], Ts[-2:]
        if len(t_s) < 3:
            return np.empty(0), np.empty((0, 6))
        felt, rate_hz = self._filtered(t_s[1:-1], _felt(Ts, float(t_s[1] - t_s[0]))), self._errors.rate_hz
        period = (1.0 + self._errors.clock) / rate_hz
        end = int(np.floor((felt[-1, 0] - self._begin_s) / period + 1e-6)) + 1
        index, self._count = np.arange(self._count, end), max(end, self._count)
        at = np.asarray(self._begin_s + period * index, np.float64)
        out = np.column_stack([np.interp(at, felt[:, 0], column) for column in felt[:, 1:].T])
        return self._digital(out, at - self._begin_s, self._begin_s + index / rate_hz, period)

    def _filtered(self, t_s: Array, z: Array) -> Array:
        """Return times and values (N, 7) behind the analogue part, the last one of before among them."""
        from scipy import signal  # takes 25 MB, which a workcell without a unit does not need

        e = self._errors
        z = z + e.hum * np.sin(2 * np.pi * e.hum_hz * t_s[:, None] + np.arange(6))
        rates, forces = z[:, :3], z[:, 3:]
        z = z + np.hstack([rates @ e.scale[:3].T + forces @ e.g_sensitivity.T, forces @ e.scale[3:].T])
        sos = signal.butter(2, e.bandwidth_hz, fs=1 / (self._t_s[1] - self._t_s[0]), output="sos")
        if not len(self._filter):
            self._begin_s, self._filter = float(t_s[0]), signal.sosfilt_zi(sos)[..., None] * z[0]
        z, self._filter = signal.sosfilt(sos, z, axis=0, zi=self._filter)
        felt = np.vstack([self._felt, np.column_stack([t_s, z])])
        self._felt = felt[-1:]
        return felt

    def _digital(self, out: Array, since_s: Array, stamps: Array, period: float) -> tuple[Array, Array]:
        """Return what is sent of sampled values (N, 6): with bias and noise, rounded, some lost, some repeated."""
        e, rng = self._errors, self._rng
        out = out + e.bias + e.warming * (1 - np.exp(-since_s / e.warming_s))[:, None]
        walk = self._walk + np.cumsum(rng.normal(size=out.shape), axis=0) * e.walk * np.sqrt(period)
        out += walk + rng.normal(size=out.shape) * e.noise * np.sqrt(e.rate_hz)
        out = np.round(np.clip(out, -e.largest, e.largest) / e.step) * e.step
        again = np.flatnonzero(rng.uniform(size=len(out)) < e.repeated) + len(self._newest)
        kept = rng.uniform(size=len(out)) >= e.lost
        whole = np.vstack([self._newest, out])
        whole[again] = whole[np.maximum(again - 1, 0)]
        if len(out):
            self._walk, self._newest, out = walk[-1], whole[-1:], whole[len(self._newest) :]
        return stamps[kept], out[kept]


def record(t_s: Array, Ts_base_sensor: Array, errors: InertialErrors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return stamps (N,), s, by the unit's own clock, and readings (N, 6), of a whole motion, its mount loose or not.

    Arguments are as for :meth:`InertialUnit.read` and :class:`InertialUnit`.
    """
    if errors.mount_hz:
        from scipy import signal  # as above

        dt, w = float(t_s[1] - t_s[0]), 2 * np.pi * errors.mount_hz
        drive = np.zeros(len(t_s))
        drive[1:-1] = np.gradient(_felt(Ts_base_sensor, dt)[:, 0], dt)
        _, angle, _ = signal.lsim(([-1.0], [1.0, 2 * _DAMPING * w, w * w]), drive, t_s - t_s[0])
        moved = np.zeros((len(t_s), 6))
        moved[:, 3] = angle
        Ts_base_sensor = Ts_base_sensor @ exp_se3(moved)
    return InertialUnit(errors, rng).read(t_s, Ts_base_sensor)


def _felt(Ts: Array, dt: float) -> Array:
    """Return angular velocity and specific force (M - 2, 6) in the sensor's axes at poses (M, 4, 4) but the outer two."""
    z, p = np.empty((len(Ts) - 2, 6)), Ts[:, :3, 3]
    z[:, :3] = log_se3(inverse(Ts[:-2]) @ Ts[2:])[:, 3:] / (2 * dt)
    force = (p[2:] - 2 * p[1:-1] + p[:-2]) / dt**2 + _UP_M_S2
    z[:, 3:] = np.einsum("nji,nj->ni", Ts[1:-1, :3, :3], force)
    return z
