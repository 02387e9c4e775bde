"""Rotations as people write them: quaternions in both orders, rotation vectors, angles about three axes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from armsight.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from armsight.data import Array

#: Conventions of three angles: a rotation vector; or rotations about x, y, z in the order given, about fixed axes (lower
#: case) or about the axes of the rotated frame (capitals). The angles stand by their axis, x first; of ZYZ in its order.
ROTATIONS = ("rotvec", "xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZYZ")
QUATERNION_OFF = 1e-2  # how far the length of a quaternion may be from 1: what two digits leave
CONVENTIONS = ("wxyz", "xyzw", *ROTATIONS)  # what three or four numbers of a rotation may mean


def rotations_by(numbers: Array, convention: str, path: Path, lines: Sequence[int] = ()) -> Array:
    """Return rotations (N, 3, 3) of quaternions (N, 4), or of angles (N, 3) in degrees, in a convention.

    Raises:
        InputError: a quaternion whose length is not 1.
    """
    import numpy as np  # the names above stand in options, whose help is quick
    from scipy.spatial.transform import Rotation

    if convention in ("wxyz", "xyzw"):
        lengths = np.linalg.norm(numbers, axis=1)
        worst = int(np.argmax(np.abs(lengths - 1))) if len(lengths) else 0
        if (np.abs(lengths - 1) > QUATERNION_OFF).any():
            where = f"line {lines[worst]}" if lines else f"pose {worst + 1}"
            raise InputError(f"{path}: {where}: a quaternion has length {lengths[worst]:.4g}, not 1")
        return np.asarray(Rotation.from_quat(numbers[:, [1, 2, 3, 0]] if convention == "wxyz" else numbers).as_matrix())
    if convention == "rotvec":
        return np.asarray(Rotation.from_rotvec(np.radians(numbers)).as_matrix())
    order = [0, 1, 2] if convention == "ZYZ" else ["xyz".index(axis) for axis in convention.lower()]
    return np.asarray(Rotation.from_euler(convention, np.radians(numbers[:, order])).as_matrix())
