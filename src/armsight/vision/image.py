"""Image files in, arrays out; a damaged file is an error, never half an image.

OpenCV decodes a truncated file to an image with a grey rest and does not report it, so the end of JPEG and PNG data is
searched before decoding. (Pillow reports truncation, but it reduces 16-bit colours to 8 bits, its JPEG decoder need not
agree with OpenCV's bit by bit, and it is not a dependency.)
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import struct
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight import MOST_PIXELS
from armsight.data import Image, Shot
from armsight.errors import InputError
from armsight.files import opened, read_bytes

#: Largest image file that is read whole; half: PNG of 30 Mpx of 16 bits are rejected; double: as much more memory.
IMAGE_MB = 128
#: Largest file of any format: MOST_PIXELS of three channels of 16 bits, uncompressed; OpenCV reads those in pieces.
_RAW_MB = 1.01 * MOST_PIXELS * 6 / 1e6
_STDERR = threading.Lock()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Discard what C libraries write to file descriptor 2: libjpeg and libpng print warnings there, past Python.

    The descriptor is the process's, so the lock admits one decoder at a time and the replacement lasts for one decode only.
    """
    with _STDERR:
        kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(null)


def jpeg_in(data: bytes) -> bytes | None:
    """Return the JPEG that data begins with, None if it is none, or cut short: walk the segments to the scan and its end.

    Inside a scan FF is always escaped, so the first FF D9 after its start is the end; a thumbnail's lies before.
    """
    at = 2 if data.startswith(b"\xff\xd8\xff") else len(data)
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xFF:  # fill byte
            at += 1
        elif data[at + 1] == 0xDA:
            end = data.find(b"\xff\xd9", at)
            return data[: end + 2] if end >= 0 else None
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _png_complete(data: bytes) -> bool:
    """Whether PNG data holds its last chunk, whole."""
    at = 8
    while at + 12 <= len(data):
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return False


#: First bytes of a file -> its format, and the check that it is complete.
_FORMATS = {b"\xff\xd8\xff": ("JPEG", jpeg_in), b"\x89PNG\r\n\x1a\n": ("PNG", _png_complete)}


#: First numbers of a TIFF and of a BigTIFF -> their header, number of entries and entry, as struct has them.
_TIFF = {42: ("4xI", "H", "HHIH2x"), 43: ("8xQ", "Q", "HHQH6x")}
_ORIENTATION = 274  # tag of a TIFF's first directory, and of EXIF
#: Orientation -> by how many right angles, counterclockwise, OpenCV's image is rotated to be as stored.
_BACK = {3: 2, 6: 1, 8: 3}


def _right_angles(file: IO[bytes]) -> int:
    """Return by how many right angles, counterclockwise, OpenCV's image of a file must be rotated to be as stored.

    OpenCV (5.0.0) applies a TIFF's orientation under every flag, IMREAD_UNCHANGED included, and a JPEG's, PNG's, WebP's not
    under that one. Where a TIFF's is a mirroring, its rows are stored mirrored, and OpenCV's image is the one to take.
    """
    with contextlib.suppress(struct.error, OSError, OverflowError, ValueError):  # a damaged file's offset may be any
        start = file.read(16)
        order = {b"II": "<", b"MM": ">"}.get(start[:2])
        layout = _TIFF.get(struct.unpack_from(f"{order}H", start, 2)[0]) if order else None
        if layout is not None:
            header, number, entry = (f"{order}{part}" for part in layout)
            file.seek(struct.unpack_from(header, start)[0])
            (count,) = struct.unpack(number, file.read(struct.calcsize(number)))
            entries = file.read(min(count, 0xFFFF) * struct.calcsize(entry))
            return next(
                (_BACK.get(value, 0) for tag, *_, value in struct.iter_unpack(entry, entries) if tag == _ORIENTATION), 0
            )
    return 0


def read_image(path: str | Path) -> Image:
    """Read an image file as stored, for pixels must stay where the camera has them; only a TIFF's mirroring is applied.

    Returns (H, W) grey or (H, W, 3) BGR, uint8 or uint16. Raises InputError: missing, unreadable, not an image, or
    truncated; the message names the file.
    """
    with opened(path, _RAW_MB) as file:
        piecewise = os.fstat(file.fileno()).st_size > IMAGE_MB * 1e6 and not file.read(8).startswith(tuple(_FORMATS))
        file.seek(0)
        back = _right_angles(file)
    if piecewise:
        image = None
        with _quiet(), contextlib.suppress(cv2.error):
            image = cv2.imread(os.fspath(path), cv2.IMREAD_UNCHANGED)
        return _checked(image, path, back)
    data = read_bytes(path, IMAGE_MB)
    if not data:
        raise InputError(f"{path}: the file is empty")
    return decoded(data, path)


def decoded(data: bytes, path: str | Path) -> Image:
    """Decode an image file that was read, or stood in a recording; as :func:`read_image`."""
    for start, (kind, complete) in _FORMATS.items():
        if data.startswith(start) and not complete(data):
            raise InputError(
                f"{path}: truncated {kind} image ({len(data)} bytes, and its end is missing); copy it again"
            )
    image = None
    with _quiet(), contextlib.suppress(cv2.error):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return _checked(image, path, _right_angles(io.BytesIO(data)))


def _checked(image: Image | None, path: str | Path, back: int) -> Image:
    """Return OpenCV's image without its alpha, rotated back; reject None, and what has not 8 or 16 bits."""
    if image is None:
        raise InputError(
            f"{path}: not an image that can be read (JPEG, PNG, TIFF, BMP, PGM, ... of {MOST_PIXELS >> 20} Mpx at most)"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: pixels are {image.dtype}; expected 8 or 16 bits, unsigned")
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[:, :, :3]
    elif image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    return np.ascontiguousarray(np.rot90(image, back))


#: An image is dark where all but this share of its pixels are below so many of 255 grey levels.
_DARK, _LIT_SHARE = 32, 1e-3


def darkness(image: NDArray[np.uint8]) -> str:
    """Return "the image is dark: ..." where a grey image (H, W) shows next to nothing, else an empty string."""
    if np.count_nonzero(image >= _DARK) > _LIT_SHARE * image.size:
        return ""
    level = float(np.percentile(image, 100.0 * (1.0 - _LIT_SHARE)))
    return f"the image is dark: 99.9% of it at most {level:.0f} of 255 grey levels: light the scene, or expose longer"


def one_image(left: Image, right: Image) -> bool:
    """Return whether two images are one and the same, and show something."""
    return np.array_equal(left, right) and bool(np.ptp(left) > 0)


def grey(image: Image) -> NDArray[np.uint8]:
    """Convert an image, (H, W), (H, W, 1), (H, W, 3) BGR or (H, W, 4) BGRA, uint8 or uint16, to 8-bit grey (H, W).

    uint16 is scaled as :func:`eight_bits`. The result is always read-only: for compiled functions read-only and writable
    arrays are two types, and each type is compiled separately. InputError: another shape or type.
    """
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or 0 in image.shape:
        raise InputError(f"an image must be (H, W) or (H, W, 3), 8 or 16 bits; got {image.shape} of {image.dtype}")
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise InputError(f"an image has 1 (grey), 3 (BGR) or 4 (BGRA) channels, got {image.shape[2]}")
    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] == 1 else cv2.cvtColor(image[:, :, :3].copy(), cv2.COLOR_BGR2GRAY)
    out = np.ascontiguousarray(eight_bits(image)).view()
    out.flags.writeable = False
    return out


def eight_bits(image: Image) -> NDArray[np.uint8]:
    """Return an image, uint8 or uint16, as uint8; 65535 is 255, so shift an array of 12 bits first: ``image << 4``.

    One image does not show how many bits its camera has; sources fill all 16 (:class:`BitDepth`).
    """
    return image if image.dtype == np.uint8 else np.rint(image / 257.0).astype(np.uint8)


#: Images of a recording that are looked at for its bits; half: a bright one is missed sooner; double: a slower start.
DEPTH_IMAGES = 16


@dataclass(frozen=True, eq=False)
class DeepShot(Shot):
    """A shot with uint16 images."""

    bits: int = 16  #: how many the cameras have; the images are shifted up to fill all 16


class BitDepth:
    """The bits of a source's uint16 images: the least of 10, 12, 14 and 16 that hold every pixel of both cameras so far.

    Converters of fewer than 16 bits leave the high ones empty (GenICam's PFNC: Mono12), and the file does not say so.

    ``first``: images that are looked at before the first uint16 image is scaled, so that the scale stays.
    """

    def __init__(self, first: Callable[[], Iterable[Image]] = tuple) -> None:
        self.bits = 0  #: 0 before the first uint16 image
        self.notes: tuple[str, ...] = ()  #: what it took the images for, where that is not 16 bits from the first on
        self._first = first

    @classmethod
    def of_files(cls, files: Sequence[Path]) -> BitDepth:
        """Return that of the images of one camera."""
        return cls(lambda: map(read_image, files[:: -(-len(files) // DEPTH_IMAGES)]))

    def filled(self, *images: Image) -> tuple[Image, ...]:
        """Return images shifted up so that they fill 16 bits; uint8 as they are."""
        deep = [image for image in images if image.dtype == np.uint16]
        if deep:
            seen = deep if self.bits else [*deep, *itertools.islice(self._first(), DEPTH_IMAGES)]
            most = max(int(image.max()) for image in seen if image.dtype == np.uint16)
            bits = max(self.bits, next(bits for bits in (10, 12, 14, 16) if not most >> bits))
            if bits != (self.bits or 16):
                after = f", from a later shot on, brighter than {self.bits}" if self.bits else ""
                self.notes += (f"its 16-bit images are read as {bits} bits, which hold their pixels{after}",)
            self.bits = bits
        return tuple(image << (16 - self.bits) if image.dtype == np.uint16 else image for image in images)

    def shot(self, shot: Shot) -> Shot:
        """Return a shot with filled images."""
        if shot.left is None or shot.right is None or shot.left.dtype == shot.right.dtype == np.uint8:
            return shot
        left, right = self.filled(shot.left, shot.right)
        return DeepShot(shot.name, left, right, shot.t_s, shot.problem, shot.encoded, self.bits)


def images_of(shots: Iterable[Shot]) -> Iterator[Image]:
    """Yield the left and the right image of each shot that has them."""
    return (image for shot in shots for image in (shot.left, shot.right) if image is not None)
