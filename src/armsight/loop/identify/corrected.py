"""An identified arm as it is used: where its tool is at given readings, and which readings bring it somewhere.

Also what is written for others: the corrected table with its causes (TOML), a URDF with Hayati's angles in its origins,
and what the board has to add to its readings.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.identify import model as chain
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.model import Model
from armsight.robot.arm import Arm
from armsight.robot.urdf_write import urdf_text

#: Newton steps to a reading, and what counts as there, m and rad.
STEPS, THERE = 30, 1e-9


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
        """Return the corrected table without Hayati's angles and without causes, which :class:`Arm` does not know."""
        table = self.model.table(self.x)
        return replace(
            self.model.arm,
            name=f"{self.model.arm.name}_identified",
            offset=table[:, chain.OFFSET],
            d=table[:, chain.D],
            a=table[:, chain.A],
            alpha=table[:, chain.ALPHA],
            T_flange_tool=_square(self.model.T_6_body(self.x)),
            source=f"identified from measurements; nominal: {self.model.arm.source}",
        )

    def urdf(self) -> str:
        """Return URDF text with everything that a URDF can hold: the table with Hayati's angles, base and tool."""
        return tilted_urdf(self.arm(), self.model.table(self.x)[:, chain.BETA])


def tilted_urdf(arm: Arm, beta: Array) -> str:
    """Return an arm with Hayati's angles (6,), rad, after its rows as URDF text, exactly."""
    robot = ET.fromstring(urdf_text(arm))
    modified = arm.convention == "modified"
    for i in range(6):
        place = i if modified else i + 1  # the origin that holds row i's angles
        if beta[i] == 0.0:
            continue
        origin = robot.findall("joint")[place].find("origin")
        if origin is None:
            raise InputError(f"{arm.name}: a URDF joint has no origin")
        before = Rotation.from_euler("xyz", [float(word) for word in origin.get("rpy", "").split()])
        turned = (before * Rotation.from_euler("y", beta[i])).as_euler("xyz")
        origin.set("rpy", " ".join(repr(float(angle)) for angle in turned))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _square(T: Array) -> Array:
    """Return a transform whose rotation is orthonormal to the last digit."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = U @ Vt
    return out
