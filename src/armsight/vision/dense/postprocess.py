"""From the winners to a result: implausible disparities are rejected, the rest smoothed, gaps filled, sigma added.

All methods end here (:func:`finished`), so that they differ in how they match and in nothing else.

1. Rejection (:func:`without_speckles`): disparities on which the two images do not agree, and patches that are too
small. 2. Smoothing (:func:`smoothed`): sub-pixel positions are noisy where there is little texture. Every measured
pixel becomes
   the mean of those near it within a small difference of disparity, weighted by their similarity in grey: along rows,
   then along columns, a separated bilateral filter (Pham and van Vliet 2005). Depth breaks stay, for disparities across
   them differ too much to count.
3. Filling (:func:`filled`): the right camera cannot see a surface behind a nearer one or beyond its image; there the
farther
   of the neighbouring surfaces in the row continues. Where a pixel could have been seen and was not matched, the same
   is a guess; the two states differ.
4. Edges (:func:`aligned_to_edges`): a window that matches covers both sides of a break, so the nearer surface comes out
a
   few pixels too wide, and the fill beside it is a guess. Near breaks and gaps every pixel takes the weighted median of
   its neighbourhood, similar and near neighbours counting more (Ma, He, Wei, Sun and Wu, "Constant time weighted median
   filtering for stereo matching and beyond", ICCV 2013). A measured pixel that moves to another surface counts as
   filled.
5. Sigma (:class:`SigmaModel`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.kernels import kernel
from armsight.vision.dense.method import FILLED, MEASURED, OCCLUDED, Disparity, Search
from armsight.vision.dense.winner import Singles, Winners, for_each_strip

#: Half the window, of which every other row and column counts, px; the spread of its weights, px and grey levels.
_EDGE_REACH, _NEAR_PX, _EDGE_ALIKE = 8, 6.0, 10.0
#: A step in disparity that is a break, px, and the distance from one within which a pixel is computed again, px.
_BREAK, _BESIDE = 1.5, 3
#: A measured disparity stays if it is so near to the median, px.
_SAME = np.float32(1.0)


def _doubtful(disparity: Singles, state: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return where (H, W) a pixel is computed again: near breaks, and in gaps that a window bridges."""
    three = np.ones((3, 3), np.uint8)
    broken = cv2.dilate(disparity, three) - cv2.erode(disparity, three) > _BREAK
    size = 2 * _BESIDE + 1
    near = cv2.dilate(broken.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    measured = (state == MEASURED).astype(np.uint8)
    bridged = cv2.dilate(measured, np.ones((2 * _EDGE_REACH + 1, 2 * _EDGE_REACH + 1), np.uint8)) > measured
    return np.asarray(near | bridged).astype(np.uint8)


@kernel("f4[:, ::1], const u1[:, ::1], u1[:, ::1], f4[::1], f4[::1], f4[::1], i8, i8, f4[:, ::1]", nogil=True)
def _weighted_medians(
    disparity: Singles,
    image: Image,
    doubtful: NDArray[np.uint8],
    alike: Singles,
    near: Singles,
    votes: Singles,
    begin: int,
    end: int,
    out: Singles,
) -> None:
    """Write weighted medians of doubtful pixels; the rest is copied. ``votes``: zeros, one for each disparity."""
    height, width = disparity.shape
    for y in range(begin, end):
        for x in range(width):
            out[y, x] = disparity[y, x]
            if not doubtful[y, x]:
                continue
            low, high, total = votes.shape[0], 0, np.float32(0)
            for j in range(-_EDGE_REACH, _EDGE_REACH + 1, 2):
                for i in range(-_EDGE_REACH, _EDGE_REACH + 1, 2):
                    v, u = y + j, x + i
                    if 0 <= v < height and 0 <= u < width:
                        weight = alike[abs(np.int32(image[v, u]) - np.int32(image[y, x]))] * near[abs(j)] * near[abs(i)]
                        k = int(disparity[v, u] + np.float32(0.5))
                        votes[k] += weight
                        total += weight
                        low, high = min(low, k), max(high, k)
            middle, below = low, votes[low]
            while below < total / 2 and middle < high:
                middle += 1
                below += votes[middle]
            votes[low : high + 1] = 0
            out[y, x] = _mean_of(disparity, image, alike, near, y, x, middle)


@kernel(nogil=True)
def _mean_of(
    disparity: Singles, image: Image, alike: Singles, near: Singles, y: int, x: int, middle: int
) -> np.float32:
    """Return the weighted mean of the neighbours within a pixel of the median."""
    height, width = disparity.shape
    up, down = np.float32(0), np.float32(0)
    for j in range(-_EDGE_REACH, _EDGE_REACH + 1, 2):
        for i in range(-_EDGE_REACH, _EDGE_REACH + 1, 2):
            v, u = y + j, x + i
            if 0 <= v < height and 0 <= u < width and abs(disparity[v, u] - middle) <= 1:
                weight = alike[abs(np.int32(image[v, u]) - np.int32(image[y, x]))] * near[abs(j)] * near[abs(i)]
                up += weight * disparity[v, u]
                down += weight
    return up / down if down > 0 else np.float32(middle)


def aligned_to_edges(disparity: Singles, state: NDArray[np.uint8], image: Image) -> tuple[Singles, NDArray[np.uint8]]:
    """Align depth breaks and gaps to the edges of the image.

    ``disparity``: (H, W) px, filled; ``state``: (H, W) the state of each; ``image``: (H, W) uint8, the left image. Returns
    the same two, aligned; a measured pixel that moves to another surface is FILLED.
    """
    doubtful, median = _doubtful(disparity, state), np.empty_like(disparity)
    alike = np.exp(-np.arange(256) / _EDGE_ALIKE).astype(np.float32)
    near = np.exp(-((np.arange(_EDGE_REACH + 1) / _NEAR_PX) ** 2) / 2).astype(np.float32)

    most = int(disparity.max()) + 2

    def work(begin: int, end: int) -> None:
        _weighted_medians(disparity, image, doubtful, alike, near, np.zeros(most, np.float32), begin, end, median)

    for_each_strip(disparity.shape[0], work)
    stays = (state == MEASURED) & (np.abs(median - disparity) <= _SAME)
    moved = (state == MEASURED) & ~stays
    return np.where(stays, disparity, median), np.where(moved, np.uint8(FILLED), state)


#: A right pixel that a measured pixel claims, nearer than this, px, hides what is farther.
_HIDES = np.float32(1.0)


@kernel(nogil=True)
def _fill_row(d: Singles, state: NDArray[np.uint8], nearest: Singles) -> bool:
    """Fill a row from its measured neighbours and set the states; False where it holds nothing measured."""
    width, last = d.shape[0], np.float32(np.inf)
    any_measured = False
    nearest[:] = -1
    for x in range(width):
        if state[x] == MEASURED:
            last, any_measured = d[x], True
            right = int(np.floor(x - d[x] + np.float32(0.5)))
            if 0 <= right < width:
                nearest[right] = max(nearest[right], d[x])
        else:
            d[x] = last
    last = np.float32(np.inf)
    for x in range(width - 1, -1, -1):
        if state[x] == MEASURED:
            last = d[x]
            continue
        d[x] = min(d[x], last)
        if any_measured:
            right = int(np.floor(x - d[x] + np.float32(0.5)))
            hidden = right < 0 or nearest[right] > d[x] + _HIDES
            state[x] = OCCLUDED if hidden else FILLED
    return any_measured


@kernel("f4[:, ::1], u1[:, ::1]", nogil=True)
def _fill(d: Singles, state: NDArray[np.uint8]) -> None:
    """Fill all rows; a row without anything measured is like the nearest one that has something."""
    height, width = d.shape
    nearest = np.empty(width, np.float32)
    held = np.zeros(height, np.bool_)
    for y in range(height):
        held[y] = _fill_row(d[y], state[y], nearest)
    for y in range(height):
        if not held[y]:
            for k in range(1, height):
                if y - k >= 0 and held[y - k]:
                    d[y] = d[y - k]
                    break
                if y + k < height and held[y + k]:
                    d[y] = d[y + k]
                    break
            state[y] = FILLED


def filled(disparity: Singles) -> tuple[Singles, NDArray[np.uint8]]:
    """Fill what was not measured, NaN in (H, W) px, but not everywhere: (H, W) px, and the state of every pixel."""
    out, state = disparity.copy(), np.where(np.isnan(disparity), np.uint8(FILLED), np.uint8(MEASURED))
    _fill(out, state)
    return out, state


#: How far to either side, px, and the grey level difference that halves a weight.
_SMOOTH_REACH, _SMOOTH_ALIKE = 4, np.float32(8.0)
#: Difference that counts as the same surface in each round, px: above the sub-pixel error, below a break.
_ROUNDS = (1.5, 1.0)


@kernel(nogil=True)
def _weigh(
    d: Singles, grey: Image, other: Singles, other_grey: Image, tolerance: np.float32, gap: Singles, weight: Singles
) -> None:
    """Write the differences of neighbours, a row at a time, and their weights; both zero where one is NaN."""
    for x in range(np.uintp(d.shape[0])):
        apart = other[x] - d[x]
        near = abs(apart) <= tolerance
        step = np.float32(abs(np.int32(other_grey[x]) - np.int32(grey[x])))
        gap[x] = apart if near else np.float32(0)
        weight[x] = _SMOOTH_ALIKE / (_SMOOTH_ALIKE + step) if near else np.float32(0)


@kernel(nogil=True)
def _add(gap: Singles, weight: Singles, sign: np.float32, up: Singles, down: Singles) -> None:
    """Add to sums of weighted differences and of weights; with a sign of -1 to those of the neighbours."""
    for x in range(np.uintp(gap.shape[0])):
        up[x] += sign * weight[x] * gap[x]
        down[x] += weight[x]


@kernel("f4[:, ::1], const u1[:, ::1], f4, i8, i8, f4[:, ::1], f4[:, ::1]", nogil=True)
def _rows(
    source: Singles, image: Image, tolerance: np.float32, begin: int, end: int, out: Singles, share: Singles
) -> None:
    width = source.shape[1]
    gaps, weights = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(begin, end):
        up, down = out[y], share[y]
        up[:], down[:] = 0, 0
        for k in range(1, _SMOOTH_REACH + 1):
            gap, weight = gaps[: width - k], weights[: width - k]
            _weigh(source[y, :-k], image[y, :-k], source[y, k:], image[y, k:], tolerance, gap, weight)
            _add(gap, weight, np.float32(1), up[:-k], down[:-k])
            _add(gap, weight, np.float32(-1), up[k:], down[k:])
        for x in range(np.uintp(width)):
            up[x] = source[y, x] + up[x] / (down[x] + np.float32(1))
            down[x] /= np.float32(2 * _SMOOTH_REACH)


@kernel("f4[:, ::1], const u1[:, ::1], f4, i8, i8, f4[:, ::1], f4[:, ::1]", nogil=True)
def _columns(
    source: Singles, image: Image, tolerance: np.float32, begin: int, end: int, out: Singles, share: Singles
) -> None:
    height, width = source.shape
    gap, weight, down = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(begin, end):
        up, part = out[y], share[y]
        up[:], down[:] = 0, 0
        for k in range(-_SMOOTH_REACH, _SMOOTH_REACH + 1):
            if k != 0 and 0 <= y + k < height:
                _weigh(source[y], image[y], source[y + k], image[y + k], tolerance, gap, weight)
                _add(gap, weight, np.float32(1), up, down)
        for x in range(np.uintp(width)):
            up[x] = source[y, x] + up[x] / (down[x] + np.float32(1))
            part[x] = np.float32(0.5) * (part[x] + down[x] / np.float32(2 * _SMOOTH_REACH))


def smoothed(disparity: Singles, image: Image) -> tuple[Singles, NDArray[np.float32]]:
    """Smooth measured disparities.

    ``disparity``: (H, W) px; NaN where nothing was measured. ``image``: (H, W) uint8, the left image. Returns (H, W) px,
    NaN where it was; and (H, W) the share of each pixel's neighbours, each by its weight, that lie on its surface.
    """
    height = disparity.shape[0]
    share, half, out = np.empty_like(disparity), np.empty_like(disparity), disparity
    for tolerance in map(np.float32, _ROUNDS):
        source, out = out, np.empty_like(disparity)

        def rows(begin: int, end: int, source: Singles = source, limit: np.float32 = tolerance) -> None:
            _rows(source, image, limit, begin, end, half, share)

        def columns(begin: int, end: int, out: Singles = out, limit: np.float32 = tolerance) -> None:
            _columns(half, image, limit, begin, end, out, share)

        for_each_strip(height, rows)
        for_each_strip(height, columns)
    return out, share


#: A patch of one disparity that is not larger than the window of one match (7 x 7) is one mistake, not a surface.
_SPECKLE_PX = 50
#: Steps per pixel in which disparities are compared when patches are found.
_FINE = 16
#: With less than this share of the image measured, there is no result: chance alone gives some.
_LEAST_SHARE = 0.005


@dataclass(frozen=True)
class SigmaModel:
    """The uncertainty of a method: sigma^2 = floor^2 + (gain * least / curvature)^2, px.

    The second term is the noise of a minimum: the cost that remains is noise, and the curvature of the costs converts it to
    pixels. The first is independent of the costs: the pull towards whole disparities, slants, the smoothing. Both are set
    so that 1.96 sigma covers about 95% of the errors on four rendered scenes; others, and real ones, then check it.
    """

    floor_px: float
    gain: float = 0.0


@kernel("Winners, i8, i8, i2[:, ::1]", nogil=True)
def _coarse(found: Winners, begin: int, end: int, out: NDArray[np.int16]) -> None:
    """Write disparities in steps of a pixel's sixteenth, below zero where the two images do not agree."""
    for y in range(begin, end):
        for x in range(out.shape[1]):
            good = found.agreed[y, x] and found.curvature[y, x] > 0
            out[y, x] = np.int16(found.disparity[y, x] * np.float32(_FINE)) if good else np.int16(-_FINE)


@kernel("Winners, i2[:, ::1], i8, i8, f4[:, ::1]", nogil=True)
def _sure(found: Winners, kept: NDArray[np.int16], begin: int, end: int, out: Singles) -> None:
    """Write the disparities that are kept, NaN elsewhere."""
    for y in range(begin, end):
        for x in range(kept.shape[1]):
            out[y, x] = found.disparity[y, x] if kept[y, x] >= 0 else np.float32(np.nan)


def without_speckles(found: Winners) -> Singles:
    """Return the disparities (H, W) that the images agree on, NaN where a patch is too small to be plausible."""
    height, width = found.disparity.shape
    coarse, out = np.empty((height, width), np.int16), np.empty((height, width), np.float32)
    for_each_strip(height, lambda begin, end: _coarse(found, begin, end, coarse))
    cv2.filterSpeckles(coarse, -_FINE, _SPECKLE_PX, _FINE)
    for_each_strip(height, lambda begin, end: _sure(found, coarse, begin, end, out))
    return out


@kernel("Winners, u1[:, ::1], f8, f8, i8, i8, f4[:, ::1], f4[:, ::1]", nogil=True)
def _write_sigmas(
    found: Winners,
    state: NDArray[np.uint8],
    floor: float,
    gain: float,
    begin: int,
    end: int,
    sigma: Singles,
    share: Singles,
) -> None:
    """Write sigmas; a pixel that was not measured has neither sigma nor confidence."""
    low, slope = np.float32(floor), np.float32(gain)
    for y in range(begin, end):
        for x in range(state.shape[1]):
            noise = slope * found.least[y, x] / max(found.curvature[y, x], np.float32(1))
            measured = state[y, x] == MEASURED
            sigma[y, x] = np.sqrt(low * low + noise * noise) if measured else np.float32(np.nan)
            share[y, x] = share[y, x] if measured else np.float32(0)


def finished(found: Winners, left: Image, search: Search, sigma_model: SigmaModel, *, edges: bool = False) -> Disparity:
    """Convert the winners of a method to a result.

    ``left``: (H, W) uint8, the left image; ``search``: which disparities were tried; ``sigma_model``: the uncertainty of
    the method; ``edges``: whether depth breaks are aligned to the edges of the image.
    """
    sure = without_speckles(found)
    if np.count_nonzero(sure == sure) < _LEAST_SHARE * sure.size:  # NaN is not even itself
        return Disparity.none(
            (left.shape[0], left.shape[1]),
            search,
            "nothing in the left image was found in the right one: too little texture, not the same scene, or "
            f"disparities beyond {search.first} to {search.last} px",
        )
    surface, share = smoothed(sure, left)
    full, state = filled(surface)
    if edges:
        full, state = aligned_to_edges(full, state, left)
    sigma = np.empty_like(full)
    for_each_strip(
        left.shape[0],
        lambda begin, end: _write_sigmas(
            found, state, sigma_model.floor_px, sigma_model.gain, begin, end, sigma, share
        ),
    )
    return Disparity(full, state, sigma, share, search)
