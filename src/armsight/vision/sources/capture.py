"""Open OpenCV's video capture so that what goes wrong is said by armsight, in one line, and not by OpenCV on stderr."""

from __future__ import annotations

import os
from collections.abc import Sequence

import cv2

#: Read by OpenCV when it first uses them; what the user has set stays.
_ENVIRONMENT = {
    "OPENCV_FFMPEG_LOGLEVEL": "-8",  # FFmpeg's level for quiet
    "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT": "2",  # s; instead of 10, so that a camera's stall is seen in time
}


def open_capture(what: str, api: int = cv2.CAP_ANY, parameters: Sequence[int] = ()) -> cv2.VideoCapture | None:
    """Open a file, an address or a device; None if OpenCV cannot."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(what, api, parameters)
    return capture if capture.isOpened() else None
