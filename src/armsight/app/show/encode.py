"""Records, arrays and paths in, what JSON holds out; and images as JPEG to look at."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from armsight.data import Image


def json_of(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return records, arrays, paths and what holds them as JSON has it; null replaces every NaN and infinity."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {each.name: json_of(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_of(each) for key, each in value.items()}
    if hasattr(value, "_asdict"):
        return json_of(value._asdict())
    if hasattr(value, "tolist"):  # an array or a number of numpy
        return json_of(value.tolist())
    if isinstance(value, list | tuple):
        return [json_of(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def jpeg(image: Image, side_px: int, quality: int) -> bytes:
    """Return an image as JPEG to look at, its longer side of so many pixels at most."""
    import cv2

    from armsight.vision.image import grey

    shown, scale = image if image.dtype == "uint8" else grey(image), side_px / max(image.shape[:2])
    if scale < 1.0:
        shown = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
