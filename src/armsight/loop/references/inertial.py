"""An inertial unit on the tool: angular velocity and specific force (Titterton and Weston, 2004, chapters 4 and 8).

With w the angular velocity and f the specific force at the sensor, in the sensor's axes, it reads

    gyro:           (I + M_g) w + G f + b_g
    accelerometer:  (I + M_a) f + b_a,        f = R_sensor_tool (v' + w x v + w' x r + w x (w x r) - R_tool_base g)

M_g has scales and misalignments; M_a is upper triangular, as what is left of its misalignment is the mounting's rotation;
G is the gyro's sensitivity to acceleration, r the lever arm. g points down; the base may be tilted against it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar, NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, left_jacobian, pose
from armsight.geometry.rotation import exp_so3, log_so3, nearest_rotation, skew
from armsight.loop.references.reference import STANDARD_GRAVITY_M_S2, ExpectedReading, Reading, Reference, ToolMotion

GYRO, ACCELEROMETER = 0, 1
_UPPER = np.triu_indices(3)
#: Rows of the parameters' tangent: rotation and lever of the mounting, biases, M_a, M_g, G, the base's tilt.
_ROTATION, _LEVER, _GYRO_BIAS, _BIAS, _M_A, _M_G, _G, _TILT = (
    slice(a, b) for a, b in ((0, 3), (3, 6), (6, 9), (9, 12), (12, 18), (18, 27), (27, 36), (36, 38))
)
_PARAMETERS = 38
#: Of them the mounting's rotation and lever and the base's tilt; and the biases.
MOUNTING, BIASES = (_ROTATION, _LEVER, _TILT), slice(_GYRO_BIAS.start, _BIAS.stop)
#: Units that are read for others: how many times larger the numbers then are, within _NEAR.
_MISREAD = {GYRO: ("rad/s", {"deg/s": 180.0 / np.pi}), ACCELEROMETER: ("m/s2", {"g": 1 / STANDARD_GRAVITY_M_S2})}
_NEAR = 0.2  # relative; half: a poor chip is not recognised, double: 25 % of scale error count as a unit
#: Singular values of what was measured, smallest over largest, below which its directions do not span the space.
_SPANS = 0.05


class InertialClass(NamedTuple):
    """What sensors of a class are like: one sigma."""

    gyro_noise: float  #: rad/s/sqrt(Hz)
    noise: float  #: of the accelerometer, m/s2/sqrt(Hz)
    gyro_bias: float  #: at power-on, rad/s
    bias: float  #: of the accelerometer, m/s2
    scale: float  #: of both, relative; misalignments likewise, rad
    g_sensitivity: float  #: rad/s per m/s2


#: By their data sheets: noise density, initial bias at 25 degrees, sensitivity tolerance and cross-axis sensitivity.
INERTIAL_CLASSES = {
    "icm-42688": InertialClass(np.deg2rad(0.0028), 70e-6 * 9.81, np.deg2rad(0.5), 0.02 * 9.81, 0.01, 2e-4),
    "mpu-6050": InertialClass(np.deg2rad(0.005), 400e-6 * 9.81, np.deg2rad(20.0), 0.06 * 9.81, 0.03, 2e-4),
    "phone": InertialClass(np.deg2rad(0.007), 180e-6 * 9.81, np.deg2rad(3.0), 0.04 * 9.81, 0.02, 2e-4),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Inertial(Reference):
    """Gyro and accelerometer on the tool; see the module for the model."""

    inertial: ClassVar[bool] = True
    T_tool_sensor: Array  #: (4, 4) its mounting
    #: (35,) lever (again, m), biases (3 rad/s, 3 m/s2), M_a (6), M_g (9), G (9, rad/s per m/s2), tilt (2, rad)
    values: Array

    @staticmethod
    def of(name: str, kind: str = "mpu-6050", T_tool_sensor: Array | None = None) -> Inertial:
        """Return one of a class, nothing of it calibrated.

        Args:
            name: what people call it.
            kind: of :data:`INERTIAL_CLASSES`.
            T_tool_sensor: (4, 4) its mounting, roughly; None: unknown, the identity.

        Raises:
            InputError: no such class.
        """
        if kind not in INERTIAL_CLASSES:
            raise InputError(f"{name}: no class of inertial units {kind!r}; there are {', '.join(INERTIAL_CLASSES)}")
        c = INERTIAL_CLASSES[kind]
        sigmas = [np.pi, 0.3, c.gyro_bias, c.bias, c.scale, c.scale, c.g_sensitivity, np.deg2rad(5.0)]
        rows = (_ROTATION, _LEVER, _GYRO_BIAS, _BIAS, _M_A, _M_G, _G, _TILT)
        each = np.concatenate([np.full(r.stop - r.start, s) for r, s in zip(rows, sigmas, strict=True)])
        T = np.eye(4) if T_tool_sensor is None else T_tool_sensor
        values = np.concatenate([T[:3, 3], np.zeros(_PARAMETERS - _LEVER.stop)])
        return Inertial(name=name, cov=np.diag(each**2), sigma_delay_s=0.02, T_tool_sensor=T, values=values)

    @property
    def channels(self) -> tuple[str, ...]:
        """Gyro and accelerometer."""
        return ("gyro", "accelerometer")

    @property
    def parameters(self) -> dict[str, float]:
        """Names and values; of the mounting's rotation its vector."""
        axes = [f"{a}{b}" for a in "xyz" for b in "xyz"]
        names = chain(
            (f"rotation_{a}_rad" for a in "xyz"),
            (f"lever_{a}_m" for a in "xyz"),
            (f"gyro_bias_{a}_rad_s" for a in "xyz"),
            (f"accelerometer_bias_{a}_m_s2" for a in "xyz"),
            (f"accelerometer_scale_{axes[3 * i + j]}" for i, j in zip(*_UPPER, strict=True)),
            (f"gyro_scale_{a}" for a in axes),
            (f"g_sensitivity_{a}_s_m" for a in axes),
            ("base_tilt_x_rad", "base_tilt_y_rad"),
        )
        values = [*log_so3(self.T_tool_sensor[None, :3, :3])[0], *self.values]
        return dict(zip(names, map(float, values), strict=True))

    def _part(self, rows: slice) -> Array:
        return self.values[rows.start - _LEVER.start : rows.stop - _LEVER.start]

    def _matrices(self) -> tuple[Array, Array]:
        """Return I + M_g and I + M_a (3, 3)."""
        gyro, force = np.eye(3) + self._part(_M_G).reshape(3, 3), np.eye(3)
        force[_UPPER] += self._part(_M_A)
        return gyro, force

    def felt(self, z: Array) -> Array:
        """Return angular velocities, rad/s, and specific forces, m/s2, (N, 6) in the sensor's axes, of readings (N, 6)."""
        gyro, force = self._matrices()
        f = (z[:, 3:] - self._part(_BIAS)) @ np.linalg.inv(force).T
        w = z[:, :3] - self._part(_GYRO_BIAS) - f @ self._part(_G).reshape(3, 3).T
        return np.hstack([w @ np.linalg.inv(gyro).T, f])

    def expected(self, motion: ToolMotion, channel: int) -> ExpectedReading:
        """Return angular velocity (3,), rad/s, or specific force (3,), m/s2, as the sensor reads it."""
        R, r = self.T_tool_sensor[:3, :3].T, self.T_tool_sensor[:3, 3]
        R_tool_base = motion.T_base_tool[:3, :3].T
        (v, w), (dv, dw) = motion.twist.reshape(2, 3), motion.acceleration.reshape(2, 3)
        W, tilt = skew(w), np.append(self._part(_TILT), 0.0)
        up = exp_so3(tilt)[:, 2]
        up_tool, wr = R_tool_base @ up, W @ r
        f = R @ (dv + W @ v + skew(dw) @ r + W @ wr + STANDARD_GRAVITY_M_S2 * up_tool)
        # Derivatives of f by the tool's rotation, twist, acceleration, and by the parameters.
        by_tool, by_twist, by_acceleration = np.zeros((3, 6)), np.empty((3, 6)), np.empty((3, 6))
        by_tool[:, 3:] = STANDARD_GRAVITY_M_S2 * R @ skew(up_tool)
        by_twist[:, :3], by_twist[:, 3:] = R @ W, -R @ (skew(v) + skew(wr) + W @ skew(r))
        by_acceleration[:, :3], by_acceleration[:, 3:] = R, -R @ skew(r)
        by = np.zeros((3, _PARAMETERS))
        by[:, _ROTATION], by[:, _LEVER] = skew(f), R @ (skew(dw) + W @ W)
        by[:, _TILT] = (-STANDARD_GRAVITY_M_S2 * R @ R_tool_base @ skew(up) @ left_jacobian(tilt))[:, :2]
        M = self._matrices()[channel]
        if channel == ACCELEROMETER:
            by = M @ by
            by[_UPPER[0], np.arange(_M_A.start, _M_A.stop)] = f[_UPPER[1]]
            by[:, _BIAS] = np.eye(3)
            return ExpectedReading(M @ f + self._part(_BIAS), M @ by_tool, by, M @ by_twist, M @ by_acceleration)
        G, rates = self._part(_G).reshape(3, 3), R @ w
        by = G @ by
        by[:, _ROTATION] += M @ skew(rates)
        by[:, _M_G], by[:, _G] = np.kron(np.eye(3), rates), np.kron(np.eye(3), f)
        by[:, _GYRO_BIAS], by_rate = np.eye(3), G @ by_twist
        by_rate[:, 3:] += M @ R
        return ExpectedReading(
            M @ rates + G @ f + self._part(_GYRO_BIAS), G @ by_tool, by, by_rate, G @ by_acceleration
        )

    def moved(self, step: Array) -> Inertial:
        """Return it with a mounting rotated on the right by ``step[:3]``, the other parameters added."""
        values = self.values + step[_LEVER.start :]
        T = self.T_tool_sensor @ exp_se3(np.append(np.zeros(3), step[_ROTATION]))
        T[:3, 3] = values[:3]
        return replace(self, T_tool_sensor=T, values=values)

    def begun(self, readings: Sequence[Reading], motion: Callable[[float], ToolMotion]) -> Inertial:
        """Return it with a mounting near the truth, in closed form, for :func:`calibrate`.

        The accelerometer's readings are fitted by any matrix and an offset to the specific forces, and so are the gyro's to
        the angular velocities; the rotation of the matrix is the mounting's.

        Raises:
            InputError: other units, mirrored axes, or too few attitudes.
        """
        plain = replace(self, T_tool_sensor=pose(np.eye(3), np.zeros(3)), values=np.zeros_like(self.values))
        found = []
        for channel, name in enumerate(self.channels):
            mine = [reading for reading in readings if reading.channel == channel]
            at = [plain.expected(motion(each.t_s - self.delay_s), channel).z for each in mine]
            if len(mine) < 4:
                continue
            x, z = np.array(at), np.array([each.z for each in mine])
            A, spread = _matrix(x, z)
            if spread[-1] < _SPANS * spread[0]:
                continue
            found.append((A, np.linalg.norm(spread)))
            self._reject(A, name, channel)
        if not found:
            raise InputError(
                f"{self.name}: the tool was not rotated enough to see how the sensor is mounted: give it attitudes about "
                "two axes that differ by 60 degrees and more"
            )
        R = nearest_rotation(found[-1][0])
        return replace(self, T_tool_sensor=pose(R.T, self.T_tool_sensor[:3, 3]))

    def _reject(self, A: Array, name: str, channel: int) -> None:
        """Raise an InputError where a matrix from what was expected to what was read is that of other units or axes."""
        size, (unit, others) = float(abs(np.linalg.det(A)) ** (1 / 3)), _MISREAD[channel]
        for other, factor in others.items():
            if abs(size / factor - 1) < _NEAR:
                raise InputError(
                    f"{self.name}: the {name} reads {size:.3g} times {unit}, as if in {other}; give {unit}"
                )
        if not 1 - 2 * _NEAR < size < 1 + 2 * _NEAR:
            raise InputError(
                f"{self.name}: the {name} reads {size:.3g} times what the motion gives; check its unit, {unit}"
            )
        if np.linalg.det(A) < 0.0:
            raise InputError(f"{self.name}: the {name}'s axes are mirrored (left-handed): swap two or negate one")


def _matrix(x: Array, z: Array) -> tuple[Array, Array]:
    """Return the matrix A (3, 3) of z = A x + b by least squares, and the singular values of x's spread."""
    X, Z = x - x.mean(axis=0), z - z.mean(axis=0)
    A, *_ = np.linalg.lstsq(X, Z, rcond=None)
    return A.T, np.linalg.svd(X, compute_uv=False)
