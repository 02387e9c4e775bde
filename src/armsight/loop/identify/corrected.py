"""An identified arm in use: the pose of its tool at given joint readings, and the readings that reach a given pose.

Also the arm for other programs: an :class:`Arm` with the corrected table, a URDF with Hayati's angles in its origins,
corrected.toml (:func:`table_text`, which :mod:`armsight.robot.arm_file` reads), and what the board adds to its readings
(:func:`zeros_text`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import nearest_rotation, quaternion_wxyz
from armsight.loop.identify import model as chain
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.model import Model
from armsight.robot.arm import Arm
from armsight.robot.arm_file import LIMITS, tilted_urdf

#: Newton steps to a reading, and what counts as there, m and rad.
STEPS, THERE = 30, 1e-9
#: Version of corrected.toml. Version 1, which said no version, had [[cause]] tables and other names of the kinds of
#: gravity.
VERSION = 2


@dataclass(frozen=True, eq=False)
class Corrected(Record):
    """An identified arm.

    Attributes:
        model: the nominal arm with every parameter.
        x: (P,) the vector.
    """

    model: Model
    x: Array

    @staticmethod
    def of(found: Identified) -> Corrected:
        """Return what was identified, ready for use."""
        return Corrected(found.model, found.solution.x)

    def forward(self, q: Array, approach: Array | None = None) -> Array:
        """Return T_base_body (N, 4, 4) at readings q (N, 6), rad; ``approach`` (N, 6) as in :class:`Measured`."""
        return self.model.tool_in_base(self.x, q, approach)

    def readings(self, T_base_body: Array, near: Array, approach: Array | None = None) -> Array | None:
        """Return the readings (6,), rad, at which the body is at a pose, nearest to ``near``; None out of reach.

        Args:
            T_base_body: (4, 4) where the body shall be.
            near: (6,) readings to start from.
            approach: (6,) from which sides the joints will come.
        """
        q, side = np.array(near, float), None if approach is None else approach[None]
        for _ in range(STEPS):
            T = self.forward(q[None], side)[0]
            e = log_se3(inverse(T) @ T_base_body)
            if np.abs(e).max() < THERE:
                return q
            step = np.linalg.lstsq(self._jacobian(q, side, T), e, rcond=1e-9)[0]
            q = q + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
        return None

    def _jacobian(self, q: Array, side: Array | None, T: Array) -> Array:
        """Return the derivative (6, 6) of the right tangent by the readings, by differences over 1e-6 rad."""
        h = 1e-6
        many = np.repeat(q[None], 6, axis=0) + h * np.eye(6)
        sides = None if side is None else np.repeat(side, 6, axis=0)
        return np.asarray(log_se3(inverse(T) @ self.forward(many, sides)).T / h)

    def arm(self) -> Arm:
        """Return the corrected table without Hayati's angles and error sources, for which :class:`Arm` has no room."""
        table, T_6_body = self.model.table(self.x), self.model.T_6_body(self.x)
        return replace(
            self.model.arm,
            name=f"{self.model.arm.name}_identified",
            offset=table[:, chain.OFFSET],
            d=table[:, chain.D],
            a=table[:, chain.A],
            alpha=table[:, chain.ALPHA],
            T_flange_tool=pose(nearest_rotation(T_6_body[:3, :3]), T_6_body[:3, 3]),
            source=f"identified from measurements; nominal: {self.model.arm.source}",
        )

    def urdf(self) -> str:
        """Return URDF text with everything that a URDF can hold: the table with Hayati's angles, base and tool."""
        return tilted_urdf(self.arm(), self.model.table(self.x)[:, chain.BETA])


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
