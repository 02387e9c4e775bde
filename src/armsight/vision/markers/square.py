"""Square code markers (AprilTag, ArUco) placed by a fit of their whole printed pattern, with covariance.

A grey image, a marker's cells and its rough corners go in; its four corners and their covariance come out. The marker is
modelled as what it is, a grid of dark and bright cells in a white surround, seen through a homography, blur and pixels:

    I(x) = (1 + k . d) (a + b M + c (1 - M^2)),   M = sum of the cells' colours, each edge blurred as in ``edge.py``.

Every edge in the pattern tells where it lies, not the outline alone, so corners of small markers come out several times
better than from their outline. The homography is corrected by a field that is quadratic over the marker: its affine and
perspective parts are free, the others take up the bow that lens distortion gives to lines, which is small (prior). c
takes up print that bleeds and the camera's gamma, which make all dark cells look smaller or larger and would move an
outline's corners inward or outward. Levenberg-Marquardt; the covariance is that of the linearised fit with the noise
that its own residuals show.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.vision.markers.pattern import FIELD, PARAMETERS, field, fit_pattern

#: How far the window reaches beyond the outline, in cells, and how far it stays away, px, from the end of the white
#: around a marker, which is one cell wide by its rules.
MARGIN_CELLS, MARGIN_GAP_PX = (0.2, 0.6), 1.5
#: More pixels than this are thinned evenly, in the first fit, which only finds the place, and in the last.
PIXELS_FIRST, PIXELS_LAST = 500, 3000
#: The first fit starts this blurred, cells, so that corners off by most of a cell find home.
START_BLUR_CELLS = 0.4
#: A corner that ends further than this many cells from where it was found belongs to something else.
MOVED_MAX_CELLS = 2.0
#: The fit is drawn again about its own result until no corner moves by more than this, cells and px.
SETTLED_CELLS, SETTLED_PX = 0.1, 0.3
#: Largest residual as a share of the contrast (half the step between dark and bright).
MISFIT_MAX = 0.5

_ROUNDS = 5
#: Weak priors, as in ``corner.py``, of a squared blur, px^2: mean and sigma.
_BLUR2_PRIOR = (0.25, 0.25)
#: Bow of a line by lens distortion: its sag is about this times the squared length in px (a webcam near its corner).
_BOW_PER_PX = 1e-4
_BLEED_SHARE = 0.3  # c as a share of b, about
_PRIOR_NOISE = 2.0  # grey levels of noise that the priors on bow and c are weighed against

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True, eq=False)
class SquareFit(Record):
    """One marker, placed.

    Attributes:
        uv: (4, 2) corners in the order of the rough ones, raw pixels.
        cov_uv: (4, 2, 2) covariance of each, px^2.
        problem: why the fit is not to be used; None when it is good.
    """

    uv: Array
    cov_uv: Array
    problem: str | None


def place_square(
    image: NDArray[np.uint8], corners: Array, cells: NDArray[np.int8], diagonal: int | None = None
) -> SquareFit:
    """Fit one marker.

    Args:
        image: (H, W) grey image.
        corners: (4, 2) rough corners, raw pixels: those of the cells' upper left, upper right, lower right, lower left.
        cells: (N, N) the marker's cells, its dark border included: 1 bright, -1 dark.
        diagonal: what meets the marker at its corners, as a cell's colour; unknown by default, and then not looked at.

    Returns:
        The placed corners, or why they cannot be.
    """
    cell = float(np.mean(np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1))) / len(cells)
    here, blur, pixels = corners, START_BLUR_CELLS * cell, PIXELS_FIRST
    for _ in range(_ROUNDS):
        fit = _fit_from(image, here, cells, diagonal, max(1.0, blur), pixels)
        if fit.problem is not None:
            return fit
        moved = np.linalg.norm(fit.uv - here, axis=1).max()
        if not np.linalg.norm(fit.uv - corners, axis=1).max() <= max(MOVED_MAX_CELLS * cell, 1.0):
            return _bad(corners, "its corners are not where they were found")
        if moved < max(SETTLED_CELLS * cell, SETTLED_PX) and pixels == PIXELS_LAST:
            return fit
        here, blur, pixels = np.array(fit.uv), 1.0, PIXELS_LAST
    return _bad(corners, "no convergence")


def _fit_from(
    image: NDArray[np.uint8], corners: Array, cells: NDArray[np.int8], diagonal: int | None, blur: float, pixels: int
) -> SquareFit:
    """Fit one marker's field over the homography of given corners, starting at a blur in px."""
    size = len(cells)
    H: Array = cv2.getPerspectiveTransform(corners.astype(np.float32), _CORNERS.astype(np.float32)).astype(np.float64)
    px = _gather(image, corners, H, size, diagonal is not None, pixels)
    if px is None or px.shape[1] < 3 * PARAMETERS:
        return _bad(corners, "too small or too near the image border")
    low, high = np.percentile(px[0], (5, 95))
    q, prior, inverse = np.zeros(PARAMETERS), np.zeros((FIELD + 3, 2)), np.empty((PARAMETERS, PARAMETERS))
    q[FIELD], q[FIELD + 1], q[FIELD + 3] = blur * blur, 0.5 * (high - low), 0.5 * (high + low)
    side = float(np.mean(np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1)))
    prior[8:FIELD, 1] = (_PRIOR_NOISE * 0.5 / (_BOW_PER_PX * side)) ** 2
    prior[FIELD] = _BLUR2_PRIOR[0], _BLUR2_PRIOR[1] ** -2
    prior[FIELD + 2, 1] = (_PRIOR_NOISE / (_BLEED_SHARE * max(q[FIELD + 1], 1.0))) ** 2
    grid = np.pad(cells.astype(np.float64), 2, constant_values=1.0)
    grid[np.ix_((0, 1, -2, -1), (0, 1, -2, -1))] = 1.0 if diagonal is None else diagonal
    variance = fit_pattern(px.shape[1], px, grid, prior, q, inverse)
    if variance < 0.0:
        return _bad(corners, "no convergence")
    if not np.sqrt(variance) <= MISFIT_MAX * q[FIELD + 1]:
        return _bad(corners, "the pattern does not fit")
    uv, cov = _corners(q, variance * inverse[:FIELD, :FIELD], np.asarray(np.linalg.inv(H), np.float64))
    return SquareFit(uv, cov, None)


def _bad(corners: Array, problem: str) -> SquareFit:
    """Return a fit that failed."""
    return SquareFit(corners, np.zeros((4, 2, 2)), problem)


def _gather(image: NDArray[np.uint8], corners: Array, H: Array, size: int, whole: bool, pixels: int) -> Array | None:
    """Collect the pixels of a marker and its margin, (8, n) as ``fit_pattern`` takes them."""
    cell = float(np.sqrt(abs(cv2.contourArea(corners.astype(np.float32))))) / size
    margin = np.clip(1.0 - MARGIN_GAP_PX / max(cell, 1e-9), *MARGIN_CELLS)
    reach = 1.0 + 2.0 * float(margin) / size
    quad = cv2.perspectiveTransform((reach * _CORNERS)[None], np.linalg.inv(H))[0]
    low = np.maximum(np.floor(quad.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0)), np.array(image.shape[::-1]) - 1).astype(int)
    if not (np.isfinite(quad).all() and (high > low).all()):
        return None
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1].reshape(2, -1)
    p = H / (H[2] @ [*corners.mean(axis=0), 1.0]) @ np.stack([u, v, np.ones(len(u))])  # positive before the horizon
    xy = p[:2] / p[2]
    beyond = (np.abs(xy) > 1.0).all(axis=0)  # what meets the marker at its corners
    inside = (p[2] > 0) & (np.abs(xy) <= reach).all(axis=0) & (whole | ~beyond)
    chosen = np.flatnonzero(inside)
    if len(chosen) > pixels:
        chosen = chosen[np.linspace(0, len(chosen) - 1, pixels).astype(int)]
    slope = H[:2, None, :2] - xy[:, chosen][:, :, None] * H[2, :2]
    slope /= (H[2] @ [*corners.mean(axis=0), 1.0]) * p[2, chosen][None, :, None]
    steep = np.linalg.norm(slope, axis=2)
    width = np.abs(slope).max(axis=2) / steep
    cosine = (slope[0] * slope[1]).sum(axis=1) / steep.prod(axis=0)
    return np.concatenate([image[v[chosen], u[chosen]][None], xy[:, chosen], 1.0 / steep, width, cosine[None]])


def _corners(q: Array, cov: Array, H: Array) -> tuple[Array, Array]:
    """Return the corners (4, 2) and their covariance (4, 2, 2) from the field and its covariance; H: marker to image."""
    phi = np.empty((FIELD, 2))
    uv, cov_uv = np.empty((4, 2)), np.empty((4, 2, 2))
    for i, corner in enumerate(_CORNERS):
        at = corner.copy()
        for _ in range(10):  # where the field carries a point onto the corner; the field is small, so this converges
            field(at[0], at[1], phi)
            at = corner - q[:FIELD] @ phi
        x, y, w = H @ np.array([at[0], at[1], 1.0])
        uv[i] = x / w, y / w
        J = (H[:2, :2] - uv[i][:, None] * H[2, :2]) / w @ -phi.T
        cov_uv[i] = J @ cov @ J.T
    return uv, cov_uv
