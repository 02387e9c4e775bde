"""Bodies that carry AprilTag or ArUco markers; each marker gives its four corners.

A marker's own frame has its origin in the middle, x to the right and y down as one looks at it upright, and z into it.
Its corners are named ``NAME.0`` to ``NAME.3``: upper left, upper right, lower right, lower left. OpenCV finds the
markers, :mod:`~armsight.vision.markers.square` fits their corners to a fraction of a pixel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Record
from armsight.geometry.pose import transform
from armsight.vision.markers.apriltag3 import LAYOUTS, negative_square
from armsight.vision.markers.aruco import cells, find_squares, tag_count, tag_family
from armsight.vision.markers.body_file import Marker
from armsight.vision.markers.marker import Target
from armsight.vision.markers.square import fit_square

#: A marker's corners in its own frame, in halves of its side.
CORNERS = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Tag(Record):
    """One marker on a body."""

    name: str  #: what its corners are named after
    family: str  #: a name of :data:`~armsight.vision.markers.aruco.FAMILIES`, or AprilTag 3's.
    identity: int  #: its number in the family
    size_m: float  #: side of its dark outline, of AprilTag 3's families that of the square where the rings meet, m
    T_body_tag: Array  #: (4, 4) its pose on the body, m


@dataclass(frozen=True, eq=False)
class TagTarget(Record, Target):
    """A body found by its square markers."""

    name: str
    tags: tuple[Tag, ...]

    @staticmethod
    def from_markers(name: str, markers: Sequence[Marker]) -> TagTarget:
        """Build the target from a body file's markers of kind ``tag``: ``{ family = "tag36h11", id = 3, size_mm = 40 }``.

        InputError: unknown family or id, a missing or unknown key, or one marker twice.
        """
        tags = []
        taken: dict[tuple[str, int], str] = {}
        for marker in markers:
            marker.check_keys("tag", required=("family", "id", "size_mm"))
            family = marker.converted("family", tag_family)
            identity = marker.fields["id"]
            if type(identity) is not int or not 0 <= identity < tag_count(family):
                raise marker.error(f"id {identity!r} is not in {family}; it has 0 to {tag_count(family) - 1}")
            if (family, identity) in taken:
                raise marker.error(f"{family} id {identity} is on marker {taken[family, identity]!r} already")
            taken[family, identity] = marker.name
            tags.append(Tag(marker.name, family, identity, marker.length_m("size_mm"), marker.pose()))
        return TagTarget(name, tuple(tags))

    @cached_property
    def body(self) -> Body:
        """The corners of all markers, four by four."""
        names = tuple(f"{tag.name}.{i}" for tag in self.tags for i in range(4))
        points = [transform(tag.T_body_tag, CORNERS * (tag.size_m / 2)) for tag in self.tags]
        return Body(self.name, names, np.concatenate(points))

    @cached_property
    def normals(self) -> Array:
        """(M, 3) unit vectors out of the face of each point, body frame."""
        return np.repeat([-tag.T_body_tag[:3, 2] for tag in self.tags], 4, axis=0)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the body in one grey image; a marker that is detected twice is left out: one of them is foreign."""
        ids, uv, cov, problems = [], [], [], []
        for family in sorted({tag.family for tag in self.tags}):
            found = find_squares(image, family, requested=[tag.identity for tag in self.tags if tag.family == family])
            seen = Counter(identity for identity, _ in found)
            corners = dict(found)
            for row, tag in enumerate(self.tags):
                if tag.family != family or tag.identity not in seen:
                    continue
                if seen[tag.identity] > 1:
                    problems.append(f"{tag.name} is seen {seen[tag.identity]} times")
                    continue
                if family in LAYOUTS:
                    fit = fit_square(255 - image, corners[tag.identity], negative_square(family, tag.identity))
                else:
                    fit = fit_square(image, corners[tag.identity], cells(family, tag.identity))
                if fit.problem is not None:
                    problems.append(f"{tag.name}: {fit.problem}")
                    continue
                ids.append(4 * row + np.arange(4))
                uv.append(fit.uv)
                cov.append(fit.cov_uv)
        if not ids:
            return Detections.none("no marker of the body found" + "".join(f"; {problem}" for problem in problems))
        order = np.argsort(np.concatenate(ids))
        return Detections(np.concatenate(ids)[order], np.concatenate(uv)[order], np.concatenate(cov)[order])
