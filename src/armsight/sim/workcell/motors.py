"""The motors of an arm: direct-current motors with gears, chosen by a rule that suits any table.

What each joint needs is looked up over many poses of the nominal arm: the greatest torque of its weight, the greatest
inertia. A gear and a motor are then chosen so that a 24 V supply gives a speed and a torque to spare. Current
``i = (duty U - k n w) / R`` within its limit, torque ``n k i`` less friction, at the joint's speed w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.robot.arm import Arm
from armsight.sim.cell_solids import Solids, inertia, weight_torque

SUPPLY_V = 24.0
#: No-load speed over the joint's greatest; greatest torque and stall torque over what is needed.
_SPEED_SPARE, _TORQUE_SPARE, _STALL_SPARE = 1.7, 2.5, 6.0
_ACCELERATION_SPARE = 2.0  # a joint could accelerate so many times as hard as it may
_TIME_CONSTANT_S = 0.012  # of the motor alone, unloaded
_TORQUE_CONSTANT = 0.04  # N m/A: of the whole family
#: Friction: dry, of the torque needed; viscous, of the motor's own damping; of the bearing, of the torque needed.
_COULOMB, _VISCOUS, _BEARING = 0.10, 0.05, 0.01
_LEAST = 0.03  # a joint needs no less than this share of what the strongest needs
_BRAKE = 5.0  # holding torque of the brakes, of the torque needed
_POSES = 400  # at which the arm is looked at


@dataclass(frozen=True, eq=False)
class Motors(Record):
    """Six geared motors; what turns is given at the joint.

    Attributes:
        gear_ratio: (6,) turns of the motor for one of the joint.
        torque_constant: (6,) N m/A, also V s/rad, at the motor.
        resistance_ohm: (6,) of the winding.
        rotor_inertia: (6,) kg m^2, of rotor and gear, at the joint.
        current_max_a: (6,) the driver's own limit.
        coulomb_nm: (6,) dry friction of motor and gear, N m.
        viscous: (6,) friction that grows with speed, N m s/rad.
        bearing_nm: (6,) dry friction of the link's own bearing, N m.
        brake_nm: (6,) what the brake holds, N m; closed while the drivers are off.
        needed_nm: (6,) torque that the joint needs, N m: of weight and of its greatest acceleration.
        weight_nm: (6,) greatest torque of the weight, N m.
    """

    gear_ratio: Array
    torque_constant: Array
    resistance_ohm: Array
    rotor_inertia: Array
    current_max_a: Array
    coulomb_nm: Array
    viscous: Array
    bearing_nm: Array
    brake_nm: Array
    needed_nm: Array
    weight_nm: Array

    @property
    def stall_nm(self) -> Array:
        """(6,) torque at full duty and at rest if nothing limited the current, N m."""
        return np.asarray(self.gear_ratio * self.torque_constant * SUPPLY_V / self.resistance_ohm)

    @property
    def emf_damping(self) -> Array:
        """(6,) torque lost per speed, N m s/rad: the motor's own voltage drives current back."""
        return np.asarray((self.gear_ratio * self.torque_constant) ** 2 / self.resistance_ohm)

    @property
    def no_load_rad_s(self) -> Array:
        """(6,) speed at full duty without load or friction, rad/s."""
        return np.asarray(SUPPLY_V / (self.gear_ratio * self.torque_constant))


def chosen(model: Arm, parts: Solids, friction: float = 1.0) -> Motors:
    """Choose motors and gears for an arm.

    Args:
        model: the nominal arm.
        parts: its solids.
        friction: dry and viscous friction, of what is usual.
    """
    rng = np.random.default_rng(0)
    poses = rng.uniform(model.q_min, model.q_max, (_POSES, 6))
    weight = np.max([np.abs(weight_torque(model, parts, q)) for q in poses], axis=0)
    load = np.max([inertia(model, parts, q) for q in poses], axis=0)
    needed = weight + _ACCELERATION_SPARE * load * model.qdd_max
    needed = np.maximum(needed, _LEAST * needed.max())
    constant = np.full(6, _TORQUE_CONSTANT)
    gear = SUPPLY_V / (constant * _SPEED_SPARE * model.qd_max)
    resistance = gear * constant * SUPPLY_V / (_STALL_SPARE * needed)
    emf = (gear * constant) ** 2 / resistance
    return Motors(
        gear,
        constant,
        resistance,
        _TIME_CONSTANT_S * emf,
        _TORQUE_SPARE * needed / (gear * constant),
        friction * _COULOMB * needed,
        friction * _VISCOUS * emf,
        friction * _BEARING * needed,
        _BRAKE * needed,
        needed,
        weight,
    )
