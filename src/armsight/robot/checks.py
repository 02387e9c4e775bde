"""Joint angles and poses as they come in at the public door: made into new arrays, and refused with the reason.

New arrays, so that the kernels see one type only. What costs time, looking at every number, the kernels do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.kinematics import chain

DEGREES = "are these degrees? give radians: numpy.deg2rad(...)"


def angles_of(q: ArrayLike, *, batch: bool = True, name: str = "q") -> Array:
    """Return joint angles as a new array, so that kernels see one type only."""
    try:
        angles = np.array(q, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if angles.shape != (6,) and not (batch and angles.ndim == 2 and angles.shape[1] == 6):
        raise InputError(f"{name} has shape {angles.shape}, must be {'(6,) or (N, 6)' if batch else '(6,)'}")
    return angles


def near_angles(near: ArrayLike) -> Array:
    """Return the angles to be near to."""
    angles = angles_of(near, batch=False, name="near")
    if chain.verdict(angles):
        raise InputError(str(angle_refusal(angles)).replace("q", "near", 1))
    return angles


def poses_of(T: ArrayLike, dimensions: int) -> Array:
    """Return poses as a new array, so that kernels see one type only."""
    try:
        poses = np.array(T, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"T_base_tool must be numbers: {error}") from None
    if poses.ndim != dimensions or poses.shape[-2:] != (4, 4):
        want = "(4, 4)" if dimensions == 2 else "(N, 4, 4)"
        raise InputError(f"T_base_tool has shape {poses.shape}, must be {want}")
    return poses


def pose_refusal(Ts: Array) -> InputError:
    """Tell what is wrong with poses that a kernel refused."""
    if not np.isfinite(Ts).all():
        return InputError("T_base_tool contains NaN or infinity; every entry must be a finite number")
    R = Ts[:, :3, :3]
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max()
    if (Ts[:, 3] != (0, 0, 0, 1)).any():
        return InputError("T_base_tool is no rigid motion: its last row must be 0 0 0 1")
    if off < 1e-6:
        return InputError("T_base_tool is no rigid motion: its 3x3 part is a mirror image, its determinant is -1")
    return InputError(
        f"T_base_tool is no rigid motion: its columns are off from orthonormal by {off:.2g}; allowed is 1e-6"
    )


def angle_refusal(angles: Array) -> InputError:
    """Tell what is wrong with joint angles that a kernel refused."""
    if not np.isfinite(angles).all():
        return InputError("q contains NaN or infinity; every joint angle must be a finite number")
    row, joint = divmod(int(np.argmax(np.abs(angles) > chain.MOST_RADIANS)), 6)
    where = f"joint {joint + 1}" + (f" of row {row}" if angles.ndim == 2 else "")
    return InputError(f"q: {where} is at {angles.ravel()[6 * row + joint]:g} rad; {DEGREES}")
