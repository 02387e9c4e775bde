"""Poses in YAML, JSON, numpy's files and ROS's printed messages, as programs of hand-eye calibration save them.

In: a file. Out: names of columns and rows. Whatever the nesting, a pose is recognised by its form: a matrix of 4x4 or 3x4,
16, 12, 7 or 6 numbers, a position beside a rotation, or numbers that are named x, y, z. Around it: a list of poses, a
mapping of named ones, lists in parallel (rvecs, tvecs), documents of ``rostopic echo`` with their stamps. Where a record
holds poses of both sides (easy_handeye's robot and tracking, moveit_calibration's effector_wrt_world and
object_wrt_sensor), the names say which is which.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from armsight.errors import InputError
from armsight.files import opened, read_bytes
from armsight.tables.document import documents_in, matrix_of

Record: TypeAlias = dict[str, str]
#: What stands before what ``--columns`` says of a side.
PREFIX = {"robot": "", "seen": "seen:"}
#: Words in the names of poses that say whose they are.
SIDES = {
    "robot": re.compile("robot|hand|gripper|effector|eef|flange|tcp|arm|wrist|o_t_ee|end"),
    "seen": re.compile("track|target|marker|object|board|optical|sensor|camera|cam|tag|pattern|calib"),
}
#: Names for numbers that have none, by how many they are.
_MATRIX = [name for i in "123" for name in (f"r{i}1", f"r{i}2", f"r{i}3", "xyz"[int(i) - 1])]
BY_COUNT = {
    16: [*_MATRIX, "_0", "_1", "_2", "_3"],
    12: _MATRIX,
    7: [*"xyz", "n1", "n2", "n3", "n4"],
    6: [*"xyz", "n1", "n2", "n3"],
}
_ROTATION = [f"r{i}{j}" for i in "123" for j in "123"]
#: Names of a position, and of a rotation, alone or before or behind whose they are.
_POSITION = r"translations?|positions?|tvecs?|trans|pos|t|p|xyz"
_ORIENTATION = r"rotations?|orientations?|rvecs?|rotvecs?|rot|quaternions?|quat|q|R|r|rpy|euler|axis_angle"
_HALF = re.compile(
    rf"(?:(?P<before>.+?)[_.])?(?:(?P<position>{_POSITION})|(?P<rotation>{_ORIENTATION}))(?:[_.](?P<behind>.+))?"
)
_XYZ = {"x", "y", "z"}
#: A list of numbers of such a name is of joints; a unit, or an order, behind a name.
_JOINTS, _UNIT = re.compile(r"joint|servo|angles|qpos|^q$", re.IGNORECASE), re.compile(r"_(mm|m|deg|rad|xyzw|wxyz)$")
#: Where a text begins so, it is one of these files.
_DOCUMENT = re.compile(r"%YAML|---\s*$|[\[{]\s*$|[\[{]\s*(?:\[\s*[-\d.\[]|[{\"'-])|- \S|-\s*$|[\w.\"' -]+:(?:\s|$)")
#: A transform as tf_echo and tf2_echo print it.
_ECHO = re.compile(
    r"(?:At time\s+([\d.]+)\s+)?-?\s*Translation:\s*\[([^\]]*)\]\s+"
    r"-?\s*Rotation:\s*in Quaternion(?:\s*\(xyzw\))?\s*\[([^\]]*)\]"
)
#: Suffixes of documents that are text, and of those that are not.
_TEXTS, PACKED = (".yaml", ".yml", ".json"), (".npy", ".npz", ".mat", ".xml", ".gz")
_CAMERAS = re.compile(r"'(intrinsics|distortion|camera_?matrix)\w*': ", re.IGNORECASE)
_MOST_RECORDS = 200_000  # poses of a document, of 40 bytes each; half: the same; double: a hostile list takes 500 MB


def is_document(path: Path, text: str) -> bool:
    """Return whether a text, or a file by its suffix, is one of these."""
    first = next((row.strip() for row in text.splitlines() if row.strip() and not row.strip().startswith("#")), "")
    return path.suffix.lower() in _TEXTS or bool(_ECHO.search(text) or _DOCUMENT.match(first))


def is_packed(path: Path) -> bool:
    """Return whether a file begins as gzip or numpy's files do, whatever its suffix."""
    with opened(path) as file:
        return file.read(6).startswith((b"\x1f\x8b", b"\x93NUMPY"))


def document_rows(path: Path, text: str, side: str, whose: str | None) -> tuple[list[str], list[Record]]:
    """Return the names of columns and the records of a document.

    Args:
        path: the file.
        text: what it holds, "" where that is no text.
        side: "robot" or "seen": which poses are requested where records have both.
        whose: the name of the poses that are requested; None: the names say whose they are.

    Raises:
        InputError: no document, no poses in it, or poses of several and no name says whose.
    """
    if echoed := _ECHO.findall(text):
        names = ("t_s", "x", "y", "z", "qx", "qy", "qz", "qw")
        rows = [dict(zip(names, (at, *p.split(","), *q.split(",")), strict=False)) for at, p, q in echoed]
        records = [{key: cell.strip() for key, cell in one.items() if cell} for one in rows]
    else:
        records = _records(path, _parsed(path), side, whose)
    return list(dict.fromkeys(key for one in records for key in one)), records


def _records(path: Path, document: Any, side: str, whose: str | None) -> list[Record]:  # noqa: ANN401
    if isinstance(document, list) and len(document) > _MOST_RECORDS:
        raise InputError(f"{path}: holds {_content(document)}, more than {_MOST_RECORDS} poses: split it")
    records, items = list[Record](), _items(document)
    for k, (item, name) in enumerate(items, 1):
        groups, named = dict(_poses(item)), {} if name is None else {"name": name}
        if not groups and (item is None or (isinstance(item, Mapping) and None in item.values())):
            records.append({**named, **_beside(item)})
        elif not groups and records:
            raise InputError(
                f"{path}: record {k} of {len(items)} holds {_content(item)}, and no pose, as those before it do"
            )
        elif groups:
            chosen, record = _record(path, groups, side, whose)
            if len(items) == 1 and _CAMERAS.search(str(item)) and not any(_score(chosen, each) for each in SIDES):
                raise InputError(f"{path}: is a calibration of cameras ({chosen}), no table of poses")
            records.append({**record, **named, **_beside(item)})
    if not any(records):
        raise InputError(
            f"{path}: holds {_content(document)}, and no poses: expected a list of matrices, of 6 or 7 numbers, or of "
            "positions beside rotations (translation, rotation), or a table such as x_mm,y_mm,z_mm,qw,qx,qy,qz"
        )
    return records


def _record(path: Path, groups: dict[str, Record], side: str, whose: str | None) -> tuple[str, Record]:
    """Return which pose of a record is meant, and it with the joints beside."""
    poses = [key for key, one in groups.items() if not _is_joints(one)]
    chosen = _chosen(path, poses or list(groups), side, whose)
    joints = (one for one in groups.values() if poses and _is_joints(one, r"q\d_(deg|rad)"))
    return chosen, {**groups[chosen], **next(joints, {})}


def _parsed(path: Path) -> Any:  # noqa: ANN401 - whatever a document holds
    """Return a document, or a list of several, its matrices as lists."""
    documents = documents_in(read_bytes(path), path)
    return _plain(documents[0] if len(documents) == 1 else documents)


def _plain(node: Any) -> Any:  # noqa: ANN401
    """Return a node with arrays, and OpenCV's and ViSP's matrices, as nested lists without sides of 1."""
    if isinstance(node, np.ndarray):
        return node.tolist()
    if isinstance(node, list):
        return [_plain(one) for one in node]
    if not isinstance(node, Mapping):
        return node
    try:
        found = matrix_of("", node)
    except InputError:
        return dict(node)
    if found is None:
        return {str(key): _plain(one) for key, one in node.items()}
    matrix = np.squeeze(found)
    if matrix.shape == (6,) and "dt" not in node:  # ViSP's vector of a pose, theta u in radians
        return {"position": matrix[:3].tolist(), "rotvec": matrix[3:].tolist()}
    return matrix.tolist()


def _array(node: object) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Return a list of numbers, nested or not, without sides of 1; None where it is none."""
    if not isinstance(node, list) or not node:
        return None
    try:
        found = np.array(node, dtype=float)
    except (ValueError, TypeError):
        return None
    return np.squeeze(found)


def _items(node: Any) -> list[tuple[Any, str | None]]:  # noqa: ANN401
    if (array := _array(node)) is not None:
        whole = array.ndim < 2 or array.shape in ((4, 4), (3, 4))
        return [(one.tolist(), None) for one in ([array] if whole else array)]
    if isinstance(node, list):
        found: list[tuple[Any, str | None]] = [(one, None) for one in node if isinstance(one, Mapping | list | None)]
        return found if len(found) != 1 else _items(found[0][0])
    return _items_of_mapping(node) if isinstance(node, Mapping) else []


def _items_of_mapping(node: Mapping[str, Any]) -> list[tuple[Any, str | None]]:
    """Return the same of a mapping: of named poses, of one pose, of lists in parallel, or of its largest part."""
    inner = {key: one for key, one in node.items() if isinstance(one, Mapping | list)}
    named = [(one, str(key)) for key, one in inner.items() if dict(_poses(one, key))]
    if 2 < len(named) == len(inner):
        return list(named)
    if dict(_poses(node)):
        return [(node, None)]
    lists = {key: one for key, one in inner.items() if isinstance(one, list) and len(one) > 1}
    if len(lists) > 1 and len({len(one) for one in lists.values()}) == 1:
        rows = [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]
        if any(dict(_poses(row)) for row in rows):
            return [(row, None) for row in rows]
    return max(
        map(_items, inner.values()), key=lambda one: sum(bool(dict(_poses(item))) for item, _ in one), default=[]
    )


def _numbers(node: Mapping[str, Any]) -> Record:
    return {key: repr(float(one)) for key, one in node.items() if type(one) in (int, float)}


def _poses(node: Any, name: str = "") -> Iterator[tuple[str, Record]]:  # noqa: ANN401
    """Yield the poses, or joints, of a record, each by its name."""
    array = _array(node)
    if array is not None:
        if (found := _of_numbers(array, name)) is not None:
            yield name, found
        return
    if isinstance(node, list) and len(node) == 1:
        yield from _poses(node[0], name)
    if not isinstance(node, Mapping):
        return
    names, angles = node.get("name"), node.get("position")
    values = _array(angles)
    if isinstance(names, list) and values is not None and values.size == len(names):  # sensor_msgs/JointState
        yield name, {str(joint): repr(float(angle)) for joint, angle in zip(names, values.ravel(), strict=True)}
        return
    scalars = _numbers(node)
    if {key.lower().partition("_")[0] for key in scalars} >= _XYZ and len(scalars) > 3 and set(scalars) != {*"wxyz"}:
        yield name, scalars
        return
    whole = _positions_beside_rotations(node)
    for whose, found in whole.items():
        yield f"{name}.{whose}".strip("."), found
    for key, one in () if whole else node.items():
        yield from _poses(one, f"{name}.{key}".strip("."))


def _positions_beside_rotations(node: Mapping[str, Any]) -> dict[str, Record]:
    """Return the poses whose position and rotation a mapping holds beside each other, by whose they are."""
    halves: dict[str, Record] = {}
    for key, one in node.items():
        half = _HALF.fullmatch(_UNIT.sub("", key))
        if half is not None and (numbers := _half(key, one, half)):
            whose = ".".join(part for part in (half["before"], half["behind"]) if part)
            halves.setdefault(whose, {}).update(numbers)
    return {whose: found for whose, found in halves.items() if len(found) > 4}


def _is_joints(record: Record, unit: str = "") -> bool:
    known = all(re.fullmatch(unit, key) for key in record) if unit else True
    return known and not {key.partition("_")[0] for key in record} & {*_XYZ, *"XYZ"}


def _of_numbers(array: np.ndarray[Any, np.dtype[np.float64]], name: str) -> Record | None:
    """Return a pose, or joints by their name, of numbers alone; None where they are none."""
    if array.ndim == 1 and _JOINTS.search(name.split(".")[-1]):
        unit = next((f"_{unit}" for unit in ("deg", "rad") if unit in name.lower()), "")
        return {f"q{k}{unit}": repr(float(one)) for k, one in enumerate(array, 1)}
    if array.shape == (3, 4):
        array = array.ravel()
    if array.shape in ((4, 4), (16,)):
        array = array.reshape(4, 4)
        if not np.allclose(array[3], [0, 0, 0, 1], atol=1e-6) and np.allclose(array[:, 3], [0, 0, 0, 1], atol=1e-6):
            array = array.T  # column by column, as Franka's O_T_EE
        array = array.ravel()
    if array.ndim != 1 or len(array) not in BY_COUNT or "cov" in name.lower():
        return None
    return dict(zip(BY_COUNT[len(array)], (repr(float(one)) for one in array), strict=True))


def _half(key: str, node: Any, half: re.Match[str]) -> Record:  # noqa: ANN401
    """Return the numbers of a position or a rotation by their names; {} where they are none."""
    position = half["position"] is not None
    if isinstance(node, Mapping):
        numbers = _numbers(node)
        before = {frozenset(_XYZ): "r", frozenset("wxyz"): "q"} if not position else {frozenset(_XYZ): ""}
        prefix = before.get(frozenset(numbers))
        return {} if prefix is None else {f"{prefix}{k}": one for k, one in numbers.items()}
    array = _array(node)
    unit = found[0] if (found := _UNIT.search(key)) else ""
    names = [f"{axis}{unit}" for axis in "xyz"] if position else _rotation_names(key.lower(), unit, array)
    if array is None or array.size != len(names) or array.ndim > 2:
        return {}
    return dict(zip(names, (repr(float(one)) for one in array.ravel()), strict=True))


def _rotation_names(key: str, unit: str, array: np.ndarray[Any, np.dtype[np.float64]] | None) -> list[str]:
    """Return the names of a rotation's numbers by their shape, and by what they are called."""
    shape = () if array is None else array.shape
    if shape == (4,):
        order = next((order for order in ("xyzw", "wxyz") if order in key), None)
        return [f"q{k}" for k in order] if order else ["n1", "n2", "n3", "n4"]
    if shape in ((3, 3), (9,)):
        return _ROTATION
    vector = any(word in key for word in ("rvec", "rotvec", "axis"))
    return [f"r{axis}{unit or ('_rad' if vector else '')}" for axis in "xyz"]


def _beside(item: Any) -> Record:  # noqa: ANN401
    """Return the name, the image and the time of a record."""
    if not isinstance(item, Mapping):
        return {}
    out = {}
    for key, one in item.items():
        name = {"file": "image", "filename": "image", "image_path": "image"}.get(key.lower(), key.lower())
        if isinstance(one, str) and name in ("name", "image", "shot"):
            out[name] = one
        if name in ("t_s", "t", "time", "timestamp", "stamp") and (number := _numbers({key: one})):
            out["t_s"] = number[key]
    stamp = item.get("stamp", item.get("header", {}).get("stamp") if isinstance(item.get("header"), Mapping) else None)
    if isinstance(stamp, Mapping):
        whole, parts = (
            next((stamp[key] for key in keys if key in stamp), 0) for keys in (("sec", "secs"), ("nanosec", "nsecs"))
        )
        if isinstance(whole, int) and isinstance(parts, int):
            out["t_s"] = f"{whole}.{parts:09d}"
    return out


def _chosen(path: Path, names: list[str], side: str, whose: str | None) -> str:
    """Return the name of the poses that are requested, of those that a record holds."""
    if whose is not None:
        if whose not in names:
            raise InputError(f"{path}: has no poses {whose!r}; there are {', '.join(names)}")
        return whose
    if len(names) == 1:
        return names[0]
    exact = [name for name in names if name.split(".")[-1] == "O_T_EE"]
    if len(exact) == 1 and side == "robot":
        return exact[0]
    other = next(one for one in SIDES if one != side)
    scores = {name: _score(name, side) - _score(name, other) for name in names}
    best = [name for name in names if scores[name] == max(scores.values())]
    if (len(best) == 1 and scores[best[0]] > 0) or (len(names) == 2 and len(best) == 1):
        return best[0]
    raise InputError(f"{path}: holds poses of {', '.join(names)}: say which, --columns {PREFIX[side]}pose={names[0]}")


def _score(name: str, side: str) -> int:
    """Return how many words of a side a name has; what stands behind ``2`` or ``wrt`` is what a pose is given in."""
    own = re.split(r"_wrt_|2|_in_|_to_", name.lower())[0]
    return 2 * bool(SIDES[side].search(own)) + bool(SIDES[side].search(name.lower()))


def has_both(path: Path) -> bool:
    """Return whether a document's records hold poses of both sides, the robot's and what was seen."""
    if path.suffix.lower() not in (*_TEXTS, *PACKED) or not path.is_file():
        return False
    items = _items(_parsed(path))
    names = [name for name, _ in _poses(items[0][0])] if items else []
    return len(names) == 2 and all(any(_score(name, side) for name in names) for side in SIDES)


def _content(node: Any) -> str:  # noqa: ANN401
    if isinstance(node, Mapping):
        return f"a mapping of {', '.join(map(str, list(node)[:5]))}" + (", .." if len(node) > 5 else "")
    return f"a list of {len(node)}" if isinstance(node, list) else f"{str(node)[:40]!r}"
