"""Boards in the real recordings: found in every image; chessboards located more smoothly than by OpenCV."""

import cv2
import numpy as np
import pytest

from armsight.vision.image import grey, read_image
from armsight.vision.markers.board import open_board
from armsight.vision.markers.chessboard import find_grid

COLUMNS, ROWS = 9, 6


def roughness(ids, uv):
    """Return the typical residual, px an axis, of positions from a perspective and a smooth quartic field over the board.

    Lens distortion and the board's bend are smooth over the board; errors of single corners are not.
    """
    x, y = (ids % COLUMNS) / 4.0 - 1.0, (ids // COLUMNS) / 2.5 - 1.0
    basis = np.stack([x**i * y**j for i in range(5) for j in range(5 - i)], axis=1)
    H, _ = cv2.findHomography(np.stack([x, y], axis=1), uv)
    p = np.stack([x, y, np.ones(len(x))], axis=1) @ H.T
    bent = uv - p[:, :2] / p[:, 2:]
    left = bent - basis @ np.linalg.lstsq(basis, bent, rcond=None)[0]
    freedom = len(x) / (len(x) - basis.shape[1])
    return np.sqrt(np.median(np.sum(left**2, axis=1)) / (2 * np.log(2)) * freedom)


@pytest.mark.parametrize(
    ("folder", "images"),
    [("webcams-360p", 58), ("opencv-480p", 26), ("stereopi-240p", 60)],
    ids=lambda value: str(value),
)
def test_boards_are_found_in_every_image_and_posed_smoothly(data_dir, folder, images):
    board = open_board(f"chessboard:{COLUMNS}x{ROWS}:25mm")
    paths = sorted(path for path in (data_dir / "stereo" / folder).iterdir() if path.suffix in (".jpg", ".png"))
    assert len(paths) == images
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    ours, theirs = [], []
    for path in paths:
        image = grey(read_image(path))
        found = board.detect(image)
        assert found.problem is None, f"{path.name}: {found.problem}"
        assert len(found.ids) >= 48, path.name
        ours.append(roughness(found.ids, found.uv))
        rough = find_grid(image, COLUMNS, ROWS).reshape(-1, 1, 2).astype(np.float32)
        posed = cv2.cornerSubPix(image, rough, (5, 5), (-1, -1), stop).reshape(-1, 2).astype(np.float64)
        theirs.append(roughness(np.arange(COLUMNS * ROWS), posed))
    assert np.median(ours) < 0.07
    assert np.median(ours) < 0.75 * np.median(theirs)


def test_left_and_right_agree_on_the_first_corner(data_dir):
    board = open_board(f"chessboard:{COLUMNS}x{ROWS}:25mm")
    for pair in range(1, 5):
        left, right = (
            board.detect(grey(read_image(data_dir / "stereo" / "opencv-480p" / f"{side}0{pair}.jpg")))
            for side in ("left", "right")
        )
        along = [
            found.uv[np.searchsorted(found.ids, 8)] - found.uv[np.searchsorted(found.ids, 0)] for found in (left, right)
        ]
        assert along[0] @ along[1] > 0.7 * np.linalg.norm(along[0]) * np.linalg.norm(along[1])


@pytest.mark.parametrize(
    ("folder", "images", "spec", "least"),
    [
        ("discocal", "*.png", "circles:4x3:90mm", 11),
        ("dice-dots", "*_?4.jpg", "circles:14x10:7mm:rings=2x7,11x7,2x2", 100),
        ("boof-circle-regular", "*.jpg", "circles:10x8:25mm", 80),
        ("boof-circle-asym", "*.jpg", "acircles:4x5:30mm", 18),
        ("open3dv-discs", "*.png", "acircles:7x11:10mm", 77),
    ],
)
def test_boards_of_discs_are_found_in_every_image(data_dir, folder, images, spec, least):
    board = open_board(spec)
    paths = sorted((data_dir / "real" / folder).glob(images))
    if not paths:
        pytest.skip(f"real/{folder} is not in the recordings")
    for path in paths:
        found = board.detect(grey(read_image(path)))
        assert found.problem is None, f"{path.name}: {found.problem}"
        assert len(found.ids) >= least, path.name
