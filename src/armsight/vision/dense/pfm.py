"""Portable float maps (PFM): the Middlebury benchmark's disparity files, rows from the bottom up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.errors import InputError
from armsight.files import replacing


def read_pfm(path: str | Path) -> NDArray[np.float32]:
    """Read a grey PFM file into (H, W), the first row at the top.

    Raises:
        InputError: missing, unreadable, or no grey PFM.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        kind, size, scale, rest = data.split(b"\n", 3)
        width, height = (int(n) for n in size.split())
        order = "<f4" if float(scale) < 0 else ">f4"
        if kind.strip() != b"Pf" or width < 1 or height < 1 or len(rest) < 4 * width * height:
            raise ValueError
    except ValueError:
        raise InputError(f"{path}: not a grey PFM file: expected Pf, its size, a scale and the pixels") from None
    pixels = np.frombuffer(rest, order, width * height).reshape(height, width)
    return np.ascontiguousarray(pixels[::-1], dtype=np.float32)


def write_pfm(path: str | Path, image: NDArray[np.floating[Any]], scale: float = 1.0) -> None:
    """Write a grey PFM file (H, W), little-endian; NaN becomes infinity, the benchmark's "unknown".

    Args:
        path: where to.
        image: (H, W).
        scale: what is written is so many times as much, as for mm in place of m.

    Raises:
        InputError: the file cannot be written.
    """
    height, width = image.shape
    with replacing(path, "wb") as file:
        file.write(f"Pf\n{width} {height}\n-1.0\n".encode())
        for row in image[::-1]:
            file.write(np.where(np.isnan(row), np.inf, scale * row).astype("<f4").tobytes())
