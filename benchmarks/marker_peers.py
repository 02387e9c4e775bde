"""Metric 3: other finders on the same noise, blur and contrast: ms an image (cold, one thread) and px.

Discs are dark on bright, as OpenCV's blob detector wants them by default. Tags are squares as wide as the discs, the white
rim not counted, tilted alike; a tag's position is the crossing of its diagonals, beside the error of a single corner.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from disc_images import HEIGHT, WIDTH, add_region, ellipse_border, exposed, polygon_border, scatter
from marker_report import Report, disc_target, ring, timed

DARK, BRIGHT, NOISE, BLUR, TARGETS = 40.0, 160.0, 2.0, 0.8, 4
FAMILY = "tag36h11"


def squares(rng: np.random.Generator, radius: float, count: int = TARGETS) -> np.ndarray:
    """Return maps (N, 2, 3) from [-1, 1]^2 to squares as wide as discs of a radius, tilted and rotated, apart."""
    uv = scatter(np.full(count, 2.2 * radius), 20.0, rng)
    out = []
    for position in uv[np.isfinite(uv[:, 0])]:
        a, b, c = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi), np.cos(np.radians(rng.uniform(0, 45)))
        R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        tilt = np.array([[np.cos(b), -np.sin(b)], [np.sin(b), np.cos(b)]])
        out.append(np.column_stack([radius * tilt @ np.diag([1.0, c]) @ R, position]))
    return np.array(out)


def tag_picture(
    rng: np.random.Generator, radius: float, count: int = TARGETS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an image of tags, their centres (N, 2) and corners (N, 4, 2)."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    light = np.full((HEIGHT, WIDTH), BRIGHT)
    maps = squares(rng, radius, count)
    for A in maps:
        bits = cv2.aruco.generateImageMarker(known, int(rng.integers(0, 587)), 8, borderBits=1) > 127
        edges = np.linspace(-1, 1, 9)
        for j, row in enumerate(bits):
            dark = np.flatnonzero(np.diff(np.r_[True, row, True].astype(int)))  # a run's start and end alternately
            for start, end in dark.reshape(-1, 2):
                x, y = edges[[start, end]], edges[[j, j + 1]]
                cell = np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]])
                add_region(light, polygon_border(cell @ A.T, BLUR), BLUR, DARK - BRIGHT)
    square = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float)
    maps = np.reshape(maps, (-1, 2, 3))
    return exposed(light, NOISE, 0.0, rng), maps[:, :, 2], square @ maps.transpose(0, 2, 1)


def disc_pictures(rng: np.random.Generator, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return an image of dark discs and their centres (N, 2)."""
    light = np.full((HEIGHT, WIDTH), BRIGHT)
    maps = squares(rng, radius)
    for A in maps:
        a, b = np.linalg.svd(A[:, :2])[1]
        S = A[:, :2] @ A[:, :2].T
        add_region(
            light,
            ellipse_border(*A[:, 2], a, b, 0.5 * np.arctan2(2 * S[0, 1], S[0, 0] - S[1, 1]), BLUR),
            BLUR,
            DARK - BRIGHT,
        )
    return exposed(light, NOISE, 0.0, rng), maps[:, :, 2]


def blobs() -> Callable:
    finder = cv2.SimpleBlobDetector_create()
    return lambda image: np.array([k.pt for k in finder.detect(image)])


def contours(image: np.ndarray) -> list[np.ndarray]:
    _, binary = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    found, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [c for c in found if len(c) >= 8]


def moments(image: np.ndarray) -> np.ndarray:
    return np.array(
        [(m["m10"] / m["m00"], m["m01"] / m["m00"]) for c in contours(image) if (m := cv2.moments(c))["m00"] > 0]
    )


def ellipses(image: np.ndarray) -> np.ndarray:
    return np.array([cv2.fitEllipse(c)[0] for c in contours(image)])


def crossing(corners: np.ndarray) -> np.ndarray:
    """Return where the diagonals of quadrilaterals (N, 4, 2) cross."""
    a, c, b, d = corners[:, 0], corners[:, 2], corners[:, 1], corners[:, 3]
    p, q, r = c - a, d - b, b - a
    t = (r[:, 0] * q[:, 1] - r[:, 1] * q[:, 0]) / (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    return a + t[:, None] * p


def aruco(window_cells: float) -> Callable:
    """Return OpenCV's marker finder with its corners refined in a window of so many cells of a marker to each side."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.relativeCornerRefinmentWinSize = window_cells
    parameters.cornerRefinementWinSize = 10  # else it cuts a wide window to 5 px
    finder = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)
    return lambda image: np.array(finder.detectMarkers(image)[0]).reshape(-1, 4, 2)


def apriltags(decimate: float) -> Callable | None:
    try:
        from pyapriltags import Detector
    except ImportError:
        return None
    finder = Detector(families=FAMILY, nthreads=1, quad_decimate=decimate)
    # Its pixel (0, 0) is the corner of the top-left pixel; ours is that pixel's centre.
    return lambda image: np.array([d.corners for d in finder.detect(image)]).reshape(-1, 4, 2) - 0.5


def nearest(found: np.ndarray, true: np.ndarray, within: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (M, 2) of the true positions that were found, and which they are."""
    if not len(found):
        return np.zeros((0, 2)), np.zeros(0, int)
    distance = np.linalg.norm(true[:, None] - found[None], axis=2)
    j = distance.argmin(axis=1)
    good = np.flatnonzero(distance[np.arange(len(true)), j] < within)
    return found[j[good]] - true[good], good


def rms(e: np.ndarray) -> float:
    """Return the RMS of errors (N, 2) along an axis, which compares with a sigma."""
    return float(np.sqrt((e**2).mean())) if e.size else float("nan")


def row(report: Report, name: str, radius: int, way: Callable, frames: list, truth: list) -> None:
    """Time a finder on cold frames, print its row.

    Args:
        report: where to.
        name: of the row.
        radius: of the targets, px.
        way: image -> positions (N, 2) or corners (N, 4, 2).
        frames: a ring of the images.
        truth: for each image its centres (N, 2), for tags with the corners (N, 4, 2).
    """
    times, results = timed(way, frames)
    e, corner, count = [np.zeros((0, 2))], [np.zeros((0, 2))], 0
    for i, found in enumerate(results):
        uv, corners = truth[i % len(truth)]
        count += len(uv)
        if len(found) and found.ndim == 3:
            corner.append(nearest(found.reshape(-1, 2), corners.reshape(-1, 2))[0])
            found = crossing(found)
        e.append(nearest(found, uv)[0])
    errors, ms = np.concatenate(e), float(np.median(times)) / 1e3
    each = rms(np.concatenate(corner))
    report.say(
        f"  {name:46s} {ms:8.3f} ms   {rms(errors):.4f} px an axis{'' if np.isnan(each) else f', a corner {each:.4f}'}"
        f"   found {len(errors)} of {count}"
    )
    report.found[f"{name}, {2 * radius} px"] = {"ms": ms, "px": rms(errors), "found": len(errors), "of": count}


def metric(seed: int, report: Report, images: int = 60) -> None:
    for radius in (20, 10):
        rng = np.random.default_rng(seed + radius)
        report.say(
            f" {TARGETS} targets {2 * radius} px wide on an HD image, contrast {BRIGHT - DARK:g}, blur {BLUR}, noise "
            f"{NOISE:g}, tilt to 45 degrees"
        )
        pictures = [disc_pictures(rng, radius) for _ in range(images)]
        frames, truth = ring([image for image, _ in pictures]), [(uv, None) for _, uv in pictures]
        target = disc_target(False)
        ours = lambda image, target=target: target.find(image).uv  # noqa: E731
        row(report, "armsight discs, whole image", radius, ours, frames, truth)
        for name, way in (
            ("cv2 SimpleBlobDetector, default", blobs()),
            ("cv2 Otsu, findContours, moments", moments),
            ("cv2 Otsu, findContours, fitEllipse", ellipses),
        ):
            row(report, name, radius, way, frames, truth)
        tags = [tag_picture(rng, radius) for _ in range(images)]
        frames, truth = ring([image for image, _, _ in tags]), [tag[1:] for tag in tags]
        for name, way in (
            ("cv2.aruco, subpixel corners, default window", aruco(0.3)),
            ("cv2.aruco, subpixel corners, window of a cell", aruco(1.0)),
            *((f"pyapriltags, decimate {d:g}", apriltags(d)) for d in (1.0, 2.0)),
        ):
            if way is None:
                report.say(f"  {name:46s} not installed")
            else:
                row(report, name, radius, way, frames, truth)
