"""Image files in, arrays out; a damaged file is an error, never half a picture.

OpenCV decodes a truncated file into a picture with a grey rest and says nothing to the caller, so the end of JPEG and
PNG data is looked for before decoding.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.errors import InputError

_STDERR = threading.Lock()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Send what C libraries write to stderr nowhere: libjpeg and libpng print warnings there on their own."""
    with _STDERR:
        kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(null)


def _jpeg_ends(data: bytes) -> bool:
    """Whether JPEG data holds the end of its picture: walk the segments to the scan, then look for its end marker.

    Inside a scan FF is always escaped, so the first FF D9 after its start is the end; a thumbnail's lies before.
    """
    place = 2
    while place + 4 <= len(data):
        if data[place] != 0xFF:
            return False
        if data[place + 1] == 0xFF:  # fill byte
            place += 1
        elif data[place + 1] == 0xDA:
            return data.find(b"\xff\xd9", place) >= 0
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return False


def _png_ends(data: bytes) -> bool:
    """Whether PNG data holds its last chunk, whole."""
    place = 8
    while place + 12 <= len(data):
        if data[place + 4 : place + 8] == b"IEND":
            return True
        place += 12 + int.from_bytes(data[place : place + 4], "big")
    return False


#: First bytes of a file -> what it is, and how to tell that it is whole.
_FORMATS = {b"\xff\xd8\xff": ("JPEG", _jpeg_ends), b"\x89PNG\r\n\x1a\n": ("PNG", _png_ends)}


def read_image(path: str | Path) -> Image:
    """Read an image file as it is stored; an EXIF orientation is ignored, for pixels must stay where the camera saw them.

    Returns:
        (H, W) grey or (H, W, 3) BGR, uint8 or uint16.

    Raises:
        InputError: missing, unreadable, not an image, or truncated; the message names the file.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise InputError(f"{path}: the file is empty")
    for start, (kind, ends) in _FORMATS.items():
        if data.startswith(start) and not ends(data):
            raise InputError(
                f"{path}: truncated {kind} image ({len(data)} bytes, and its end is missing); copy it again"
            )
    image = None
    with _quiet(), contextlib.suppress(cv2.error):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{path}: not an image that can be read (JPEG, PNG, TIFF, BMP, PGM, ...)")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: pixels are {image.dtype}; expected 8 or 16 bits, unsigned")
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[:, :, :3]
    elif image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    return np.ascontiguousarray(image)


def grey(image: Image) -> NDArray[np.uint8]:
    """Turn an image into 8-bit grey.

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) BGR or (H, W, 4) BGRA, uint8 or uint16; 16 bits are scaled by 1/257.

    Returns:
        (H, W) uint8, read-only whatever the image is: to compiled functions arrays that are read-only and arrays that are
        not are two types, and they would be compiled again for the other.

    Raises:
        InputError: another shape or type.
    """
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or 0 in image.shape:
        raise InputError(f"an image must be (H, W) or (H, W, 3), 8 or 16 bits; got {image.shape} of {image.dtype}")
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise InputError(f"an image has 1 (grey), 3 (BGR) or 4 (BGRA) channels, got {image.shape[2]}")
    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] == 1 else cv2.cvtColor(image[:, :, :3].copy(), cv2.COLOR_BGR2GRAY)
    if image.dtype == np.uint16:
        image = np.rint(image / 257.0).astype(np.uint8)
    out = np.ascontiguousarray(image).view()
    out.flags.writeable = False
    return out
