"""Files of names and values, in whatever syntax: found by the content, not the suffix.

In: a file. Out: its documents as mappings, lists, texts, numbers and matrices (whatever has ``rows``, ``cols`` and ``data``
is an array). Read are YAML, JSON, JSON Lines, TOML, INI, Python's literals (mrcal), OpenCV's FileStorage in YAML, XML or
JSON, numpy's .npz and .npy, each also compressed by gzip. What holds programs (pickles) or is an archive is named with what
to do. YAML has the plain values of YAML 1.2's core schema, as yaml-cpp and ROS read them (1e-05 is a number, 010 is ten,
``on`` and ``2026-01-01`` are texts), and OpenCV's ``%YAML:1.0``; a name that stands twice in one mapping is an error.
"""

from __future__ import annotations

import ast
import configparser
import io
import json
import re
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeAlias
from xml.etree import ElementTree

import numpy as np
import yaml

from armsight.errors import InputError, naming
from armsight.files import DOCUMENT_MB, as_input_error, parse_toml, parsed_json, read_bytes, read_text
from armsight.tables.lengths import number

#: A value of a file of another program: a number, a text, a list or a mapping, unknown until checked.
Foreign: TypeAlias = Any
_Event: TypeAlias = Any  # an event of PyYAML's parser; its kinds have no common type with a tag and an anchor

#: What is read, for messages.
KINDS = "YAML, JSON, TOML, INI, OpenCV's XML, mrcal's .cameramodel, .npz or .npy, each also as .gz"
_SAVE = "save the arrays with numpy.savez('calibration.npz', K1=K1, D1=D1, ..)"
_MOST_VALUES = 1_000_000  # of YAML, aliases counted in full; half: 30,000 poses; double: 400 MB where all are lists
_MOST_DEPTH = 100  # of YAML; half: still three times what programs nest; double: hostile files overflow the stack
#: Plain values of YAML 1.2's core schema; OpenCV writes .Nan and .Inf.
_PLAIN = re.compile(
    r"(?P<null>~|null|Null|NULL|)|(?P<true>true|True|TRUE)|(?P<false>false|False|FALSE)|(?P<int>[-+]?[0-9]+)|"
    r"(?P<based>0o[0-7]+|0x[0-9a-fA-F]+)|(?P<float>[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?)|"
    r"(?P<special>[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN|Nan))"
)
_VALUES: dict[str, Callable[[str], Foreign]] = {
    "null": lambda text: None,
    "true": lambda text: True,
    "false": lambda text: False,
    "int": int,
    "based": lambda text: int(text, 0),
    "float": float,
    "special": lambda text: float(text.replace(".", "")),
}
_CORE = "tag:yaml.org,2002:"
#: Tags that change nothing of what is plain to see.
_HARMLESS = {None, "!", *(_CORE + name for name in (
    "seq", "map", "int", "float", "bool", "null", "opencv-matrix", "opencv-nd-matrix", "python/tuple"))}  # fmt: skip
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_document(path: str | Path) -> dict[str, Foreign]:
    """Read a file of names and values.

    Raises:
        InputError: missing, damaged, or of a kind that is not read; the message names it and the way out.
    """
    document = _only(documents_in(read_bytes(path), path), path)
    if not isinstance(document, Mapping):
        kind = "nothing" if document is None else "a list" if isinstance(document, list) else "text, or a table (CSV)"
        raise InputError(f"{path}: holds {kind}; expected names and values, as YAML, JSON, TOML or INI")
    with naming(path):
        return {str(key): _with_matrices(str(key), value) for key, value in document.items()}


def _only(documents: list[Foreign], path: str | Path) -> Foreign:
    if len(documents) > 1:
        raise InputError(
            f"{path}: holds {len(documents)} YAML documents, separated by ---; expected one: keep one of them"
        )
    return documents[0]


def documents_in(data: bytes, path: str | Path) -> list[Foreign]:
    """Return the documents that a file's bytes hold, one at least; errors as :func:`read_document`."""
    if data[:2] == b"\x1f\x8b":
        data = _unpacked(data, path)
    if data[:4] == b"PK\x03\x04" or data[:6] == b"\x93NUMPY":
        return [_numpy(data, path)]
    _refuse(data, path)
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        if data[:200].lstrip().startswith(b"<?xml"):
            return [_xml(data, path)]
        raise InputError(f"{path}: not a text file, and no other that is read here: {KINDS}") from None
    return _of_text(text, path)


def matrix_of(name: str, value: Mapping[str, Foreign]) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Return a mapping of rows, cols and data (OpenCV, ViSP, ROS) as an array; None where it is none.

    Raises:
        InputError: no numbers, or not as many as it says.
    """
    sized = {"sizes", "data", "dt"} <= set(value)  # OpenCV 5's vectors, and matrices of three dimensions
    if not sized and not {"rows", "cols", "data"} <= set(value):
        return None
    with as_input_error(
        f"{name} must be numbers: rows, cols and data of a matrix", TypeError, ValueError, OverflowError
    ):
        rows, cols = (int(np.prod(np.asarray(value["sizes"], float))), 1) if sized else (value["rows"], value["cols"])
        rows, cols, data = int(rows), int(cols), np.asarray(value["data"], float).ravel()
    channels = re.match(r"\d*", str(value.get("dt", "")))
    depth = int(channels[0]) if channels and channels[0] else 1
    if min(rows, cols) < 0 or rows * cols * depth != data.size:
        raise InputError(
            f"{name} is damaged: it says {rows} rows and {cols} cols, and its data holds {data.size} numbers"
        )
    return data.reshape((rows, cols) if depth == 1 else (rows * cols, depth))


def _with_matrices(name: str, value: Foreign) -> Foreign:
    """Return a value in which whatever has rows, cols and data is an array."""
    if isinstance(value, list):
        return [_with_matrices(name, one) for one in value] if any(isinstance(one, dict) for one in value) else value
    if not isinstance(value, Mapping):
        return value
    array = matrix_of(name, value)
    return {str(key): _with_matrices(f"{name}.{key}", one) for key, one in value.items()} if array is None else array


def _unpacked(data: bytes, path: str | Path) -> bytes:
    most = int(DOCUMENT_MB * 1e6)
    with as_input_error(f"{path}: compressed by gzip and damaged", zlib.error, why=True):
        packed = zlib.decompressobj(31)
        out = packed.decompress(data, most + 1)
    if len(out) > most:
        raise InputError(f"{path}: holds more than {DOCUMENT_MB} MB: is it the right file?")
    if not packed.eof:
        raise InputError(f"{path}: compressed by gzip and cut short: copy it again")
    return out


def _refuse(data: bytes, path: str | Path) -> None:
    """Raise an InputError for a file of a kind that is known and not read."""
    if data[:6] == b"MATLAB" or data[:4] == b"\x89HDF":
        raise InputError(
            f"{path}: a MATLAB file, which is not read: in MATLAB, writelines(jsonencode(load('{Path(path).name}')), "
            "'calibration.json') writes one that is"
        )
    if data[257:262] == b"ustar":
        raise InputError(f"{path}: an archive (tar): unpack it and give the files in it")
    if re.match(rb"\x80[\x02-\x05]", data):
        raise InputError(f"{path}: a Python pickle, which may run programs and is not read: {_SAVE}")


def _numpy(data: bytes, path: str | Path) -> dict[str, Foreign]:
    try:
        if data[:2] == b"PK":
            sizes = [member.file_size for member in zipfile.ZipFile(io.BytesIO(data)).infolist()]
            if sum(sizes) > DOCUMENT_MB * 1e6:
                raise InputError(
                    f"{path}: holds {sum(sizes) / 1e6:.0f} MB, more than {DOCUMENT_MB}: is it the right file?"
                )
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        return dict(loaded) if data[:2] == b"PK" else {Path(path).stem: loaded}
    except (ValueError, SyntaxError, tokenize.TokenError) as error:  # the header is Python's
        if "allow_pickle" in str(error):
            raise InputError(f"{path}: holds a pickled Python object, which may run programs: {_SAVE}") from None
        raise InputError(f"{path}: a damaged numpy file: {error}") from None
    except (OSError, KeyError, EOFError, zlib.error, RuntimeError, zipfile.BadZipFile, MemoryError) as error:
        raise InputError(
            f"{path}: an archive (zip) or damaged .npz: {error}; unpack it and give the files in it"
        ) from None


def _of_text(text: str, path: str | Path) -> list[Foreign]:
    """Return what a text holds, by its first line that is no comment."""
    if text.lstrip().startswith("# oST"):
        raise InputError(
            f"{path}: camera_calibration's ost.txt; give the .yaml files of the same archive, or of ~/.ros/camera_info"
        )
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith(("#", ";", "//"))), "")
    if first.startswith("<"):
        return [_xml(text.lstrip().encode(), path)]
    suffix = Path(path).suffix.lower()
    if suffix == ".toml":
        return [_toml_or_ini(text, path)]
    if first.startswith(("{", "[")) and not re.fullmatch(r"\[\[?[\w.\" /-]+\]?\]\s*([#;].*)?", first):
        if suffix != ".json" and first.startswith("{") and re.search(r"^\s*(#|')|^\{\s*'", text, re.MULTILINE):
            return [_literal(text, path)]
        return _json(text, path)
    if first.startswith("[") or re.match(r"[\w.\"-]+\s*=", first):
        return [_toml_or_ini(text, path)]
    if suffix == ".json" and first:
        return [parsed_json(text, path)]
    if suffix in (".yaml", ".yml", ""):
        return parse_yaml(text, path)
    with as_input_error(f"{path}: no file of names and values; read are {KINDS}", InputError, why=True):
        return parse_yaml(text, path)


def _json(text: str, path: str | Path) -> list[Foreign]:
    try:
        return [parsed_json(text, path)]
    except InputError:
        rows = [row.strip() for row in text.splitlines() if row.strip()]
        if len(rows) > 1 and all(row[0] in "{[" for row in rows):
            try:
                return [[json.loads(row.rstrip(",")) for row in rows]]
            except ValueError:
                pass
        if Path(path).suffix.lower() == ".json" or re.match(r"\s*\{\s*\"", text):
            raise
        return parse_yaml(text, path)


def read_yaml(path: str | Path) -> Mapping[str, Foreign]:
    """Read a YAML file of one document that is a mapping.

    Raises:
        InputError: missing, not YAML, another number of documents, or no mapping; the message names file and line.
    """
    document = _only(parse_yaml(read_text(path), path), path)
    if not isinstance(document, dict):
        raise InputError(f"{path}: expected a YAML mapping of names to values, such as width: 640")
    return document


def parse_yaml(text: str, path: str | Path) -> list[Foreign]:
    """Return the documents of a YAML text, one at least; an empty one at its end (a trailing ---) is left out.

    Args:
        text: the text.
        path: where it comes from, for messages.

    Raises:
        InputError: not YAML; the message names the line.
    """
    text = text.removeprefix("\ufeff")
    if text.startswith("%YAML"):  # OpenCV's header is no directive of YAML; the line stays, for messages
        text = text[text.index("\n") :] if "\n" in text else ""
    try:
        documents = _Yaml(text).documents()
    except yaml.MarkedYAMLError as error:
        last = text.count("\n") + 1
        line = f"line {min(error.problem_mark.line + 1, last)}: " if error.problem_mark else ""
        raise InputError(f"{path}: {line}not YAML ({error.problem})") from None
    except (yaml.YAMLError, ValueError):  # control characters, thousands of digits
        raise InputError(f"{path}: not YAML") from None
    while len(documents) > 1 and documents[-1] is None:
        documents.pop()
    return documents or [None]


class _Yaml:
    """The values of a YAML text, made from the parser's events: PyYAML's tree of nodes takes 1 kB for each value."""

    def __init__(self, text: str) -> None:
        self._events = iter(yaml.parse(text, _LOADER))
        self._count = 0
        #: Anchor -> its value, and how many values that holds.
        self._anchors: dict[str, tuple[Foreign, int]] = {}

    def documents(self) -> list[Foreign]:
        return [
            self._value(next(self._events), 0) for event in self._events if isinstance(event, yaml.DocumentStartEvent)
        ]

    def _value(self, event: _Event, depth: int) -> Foreign:
        before, alias = self._count, isinstance(event, yaml.AliasEvent)
        if alias and event.anchor not in self._anchors:
            _reject(event, f"no anchor &{event.anchor} before it")
        value, held = self._anchors[event.anchor] if alias else (None, 0)
        self._count += 1 + held
        if self._count > _MOST_VALUES or depth > _MOST_DEPTH:
            _reject(event, f"over {_MOST_VALUES} values, or nested over {_MOST_DEPTH} deep: is it the right file?")
        if alias:
            return value
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event)
        else:
            self._check_tag(event)
            value = self._sequence(depth) if isinstance(event, yaml.SequenceStartEvent) else self._mapping(depth)
        if event.anchor:
            self._anchors[event.anchor] = value, self._count - before
        return value

    def _sequence(self, depth: int) -> list[Foreign]:
        values = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            values.append(self._value(event, depth + 1))
        return values

    def _mapping(self, depth: int) -> dict[Hashable, Foreign]:
        """Return a mapping; a name that stands in it twice is an error, ``<<`` gives what its own names do not."""
        values: dict[Hashable, Foreign] = {}
        merged: dict[Hashable, Foreign] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self._value(event, depth + 1)
            value = self._value(next(self._events), depth + 1)
            if not isinstance(key, Hashable):
                _reject(event, "a list or mapping as a name")
            if key == "<<":
                for one in reversed(value if isinstance(value, list) else [value]):
                    if not isinstance(one, dict):
                        _reject(event, "<< needs mappings")
                    merged |= one
            elif key in values:
                _reject(event, f"{key!r} stands twice in one mapping")
            else:
                values[key] = value
        return merged | values if merged else values

    def _scalar(self, event: yaml.ScalarEvent) -> Foreign:
        """Return a text, or the plain value that it is; a leading zero does not make a number octal."""
        if event.tag == _CORE + "str" or (event.tag in (None, "!") and not event.implicit[0]):
            return event.value
        self._check_tag(event)
        found = _PLAIN.fullmatch(event.value)
        return event.value if found is None else _VALUES[str(found.lastgroup)](event.value)

    def _check_tag(self, event: _Event) -> None:
        """Reject a value of a kind that is not known: what it means would be a guess."""
        if event.tag not in _HARMLESS:
            python = "; that is a Python object, not plain numbers: write arrays with .tolist()"
            tag = event.tag.replace(_CORE, "!!")
            _reject(event, f"the tag {tag} is not known{python if 'python/' in tag else ''}")


def _reject(event: _Event, problem: str) -> NoReturn:
    raise yaml.MarkedYAMLError(None, None, problem, event.start_mark)


def dump_yaml(document: Mapping[str, Foreign]) -> str:
    """Return YAML text whose numbers read back exactly."""
    return str(yaml.safe_dump(dict(document), sort_keys=False, default_flow_style=None, width=120))


def _literal(text: str, path: str | Path) -> Foreign:
    try:
        return ast.literal_eval(text.lstrip())
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        line = f"line {error.lineno}: " if isinstance(error, SyntaxError) else ""
        raise InputError(f"{path}: {line}neither JSON nor Python's names and values") from None


def _toml_or_ini(text: str, path: str | Path) -> dict[str, Foreign]:
    """Return TOML, or INI with numbers where its values are some."""
    try:
        return parse_toml(text)
    except (ValueError, RecursionError) as error:
        problem = error
    if Path(path).suffix.lower() == ".toml":
        raise InputError(f"{path}: not TOML: {problem}") from None
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign] # names keep their capitals
    with as_input_error(f"{path}: neither TOML nor INI: {problem}", configparser.Error):
        parser.read_string(text)
    return {name: {key: _or_number(value) for key, value in parser[name].items()} for name in parser.sections()}


def _xml(data: bytes, path: str | Path) -> Foreign:
    with as_input_error(f"{path}: not XML", ElementTree.ParseError, why=True):
        root = ElementTree.fromstring(data)
    if root.tag != "opencv_storage":
        raise InputError(f"{path}: XML of <{root.tag}>; expected OpenCV's <opencv_storage>")
    return _node(root)


def _node(element: ElementTree.Element) -> Foreign:
    if children := list(element):
        listed = all(child.tag == "_" for child in children)
        return [*map(_node, children)] if listed else {child.tag: _node(child) for child in children}
    words = (element.text or "").split()
    if element.tag == "dt" or not words:
        return " ".join(words)
    values = [_or_number(word) for word in words]
    if any(isinstance(value, str) for value in values):
        return " ".join(words).strip('"')
    return values[0] if len(values) == 1 and element.tag != "data" else values


def _or_number(text: str) -> Foreign:
    return text.strip() if (found := number(text)) is None else found
