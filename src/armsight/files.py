"""Reading and writing files so that nothing half-written stays behind and every error names the file."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from armsight.errors import InputError


def read_text(path: str | Path) -> str:
    """Read a UTF-8 text file.

    Raises:
        InputError: missing, unreadable or not text.
    """
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


@contextlib.contextmanager
def replacing(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a file for writing that takes the place of ``path`` only when the block ends well.

    Args:
        path: the file to be; its folder must exist.
        mode: "w" for UTF-8 text, "wb" for bytes.

    Raises:
        InputError: the folder is missing, is not writable, or the disk is full; what stood at ``path`` stays.
    """
    target = Path(path)
    handle, temporary = -1, ""
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        os.fchmod(handle, 0o644)
        with os.fdopen(handle, mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
        os.replace(temporary, target)
    except OSError as error:
        if error.filename is not None and str(error.filename) not in (temporary, str(target), str(target.parent)):
            if not str(error.filename).startswith(str(target.parent / f".{target.name}.")):
                raise
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file in one step; errors as :func:`replacing`."""
    with replacing(path) as file:
        file.write(text)
