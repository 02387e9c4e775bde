"""Reading and writing files so that nothing half-written stays behind and every error names the file.

Whatever is read by name is opened by :func:`opened`, or checked by :func:`check_readable` before a library opens it: an
ordinary file of bounded size, opened without waiting.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import itertools
import json
import math
import os
import re
import stat
from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from armsight.errors import InputError, some

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

    _Paths = Iterable[str | Path | None]

#: Largest documents (JSON, TOML, XML) and tables that are read: parsed they take 10 to 40 times as much memory.
DOCUMENT_MB = 8  # half: a recording's truth of 10,000 shots is rejected; double: a hostile file takes 600 MB
_TOML_DIGITS = 100_000  # in a row, and letters a to f; half: nothing notable, double: it takes 24 MB
_JSON_PARTS = (
    1_000_000  # lists, mappings and pairs of values of a JSON text; half: long tracks are rejected; double: 400 MB
)
TABLE_MB = 64  # half: an hour of a run is rejected; double: twice the memory
LONG_TABLE_MB = 2000  # of a table that is read piece by piece; half: 2 hours of a run are rejected; double: nothing
#: Cells and lines of a table, of up to 72 bytes each; half: 5 minutes of detections are rejected; double: 700 MB.
_TABLE_CELLS = 5_000_000
_MB = 1_000_000
_KINDS = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"))


def natural_key(name: object) -> tuple[tuple[int, str] | tuple[int, int], ...]:
    """Return a sorting key under which numbers in a path or name count as numbers: left2 before left10."""
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", str(name)) if part)


def opened(path: str | Path, most_mb: float | None = None) -> IO[bytes]:
    """Open what must be an ordinary file, for reading; whatever a name leads to, this returns at once.

    Everything that is read by name comes through here: a device has no end and a pipe may never have a beginning.

    Args:
        path: the file.
        most_mb: how large it may be; None is any size, for what is read piece by piece.

    Raises:
        InputError: missing, unreadable, a folder, pipe or device, or larger.
    """
    try:
        number = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | _AT_ONCE)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except ValueError:  # it holds a NUL
        raise InputError(f"{str(path)!r}: not the name of a file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    about = os.fstat(number)
    problem = None
    if not stat.S_ISREG(about.st_mode):
        kind = next((name for test, name in _KINDS if test(about.st_mode)), "a device")
        problem = f"{path}: cannot be read: it is {kind}; give the name of a file"
    elif most_mb is not None and about.st_size > most_mb * _MB:
        problem = _too_large(path, about.st_size, most_mb)
    if problem is not None:
        os.close(number)
        raise InputError(problem)
    return os.fdopen(number, "rb")


#: Not to wait for the other end of a pipe, nor become the owner of a terminal.
_FILES = frozenset((".csv", ".html", ".json", ".mcap", ".parquet", ".pdf", ".png", ".toml", ".tum", ".txt", ".xlsx"))
_AT_ONCE = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)


def _too_large(path: str | Path, size: int, most_mb: float) -> str:
    return f"{path}: has {size / _MB:.0f} MB, such a file at most {most_mb:.0f} MB: is it the right one?"


@contextlib.contextmanager
def as_input_error(problem: str, *kinds: type[Exception], why: bool = False) -> Iterator[None]:
    """Raise an InputError instead of an OSError of the block: ``problem``, and why; of other kinds only with ``why``."""
    caught = kinds or (OSError,)
    try:
        yield
    except caught as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(problem if kinds and not why else f"{problem}: {reason}") from None


def check_readable(path: str | Path, most_mb: float | None = None) -> str:
    """Return the name of an ordinary file for a library that opens it by itself; errors as :func:`opened`."""
    opened(path, most_mb).close()
    return os.fspath(path)


def read_bytes(path: str | Path, most_mb: float = DOCUMENT_MB) -> bytes:
    """Read a whole file; errors as :func:`opened`."""
    with opened(path, most_mb) as file, as_input_error(f"{path}: cannot be read"):
        pieces = iter(lambda: file.read(_MB) or b"", b"")  # some files of the system have no size, and no end
        data = b"".join(itertools.islice(pieces, int(most_mb) + 1))
    if len(data) > most_mb * _MB:
        raise InputError(_too_large(path, len(data), most_mb))
    return data


def read_text(path: str | Path, most_mb: float = DOCUMENT_MB) -> str:
    """Read a text file: UTF-8, UTF-16 with its byte-order mark, or XML in the encoding that it declares.

    Raises:
        InputError: as :func:`opened`, or not text.
    """
    data = read_bytes(path, most_mb)
    try:
        return io.TextIOWrapper(io.BytesIO(data), _encoding(path, data)).read()
    except UnicodeDecodeError as error:
        raise InputError(_no_text(path, error)) from None


def _no_text(path: str | Path, error: UnicodeDecodeError) -> str:
    how = "save text as UTF-8, a table as CSV" if error.object[:5] != b"<?xml" else "its declaration says otherwise"
    return f"{path}: not a text file in {error.encoding}; {how}"


def read_json(path: str | Path) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Read a JSON file.

    Raises:
        InputError: as :func:`read_text`, or not JSON; the message names the line.
    """
    return parsed_json(read_text(path), path)


def require_version(path: str | Path, what: str, version: object, newest: int) -> None:
    """Reject what a newer armsight wrote.

    Args:
        path: the file.
        what: what the file is, for the message: "rig file".
        version: as the file says; what is no number passes.
        newest: version that this armsight knows.

    Raises:
        InputError: it is newer.
    """
    if isinstance(version, int | float) and version > newest:
        raise InputError(f"{path}: {what} version {version}, this armsight reads up to {newest}: update armsight")


def parsed_json(text: str, path: str | Path, what: str = "") -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return JSON text as what it holds; errors as :func:`read_json`."""
    expected = f"; expected {what}" if what else ""
    if text.count("[") + text.count("{") + text.count(",") // 2 > _JSON_PARTS:
        raise InputError(
            f"{path}: holds over {_JSON_PARTS} lists, or twice as many values{expected}: is it the right file?"
        )
    try:
        return json.loads(text, parse_int=_integer)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: line {error.lineno}: not JSON{expected} ({error.msg})") from None
    except RecursionError:
        raise InputError(f"{path}: not JSON that can be read: nested too deep{expected}") from None


def _integer(digits: str) -> int | float:
    """Return an integer, one that no double holds as infinity."""
    return int(digits) if len(digits) < 300 else float(digits)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        InputError: as :func:`read_text`, or not TOML; the message names the line.
    """
    text = read_text(path)
    try:
        return parse_toml(text)
    except ValueError as error:  # also a number of thousands of digits
        raise InputError(f"{path}: not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: not TOML that can be read: nested too deep") from None


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML of moderate numbers: tomllib takes 120 bytes for each digit of one.

    Raises:
        ValueError: not TOML.
    """
    import tomllib

    if any(len(run[0]) > _TOML_DIGITS for run in re.finditer(r"[0-9A-Fa-f_]+", text)):
        raise ValueError(f"a run of more than {_TOML_DIGITS} digits or letters a to f")
    return tomllib.loads(text)


def _encoding(path: str | Path, data: bytes) -> str:
    """Return the encoding of a text file by its first bytes: its byte-order mark, or XML's declaration."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):  # spreadsheets' "Unicode text"
        return "utf-16"
    for wide in ("utf-16-le", "utf-16-be"):  # XML without the mark that it should have
        if data.startswith("<?xml".encode(wide)):
            return wide
    declared = re.match(rb"<\?xml[^>]*?encoding\s*=\s*[\"']([\w.:-]+)", data)
    name = "utf-8" if declared is None else declared[1].decode()
    with as_input_error(
        f"{path}: line 1: declares encoding {name!r}, which is not known; save it as UTF-8", LookupError, UnicodeError
    ):
        "".encode(name)  # zlib and its like are codecs, too, and none of text
    return "utf-8" if name.lower().startswith("utf-16") else name  # its declaration could not be read if it were


#: A number as half of the world writes it: 0,25 or -1,5e-3.
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


def read_table(path: str | Path) -> list[list[str]]:
    """Read a CSV file into rows of cells; a byte-order mark before the first is left out.

    Cells may also be separated by semicolons or tabs, as spreadsheets write them where the comma is the decimal mark;
    numbers with a decimal comma are then returned with a point.

    Args:
        path: the file.

    Raises:
        InputError: missing, unreadable, not text or not a table, or decimal commas and points in one table.
    """
    lines = _lines(path)
    first = next(lines, "").removeprefix("\ufeff")
    mark = next((mark for mark in (";", "\t") if mark in first and "," not in first), ",")
    rows: list[list[str]] = []
    cells = 0
    with as_input_error(f"{path}: not a table", csv.Error, why=True):
        for row in csv.reader(itertools.chain([first] if first else [], lines), delimiter=mark):
            rows.append(row)
            cells += len(row) + 1
            if cells > _TABLE_CELLS:
                raise InputError(f"{path}: more than {_TABLE_CELLS} cells up to line {len(rows)}: split the table")
    if mark != ",":
        rows = _with_points(path, rows)
    return rows


def is_long(path: str | Path) -> bool:
    """Return whether a table is one of numbers between commas, so long that it is to be read piece by piece."""
    with opened(path, LONG_TABLE_MB) as file:
        size, head = os.fstat(file.fileno()).st_size, file.read(_MB).partition(b"\n")[0]
    return size > DOCUMENT_MB * _MB and b"," in head and head.isascii()


def long_rows(path: str | Path) -> Generator[list[str]]:
    """Yield the rows of cells of such a table, its header first; errors as :func:`read_table`."""
    wrong = as_input_error(f"{path}: not a table", csv.Error, why=True)
    with opened(path, LONG_TABLE_MB) as raw, io.TextIOWrapper(raw, "utf-8") as text, wrong:
        yield from csv.reader(_bounded(path, text))


def _lines(path: str | Path) -> Iterator[str]:
    """Yield the lines of a table; errors as :func:`read_text`."""
    data = read_bytes(path, TABLE_MB)
    return _bounded(path, io.TextIOWrapper(io.BytesIO(data), _encoding(path, data)))


def _bounded(path: str | Path, file: io.TextIOWrapper) -> Iterator[str]:
    """Yield the lines of a text file, none of them longer than a table's."""
    try:
        while line := file.readline(_MB + 1):
            if len(line) > _MB:
                raise InputError(f"{path}: a line of more than {_MB} characters: not a table")
            yield line
    except UnicodeDecodeError as error:
        raise InputError(_no_text(path, error)) from None


def _with_points(path: str | Path, rows: list[list[str]]) -> list[list[str]]:
    """Return rows with decimal points for decimal commas; a table has one or the other."""
    found = [(line, cell) for line, row in enumerate(rows, 1) for cell in row if DECIMAL_COMMA.fullmatch(cell.strip())]
    if not found:
        return rows
    for line, row in enumerate(rows[1:], 2):
        for cell in row:
            if re.fullmatch(r"[+-]?\d*\.\d+(?:[eE][+-]?\d+)?", cell.strip()):
                raise InputError(
                    f"{path}: line {line} has {cell.strip()} and line {found[0][0]} {found[0][1].strip()}: is the comma "
                    "the decimal mark, or the point? save it with one of them"
                )
    return [[cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell.strip()) else cell for cell in row] for row in rows]


def columns_unused(names: Sequence[str]) -> str:
    """Return which columns of a table were not read, as text."""
    return f"columns not used: {some(names)}"


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

    def sync(self) -> None:
        """Have the disk hold what was written: without it a crash after the renaming leaves an empty file."""
        with self._named():
            os.fsync(self.fileno())

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


def _sync_folder(folder: Path) -> None:
    """Have the disk hold a folder's names, where the system can."""
    with contextlib.suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _beside(target: Path) -> Path:
    return target.with_name(f".{target.name}.{os.urandom(4).hex()}")


@contextlib.contextmanager
def replacing(path: str | Path, mode: str = "w", *, durable: bool = True) -> Iterator[IO[Any]]:
    """Open a file for writing that replaces ``path`` only when the block ends well.

    Blocks may be nested; an error names the file it happened to; an error of another file passes through.

    Args:
        path: the file to be, or a link to it; its folder must exist.
        mode: "w" for UTF-8 text, "wb" for bytes.
        durable: it outlives a crash of the computer from then on; for many files a second the caller sees to that.

    Raises:
        InputError: the folder is missing or not writable, ``path`` is no ordinary file, or the disk is full; what stood
            at ``path`` stays.
    """
    target = _target(path)
    # The name is chosen first: whatever happens from here on, there is only one file to take away.
    temporary = _beside(target)
    raw: _NamedFile | None = None
    try:
        raw = _NamedFile(temporary)
        buffered = io.BufferedWriter(raw)
        # A name that is not text (an undecodable file name) is written with escapes rather than not at all.
        file = buffered if "b" in mode else io.TextIOWrapper(buffered, encoding="utf-8", errors="backslashreplace")
        yield file
        if not file.closed:
            file.flush()
            if durable:
                raw.sync()
        file.close()
        os.replace(temporary, target)
        if durable:
            _sync_folder(target.parent)
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


def made_folder(folder: Path, problem: str = "cannot be made a folder") -> Path:
    """Make a folder with those above it, if it is not there, and return it; InputError: ``problem``, and why."""
    with as_input_error(f"{folder}: {problem}"):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def table_text(names: Iterable[object], rows: Iterable[Iterable[object]] = ()) -> str:
    """Return a table as CSV, a line each; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    return text.getvalue()


class RowFile:
    """A CSV being written: a row is in the file, whole, once it is added, and nothing of one that failed."""

    def __init__(self, path: Path, columns: Sequence[str], *, replaces: bool = False) -> None:
        self.path, self.rows, self._whole = path, 0, 0
        target, is_new = _target(path), not os.path.exists(path)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | (0 if replaces else os.O_EXCL) | getattr(os, "O_BINARY", 0)
        with self._named():
            self._file = os.open(target, flags, 0o644)
        try:
            with self._named():
                os.ftruncate(self._file, 0)
            self._append(columns)
        except InputError:
            os.close(self._file)
            if is_new:
                target.unlink()
            raise

    def _named(self) -> contextlib.AbstractContextManager[None]:
        return as_input_error(f"{self.path}: cannot be written")

    def _append(self, cells: Sequence[object]) -> None:
        data = table_text(cells).encode(errors="backslashreplace")
        with self._named():
            try:
                if os.write(self._file, data) < len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                if not os.fstat(self._file).st_nlink:
                    raise OSError(errno.ENOENT, "it was deleted meanwhile")
            except OSError:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._file, self._whole)
                raise
        self._whole += len(data)

    def add(self, cells: Sequence[object]) -> None:
        """Append a row; InputError where the disk is full, where the rows before stay, or the file was deleted."""
        self._append(cells)
        self.rows += 1

    def close(self) -> None:
        """Close the file; it outlives a crash of the computer from then on.

        Raises:
            InputError: the disk does not take it.
        """
        with self._named():
            try:
                os.fsync(self._file)
            finally:
                os.close(self._file)


def try_writing(folder: Path) -> None:
    """Write a file in a folder and remove it.

    Raises:
        OSError: it cannot be written.
    """
    import tempfile  # not above: who prints a pose writes none

    with tempfile.TemporaryFile(dir=folder):
        pass


def check_writable(path: str | Path, *, apart_from: _Paths = (), outputs: _Paths = ()) -> None:
    """Find out before long work whether a file can be written at ``path``; nothing is left there.

    Args:
        path: the file to be.
        apart_from: files that are read.
        outputs: what else is written.

    Raises:
        InputError: its folder is missing or not writable, ``path`` is no ordinary file, or one of the others.
    """
    _check_name(path)
    _check_apart(path, apart_from, outputs)
    target = _target(path)
    folder = target.parent
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: cannot be written: no permission to write in {folder}")
    if os.path.exists(target) and not os.access(target, os.W_OK):
        raise InputError(f"{path}: cannot be written: it is read-only")
    with as_input_error(f"{path}: cannot be written"):
        with contextlib.suppress(FileNotFoundError):
            os.lstat(_beside(target))  # a name that is too long
        try_writing(folder)


def unused(path: Path) -> Path:
    """Return the first of NAME.csv, NAME-2.csv, NAME-3.csv ... that is not there yet; of a folder likewise."""
    found, number = path, 1
    while found.exists():
        number += 1
        found = path.with_stem(f"{path.stem}-{number}")
    return found


def check_suffix(path: str | Path, suffix: str, what: str) -> None:
    """Check that a file to be is named as what it will hold.

    Args:
        path: the file to be.
        suffix: that it must have, in small or capital letters.
        what: is written, as the message names it: "a figure of the arm".

    Raises:
        InputError: another suffix, or none.
    """
    if Path(path).suffix.lower() != suffix:
        raise InputError(f"{path}: {what} is written as {suffix}; give it a name that ends so")


def check_outputs(outputs: _Paths, inputs: _Paths = ()) -> None:
    """Find out before long work whether all files of a command can be written, each apart from the others and the inputs.

    Args:
        outputs: the files to be; None is no file.
        inputs: the files that are read; None is no file.

    Raises:
        InputError: as :func:`check_writable`, for the first that cannot be written.
    """
    inputs, taken = list(inputs), list[str | Path]()
    for path in outputs:
        if path is not None:
            check_writable(path, apart_from=inputs, outputs=taken)
            taken.append(path)


@contextlib.contextmanager
def alone_in(folder: Path, command: str) -> Iterator[None]:
    """Keep a folder, which is made, to one process of any command; one that was made and stays empty is removed again.

    Raises:
        InputError: another one uses it.
    """
    import fcntl  # POSIX

    path, used = folder / "in_use.lock", "uses it: give this one another folder, -o FOLDER"
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = path.open("a+", encoding="utf-8")
    except (FileNotFoundError, FileExistsError):
        if os.path.lexists(folder) and not folder.is_dir():
            raise
        raise InputError(f"{folder}: another {command} {used}") from None  # the one who ends has just removed it
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.fstat(lock.fileno()).st_nlink:  # the one who ends has just removed it
                raise BlockingIOError
        except BlockingIOError:
            lock.seek(0)
            raise InputError(f"{folder}: another {lock.read() or command} {used}") from None
        except OSError as error:  # a file system without locks
            raise InputError(
                f"{folder}: cannot be kept to one {command}: {error.strerror}: give another folder"
            ) from None
        lock.truncate(0)
        lock.write(command)
        lock.flush()
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                path.unlink()
                for each in made:  # up to where something came to be in one
                    each.rmdir()


def check_folder(
    path: str | Path,
    *,
    holding: Sequence[str] = (),
    signs: Sequence[str] = ("report.html",),
    apart_from: _Paths = (),
    outputs: _Paths = (),
    problem: str = "nothing can be written here",
) -> Path:
    """Return a folder, ``~`` expanded, if files can be written to it, before long work; a missing one is not made.

    Args:
        path: the folder to be.
        holding: names of files that will be written to it.
        signs: files that show that the command made the folder; a report is the last file it writes.
        apart_from: files that are read.
        outputs: what else is written.
        problem: what does not work, as the message has it: "no report can be written here".

    Raises:
        InputError: it cannot be made or written to, it or one of its files is one of the others, or it holds some of
            ``holding`` that the command did not write, or that were changed since.
    """
    _check_name(path)
    folder = Path(path).expanduser()
    if folder.suffix.lower() in _FILES and not os.path.lexists(folder):
        raise InputError(f"{path}: {problem}: several files come of it; give a folder, such as {folder.stem}")
    try:
        whole = Path(os.path.abspath(folder))  # a/../b is b, also where there is no a yet
        there = next(p for p in (whole, *whole.parents) if os.path.lexists(p))
        for part in whole.relative_to(there).parts:
            with contextlib.suppress(FileNotFoundError):
                (there / part).lstat()  # a name too long comes up here
        try_writing(there)
    except OSError as error:
        advice = "; give a folder" if isinstance(error, NotADirectoryError) else ""
        raise InputError(f"{folder}: {problem}: {error.strerror}{advice}") from None
    apart_from, outputs = list(apart_from), list(outputs)
    for part in (*(() if folder.is_dir() else (folder,)), *(folder / name for name in holding)):
        _check_apart(part, apart_from, outputs)
    files, written_ns, why = [folder / name for name in holding], 0.0, ""
    if any((folder / sign).exists() for sign in signs):
        page = folder / "report.html"
        written_ns = page.stat().st_mtime_ns if page.is_file() else math.inf
        why = f" changed after {page.name} was written: move them, or"
    if lost := ", ".join(each.name for each in files if each.is_file() and each.stat().st_mtime_ns > written_ns):
        raise InputError(f"{path}: holds {lost}, which would be written over;{why} choose another folder")
    return folder


def _check_name(path: str | Path) -> None:
    """Reject what is no name of a file: - stands for the standard output elsewhere."""
    if str(path) in ("-", ""):
        raise InputError(
            f"{str(path) or repr('')}: give the name of a file or folder; --json prints to standard output"
        )


def _check_apart(path: str | Path, inputs: _Paths, outputs: _Paths) -> None:
    """Reject a file to be that is also read, or written as something else."""
    if any(other is not None and _same_file(other, path) for other in inputs):
        raise InputError(f"{path}: is read, and would be written over; give the result another name")
    if any(other is not None and _same_file(other, path) for other in outputs):
        raise InputError(f"{path}: is given twice, for two results; give each a name of its own")


def _same_file(one: str | Path, other: str | Path) -> bool:
    """Say whether two paths are one file, also by hard links or a file system that ignores case."""
    if os.path.realpath(one) == os.path.realpath(other):
        return True
    try:
        return os.path.samefile(one, other)
    except (OSError, ValueError):
        return False
