"""The robot's side: kinematics, trajectories and controllers. Never imports vision.

In: an arm by name, from a TOML table or from URDF; poses T_base_tool, m; joint angles, rad; a board's port. Out: poses,
Jacobians, joint angles, trajectories; joint commands to a board and what its joints report.

- ``kinematics/``: an arm of four to seven revolute joints, its inverse kinematics, its workspace;
- ``models``: the arms that come with armsight; ``arm_file``, ``urdf/``, ``calibration_file``: arms from files;
- ``trajectories/``: motions that are checked against every limit before they start;
- ``boards/``: the controllers that drive the joints, real and emulated ones; ``board_registry`` opens them by name.
"""
