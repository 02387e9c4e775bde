"""Images that show which camera and which frame they are: left frame k is grey 10k, right frame k grey 10k + 5."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest


def level(side: str, k: int) -> int:
    return 10 * k + (5 if side == "right" else 0)


@pytest.fixture
def picture() -> Callable[..., np.ndarray]:
    """Make the image of a side and a frame number."""

    def make(side: str, k: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
        return np.full((size[1], size[0], 3), level(side, k), np.uint8)

    return make


@pytest.fixture
def read_back() -> Callable[[np.ndarray], tuple[str, int]]:
    """Read side and frame number from an image; lossy codecs move the grey by less than 2."""

    def read(image: np.ndarray) -> tuple[str, int]:
        value = float(np.mean(image))
        k, rest = divmod(value + 2, 10)
        assert rest < 4 or 5 <= rest < 9, value
        return ("left" if rest < 4 else "right"), int(k)

    return read


@pytest.fixture
def store(picture: Callable[..., np.ndarray]) -> Callable[..., Path]:
    """Write frame k of a side to a file."""

    def write(path: Path, side: str, k: int) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), picture(side, k))
        return path

    return write
