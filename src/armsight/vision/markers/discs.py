"""Plain discs: which discs a body carries, and where one image shows discs.

Discs carry no code: which of the body's each one is follows from both cameras (:mod:`~armsight.vision.discs.identify`).
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Discs, Record, Rejected
from armsight.vision.markers.body_file import Marker, check_discs
from armsight.vision.markers.disc import fit, search
from armsight.vision.markers.disc.common import FIELDS, SHARED

#: Most rejected candidates of an image that are reported.
MOST_REPORTED = 100
#: Most candidates examined in an image; rank of one that has no closed rim.
_MOST_CANDIDATES, _NEVER = fit.MOST_DISCS, len(fit.LOOK_ALIKES)
#: An outline in a smaller copy this large, as a share of the longest half chord in the image, is looked at.
_LARGE = 0.8
#: Points count as coplanar where their third singular value is below this share of the first.
_FLAT = 1e-3
#: Code -> rank among the reported.
_ORDER = np.array(
    [fit.LOOK_ALIKES.index(c) if c in fit.LOOK_ALIKES else _NEVER for c in range(1 + max(fit.REASONS))], np.uint8
)
_KEPT = threading.local()


@dataclass(frozen=True, eq=False)
class DiscTarget(Record):
    """The discs of a body."""

    body: Body  #: their centres; their names
    radii_m: Array  #: (M,) radii, m
    bright: NDArray[np.bool_]  #: (M,) whether a disc is brighter than what surrounds it
    #: (M, 3) unit vectors out of the discs' faces, body frame; NaN where the body file does not give them
    normals: Array

    @staticmethod
    def from_markers(name: str, markers: Sequence[Marker]) -> DiscTarget:
        """Make the target of a file's discs: ``disc = { radius_mm = 8.0, bright = true }``; InputError names the entry."""
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

    @cached_property
    def bias_normals(self) -> Array:
        """(M, 3) normals for the perspective bias, for which their sign does not matter.

        Where none is given, that of the plane of all discs; NaN where they are not coplanar.
        """
        normals, unknown = np.array(self.normals), np.isnan(self.normals[:, 0])
        if unknown.any() and len(normals) >= 3:
            _, spread, axes = np.linalg.svd(self.body.points - self.body.points.mean(axis=0))
            if spread[1] > _FLAT * spread[0] and spread[2] <= _FLAT * spread[0]:
                normals[unknown] = axes[2]
        return normals

    def find(self, image: NDArray[np.uint8]) -> Discs:
        """Find the discs in one grey image (H, W), of the kinds, bright or dark, that the body has.

        Where fewer than the body has are found and large parts of the image differ, smaller copies of it are searched too.
        """
        image = _padded(image)
        words, (bright, dark) = image.view(np.uint64), self._kinds
        theta, codes, signs, cov, shape, shared, room, work = _room()
        buffers = theta, codes, signs, cov, shape, room, work
        good, n, large, noise = search.find(image, words, bright, dark, 0, 0, 0, *buffers)
        if large and good < len(self.radii_m):
            larger, kinds = _larger(image, bright, dark)
            if (k := min(len(larger), _MOST_CANDIDATES - n)) > 0:
                more = slice(n, n + k)
                theta[more], codes[more], signs[more] = larger[:k], 0, kinds[:k]
                good, n, _, _ = search.find(image, words, bright, dark, good, n, n + k, *buffers)
        search.correct_all(image, noise, good, theta, cov, shared, work)
        rejected = _rejected(theta[good:n], codes[good:n]) if n > good else ()
        if n == _MOST_CANDIDATES:  # rows are searched from the top
            row = float(min(np.nanmax(theta[:n, 1]), len(image) - 1))
            reason = f"{n} candidates, and no more are examined: below about row {row:.0f} discs were not searched"
            rejected = (Rejected((0.0, row), reason), *rejected)
        return Discs(
            theta[:good, :2].copy(),
            cov[:good].copy(),
            shape[:good].copy(),
            signs[:good] > 0,
            rejected,
            shared[FIELDS:].reshape(2, 3).copy(),
        )


def _padded(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image whose rows are whole 64-bit words."""
    if image.shape[1] % 8:
        image = np.pad(image, ((0, 0), (0, -image.shape[1] % 8)), mode="edge")
    return np.ascontiguousarray(image)


def copies(image: NDArray[np.uint8]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield an image and copies of half its size, a quarter, ..: how many times smaller each is, and its padded pixels."""
    scale = 1
    yield scale, _padded(image)
    while min(image.shape) >= 2 * search.REACH:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        scale, image = 2 * scale, np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
        yield scale, _padded(image)


def enlarged(theta: Array, scale: int) -> Array:
    """Return outlines (N, 10) of a copy so many times smaller as they are in the image."""
    theta = theta.copy()
    theta[:, :2] = (theta[:, :2] + 0.5) * scale - 0.5
    theta[:, 2:5] /= scale**2
    theta[:, 5] *= scale
    return theta


def _larger(image: NDArray[np.uint8], bright: bool, dark: bool) -> tuple[Array, NDArray[np.int64]]:
    """Look for discs too large for the search in smaller copies: (K, 10) starts for the fit, (K,) 1 bright, -1 dark."""
    if not hasattr(_KEPT, "outlines"):
        n = _MOST_CANDIDATES
        _KEPT.outlines = np.empty((n, fit.UNKNOWNS)), np.empty(n, np.int64), np.empty(n, np.int64), search.workspace()
    starts, codes, signs, work = _KEPT.outlines
    thetas, kinds = [np.empty((0, fit.UNKNOWNS))], [np.empty(0, np.int64)]
    for scale, copy in itertools.islice(copies(image), 1, None):
        noise = search.noise_of(copy)
        n, _ = search.search(copy, copy.view(np.uint64), noise, bright, dark, starts, codes, signs, work)
        found, signs_found = starts[:n][codes[:n] == 0], signs[:n][codes[:n] == 0]
        large = (found[:, 2] * found[:, 4] - found[:, 3] ** 2) ** -0.25 > _LARGE * search.REACH / 2
        thetas.append(enlarged(found[large], scale))
        kinds.append(signs_found[large])
    return np.concatenate(thetas), np.concatenate(kinds)


def _room() -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Array, Array, Array, search.Room, fit.FitBuffers]:
    """Return this thread's buffers; they are kept, for new memory each time costs as much as the search."""
    if not hasattr(_KEPT, "room"):
        _KEPT.room = (
            np.empty((_MOST_CANDIDATES, fit.UNKNOWNS)),
            np.empty(_MOST_CANDIDATES, np.int64),
            np.empty(_MOST_CANDIDATES, np.int64),
            np.empty((_MOST_CANDIDATES, 2, 2)),
            np.empty((_MOST_CANDIDATES, 3)),
            np.empty(SHARED),
            search.workspace(),
            fit.workspace(),
        )
    room: tuple[Any, ...] = _KEPT.room
    return room


def _rejected(theta: Array, codes: NDArray[np.int64]) -> tuple[Rejected, ...]:
    """Report what is not a disc and why: candidates with a closed rim, most disc-like first; without one, the others."""
    order = _ORDER[codes]
    reported = np.argsort(order, kind="stable")[: min(MOST_REPORTED, max(int((order < _NEVER).sum()), 1))]
    rows = zip(theta[reported, :2].tolist(), codes[reported].tolist(), strict=True)
    return tuple(Rejected((u, v), fit.REASONS[code]) for (u, v), code in rows)
