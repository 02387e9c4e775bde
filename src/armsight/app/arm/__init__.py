"""``armsight arm``: the kinematics of an arm at the command line.

In: an arm (a name, a .toml or a .urdf file), and joint angles or a pose. Out: its table, limits and reach, the pose of
the tool, the Jacobian, every inverse solution, a URDF file, a figure.

- ``command``: the command line.
- ``description``: the answers as JSON objects and as text.
- ``figure``: the arm at home as a PNG.
"""
