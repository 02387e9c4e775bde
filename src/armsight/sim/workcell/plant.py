"""The arm at the board's motors: duties go in, the converters' readings come out, and the truth is kept apart.

:class:`ArmPlant` fulfils :class:`armsight.robot.boards.link.Plant`. Steps are 1 ms. Brakes hold the shafts until the
board opens them.

The arm is a MuJoCo model made of its true table (:func:`mjcf`): twelve degrees of freedom, six gear shafts and six links,
each pair joined by backlash and a spring. A motor rotates its shaft; the potentiometer sits on the shaft, so it sees
neither backlash nor twist. In MuJoCo that is a fixed tendon of the length (shaft - link) whose spring has a dead band. Dry
friction is MuJoCo's friction loss, so hard that a resting joint stays; the motor is an actuator whose force falls with
speed and is bounded by the driver's current limit. Bodies touch nothing.

A potentiometer (:class:`Potentiometers`) spans a joint's travel with nine tenths of its supply. Its reading differs from
the straight line by a smooth error and an offset; each conversion adds noise and is rounded to the converter's step, and a
tick's conversions are averaged: noise of a step or so compensates the rounding.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, quaternion_wxyz
from armsight.kernels import kernel
from armsight.robot.boards.link import TICK_S, Sensed
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.table import BASE, TOOL, link, rows_of
from armsight.sim.workcell.arm import TrueArm, pot_travel
from armsight.sim.workcell.motors import GRAVITY_M_S2, SUPPLY_V, Motors, Solids, chosen, inertia, solids

#: MuJoCo's own steps in a millisecond: the stiffest wrist swings at up to 3000 rad/s.
SUBSTEPS = 4
#: A dry friction yields this little: what is held creeps less than a microradian a second.
_HARD = 'solreffriction="0.0005 1" solimpfriction="0.9999 0.9999 0.001"'


def _mujoco() -> Any:  # noqa: ANN401 - a module without types
    """Import MuJoCo, which only the simulated workcell needs."""
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise InputError(
            "the simulated workcell needs mujoco, which is not installed: pip install 'armsight[sim]'"
        ) from None


def mjcf(arm: Arm, parts: Solids, motors: Motors, backlash_rad: Array, stiffness: Array, damping: Array) -> str:
    """Write the model as MJCF: shafts are joints 0 to 5 (``shaft1``...), links 6 to 11 (``link1``...), a site ``tool``.

    backlash_rad (6,) from stop to stop; stiffness (6,), N m/rad, and damping (6,), N m s/rad, between shaft and link.
    """
    shafts = "".join(
        f'<body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1e-9"/><joint name="shaft{i + 1}" axis="0 0 1" '
        f'armature="{motors.rotor_inertia[i]}" damping="{motors.viscous[i]}" frictionloss="{motors.brake_nm[i]}" '
        f"{_HARD}/></body>"
        for i in range(6)
    )
    tendons = "".join(
        f'<fixed stiffness="{stiffness[i]}" damping="{damping[i]}" springlength="{-half} {half}">'
        f'<joint joint="shaft{i + 1}" coef="1"/><joint joint="link{i + 1}" coef="-1"/></fixed>'
        for i, half in enumerate(0.5 * backlash_rad)
    )
    motor = "".join(
        f'<general joint="shaft{i + 1}" gainprm="{motors.stall_nm[i]}" biastype="affine" forcelimited="true" '
        f'forcerange="-{most} {most}"/>'
        for i, most in enumerate(motors.gear_ratio * motors.torque_constant * motors.current_max_a)
    )
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{1e-3 / SUBSTEPS}" integrator="implicitfast" '
        f'gravity="0 0 -{GRAVITY_M_S2}" iterations="8"><flag contact="disable"/></option>'
        f"<worldbody>{shafts}{_links(arm, parts, motors)}</worldbody>"
        f"<tendon>{tendons}</tendon><actuator>{motor}</actuator></mujoco>"
    )


def _links(arm: Arm, parts: Solids, motors: Motors) -> str:
    """Write the links, one body in the other; body i is row frame i."""
    rows = rows_of(arm.table)
    T_6_tool = np.vstack([arm.table[TOOL : TOOL + 12].reshape(3, 4), [0, 0, 0, 1]])
    T, opened = np.vstack([arm.table[BASE : BASE + 12].reshape(3, 4), [0, 0, 0, 1]]), ""
    for i, (a, d, c, s, offset, way) in enumerate(rows):
        rotated = T @ pose(exp_so3(np.array([0.0, 0.0, offset])), np.zeros(3))
        opened += (
            f'<body {_pose_text(rotated)}><joint name="link{i + 1}" axis="0 0 {way}" frictionloss="{motors.bearing_nm[i]}" '
            f"{_HARD}/>" + "".join(_capsule(parts, k) for k in np.flatnonzero(parts.link == i + 1).tolist())
        )
        T = link(a, d, c, s)
    return f'{opened}<site name="tool" {_pose_text(T @ T_6_tool)}/>' + 6 * "</body>"


def _pose_text(T: Array) -> str:
    return f'pos="{_row(T[:3, 3])}" quat="{_row(quaternion_wxyz(T[:3, :3]))}"'


def _capsule(parts: Solids, k: int) -> str:
    """Write one solid; one without length is a ball."""
    foot, hand = parts.ends[k]
    common = f'mass="{parts.mass[k]}" contype="0" conaffinity="0"'
    if np.allclose(foot, hand):
        return f'<geom type="sphere" pos="{_row(foot)}" size="{parts.radius[k]}" {common}/>'
    return f'<geom type="capsule" fromto="{_row(foot)} {_row(hand)}" size="{parts.radius[k]}" {common}/>'


def _row(numbers: Array) -> str:
    """Write numbers to the last bit."""
    return " ".join(repr(float(n)) for n in numbers)


#: Shares of the supply at the ends of the travel.
LOW_SHARE, HIGH_SHARE = 0.05, 0.95
COUNTS = 65536  # of the supply, as the board gives them
#: Ticks that are kept as they were, 4 to 9 minutes in 50 MB; half: the same, no shot looks back so far; double: 100 MB.
_RECENT = 1 << 18
_THINNED = 8  # of older ticks one in so many is kept; half: twice the memory; double: 50 um between two at 1 m/s^2
_BLOCK = 256  # ticks whose noise is sampled at once

Counts = NDArray[np.uint32]


@kernel("f8[:, ::1], f8[::1], f8[:, :, ::1], f8[::1], f8[::1], f8[:, ::1]")
def _errors(shaft: Array, offset: Array, sines: Array, low: Array, span: Array, out: Array) -> None:
    """Write what potentiometers say too much at shaft angles (N, 6) into out (N, 6)."""
    for n in range(shaft.shape[0]):
        for i in range(6):
            along = (shaft[n, i] - low[i]) / span[i]
            total = offset[i]
            for k in range(sines.shape[1]):
                total += sines[i, k, 0] * np.sin(2 * np.pi * sines[i, k, 1] * along + sines[i, k, 2])
            out[n, i] = total


@kernel("const f8[:, ::1], f8[::1], f8[:, :, ::1], f8[::1], f8[::1], f4[:, :, ::1], i8, f8, u4[::1]")
def _read(
    shaft: Array,
    offset: Array,
    sines: Array,
    low: Array,
    span: Array,
    noise: NDArray[np.float32],
    row: int,
    steps: float,
    counts: Counts,
) -> None:
    """Convert what wipers say at shaft angles (1, 6), with a row of noise (N, 6, n) in steps; averages into counts (6,)."""
    n, over = noise.shape[2], np.empty((1, 6))
    _errors(shaft, offset, sines, low, span, over)
    for i in range(6):
        said = shaft[0, i] + over[0, i]
        share = LOW_SHARE + (HIGH_SHARE - LOW_SHARE) * (said - low[i]) / span[i]
        total = 0.0
        for k in range(n):
            total += min(max(np.floor(share * steps + noise[row, i, k] + 0.5), 0.0), steps - 1.0)
        counts[i] = np.uint32(min(np.floor(total / n * (COUNTS / steps) + 0.5), COUNTS - 1.0))


class Potentiometers:
    """Six potentiometers on one converter."""

    def __init__(self, true: TrueArm, travel: Array, seed: int) -> None:
        """Make ready to read, with joint angles travel (6, 2) at the ends of their travel, rad."""
        self._given = true.imperfections
        self._low, self._span = travel[:, 0].copy(), np.ptp(travel, axis=1)
        self._offset, self._sines = true.pot_offset_rad.copy(), true.pot_sines.copy()
        self._rng = np.random.default_rng([seed, 2])
        self._noise = np.zeros((0, 6, 0), np.float32)
        self._next = 0
        self._steps = float(1 << self._given.adc_bits)

    def error(self, shaft: Array) -> Array:
        """Return what they say too much at shaft angles (N, 6), rad."""
        out = np.empty(shaft.shape)
        _errors(np.ascontiguousarray(shaft), self._offset, self._sines, self._low, self._span, out)
        return out

    def read(self, shaft: Array) -> Counts:
        """Read them once at shaft angles (6,), rad: (6,) counts, uint32, 0 to 65535."""
        if self._next == len(self._noise):
            block = self._rng.standard_normal((_BLOCK, 6, self._given.oversampling), dtype=np.float32)
            self._noise, self._next = block * np.float32(self._given.pot_noise_lsb), 0
        counts = np.empty(6, np.uint32)
        errors = (self._offset, self._sines, self._low, self._span)
        _read(shaft[None], *errors, self._noise, self._next, self._steps, counts)
        self._next += 1
        return counts


#: Damping between shaft and link, of critical.
_DAMPING = 0.08
#: The arm hangs in its joints before time begins, s.
_SETTLE_S = 0.5


class Travelled:
    """What an arm's angles were, at each millisecond of the last minutes; longer ago at fewer times, so that hours fit.

    Args:
        first: (K,) the first angles, rad.

    Attributes:
        begin: the tick of the first row of ``recent``.
        ticks: how many ticks have passed since the first.
    """

    def __init__(self, first: Array) -> None:
        self._rows, self._old = np.empty((2 * _RECENT, len(first))), np.empty((0, len(first)))
        self._old_ticks = np.empty(0)
        self.begin, self.ticks = 0, 0
        self._rows[0] = first

    def add(self, angles: Array) -> None:
        """Add the angles (K,), rad, of the next tick."""
        self.ticks += 1
        if self.ticks - self.begin == len(self._rows):
            self._old = np.concatenate([self._old, self._rows[:_RECENT:_THINNED]])
            self._old_ticks = np.append(self._old_ticks, self.begin + np.arange(0, _RECENT, _THINNED))
            if len(self._old) > 2 * _RECENT:
                self._old, self._old_ticks = self._old[::2].copy(), self._old_ticks[::2].copy()
            self._rows[:_RECENT] = self._rows[_RECENT:]
            self.begin += _RECENT
        self._rows[self.ticks - self.begin] = angles

    @property
    def recent(self) -> Array:
        """(N, K) angles at each tick from ``begin`` on, rad."""
        return self._rows[: self.ticks - self.begin + 1]

    def whole(self) -> tuple[Array, Array]:
        """Return ticks (M,) from the beginning on, and the angles (M, K) then, rad."""
        ticks = np.append(self._old_ticks, self.begin + np.arange(len(self.recent), dtype=np.float64)).astype(
            np.float64
        )
        return ticks, np.concatenate([self._old, self.recent])


class ArmPlant:
    """An arm with motors, backlash, twist and potentiometers; ``arm`` is the true table.

    May be set: ``stop_pressed``, the supply, and ``stepped``, which is called after every step.
    """

    def __init__(self, model: Arm, true: TrueArm, seed: int = 0) -> None:
        """Build the arm, at rest at the model's home, held by its brakes.

        The nominal table ``model`` is what motors and potentiometers are chosen for; ``true`` how the arm really is.
        """
        self.arm, self.parts = true.arm, solids(true.arm)
        self.motors: Motors = chosen(model, solids(model), true.imperfections.friction)
        self.stop_pressed, self.supply_mv = False, round(1e3 * SUPPLY_V)
        self.stepped: Callable[[], None] = lambda: None
        self.pots = Potentiometers(true, pot_travel(model), seed)
        # The twist under the greatest gravity load; joints that carry none are as stiff for the torque they need.
        load = np.maximum(self.motors.gravity_nm, 0.5 * self.motors.needed_nm)
        self.stiffness = load / true.imperfections.compliance_rad
        damping = 2 * _DAMPING * np.sqrt(self.stiffness * inertia(model, self.parts, model.home))
        text = mjcf(true.arm, self.parts, self.motors, true.backlash_rad, self.stiffness, damping)
        mujoco = _mujoco()
        self._mj_step = mujoco.mj_step
        self._model = mujoco.MjModel.from_xml_string(text)
        self._data = mujoco.MjData(self._model)
        self._switched = False, True
        self._qpos, self._ctrl, self._force = self._data.qpos, self._data.ctrl, self._data.actuator_force
        self._newton_metre_per_a = self.motors.gear_ratio * self.motors.torque_constant
        self._qpos[:] = np.tile(model.home, 2)
        self._mj_step(self._model, self._data, nstep=round(_SETTLE_S / TICK_S) * SUBSTEPS)
        self.travelled = Travelled(self._qpos)
        self.travelled.add(self._qpos)  # what a board's first tick, number 1, senses

    @property
    def t_s(self) -> float:
        """When the arm is as it is now, s: what is sensed in a board's tick k is sensed at k ms."""
        return self.travelled.ticks * TICK_S

    @property
    def path(self) -> Array:
        """(N, 12) true angles of the shafts, then of the links, rad, at each millisecond of the last minutes."""
        return self.travelled.recent

    def sense(self) -> Sensed:
        """Return what the converters read now."""
        amperes = self._force / self._newton_metre_per_a
        return Sensed(
            self.pots.read(self._qpos[:6]), np.rint(1e3 * amperes).astype(np.int32), self.supply_mv, self.stop_pressed
        )

    def step(self, duty: Array, awake: bool, braked: bool = False) -> None:
        """Let 1 ms pass with these duties (6,), -1 to 1, held, the motors' circuits closed, the brakes open or closed."""
        if (awake, braked) != self._switched:
            self._switch(awake, braked)
        self._ctrl[:] = duty if awake else 0.0
        self._mj_step(self._model, self._data, nstep=SUBSTEPS)
        self.travelled.add(self._qpos)
        self.stepped()

    def _switch(self, awake: bool, braked: bool) -> None:
        """Open or close the motors' circuits and the brakes."""
        self._switched = awake, braked
        self._model.dof_frictionloss[:6] = self.motors.brake_nm if braked else self.motors.coulomb_nm
        self._model.actuator_biasprm[:, 2] = -self.motors.emf_damping if awake else 0.0
