"""Chains of the models as their makers, or the makers of their ROS drivers, publish them in URDF: not written by us.

A row is a joint: xyz, m, and roll, pitch, yaw, rad, of its origin in the frame before, and its axis. The last row is the
tool, without axis. Angles that the files print as multiples of 90 degrees to a few digits (1.5708) are meant exactly.
"""

from __future__ import annotations

from math import pi

import numpy as np

H = pi / 2
Z, BACK = (0, 0, 1), (0, 0, -1)


def ur(d1, a2, a3, d4, d5, d6):
    """Universal_Robots_ROS2_Description, config/*/default_kinematics.yaml: the links of all its arms stand alike."""
    return [
        ((0, 0, d1), (0, 0, 0), Z),
        ((0, 0, 0), (H, 0, 0), Z),
        ((a2, 0, 0), (0, 0, 0), Z),
        ((a3, 0, d4), (0, 0, 0), Z),
        ((0, -d5, 0), (H, 0, 0), Z),
        ((0, d6, 0), (H, pi, pi), Z),
        ((0, 0, 0), (0, 0, 0), None),
    ]


CHAINS = {
    "ur3": ur(0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "ur5": ur(0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "ur10": ur(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "ur3e": ur(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": ur(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": ur(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    # ycheng517/ar4_ros_driver, annin_ar4_description/urdf/ar_macro.xacro with ar_description/config/mk3.yaml; without the
    # 7 mm by which joint 3 stands sideways there, which the maker's table does not have
    "ar4": [
        ((0, 0, 0), (pi, 0, 0), Z),
        ((0, 0.0642, -0.16977), (H, 0, -H), BACK),
        ((0, -0.305, 0), (0, 0, pi), BACK),
        ((0, 0, 0), (H, 0, -H), BACK),
        ((0, 0, -0.22263), (pi, 0, -H), (1, 0, 0)),
        ((0, 0, 0.041), (0, 0, pi), Z),
        ((0, 0, 0), (0, 0, 0), None),
    ],
    # TheRobotStudio/SO-ARM100, Simulation/SO101/so101_new_calib.urdf, up to gripperframe; without a pitch of 9e-8 in joint
    # 5
    "so101": [
        ((0.0207909, -0.0230745, 0.0948817), (-pi, 0, H), Z),
        ((-0.0303992, -0.0182778, -0.0542), (-H, -H, 0), Z),
        ((-0.11257, -0.028, 0), (0, 0, H), Z),
        ((-0.1349, 0.0052, 0), (0, 0, -H), Z),
        ((0, -0.0611, 0.0181), (H, 0, pi), Z),
        ((-0.0079, -0.000218121, -0.0981274), (H, 0, H), None),
    ],
    # xArm-Developer/xarm_ros2, xarm_description/urdf/xarm6/xarm6.urdf.xacro and xarm7/xarm7.urdf.xacro
    "xarm6": [
        ((0, 0, 0.267), (0, 0, 0), Z),
        ((0, 0, 0), (-H, 0, 0), Z),
        ((0.0535, -0.2845, 0), (0, 0, 0), Z),
        ((0.0775, 0.3425, 0), (-H, 0, 0), Z),
        ((0, 0, 0), (H, 0, 0), Z),
        ((0.076, 0.097, 0), (-H, 0, 0), Z),
        ((0, 0, 0), (0, 0, 0), None),
    ],
    "xarm7": [
        ((0, 0, 0.267), (0, 0, 0), Z),
        ((0, 0, 0), (-H, 0, 0), Z),
        ((0, -0.293, 0), (H, 0, 0), Z),
        ((0.0525, 0, 0), (H, 0, 0), Z),
        ((0.0775, -0.3425, 0), (H, 0, 0), Z),
        ((0, 0, 0), (H, 0, 0), Z),
        ((0.076, 0.097, 0), (-H, 0, 0), Z),
        ((0, 0, 0), (0, 0, 0), None),
    ],
    # frankaemika/franka_ros, franka_description/robots/common/franka_robot.xacro, up to link8
    "franka": [
        ((0, 0, 0.333), (0, 0, 0), Z),
        ((0, 0, 0), (-H, 0, 0), Z),
        ((0, -0.316, 0), (H, 0, 0), Z),
        ((0.0825, 0, 0), (H, 0, 0), Z),
        ((-0.0825, 0.384, 0), (-H, 0, 0), Z),
        ((0, 0, 0), (H, 0, 0), Z),
        ((0.088, 0, 0), (H, 0, 0), Z),
        ((0, 0, 0.107), (0, 0, 0), None),
    ],
    # IFL-CAMP/iiwa_stack, iiwa_description/urdf/iiwa14.xacro, up to link_ee_kuka
    "iiwa": [
        ((0, 0, 0.1575), (0, 0, 0), Z),
        ((0, 0, 0.2025), (H, 0, pi), Z),
        ((0, 0.2045, 0), (H, 0, pi), Z),
        ((0, 0, 0.2155), (H, 0, 0), Z),
        ((0, 0.1845, 0), (-H, pi, 0), Z),
        ((0, 0, 0.2155), (H, 0, 0), Z),
        ((0, 0.081, 0), (-H, pi, 0), Z),
        ((0, 0, 0.045), (pi, pi, pi), None),
    ],
}


def urdf(name, chain):
    """A chain as URDF text."""
    words = [f'<robot name="{name}"><link name="l0"/>']
    for i, (xyz, rpy, axis) in enumerate(chain):
        at = " ".join(map(repr, map(float, xyz))), " ".join(map(repr, map(float, rpy)))
        kind = "fixed" if axis is None else "revolute"
        words.append(
            f'<link name="l{i + 1}"/><joint name="j{i + 1}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="{at[0]}" rpy="{at[1]}"/>'
        )
        if axis is not None:
            words.append(f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>')
            words.append('<limit lower="-3" upper="3" velocity="1" effort="1"/>')
        words.append("</joint>")
    return "".join([*words, "</robot>"])


class Peer:
    """pinocchio on the URDF of a chain."""

    def __init__(self, name):
        import pinocchio as pin

        self._pin = pin
        self.model = pin.buildModelFromXML(urdf(name, CHAINS[name]))
        self.data = self.model.createData()
        self.tool = self.model.getFrameId(f"l{len(CHAINS[name])}")

    def forward(self, q):
        self._pin.framesForwardKinematics(self.model, self.data, np.asarray(q))
        return self.data.oMf[self.tool].homogeneous

    def jacobian(self, q):
        axes = self._pin.LOCAL_WORLD_ALIGNED
        return self._pin.computeFrameJacobian(self.model, self.data, np.asarray(q), self.tool, axes)
