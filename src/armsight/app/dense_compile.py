"""A method compiled in a process of its own.

The first run of a method compiles it, and the compiler keeps about 100 MB for as long as its process lives. Here another
process does that and ends; this one reads what is compiled from numba's cache.

    python -m armsight.app.dense_compile METHOD
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
from numba.core import event

from armsight.vision.dense.method import Search
from armsight.vision.dense.methods import open_method


class _NotYetError(Exception):
    """Something is about to be compiled here."""


class _Watch(event.Listener):
    """Stops what would compile."""

    def on_start(self, event: event.Event) -> None:
        """Refuse."""
        raise _NotYetError

    def on_end(self, event: event.Event) -> None:
        """Nothing was begun."""


def _run(name: str) -> None:
    """Match a small pair, so that all of a method is compiled or read."""
    noise = np.random.default_rng(0).integers(0, 256, (64, 140)).astype(np.uint8)
    left, right = noise[:, :128].copy(), noise[:, 4:132].copy()  # a disparity of 4: matched, smoothed and filled
    for image in (left, right):
        image.setflags(write=False)  # as a shot's images are: to the compiler that is another type
    open_method(name).match(left, right, Search(0, 16))


def compile_apart(name: str) -> None:
    """Have a method compiled elsewhere, unless numba's cache holds it already.

    Where the cache cannot be written, this process will compile when it matches: only its memory is more.
    """
    try:
        with event.install_listener("numba:compile", _Watch()):
            _run(name)
    except _NotYetError:
        subprocess.run([sys.executable, "-m", __name__, name], check=False, capture_output=True)


if __name__ == "__main__":
    _run(sys.argv[1])
