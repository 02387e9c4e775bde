"""The registry of dense methods; another one is one line here."""

from __future__ import annotations

from collections.abc import Callable

from armsight.errors import InputError
from armsight.vision.dense.block import Block
from armsight.vision.dense.method import Method
from armsight.vision.dense.opencv import OpenCV
from armsight.vision.dense.scanline import Scanline
from armsight.vision.dense.semiglobal import Semiglobal

#: Name -> what makes the method with its usual settings.
METHODS: dict[str, Callable[[], Method]] = {
    "block": Block,
    "scanline": Scanline,
    "semiglobal": Semiglobal,
    "opencv": OpenCV,
}


def open_method(name: str) -> Method:
    """Return a method by its name.

    Raises:
        InputError: an unknown name.
    """
    if name not in METHODS:
        raise InputError(f"unknown dense method {name!r}; known are {', '.join(METHODS)}")
    return METHODS[name]()
