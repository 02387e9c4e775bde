"""What ``armsight arm`` answers, as JSON objects (units in the keys) and as text (mm and degrees).

In: an arm, joint angles (n,) in rad or a pose (4, 4), the inverse solutions of a pose. Out: for each subcommand a function
NAME_json and a function NAME_text of the same records.

Angles of a rotation are Euler angles about z, y and x, in that sequence: R = Rz(euler_z) Ry(euler_y) Rx(euler_x). Robot
sources that call them roll, pitch, yaw put roll about z; ROS puts roll about x.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from armsight.app.show.encode import json_of
from armsight.app.show.table import aligned
from armsight.data import Array
from armsight.geometry.rotation import euler_zyx
from armsight.robot.calibration_file import Difference
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.reach import reach
from armsight.robot.kinematics.solutions import Solutions


def list_json(models: Mapping[str, Arm]) -> list[dict[str, Any]]:
    """Return each arm's name, reach and source."""
    return [{"arm": name, "radius_m": reach(arm).radius_m, "source": arm.source} for name, arm in models.items()]


def list_text(models: Mapping[str, Arm]) -> str:
    """Return the arms as lines."""
    wide = max(map(len, models))
    return "\n".join(
        f"{name:{wide}}  reach {1e3 * reach(arm).radius_m:6.0f} mm  {arm.source}" for name, arm in models.items()
    )


def show_json(arm: Arm) -> dict[str, Any]:
    """Return an arm's table, limits and reach."""
    joints = [
        {
            "name": arm.joint_names[i],
            "a_m": arm.a[i],
            "d_m": arm.d[i],
            "alpha_rad": arm.alpha[i],
            "offset_rad": arm.offset[i],
            "direction": int(arm.direction[i]),
            "q_min_rad": arm.q_min[i],
            "q_max_rad": arm.q_max[i],
            "qd_max_rad_s": arm.qd_max[i],
            "qdd_max_rad_s2": arm.qdd_max[i],
            "qddd_max_rad_s3": arm.qddd_max[i],
            "home_rad": arm.home[i],
        }
        for i in range(arm.joints)
    ]
    return {
        "arm": arm.name,
        "convention": arm.convention,
        "joints": joints,
        "coupling": arm.coupling.tolist(),
        "T_base_0": arm.T_base_0.tolist(),
        "T_flange_tool": arm.T_flange_tool.tolist(),
        "T_base_tool_home": arm.forward(arm.home).tolist(),
        "reach_m": reach(arm)._asdict(),
        "source": arm.source,
    }


def show_text(arm: Arm) -> str:
    """Return an arm's table, limits and reach as a table and lines."""
    deg = np.degrees
    head = ("joint", "a mm", "d mm", "alpha", "offset", "dir", "from", "to", "speed", "accel.", "jerk", "home")
    rows = [
        (
            arm.joint_names[i],
            *(f"{1e3 * x:.3f}" for x in (arm.a[i], arm.d[i])),
            *(_short(deg(x)) for x in (arm.alpha[i], arm.offset[i])),
            f"{arm.direction[i]:+.0f}",
            *(_short(deg(x)) for x in (arm.q_min[i], arm.q_max[i], arm.qd_max[i], arm.qdd_max[i], arm.qddd_max[i])),
            _short(deg(arm.home[i])),
        )
        for i in range(arm.joints)
    ]
    extent = reach(arm)
    lines = [f"{arm.name}: {arm.convention} Denavit-Hartenberg table; angles in deg, speeds in deg/s, deg/s^2, deg/s^3"]
    lines += aligned((head, *rows))
    for name, T in (("T_base_0", arm.T_base_0), ("T_flange_tool", arm.T_flange_tool)):
        if not np.array_equal(T, np.eye(4)):
            lines.append(f"{name}: {_pose_text(T)}")
    lines += _coupling(arm)
    lines.append(f"tool at home: {_pose_text(arm.forward(arm.home))}")
    lines.append(
        f"reach of the tool: {1e3 * extent.radius_m:.1f} mm from joint 1's axis, from {1e3 * extent.low_m:.1f} to "
        f"{1e3 * extent.high_m:.1f} mm along it"
    )
    return "\n".join([*lines, f"source: {arm.source}"])


def _coupling(arm: Arm) -> list[str]:
    """Return which joints more than one motor moves, as lines."""
    lines = []
    for name, row, one in zip(arm.joint_names, arm.coupling, np.eye(arm.joints), strict=True):
        if (row != one).any():
            parts = [f"{factor:+g} {other}" for factor, other in zip(row, arm.joint_names, strict=True) if factor]
            lines.append(f"coupling: the angle of {name} is that of the motors {' '.join(parts)}")
    return lines


def forward_json(arm: Arm, q: Array, T: Array) -> dict[str, Any]:
    """Return the pose T (4, 4) of the tool in the base at joint angles (n,), rad."""
    return {"arm": arm.name, **_angles_json(q), "within_limits": bool(arm.within_limits(q)), **_pose_json(T)}


def forward_text(T: Array) -> str:
    """Return the pose T (4, 4) of the tool in the base as lines."""
    return "\n".join([f"tool at {_pose_text(T)}", "T_base_tool, m:", *_matrix(T)])


def jacobian_json(arm: Arm, q: Array) -> dict[str, Any]:
    """Return the Jacobian in base axes at joint angles (n,), rad."""
    return {
        "arm": arm.name,
        **_angles_json(q),
        "within_limits": bool(arm.within_limits(q)),
        "J_base": arm.jacobian(q).tolist(),
        "manipulability": float(arm.manipulability(q)),
    }


def jacobian_text(arm: Arm, q: Array) -> str:
    """Return the Jacobian in base axes at joint angles (n,), rad, as lines."""
    lines = ["J_base: m/s and rad/s of the tool, base axes, for 1 rad/s of each joint", *_matrix(arm.jacobian(q))]
    return "\n".join([*lines, f"manipulability: {float(arm.manipulability(q)):.6g} (0 is singular)"])


def inverse_json(arm: Arm, T_base_tool: Array, found: Solutions) -> dict[str, Any]:
    """Return the inverse solutions of a pose (4, 4), or why there is none."""
    solutions = [
        {
            "configuration": None if configuration is None else dataclasses.asdict(configuration),
            **_angles_json(found.q[i]),
            "within_limits": bool(found.within_limits[i]),
            "outside": beyond(arm, found.q[i]),
            "singular": bool(found.singular[i]),
            "residual_m": float(found.residual_m[i]),
            "residual_rad": float(found.residual_rad[i]),
        }
        for i, configuration in enumerate(found.configurations)
    ]
    nearest = None
    if found.nearest is not None:
        off = {"off_m": found.nearest.off_m, "off_rad": found.nearest.off_rad}
        nearest = {**_angles_json(found.nearest.q), **_pose_json(found.nearest.T_base_tool), **off}
    return {
        "arm": arm.name,
        **_pose_json(T_base_tool),
        "reachable": bool(found.within_limits.any()),
        "reason": found.reason,
        "solutions": solutions,
        "nearest": nearest,
    }


def inverse_text(arm: Arm, T_base_tool: Array, found: Solutions) -> str:
    """Return the inverse solutions of a pose (4, 4) as a table and lines."""
    lines = [f"{arm.name}: tool at {_pose_text(T_base_tool)}"]
    rows = [
        (
            f"{i + 1}",
            *(_fixed(angle) for angle in np.degrees(found.q[i])),
            "-" if configuration is None else " ".join(dataclasses.asdict(configuration).values()),
            _remark(arm, found.q[i], singular=bool(found.singular[i])),
        )
        for i, configuration in enumerate(found.configurations)
    ]
    if rows:
        lines += aligned((("", *(f"q{i + 1}" for i in range(arm.joints)), "configuration", ""), *rows))
    if found.reason is not None:
        lines.append(found.reason)
    if (nearest := found.nearest) is not None:
        lines.append(f"nearest pose within limits: {_pose_text(nearest.T_base_tool)}")
        lines.append(
            f"  {1e3 * nearest.off_m:.3f} mm and {np.degrees(nearest.off_rad):.3f} deg away, at q "
            + " ".join(_fixed(angle) for angle in np.degrees(nearest.q))
        )
    return "\n".join(lines)


def difference_json(nominal: Arm, arm: Arm, found: Difference) -> dict[str, Any]:
    """Return how far an arm puts its tool from where the nominal one does, and the changes of its table."""
    changes = {name: getattr(found, name) for name in ("a_m", "d_m", "alpha_rad", "offset_rad")}
    return {
        "nominal": nominal.name,
        "arm": arm.name,
        "tool_apart_mean_m": found.mean_m,
        "tool_apart_max_m": found.most_m,
        "tool_rotated_mean_rad": found.mean_rad,
        "tool_rotated_max_rad": found.most_rad,
        "changes": json_of(changes),
    }


def difference_text(nominal: Arm, arm: Arm, found: Difference) -> str:
    """Return the same as lines."""
    rows = [
        (
            nominal.joint_names[i],
            *(_change(1e3 * x) for x in (found.a_m[i], found.d_m[i])),
            *(_change(np.degrees(x)) for x in (found.alpha_rad[i], found.offset_rad[i])),
        )
        for i in range(nominal.joints)
    ]
    lines = [
        f"{arm.name} puts its tool {1e3 * found.mean_m:.3f} mm from {nominal.name} on the mean, "
        f"{1e3 * found.most_m:.3f} mm at most, rotated by {np.degrees(found.mean_rad):.3f} deg on the mean, "
        f"{np.degrees(found.most_rad):.3f} deg at most",
        "(the same joint angles and base; poses all over the joint limits)",
        *aligned((("changes", "a mm", "d mm", "alpha deg", "offset deg"), *rows)),
    ]
    if np.isnan(found.a_m).any():
        lines.append("-: axes that were parallel no longer are, or another convention: these rows cannot be compared")
    return "\n".join(lines)


def _change(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:+.4f}"


def beyond(arm: Arm, q: Array) -> list[str]:
    """Return which of the joint angles (n,), rad, are beyond the arm's limits, as text."""
    return [
        f"{arm.joint_names[i]} at {np.degrees(q[i]):.3f} deg is outside its limits "
        f"{np.degrees(arm.q_min[i]):.3f} to {np.degrees(arm.q_max[i]):.3f} deg"
        for i in range(arm.joints)
        if not arm.q_min[i] <= q[i] <= arm.q_max[i]
    ]


def _angles_json(q: Array) -> dict[str, Any]:
    return {"q_deg": np.degrees(q).tolist(), "q_rad": q.tolist()}


def _pose_json(T: Array) -> dict[str, Any]:
    """Return a pose: the matrix, and mm and degrees."""
    angles, singular = euler_zyx(T[:3, :3])
    return {
        "T_base_tool": T.tolist(),
        "position_mm": (1e3 * T[:3, 3]).tolist(),
        "euler_zyx_deg": np.degrees(angles).tolist(),
        "pitch_singular": singular,
    }


def _pose_text(T: Array) -> str:
    """Return a pose as text: position and Euler angles."""
    angles, singular = euler_zyx(T[:3, :3])
    xyz, zyx = (", ".join(map(_fixed, values)) for values in (1e3 * T[:3, 3], np.degrees(angles)))
    note = " (singular: of the angles about z and x only both together are determined)" if singular else ""
    return f"({xyz}) mm, euler zyx ({zyx}) deg{note}"


def _remark(arm: Arm, q: Array, *, singular: bool) -> str:
    """Return what is special about a solution."""
    if outside := beyond(arm, q):
        return "outside limits: " + " ".join(text.split(" at ")[0] for text in outside)
    return "singular" if singular else ""


def _fixed(value: float) -> str:
    """Return a number with three decimals, and no minus before a zero."""
    return f"{round(float(value), 3) + 0.0:.3f}"


def _matrix(values: Array) -> list[str]:
    """Return a matrix as lines."""
    return ["  " + " ".join(f"{v + 0.0:11.6f}" for v in row) for row in np.round(values, 9)]


def _short(value: float) -> str:
    """Return a number with at most three decimals."""
    return f"{round(float(value), 3) + 0.0:.10g}"
