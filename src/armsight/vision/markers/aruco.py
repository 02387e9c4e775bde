"""Square code markers of every family OpenCV knows, found roughly: identities and corners to a pixel or so.

A quick search (:mod:`~armsight.vision.markers.quads`) reads plain ones. Where it leaves dark regions that may be
markers, and not all that are requested were read, OpenCV finds quadrilaterals in several windows and reads their cells by a
threshold. Blur and sharpening mix neighbouring cells of small markers, and some are not read. In families of 6x6 cells
and more, those quadrilaterals are compared with all codes, each blurred: the nearest code is taken where the next one
explains the image much worse.

AprilTag families carry their own names (``tag36h11``) and are then upright as the AprilTag project prints them; markers
of OpenCV's names (``DICT_APRILTAG_36h11``, ``DICT_4X4_50``) are upright as OpenCV prints them. The two conventions
print the same AprilTag upside down to each other, so the name of the family states which one is used.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.vision.markers.apriltag3 import LAYOUTS, codes, read_tag
from armsight.vision.markers.quads import SIDE_MIN_PX, outlines, read_codes

#: AprilTag's families -> OpenCV's dictionaries, in which they stand upside down.
APRILTAGS = {f"tag{kind}": f"DICT_APRILTAG_{kind}" for kind in ("16h5", "25h9", "36h10", "36h11")}
#: Every family; OpenCV lists some of its dictionaries twice, as 36h11 and 36H11.
FAMILIES = (*APRILTAGS, *sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_") and not re.search("[0-9]H[0-9]", n)))
#: Most quadrilaterals of an image; share of the cells that a family's distance lets correct which is used, as OpenCV's.
_MOST, _CORRECTED = 1024, 0.6


def family_name(text: str, known: Sequence[str] = FAMILIES) -> str:
    """Return the family that a text names, in any case, with or without ``DICT_`` or ``tag``; InputError if unknown."""
    for name in known:
        if text.lower() in (name.lower(), name.lower().removeprefix("dict_"), name.lower().removeprefix("tag")):
            return name
    raise InputError(f"unknown marker family {text!r}; known are {', '.join(known)}")


@lru_cache(maxsize=64)
def _dictionary(family: str) -> cv2.aruco.Dictionary:
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


@lru_cache(maxsize=16)
def _codes(family: str, border: int) -> NDArray[np.uint64]:
    """Return a family's codes (M, 4) in four rotations, row by row, the first cell in the highest bit."""
    whole = np.array([cells(family, k, border)[border:-border, border:-border] > 0 for k in range(family_size(family))])
    bits = np.uint64(1) << np.arange(whole[0].size - 1, -1, -1, dtype=np.uint64)
    rotated = [np.rot90(whole, r, axes=(1, 2)).reshape(len(whole), -1) @ bits for r in range(4)]
    return np.ascontiguousarray(np.transpose(rotated))


def _read_quickly(image: NDArray[np.uint8], family: str, border: int) -> tuple[list[tuple[int, Array]], bool]:
    """Return the markers that the quick search reads, upright, and whether the image may show others."""
    height, width = image.shape
    image, dictionary = np.ascontiguousarray(image), _dictionary(family)
    dark, steps = np.zeros((height + 2, width + 2), np.uint8), np.empty((2, 3 * (height + width)), np.int32)
    quads, found = np.empty((_MOST, 4, 2)), np.empty(_MOST, np.int64)
    count, regions = outlines(image, dark, steps, quads)
    size, allowed = dictionary.markerSize + 2 * border, int(_CORRECTED * dictionary.maxCorrectionBits)
    read_codes(image, quads[:count], _codes(family, border), size, border, allowed, found)
    read = [(int(code) // 4, np.roll(quads[k], code % 4, axis=0)) for k, code in enumerate(found[:count]) if code >= 0]
    return read, regions > len(read)


def detect_markers(image: NDArray[np.uint8], family: str, border: int = 1) -> tuple[Array, NDArray[np.int32]]:
    """Find the markers of a family in a grey image (H, W): corners (n, 4, 2) in OpenCV's order, identities (n,).

    ``border``: width of their dark border, cells.
    """
    image = _full_range(image)
    found, read, unread = _detector(family, round(4.0 * SIDE_MIN_PX / max(image.shape), 4), border).detectMarkers(image)
    identities = [] if read is None else map(int, np.ravel(read))
    markers = list(zip(identities, [np.asarray(quad, np.float64).reshape(4, 2) for quad in found], strict=True))
    for quad in unread if _dictionary(family).markerSize >= _CODE_CELLS else ():
        if (code := _nearest_code(image, np.reshape(quad, (4, 2)), family, border)) is not None:
            markers.append(code)
    markers = _without_repeats(markers)
    corners = np.array([quad for _, quad in markers], np.float64).reshape(-1, 4, 2)
    return corners, np.array([identity for identity, _ in markers], np.int32)


#: An image whose levels, but for the extreme ones of this share, span less than this is scaled to all of them; but its
#: noise to so many levels at most, for OpenCV would take it for edges, and by so much at least.
_EXTREME_PERCENT, _SPAN, _NOISE, _GAIN = 0.5, 128.0, 4.0, 1.3


def _full_range(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a dark or faint image with all grey levels: OpenCV's threshold of markers is a number of levels."""
    some = image[::4]
    low, high = np.percentile(some[:, ::4], (_EXTREME_PERCENT, 100.0 - _EXTREME_PERCENT))
    if not 0.0 < high - low < _SPAN:
        return image
    steps = np.abs(np.diff(some.astype(np.int16), axis=1))
    noise = float(np.mean(steps[steps <= np.percentile(steps, 90.0)]))
    gain = min(255.0 / (high - low), _NOISE / max(noise, 0.3))
    if gain < _GAIN:
        return image
    return np.asarray(cv2.LUT(image, np.clip((np.arange(256) - low) * gain, 0.0, 255.0).astype(np.uint8)), np.uint8)


#: Families with fewer cells a side are not compared: what is no marker resembles one of their codes too often.
_CODE_CELLS = 6
#: A contour's corners are off by so much: factors of its size that are tried.
_SCALES = (0.95, 1.0, 1.05, 1.1)
_CODE_BLUR = 0.5  # cells; sigma of the codes' blur; half, double: small markers are not read
#: A code's correlation with the image is at least this, and what it leaves unexplained at most this share of what the next
#: code leaves.
_CODE_FIT, _CODE_LEAD = 0.85, 0.5
#: The white ring around a marker exceeds its dark border by this many times the border's own deviation.
_RING_CLEAR = 2.0
#: The cells of the code vary by this share of that step at least, RMS; half of it where there is no blur.
_CODE_DEPTH = 0.25


@lru_cache(maxsize=16)
def _blurred_codes(family: str, border: int) -> NDArray[np.float32]:
    """Return a family's codes (4 M, cells), blurred, each in its four rotations, without mean and of length one."""
    name = APRILTAGS.get(family, family)
    whole = [cells(name, k, border) for k in range(family_size(family))]
    grids = np.array([np.rot90(np.pad(c, 1, constant_values=1), -r) for c in whole for r in range(4)], np.float32)
    soft = np.array([cv2.GaussianBlur(grid, (5, 5), _CODE_BLUR, borderType=cv2.BORDER_REPLICATE) for grid in grids])
    inner = soft[:, border + 1 : -border - 1, border + 1 : -border - 1].reshape(len(grids), -1)
    inner = inner - inner.mean(axis=1, keepdims=True)
    return np.asarray(inner / np.maximum(np.linalg.norm(inner, axis=1, keepdims=True), 1e-9))


def _nearest_code(image: NDArray[np.uint8], quad: Array, family: str, border: int) -> tuple[int, Array] | None:
    """Return identity and corners (4, 2), in OpenCV's order, of the marker that a quadrilateral (4, 2) shows, if any."""
    size, best = len(cells(family, 0, border)), (_CODE_FIT, -1, 0, quad)
    middle = quad.mean(axis=0)
    for scale in _SCALES:
        about = (middle + scale * (quad - middle)).astype(np.float32)
        seen = _cells_seen(image, about, size)
        rim, dark = np.ones(seen.shape, bool), np.zeros(seen.shape, bool)
        rim[1:-1, 1:-1], dark[1:-1, 1:-1] = False, True
        dark[border + 1 : -border - 1, border + 1 : -border - 1] = False
        step = float(np.median(seen[rim]) - seen[dark].mean())
        if step <= _RING_CLEAR * float(seen[dark].std()):
            continue
        inner = seen[border + 1 : -border - 1, border + 1 : -border - 1].ravel()
        inner = inner - inner.mean()
        if inner.std() < _CODE_DEPTH * step:
            continue
        inner /= np.linalg.norm(inner)
        correlation = _blurred_codes(family, border) @ inner
        row = int(correlation.argmax())
        first = float(correlation[row])
        correlation[row - row % 4 : row - row % 4 + 4] = 0.0  # the same marker, rotated
        if first > best[0] and 1 - first**2 < _CODE_LEAD * (1 - float(correlation.max()) ** 2):
            best = (first, row // 4, row % 4, about)
    return None if best[1] < 0 else (best[1], np.roll(best[3], -best[2], axis=0))


def _cells_seen(image: NDArray[np.uint8], corners: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return the mean grey of a marker's cells and of a ring of cells around it, (size + 2, size + 2)."""
    count, samples = size + 2, 3
    ends = np.array([[1, 1], [size + 1, 1], [size + 1, size + 1], [1, size + 1]], np.float32) * samples - np.float32(
        0.5
    )
    H = cv2.getPerspectiveTransform(corners, ends)
    fine = cv2.warpPerspective(image, H, (samples * count, samples * count), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(fine.reshape(count, samples, count, samples).mean(axis=(1, 3), dtype=np.float32))


def _without_repeats(found: list[tuple[int, Array]]) -> list[tuple[int, Array]]:
    """Return identities and corners (4, 2) that are markers of their own: one outline is found once or more."""
    kept: list[int] = []
    corners = np.array([each for _, each in found]).reshape(-1, 4, 2)
    sides = np.linalg.norm(np.diff(corners, axis=1, append=corners[:, :1]), axis=2).mean(axis=1)
    middles = corners.mean(axis=1)
    for i in np.argsort(-sides).tolist():
        same = [k for k in kept if found[k][0] == found[i][0]]
        if all(np.linalg.norm(middles[k] - middles[i]) > 0.5 * sides[i] for k in same):
            kept.append(i)
    return [found[i] for i in sorted(kept)]


def find_squares(
    image: NDArray[np.uint8], family: str, border: int = 1, requested: Collection[int] | None = None
) -> list[tuple[int, Array]]:
    """Find the markers of a family in a grey image (H, W), upright by the convention of its name: identity, corners (4, 2).

    Corners are rough, raw pixels: upper left, upper right, lower right, lower left; of AprilTag 3's families those of
    the inner square. The quick search is enough where it reads all that are ``requested``. ``border``: of the dark
    border, cells.
    """
    if family in LAYOUTS:
        return _find_apriltag3(image, family)
    read, others = _read_quickly(image, family, border)
    if not others or (requested is not None and set(requested) <= {identity for identity, _ in read}):
        return read
    rot90 = 2 if family in APRILTAGS else 0
    corners, identities = detect_markers(image, family, border)
    return _without_repeats(
        read + [(int(k), np.roll(found, -rot90, axis=0)) for k, found in zip(identities, corners, strict=True)]
    )


def _find_apriltag3(image: NDArray[np.uint8], family: str) -> list[tuple[int, Array]]:
    """Find tags of AprilTag 3's families: in the negative of an image their inner squares are dark outlines."""
    image = _full_range(image)
    share = round(4.0 * SIDE_MIN_PX / max(image.shape), 4)
    some, _, others = _detector("DICT_4X4_50", share, 1).detectMarkers(255 - image)
    tags = [read_tag(image, np.reshape(quad, (4, 2)).astype(np.float64), family) for quad in (*some, *others)]
    return _without_repeats([tag for tag in tags if tag is not None])


def tag_family(text: str) -> str:
    """Return the family of single tags that a text names: AprilTag 3's too; otherwise as :func:`family_name`."""
    return family_name(text, (*LAYOUTS, *FAMILIES))


def tag_count(family: str) -> int:
    """Return how many tags a family has, AprilTag 3's too."""
    return len(codes(family)) if family in LAYOUTS else family_size(family)


@lru_cache(maxsize=64)
def charuco_detector(
    size: tuple[int, int], square_m: float, marker_m: float, family: str, legacy: bool
) -> cv2.aruco.CharucoDetector:
    """Make OpenCV's detector of a charuco board: squares columns x rows, and whether the layout is that before 4.6."""
    return cv2.aruco.CharucoDetector(_charuco(size, square_m, marker_m, family, legacy))


@lru_cache(maxsize=16)
def marker_corners(size: tuple[int, int], square_m: float, marker_m: float, family: str, legacy: bool) -> Array:
    """Return where the markers of a charuco board have their corners (n, 4, 2), m, from the board's upper left."""
    corners = _charuco(size, square_m, marker_m, family, legacy).getObjPoints()
    return np.asarray(corners, dtype=float)[..., :2]


def _charuco(
    size: tuple[int, int], square_m: float, marker_m: float, family: str, legacy: bool
) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's charuco board; arguments as :func:`charuco_detector`."""
    board = cv2.aruco.CharucoBoard(size, square_m, marker_m, _dictionary(family))
    board.setLegacyPattern(legacy)
    return board
