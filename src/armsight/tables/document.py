"""Files of names and values, in whatever syntax: found by the content, not the suffix.

In: a file. Out: a mapping of names to texts, numbers, lists, mappings and matrices (whatever has ``rows``, ``cols`` and
``data`` is an array). Read are YAML, JSON, TOML, INI, Python's literals (mrcal), OpenCV's FileStorage in YAML, XML or JSON,
numpy's .npz and .npy, each also compressed by gzip. What holds programs (pickles) or is an
archive is named with what to do.
"""

from __future__ import annotations

import ast
import configparser
import io
import re
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from armsight.errors import InputError
from armsight.files import DOCUMENT_MB, YAML_MB, parsed_json, read_bytes
from armsight.tables.yaml_file import Foreign, parse_yaml

#: First bytes -> what the file is, and what to do instead.
_OTHERS = (
    (b"\x80\x02", "a Python pickle, which may run programs"),
    (b"\x80\x03", "a Python pickle, which may run programs"),
    (b"\x80\x04", "a Python pickle, which may run programs"),
    (b"\x80\x05", "a Python pickle, which may run programs"),
)
_SAVE = "save the arrays with numpy.savez('calibration.npz', K1=K1, D1=D1, ..)"


def read_document(path: str | Path) -> dict[str, Foreign]:
    """Read a file of names and values.

    Raises:
        InputError: missing, damaged, or of a kind that is not read; the message names it and the way out.
    """
    data = read_bytes(path)
    if data[:2] == b"\x1f\x8b":
        data = _unpacked(data, path)
    document = _binary(data, path)
    if document is None:
        try:
            text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
        except UnicodeDecodeError:
            if data[:200].lstrip().startswith(b"<?xml"):
                return _checked(_xml(data, path), path)
            raise InputError(f"{path}: not a text file, and no other that is read here: {KINDS}") from None
        document = _text(text, path)
    return _checked(document, path)


#: What is read, for messages.
KINDS = "YAML, JSON, TOML, INI, OpenCV's XML, mrcal's .cameramodel, .npz or .npy, each also as .gz"


def _checked(document: Foreign, path: str | Path) -> dict[str, Foreign]:
    """Return a document that is a mapping, its matrices as arrays."""
    if not isinstance(document, Mapping):
        kind = "nothing" if document is None else f"a {'list' if isinstance(document, list) else 'single value'}"
        raise InputError(f"{path}: holds {kind}; expected names and values, as YAML, JSON, TOML or INI")
    try:
        return {str(key): _with_matrices(str(key), value) for key, value in document.items()}
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _with_matrices(name: str, value: Foreign) -> Foreign:
    """Return a value in which whatever has rows, cols and data is an array."""
    if isinstance(value, list):
        return [_with_matrices(name, one) for one in value] if any(isinstance(one, dict) for one in value) else value
    if not isinstance(value, Mapping):
        return value
    sized = {"sizes", "data", "dt"} <= set(value)  # OpenCV 5's vectors, and matrices of three dimensions
    if not sized and not {"rows", "cols", "data"} <= set(value):
        return {str(key): _with_matrices(f"{name}.{key}", one) for key, one in value.items()}
    try:
        if sized:
            value = {**value, "rows": int(np.prod(np.asarray(value["sizes"], float))), "cols": 1}
        rows, cols, data = int(value["rows"]), int(value["cols"]), np.asarray(value["data"], float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} must be numbers: rows, cols and data of a matrix") from None
    channels = re.match(r"\d*", str(value.get("dt", "")))
    depth = int(channels[0]) if channels and channels[0] else 1
    if min(rows, cols) < 0 or rows * cols * depth != data.size:
        raise InputError(
            f"{name} is damaged: it says {rows} rows and {cols} cols, and its data holds {data.size} numbers"
        )
    return data.reshape((rows, cols) if depth == 1 else (rows * cols, depth))


def _unpacked(data: bytes, path: str | Path) -> bytes:
    """Return what gzip packed."""
    most = int(DOCUMENT_MB * 1e6)
    try:
        packed = zlib.decompressobj(31)
        out = packed.decompress(data, most + 1)
    except zlib.error as error:
        raise InputError(f"{path}: compressed by gzip and damaged: {error}") from None
    if len(out) > most:
        raise InputError(f"{path}: holds more than {DOCUMENT_MB} MB: is it the right file?")
    if not packed.eof:
        raise InputError(f"{path}: compressed by gzip and cut short: copy it again")
    return out


def _binary(data: bytes, path: str | Path) -> dict[str, Foreign] | None:
    """Return what a file of numpy holds, None where it is none."""
    if data[:4] == b"PK\x03\x04" or data[:6] == b"\x93NUMPY":
        return _numpy(data, path)
    if data[:6] == b"MATLAB" or data[:4] == b"\x89HDF":
        raise InputError(
            f"{path}: a MATLAB file, which is not read: in MATLAB, writelines(jsonencode(load('{Path(path).name}')), "
            "'calibration.json') writes one that is"
        )
    if data[257:262] == b"ustar":
        raise InputError(f"{path}: an archive (tar): unpack it and give the files in it")
    for magic, what in _OTHERS:
        if data.startswith(magic):
            raise InputError(f"{path}: {what} and is not read: {_SAVE}")
    return None


def _numpy(data: bytes, path: str | Path) -> dict[str, Foreign]:
    """Return the arrays of an .npz, or the one of an .npy under the file's name."""
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
    except (
        OSError,
        KeyError,
        EOFError,
        NotImplementedError,
        zlib.error,
        RuntimeError,
        zipfile.BadZipFile,
        MemoryError,
    ) as error:
        raise InputError(
            f"{path}: an archive (zip) or damaged .npz: {error}; unpack it and give the files in it"
        ) from None


def _text(text: str, path: str | Path) -> Foreign:
    """Return what a text holds, by its first line that is no comment."""
    if text.lstrip().startswith("# oST"):
        raise InputError(
            f"{path}: camera_calibration's ost.txt; give the .yaml files of the same archive, or of ~/.ros/camera_info"
        )
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith(("#", ";", "//"))), "")
    if first.startswith("<"):
        return _xml(text.lstrip().encode(), path)
    if first.startswith(("{", "[")) and not re.fullmatch(r"\[\[?[\w.\" /-]+\]?\]\s*([#;].*)?", first):
        if (
            Path(path).suffix.lower() != ".json"
            and first.startswith("{")
            and re.search(r"^\s*(#|')", text, re.MULTILINE)
        ):
            return _literal(text, path)
        return parsed_json(text, path)
    if first.startswith("[") or re.match(r"[\w.\"-]+\s*=", first):
        return _toml_or_ini(text, path)
    if len(text) > YAML_MB * 1e6:
        raise InputError(
            f"{path}: has {len(text) / 1e6:.0f} MB of YAML, such a file at most {YAML_MB} MB: is it the right one?"
        )
    documents = parse_yaml(text, path)
    if len(documents) > 1:
        raise InputError(
            f"{path}: holds {len(documents)} YAML documents, separated by ---; expected one: keep one of them"
        )
    return documents[0]


def _literal(text: str, path: str | Path) -> Foreign:
    """Return Python's literals, as mrcal writes them."""
    try:
        return ast.literal_eval(text.lstrip())
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        line = f"line {error.lineno}: " if isinstance(error, SyntaxError) else ""
        raise InputError(f"{path}: {line}neither JSON nor Python's names and values") from None


def _toml_or_ini(text: str, path: str | Path) -> dict[str, Foreign]:
    """Return TOML, or INI with numbers where its values are some."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        problem = error
    if Path(path).suffix.lower() == ".toml":
        raise InputError(f"{path}: not TOML: {problem}") from None
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign] # names keep their capitals
    try:
        parser.read_string(text)
    except configparser.Error:
        raise InputError(f"{path}: neither TOML nor INI: {problem}") from None
    return {section: {key: _number(value) for key, value in parser[section].items()} for section in parser.sections()}


def _xml(data: bytes, path: str | Path) -> Foreign:
    """Return what OpenCV's XML holds."""
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: not XML: {error}") from None
    if root.tag != "opencv_storage":
        raise InputError(f"{path}: XML of <{root.tag}>; expected OpenCV's <opencv_storage>")
    return _node(root)


def _node(element: ElementTree.Element) -> Foreign:
    """Return the value of an element of OpenCV's XML."""
    children = list(element)
    if children:
        if all(child.tag == "_" for child in children):
            return [_node(child) for child in children]
        return {child.tag: _node(child) for child in children}
    words = (element.text or "").split()
    if element.tag == "dt" or not words:
        return " ".join(words)
    values = [_number(word) for word in words]
    if any(isinstance(value, str) for value in values):
        return " ".join(words).strip('"')
    return values[0] if len(values) == 1 and element.tag != "data" else values


def _number(text: str) -> Foreign:
    """Return a number where a text is one."""
    try:
        return float(text)
    except ValueError:
        return text.strip()
