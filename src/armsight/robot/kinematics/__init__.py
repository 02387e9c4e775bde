"""Kinematics: :class:`~armsight.robot.kinematics.arm.Arm` checks, kernels of (table, q) compute without allocation.

In: the packed table of an arm and joint angles, rad, or a pose T_base_tool, m. Out: poses, Jacobians, joint angles.

- ``arm``, ``solutions``, ``reach``: the arm, its joint angles at a pose, its workspace;
- ``table``: the packed form of a Denavit-Hartenberg table, which all kernels read;
- ``chain``: forward kinematics, Jacobian and its rate, one configuration or a batch of eight;
- ``structure``: which closed-form inverse a table of six joints has; ``closed``: that inverse;
- ``inverse``: all joint angles of a pose, checked, polished and sorted; the nearest pose where there are none;
- ``numeric``: joint angles of a pose for four, five and seven joints.
"""
