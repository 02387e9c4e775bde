"""TIFF files as they are, floats included: some scenes keep their truth so, some cameras their images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def read_tiff(path: str | Path) -> NDArray[Any] | None:
    """Read a TIFF file into (H, W) or (H, W, 3) of its own type; None where OpenCV cannot."""
    if not Path(path).is_file():
        return None
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # or it warns of tags it does not know
    try:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(level)
    return None if image is None else np.asarray(image)
