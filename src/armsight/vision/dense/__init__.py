"""Dense stereo: a rectified pair goes in, a disparity for every pixel of the left image comes out.

The contract is :class:`~armsight.vision.dense.method.Method` in ``method.py``; the registry is here:
another one is one line of ``METHODS``.

- The methods: ``block.py`` (windows), ``scanline.py`` (dynamic programming),
  ``semiglobal.py``, ``opencv.py``. What they share: ``cost.py`` (matching costs), ``winner.py`` (the least total),
  ``postprocess.py`` (rejection, smoothing, filling, sigma).
- Before and after: ``rectified.py`` (checks of a pair), ``depth.py`` (depth with its standard deviation).
- ``evaluate.py`` and ``middlebury.py``: errors against a true disparity map, and the benchmark's files.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from armsight.errors import InputError

if TYPE_CHECKING:
    from armsight.vision.dense.method import Method

#: Name, which is that of the method's module, -> its class; imported when it is opened.
METHODS = {"block": "Block", "scanline": "Scanline", "semiglobal": "Semiglobal", "opencv": "OpenCV"}


def open_method(name: str) -> Method:
    """Return a method with its usual settings by its name; InputError where it is unknown."""
    if name not in METHODS:
        raise InputError(f"unknown dense method {name!r}; known are {', '.join(METHODS)}")
    method: Method = getattr(importlib.import_module(f"armsight.vision.dense.{name}"), METHODS[name])()
    return method
