"""The model that identification fits: an arm with everything that can be off about it, as one vector of parameters.

The vector x (P,) holds, in this order: the base in the rig (translation along the rig's axes; rotation about them, from a
start), the tool's points or the body in the last frame, the 30 numbers of the table, and one coefficient per error source
beyond the table.

A row of the table is Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta), modified Rx(alpha) Tx(a) Ry(beta) Rz(theta) Tz(d). Beta is
Hayati's angle ("Robot arm geometric link parameter estimation", CDC 1983): between neighbouring axes that are parallel, d
has no effect and only beta can tilt the second axis about the common normal's perpendicular. The derivative of a point p by
an elementary rotation about axis u through o is u x (p - o), by a translation along u it is u.

The error sources say by how much a joint's true angle differs from its sensor's reading, linear in the coefficients:

- gain: scale of the sensor.
- wave, ripple: linearity error of the sensor, sine and cosine of its angle and of multiples of it. With gain they are the
  sensor's curve, which holds over the range of readings that was measured. Beyond it the curve fades within FADE_RAD to its
  mean over that range, which is a part of the joint's zero: what is fitted in one range says nothing of another.
- backlash: half of it to either side, by the direction of approach: friction holds the joint on the side it came from.
- gravity_backlash: backlash that the gravity load of the links beyond the joint closes, whichever way the joint came,
  except where the lever is so small that friction is stronger.
- compliance: the gear yields under the gravity torque of the links. The torque about joint i is the sum over links j >=
  i of (mass and lever, unknown) times z_i . (L_j x g), where L_j is the vector of link j.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import inverse, left_jacobian
from armsight.geometry.rotation import exp_so3, log_so3, skew
from armsight.loop.identify.measured import Measured
from armsight.robot.kinematics.arm import Arm

COLUMNS = ("offset", "d", "a", "alpha", "beta")  # columns of a table of lengths and angles, (n, 5)
OFFSET, D, A, ALPHA, BETA = range(5)
_STANDARD = (OFFSET, D, A, ALPHA, BETA)
_MODIFIED = (ALPHA, A, BETA, OFFSET, D)
_AXIS = {OFFSET: 2, D: 2, A: 0, ALPHA: 0, BETA: 1}  # column -> the axis it rotates about or translates along
_SHIFTS = (D, A)


class TableMotion(NamedTuple):
    """Pose of an arm's last frame, and the axes along or about which each number of the table moves it."""

    R: Array  #: (N, 3, 3) rotation of the last frame in the rig
    o: Array  #: (N, 3) origin of the last frame in the rig, m
    axis: Array  #: (n, 5, N, 3) unit axes that each number rotates about or translates along, rig
    through: Array  #: (n, 5, N, 3) points on those axes, rig, m


def nominal_table(arm: Arm) -> Array:
    """Return the table (n, 5) of an arm, by COLUMNS."""
    return np.stack([arm.offset, arm.d, arm.a, arm.alpha, np.zeros(arm.joints)], axis=1)


def motion(table: Array, theta: Array, modified: bool, R_rig_0: Array, o_rig_0: Array) -> TableMotion:
    """Move frame 0, R_rig_0 (3, 3) and o_rig_0 (3,), along the chain, and note the axis of every number of the table.

    ``table``: (n, 5) by COLUMNS, m and rad. ``theta``: (N, n) rotation of each joint without its offset, rad.
    ``modified``: whether the table follows the modified convention. ``R_rig_0``: rotation of frame 0. ``o_rig_0``: its
    origin, m.
    """
    n = len(theta)
    R, o = np.broadcast_to(R_rig_0, (n, 3, 3)).copy(), np.broadcast_to(o_rig_0, (n, 3)).copy()
    joints = len(table)
    axis, through = np.empty((joints, 5, n, 3)), np.empty((joints, 5, n, 3))
    for i in range(joints):
        for column in _MODIFIED if modified else _STANDARD:
            k = _AXIS[column]
            axis[i, column], through[i, column] = R[:, :, k], o
            value = table[i, column]
            if column in _SHIFTS:
                o += value * R[:, :, k]
            elif column == OFFSET:
                _rotate(R, k, value + theta[:, i])
            elif value != 0.0:
                _rotate(R, k, np.full(n, value))
    return TableMotion(R, o, axis, through)


def _rotate(R: Array, k: int, angle: Array) -> None:
    """Overwrite frames (N, 3, 3), rotated about their own axis ``k`` by angles (N,), rad."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    u, v = R[:, :, (k + 1) % 3].copy(), R[:, :, (k + 2) % 3].copy()
    R[:, :, (k + 1) % 3] = c * u + s * v
    R[:, :, (k + 2) % 3] = c * v - s * u


#: Harmonics of one revolution of a sensor: by its mounting, by its track and gears, and the fastest (pots: up to nine).
WAVES, RIPPLES, FAST = (1, 2), (3, 4, 5, 6, 7, 8), (9, 10, 11, 12)
#: With fewer measured numbers than this the model has no ripples: chance alone would determine their one prior.
ENOUGH = 100
#: With so many numbers per parameter each harmonic and load is selected by itself; the fastest, without a bound, are
#: left out.
PLENTY = 10
#: A bearing's friction holds a link inside its backlash up to about this lever, m; over half of it the backlash closes.
FRICTION_M = 2e-3
UP = np.array([0.0, 0.0, 1.0])  # against gravity, of an arm that stands upright
SENSOR = ("gain", "wave", "ripple")  # kinds that make up the curve of a joint's sensor: functions of its reading
#: Beyond the readings seen, a sensor's curve fades over so much, rad. Double: a fast harmonic swings there; half: what
#: holds a few degrees on is lost.
FADE_RAD = np.deg2rad(20.0)


class Feature(NamedTuple):
    """An error source that moves one joint."""

    name: str  #: of the coefficient
    kind: str  #: "gain", "wave", "ripple", "backlash", "gravity_backlash" or "compliance"
    joint: int  #: from 0
    unit: str  #: of the coefficient
    #: the harmonic with its phase (n, 0 sine or 1 cosine), or the link whose gravity loads the gear; (0, 0) elsewhere
    detail: tuple[int, int] = (0, 0)


def all_features(joints: int, backlash: bool, ripples: tuple[int, ...]) -> tuple[Feature, ...]:
    """Return every error source.

    ``backlash``: include backlash that friction holds, which needs known directions of approach. ``ripples``: harmonics
    beyond WAVES.
    """
    found = []
    for i in range(joints):
        found.append(Feature(f"gain{i + 1}", "gain", i, "rad/rad"))
        for n in (*WAVES, *ripples):
            kind = "wave" if n in WAVES else "ripple"
            found += [Feature(f"{kind}{i + 1}_{w}{n}", kind, i, "rad", (n, k)) for k, w in enumerate(("sin", "cos"))]
        if backlash:
            found.append(Feature(f"backlash{i + 1}", "backlash", i, "rad"))
        found.append(Feature(f"gravity_backlash{i + 1}", "gravity_backlash", i, "rad"))
        found += [Feature(f"compliance{i + 1}_{j + 1}", "compliance", i, "rad/m", (j, 0)) for j in range(i, joints)]
    return tuple(found)


def values(
    arm: Arm,
    features: tuple[Feature, ...],
    q: Array,
    approach: Array | None,
    up_base: Array,
    q_seen: Array | None = None,
    fade_rad: float = FADE_RAD,
) -> Array:
    """Return what one unit of every coefficient adds to its joint's angle, (N, F), rad per unit; see :class:`Model`."""
    out = np.zeros((len(q), len(features)))
    by_gravity = any(f.kind in ("compliance", "gravity_backlash") for f in features)
    levers = _levers(arm, q, up_base) if by_gravity else np.zeros((len(q), arm.joints, arm.joints))
    for k, f in enumerate(features):
        if f.kind in SENSOR:
            out[:, k] = _curve(f, q[:, f.joint], None if q_seen is None else q_seen[f.joint], fade_rad)
        elif f.kind == "backlash" and approach is not None:
            out[:, k] = -0.5 * approach[:, f.joint]
        elif f.kind == "gravity_backlash":
            out[:, k] = 0.5 * _side(_gravity_lever(arm, levers, f.joint), approach, f.joint)
        elif f.kind == "compliance":
            out[:, k] = levers[:, f.joint, f.detail[0]]
    return out


def _curve(f: Feature, angle: Array, seen: Array | None, fade_rad: float) -> Array:
    """Return what one unit of a part of a sensor's curve adds at readings (N,), rad; see :func:`values` for ``seen``."""
    n, phase = f.detail
    out = angle if f.kind == "gain" else np.cos(n * angle) if phase else np.sin(n * angle)
    if seen is None:
        return np.asarray(out)
    low, high = float(seen[0]), float(seen[1])
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    if f.kind == "gain":
        mean = middle
    else:  # the mean of a wave over a range is its value in the middle, times sin(n half) / (n half)
        mean = float(np.sinc(n * half / np.pi) * (np.cos(n * middle) if phase else np.sin(n * middle)))
    return np.asarray(mean + fade(angle, low, high, fade_rad) * (out - mean))


def fade(angle: Array, low: float, high: float, width: float = FADE_RAD) -> Array:
    """Return 1 for readings from ``low`` to ``high``, falling to 0 over ``width`` on either side, its slope continuous."""
    beyond = np.clip(np.maximum(low - angle, angle - high) / width, 0.0, 1.0)
    return np.asarray(1 - beyond**2 * (3 - 2 * beyond))


def _gravity_lever(arm: Arm, levers: Array, joint: int) -> Array:
    """Return the lever (N,), m, of the gravity load beyond a joint, for links that are rods of one mass per metre."""
    mass = np.hypot(arm.a, arm.d)[joint:] + 1e-9
    beyond = np.cumsum(mass[::-1])[::-1] - 0.5 * mass  # carried by a link's vector: half of its own, and all after it
    return np.asarray(levers[:, joint, joint:] @ beyond / mass.sum())


def gravity_levers(arm: Arm, q: Array) -> Array:
    """Return the levers (N, n), m, of the gravity load beyond each joint at joint angles (N, n), rad.

    For links that are rods of one mass per metre, of an arm that stands upright; positive where the load pulls to larger
    angles.
    """
    levers = _levers(arm, q, UP)
    return np.stack([_gravity_lever(arm, levers, joint) for joint in range(arm.joints)], axis=1)


def _side(lever: Array, approach: Array | None, joint: int) -> Array:
    """Return on which side of its backlash a link lies (N,), -1 to 1: by gravity, or by friction where that is stronger.

    Where the two are about as strong it is the mean of both sides, weighted by how likely each is.
    """
    if np.abs(lever).max(initial=0.0) < FRICTION_M:
        return np.zeros(len(lever))  # gravity does not load it: its backlash is of kind ``backlash``
    side = np.zeros(len(lever)) if approach is None else approach[:, joint]
    return np.asarray(np.tanh((lever - FRICTION_M * side) / (FRICTION_M * (1 - 0.5 * np.abs(side)))))


def _levers(arm: Arm, q: Array, up_base: Array) -> Array:
    """Return z_i . (L_j x g) (N, n, n) for unit gravity g: lever of link j about joint i, m, signed by its direction."""
    T = arm.T_base_0
    modified = arm.convention == "modified"
    m = motion(nominal_table(arm), arm.direction * (q @ arm.coupling.T), modified, T[:3, :3], T[:3, 3])
    z, at = m.axis[:, OFFSET], np.concatenate([m.through[:, OFFSET], m.o[None]])
    pull = np.cross(at[1:] - at[:-1], -up_base)  # link j goes from axis j to axis j + 1
    return np.asarray(np.einsum("i,inx,jnx->nij", arm.direction, z, pull))


#: Unit of a parameter -> its factor to what people read, and that.
SHOWN_IN = {"m": (1e3, "mm"), "rad": (180 / np.pi, "deg"), "rad/m": (180 / np.pi, "deg/m"), "rad/rad": (100.0, "%")}
BASE = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")


@dataclass(frozen=True)
class Parameter:
    """One number that can be off."""

    name: str  #: such as "a2", "offset3", "gain1", "tool1_x"
    kind: str  #: "base", "tool", a column of the table, or a feature's kind
    unit: str  #: "m", "rad", "rad/rad" (of a scale) or "rad/m"
    joint: int  #: from 0; -1 for base and tool


@dataclass(frozen=True, eq=False)
class Model(Record):
    """An arm with everything that can be off about it."""

    arm: Arm  #: the nominal arm; its T_base_0 holds, its tool is not used
    points: int  #: how many points are tracked; 1 with full poses
    full: bool  #: whether full poses are measured
    features: tuple[Feature, ...]  #: the error sources beyond the table
    #: (3, 3) rotation of the base in the rig that the base's rotation parameters start from
    R_start: Array = field(default_factory=lambda: np.eye(3))
    #: (3, 3) rotation of the body in the last frame that the tool's start from, with full poses
    R_tool: Array = field(default_factory=lambda: np.eye(3))
    up_base: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  #: (3,) unit vector against gravity, base
    #: (n, 2) least and greatest reading of each joint in the poses fitted, rad, beyond which curves fade; None if
    #: unknown
    q_seen: Array | None = None
    fade_rad: float = FADE_RAD  #: how far beyond them the curves have faded, rad

    @staticmethod
    def of(arm: Arm, measured: Measured, *, backlash: bool) -> Model:
        """Return the model that fits what was measured."""
        numbers = len(measured) * measured.size
        fast = all_features(arm.joints, backlash, (*RIPPLES, *FAST) if numbers >= ENOUGH else ())
        model = Model(arm, measured.points, measured.R_rig_body is not None, fast)
        if numbers < PLENTY * len(model.parameters):
            return model
        return model.with_features(all_features(arm.joints, backlash, RIPPLES))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every parameter, in the order of the vector."""
        found = [Parameter(name, "base", "rad" if "r" in name else "m", -1) for name in BASE]
        for k in range(self.points):
            found += [Parameter(f"tool{k + 1}_{axis}", "tool", "m", -1) for axis in "xyz"]
        if self.full:
            found += [Parameter(f"tool1_r{axis}", "tool", "rad", -1) for axis in "xyz"]
        for i in range(self.arm.joints):
            for c, column in enumerate(COLUMNS):
                found.append(Parameter(f"{column}{i + 1}", column, "m" if c in _SHIFTS else "rad", i))
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
    def sources_at(self) -> int:
        """Where the features' coefficients begin."""
        return self.table_at + len(COLUMNS) * self.arm.joints

    def nominal(self) -> Array:
        """Return the vector of the nominal arm, its base at the rig and its tool at the last frame."""
        x = np.zeros(len(self.parameters))
        x[self.table_at : self.sources_at] = nominal_table(self.arm).ravel()
        return x

    def table(self, x: Array) -> Array:
        """Return the table (n, 5) of a vector, by ``COLUMNS``."""
        return x[self.table_at : self.sources_at].reshape(-1, len(COLUMNS))

    def T_rig_base(self, x: Array) -> Array:
        """Return the base (4, 4) in the rig."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = exp_so3(x[3:6].copy()) @ self.R_start, x[:3]
        return T

    def tool_points(self, x: Array) -> Array:
        """Return the tracked points (K, 3) in the last frame."""
        return x[self.tool_at : self.tool_at + 3 * self.points].reshape(-1, 3)

    def T_6_body(self, x: Array) -> Array:
        """Return the body (4, 4) in the last frame; its rotation is that frame's where only points are measured."""
        T = np.eye(4)
        T[:3, 3] = self.tool_points(x)[0]
        if self.full:
            T[:3, :3] = self.R_tool @ exp_so3(x[self.table_at - 3 : self.table_at].copy())
        return T

    def rotations(self, x: Array) -> list[tuple[int, Array, float]]:
        """Return where the small rotations of base and body begin, their vectors (3,), and the side, 1 before, -1 after."""
        found = [(3, log_so3(self.T_rig_base(x)[:3, :3]), 1.0)]
        return [*found, (self.table_at - 3, log_so3(self.T_6_body(x)[:3, :3]), -1.0)] if self.full else found

    def with_seen(self, q: Array) -> Model:
        """Return the model whose sensors' curves fade beyond the readings (N, n), rad, of the poses fitted."""
        return replace(self, q_seen=np.stack([q.min(axis=0), q.max(axis=0)], axis=1))

    def with_features(self, features: tuple[Feature, ...]) -> Model:
        """Return the model with other error sources."""
        return replace(self, features=features)

    def feature_values(self, q: Array, approach: Array | None) -> Array:
        """Return what one unit of every error source adds to its joint's angle, (N, F), rad per unit."""
        return values(self.arm, self.features, q, approach, self.up_base, self.q_seen, self.fade_rad)

    def beyond(self, q: Array, prior: Array) -> Array:
        """Return the variance (N, n), rad^2, of sensors' curves beyond the readings fitted, of prior sigmas (P,)."""
        fades = replace(self, q_seen=None).feature_values(q, None) - self.feature_values(q, None)
        squares = (fades * prior[self.sources_at :]) ** 2
        joint = np.array([f.joint for f in self.features], dtype=np.int64)
        return np.stack([squares[:, joint == i].sum(axis=1) for i in range(self.arm.joints)], axis=1)

    def theta(self, x: Array, q: Array, phi: Array) -> Array:
        """Return the joints' rotations without their offsets (N, n), rad; ``phi`` is :meth:`feature_values`."""
        of = np.equal.outer([f.joint for f in self.features], np.arange(self.arm.joints))
        off = (phi * x[self.sources_at :]) @ of.astype(np.float64)
        return np.asarray(self.arm.direction * ((q + off) @ self.arm.coupling.T))

    def _by_source(self, axes: Array, phi: Array) -> Array:
        """Return what the coefficients move (N, 3, F), from what rotations of the joints move, (n, N, 3)."""
        by_motor = np.einsum("ij,i,inx->jnx", self.arm.coupling, self.arm.direction, axes)
        return np.asarray((by_motor[[f.joint for f in self.features]] * phi.T[..., None]).transpose(1, 2, 0))

    def motion(self, x: Array, q: Array, phi: Array) -> TableMotion:
        """Return the last frame in the rig, and how it moves."""
        T = self.T_rig_base(x) @ self.arm.T_base_0
        modified = self.arm.convention == "modified"
        return motion(self.table(x), self.theta(x, q, phi), modified, T[:3, :3], T[:3, 3])

    def _phi(self, measured: Measured, phi: Array | None) -> Array:
        return self.feature_values(measured.q, measured.approach) if phi is None else phi

    def residuals(self, x: Array, measured: Measured, phi: Array | None = None, m: TableMotion | None = None) -> Array:
        """Return predicted minus measured, (N, M); see :class:`Measured` for its axes.

        ``phi``: :meth:`feature_values`, and ``m``: the motion, where they are known already.
        """
        m, t = self.motion(x, measured.q, self._phi(measured, phi)) if m is None else m, self.tool_points(x)
        p = m.o[:, None] + (m.R @ t.T).swapaxes(1, 2)
        if measured.length_m is not None:
            return np.asarray(np.linalg.norm(p[:, 0], axis=1) - measured.length_m)[:, None]
        off = p - measured.p_rig
        if measured.R_rig_body is None:
            return np.asarray(off.reshape(len(off), -1))
        back = measured.R_rig_body.swapaxes(1, 2)
        angle = log_so3(back @ m.R @ self.T_6_body(x)[:3, :3])
        return np.concatenate([(back @ off.swapaxes(1, 2))[..., 0], angle], axis=1)

    def linearised(self, x: Array, measured: Measured, phi: Array | None = None) -> tuple[Array, Array]:
        """Return predicted minus measured (N, M), and its derivative (N, M, P) by the vector; ``phi`` as above."""
        phi = self._phi(measured, phi)
        m = self.motion(x, measured.q, phi)
        e = self.residuals(x, measured, phi, m)
        t, n, at = self.tool_points(x), len(measured), self.table_at
        J = np.zeros((n, 3 * self.points + 3 * self.full, len(self.parameters)))
        for k in range(self.points):
            rows, p = slice(3 * k, 3 * k + 3), m.o + m.R @ t[k]
            J[:, rows, 0:3] = np.eye(3)
            J[:, rows, 3:6] = -skew(p - x[:3]) @ left_jacobian(x[3:6])
            J[:, rows, self.tool_at + 3 * k : self.tool_at + 3 * k + 3] = m.R
            table = np.cross(m.axis, p - m.through)  # the derivative (n, 5, N, 3) by every number of the table
            table[:, _SHIFTS] = m.axis[:, _SHIFTS]
            J[:, rows, at : self.sources_at] = table.reshape(-1, n, 3).transpose(1, 2, 0)
            if self.features:
                J[:, rows, self.sources_at :] = self._by_source(table[:, OFFSET], phi)
        if measured.R_rig_body is not None:
            self._rotation_rows(m, x, measured, phi, e, J)
        if measured.length_m is not None:
            p = m.o + m.R @ t[0]
            J = (p / np.linalg.norm(p, axis=1)[:, None])[:, None] @ J
        return e, J

    def _rotation_rows(self, m: TableMotion, x: Array, measured: Measured, phi: Array, e: Array, J: Array) -> None:
        """Fill in the derivative of full poses: position residuals in the body's axes, and rotation residuals."""
        assert measured.R_rig_body is not None  # for the type checker: the caller has looked
        n, at = len(measured), self.table_at
        J[:, :3] = measured.R_rig_body.swapaxes(1, 2) @ J[:, :3]
        R_hat = m.R @ self.T_6_body(x)[:3, :3]
        to_log = (np.eye(3) + 0.5 * skew(e[:, 3:]) + _second(e[:, 3:])) @ R_hat.swapaxes(1, 2)
        by_rotation = m.axis.copy()  # the derivative (n, 5, N, 3) of a rotation vector in the rig's axes
        by_rotation[:, _SHIFTS] = 0.0
        W = np.zeros((n, 3, J.shape[2]))
        W[:, :, 3:6] = left_jacobian(x[3:6])
        W[:, :, at : self.sources_at] = by_rotation.reshape(-1, n, 3).transpose(1, 2, 0)
        if self.features:
            W[:, :, self.sources_at :] = self._by_source(by_rotation[:, OFFSET], phi)
        J[:, 3:] = to_log @ W
        J[:, 3:, at - 3 : at] = (to_log @ R_hat) @ left_jacobian(-x[at - 3 : at])

    def tool_in_base(self, x: Array, q: Array, approach: Array | None) -> Array:
        """Return T_base_body (N, 4, 4) at joint angles (N, n) read by the sensors."""
        m = self.motion(x, q, self.feature_values(q, approach))
        T = np.zeros((len(q), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = m.R, m.o, 1.0
        return np.asarray(inverse(self.T_rig_base(x)) @ T @ self.T_6_body(x))


def _second(e: Array) -> Array:
    """Return the second-order term of the right Jacobian's inverse at rotation vectors (N, 3)."""
    S = skew(e)
    return np.asarray(S @ S / 12)
