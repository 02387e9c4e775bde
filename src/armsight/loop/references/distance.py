"""Distances between a point of the tool and fixed anchors: draw-wire, bar, laser, ultrasonic or ultra-wideband range.

A channel is an anchor: z = scale |p - a| + offset, m. Parameters: the tool's point, then for each anchor its position, offset
and scale. Anchors nearly in one plane leave their mirror image open, :func:`fold_sigmas` gives by how much (Moore et al.,
"Robust distributed network localization with noisy range measurements", SenSys 2004: no position from a layout whose flip
noise can produce).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import skew
from armsight.loop.references.reference import ExpectedReading, Reference, ToolMotion

EACH = ("x_m", "y_m", "z_m", "offset_m", "scale")  # parameters of an anchor


@dataclass(frozen=True, eq=False, kw_only=True)
class Distance(Reference):
    """A ranging sensor with its anchors.

    Attributes:
        anchors: (A, 3) their positions in the base, m.
        p_tool: (3,) the point that is measured, tool, m.
        offset: (A,) what each range reads beyond the scaled distance, m.
        scale: (A,) of each range, 1 where it is right.
        names: of the anchors; empty: 1, 2, ...
    """

    anchors: Array
    p_tool: Array
    offset: Array
    scale: Array
    names: tuple[str, ...] = ()

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the anchors."""
        return self.names or tuple(str(k + 1) for k in range(len(self.anchors)))

    @property
    def parameters(self) -> dict[str, float]:
        """Tool point, then each anchor's position, offset and scale."""
        out = {f"tool_{axis}_m": float(v) for axis, v in zip("xyz", self.p_tool, strict=True)}
        for name, a, b, s in zip(self.channels, self.anchors, self.offset, self.scale, strict=True):
            out |= {f"{name}_{key}": float(v) for key, v in zip(EACH, (*a, b, s), strict=True)}
        return out

    def expected(self, motion: ToolMotion, channel: int) -> ExpectedReading:
        """Return the range to an anchor."""
        T = motion.T_base_tool
        apart = T[:3, 3] + T[:3, :3] @ self.p_tool - self.anchors[channel]
        far = float(np.linalg.norm(apart))
        u, scale = apart / far, self.scale[channel]
        in_tool = scale * u @ T[:3, :3]
        by = np.zeros(3 + len(EACH) * len(self.anchors))
        by[:3] = in_tool
        by[3 + len(EACH) * channel : 3 + len(EACH) * (channel + 1)] = [*(-scale * u), 1.0, far]
        by_tool = np.concatenate([in_tool, -in_tool @ skew(self.p_tool)])
        return ExpectedReading(np.array([scale * far + self.offset[channel]]), by_tool[None], by[None])

    def moved(self, step: Array) -> Self:
        """Return it with its parameters moved."""
        each = step[3:].reshape(-1, len(EACH))
        return replace(
            self,
            p_tool=self.p_tool + step[:3],
            anchors=self.anchors + each[:, :3],
            offset=self.offset + each[:, 3],
            scale=self.scale + each[:, 4],
        )


def fold_sigmas(anchors: Array, p: Array, sigma_m: float) -> Array:
    """Return by how many sigmas ranges distinguish positions from their mirror images about the anchors' best plane.

    Args:
        anchors: (A, 3) positions, m.
        p: (N, 3) positions, m.
        sigma_m: of a range, m.

    Returns:
        (N,) Mahalanobis distances; below 3 or so the position may be the mirror image, whatever the fit says.
    """
    centre = anchors.mean(axis=0)
    normal = np.linalg.svd(anchors - centre)[2][2]
    mirrored = p - 2 * ((p - centre) @ normal)[:, None] * normal
    far, image = (np.linalg.norm(x[:, None] - anchors, axis=2) for x in (p, mirrored))
    return np.asarray(np.linalg.norm(far - image, axis=1) / sigma_m)
