"""The registry of dense methods; another one is one line here."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from armsight.errors import InputError

if TYPE_CHECKING:
    from armsight.vision.dense.method import Method

#: Name, which is that of the method's module, -> its class; imported when it is opened.
METHODS = {"block": "Block", "scanline": "Scanline", "semiglobal": "Semiglobal", "opencv": "OpenCV"}


def open_method(name: str) -> Method:
    """Return a method with its usual settings by its name.

    Raises:
        InputError: an unknown name.
    """
    if name not in METHODS:
        raise InputError(f"unknown dense method {name!r}; known are {', '.join(METHODS)}")
    method: Method = getattr(importlib.import_module(f"armsight.vision.dense.{name}"), METHODS[name])()
    return method
