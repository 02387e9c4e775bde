"""The contract of a marker family: an image goes in, the pixel positions of a body's points come out.

To add a family: write one file with a class that fulfils :class:`Target`, and add one line to the registry in
``targets.py``. The laws in tests/vision/markers are parametrised over that registry, so the new member inherits them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from armsight.data import Body, Detections, Ids, Image
from armsight.vision.markers.discs import DiscTarget


class Target(Protocol):
    """A rigid body that can be found in an image.

    Derive from this class to inherit the two defaults: no symmetries, no discs.
    """

    @property
    def body(self) -> Body:
        """The points that can be found and their positions, m, body frame."""

    @property
    def symmetries(self) -> tuple[Ids, ...]:
        """Permutations (M,) of the points under which the body looks the same, without identity: i may be perm[i].

        ``perm[ids]`` renames detections. One image cannot resolve the ambiguity; the left and the right image of a pair
        together can.
        """
        return ()

    @property
    def disc_radius_m(self) -> float | None:
        """Radius of the discs of a board of discs, m, if it is known; None for everything else."""
        return None

    @property
    def discs(self) -> DiscTarget | None:
        """Its plain discs, which carry no code and whose points come last in ``body``; None where it has none."""
        return None

    def detect(self, image: Image) -> Detections:
        """Find the coded points of the body in one grey image; discs are identified by both cameras together.

        ``image``: (H, W) uint8. Returns the points found: rows of ``body.points``, raw pixels ((0, 0) is the centre of the
        top-left pixel), and the covariance that the image itself supports. Nothing found is ``Detections.none(reason)``,
        never an exception.
        """


def detect_parts(image: Image, parts: Iterable[tuple[str, Target]], nothing: str = "") -> Detections:
    """Find the parts of a body in one grey image (H, W) whose points follow one another in the body.

    Each of ``parts`` is what the reason begins with if it is not found, and the part; ``nothing`` is the reason without
    parts.
    """
    first, found, problems = 0, list[Detections](), list[str]()
    for name, part in parts:
        seen = part.detect(image)
        if seen.problem is None:
            found.append(Detections(seen.ids + first, seen.uv, seen.cov_uv, common=seen.common))
        else:
            problems.append(f"{name}{seen.problem}")
        first += len(part.body.points)
    if not found:
        return Detections.none("; ".join(problems) or nothing)
    ids, uv, cov = (np.concatenate([getattr(seen, key) for seen in found]) for key in ("ids", "uv", "cov_uv"))
    return Detections(ids, uv, cov, common=max((seen.common for seen in found), key=np.linalg.norm))


class CalibrationBoard(Target, Protocol):
    """A flat target whose points lie in z = 0, the first at the origin, x along the columns; m, board frame.

    ``symmetries`` is empty for a board that shows which way up it is.
    """

    @property
    def y_up(self) -> bool:
        """Whether y runs up and z points out of its face, as on Kalibr's boards; else they run down and into it."""
        return False

    @property
    def codes(self) -> tuple[str, range]:
        """The family of its tags, and their ids; "" and none where it has no tags."""
        return "", range(0)
