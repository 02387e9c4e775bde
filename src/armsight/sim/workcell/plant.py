"""The arm at the board's motors: duties go in, what the converters read comes out, and the truth is kept apart.

:class:`ArmPlant` fulfils :class:`armsight.robot.boards.machine.Plant`. The arm is a MuJoCo model made of its true table
(cell_mjcf): motors with current limit and friction, backlash and twist in every joint, potentiometers on the gears'
shafts, which see neither backlash nor twist. Brakes hold the shafts while the drivers are off. Steps are 1 ms.
"""

from __future__ import annotations

import mujoco
import numpy as np

from armsight.data import Array
from armsight.robot.arm import Arm
from armsight.robot.boards.machine import Sensed
from armsight.sim.workcell.arm import TrueArm, pot_travel
from armsight.sim.cell_mjcf import SUBSTEPS, mjcf
from armsight.sim.workcell.motors import SUPPLY_V, Motors, chosen
from armsight.sim.cell_pots import Potentiometers
from armsight.sim.cell_solids import inertia, solids

TICK_S = 0.001
#: Damping between shaft and link, of critical.
_DAMPING = 0.08
#: The arm hangs in its joints before time begins, s.
_SETTLE_S = 0.5


class ArmPlant:
    """An arm with motors, backlash, twist and potentiometers.

    Attributes:
        arm: the true table.
        parts: the solids it is made of.
        motors: what turns it.
        stop_pressed: whether the emergency stop button is pressed; may be set.
        supply_mv: motor supply, mV; may be set.
    """

    def __init__(self, model: Arm, true: TrueArm, seed: int = 0) -> None:
        """Build the arm, at rest at the model's home, held by its brakes.

        Args:
            model: the nominal table: motors and potentiometers are chosen for it.
            true: how the arm really is.
            seed: of the potentiometers' noise.
        """
        self.arm, self.parts = true.arm, solids(true.arm)
        self.motors: Motors = chosen(model, solids(model), true.imperfections.friction)
        self.stop_pressed, self.supply_mv = False, round(1e3 * SUPPLY_V)
        self.pots = Potentiometers(true, pot_travel(model), seed)
        # The twist under the greatest weight; joints that carry none are as stiff for the torque they need.
        load = np.maximum(self.motors.weight_nm, 0.5 * self.motors.needed_nm)
        self.stiffness = load / true.imperfections.sag_rad
        damping = 2 * _DAMPING * np.sqrt(self.stiffness * inertia(model, self.parts, model.home))
        text = mjcf(true.arm, self.parts, self.motors, true.backlash_rad, self.stiffness, damping)
        self._model = mujoco.MjModel.from_xml_string(text)
        self._data = mujoco.MjData(self._model)
        self._drives_on = False
        self._qpos, self._ctrl, self._force = self._data.qpos, self._data.ctrl, self._data.actuator_force
        self._newton_metre_per_a = self.motors.gear_ratio * self.motors.torque_constant
        self._qpos[:] = np.tile(model.home, 2)
        mujoco.mj_step(self._model, self._data, nstep=round(_SETTLE_S / TICK_S) * SUBSTEPS)
        self._ticks = 1  # what a board's first tick, number 1, senses
        self._path = np.empty((4096, 12))
        self._path[:2] = self._qpos

    @property
    def t_s(self) -> float:
        """When the arm is as it is now, s: what is sensed in a board's tick k is sensed at k ms."""
        return self._ticks * TICK_S

    @property
    def path(self) -> Array:
        """(N, 12) true angles of the shafts, then of the links, rad, at each millisecond from the start."""
        return self._path[: self._ticks + 1]

    def sense(self) -> Sensed:
        """Return what the converters read now."""
        amperes = np.abs(self._force) / self._newton_metre_per_a
        return Sensed(
            self.pots.read(self._qpos[:6]),
            np.rint(1e3 * amperes).astype(np.uint32),
            self.supply_mv,
            self.stop_pressed,
        )

    def step(self, duty: Array, drives_on: bool) -> None:
        """Let 1 ms pass with these duties (6,), -1 to 1, held; with ``drives_on`` False the brakes are closed."""
        if drives_on != self._drives_on:
            self._switch(drives_on)
        self._ctrl[:] = duty if drives_on else 0.0
        mujoco.mj_step(self._model, self._data, nstep=SUBSTEPS)
        self._ticks += 1
        if self._ticks == len(self._path):
            self._path = np.concatenate([self._path, np.empty_like(self._path)])
        self._path[self._ticks] = self._qpos

    def _switch(self, drives_on: bool) -> None:
        """Open the brakes and close the motors' circuits, or the other way round."""
        self._drives_on = drives_on
        self._model.dof_frictionloss[:6] = self.motors.coulomb_nm if drives_on else self.motors.brake_nm
        self._model.actuator_biasprm[:, 2] = -self.motors.emf_damping if drives_on else 0.0
