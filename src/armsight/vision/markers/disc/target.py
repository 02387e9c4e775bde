"""Plain discs: which a body carries, and where one image shows discs.

Discs carry no code. A camera alone says only where discs are; which of the body's discs each one is, both cameras and
the body's geometry say together (:mod:`~armsight.vision.discs.identify`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Discs, Record, Rejected
from armsight.vision.markers.body_check import check_discs
from armsight.vision.markers.body_file import Marker
from armsight.vision.markers.disc import fit as disc_fit
from armsight.vision.markers.disc import fit as disc_model
from armsight.vision.markers.disc import search as disc_outline
from armsight.vision.markers.disc import search as disc_search

#: Most rejected places of an image that are told.
MOST_REPORTED = 100
#: Most places looked at in an image.
_MOST_PLACES, _NEVER = 16384, 99
_KEPT = threading.local()


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

    @cached_property
    def _kinds(self) -> tuple[bool, bool]:
        """Whether there are bright discs, and dark ones."""
        return bool(self.bright.any()), not bool(self.bright.all())

    def find(self, image: NDArray[np.uint8]) -> Discs:
        """Find the discs in one grey image (H, W), of the kinds, bright or dark, that the body has."""
        image = np.ascontiguousarray(image)
        if image.shape[1] % 8:
            image = np.pad(image, ((0, 0), (0, -image.shape[1] % 8)), mode="edge")
        room = _room()
        bright, dark = self._kinds
        good, n = disc_search.find(image, image.view(np.uint64), bright, dark, *room)
        theta, codes, signs, cov, shape = room[:5]
        rejected = _rejected(theta[good:n], codes[good:n]) if n > good else ()
        if n == _MOST_PLACES:  # rows are looked at from above
            row = float(min(np.nanmax(theta[:n, 1]), len(image) - 1))
            reason = f"{n} places stand out, and no more are looked at: below about row {row:.0f} discs were not found"
            rejected = (Rejected((0.0, row), reason), *rejected)
        return Discs(theta[:good, :2].copy(), cov[:good].copy(), shape[:good].copy(), signs[:good] > 0, rejected)


def _room() -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Array, Array, disc_outline.Room, disc_model.Work]:
    """Return the arrays that this thread finds discs in; kept, for new memory each time costs as much as the search."""
    if not hasattr(_KEPT, "room"):
        _KEPT.room = (
            np.empty((_MOST_PLACES, disc_model.UNKNOWNS)),
            np.empty(_MOST_PLACES, np.int64),
            np.empty(_MOST_PLACES, np.int64),
            np.empty((_MOST_PLACES, 2, 2)),
            np.empty((_MOST_PLACES, 3)),
            disc_outline.workspace(),
            disc_model.workspace(),
        )
    room: tuple[Any, ...] = _KEPT.room
    return room


def _rejected(theta: Array, codes: NDArray[np.int64]) -> tuple[Rejected, ...]:
    """Say what is no disc and why: places with a closed rim, most like a disc first, or the others where there is none."""
    order = np.array([disc_fit.LOOK_ALIKES.index(c) if c in disc_fit.LOOK_ALIKES else _NEVER for c in codes.tolist()])
    told = np.argsort(order, kind="stable")[: min(MOST_REPORTED, max(int((order < _NEVER).sum()), 1))]
    return tuple(Rejected((float(theta[i, 0]), float(theta[i, 1])), disc_fit.REASONS[int(codes[i])]) for i in told)
