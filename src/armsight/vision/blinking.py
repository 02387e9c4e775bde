"""Find what blinks in a camera's images, and measure how bright it is.

In: the images of one camera that stands still. Out: spots whose brightness changes most, each with its brightness in every
image; for the one that is chosen a :class:`Spot`, whose weights are how much each pixel around it blinks, so that its
brightness has the least noise. Pixels that saturate are left out: their neighbours, lit by the lens's blur, say the same.

The search is in two steps, for a second of images is too much to keep: the means of blocks of pixels find the candidates,
then the pixels about them are kept until the weights are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from armsight.data import Array, Image, Missed, Record
from armsight.vision.image import grey

#: Pixels on a side of a block, and of the window about a spot.
BLOCK, WINDOW = 8, 32
#: Blocks on a side of what a block is compared with.
_NEAR = 7
#: Spots that are looked at more closely.
CANDIDATES = 6
#: A block blinks if its brightness scatters by so many times what those of the image usually do, and so much, grey levels.
_TIMES, _LEAST = 2.0, 0.5
#: Grey level from which a pixel may be saturated; share of the strongest pixel's blinking that belongs to the spot, and
#: below which a pixel is around it.
_SATURATED, _SHARE, _AROUND = 250, 0.15, 0.05
#: The weakest blinking that is measured, grey levels of a pixel.
_WEAKEST = 6.0


@dataclass(frozen=True, eq=False)
class Spot(Record):
    """Something that blinks at uv (2,), pixels: a window at ``corner`` (column, row) with weights (h, w) of sum 1.

    ``around``: weights of what is around it, sum 1.
    """

    uv: Array
    corner: tuple[int, int]
    weights: Array
    around: Array

    def brightness(self, image: Image) -> tuple[float, float]:
        """Return how bright the spot is in an image (H, W) or (H, W, 3), and what is around it, grey levels."""
        part = _part(image, self.corner, self.weights.shape)
        return float((self.weights * part).sum()), float((self.around * part).sum())


def block_means(image: Image) -> Array:
    """Return the means (H // BLOCK, W // BLOCK) of an image's blocks, uint8."""
    whole = grey(image)
    rows, columns = whole.shape[0] // BLOCK, whole.shape[1] // BLOCK
    part = whole[: rows * BLOCK, : columns * BLOCK]
    return np.asarray(cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA))


def candidates(means: Array) -> list[tuple[int, int]]:
    """Return the first column and row of windows about what blinks most in block means (N, h, w); the most first."""
    # Lamps that flicker change all blocks alike, shadows change slowly: neither is what blinks.
    apart = [image - cv2.blur(image, (_NEAR, _NEAR)) for image in means.astype(np.float32)]
    changes = np.diff(apart, axis=0).std(axis=0)
    usual = float(np.median(changes))
    found, left = [], changes.copy()
    high, wide = means.shape[1] * BLOCK, means.shape[2] * BLOCK
    for _ in range(CANDIDATES):
        row, column = (int(k) for k in np.unravel_index(np.argmax(left), left.shape))
        if left[row, column] < max(_TIMES * usual, _LEAST):
            break
        near = WINDOW // BLOCK // 2
        rows = slice(max(row - near, 0), row + near + 1)
        columns = slice(max(column - near, 0), column + near + 1)
        weight = np.maximum(changes[rows, columns] - usual, 0.0)
        at_row = float((weight.sum(axis=1) @ np.arange(rows.start, rows.start + len(weight))) / weight.sum())
        at_column = float(
            (weight.sum(axis=0) @ np.arange(columns.start, columns.start + weight.shape[1])) / weight.sum()
        )
        u = int(np.clip(round((at_column + 0.5) * BLOCK - WINDOW / 2), 0, max(wide - WINDOW, 0)))
        found.append((u, int(np.clip(round((at_row + 0.5) * BLOCK - WINDOW / 2), 0, max(high - WINDOW, 0)))))
        left[rows, columns] = 0.0
    return found


def window(image: Image, corner: tuple[int, int]) -> Array:
    """Return the pixels (WINDOW, WINDOW) of an image from a corner on, column and row; uint8."""
    return _part(image, corner, (WINDOW, WINDOW))


def _part(image: Image, corner: tuple[int, int], shape: tuple[int, ...]) -> Array:
    u, v = corner
    return np.asarray(grey(image[v : v + shape[0], u : u + shape[1]]))


def spot(pixels: Array, corner: tuple[int, int]) -> Spot | Missed:
    """Weigh the pixels (N, h, w) of a window at ``corner`` by how much they blink together; Missed if weak or saturated."""
    stack = pixels.astype(np.float64)
    changes = stack - stack.mean(axis=0)
    together = changes[:, changes.std(axis=0) >= 0.5 * changes.std(axis=0).max()].mean(axis=1)
    amplitude = np.maximum(np.tensordot(together, changes, (0, 0)) / max(float(together @ together), 1e-12), 0.0)
    swing = amplitude * float(np.ptp(together))
    blinks = swing >= max(_SHARE * float(swing.max()), _WEAKEST)
    if not blinks.any():
        return Missed(f"what blinks changes by {swing.max():.0f} grey levels; {_WEAKEST:.0f} at least are needed")
    clipped = pixels.max(axis=0) >= _SATURATED
    used = blinks & ~clipped
    if used.sum() < max(4, 0.1 * blinks.sum()):
        return Missed(
            f"the LED is saturated in {int((blinks & clipped).sum())} of its {int(blinks.sum())} pixels: dim it (a larger"
            " resistor, paper before it), or expose shorter"
        )
    weights = np.where(used, swing, 0.0)
    around = (swing <= _AROUND * swing.max()) & ~clipped
    ring = around if around.any() else ~blinks
    total = weights.sum()
    rows, columns = np.indices(swing.shape)
    centre = np.array([(swing * blinks * columns).sum(), (swing * blinks * rows).sum()]) / (swing * blinks).sum()
    return Spot(centre + corner, corner, weights / total, ring / max(ring.sum(), 1))
