"""Poses and joints in the languages of robots' controllers.

In: the text of a program or of its data. Out: names of columns and rows, mm and degrees as the maker writes them. A table
of patterns, one a maker; each says in which unit and convention its numbers are, by its maker's manual:

- Universal Robots ``p[x, y, z, rx, ry, rz]``: m and rad, a rotation vector.
- KUKA ``{X 1,Y 2,Z 3,A 4,B 5,C 6}`` (.dat, .src): mm, deg, about z, y' and x''; axes ``{A1 1,..,A6 6}``.
- ABB ``[[x,y,z],[q1,q2,q3,q4],..]`` (RAPID): mm, a quaternion w first; ``jointtarget``.
- FANUC ``P[1]{.. X = 1 mm, .. R = 6 deg}`` (.LS), Yaskawa ``C00000=x,..`` (.JBI, ///RECTAN), DENSO ``P(x, .., rz, fig)``,
  xArm ``set_position(x=.., yaw=..)``: mm, deg, about the fixed x, y and z.
- Staubli ``<Value x= .. rz= />`` (.dtx), Mecademic ``MovePose(..)``: mm, deg, about x, y' and z''.
- Epson ``XY(x, y, z, u, v, w)`` and .pts: mm, deg, U, V, W about the fixed z, y and x; Mitsubishi ``P1=(x,..,c)(7,0)``,
  Techman ``PTP("CPP",x,..,rz,..)``: mm, deg, about the fixed x, y and z.
- Doosan ``posx(x, y, z, a, b, c)``, Kawasaki ``.TRANS`` and ``TRANS(x,y,z,o,a,t)``: mm, deg, about z, y' and z''; given on
  as a quaternion.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.errors import InputError
from armsight.tables.number import NUMBER

_N = NUMBER
_SIX = rf"\s*({_N})" + rf"\s*,\s*({_N})" * 5
_SIX_JOINTS = rf"\s*({_N}(?:\s*,\s*{_N}){{5}})"
_JOINTS = rf"\s*({_N}(?:\s*,\s*{_N}){{3,6}})"
_MM = ("x_mm", "y_mm", "z_mm")
_ANGLES = ("rx_deg", "ry_deg", "rz_deg")
_ROTATED, _FIXED = "XYZ", "xyz"
#: Kawasaki: between two numbers; Epson: the names before the second number and on.
_OR_BLANK = r"(?:[ \t]*,[ \t]*|[ \t]+)"
_SPEL = "".join(rf"(?:\s*,\s*|\s*r{name}\s*=\s*)({_N})" for name in "YZUVW")


class Program(NamedTuple):
    """A maker's way to write poses."""

    maker: str  #: its name
    mark: str | None  #: what shows that a text is of this maker; None: the patterns
    pose: str  #: a pattern with its numbers as groups, in the order of ``names``
    names: tuple[str, ...]  #: of the numbers of a pose; () where the pattern names them itself
    rotation: str  #: the convention of its angles; "" for quaternions
    joints: str | None = None  #: a pattern of joints, degrees, one group with commas, or named groups
    beside: str | None = None  #: a pattern of lines that hold such numbers, but no pose to read: tools, frames


PROGRAMS = (
    Program(
        "ABB",
        r"\brobtarget\b|\bjointtarget\b|\bMove[LJ]\b|^\s*MODULE\b|^\s*\[\s*\[[^\[\]]*\]\s*,\s*\[[^\[\]]*\]\s*,\s*\[",
        rf"\[\s*\[\s*({_N})\s*,\s*({_N})\s*,\s*({_N})\s*\]\s*,\s*\[\s*({_N})\s*,\s*({_N})\s*,\s*({_N})\s*,\s*({_N})\s*\]\s*,\s*\[",
        (*_MM, "qw", "qx", "qy", "qz"),
        "",
        rf"\[\s*\[{_JOINTS}\s*\]\s*,\s*\[",
        r"\b(?:tooldata|wobjdata|loaddata|speeddata|zonedata)\b",
    ),
    Program(
        "FANUC",
        r"^\s*P\[\d+.*\]\s*\{",
        r"P\[\d+[^\]]*\]\s*\{[^}]*?\bX\s*=\s*({n})\s*mm\s*,\s*Y\s*=\s*({n})\s*mm\s*,\s*Z\s*=\s*({n})\s*mm\s*,\s*"
        r"W\s*=\s*({n})\s*deg\s*,\s*P\s*=\s*({n})\s*deg\s*,\s*R\s*=\s*({n})\s*deg".replace("{n}", _N),
        (*_MM, *_ANGLES),
        _FIXED,
        r"P\[\d+[^\]]*\]\s*\{[^}]*?"
        + r"\s*deg\s*,\s*".join(rf"\bJ{k}\s*=\s*(?P<J{k}>{_N})" for k in range(1, 7))
        + r"\s*deg",
    ),
    Program("Yaskawa", r"^///(?:POSTYPE|RECTAN|PULSE)\b", rf"^[BC]?[CP]X?\d+\s*={_SIX}\s*$", (*_MM, *_ANGLES), _FIXED),
    Program("Staubli", r"<Data\b[^>]*\btype=\"(?:pointRx|point|jointRx|joint|trsf)\"", "", (*_MM, *_ANGLES), _ROTATED),
    Program(
        "Doosan",
        r"\bpos[xj]\s*\(",
        rf"\bposx\s*\(\s*\[?{_SIX}",
        (*_MM, *_ANGLES),
        "ZYZ",
        rf"\bposj\s*\(\s*\[?{_JOINTS}",
    ),
    Program(
        "Mecademic",
        r"\b(?:Move|Set)\w+\s*\(",
        rf"\b(?:MovePose|MoveLin|MoveLinRelWrf|MoveJump)\s*\({_SIX}\s*\)",
        (*_MM, *_ANGLES),
        _ROTATED,
        rf"\bMoveJoints\s*\({_JOINTS}\s*\)",
        r"\bSet[TW]rf\b",
    ),
    Program(
        "DENSO",
        r"(?:^|[^\w])P\d*\s*=?\s*P?\s*\(",
        rf"(?:^|[^\w])P\s*\({_SIX}(?:\s*,\s*[-+\d]+)?\s*\)",
        (*_MM, *_ANGLES),
        _FIXED,
        rf"(?:^|[^\w])J\s*\({_JOINTS}\s*\)",
    ),
    Program(
        "Kawasaki",
        r"^\s*\.(?:TRANS|JOINTS)\b|\bTRANS\s*\(",
        rf"(?:^[ \t]*[A-Za-z]\w*(?:\[\d+\])?[ \t]+|\bTRANS\s*\(\s*)({_N})" + rf"{_OR_BLANK}({_N})" * 5,
        (*_MM, *_ANGLES),
        "ZYZ",
        rf"^[ \t]*#[A-Za-z]\w*(?:\[\d+\])?[ \t]+({_N}(?:{_OR_BLANK}{_N}){{5,6}})",
    ),
    Program(
        "Mitsubishi",
        r"^\s*(?:\d+\s+)?[PJ]\w*\s*=\s*\(",
        rf"^\s*(?:\d+\s+)?P\w*\s*=\s*\({_SIX}(?:\s*,\s*{_N}){{0,2}}\s*\)\s*\(\s*\d+\s*,\s*-?\d+\s*\)",
        (*_MM, *_ANGLES),
        _FIXED,
        rf"^\s*(?:\d+\s+)?J\w*\s*=\s*\({_SIX_JOINTS}(?:\s*,\s*{_N}){{0,2}}\s*\)",
    ),
    Program(
        "Epson",
        r"\bXY\s*\(|^\s*rX\s*=|\b(?:JA|AglToPls)\s*\(",
        rf"(?:\bXY\s*\(\s*|\brX\s*=\s*)({_N}){_SPEL}",
        (*_MM, *_ANGLES[::-1]),
        _FIXED,
        rf"\b(?:JA|AglToPls)\s*\({_SIX_JOINTS}\s*\)",
    ),
    Program(
        "Techman",
        r"\b(?:PTP|Line)\s*\(\s*\"(?:CPP|CAP|CAR|JPP)\"",
        rf"\b(?:PTP|Line)\s*\(\s*\"C(?:PP|AP|AR)\"\s*,\s*\{{?{_SIX}",
        (*_MM, *_ANGLES),
        _FIXED,
        rf"\bPTP\s*\(\s*\"JPP\"\s*,\s*\{{?{_SIX_JOINTS}",
    ),
    Program(
        "xArm",
        r"\bset_(?:position|servo_angle)\s*\(",
        r"\bset_position\s*\((?:\s*\*?\[\s*)?(?:x\s*=)?\s*({n})\s*,\s*(?:y\s*=)?\s*({n})\s*,\s*(?:z\s*=)?\s*({n})\s*,\s*"
        r"(?:roll\s*=)?\s*({n})\s*,\s*(?:pitch\s*=)?\s*({n})\s*,\s*(?:yaw\s*=)?\s*({n})".replace("{n}", _N),
        (*_MM, *_ANGLES),
        _FIXED,
        rf"\bset_servo_angle\s*\([^\[]*\[{_JOINTS}\s*\]",
    ),
)
_UR = re.compile(r"\bp\[([^\[\]]*,[^\[\]]*)\]")
#: What a line of a program of Universal Robots may be beside one with a pose.
_UR_BESIDE = re.compile(r"[#=()]|^\s*(?:def|end|while|if|else|elif|loop|halt)\b")
#: A point or the axes in KUKA's language: {X 1.5,Y 2, ..}, with or without the name of its type.
_KRL = re.compile(r"\{\s*(?:\w+\s*:\s*)?([A-Z]\w*\s+[-+.\deE]+(?:\s*,\s*[A-Z]\w*\s+[-+.\deE]+)*)\s*\}")
#: What of it is read: a point, mm and degrees, or its axes.
_KRL_KEYS = (("X", "Y", "Z", "A", "B", "C"), ("A1", "A2", "A3", "A4", "A5", "A6"))
#: What only points have; motions between them have other names ({VEL 100.0,ACC 100.0}).
_OF_A_POINT = {"X", "Y", "Z", *_KRL_KEYS[1]}
#: Frames and tools in KUKA's language have the form of points.
_KRL_BESIDE = re.compile(r"^\s*(?:DECL\s+)?(?:GLOBAL\s+)?(?:FRAME\b.*)?\$|\b(?:BASE|TOOL)_DATA\b", re.IGNORECASE)


class ProgramPoints(NamedTuple):
    """The points of a program: names of columns, rows with their lines, the convention and what was passed over."""

    head: list[str]
    rows: list[tuple[int, list[str]]]
    rotation: str | None
    notes: tuple[str, ...]


def program_rows(path: Path, text: str) -> ProgramPoints | None:
    """Return the poses or joints of a robot's program; None where the text is none.

    Raises:
        InputError: a point that lacks a number, poses and joints in one file, or pulses.
    """
    written = [(line, row.strip()) for line, row in enumerate(text.splitlines(), 1)]
    written = [(line, row) for line, row in written if row and not row.startswith("#")]
    if any(_UR.search(row) for _, row in written):
        return ProgramPoints(["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"], _poses_of_ur(path, written), None, ())
    if any(_points_in(row) for _, row in written):
        return _points_of_krl(path, written)
    for program in PROGRAMS:
        if re.search(program.mark or program.pose, text, re.MULTILINE) and (found := _points(path, text, program)):
            return found
    return None


def _points(path: Path, text: str, program: Program) -> ProgramPoints | None:
    """Return the points of one maker's program; None where it has none."""
    if program.maker == "Staubli":
        return _points_of_staubli(path, text)
    kept = text if program.beside is None else re.sub(rf"(?m)^.*{program.beside}.*$", "", text)
    notes: tuple[str, ...] = () if kept == text else (f"{path}: frames and tools are passed over",)
    if program.maker == "Yaskawa":
        kept, left_out = _rectangular(path, kept)
        notes += left_out
    poses = list(re.finditer(program.pose, kept, re.MULTILINE))
    joints = [] if program.joints is None else list(re.finditer(program.joints, kept, re.MULTILINE))
    joints = [one for one in joints if not any(one.start() == pose.start() for pose in poses)]
    if poses and joints:
        kinds = [
            f"{len(found)} {what} (line {_line(text, found[0])})"
            for found, what in ((poses, "poses"), (joints, "joints"))
        ]
        raise InputError(f"{path}: {program.maker}'s program holds {' and '.join(kinds)}: keep one kind in a file")
    if program.maker == "FANUC":
        _require_one_frame(path, kept)
    if joints:
        cells = [re.split(r"[\s,]+", one[1].strip()) if one.re.groups == 1 else list(one.groups()) for one in joints]
        head = [f"q{k}_deg" for k in range(1, len(cells[0]) + 1)]
        rows = [(_line(text, one), [cell.strip() for cell in row]) for one, row in zip(joints, cells, strict=True)]
        return ProgramPoints(head, rows, None, notes)
    return _poses_of(path, program, [(_line(text, one), list(one.groups())) for one in poses], notes)


def _poses_of(
    path: Path, program: Program, rows: list[tuple[int, list[str]]], notes: tuple[str, ...]
) -> ProgramPoints | None:
    """Return the poses of a program, by their lines; None where there are none."""
    if not rows:
        return None
    how = f"degrees, {program.rotation}" if program.rotation else "quaternions"
    said = f"{path}: {len(rows)} points read as {program.maker}'s: mm, {how}"
    if program.rotation == "ZYZ":  # not among the conventions of three axes
        angles = np.array([row[3:] for _, row in rows], float)
        x, y, z, w = Rotation.from_euler("ZYZ", angles, degrees=True).as_quat().T
        rows = [
            (line, [*row[:3], *map(repr, map(float, quaternion))])
            for (line, row), quaternion in zip(rows, np.stack([w, x, y, z], axis=1), strict=True)
        ]
        return ProgramPoints([*_MM, "qw", "qx", "qy", "qz"], rows, None, (*notes, said))
    return ProgramPoints(list(program.names), rows, program.rotation or None, (*notes, said))


def _line(text: str, found: re.Match[str]) -> int:
    """Return the line that a match begins in."""
    return text.count("\n", 0, found.start() + len(found[0]) - len(found[0].lstrip())) + 1


def _require_one_frame(path: Path, text: str) -> None:
    """Raise an InputError where points of FANUC's are of several tools or frames: their poses do not belong together."""
    frames = dict.fromkeys(re.findall(r"\bUF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)", text))
    if len(frames) > 1:
        named = ", ".join(f"UF {uf}, UT {ut}" for uf, ut in frames)
        raise InputError(f"{path}: its points are of several frames or tools ({named}): keep those of one in a file")


def _rectangular(path: Path, text: str) -> tuple[str, tuple[str, ...]]:
    """Return Yaskawa's positions in mm and degrees, without those in pulses.

    Raises:
        InputError: all are in pulses, which only the controller's own ratios make degrees.
    """
    kept, pulses, rectangular = [], 0, True
    for row in text.splitlines():
        if mark := re.match(r"///(RECTAN|PULSE|POSTYPE\s+(\w+))", row):
            rectangular = "PULSE" not in mark[1]
        point = bool(re.match(r"[BC]?[CP]X?\d+\s*=", row))
        pulses += point and not rectangular
        kept.append("" if point and not rectangular else row)
    kept_text = "\n".join(kept)
    if not pulses:
        return kept_text, ()
    if not re.search(r"(?m)^[BC]?[CP]X?\d+\s*=", kept_text):
        raise InputError(
            f"{path}: its {pulses} positions are pulses of the motors' encoders (///PULSE); expected mm and degrees "
            "(///RECTAN): convert the job to a relative one (BASE or ROBOT) on the controller, or write joints in degrees"
        )
    return kept_text, (f"{path}: {pulses} positions in pulses (///PULSE) are left out",)


def _points_of_staubli(path: Path, text: str) -> ProgramPoints | None:
    """Return the points or joints of a VAL3 data file; what an element leaves out is zero."""
    rows: dict[str, list[tuple[int, list[str]]]] = {"point": [], "joint": []}
    fathers: dict[str, None] = {}
    for data in re.finditer(
        r"<Data\b[^>]*\btype=\"(pointRx|point|jointRx|joint)\"[^>]*(?<!/)>(.*?)</Data>", text, re.DOTALL
    ):
        kind = "point" if "point" in data[1] else "joint"
        keys = ("x", "y", "z", "rx", "ry", "rz") if kind == "point" else tuple(f"j{k}" for k in range(1, 7))
        for value in re.finditer(r"<Value\b([^>]*)/?>", data[2]):
            given = dict(re.findall(r"(\w+)=\"([^\"]*)\"", value[1]))
            fathers[given.get("fatherId", "world[0]")] = None
            line = text.count("\n", 0, data.start(2) + value.start()) + 1
            rows[kind].append((line, [given.get(key, "0") for key in keys]))
    if rows["point"] and rows["joint"]:
        raise InputError(f"{path}: holds points and joints: keep one kind in a file")
    if rows["joint"]:
        return ProgramPoints([f"q{k}_deg" for k in range(1, 7)], rows["joint"], None, ())
    if not rows["point"]:
        return None
    if len(fathers) > 1:
        raise InputError(
            f"{path}: its points are of several frames ({', '.join(fathers)}): keep those of one in a file"
        )
    said = f"{path}: {len(rows['point'])} points read as Staubli's: mm, degrees, {_ROTATED}"
    return ProgramPoints([*_MM, *_ANGLES], rows["point"], _ROTATED, (said,))


def _poses_of_ur(path: Path, written: list[tuple[int, str]]) -> list[tuple[int, list[str]]]:
    """Return the numbers of the one p[...] of each line that has any."""
    rows = []
    for line, row in written:
        found = _UR.findall(row)
        if len(found) > 1 or (not found and not _UR_BESIDE.search(row)):
            raise InputError(f"{path}: line {line}: expected one p[x, y, z, rx, ry, rz], found {row[:40]!r}")
        rows += [(line, [cell.strip() for cell in one.split(",")]) for one in found]
    return rows


def _points_in(row: str) -> list[dict[str, str]]:
    """Return the numbers of the points of a line in KUKA's language by their names, without other structures (speeds)."""
    if _KRL_BESIDE.search(row):
        return []
    found = (dict(part.split() for part in re.split(r"\s*,\s*", one)) for one in _KRL.findall(row))
    return [point for point in found if _OF_A_POINT & set(point)]


def _points_of_krl(path: Path, written: list[tuple[int, str]]) -> ProgramPoints:
    """Return the points of a text in KUKA's language; other lines are passed over."""
    rows = []
    for line, row in written:
        found = _points_in(row)
        if len(found) > 1:
            raise InputError(f"{path}: line {line}: has {len(found)} points; one a line is needed")
        rows += [(line, point) for point in found]
    keys = next((keys for keys in _KRL_KEYS if set(keys) <= set(rows[0][1])), None)
    if keys is None:
        raise InputError(f"{path}: line {rows[0][0]}: a point needs X, Y, Z, A, B, C, and axes A1 to A6")
    for line, point in rows:
        if missing := [key for key in keys if key not in point]:
            raise InputError(f"{path}: line {line}: {missing[0]} is missing, which line {rows[0][0]} has")
    head = [f"q{key[1]}_deg" for key in keys] if keys[0] == "A1" else list(keys)
    return ProgramPoints(head, [(line, [point[key] for key in keys]) for line, point in rows], None, ())
