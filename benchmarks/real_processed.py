"""Recorded boards again after a camera's processing: how many are found, and how far their points move by it.

    ARMSIGHT_DATA=.. python benchmarks/real_processed.py [SET...] [--images 8]

Images of real cameras are sharpened, compressed, darkened, blurred, scaled ... and searched again. A board counts as found
again where it was found in the image as recorded; the RMS is of its points against those, an axis, in recorded pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import cv2
import numpy as np
from scipy.spatial import KDTree

from armsight.vision.image import grey, read_image
from armsight.vision.markers.board import open_board
from real_discs import SETS as DISCS
from real_sets import DATA
from real_sets import SETS as CHESSBOARDS

#: A point that another one is nearest to within this is the same, px.
NEAR_PX = 5.0
RNG = np.random.default_rng(0)


def pixels(levels) -> np.ndarray:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def jpeg(quality: int):
    return lambda image: cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0)


def sharpened(amount: float, sigma: float):
    return lambda image: pixels(image + amount * (image - cv2.GaussianBlur(image, (0, 0), sigma).astype(float)))


def scaled(factor: float):
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return lambda image: cv2.resize(image, None, fx=factor, fy=factor, interpolation=way)


def smeared(length: int, angle_deg: float):
    line = np.zeros((length, length))
    line[length // 2] = 1.0
    middle = (length / 2 - 0.5, length / 2 - 0.5)
    kernel = cv2.warpAffine(line, cv2.getRotationMatrix2D(middle, angle_deg, 1.0), (length, length))
    return lambda image: cv2.filter2D(image, -1, kernel / kernel.sum())


#: Name -> what is done to a grey image, and by what it is scaled.
PROCESSES: dict[str, tuple[Callable, float]] = {
    "as recorded": (lambda image: image, 1.0),
    "JPEG 50": (jpeg(50), 1.0),
    "JPEG 20": (jpeg(20), 1.0),
    "unsharp 1.5 at 1.5 px": (sharpened(1.5, 1.5), 1.0),
    "gamma 0.45": (lambda image: pixels(255 * (image / 255) ** 0.45), 1.0),
    "gamma 2.2": (lambda image: pixels(255 * (image / 255) ** 2.2), 1.0),
    "noise of 8 levels": (lambda image: pixels(image + RNG.normal(0, 8, image.shape)), 1.0),
    "0.15 of the light, noise": (lambda image: pixels(0.15 * image + RNG.normal(0, 1.5, image.shape)), 1.0),
    "1.8 of it, saturated": (lambda image: pixels(1.8 * image), 1.0),
    "light falling to a quarter": (lambda image: pixels(image * np.linspace(0.25, 1, image.shape[1])), 1.0),
    "blur of 2 px": (lambda image: cv2.GaussianBlur(image, (0, 0), 2), 1.0),
    "motion of 7 px": (smeared(7, 30.0), 1.0),
    "median of 5 px": (lambda image: cv2.medianBlur(image, 5), 1.0),
    "edge-keeping denoise": (lambda image: cv2.bilateralFilter(image, 9, 30, 5), 1.0),
    "local equalisation": (lambda image: cv2.createCLAHE(3.0, (8, 8)).apply(image), 1.0),
    "half the size": (scaled(0.5), 0.5),
    "1.5 times the size": (scaled(1.5), 1.5),
}


def main() -> None:
    sets = {name: (f"real/{name}/{images}", spec) for name, (images, spec, _, _) in DISCS.items()}
    sets |= {name: (f"stereo/{name}/*.{end}", spec) for name, (end, spec, _) in CHESSBOARDS.items()}
    sets["kuka2"] = ("handeye/kuka2/*.png", "chessboard:24x17:15mm")
    sets["ur3a"] = ("real/ur3a/cam*.png", "chessboard:9x7:20mm")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(sets)}; all by default")
    parser.add_argument("--images", type=int, default=8, help="of each set, evenly chosen")
    given = parser.parse_args()
    if unknown := [name for name in given.sets if name not in sets]:
        parser.error(f"no set {', '.join(unknown)}")
    rows: dict[str, list[str]] = {process: [] for process in PROCESSES}
    for name in given.sets or sets:
        paths, spec = sets[name]
        files = sorted(DATA.glob(paths))
        if not files:
            print(f"{name}: not here")
            continue
        board = open_board(spec)
        images = [grey(read_image(path)) for path in files[:: max(1, len(files) // given.images)]]
        before = [board.detect(image) for image in images]
        for process, (changed, scale) in PROCESSES.items():
            off = []
            for image, first in zip(images, before, strict=True):
                now = board.detect(np.ascontiguousarray(changed(image)))
                if first.problem is None and now.problem is None:
                    uv = (now.uv + 0.5) / scale - 0.5
                    far, at = KDTree(first.uv).query(uv)
                    same = far < NEAR_PX
                    off.append(float(np.sqrt(np.mean((uv[same] - first.uv[at[same]]) ** 2))))
            there = sum(first.problem is None for first in before)
            rows[process].append(f"{len(off)}/{there} {np.median(off) if off else np.nan:.3f}")
        print(f"{name}: {len(images)} images", flush=True)
    print("\n" + " | ".join(["found again, px RMS", *(given.sets or sets)]))
    for process, cells in rows.items():
        print(" | ".join([process, *cells]))


if __name__ == "__main__":
    main()
