"""Text files as rows of cells: tables with any separator, lists, programs of robots, YAML and JSON."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armsight.errors import InputError, nearest
from armsight.files import DECIMAL_COMMA, TABLE_MB, natural_key, read_table, read_text
from armsight.tables.capture import capture_rows
from armsight.tables.lengths import NO_NUMBER, NUMBER, number
from armsight.tables.nested import BY_COUNT, PACKED, document_rows, is_document, is_packed
from armsight.tables.programs import program_rows

Rows = Sequence[tuple[int, list[str]]]
Renames = str | Mapping[str, str] | Sequence[str]  # what ``--columns`` may be
#: A number with its unit.
_WITH_UNIT = re.compile(rf"({NUMBER}|{DECIMAL_COMMA.pattern})\s*(mm|m|deg|\N{{DEGREE SIGN}}|rad|s)")
_LIST = re.compile(r"\[([^\[\]{}\"]*)\],?")  # a list alone in its line
#: The line that stands beneath the names in Markdown or psql, and psql's last line.
_RULE = re.compile(r"[\s|+:-]*-[\s|+:-]*|\(\d+ rows?\)")
#: The first line of a text that is no table: of a document, of a program, a call.
_NO_TABLE = re.compile(r"[{<\[/]|\.[A-Z]|(?:DEF|MODULE|PROC)\b|.*(?::=|=|\(\)|[\[{]$)|.*\w\s*\(\s*[\"\[{\d.+-]")
_FORMS = {8: ["t_s", *BY_COUNT[7]], **BY_COUNT}  # names for columns that have none, by how many they are


class Cells(NamedTuple):
    """What a file holds."""

    head: list[str]  #: the names of its columns; n1.. of a rotation and _0.. of a last row where the file has no names.
    rows: Rows  #: the line, or the number of the record, and the cells of each row
    rotation: str | None = None  #: the convention of its rotations, where the program that wrote it has one
    notes: tuple[str, ...] = ()  #: what it was read as
    listed: bool = False  #: whether its rows are lists of numbers without names, which may be joints as well


class Said(NamedTuple):
    """What the option ``--columns`` says of a table."""

    columns: str | None  #: the names of its columns, for :func:`read_columns`
    unit: str | None = None  #: "m" or "mm", of lengths whose columns do not name one
    detect_units: bool = False  #: whether lengths that cannot be metres are millimetres
    rotation: str | None = None  #: the convention of its rotations
    frames: str | None = None  #: of a recording's transforms, BASE:FLANGE


def said_columns(text: str | None, known: Collection[str] = ("units", "rotation", "frames")) -> Said:
    """Split the option ``--columns``: units=mm, units=detect, rotation=xyz and frames=BASE:FLANGE may stand among names.

    Args:
        text: its value; None where it is not given.
        known: what of these the command takes.

    Raises:
        InputError: another unit, or something said twice.
    """
    names, said = list[str](), dict[str, str]()
    for part in text.split(",") if text is not None else ():
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or key not in known:
            names.append(part)
            continue
        key = "detect" if (key, value) == ("units", "detect") else key
        if key in said:
            raise InputError(f"--columns {text}: {key} is given twice")
        if key == "units" and value not in ("m", "mm"):
            raise InputError(f"--columns {text}: {part} is none of units=m, units=mm, units=detect")
        said[key] = value
    columns = ",".join(names) or None
    return Said(columns, said.get("units"), "detect" in said, said.get("rotation"), said.get("frames"))


def column_parts(given: Renames | None) -> list[str]:
    """Return the parts of ``--columns``, NAME=THEIRS or a name each; InputError where it is neither text nor names."""
    if given is None or isinstance(given, str):
        return [] if given is None else given.split(",")
    if isinstance(given, Mapping):
        return [f"{name}={theirs}" for name, theirs in given.items()]
    if not isinstance(given, Sequence) or not all(isinstance(each, str) for each in given):
        raise InputError(f"columns is a {type(given).__name__}; expected NAMES to COLUMNS, such as {{'x_mm': 'X'}}")
    return list(given)


def read_columns(given: Renames | None, known: Collection[str]) -> Mapping[str, str] | list[str]:
    """Read ``--columns``: what each name is in the file, or the names of all columns in order, _ for one not used.

    Args:
        given: NAME=THEIRS,... or NAME,... as text, a mapping of NAME to THEIRS, or the parts of such a text; None: nothing.
        known: the names that the command looks for.

    Returns:
        Name that the command looks for -> name in the file; or the names in order.

    Raises:
        InputError: no such form, an unknown name, or one given twice.
    """
    columns: dict[str, str] = {}
    parts = [part.strip() for part in column_parts(given)]
    text = ",".join(parts)
    in_order = len(parts) > 1 and not any("=" in part for part in parts)
    for part in parts:
        name, equals, theirs = (piece.strip() for piece in part.partition("="))
        if in_order:
            name, theirs = part, f"{len(columns)}"
        elif not (name and equals and theirs):
            raise InputError(
                f"--columns {text}: expected NAME=COLUMN,..., such as x_m=X,y_m=Y, or the names of all columns in order, "
                f"such as rx,ry,rz,x,y,z; got {part!r}"
            )
        if name == "_" and in_order:
            name = f"_{len(columns)}"
        elif name not in known:
            raise InputError(f"--columns {text}: unknown name {name!r}; known are {nearest(name, known)}")
        if name in columns or theirs in columns.values():
            raise InputError(f"--columns {text}: {part} repeats a name")
        columns[name] = theirs
    return ["" if name.startswith("_") else name for name in columns] if in_order else columns


def read_cells(path: Path, columns: Mapping[str, str] | Sequence[str] = (), side: str = "robot") -> Cells:
    """Read a file.

    Args:
        path: the file, or a glob of files of one pose each.
        columns: names for the file's own, or for its columns in their order, as :func:`read_columns` returns them.
        side: "robot" or "seen": whose poses are read where a file holds both.

    Raises:
        InputError: no such form; the message says what was found and what would do.
    """
    whose = columns.get("pose") if isinstance(columns, Mapping) else None
    names = {k: v for k, v in columns.items() if k != "pose"} if isinstance(columns, Mapping) else columns
    if any(mark in path.name for mark in "*?") and not path.exists():
        cells = _of_files(path, side, whose)
        if names and not isinstance(names, Mapping) and len(names) == len(cells.head) - 1:
            names = ["name", *names]  # a file's name is no column of it
    else:
        cells = _of_file(path, side, whose, names)
    if names:
        head = renamed(path, cells.head, names, 1 if isinstance(names, Mapping) else cells.rows[0][0])
        cells = cells._replace(head=head)
        if not isinstance(names, Mapping):
            cells = cells._replace(rotation=None, notes=(), listed=False)
    if all(name.startswith("_") for name in cells.head):
        raise InputError(
            f"{path}: line {cells.rows[0][0]}: {len(cells.head)} numbers without names; known are 16 or 12 (a matrix), 8 "
            "(time, position, quaternion), 7 (position, quaternion), 6 (position, three numbers of a rotation); or name "
            "columns, --columns x_mm,y_mm,.."
        )
    return _without_units(path, cells)


def _of_files(path: Path, side: str, whose: str | None) -> Cells:
    """Return the poses of files of one pose each, in the order of the numbers in their names, which name them."""
    files = sorted(path.parent.glob(path.name), key=natural_key)
    if not files:
        raise InputError(f"{path}: no such file; quote a glob such as 'poses/pose_*.yaml'")
    each = [_of_file(file, side, whose) for file in files]
    for k, cells in enumerate(each):
        if cells.head == ["_0"]:  # a number a line
            each[k] = _without_names(files[k], [(1, [row[0] for _, row in cells.rows])])
    for file, cells in zip(files, each, strict=True):
        if len(cells.rows) != 1 or cells.head != each[0].head:
            held, first = (
                f"{len(head)} numbers" if head[0].startswith("_") else ", ".join(head)
                for head in (cells.head, each[0].head)
            )
            as_first = f", as {files[0].name}" if file != files[0] else ""
            raise InputError(f"{file}: holds {len(cells.rows)} rows of {held}; expected one pose of {first}{as_first}")
    if "name" in each[0].head:
        return each[0]._replace(rows=[(k, cells.rows[0][1]) for k, cells in enumerate(each, 1)])
    rows = [(k, [file.stem, *cells.rows[0][1]]) for k, (file, cells) in enumerate(zip(files, each, strict=True), 1)]
    return each[0]._replace(head=["name", *each[0].head], rows=rows)


def _of_file(path: Path, side: str, whose: str | None, names: Mapping[str, str] | Sequence[str] = ()) -> Cells:
    """Return what one file holds, its names as they stand there."""
    packed = path.suffix.lower() in PACKED or is_packed(path)
    text = "" if packed else read_text(path, TABLE_MB).removeprefix("\ufeff")
    if not packed and (points := capture_rows(path, text, side, whose) or program_rows(path, text)):
        return Cells(points.head, _even(path, points.rows, len(points.head)), points.rotation, points.notes)
    written = [(line, row.strip()) for line, row in enumerate(text.splitlines(), 1)]
    written = [(line, row) for line, row in written if row and not row.startswith("#")]
    if written and _LIST.fullmatch(written[0][1]):
        return _without_names(path, _lists(path, written))._replace(listed=True)
    if packed or is_document(path, text):
        head, records = document_rows(path, text, side, whose)
        return Cells(head, [(k, [record.get(name, "") for name in head]) for k, record in enumerate(records, 1)])
    if written and _NO_TABLE.match(written[0][1]):
        raise InputError(
            f"{path}: {written[0][1][:40]!r} begins no table: write one pose a line, a matrix of 16 numbers or columns "
            "such as x_mm,y_mm,z_mm,qw,qx,qy,qz"
        )
    return _delimited(path, text, written, names.values() if isinstance(names, Mapping) else ())


def _delimited(path: Path, text: str, written: list[tuple[int, str]], named: Collection[str]) -> Cells:
    rows = _with_content(_separated(path, text.splitlines(), written[0][1] if written else ""))
    if not rows:
        raise InputError(f"{path}: no rows; one line a pose is needed")
    head = rows[0][1]
    numbered = [str(k) for k in range(len(head))]
    is_named = bool(named) and set(named) <= set(head)
    # pandas' names of none, with its index or without
    if not is_named and len(rows) > 1 and head in (numbered, ["", *numbered[:-1]]):
        return _without_names(path, [(line, row[head[0] == "" :]) for line, row in rows[1:]])
    if not is_named and not _is_head(head, rows[1:]):
        return _without_names(path, rows)
    twice = next((name for name in head if name and head.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: line {rows[0][0]} names a column twice: {twice}")
    return Cells(head, _even(path, rows[1:], len(head)))


def _is_head(head: list[str], rows: Rows) -> bool:
    """Whether a first row is of names: most of it, or one stands above a number (a message's frame, above itself)."""
    words = [k for k, cell in enumerate(head) if number(cell) is None]
    below = [row[k] for k in words if head[k][:1].isalpha() for _, row in rows if k < len(row)]
    return 2 * len(words) > len(head) or any(number(cell) is not None for cell in below)


def _with_content(cells: list[list[str]]) -> list[tuple[int, list[str]]]:
    """Return the rows that are neither blank nor comments, with their lines; without an empty cell behind the last.

    A row of separators alone is one without a pose; above the first row with content it is none.
    """
    rows = [(line, [cell.strip() for cell in row]) for line, row in enumerate(cells, 1)]
    rows = [(line, row) for line, row in rows if len(row) > 1 or any(row)]
    rows = [(line, row) for line, row in rows if not row[0].startswith("#")]
    rows = list(itertools.dropwhile(lambda each: not any(each[1]), rows))
    count = len(rows[0][1]) - (rows[0][1][-1] == "") if rows else 0
    rows = [(line, row if any(row) else [""] * count) for line, row in rows]
    return [(line, row[:-1] if len(row) == count + 1 and row[-1] == "" else row) for line, row in rows]


def _separated(path: Path, lines: list[str], first: str) -> list[list[str]]:
    if "|" in first:
        bare = ["" if _RULE.fullmatch(line.strip()) else line.strip().strip("|") for line in lines]
        return [[] if not line else line.split("|") for line in bare]
    if _has_decimal_commas(first.split()):
        return [line.replace(",", ".").split() for line in lines]
    return read_table(path) if any(mark in first for mark in ",;\t") else [line.split() for line in lines]


def _even(path: Path, rows: Rows, count: int) -> Rows:
    """Return the rows if all have as many fields as there are columns."""
    for line, row in rows:
        if len(row) != count:
            commas = (
                "are there decimal commas between commas? separate by semicolons, or " if len(row) == 2 * count else ""
            )
            raise InputError(
                f"{path}: line {line}: {len(row)} fields where {count} are expected; {commas}correct or remove the line"
            )
    if not rows:
        raise InputError(f"{path}: no rows; one line a pose is needed")
    return rows


def _lists(path: Path, written: list[tuple[int, str]]) -> Rows:
    """Return the numbers of lists, one a line."""
    rows = []
    for line, row in written:
        found = _LIST.fullmatch(row)
        if found is None:
            raise InputError(f"{path}: line {line}: expected a list [..] as before, found {row[:40]!r}")
        rows.append((line, re.split(r"\s*[,;]\s*|\s+", found[1].strip())))
    return rows


def _without_names(path: Path, rows: Rows) -> Cells:
    """Return columns that have no names, named by how many they are."""
    if len(rows[0][1]) == 4:
        rows = _matrices(path, _even(path, [each for each in rows if any(each[1])], 4))
    count = len(rows[0][1])
    if head := _echoed(rows):
        times = [f"{row[0]}.{row[1]:0>9}" for _, row in _even(path, rows, count)]
        return Cells(head, [(line, [t, *row[1:]]) for t, (line, row) in zip(times, rows, strict=True)])
    cells = Cells(_FORMS.get(count) or [f"_{k}" for k in range(count)], _even(path, rows, count))
    return _row_major(path, cells) if count == 16 else cells


def _echoed(rows: Rows) -> list[str]:
    """Return the names of the fields of messages that ``ros2 topic echo --csv`` writes; [] where they are none.

    Seconds, nanoseconds, frame; then of a PoseStamped position and quaternion, of a TransformStamped the other frame first,
    of a JointState names, positions, velocities, efforts (a message's fields in their order, without names).
    """
    first = rows[0][1]
    texts = [k for k, cell in enumerate(first) if number(cell) is None]
    names, rest = [first[k] for k in texts[1:]], len(first) - 2 - len(texts)
    if texts != list(range(2, 2 + len(texts))) or not texts or not all(cell.isdecimal() for cell in first[:2]):
        return []
    if len(texts) <= 2 and rest == 7:
        names = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
    elif rest not in (len(names), 2 * len(names), 3 * len(names)) or any(
        row[3 : 3 + len(names)] != names for _, row in rows
    ):
        return []
    fields = ["t_s", *(f"_{k}" for k in range(1, 2 + len(texts))), *names]
    return [*fields, *(f"_{k}" for k in range(len(fields), len(first)))]


def _is_last(cells: list[str], matrix: Iterable[str]) -> bool | None:
    """Return whether cells are the last row of a matrix, 0 0 0 1; None where one is no finite number, or all of it is 0."""
    numbers = np.array([number(cell) for cell in cells], float)
    if not any(number(cell) for cell in matrix):
        return None
    return bool(np.allclose(numbers, [0, 0, 0, 1], atol=1e-6)) if np.isfinite(numbers).all() else None


def _row_major(path: Path, cells: Cells) -> Cells:
    """Return matrices of 16 numbers row by row; those of Franka's O_T_EE, Eigen's and MATLAB's are column by column."""
    rowwise = [_is_last(row[12:], row) for _, row in cells.rows]
    if False in rowwise and False not in [_is_last(row[3::4], row) for _, row in cells.rows]:
        order = np.arange(16).reshape(4, 4).T.ravel()
        note = f"{path}: its matrices are column by column (0 0 0 1 is the last of every four numbers), and read so"
        return cells._replace(rows=[(line, [row[k] for k in order]) for line, row in cells.rows], notes=(note,))
    if False in rowwise:
        line, row = cells.rows[rowwise.index(False)]
        raise InputError(
            f"{path}: line {line}: 16 numbers are a matrix row by row, which ends with 0 0 0 1, not "
            f"{' '.join(row[12:])[:40]}; or name the columns, --columns"
        )
    return cells


def _matrices(path: Path, rows: Rows) -> Rows:
    """Return matrices of four lines each, or of three without the last one, as a row each."""
    fours = [[cell for _, row in rows[k : k + 4] for cell in row] for k in range(0, len(rows), 4)]
    lasts = {_is_last(four[3::4], four) for four in fours} - {None}
    columnwise = len(rows) % 4 == 0 and lasts == {True}
    count = 4 if columnwise or any(_is_last(row, row) for _, row in rows) else 3  # three of [R p] never end so
    for (line, row), four in zip(rows[3::4], fours, strict=False) if count == 4 and not columnwise else ():
        if _is_last(row, four) is False:
            raise InputError(
                f"{path}: line {line}: expected 0 0 0 1, the last of a matrix's four lines, found {' '.join(row)[:40]!r}"
            )
    if len(rows) % count:
        raise InputError(
            f"{path}: line {rows[-1][0]}: ends within a matrix: four numbers a line are matrices of four lines each, the "
            "last 0 0 0 1, or of three without it"
        )
    return [(rows[k][0], [cell for _, row in rows[k : k + count] for cell in row]) for k in range(0, len(rows), count)]


def _has_decimal_commas(cells: list[str]) -> bool:
    """Return whether cells that blanks separate are numbers with decimal commas; whole ones have none, points are none."""
    commas = [bool(DECIMAL_COMMA.fullmatch(cell)) for cell in cells]
    whole = [number(cell) is not None and "." not in cell for cell in cells]
    return len(cells) > 1 and any(commas) and all(a or b for a, b in zip(commas, whole, strict=True))


def renamed(path: Path, head: list[str], columns: Mapping[str, str] | Sequence[str], line: int = 1) -> list[str]:
    """Return the names that the caller looks for in place of the file's own, as :func:`read_columns` returns them.

    Raises:
        InputError: a name of a column that is not there, or not as many as there are.
    """
    if not isinstance(columns, Mapping):
        if columns and len(columns) != len(head):
            raise InputError(
                f"{path}: line {line}: has {len(head)} columns, --columns names {len(columns)}: name each, _ for one that "
                "is not used"
            )
        return list(columns or head)
    for name, theirs in columns.items():
        if theirs not in head:
            raise InputError(f"{path}: line {line}: no column {theirs!r} for {name}; there are {nearest(theirs, head)}")
    given = {theirs: name for name, theirs in columns.items()}
    return [given.get(name, f"({name})" if name in columns else name) for name in head]


def _without_units(path: Path, cells: Cells) -> Cells:
    """Return numbers without the units that stand behind them, 12.5 mm, and the units in the columns' names."""
    head, columns = list(cells.head), list(zip(*(row for _, row in cells.rows), strict=True))
    for k, column in enumerate(columns):
        found = [_WITH_UNIT.fullmatch(cell) for cell in column]
        if not any(found):
            continue
        filled = [one for one, cell in zip(found, column, strict=True) if cell.lower() not in NO_NUMBER]
        units = {one[2].replace("\N{DEGREE SIGN}", "deg") if one else "" for one in filled}
        if len(units) > 1:
            raise InputError(
                f"{path}: column {head[k] or k + 1} has numbers in several units ({', '.join(sorted(units)) or 'none'}): "
                "write one"
            )
        unit = units.pop()
        columns[k] = tuple("" if one is None else one[1].replace(",", ".") for one in found)
        bare = re.sub(r"\s*[\[(]\w+[\])]$", "", head[k])
        head[k] = (
            head[k] if bare.endswith(f"_{unit}") else {"n1": "rx", "n2": "ry", "n3": "rz"}.get(bare, bare) + f"_{unit}"
        )
    rows = [(line, list(row)) for (line, _), row in zip(cells.rows, zip(*columns, strict=True), strict=True)]
    return cells._replace(head=head, rows=rows) if columns else cells
