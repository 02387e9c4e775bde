"""Square code markers of every family OpenCV knows, found roughly: identities and corners to a pixel or so.

AprilTag families carry their own names (``tag36h11``) and are then upright as the AprilTag project prints them; markers
of OpenCV's names (``DICT_APRILTAG_36h11``, ``DICT_4X4_50``) are upright as OpenCV prints them. The two conventions
print the same AprilTag upside down to each other, so the name of the family states which one is used.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError

#: AprilTag's families -> OpenCV's dictionaries, in which they stand upside down.
APRILTAGS = {f"tag{kind}": f"DICT_APRILTAG_{kind}" for kind in ("16h5", "25h9", "36h10", "36h11")}
#: Every family; OpenCV lists some of its dictionaries twice, as 36h11 and 36H11.
FAMILIES = (*APRILTAGS, *sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_") and not re.search("[0-9]H[0-9]", n)))
#: A marker smaller than this cannot be read: eight cells across need more than a pixel each.
SIDE_MIN_PX = 10.0


def family_name(text: str) -> str:
    """Return the family that a text names: any case, with or without OpenCV's ``DICT_``.

    Raises:
        InputError: unknown; the message lists the known ones.
    """
    for name in FAMILIES:
        if text.lower() in (name.lower(), name.lower().removeprefix("dict_")):
            return name
    raise InputError(f"unknown marker family {text!r}; known are {', '.join(FAMILIES)}")


@lru_cache(maxsize=64)
def _dictionary(family: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a family."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, APRILTAGS.get(family, family)))


def family_size(family: str) -> int:
    """Return how many markers a family has; their ids are 0 to this less one."""
    return len(_dictionary(family).bytesList)


@lru_cache(maxsize=4096)
def cells(family: str, identity: int, border: int = 1) -> NDArray[np.int8]:
    """Return a marker's cells (N, N), 1 bright and -1 dark, its dark border of so many cells included, upright."""
    dictionary = _dictionary(family)
    code = dictionary.bytesList[identity : identity + 1]
    bits = cv2.aruco.Dictionary.getBitsFromByteList(code, dictionary.markerSize)
    upright = np.rot90(bits, 2) if family in APRILTAGS else bits
    out = np.pad(np.where(upright > 0, 1, -1), border, constant_values=-1).astype(np.int8)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=64)
def _detector(family: str, perimeter_share: float, border: int) -> cv2.aruco.ArucoDetector:
    """Make a detector that takes markers down to a share of the image's longer side, as perimeter."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = perimeter_share
    parameters.perspectiveRemovePixelPerCell = 8  # small markers are read from more samples a cell than by default
    # A marker on a card of its own has the card's outline close around it; OpenCV would keep only the larger of the
    # two.
    parameters.minMarkerDistanceRate = 0.01
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    parameters.markerBorderBits = border
    return cv2.aruco.ArucoDetector(_dictionary(family), parameters)


def detect_markers(
    image: NDArray[np.uint8], family: str, border: int = 1
) -> tuple[Sequence[NDArray[Any]], NDArray[Any]]:
    """Find the markers of a family as OpenCV gives them.

    Args:
        image: (H, W) grey image.
        family: a name of FAMILIES.
        border: width of the markers' dark border, cells.

    Returns:
        (1, 4, 2) corners of each marker, in OpenCV's order whatever the family; (n, 1) identities.
    """
    share = round(4.0 * SIDE_MIN_PX / max(image.shape), 4)
    corners, identities, _ = _detector(family, share, border).detectMarkers(image)
    if identities is None:
        return (), np.zeros((0, 1), np.int32)
    identities = np.asarray(identities).reshape(-1, 1)
    kept = _without_repeats(np.reshape(corners, (-1, 4, 2)), identities[:, 0])
    return [corners[i] for i in kept], identities[kept]


def _without_repeats(corners: Array, identities: NDArray[Any]) -> list[int]:
    """Return the rows (n,) of corners (n, 4, 2) that are markers of their own: one outline is found once or more."""
    kept: list[int] = []
    sides = np.linalg.norm(np.diff(corners, axis=1, append=corners[:, :1]), axis=2).mean(axis=1)
    middles = corners.mean(axis=1)
    for i in np.argsort(-sides).tolist():
        same = [k for k in kept if identities[k] == identities[i]]
        if all(np.linalg.norm(middles[k] - middles[i]) > 0.5 * sides[i] for k in same):
            kept.append(i)
    return sorted(kept)


def find_squares(image: NDArray[np.uint8], family: str, border: int = 1) -> list[tuple[int, Array]]:
    """Find the markers of a family, upright by the convention of the family's name.

    Args:
        image: (H, W) grey image.
        family: a name of FAMILIES.
        border: width of the markers' dark border, cells.

    Returns:
        Identity and rough corners (4, 2), raw pixels, of each marker seen: upper left, upper right, lower right, lower
        left of the upright marker.
    """
    rot90 = 2 if family in APRILTAGS else 0
    corners, identities = detect_markers(image, family, border)
    return [
        (int(identity), np.roll(found.reshape(4, 2).astype(np.float64), -rot90, axis=0))
        for identity, found in zip(identities[:, 0], corners, strict=True)
    ]


@lru_cache(maxsize=64)
def charuco_detector(
    size: tuple[int, int], square_m: float, marker_m: float, family: str, legacy: bool
) -> cv2.aruco.CharucoDetector:
    """Make OpenCV's detector of a charuco board: squares columns x rows, and whether the layout is that before 4.6."""
    board = cv2.aruco.CharucoBoard(size, square_m, marker_m, _dictionary(family))
    board.setLegacyPattern(legacy)
    return cv2.aruco.CharucoDetector(board)
