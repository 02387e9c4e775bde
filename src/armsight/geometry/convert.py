"""Transforms of other libraries: objects in, 4x4 matrices out, and ROS' fields of a matrix.

The other way most take the matrix: ``pinocchio.SE3(T)``, ``RigidTransform.from_matrix(T)``, ``spatialmath.SE3(T)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armsight.errors import InputError
from armsight.geometry.check import numbers
from armsight.geometry.pose import pose
from armsight.geometry.rotation import Array, from_quaternion_wxyz, quaternion_wxyz

#: Deviation of a rotation from orthonormal that rounding leaves, as `handeye` allows; half: five decimals pass barely,
#: double: more drift passes.
_ROUNDING = 1e-4


def as_transform(given: object) -> Array:
    """Return the (4, 4) transform, m, that an object of another library holds.

    Args:
        given: a 4x4 matrix; a pose that was measured; pinocchio's, SciPy's (RigidTransform) or spatialmath's transform; a
            pair of SciPy's Rotation and a translation, m; a ROS Pose, Transform, or a message that holds one (``pose``,
            ``transform``, also with covariance), whose quaternions are x y z w.

    Raises:
        InputError: it is none of these, or no rigid transform.
    """
    T = _matrix(given)
    if T.ndim > 2:
        raise InputError(f"{type(given).__name__}: holds {len(T)} transforms; expected one")
    R = T[:3, :3]
    rigid = np.isfinite(T).all() and np.abs(R @ R.T - np.eye(3)).max() < _ROUNDING and np.linalg.det(R) > 0
    if not rigid or (T[3] != [0, 0, 0, 1]).any():
        raise InputError(
            f"{type(given).__name__}: no rigid transform: expected a rotation, a translation and the row 0 0 0 1"
        )
    return T


def as_transforms(given: Any) -> Array:  # noqa: ANN401 - any library's object
    """Return the (N, 4, 4) matrices, m, of a list of what :func:`as_transform` takes, or of one object that holds N.

    Such are SciPy's RigidTransform, a table of ``measure_all`` and ROS' PoseArray. InputError has an entry's number.
    """
    given = getattr(given, "poses", given)
    many = given if isinstance(given, list | tuple) and not _is_pair(given) else _matrix(given).reshape(-1, 4, 4)
    found = np.zeros((len(many), 4, 4))
    for k, each in enumerate(many):
        try:
            found[k] = as_transform(each)
        except InputError as error:
            raise InputError(f"entry {k}: {error}") from None
    return found


def _is_pair(given: Any) -> bool:  # noqa: ANN401
    """Return whether this is a rotation that knows its matrix, as SciPy's, with a translation."""
    return (
        isinstance(given, list | tuple)
        and len(given) == 2
        and hasattr(given[0], "as_matrix")
        and not hasattr(given[1], "as_matrix")
        and np.shape(given[0].as_matrix())[-2:] == (3, 3)
    )


def _numbers(given: object) -> Array:
    """Return an array of numbers, an empty one where there are none."""
    try:
        return numbers(given).copy()
    except (TypeError, ValueError):
        return np.zeros(0)


def _matrix(given: Any) -> Array:  # noqa: ANN401 - any library's object
    """Return the matrix of a transform of another library; (N, 4, 4) where it holds N."""
    if _is_pair(given):
        R, p = np.asarray(given[0].as_matrix()), _numbers(given[1])
        if p.shape != R.shape[:-1]:
            raise InputError(f"a rotation {R.shape} needs a translation of numbers: expected {R.shape[:-1]}, m")
        return pose(R, p)
    for name in ("T_left_body", "transform", "pose"):  # a pose, and what ROS wraps
        if (inner := getattr(given, name, None)) is not None:
            return _matrix(inner)
    for moves, rotates in (("translation", "rotation"), ("position", "orientation")):
        t: Any = getattr(given, moves, None)
        q: Any = getattr(given, rotates, None)
        if hasattr(t, "x") and hasattr(q, "w"):
            wxyz, p = _numbers([q.w, q.x, q.y, q.z]), _numbers([t.x, t.y, t.z])
            if (wxyz.shape, p.shape) != ((4,), (3,)):
                raise InputError(f"{type(given).__name__}: expected numbers as its {moves} and {rotates}")
            if not np.linalg.norm(wxyz) > 0:
                raise InputError(f"{type(given).__name__}: its quaternion is zero: was it never set?")
            return pose(from_quaternion_wxyz(wxyz), p)
    given = (
        given.as_matrix() if hasattr(given, "as_matrix") else getattr(given, "homogeneous", getattr(given, "A", given))
    )
    T = _numbers(given)
    if T.shape[-2:] == (3, 3):
        raise InputError(
            f"{type(given).__name__}: a rotation without a translation: give the pair (rotation, [x, y, z] in m)"
        )
    if T.shape[-2:] != (4, 4) or T.ndim > 3:
        raise InputError(
            f"{type(given).__name__}: expected a 4x4 matrix, m, as an array or the list of its rows, or a transform of "
            "pinocchio, SciPy, spatialmath or ROS"
        )
    return T


def ros_fields(given: object) -> dict[str, dict[str, float]]:
    """Return ``translation`` and ``rotation`` of a ROS Transform as plain numbers, m and quaternion x y z w.

    Args:
        given: what :func:`as_transform` takes.

    Raises:
        InputError: it is no rigid transform.
    """
    T = as_transform(given)
    w, x, y, z = quaternion_wxyz(T[:3, :3]).tolist()
    tx, ty, tz = T[:3, 3].tolist()
    return {"translation": {"x": tx, "y": ty, "z": tz}, "rotation": {"x": x, "y": y, "z": z, "w": w}}
