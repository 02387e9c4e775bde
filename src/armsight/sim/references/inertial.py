"""An inertial unit: true poses in, its recording out, with the errors of the chip, its clock and its mount.

The motion is differentiated from the poses alone, so that nothing is shared with the model of an estimator. Errors beyond
scale, bias and white noise: bias that walks and warms up, a range that ends, rounding, the chip's low-pass, sensitivity to
acceleration, a clock of its own, readings lost and repeated, a mount that resonates, the hum of motors.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import signal

from armsight.data import Array, Record
from armsight.geometry.pose import exp_se3, inverse, log_se3

_UP_M_S2 = np.array([0.0, 0.0, 9.80665])
_DAMPING = 0.05  # of a loose mount, of critical


def _none() -> Array:
    return np.zeros(6)


@dataclass(frozen=True, eq=False)
class InertialErrors(Record):
    """What is wrong with a unit: rows of six are gyro x, y, z, rad/s, then accelerometer x, y, z, m/s2.

    Attributes:
        noise: (6,) density, per sqrt(Hz).
        bias: (6,) at power-on.
        walk: (6,) of the bias, per sqrt(s).
        warming: (6,) change of the bias as the chip warms up.
        warming_s: time constant of that, s.
        scale: (6, 3) by how much the matrices of gyro and accelerometer differ from the identity, row by row.
        g_sensitivity: (3, 3) of the gyro, rad/s per m/s2.
        largest: (6,) end of the range.
        step: (6,) that values are rounded to.
        bandwidth_hz: of the chip's low-pass of second order.
        rate_hz: readings a second, by its own clock.
        clock: by how much that clock is slow, relative.
        lost: share of the readings.
        repeated: share of the readings that repeat the one before.
        mount_hz: resonance of a loose mount about the sensor's x axis; 0: rigid.
        hum: (6,) amplitude of the motors' vibration.
        hum_hz: its frequency.
    """

    noise: Array = field(default_factory=lambda: np.repeat([9e-5, 4e-3], 3))
    bias: Array = field(default_factory=_none)
    walk: Array = field(default_factory=_none)
    warming: Array = field(default_factory=_none)
    warming_s: float = 60.0
    scale: Array = field(default_factory=lambda: np.zeros((6, 3)))
    g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))
    largest: Array = field(default_factory=lambda: np.repeat([8.7, 39.0], 3))
    step: Array = field(default_factory=lambda: np.repeat([2.7e-4, 1.2e-3], 3))
    bandwidth_hz: float = 42.0
    rate_hz: float = 100.0
    clock: float = 0.0
    lost: float = 0.0
    repeated: float = 0.0
    mount_hz: float = 0.0
    hum: Array = field(default_factory=_none)
    hum_hz: float = 47.0


def record(t_s: Array, Ts_base_sensor: Array, errors: InertialErrors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return stamps (N,), s, by the unit's own clock, and readings (N, 6).

    Args:
        t_s: (M,) times, evenly spaced by a millisecond or less, s.
        Ts_base_sensor: (M, 4, 4) true poses of the sensor's mount; z of the base is up.
        errors: of the unit.
        rng: random numbers.
    """
    dt = float(t_s[1] - t_s[0])
    z = _felt(Ts_base_sensor, dt)
    if errors.mount_hz:
        w = 2 * np.pi * errors.mount_hz
        drive = np.gradient(z[:, 0], dt)
        _, angle, _ = signal.lsim(([-1.0], [1.0, 2 * _DAMPING * w, w * w]), drive, t_s - t_s[0])
        moved = np.zeros((len(t_s), 6))
        moved[:, 3] = angle
        z = _felt(Ts_base_sensor @ exp_se3(moved), dt)
    z = z + errors.hum * np.sin(2 * np.pi * errors.hum_hz * t_s[:, None] + np.arange(6))
    rates, forces = z[:, :3], z[:, 3:]
    z = z + np.hstack([rates @ errors.scale[:3].T + forces @ errors.g_sensitivity.T, forces @ errors.scale[3:].T])
    z = signal.sosfilt(signal.butter(2, errors.bandwidth_hz, fs=1 / dt, output="sos"), z - z[0], axis=0) + z[0]
    period = (1.0 + errors.clock) / errors.rate_hz
    at = np.arange(t_s[0], t_s[-1], period)
    out = np.column_stack([np.interp(at, t_s, column) for column in z.T])
    out += errors.bias + errors.warming * (1 - np.exp(-(at - t_s[0]) / errors.warming_s))[:, None]
    out += np.cumsum(rng.normal(size=out.shape), axis=0) * errors.walk * np.sqrt(period)
    out += rng.normal(size=out.shape) * errors.noise * np.sqrt(errors.rate_hz)
    out = np.round(np.clip(out, -errors.largest, errors.largest) / errors.step) * errors.step
    again = np.flatnonzero(rng.uniform(size=len(out)) < errors.repeated)
    out[again] = out[np.maximum(again - 1, 0)]
    kept = rng.uniform(size=len(out)) >= errors.lost
    stamps = t_s[0] + np.arange(len(at)) / errors.rate_hz
    return stamps[kept], out[kept]


def _felt(Ts: Array, dt: float) -> Array:
    """Return angular velocity and specific force (M, 6) in the sensor's axes, from its poses."""
    z = np.empty((len(Ts), 6))
    z[1:-1, :3] = log_se3(inverse(Ts[:-2]) @ Ts[2:])[:, 3:] / (2 * dt)
    p = Ts[:, :3, 3]
    force = (p[2:] - 2 * p[1:-1] + p[:-2]) / dt**2 + _UP_M_S2
    z[1:-1, 3:] = np.einsum("nji,nj->ni", Ts[1:-1, :3, :3], force)
    z[0], z[-1] = z[1], z[-2]
    return z
