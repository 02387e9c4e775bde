"""Write an identified arm as TOML: the corrected table, and what the board has to add to its readings."""

from __future__ import annotations

import json

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import quaternion_wxyz
from armsight.loop.identify import model as chain
from armsight.loop.identify.identify import Identified
from armsight.robot.arm_file import LIMITS

#: Of the file. Version 1, which said no version, had [[cause]] tables and other names of the kinds of gravity.
VERSION = 2


def table_text(found: Identified) -> str:
    """Return the corrected arm as TOML, m and rad; every value with its sigma."""
    model, x = found.model, found.solution.x
    table, sigma = model.table(x), np.sqrt(np.diag(found.cov))[model.table_at : model.sources_at].reshape(6, 5)
    lines = [
        f"name = {_quoted(model.arm.name)}",
        f"convention = {_quoted(model.arm.convention)}",
        "identified = true",
        f"version = {VERSION}",
        "# theta = direction (q + error sources) + offset; beta is Hayati's angle, a rotation about y after alpha",
        *_transform("T_rig_base", model.T_rig_base(x)),
        *_transform("T_base_0", model.arm.T_base_0),
        *_transform("T_flange_body", model.T_6_body(x)),
    ]
    for i, name in enumerate(model.arm.joint_names):
        lines += ["", "[[joint]]", f"name = {_quoted(name)}", f"direction = {model.arm.direction[i]:.0f}"]
        for c, column in enumerate(chain.COLUMNS):
            unit = "m" if c in (chain.D, chain.A) else "rad"
            lines.append(f"{column}_{unit} = {float(table[i, c])!r}")
            lines.append(f"sigma_{column}_{unit} = {float(sigma[i, c])!r}")
        for key, unit in LIMITS.items():
            lines.append(f"{key}_{unit} = {float(getattr(model.arm, key)[i])!r}")
    for k, feature in enumerate(model.features):
        at = model.sources_at + k
        if found.solution.free[at]:
            lines += ["", "[[error_source]]", f"name = {_quoted(feature.name)}", f"kind = {_quoted(feature.kind)}"]
            lines += [f"joint = {feature.joint + 1}", f"unit = {_quoted(feature.unit)}"]
            lines += [f"value = {float(x[at])!r}", f"sigma = {float(np.sqrt(found.cov[at, at]))!r}"]
    return "\n".join(lines) + "\n"


def zeros_text(found: Identified) -> str:
    """Return what the board adds to the angle that it reads from each potentiometer, as TOML."""
    model = found.model
    lines = [
        "# angle = (1 + gain) reading + zero + sin1 sin(reading) + cos1 cos(reading) + sin2 sin(2 reading) + ..;",
        "# zero: to be added to every node of the joint's potentiometer table. Backlash and compliance stay uncorrected.",
    ]
    nominal = model.table(model.nominal())
    for i, name in enumerate(model.arm.joint_names):
        zero = float((model.table(found.solution.x) - nominal)[i, chain.OFFSET] * model.arm.direction[i])
        sigma = found.value(f"offset{i + 1}")[1]
        lines += [
            "",
            "[[joint]]",
            f"name = {_quoted(name)}",
            f"zero_rad = {zero!r}",
            f"zero_deg = {np.degrees(zero):.5f}",
        ]
        lines.append(f"sigma_zero_rad = {sigma!r}")
        for f in model.features:
            if f.joint == i and f.kind in ("gain", "wave", "ripple") and found.value(f.name)[0] != 0.0:
                key = "gain" if f.kind == "gain" else f"{f.name.split('_')[1]}_rad"
                lines.append(f"{key} = {found.value(f.name)[0]!r}")
    return "\n".join(lines) + "\n"


def _transform(name: str, T: Array) -> list[str]:
    """Return a pose as position and quaternion wxyz."""
    position = ", ".join(repr(float(v)) for v in T[:3, 3])
    quaternion = ", ".join(repr(float(v)) for v in quaternion_wxyz(T[:3, :3]))
    return [f"{name} = {{ position_m = [{position}], quaternion_wxyz = [{quaternion}] }}"]


def _quoted(text: str) -> str:
    """Return a basic string of TOML: JSON's escapes, but every character above ASCII as itself."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
