"""The firmware compiled for this computer: the same bits as on the board, and the fastest emulator."""

from __future__ import annotations

import ctypes
import os
import shutil
import tempfile
from pathlib import Path
from typing import Self

from armsight.errors import InputError
from armsight.robot.boards.frames import ANSWER, REQUEST


class HostEmulator:
    """The board's code in a shared library, loaded for this board alone by :meth:`open`."""

    def __init__(self, loaded: ctypes.CDLL) -> None:
        self._request = (ctypes.c_char * REQUEST.itemsize).in_dll(loaded, "pil_request_frame")
        self._answer = (ctypes.c_char * ANSWER.itemsize).in_dll(loaded, "pil_answer_frame")
        self._tick, self._start = loaded.pil_tick, loaded.pil_start

    @classmethod
    def open(cls, library: Path) -> Self:
        """Load a library of the board ``host`` and start it, or raise InputError: it cannot be loaded."""
        # A library's variables exist once however often it is loaded: a second board needs a second file.
        handle, name = tempfile.mkstemp(suffix=library.suffix)
        os.close(handle)
        try:
            shutil.copyfile(library, name)
            emulator = cls(ctypes.CDLL(name))
            emulator._start()
        except (OSError, AttributeError, ValueError) as error:
            raise InputError(
                f"{library}: no host build of the firmware ({error}); run `armsight board build`"
            ) from None
        finally:
            os.unlink(name)
        return emulator

    def tick(self, request: bytes) -> bytes:
        """Run one tick on a request frame and return the answer frame."""
        ctypes.memmove(self._request, request, REQUEST.itemsize)
        self._tick()
        return self._answer.raw

    def close(self) -> None:
        """Nothing to end: the library stays loaded as long as the process lives."""
