"""Discs of a board in one image: where they may be at every size, and their fits.

Discs are searched in the image and in copies of half, a quarter, ... its size with the search of disc markers
(:mod:`~armsight.vision.markers.disc.search`), so a disc may have any size, and a soft edge becomes a sharp one in a smaller
copy. Only the outline is taken there: it is cheap, and it need not be good. Which outlines are discs of a board is decided
by the grid that they form (:mod:`~armsight.vision.markers.circle_grid`); those are fitted in the image itself
(:func:`fit_discs`).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.kernels import kernel
from armsight.vision.markers.disc.common import FIELDS, SHARED, common, correct
from armsight.vision.markers.disc.fit import (
    CUT,
    HILLY,
    MOST_DISCS,
    NO_RIM,
    NOT_ELLIPSE,
    NOT_UNIFORM,
    PARAMETERS,
    REASONS,
    SURROUND,
    UNKNOWNS,
    FitBuffers,
    factor,
    fit,
    gather,
    linearise,
    normal_equations,
    of_centre,
    shape_of,
)
from armsight.vision.markers.disc.fit import workspace as workspace_of_fits
from armsight.vision.markers.disc.search import OUTLINED, Grey, Room, Words64, noise_of, search, workspace
from armsight.vision.markers.discs import copies, enlarged

#: Directions in which the contrast at a rim is compared, and how many must have this share of the median contrast.
_RAYS, _RAYS_GOOD, _RAY_SHARE = 12, 10, 0.35

_COS = np.cos(2 * np.pi * np.arange(_RAYS) / _RAYS)
_SIN = np.sin(2 * np.pi * np.arange(_RAYS) / _RAYS)
_KEPT = threading.local()


@kernel
def _level(image: Grey, u: float, v: float) -> float:
    """Return the grey at a position, bilinear; -1 outside the image."""
    if not (u >= 0.0 and v >= 0.0 and u < image.shape[1] - 1.0 and v < image.shape[0] - 1.0):
        return -1.0
    i, j = int(u), int(v)
    a, b = u - i, v - j
    top = (1 - a) * image[j, i] + a * image[j, i + 1]
    return float((1 - b) * top + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]))


@kernel
def _rim_contrast(image: Grey, theta: Array, sign: int, across: Array) -> tuple[float, bool]:
    """Compare grey inside and outside an ellipse, theta (10,), by buffer ``across`` (_RAYS,); ``sign`` 1 for a bright disc.

    Return the median contrast, grey levels, 0 where it is no closed rim; whether the middle has the surround's level.
    """
    det = theta[2] * theta[4] - theta[3] * theta[3]
    s11, s12, s22 = theta[4] / det, -theta[3] / det, theta[2] / det
    l11 = np.sqrt(s11)
    l21 = s12 / l11
    l22 = np.sqrt(max(s22 - l21 * l21, 0.0))
    beyond = 1.2 + 1.0 / np.sqrt(np.sqrt(s11 * s22 - s12 * s12))
    outside = 0.0
    for k in range(_RAYS):
        du, dv = l11 * _COS[k], l21 * _COS[k] + l22 * _SIN[k]
        near = _level(image, theta[0] + 0.75 * du, theta[1] + 0.75 * dv)
        far = _level(image, theta[0] + beyond * du, theta[1] + beyond * dv)
        if near < 0.0 or far < 0.0:
            return 0.0, False
        across[k] = sign * (near - far)
        outside += far / _RAYS
    ordered = np.sort(across)
    median = 0.5 * (ordered[_RAYS // 2 - 1] + ordered[_RAYS // 2])
    if not (median > 0.0 and ordered[_RAYS - _RAYS_GOOD] > _RAY_SHARE * median):
        return 0.0, False
    middle = 0.0
    for y in range(-1, 2):
        for x in range(-1, 2):
            middle += _level(image, theta[0] + 0.5 * x, theta[1] + 0.5 * y) / 9
    return median, sign * (middle - outside) < 0.6 * median


@kernel(
    "const u1[:, ::1], const u8[:, ::1], b1, b1, f8[:, ::1], i8[::1], i8[::1], f8[::1], "
    "(f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"
)
def _outlines(
    image: Grey, words: Words64, bright: bool, dark: bool, starts: Array, codes: NDArray[np.int64],
    signs: NDArray[np.int64], contrast: Array, room: Room,
) -> int:  # fmt: skip
    """Search an image for outlines of discs; return their number.

    ``starts`` (N, 10), ``signs`` (N,), 1 or -1 for dark ones, and ``contrast`` (N,), grey levels, are filled; the
    others are those of :func:`~armsight.vision.markers.disc.search.search`.
    """
    n, _ = search(image, words, noise_of(image), bright, dark, starts, codes, signs, room)
    across, good = np.empty(_RAYS), 0
    for i in range(n):
        if codes[i] == NOT_ELLIPSE or (codes[i] != 0 and codes[i] not in OUTLINED):
            continue
        found, _ = _rim_contrast(image, starts[i], signs[i], across)
        if found > 0.0:
            for a in range(starts.shape[1]):
                starts[good, a] = starts[i, a]
            signs[good], contrast[good] = signs[i], found
            good += 1
    return good


@kernel("const u1[:, ::1], f8[:, ::1], i8, f8[::1], b1[::1]")
def _each_contrast(image: Grey, theta: Array, sign: int, contrast: Array, hollow: NDArray[np.bool_]) -> None:
    """Fill contrast (N,) and hollow (N,) of ellipses theta (N, 10) as :func:`_rim_contrast` gives them."""
    across = np.empty(_RAYS)
    for i in range(len(theta)):
        contrast[i], hollow[i] = _rim_contrast(image, theta[i], sign, across)


@dataclass(frozen=True, eq=False)
class Blobs(Record):
    """Outlines of what may be discs of one polarity, in one image."""

    theta: Array  #: (N, 10) start of a fit: centre (raw px), M (1/px^2), blur (px), contrast, base, gradient
    contrast: Array  #: (N,) contrast at the rim, grey levels, positive
    radius_px: Array  #: (N,) geometric mean of the half axes


def find_blobs(image: Grey, bright: bool, dark: bool) -> tuple[Blobs, Blobs]:
    """Find outlines of discs of any size in one grey image (H, W): the dark ones, and the bright ones."""
    found: list[tuple[Array, Array, NDArray[np.int64]]] = []
    starts, codes, signs, contrast, room = _room()
    for scale, small in copies(image):
        n = _outlines(small, small.view(np.uint64), bright, dark, starts, codes, signs, contrast, room)
        found.append((enlarged(starts[:n], scale), contrast[:n].copy(), signs[:n].copy()))
    theta, contrast, signs = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _without_repeats(theta[signs < 0], contrast[signs < 0]), _without_repeats(
        theta[signs > 0], contrast[signs > 0]
    )


def _room() -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Array, Room]:
    if not hasattr(_KEPT, "room"):
        n = MOST_DISCS
        _KEPT.room = np.empty((n, UNKNOWNS)), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n), workspace()
    room: tuple[Array, NDArray[np.int64], NDArray[np.int64], Array, Room] = _KEPT.room
    return room


def _without_repeats(theta: Array, contrast: Array) -> Blobs:
    """Drop outlines of one disc that the next larger copies gave again; the one of the sharpest copy stays."""
    from scipy.spatial import KDTree  # not above: SciPy takes longer than a pair of images

    radius = (theta[:, 2] * theta[:, 4] - theta[:, 3] ** 2) ** -0.25
    keep = np.ones(len(theta), bool)
    if len(theta) > 1:
        tree = KDTree(theta[:, :2])
        near = tree.query_ball_point(theta[:, :2], 0.4 * radius)
        for i, others in enumerate(near):
            if keep[i]:
                again = [j for j in others if j > i and 0.6 < radius[j] / radius[i] < 1.7]
                keep[again] = False
    return Blobs(theta[keep], contrast[keep], radius[keep])


#: A hole in a disc and its soft edge end within this share of the disc's radius; the ring from there to the next shows the
#: disc's own grey.
_HOLE, _SOLID = 0.66, 0.8


def without_holes(image: Grey, theta: Array) -> Grey:
    """Fill the holes of rings theta (N, 10) with grey of the rings around them, pixel by pixel, noise and all."""
    if not len(theta):
        return image
    filled = image.copy()
    for u, v, m11, m12, m22 in theta[:, :5]:
        reach = int(np.ceil((m11 * m22 - m12 * m12) ** -0.5 * np.sqrt(max(m11, m22)))) + 1
        left, top = max(int(u) - reach, 0), max(int(v) - reach, 0)
        window = filled[top : int(v) + reach + 2, left : int(u) + reach + 2]
        y, x = np.mgrid[: window.shape[0], : window.shape[1]]
        x, y = x + left - u, y + top - v
        size = np.sqrt(m11 * x * x + 2 * m12 * x * y + m22 * y * y)
        hole, solid = size < _HOLE, window[(size >= _HOLE) & (size < _SOLID)]
        if len(solid):
            window[hole] = np.resize(solid, int(hole.sum()))
    return filled


#: Reasons of the fit that leave a usable centre: what surrounds a board's disc is known, and sharpening or a wide lens
#: bends every rim a little.
HARMLESS = (NOT_ELLIPSE, HILLY, NOT_UNIFORM)
#: If more than this share of the fits have such a reason, the image is like that.
_ODD_SHARE = 0.3


@kernel("const u1[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1], f8[::1], FitBuffers")
def _fit_each(
    image: Grey, theta: Array, cov: Array, shape: Array, codes: NDArray[np.int64], shared: Array, work: FitBuffers
) -> None:
    """Fit discs from ``theta`` (N, 10), which is replaced; the arrays of :class:`Fits` are filled."""
    noise, count = noise_of(image), 0
    for i in range(len(theta)):
        codes[i] = fit(image, noise, theta[i], cov[i], work)
        if codes[i] in HARMLESS:
            n, _ = gather(image, theta[i], work)
            if n < 4 * UNKNOWNS:
                codes[i] = CUT
                continue
            for a in range(UNKNOWNS):
                work.at[a] = theta[i, a]
            work.at[0], work.at[1] = theta[i, 0] - np.rint(theta[i, 0]), theta[i, 1] - np.rint(theta[i, 1])
            square = linearise(n, SURROUND, 0.0, work)
            normal_equations(n, work)
            if not factor(work.H, work.L, work.scale):
                codes[i] = NO_RIM
                continue
            of_centre(work, cov[i])
            for a in range(2):
                for b in range(2):
                    cov[i, a, b] *= square / (n - UNKNOWNS)
        if codes[i] == 0 or codes[i] in HARMLESS:
            shape_of(theta[i], shape[i])
        if codes[i] == 0:
            work.discs[count, :] = work.shown
            count += 1
    common(image, count, work, shared)
    count = 0
    for i in range(len(theta)):
        if codes[i] == 0:
            correct(image, noise, work.discs[count], shared, cov[i], work)
            for a in range(UNKNOWNS):
                theta[i, a] = work.discs[count, PARAMETERS + a]
            count += 1


@dataclass(frozen=True, eq=False)
class Fits(Record):
    """Fitted discs, parameters theta (N, 10) as in :class:`Blobs`; ``cov`` (N, 2, 2) of the centres, px^2.

    ``shape`` (N, 3): ellipses S11, S12, S22, px^2; ``codes`` (N,): 0 or why it is not a disc (``fit.REASONS``);
    ``common`` (2, 3) as in :class:`~armsight.data.Discs`.
    """

    theta: Array
    cov: Array
    shape: Array
    codes: NDArray[np.int64]
    common: Array

    @property
    def uv(self) -> Array:
        """(N, 2) the centres of the ellipses, raw px."""
        return self.theta[:, :2]

    def kept(self) -> NDArray[np.bool_]:
        """(N,) which fits are good; where a harmless reason speaks against many, it is the image that is so."""
        good, harmless = self.codes == 0, np.isin(self.codes, HARMLESS)
        return np.asarray(good | harmless if harmless.sum() > _ODD_SHARE * len(good) else good)

    def why_not(self) -> str:
        """Return the most frequent reason against a disc, for a message."""
        bad = self.codes[~self.kept()]
        return f", mostly: {REASONS[int(np.bincount(bad).argmax())]}" if len(bad) else ""


def odd_sized(theta: Array, factor: float) -> NDArray[np.bool_]:
    """(N,) whether a disc's area is far from what the others' areas, linear over the image, let expect.

    ``theta``: (N, 10) discs of one grid; ``factor``: by which an area may be larger or smaller, beyond what is usual among
    them.
    """
    area, uv = -0.5 * np.log(np.maximum(theta[:, 2] * theta[:, 4] - theta[:, 3] ** 2, 1e-300)), theta[:, :2]
    keep = np.ones(len(area), bool)
    basis = np.column_stack([np.ones(len(area)), (uv - uv.mean(axis=0)) / max(float(np.ptp(uv)), 1.0)])
    odd = np.zeros(len(area), bool)
    for _ in range(3 if keep.any() else 0):
        plane, *_ = np.linalg.lstsq(basis[keep], area[keep], rcond=None)
        off = np.abs(area - basis @ plane)
        odd = off > np.log(factor) + 2.0 * np.median(off[keep])
        if not (odd & keep).any() or (keep & ~odd).sum() < 4:
            break
        keep &= ~odd
    return odd


def contrasts(image: Grey, theta: Array, sign: int) -> tuple[Array, NDArray[np.bool_]]:
    """Compare grey inside and outside of ellipses theta (N, 10); ``sign`` 1 for bright discs, -1 for dark ones.

    Return (N,) contrast in grey levels, 0 where the rim is not closed; (N,) whether the middle has the surround's level.
    """
    contrast, hollow = np.empty(len(theta)), np.empty(len(theta), bool)
    _each_contrast(np.ascontiguousarray(image), np.ascontiguousarray(theta), sign, contrast, hollow)
    return contrast, hollow


def like_neighbours(uv: Array, theta: Array) -> Array:
    """Return starts (K, 10) of discs at positions uv (K, 2) that look like the four nearest known ones, theta (N, 10)."""
    out = np.empty((len(uv), UNKNOWNS))
    for i, position in enumerate(uv):
        nearest = np.argsort(np.linalg.norm(theta[:, :2] - position, axis=1))[:4]
        out[i] = np.median(theta[nearest], axis=0)
        out[i, :2] = position
    return out


def fit_discs(image: Grey, starts: Array) -> Fits:
    """Fit discs in a grey image (H, W) from starts (N, 10)."""
    theta, n = np.array(starts, order="C"), len(starts)
    cov, shape, codes, shared = np.zeros((n, 2, 2)), np.ones((n, 3)), np.zeros(n, np.int64), np.empty(SHARED)
    if not hasattr(_KEPT, "work"):
        _KEPT.work = workspace_of_fits()
    _fit_each(np.ascontiguousarray(image), theta, cov, shape, codes, shared, _KEPT.work)
    return Fits(theta, cov, shape, codes, shared[FIELDS:].reshape(2, 3))
