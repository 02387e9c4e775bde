"""``armsight arm``: the kinematics of an arm at the command line.

In: an arm (a name, a .toml or a .urdf file), and joint angles or a pose. Out: its table, limits and reach, the pose of
the tool, the Jacobian, every inverse solution, a URDF file, a figure.
"""
