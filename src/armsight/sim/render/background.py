"""What stands behind: images (H, W) of reflectance, plain, textured or cluttered, all from a seed."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Reflectance = NDArray[np.float32]

_COARSEST_PX = 256  # size of the largest blobs of a texture


def plain(image_size_px: tuple[int, int], rng: np.random.Generator) -> Reflectance:
    """Return one value everywhere; nothing is sampled from ``rng``."""
    return np.full(image_size_px[::-1], 0.4, np.float32)


def textured(
    image_size_px: tuple[int, int], rng: np.random.Generator, mean: float = 0.4, spread: float = 0.1
) -> Reflectance:
    """Return noise of all scales, each octave a little weaker than the one above: plaster, cloth, concrete."""
    width, height = image_size_px
    total = np.zeros((height, width), np.float32)
    scale, amplitude = _COARSEST_PX, 1.0
    while scale >= 1:
        cells = (height // scale + 3, width // scale + 3)
        noise = rng.standard_normal(cells, dtype=np.float32)
        whole = cv2.resize(noise, (cells[1] * scale, cells[0] * scale), interpolation=cv2.INTER_CUBIC)
        top, left = rng.integers(0, scale, 2)  # octaves must not share a lattice
        total += np.float32(amplitude) * whole[scale + top : scale + top + height, scale + left : scale + left + width]
        scale, amplitude = scale // 2, 0.7 * amplitude
    total *= np.float32(spread) / total.std()
    total += np.float32(mean) - total.mean()
    return np.asarray(np.clip(total, 0.02, 1.0))


def cluttered(image_size_px: tuple[int, int], rng: np.random.Generator, items: int = 60) -> Reflectance:
    """Return a texture full of things that are not the target: boxes, rods, polygons, ellipses, print."""
    width, height = image_size_px
    # Rendered at twice the size and averaged, for edges as smooth as a lens would make them.
    canvas = np.full((2 * height, 2 * width), 110, np.uint8)
    for kind in rng.choice(len(_ITEMS), items, p=_SHARES):
        centre = rng.uniform(0, (2 * width, 2 * height))
        size = 2 * np.exp(rng.uniform(np.log(8), np.log(width / 5)))
        _ITEMS[kind](canvas, centre, size, int(rng.integers(15, 240)), rng)
    things = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255)
    return np.asarray(np.clip(things * textured(image_size_px, rng, 1.0, 0.06), 0.02, 1.0))


def _polygon(
    canvas: NDArray[np.uint8], centre: NDArray[np.float64], size: float, grey: int, rng: np.random.Generator
) -> None:
    """Draw a filled polygon of 3 to 7 corners."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
    reach = rng.uniform(0.4, 1.0, angle.size) * size / 2
    corners = centre + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cv2.fillPoly(canvas, [corners.round().astype(np.int32)], grey, cv2.LINE_AA)


def _box(
    canvas: NDArray[np.uint8], centre: NDArray[np.float64], size: float, grey: int, rng: np.random.Generator
) -> None:
    """Draw a rotated rectangle with a darker side, as a box seen from above."""
    corners = cv2.boxPoints((centre.tolist(), (size, size * rng.uniform(0.3, 1.0)), rng.uniform(0, 180)))
    cv2.fillPoly(canvas, [corners.round().astype(np.int32)], grey, cv2.LINE_AA)
    side = np.concatenate([corners[:2], corners[1::-1] + rng.uniform(-0.2, 0.2, 2) * size])
    cv2.fillPoly(canvas, [side.round().astype(np.int32)], grey // 2, cv2.LINE_AA)


def _rod(
    canvas: NDArray[np.uint8], centre: NDArray[np.float64], size: float, grey: int, rng: np.random.Generator
) -> None:
    bends = centre + rng.normal(0, size, (4, 2)).cumsum(axis=0)
    t = np.linspace(0, 1, 40)[:, None]
    curve = (1 - t) ** 3 * bends[0] + 3 * t * (1 - t) ** 2 * bends[1] + 3 * t**2 * (1 - t) * bends[2] + t**3 * bends[3]
    cv2.polylines(canvas, [curve.round().astype(np.int32)], False, grey, int(rng.integers(2, 16)), cv2.LINE_AA)


def _ellipse(
    canvas: NDArray[np.uint8], centre: NDArray[np.float64], size: float, grey: int, rng: np.random.Generator
) -> None:
    """Draw a cup, a coin or a screw: a filled ellipse, a ring, or a part of one."""
    axes = (int(size / 4) + 2, int(size / 4 * rng.uniform(0.3, 1.0)) + 2)
    width = -1 if rng.random() < 0.5 else int(rng.integers(2, 10))
    whole = 360 if rng.random() < 0.6 else float(rng.uniform(60, 300))
    cv2.ellipse(canvas, (int(centre[0]), int(centre[1])), axes, rng.uniform(0, 180), 0, whole, grey, width, cv2.LINE_AA)


def _print(
    canvas: NDArray[np.uint8], centre: NDArray[np.float64], size: float, grey: int, rng: np.random.Generator
) -> None:
    """Draw a few letters."""
    letters = "".join(rng.choice(list("ABCDEFGHKLMNOPRSTUVXYZ0123456789o.:"), rng.integers(2, 9)))
    corner = (int(centre[0]), int(centre[1]))
    face, scale = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX])), 0.6 + size / 100
    cv2.putText(canvas, letters, corner, face, scale, grey, int(1 + 2 * scale), cv2.LINE_AA)


_ITEMS = (_polygon, _box, _rod, _ellipse, _print)
_SHARES = (0.25, 0.25, 0.2, 0.15, 0.15)

#: Kind of background -> what makes one of (width, height) from a source of noise.
BACKGROUNDS: dict[str, Callable[[tuple[int, int], np.random.Generator], Reflectance]] = {
    "plain": plain,
    "textured": textured,
    "cluttered": cluttered,
}
