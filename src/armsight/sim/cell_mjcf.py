"""An arm as a MuJoCo model: twelve degrees of freedom, six gear shafts and six links, joined by play and a spring each.

A motor turns its shaft; the potentiometer sits on the shaft; between shaft and link lie the backlash and the twist. In
MuJoCo that is a fixed tendon of the length (shaft - link) whose spring has a dead band. Dry friction is MuJoCo's friction
loss, made so hard that what stands stays; the motor is an actuator whose force falls with speed and is bounded by the
driver's current limit. Bodies touch nothing.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, quaternion_wxyz
from armsight.robot.arm import Arm
from armsight.robot.kinematics.table import BASE, TOOL, link
from armsight.sim.workcell.motors import Motors
from armsight.sim.cell_solids import GRAVITY_M_S2, Solids

#: MuJoCo's own steps in a millisecond: the stiffest wrist swings at up to 3000 rad/s.
SUBSTEPS = 4
#: A dry friction yields this little: what is held creeps less than a microradian a second.
_HARD = 'solreffriction="0.0005 1" solimpfriction="0.9999 0.9999 0.001"'


def mjcf(arm: Arm, parts: Solids, motors: Motors, backlash_rad: Array, stiffness: Array, damping: Array) -> str:
    """Write the model.

    Args:
        arm: the table to build.
        parts: what its links are made of.
        motors: what turns it.
        backlash_rad: (6,) play from stop to stop.
        stiffness: (6,) of each joint's twist, N m/rad.
        damping: (6,) between shaft and link, N m s/rad.

    Returns:
        MJCF; shafts are joints 0 to 5 (``shaft1``...), links 6 to 11 (``link1``...), and the site ``tool`` is the tool.
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
    rows = arm.table[:BASE].reshape(6, 6)
    T_6_tool = np.vstack([arm.table[TOOL : TOOL + 12].reshape(3, 4), [0, 0, 0, 1]])
    T, opened = np.vstack([arm.table[BASE : BASE + 12].reshape(3, 4), [0, 0, 0, 1]]), ""
    for i, (a, d, c, s, offset, way) in enumerate(rows):
        turned = T @ pose(exp_so3(np.array([0.0, 0.0, offset])), np.zeros(3))
        opened += (
            f'<body {_place(turned)}><joint name="link{i + 1}" axis="0 0 {way}" frictionloss="{motors.bearing_nm[i]}" '
            f"{_HARD}/>" + "".join(_capsule(parts, k) for k in np.flatnonzero(parts.link == i + 1).tolist())
        )
        T = link(a, d, c, s)
    return f'{opened}<site name="tool" {_place(T @ T_6_tool)}/>' + 6 * "</body>"


def _place(T: Array) -> str:
    """Write a pose."""
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
