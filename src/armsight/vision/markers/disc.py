"""Plain discs: which a body carries, and where one image shows discs.

Discs carry no code. A camera alone says only where discs are; which of the body's discs each one is, both cameras and
the body's geometry say together (:mod:`~armsight.vision.identify`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Discs, Record
from armsight.vision.markers.body_check import check_discs
from armsight.vision.markers.body_file import Marker


@dataclass(frozen=True, eq=False)
class DiscTarget(Record):
    """The discs of a body.

    Attributes:
        body: their centres; their names.
        radii_m: (M,) radii, m.
        bright: (M,) whether a disc is brighter than what surrounds it.
        normals: (M, 3) unit vectors out of the discs' faces, body frame; NaN where the body file does not say.
    """

    body: Body
    radii_m: Array
    bright: NDArray[np.bool_]
    normals: Array

    @staticmethod
    def from_markers(name: str, markers: Sequence[Marker]) -> DiscTarget:
        """Make the target of a body file's discs: ``disc = { radius_mm = 8.0, bright = true }``.

        Raises:
            InputError: an unknown or missing key, a radius that is none; the message names file and entry.
        """
        radii, bright, normals = [], [], []
        for marker in markers:
            marker.check_keys("disc", ("radius_mm",), ("bright",))
            radii.append(marker.length_m("radius_mm"))
            kind = marker.fields.get("bright", True)
            if not isinstance(kind, bool):
                raise marker.error(f"bright must be true or false, got {kind!r}")
            bright.append(kind)
            normal = marker.normal()
            normals.append(np.full(3, np.nan) if normal is None else normal)
        check_discs(markers, radii)
        body = Body(name, tuple(m.name for m in markers), np.array([m.position for m in markers]))
        return DiscTarget(body, np.array(radii), np.array(bright), np.array(normals))

    def find(self, image: NDArray[np.uint8]) -> Discs:
        """Find the discs of either kind that the body has in one grey image (H, W)."""
        raise NotImplementedError
