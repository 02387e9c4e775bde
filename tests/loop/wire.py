"""A small member of the family of references for its tests: a wire from an anchor to the tool's origin."""

from dataclasses import dataclass, replace

import numpy as np

from armsight.loop.references.reference import ExpectedReading, Reference


@dataclass(frozen=True, eq=False, kw_only=True)
class Wire(Reference):
    """The length of a wire to the tool's origin, and an offset; a last parameter that does nothing."""

    values: np.ndarray

    @property
    def channels(self):
        return ("length",)

    @property
    def parameters(self):
        return dict(zip(("x_m", "y_m", "z_m", "offset_m", "idle"), self.values, strict=True))

    def expected(self, motion, channel):
        way = motion.T_base_tool[:3, 3] - self.values[:3]
        u = way / np.linalg.norm(way)
        by_tool = np.concatenate([u @ motion.T_base_tool[:3, :3], np.zeros(3)])[None]
        return ExpectedReading(np.array([np.linalg.norm(way) + self.values[3]]), by_tool, np.array([[*-u, 1.0, 0.0]]))

    def moved(self, step):
        return replace(self, values=self.values + step)
