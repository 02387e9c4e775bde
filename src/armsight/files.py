"""Reading and writing files so that nothing half-written stays behind and every error names the file."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from armsight.errors import InputError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


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


def read_table(path: str | Path) -> list[list[str]]:
    """Read a CSV file into rows of cells; a byte-order mark before the first is left out.

    Raises:
        InputError: missing, unreadable, not text or not a table, or one whose cells are separated by semicolons or tabs.
    """
    try:
        rows = list(csv.reader(io.StringIO(read_text(path).removeprefix("\ufeff"))))
    except csv.Error as error:
        raise InputError(f"{path}: not a table: {error}") from None
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if rows and len(rows[0]) == 1 and mark in rows[0][0]:
            raise InputError(f"{path}: line 1: columns are separated by {name}; save it with commas between them")
    return rows


class _NamedFile(io.FileIO):
    """A new file whose errors all carry its name: the system leaves it out when a write or a close fails."""

    def __init__(self, path: Path) -> None:
        super().__init__(os.fspath(path), "x")

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            error.filename = self.name
            raise

    def write(self, data: ReadableBuffer, /) -> int:
        with self._named():
            return super().write(data)

    def close(self) -> None:
        with self._named():
            super().close()

    def abandon(self) -> None:
        """Close without an error: the file is discarded."""
        with contextlib.suppress(OSError):
            super().close()


def _target(path: str | Path) -> Path:
    """Return the file that ``path`` is, or links to, or is to be; reject what cannot be one."""
    target = Path(os.path.realpath(path))
    if not os.path.isdir(target.parent):
        raise InputError(f"{path}: cannot be written: there is no folder {target.parent}; make it first")
    if os.path.exists(target) and not os.path.isfile(target):
        kind = "a folder" if os.path.isdir(target) else "a device"
        raise InputError(f"{path}: cannot be written: it is {kind}; give the name of a file")
    return target


@contextlib.contextmanager
def replacing(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a file for writing that replaces ``path`` only when the block ends well.

    Blocks may be nested; an error names the file it happened to; an error of another file passes through.

    Args:
        path: the file to be, or a link to it; its folder must exist.
        mode: "w" for UTF-8 text, "wb" for bytes.

    Raises:
        InputError: the folder is missing or not writable, ``path`` is no ordinary file, or the disk is full; what stood
            at ``path`` stays.
    """
    target = _target(path)
    # The name is chosen first: whatever happens from here on, there is only one file to take away.
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    raw: _NamedFile | None = None
    try:
        raw = _NamedFile(temporary)
        buffered = io.BufferedWriter(raw)
        # A name that is not text (an undecodable file name) is written with escapes rather than not at all.
        file = buffered if "b" in mode else io.TextIOWrapper(buffered, encoding="utf-8", errors="backslashreplace")
        yield file
        file.close()
        os.replace(temporary, target)
    except OSError as error:
        if error.filename != os.fspath(temporary):
            raise
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        try:
            if raw is not None:
                raw.abandon()  # below its buffers: what they still hold is discarded
        finally:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file in one step; errors as :func:`replacing`."""
    with replacing(path) as file:
        file.write(text)


def check_writable(path: str | Path, *, apart_from: Iterable[str | Path | None] = ()) -> None:
    """Find out before long work whether a file can be written at ``path``.

    Args:
        path: the file to be.
        apart_from: files that must not be written over: what is read, and what else is written.

    Raises:
        InputError: its folder is missing or not writable, ``path`` is no ordinary file, or one of ``apart_from``.
    """
    for other in apart_from:
        if other is not None and os.path.realpath(other) == os.path.realpath(path):
            raise InputError(f"{path}: is given twice, or is read as well as written; give the result another name")
    folder = _target(path).parent
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: cannot be written: no permission to write in {folder}")


def finite_json(value: Any) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return a value as JSON can hold it: None (null) replaces every NaN and infinity in it."""
    if isinstance(value, Mapping):
        return {key: finite_json(one) for key, one in value.items()}
    if isinstance(value, list):
        return [finite_json(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
