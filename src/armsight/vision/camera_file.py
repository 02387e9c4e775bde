"""The intrinsics of two cameras from a JSON file, as calibrate --cameras takes them.

    {"image_size_px": [4000, 6000],
     "left":  {"K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "distortion": [k1, k2, p1, p2, k3]},
     "right": {"K": ..., "distortion": ..., "distortion_model": "fisheye"}}

``distortion`` has 0, 4, 5 or 8 coefficients in OpenCV's order; ``"distortion_model": "fisheye"`` makes four of them
Kannala-Brandt's. A camera may have its own ``image_size_px``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import SIDES
from armsight.errors import InputError
from armsight.files import read_json
from armsight.geometry.check import checked
from armsight.vision.camera import Camera

_MODELS = {0: "none", 4: "brown4", 5: "brown5", 8: "brown8"}


def read_cameras(path: str | Path) -> tuple[Camera, Camera]:
    """Read both cameras.

    Raises:
        InputError: missing, not JSON, or not two cameras; the message names the file and the entry.
    """
    document = read_json(path)
    if not isinstance(document, dict) or not all(isinstance(document.get(side), dict) for side in SIDES):
        raise InputError(f'{path}: expected an object with "left" and "right", each with "K" and "distortion"')
    size = document.get("image_size_px")
    left, right = (camera_of(path, {"image_size_px": size, **document[side]}, f"camera {side}") for side in SIDES)
    return left, right


def camera_of(path: str | Path, entry: Mapping[str, Any], name: str = "the camera") -> Camera:
    """Build a camera from its entry: K, distortion, image_size_px, and distortion_model where it is a fisheye.

    Args:
        path: the file, for messages.
        entry: the entry.
        name: of the camera, for messages.

    Raises:
        InputError: the file, the camera and what is wrong.
    """
    try:
        K = checked(entry["K"], (3, 3), "K")
        distortion = checked(entry["distortion"], (None,), "distortion")
        width, height = (int(n) for n in entry["image_size_px"])
    except KeyError as error:
        raise InputError(f"{path}: {name} has no {error.args[0]!r}") from None
    except (TypeError, ValueError, OverflowError):
        raise InputError(f'{path}: {name} needs "image_size_px": [width, height]') from None
    except InputError as error:
        raise InputError(f"{path}: {name}: {error}") from None
    if abs(K[0, 1]) > 0 or np.abs(K[[1, 2, 2], [0, 0, 1]]).max() > 0 or K[2, 2] != 1:
        raise InputError(f"{path}: {name}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not modelled")
    model = _MODELS.get(len(distortion))
    if str(entry.get("distortion_model", "")).startswith("fisheye"):
        model = "fisheye" if len(distortion) == 4 else None
    if model is None:
        raise InputError(f"{path}: {name}: {len(distortion)} distortion coefficients; known are 0, 4, 5 and 8")
    try:
        return Camera((width, height), model, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), distortion)
    except InputError as error:
        raise InputError(f"{path}: {name}: {error}") from None
