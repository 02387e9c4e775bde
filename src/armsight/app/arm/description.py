"""What ``armsight arm`` answers, as JSON objects (units in the keys) and as text (mm and degrees).

For each subcommand a function of the same name returns both, the object and the lines. Angles of a rotation are Euler
angles about z, y and x, in that sequence: R = Rz(euler_z) Ry(euler_y) Rx(euler_x); ROS calls euler_x roll.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
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

Shown = tuple[Any, list[str]]  # what is shown: an object, and lines


def _fixed(value: float) -> str:
    """Return a number with three decimals, and no minus before a zero."""
    return f"{round(float(value), 3) + 0.0:.3f}"


def _short(value: float) -> str:
    return f"{round(float(value), 3) + 0.0:.10g}"


def _deg(value: float) -> str:
    return _short(np.degrees(value))


def _mm(value: float) -> str:
    return f"{1e3 * value:.3f}"


#: Of a joint: its key in JSON, the array of the arm, the column's title (none: it is not shown), and how it is written.
_JOINT: tuple[tuple[str, str, str, Callable[[float], str]], ...] = (
    ("a_m", "a", "a mm", _mm),
    ("d_m", "d", "d mm", _mm),
    ("alpha_rad", "alpha", "alpha", _deg),
    ("offset_rad", "offset", "offset", _deg),
    ("direction", "direction", "dir", "{:+.0f}".format),
    ("q_min_rad", "q_min", "from", _deg),
    ("q_max_rad", "q_max", "to", _deg),
    ("qd_max_rad_s", "qd_max", "speed", _deg),
    ("qdd_max_rad_s2", "qdd_max", "accel.", _deg),
    ("qddd_max_rad_s3", "qddd_max", "jerk", _deg),
    ("home_rad", "home", "home", _deg),
)


def models(of: Mapping[str, Arm]) -> Shown:
    """Return each arm's name, reach and source."""
    wide, far = max(map(len, of)), {name: reach(arm).radius_m for name, arm in of.items()}
    lines = [f"{name:{wide}}  reach {1e3 * far[name]:6.0f} mm  {arm.source}" for name, arm in of.items()]
    return [{"arm": name, "radius_m": far[name], "source": arm.source} for name, arm in of.items()], lines


def show(arm: Arm) -> Shown:
    """Return an arm's table, limits and reach."""
    extent, home = reach(arm), arm.forward(arm.home)
    joints = [
        {"name": name, **{key: getattr(arm, array)[i] for key, array, *_ in _JOINT}, "direction": int(arm.direction[i])}
        for i, name in enumerate(arm.joint_names)
    ]
    rows = [
        (name, *(form(getattr(arm, array)[i]) for _, array, _, form in _JOINT))
        for i, name in enumerate(arm.joint_names)
    ]
    lines = [f"{arm.name}: {arm.convention} Denavit-Hartenberg table; angles in deg, speeds in deg/s, deg/s^2, deg/s^3"]
    lines += aligned((("joint", *(title for _, _, title, _ in _JOINT)), *rows))
    for name, T in (("T_base_0", arm.T_base_0), ("T_flange_tool", arm.T_flange_tool)):
        if not np.array_equal(T, np.eye(4)):
            lines.append(f"{name}: {_pose_text(T)}")
    for name, row, one in zip(arm.joint_names, arm.coupling, np.eye(arm.joints), strict=True):
        if (row != one).any():
            parts = [f"{factor:+g} {other}" for factor, other in zip(row, arm.joint_names, strict=True) if factor]
            lines.append(f"coupling: the angle of {name} is that of the motors {' '.join(parts)}")
    lines.append(f"tool at home: {_pose_text(home)}")
    far, low, high = 1e3 * extent.radius_m, 1e3 * extent.low_m, 1e3 * extent.high_m
    lines.append(f"reach of the tool: {far:.1f} mm from joint 1's axis, from {low:.1f} to {high:.1f} mm along it")
    found: dict[str, Any] = {"arm": arm.name, "convention": arm.convention, "joints": joints}
    found |= {name: getattr(arm, name) for name in ("coupling", "T_base_0", "T_flange_tool")}
    found |= {"T_base_tool_home": home, "reach_m": extent, "source": arm.source}
    return json_of(found), [*lines, f"source: {arm.source}"]


def forward(arm: Arm, q: Array, T: Array) -> Shown:
    """Return the pose T (4, 4) of the tool in the base at joint angles (n,), rad."""
    found = {"arm": arm.name, **_angles_json(q), "within_limits": bool(arm.within_limits(q)), **_pose_json(T)}
    return found, [f"tool at {_pose_text(T)}", "T_base_tool, m:", *_matrix(T)]


def jacobian(arm: Arm, q: Array) -> Shown:
    """Return the Jacobian in base axes at joint angles (n,), rad."""
    J, w = arm.jacobian(q), float(arm.manipulability(q))
    found = {"arm": arm.name, **_angles_json(q), "within_limits": bool(arm.within_limits(q))}
    lines = ["J_base: m/s and rad/s of the tool, base axes, for 1 rad/s of each joint", *_matrix(J)]
    return {**found, "J_base": J.tolist(), "manipulability": w}, [*lines, f"manipulability: {w:.6g} (0 is singular)"]


def inverse(arm: Arm, T_base_tool: Array, found: Solutions) -> Shown:
    """Return the inverse solutions of a pose (4, 4), or why there is none."""
    solutions, rows, lines = list[Any](), list[tuple[str, ...]](), [f"{arm.name}: tool at {_pose_text(T_base_tool)}"]
    for i, configuration in enumerate(found.configurations):
        kind, q = None if configuration is None else dataclasses.asdict(configuration), found.q[i]
        outside, singular = beyond(arm, q), bool(found.singular[i])
        off = {name: float(getattr(found, name)[i]) for name in ("residual_m", "residual_rad")}
        within = {"within_limits": bool(found.within_limits[i]), "outside": outside, "singular": singular}
        solutions.append({"configuration": kind, **_angles_json(q), **within, **off})
        remark = "outside limits: " + " ".join(text.split(" at ")[0] for text in outside) if outside else ""
        angles, names = map(_fixed, np.degrees(q)), "-" if kind is None else " ".join(kind.values())
        rows.append((f"{i + 1}", *angles, names, remark or "singular" * singular))
    if rows:
        lines += aligned((("", *(f"q{i + 1}" for i in range(arm.joints)), "configuration", ""), *rows))
    lines += [] if found.reason is None else [found.reason]
    nearest = None
    if (near := found.nearest) is not None:
        nearest = {**_angles_json(near.q), **_pose_json(near.T_base_tool), "off_m": near.off_m, "off_rad": near.off_rad}
        lines.append(f"nearest pose within limits: {_pose_text(near.T_base_tool)}")
        angle, q_deg = np.degrees(near.off_rad), " ".join(map(_fixed, np.degrees(near.q)))
        lines.append(f"  {1e3 * near.off_m:.3f} mm and {angle:.3f} deg away, at q {q_deg}")
    reachable, of = bool(found.within_limits.any()), {"arm": arm.name, **_pose_json(T_base_tool)}
    return {**of, "reachable": reachable, "reason": found.reason, "solutions": solutions, "nearest": nearest}, lines


def difference(nominal: Arm, arm: Arm, found: Difference, sigma_m: float | None) -> Shown:
    """Return how far an arm puts its tool from where the nominal one does, sigma of that, and the changes of its table."""
    changes = {name: getattr(found, name) for name in ("a_m", "d_m", "alpha_rad", "offset_rad")}
    scaled = np.stack([(1e3 if name.endswith("_m") else np.degrees(1.0)) * each for name, each in changes.items()], 1)
    rows = [
        (name, *("-" if np.isnan(value) else f"{value:+.4f}" for value in row))
        for name, row in zip(nominal.joint_names, scaled, strict=True)
    ]
    lines = [
        f"{arm.name} puts its tool {1e3 * found.mean_m:.3f} mm from {nominal.name} on the mean, "
        f"{1e3 * found.most_m:.3f} mm at most, rotated by {np.degrees(found.mean_rad):.3f} deg on the mean, "
        f"{np.degrees(found.most_rad):.3f} deg at most",
        "(the same joint angles and base; poses all over the joint limits"
        + (f"; sigma by the poses identified from: {1e3 * sigma_m:.3f} mm)" if sigma_m is not None else ")"),
        *aligned((("changes", "a mm", "d mm", "alpha deg", "offset deg"), *rows)),
    ]
    if np.isnan(found.a_m).any():
        lines.append("-: axes that were parallel no longer are, or another convention: these rows cannot be compared")
    values: dict[str, Any] = {"tool_apart_mean_m": found.mean_m, "tool_apart_max_m": found.most_m}
    values |= {"sigma_tool_apart_m": sigma_m}
    values |= {"tool_rotated_mean_rad": found.mean_rad, "tool_rotated_max_rad": found.most_rad}
    return {"nominal": nominal.name, "arm": arm.name, **values, "changes": json_of(changes)}, lines


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
    angles, singular = euler_zyx(T[:3, :3])
    found = {"T_base_tool": T.tolist(), "position_mm": (1e3 * T[:3, 3]).tolist()}
    return {**found, "euler_zyx_deg": np.degrees(angles).tolist(), "pitch_singular": singular}


def _pose_text(T: Array) -> str:
    angles, singular = euler_zyx(T[:3, :3])
    xyz, zyx = (", ".join(map(_fixed, values)) for values in (1e3 * T[:3, 3], np.degrees(angles)))
    note = " (singular: of the angles about z and x only both together are determined)" if singular else ""
    return f"({xyz}) mm, euler zyx ({zyx}) deg{note}"


def _matrix(values: Array) -> list[str]:
    return ["  " + " ".join(f"{v + 0.0:11.6f}" for v in row) for row in np.round(values, 9)]
