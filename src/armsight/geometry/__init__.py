"""Rotations, poses, rigid fits and array checks: numpy in, numpy out, no knowledge of cameras or robots.

- ``rotation``: rotation vectors, matrices, quaternions wxyz, Euler angles; ``pose``: 4x4 transforms T_a_b and tangents;
- ``rigid``: the rigid motion between two sets of points; ``check``: shape and finiteness of arrays at the public door.
"""
