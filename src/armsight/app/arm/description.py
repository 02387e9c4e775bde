"""What ``armsight arm`` says, as JSON objects and as text: mm and degrees for people, units in the keys of JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import euler_zyx
from armsight.robot.arm import Arm
from armsight.robot.reach import reach

Facts = dict[str, Any]


def listed(models: Mapping[str, Arm]) -> list[Facts]:
    """Return each arm's name, reach and source."""
    return [{"model": name, "radius_m": reach(arm).radius_m, "source": arm.source} for name, arm in models.items()]


def list_text(models: Mapping[str, Arm]) -> str:
    """Return the arms as lines."""
    wide = max(map(len, models))
    return "\n".join(f"{f['model']:{wide}}  reach {1e3 * f['radius_m']:6.0f} mm  {f['source']}" for f in listed(models))


def shown(arm: Arm) -> Facts:
    """Return an arm's numbers."""
    extent = reach(arm)
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
        for i in range(6)
    ]
    return {
        "model": arm.name,
        "convention": arm.convention,
        "joints": joints,
        "T_base_0": arm.T_base_0.tolist(),
        "T_flange_tool": arm.T_flange_tool.tolist(),
        "T_base_tool_home": arm.forward(arm.home).tolist(),
        "reach_m": extent._asdict(),
        "source": arm.source,
    }


def show_text(arm: Arm, facts: Facts) -> str:
    """Return an arm's numbers as a table and lines."""
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
        for i in range(6)
    ]
    extent = {key: 1e3 * value for key, value in facts["reach_m"].items()}
    lines = [f"{arm.name}: {arm.convention} Denavit-Hartenberg table; angles in deg, speeds in deg/s, deg/s^2, deg/s^3"]
    lines += _table((head, *rows))
    for name, T in (("T_base_0", arm.T_base_0), ("T_flange_tool", arm.T_flange_tool)):
        if not np.array_equal(T, np.eye(4)):
            lines.append(f"{name}: {_where(T)}")
    lines.append(f"tool at home: {_where(arm.forward(arm.home))}")
    lines.append(
        f"reach of the tool: {extent['radius_m']:.1f} mm from joint 1's axis, from {extent['low_m']:.1f} to "
        f"{extent['high_m']:.1f} mm along it"
    )
    return "\n".join([*lines, f"source: {arm.source}"])


def forward(arm: Arm, q: Array) -> Facts:
    """Return where the tool is at joint angles (6,)."""
    T = arm.forward(q)
    return {"model": arm.name, **_angles(q), "within_limits": bool(arm.within_limits(q)), **_pose(T)}


def forward_text(facts: Facts) -> str:
    """Return where the tool is as lines."""
    T = np.array(facts["T_base_tool"])
    return "\n".join([f"tool at {_where(T)}", "T_base_tool, m:", *_matrix(T)])


def jacobian(arm: Arm, q: Array) -> Facts:
    """Return the Jacobian in base axes at joint angles (6,)."""
    return {
        "model": arm.name,
        **_angles(q),
        "within_limits": bool(arm.within_limits(q)),
        "J_base": arm.jacobian(q).tolist(),
        "manipulability": float(arm.manipulability(q)),
    }


def jacobian_text(facts: Facts) -> str:
    """Return the Jacobian as lines."""
    lines = [
        "J_base: m/s and rad/s of the tool, base axes, for 1 rad/s of each joint",
        *_matrix(np.array(facts["J_base"])),
    ]
    return "\n".join([*lines, f"manipulability: {facts['manipulability']:.6g} (0 is singular)"])


def inverse(arm: Arm, T_base_tool: Array) -> Facts:
    """Return every set of joint angles that brings the tool to a pose (4, 4), or why there is none."""
    found = arm.inverse(T_base_tool)
    solutions = [
        {
            "configuration": None if configuration is None else dataclasses.asdict(configuration),
            **_angles(found.q[i]),
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
        nearest = {**_angles(found.nearest.q), **_pose(found.nearest.T_base_tool), **off}
    return {
        "model": arm.name,
        **_pose(T_base_tool),
        "reachable": bool(found.within_limits.any()),
        "reason": found.reason,
        "solutions": solutions,
        "nearest": nearest,
    }


def inverse_text(facts: Facts) -> str:
    """Return the joint angles of a pose as a table and lines."""
    lines = [f"{facts['model']}: tool at {_where(np.array(facts['T_base_tool']))}"]
    if facts["solutions"]:
        head = ("", *(f"q{i}" for i in range(1, 7)), "configuration", "")
        rows = [
            (
                f"{number}",
                *map(_fixed, solution["q_deg"]),
                " ".join((solution["configuration"] or {"": "-"}).values()),
                _remark(solution),
            )
            for number, solution in enumerate(facts["solutions"], start=1)
        ]
        lines += _table((head, *rows))
    if facts["reason"] is not None:
        lines.append(facts["reason"])
    if (nearest := facts["nearest"]) is not None:
        lines.append(f"nearest pose within limits: {_where(np.array(nearest['T_base_tool']))}")
        lines.append(
            f"  {1e3 * nearest['off_m']:.3f} mm and {np.degrees(nearest['off_rad']):.3f} deg away, at q "
            + " ".join(map(_fixed, nearest["q_deg"]))
        )
    return "\n".join(lines)


def beyond(arm: Arm, q: Array) -> list[str]:
    """Return which of the joint angles (6,) are beyond the arm's limits, in words."""
    return [
        f"{arm.joint_names[i]} at {np.degrees(q[i]):.3f} deg is outside its limits "
        f"{np.degrees(arm.q_min[i]):.3f} to {np.degrees(arm.q_max[i]):.3f} deg"
        for i in range(6)
        if not arm.q_min[i] <= q[i] <= arm.q_max[i]
    ]


def _angles(q: Array) -> Facts:
    return {"q_deg": np.degrees(q).tolist(), "q_rad": q.tolist()}


def _pose(T: Array) -> Facts:
    """Return a pose: the matrix, and mm and degrees."""
    angles, singular = euler_zyx(T[:3, :3])
    return {
        "T_base_tool": T.tolist(),
        "position_mm": (1e3 * T[:3, 3]).tolist(),
        "roll_pitch_yaw_deg": np.degrees(angles).tolist(),
        "pitch_singular": singular,
    }


def _where(T: Array) -> str:
    """Return a pose in words."""
    angles, singular = euler_zyx(T[:3, :3])
    xyz, rpy = (", ".join(map(_fixed, values)) for values in (1e3 * T[:3, 3], np.degrees(angles)))
    note = " (pitch singular: only roll and yaw together are determined)" if singular else ""
    return f"({xyz}) mm, roll pitch yaw ({rpy}) deg{note}"


def _remark(solution: Facts) -> str:
    """Return what is special about a solution."""
    if solution["outside"]:
        return "outside limits: " + " ".join(text.split(" at ")[0] for text in solution["outside"])
    return "singular" if solution["singular"] else ""


def _fixed(value: float) -> str:
    """Return a number with three decimals, and no minus before a zero."""
    return f"{round(float(value), 3) + 0.0:.3f}"


def _matrix(values: Array) -> list[str]:
    """Return a matrix as lines."""
    return ["  " + " ".join(f"{v + 0.0:11.6f}" for v in row) for row in np.round(values, 9)]


def _short(value: float) -> str:
    """Return a number with at most three decimals."""
    return f"{round(float(value), 3) + 0.0:.10g}"


def _table(rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Return rows of cells as lines with aligned columns, the first to the left."""
    cells = list(rows)
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))])
        for row in cells
    ]
