"""An identified arm in use: the pose of its tool at given joint readings, and the readings that reach a given pose.

Also the arm for other programs: an :class:`Arm` with the corrected table, and a URDF with Hayati's angles in its origins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import nearest_rotation
from armsight.loop.identify import model as chain
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.model import Model
from armsight.robot.arm import Arm
from armsight.robot.arm_file import tilted_urdf

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
