"""Everything that can be off about an arm, as one vector of named parameters, and what it predicts.

Order of the vector: where the base is in the rig (shift along the rig's axes; turn about them, from a start), where the
tool's points or the body are on frame 6, the table's numbers, and the coefficients of the causes in ``features``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import exp_se3, inverse
from armsight.geometry.rotation import exp_so3, log_so3, skew
from armsight.loop.identify import chain
from armsight.loop.identify.features import ENOUGH, FAST, PLENTY, RIPPLES, Feature, all_features, values
from armsight.loop.identify.measured import Measured
from armsight.robot.arm import Arm

BASE = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")
_LENGTHS = (chain.D, chain.A)


@dataclass(frozen=True)
class Parameter:
    """One number that can be off.

    Attributes:
        name: such as "a2", "offset3", "gain1", "tool1_x".
        kind: "base", "tool", a column of the table, or a feature's kind.
        unit: "m", "rad", "rad/rad" (of a scale) or "rad/m".
        joint: 0 to 5; -1 for base and tool.
    """

    name: str
    kind: str
    unit: str
    joint: int


@dataclass(frozen=True, eq=False)
class Model(Record):
    """An arm with everything that can be off about it.

    Attributes:
        arm: the nominal arm; its T_base_0 holds, its tool is not used.
        points: how many points are tracked; 1 with full poses.
        full: whether full poses are measured.
        features: the causes beyond the table.
        R_start: (3, 3) turn of the base in the rig that the base's turn counts from.
        R_tool: (3, 3) turn of the body on frame 6 that the tool's turn counts from, with full poses.
        up_base: (3,) unit vector against gravity, base.
    """

    arm: Arm
    points: int
    full: bool
    features: tuple[Feature, ...]
    R_start: Array = field(default_factory=lambda: np.eye(3))
    R_tool: Array = field(default_factory=lambda: np.eye(3))
    up_base: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @staticmethod
    def of(arm: Arm, measured: Measured, *, backlash: bool) -> Model:
        """Return the model that fits what was measured."""
        numbers = len(measured) * measured.size
        fast = all_features(backlash, (*RIPPLES, *FAST) if numbers >= ENOUGH else ())
        model = Model(arm, measured.points, measured.R_rig_body is not None, fast)
        if numbers < PLENTY * len(model.parameters):
            return model
        return model.with_features(all_features(backlash, RIPPLES))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every parameter, in the order of the vector."""
        found = [Parameter(name, "base", "rad" if "r" in name else "m", -1) for name in BASE]
        for k in range(self.points):
            found += [Parameter(f"tool{k + 1}_{axis}", "tool", "m", -1) for axis in "xyz"]
        if self.full:
            found += [Parameter(f"tool1_r{axis}", "tool", "rad", -1) for axis in "xyz"]
        for i in range(6):
            for c, column in enumerate(chain.COLUMNS):
                found.append(Parameter(f"{column}{i + 1}", column, "m" if c in _LENGTHS else "rad", i))
        found += [Parameter(f.name, f.kind, f.unit, f.joint) for f in self.features]
        return tuple(found)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Every parameter's name."""
        return tuple(p.name for p in self.parameters)

    @property
    def tool_at(self) -> int:
        """Where the tool's parameters begin."""
        return len(BASE)

    @property
    def table_at(self) -> int:
        """Where the table's numbers begin."""
        return len(BASE) + 3 * self.points + 3 * self.full

    @property
    def causes_at(self) -> int:
        """Where the features' coefficients begin."""
        return self.table_at + 30

    def nominal(self) -> Array:
        """Return the vector of the nominal arm, its base at the rig and its tool at frame 6."""
        x = np.zeros(len(self.parameters))
        x[self.table_at : self.causes_at] = chain.nominal_table(self.arm).ravel()
        return x

    def table(self, x: Array) -> Array:
        """Return the table (6, 5) of a vector, by ``chain.COLUMNS``."""
        return x[self.table_at : self.causes_at].reshape(6, 5)

    def T_rig_base(self, x: Array) -> Array:
        """Return the base (4, 4) in the rig."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = exp_so3(x[3:6].copy()) @ self.R_start, x[:3]
        return T

    def tool_points(self, x: Array) -> Array:
        """Return the tracked points (K, 3) in frame 6."""
        return x[self.tool_at : self.tool_at + 3 * self.points].reshape(-1, 3)

    def T_6_body(self, x: Array) -> Array:
        """Return the body (4, 4) in frame 6; its turn is that of frame 6 where only points are measured."""
        T = np.eye(4)
        T[:3, 3] = self.tool_points(x)[0]
        if self.full:
            T[:3, :3] = self.R_tool @ exp_so3(x[self.table_at - 3 : self.table_at].copy())
        return T

    def with_features(self, features: tuple[Feature, ...]) -> Model:
        """Return the model with other causes."""
        return replace(self, features=features)

    def feature_values(self, q: Array, approach: Array | None) -> Array:
        """Return what one unit of every cause adds to its joint's angle, (N, F), rad."""
        return values(self.arm, self.features, q, approach, self.up_base)

    def theta(self, x: Array, q: Array, phi: Array) -> Array:
        """Return what the joints turn beside their offsets (N, 6), rad; ``phi`` of :meth:`feature_values`."""
        out = self.arm.direction * q
        for k, f in enumerate(self.features):
            if x[self.causes_at + k] != 0.0:
                out[:, f.joint] += self.arm.direction[f.joint] * x[self.causes_at + k] * phi[:, k]
        return np.asarray(out)

    def motion(self, x: Array, q: Array, phi: Array) -> chain.Motion:
        """Return frame 6 in the rig, and how it moves."""
        T = self.T_rig_base(x) @ self.arm.T_base_0
        modified = self.arm.convention == "modified"
        return chain.motion(self.table(x), self.theta(x, q, phi), modified, T[:3, :3], T[:3, 3])

    def residuals(self, x: Array, measured: Measured, phi: Array) -> Array:
        """Return predicted minus measured, (N, M); see :class:`Measured` for its axes."""
        return self._residuals(self.motion(x, measured.q, phi), x, measured)

    def _residuals(self, m: chain.Motion, x: Array, measured: Measured) -> Array:
        t = self.tool_points(x)
        off = m.o[:, None] + (m.R @ t.T).swapaxes(1, 2) - measured.p_rig
        if measured.R_rig_body is None:
            return np.asarray(off.reshape(len(off), -1))
        back = measured.R_rig_body.swapaxes(1, 2)
        turn = log_so3(back @ m.R @ self.T_6_body(x)[:3, :3])
        return np.concatenate([(back @ off.swapaxes(1, 2))[..., 0], turn], axis=1)

    def linearised(self, x: Array, measured: Measured, phi: Array) -> tuple[Array, Array]:
        """Return predicted minus measured (N, M), and its derivative (N, M, P) by the vector."""
        m = self.motion(x, measured.q, phi)
        e = self._residuals(m, x, measured)
        t, n, at = self.tool_points(x), len(measured), self.table_at
        J = np.zeros((n, measured.size, len(self.parameters)))
        ways, by_theta = self._ways(phi), self.arm.direction[[f.joint for f in self.features]].astype(int)
        for k in range(self.points):
            rows, p = slice(3 * k, 3 * k + 3), m.o + m.R @ t[k]
            J[:, rows, 0:3] = np.eye(3)
            J[:, rows, 3:6] = -skew(p - x[:3]) @ _left_jacobian(x[3:6])
            J[:, rows, self.tool_at + 3 * k : self.tool_at + 3 * k + 3] = m.R
            table = chain.point_derivative(m, p)
            J[:, rows, at : self.causes_at] = table.reshape(30, n, 3).transpose(1, 2, 0)
            if self.features:
                moved = table[ways, chain.OFFSET] * (by_theta[:, None] * phi.T)[..., None]
                J[:, rows, self.causes_at :] = moved.transpose(1, 2, 0)
        if measured.R_rig_body is not None:
            self._turn_rows(m, x, measured, phi, e, J)
        return e, J

    def _turn_rows(self, m: chain.Motion, x: Array, measured: Measured, phi: Array, e: Array, J: Array) -> None:
        """Fill in the derivative of full poses: the body's axes, and the turn."""
        assert measured.R_rig_body is not None  # for the type checker: the caller has looked
        n, at, ways = len(measured), self.table_at, self._ways(phi)
        J[:, :3] = measured.R_rig_body.swapaxes(1, 2) @ J[:, :3]
        R_hat = m.R @ self.T_6_body(x)[:3, :3]
        to_log = (np.eye(3) + 0.5 * skew(e[:, 3:]) + _second(e[:, 3:])) @ R_hat.swapaxes(1, 2)
        turn = chain.turn_derivative(m)
        W = np.zeros((n, 3, J.shape[2]))
        W[:, :, 3:6] = _left_jacobian(x[3:6])
        W[:, :, at : self.causes_at] = turn.reshape(30, n, 3).transpose(1, 2, 0)
        if self.features:
            way = self.arm.direction[[f.joint for f in self.features]]
            W[:, :, self.causes_at :] = (turn[ways, chain.OFFSET] * (way[:, None] * phi.T)[..., None]).transpose(
                1, 2, 0
            )
        J[:, 3:] = to_log @ W
        J[:, 3:, at - 3 : at] = (to_log @ R_hat) @ _left_jacobian(-x[at - 3 : at])

    def _ways(self, phi: Array) -> list[int]:
        return [f.joint for f in self.features]

    def tool_in_base(self, x: Array, q: Array, approach: Array | None) -> Array:
        """Return T_base_body (N, 4, 4) at joint angles (N, 6) read by the sensors."""
        m = self.motion(x, q, self.feature_values(q, approach))
        T = np.zeros((len(q), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = m.R, m.o, 1.0
        return np.asarray(inverse(self.T_rig_base(x)) @ T @ self.T_6_body(x))


def _left_jacobian(v: Array) -> Array:
    """Return the left Jacobian (3, 3) of exp at a rotation vector: exp(v + dv) = exp(J dv) exp(v)."""
    columns = [exp_se3(np.concatenate([e, v]))[:3, 3] for e in np.eye(3)]  # the V of SE(3) is this very matrix
    return np.stack(columns, axis=1)


def _second(e: Array) -> Array:
    """Return the second-order term of the right Jacobian's inverse at rotation vectors (N, 3)."""
    S = skew(e)
    return np.asarray(S @ S / 12)
