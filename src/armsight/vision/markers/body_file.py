"""Body files: which markers a rigid body carries, and where they are on it; the format is in docs/howto/targets.md.

A TOML body file goes in, a :class:`Marker` for each ``[[markers]]`` entry comes out, with what every kind shares: name,
position and orientation in the body frame. The table of its kind is read by ``tag.py``, ``board_marker.py`` or
``discs.py``. The checks that no body may fail follow; last, bodies as CSV tables of named points, in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.data import Array, Body, Record
from armsight.errors import InputError
from armsight.files import read_table, read_toml, write_text
from armsight.geometry.check import checked
from armsight.geometry.near import pairs_within
from armsight.geometry.pose import pose
from armsight.geometry.rigid import collinear
from armsight.geometry.rotation import from_euler_zyx, from_quaternion_wxyz
from armsight.tables.lengths import BODY, check_length, number

#: The version of the format that is documented; a file without the key ``version`` has version 1.
VERSION = 2
#: Keys of version 1 -> those of today; both are read in files of either version.
RENAMED = {"roll_pitch_yaw_deg": "euler_zyx_deg"}
#: Ways to give a marker's orientation; one of them, or none where its kind needs none. ``euler_zyx_deg`` holds the
#: angles about z, y and x, in that order (ROS's roll is the angle about x).
ORIENTATIONS = ("normal, x_axis", "quaternion_wxyz", "euler_zyx_deg")
_POSE_KEYS = ("position_mm", "normal", "x_axis", "quaternion_wxyz", "euler_zyx_deg")


@dataclass(frozen=True, eq=False)
class Marker(Record):
    """One ``[[markers]]`` entry of a body file."""

    where: str  #: file and entry, for messages
    name: str  #: its name
    kind: str  #: its kind, the key of its own table
    fields: Mapping[str, Any]  #: its own table
    position: Array  #: (3,) its position, m, body frame
    #: what the file gives of its orientation: a subset of normal, x_axis, quaternion_wxyz, euler_zyx_deg
    orientation: Mapping[str, Array]

    def error(self, what: str) -> InputError:
        """Return the error of an entry that ``what`` is wrong with."""
        return InputError(f"{self.where}: {what}")

    def check_keys(self, kind: str, required: Collection[str], optional: Collection[str] = ()) -> None:
        """Raise InputError where a key of the kind's table is missing or unknown."""
        for key in self.fields:
            if key not in required and key not in optional:
                raise self.error(f"{kind} has an unknown key {key!r}; known are {', '.join((*required, *optional))}")
        for key in required:
            if key not in self.fields:
                raise self.error(f"{kind} has no {key}; it needs {', '.join(required)}")

    def converted(self, key: str, convert: Callable[[str], str]) -> str:
        """Return a text field through ``convert``, whose InputError then names the entry."""
        if not isinstance(self.fields[key], str):
            raise self.error(f"{key} must be a text in quotes, got {self.fields[key]!r}")
        try:
            return convert(self.fields[key])
        except InputError as error:
            raise self.error(str(error)) from None

    def length_m(self, key: str) -> float:
        """Return a length field that the file gives in mm, as m: above 0.01 mm and below 100 m."""
        value = self.fields[key]
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.01 <= value <= 1e5:
            raise self.error(f"{key} must be a number of mm between 0.01 and 100000, got {value!r}")
        return float(value) * 1e-3

    def normal(self) -> Array | None:
        """Return the unit vector out of the marker's face (3,), body frame; None where the file does not give it."""
        if not self.orientation:
            return None
        return _unit(self, "normal") if set(self.orientation) == {"normal"} else -self.pose()[:3, 2]

    def pose(self) -> Array:
        """Return T_body_marker (4, 4), x right, y down, z into its face; InputError without one well-formed orientation."""
        given = set(self.orientation)
        if given == {"normal", "x_axis"}:
            x, z = _unit(self, "x_axis"), -_unit(self, "normal")
            if abs(x @ z) > 1e-3:
                raise self.error("x_axis must lie in the marker's face, perpendicular to its normal")
            x = x - (x @ z) * z
            x /= np.linalg.norm(x)
            return pose(np.column_stack([x, np.cross(z, x), z]), self.position)
        if given == {"quaternion_wxyz"}:
            return pose(from_quaternion_wxyz(_unit(self, "quaternion_wxyz")), self.position)
        if given == {"euler_zyx_deg"}:
            return pose(from_euler_zyx(*np.radians(self.orientation["euler_zyx_deg"])), self.position)
        raise self.error(
            f"give its orientation by exactly one of: {'; '.join(ORIENTATIONS)}; got {', '.join(given) or 'none'}"
        )


def _unit(marker: Marker, key: str) -> Array:
    """Return a direction of the file (3,) or a quaternion (4,), normalised."""
    norm = float(np.linalg.norm(marker.orientation[key]))
    if not norm > 1e-6:
        raise marker.error(f"{key} must not be zero")
    return np.asarray(marker.orientation[key] / norm)


def read_body_file(path: str | Path, kinds: Collection[str]) -> tuple[str, tuple[Marker, ...]]:
    """Read a body file of markers of known kinds: its name (the file's, where none is given) and its markers.

    Raises InputError: missing, not TOML, or not a body; the message names the file and the entry.
    """
    document = read_toml(path)
    unknown = set(document) - {"version", "name", "markers"}
    if unknown:
        raise InputError(f"{path}: unknown key {sorted(unknown)[0]!r}; a body file has version, name and [[markers]]")
    version = document.get("version", 1)
    if type(version) is not int or not 1 <= version <= VERSION:
        raise InputError(f"{path}: version {version!r}; this program reads body files of version 1 to {VERSION}")
    entries = document.get("markers")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: a body file needs [[markers]] entries, one for each marker")
    markers = tuple(_marker(f"{path}: marker {i + 1}", entry, kinds) for i, entry in enumerate(entries))
    names = [marker.name for marker in markers]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise markers[i].error(f"the name {name!r} is marker {names.index(name) + 1}'s already")
    name = document.get("name", Path(path).stem)
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: name must be a text in quotes, got {name!r}")
    return name, markers


def _marker(where: str, entry: Mapping[str, Any], kinds: Collection[str]) -> Marker:
    """Read one entry; keys of version 1 are renamed."""
    entry = {RENAMED.get(key, key): value for key, value in entry.items()}
    name = entry.get("name")
    if not isinstance(name, str) or not name or "," in name:
        raise InputError(f"{where}: needs a name, a text in quotes without commas, got {name!r}")
    where = f"{where} ({name})"
    own = _own_table(where, entry, kinds)
    if "position_mm" not in entry:
        raise InputError(f"{where}: has no position_mm = [x, y, z]")
    numbers = {}
    for key in (key for key in _POSE_KEYS if key in entry):
        if isinstance(entry[key], list) and any(isinstance(number, str | bool) for number in entry[key]):
            raise InputError(f"{where}: {key} must be numbers without quotes, got {entry[key]!r}")
        numbers[key] = checked(entry[key], (4 if key == "quaternion_wxyz" else 3,), f"{where}: {key}")
    position = numbers.pop("position_mm") * 1e-3
    if np.abs(position).max() > 100.0:
        raise InputError(f"{where}: position_mm is {position.max():g} m from the body's origin; is it in mm?")
    return Marker(where, name, own, entry[own], position, numbers)


def _own_table(where: str, entry: Mapping[str, Any], kinds: Collection[str]) -> str:
    """Return the name of the one table that says a marker's kind."""
    own = [key for key in entry if key not in ("name", *_POSE_KEYS)]
    known = ", ".join(sorted(kinds))
    for key in own:
        if key not in kinds:
            raise InputError(
                f"{where}: unknown key {key!r}; a marker has name, {', '.join(_POSE_KEYS)}, and one table of: {known}"
            )
    if len(own) != 1:
        raise InputError(
            f"{where}: needs exactly one table that says its kind, of: {known}; got {', '.join(own) or 'none'}"
        )
    if not isinstance(entry[own[0]], dict):
        raise InputError(f"{where}: {own[0]} must be a table, such as {own[0]} = {{ ... }}")
    return own[0]


#: Largest body with discs, and largest radius of a disc, m: a larger one has a wrong unit in its file.
DISC_BODY_MAX_M, DISC_RADIUS_MAX_M = 10.0, 0.5
#: Two discs may share a position where they are the two faces of a thin plate: the cosine between their normals is
#: below this.
_OPPOSED = -0.5


def check_discs(markers: Sequence[Marker], radii_m: Sequence[float]) -> None:
    """Reject discs of one body that cannot all exist.

    ``markers``: their entries in the body file; ``radii_m``: their radii, m. Raises InputError: a radius or a distance that
    suggests a wrong unit, or two discs at one position; the message names file and entry.
    """
    positions = np.array([marker.position for marker in markers])
    away = np.linalg.norm(positions - positions[0], axis=1)
    for marker, radius, distance in zip(markers, radii_m, away, strict=True):
        if radius > DISC_RADIUS_MAX_M:
            raise marker.error(f"radius_mm is {1e3 * radius:g}, a disc {2 * radius:g} m across; is it in mm?")
        if distance > DISC_BODY_MAX_M:
            raise marker.error(
                f"lies {distance:g} m from {markers[0].name}, and a body with discs is {DISC_BODY_MAX_M:g} m across at "
                "most; is position_mm in mm?"
            )
    for i, j in sorted(map(tuple, pairs_within(positions, max(radii_m)).tolist())):
        gap, larger = float(np.linalg.norm(positions[i] - positions[j])), max(radii_m[i], radii_m[j])
        if gap < larger and not _back_to_back(markers[i], markers[j]):
            where = "at the same position as" if gap < 1e-6 else f"{1e3 * gap:.3g} mm from"
            raise markers[j].error(
                f"lies {where} {markers[i].name}, within a disc of radius {1e3 * larger:g} mm; are all lengths in mm?"
            )


def _back_to_back(one: Marker, other: Marker) -> bool:
    """Whether two discs are known to face opposite ways."""
    normals = one.normal(), other.normal()
    return normals[0] is not None and normals[1] is not None and float(normals[0] @ normals[1]) < _OPPOSED


def check_points(path: str | Path, body: Body) -> None:
    """Reject a body whose points cannot determine a pose: fewer than three, or all on one line (InputError)."""
    count = len(body.points)
    if count < 3:
        raise InputError(
            f"{path}: {count} disc{'s' if count > 1 else ''} cannot determine a pose: give 3 or more that do not lie "
            "on one line"
        )
    if collinear(body.points):
        raise InputError(
            f"{path}: its points ({', '.join(body.point_names[:3])}{', ...' if count > 3 else ''}) lie on one line, so the "
            "rotation about that line is unobservable: move one of them off it"
        )


#: Headers that are read; all lengths are metres. The first is the one written.
HEADERS = (
    ("marker", "x_m", "y_m", "z_m"),
    ("id", "x_m", "y_m", "z_m"),
    ("id", "x", "y", "z"),
    ("marker", "x", "y", "z"),
)


def load_body_csv(path: str | Path) -> Body:
    """Read a body from a table of its points: CSV with a header of HEADERS and a line for each point.

    Raises InputError: missing, malformed, not numbers, a name twice, fewer than three points, or a size that suggests a
    wrong unit; the message names the file and the line.
    """
    rows = read_table(path)
    if not rows or tuple(field.strip().lower() for field in rows[0]) not in HEADERS:
        given = ",".join(rows[0]) if rows else "an empty file"
        raise InputError(f"{path}: line 1: expected the header {','.join(HEADERS[0])} (metres), got {given!r}")
    names: dict[str, int] = {}
    points = []
    for line, row in enumerate(rows[1:], start=2):
        if not any(field.strip() for field in row):
            continue
        if len(row) != 4:
            raise InputError(f"{path}: line {line}: expected 4 columns, got {len(row)}")
        name = row[0].strip()
        if not name:
            raise InputError(f"{path}: line {line}: the point has no name")
        if name in names:
            raise InputError(f"{path}: line {line}: the point {name!r} stands on line {names[name]} already")
        names[name] = line
        points.append([_coordinate(f"{path}: line {line}", field) for field in row[1:]])
    if len(points) < 3:
        raise InputError(f"{path}: a body needs 3 or more points, got {len(points)}")
    array = np.array(points)
    try:
        check_length(float(np.ptp(array, axis=0).max()), 1.0, BODY, "the coordinates in metres")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return Body(Path(path).stem, tuple(names), array)


def _coordinate(where: str, text: str) -> float:
    value = number(text)
    if value is None:
        raise InputError(f"{where}: {text.strip()!r} is not a number")
    if not math.isfinite(value):
        raise InputError(f"{where}: {text.strip()} where a finite number of metres belongs")
    return value


def save_body_csv(body: Body, path: str | Path) -> None:
    """Write a body as a table of its points, metres, to the nanometre, in one step; InputError if it cannot be written."""
    lines = [",".join(HEADERS[0])]
    lines += [
        f"{name},{x:.9f},{y:.9f},{z:.9f}"
        for name, (x, y, z) in zip(body.point_names, body.points.tolist(), strict=True)
    ]
    write_text(path, "\n".join(lines) + "\n")
