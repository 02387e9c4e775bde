"""Read corrected.toml, as an identification writes it: the table with Hayati's angles becomes an arm's own table, exactly.

The causes beyond the table (gains, waves, play, sag) are not an arm's table's: the board and
:class:`~armsight.loop.identify.corrected.Corrected` have them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import from_quaternion_wxyz
from armsight.loop.identify import chain
from armsight.loop.identify.corrected import tilted_urdf
from armsight.loop.identify.toml_write import LIMITS
from armsight.robot.arm import Arm
from armsight.robot.urdf import parse_urdf


def identified_arm(path: str | Path, given: dict[str, Any]) -> Arm:
    """Return the arm of a parsed corrected.toml; its tool is the body that was seen.

    Raises:
        InputError: something is missing, or no number; the message names it.
    """
    rows = given.get("joint")
    if not isinstance(rows, list) or len(rows) != 6 or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: six [[joint]] tables are needed")
    lengths = (chain.D, chain.A)
    at = {
        column: _column(path, rows, f"{column}_{'m' if c in lengths else 'rad'}")
        for c, column in enumerate(chain.COLUMNS)
    }
    limits = {key: _column(path, rows, f"{key}_{unit}") for key, unit in LIMITS.items()}
    convention = given.get("convention")
    if convention not in ("standard", "modified"):
        raise InputError(f'{path}: convention = "standard" or "modified" is needed, got {convention!r}')
    arm = Arm(
        name=str(given.get("name", Path(path).stem)),
        a=at["a"],
        d=at["d"],
        alpha=at["alpha"],
        offset=at["offset"],
        direction=_column(path, rows, "direction"),
        convention="modified" if convention == "modified" else "standard",
        T_base_0=_transform(path, given, "T_base_0"),
        T_flange_tool=_transform(path, given, "T_flange_body"),
        joint_names=tuple(str(row.get("name", f"joint{i + 1}")) for i, row in enumerate(rows)),
        source=f"identified: {path}",
        **limits,
    )
    if not at["beta"].any():
        return arm
    return replace(parse_urdf(tilted_urdf(arm, at["beta"]), path), source=arm.source)


def _column(path: str | Path, rows: list[dict[str, Any]], key: str) -> Array:
    out = np.empty(6)
    for i, row in enumerate(rows):
        value = row.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InputError(f"{path}: joint {i + 1}: {key} is {value!r}, must be a number")
        out[i] = value
    return out


def _transform(path: str | Path, given: dict[str, Any], name: str) -> Array:
    """Read a position and a quaternion wxyz."""
    try:
        p, q = (np.array(given[name][key], float) for key in ("position_m", "quaternion_wxyz"))
    except (KeyError, TypeError, ValueError):
        p, q = np.zeros(0), np.zeros(0)
    if p.shape != (3,) or q.shape != (4,) or not np.isfinite([*p, *q]).all() or abs(np.linalg.norm(q) - 1) > 1e-6:
        raise InputError(
            f"{path}: {name} = {{ position_m = [3 numbers], quaternion_wxyz = [4, of length 1] }} is needed"
        )
    return pose(from_quaternion_wxyz(q / np.linalg.norm(q)), p)
