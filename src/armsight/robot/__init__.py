"""The robot's side: kinematics, trajectories and controllers. Never imports vision.

In: an arm by name, from a TOML table or from URDF; poses T_base_tool, m; joint angles, rad; a board's port. Out: poses,
Jacobians, joint angles, trajectories; joint commands to a board and what its joints report.

- ``arm``, ``solutions``, ``reach``: an arm of four to seven revolute joints, its inverse kinematics, its workspace;
- ``models/``: the arms that come with armsight; ``urdf``: arms from and to URDF; ``calibration_file``: the
  makers' files of single arms;
- ``kinematics/``: the compiled functions beneath;
- ``trajectories/``: motions that are checked against every limit before they start;
- ``boards/``: the controllers that drive the joints, real ones on a serial port and emulated ones.
"""
