"""Poses and joints in the languages of robots' controllers.

In: the text of a program or of its data. Out: names of columns and rows, mm and degrees as the maker writes them. A table
of patterns, one a maker; each says in which unit and convention its numbers are, by its maker's manual. Two have a reader
of their own: Universal Robots ``p[x, y, z, rx, ry, rz]``, m and rad, a rotation vector; and KUKA ``{X 1,Y 2,Z 3,A 4,B 5,C
6}`` (.dat, .src), mm, deg, about z, y' and x'', axes ``{A1 1,..,A6 6}``.
"""

from __future__ import annotations

import functools
import re
from bisect import bisect_left
from pathlib import Path
from typing import NamedTuple

from armsight.errors import InputError
from armsight.tables.lengths import NUMBER

_MM, _ANGLES, _QUATERNION = ("x_mm", "y_mm", "z_mm"), ("rx_deg", "ry_deg", "rz_deg"), ("qw", "qx", "qy", "qz")
_ROTATED, _FIXED = "XYZ", "xyz"
#: What stands for a part in the patterns below: a number, a captured one, a comma, six numbers between commas, joints as
#: one group (six, or four to seven); Kawasaki's comma; the names before Epson's second number and on.
_PARTS = {
    "<epson>": "".join(rf"(?:<,>|\s*r{name}\s*=\s*)<n>" for name in "YZUVW"),
    "<6>": r"\s*<n>" + r"<,><n>" * 5,
    "<joints6>": r"\s*(<N>(?:<,><N>){5})",
    "<joints>": r"\s*(<N>(?:<,><N>){3,6})",
    "<or blank>": r"(?:[ \t]*,[ \t]*|[ \t]+)",
    "<n>": "(<N>)",
    "<,>": r"\s*,\s*",
    "<N>": NUMBER,
}


def _pattern(text: str) -> str:
    for part, pattern in _PARTS.items():
        text = text.replace(part, pattern)
    return text


class Program(NamedTuple):
    """A maker's way to write poses, mm and degrees."""

    maker: str  #: its name
    rotation: str  #: the convention of its angles; "" for quaternions
    mark: str  #: what shows that a text is of this maker
    pose: str  #: a pattern with its numbers as groups, in the order of ``names``
    joints: str | None = None  #: a pattern of joints, degrees, one group with commas, or named groups
    names: tuple[str, ...] = (*_MM, *_ANGLES)  #: of the numbers of a pose


PROGRAMS = (
    Program(  # RAPID: [[x,y,z],[q1,q2,q3,q4],..], w first; jointtarget
        "ABB",
        "",
        r"\brobtarget\b|\bjointtarget\b|\bMove[LJ]\b|^\s*MODULE\b|^\s*\[\s*\[[^\[\]]*\]\s*,\s*\[[^\[\]]*\]\s*,\s*\[",
        r"\[\s*\[\s*<n><,><n><,><n>\s*\]<,>\[\s*<n><,><n><,><n><,><n>\s*\]<,>\[",
        r"\[\s*\[<joints>\s*\]<,>\[",
        (*_MM, *_QUATERNION),
    ),
    Program(  # .LS: P[1]{.. X = 1 mm, .. R = 6 deg}
        "FANUC",
        _FIXED,
        r"^\s*P\[\d+.*\]\s*\{",
        r"P\[\d+[^\]]*\]\s*\{[^}]*?\bX\s*=\s*<n>\s*mm<,>Y\s*=\s*<n>\s*mm<,>Z\s*=\s*<n>\s*mm<,>"
        r"W\s*=\s*<n>\s*deg<,>P\s*=\s*<n>\s*deg<,>R\s*=\s*<n>\s*deg",
        r"P\[\d+[^\]]*\]\s*\{[^}]*?"
        + r"\s*deg<,>".join(rf"\bJ{k}\s*=\s*(?P<J{k}><N>)" for k in range(1, 7))
        + r"\s*deg",
    ),
    # .JBI, ///RECTAN: C00000=x,..
    Program("Yaskawa", _FIXED, r"^///(?:POSTYPE|RECTAN|PULSE)\b", r"^[BC]?[CP]X?\d+\s*=<6>\s*$"),
    # .dtx: <Value x= .. rz= />
    Program("Staubli", _ROTATED, r"<Data\b[^>]*\btype=\"(?:pointRx|point|jointRx|joint|trsf)\"", ""),
    Program("Doosan", "ZYZ", r"\bpos[xj]\s*\(", r"\bposx\s*\(\s*\[?<6>", r"\bposj\s*\(\s*\[?<joints>"),
    Program(
        "Mecademic",
        _ROTATED,
        r"\b(?:Move|Set)\w+\s*\(",
        r"\b(?:MovePose|MoveLin)\s*\(<6>\s*\)",
        r"\bMoveJoints\s*\(<joints>\s*\)",
    ),
    Program(  # P(x, .., rz, fig)
        "DENSO",
        _FIXED,
        r"(?:^|[^\w])P\d*\s*=?\s*P?\s*\(",
        r"(?:^|[^\w])P\s*\(<6>(?:\s*,\s*[-+\d]+)?\s*\)",
        r"(?:^|[^\w])J\s*\(<joints>\s*\)",
    ),
    Program(  # .TRANS, and TRANS(x,y,z,o,a,t)
        "Kawasaki",
        "ZYZ",
        r"^\s*\.(?:TRANS|JOINTS)\b|\bTRANS\s*\(",
        r"(?:^[ \t]*[A-Za-z]\w*(?:\[\d+\])?[ \t]+|\bTRANS\s*\(\s*)<n>" + "<or blank><n>" * 5,
        r"^[ \t]*#[A-Za-z]\w*(?:\[\d+\])?[ \t]+(<N>(?:<or blank><N>){5,6})",
    ),
    Program(  # P1=(x,..,c)(7,0)
        "Mitsubishi",
        _FIXED,
        r"^\s*(?:\d+\s+)?[PJ]\w*\s*=\s*\(",
        r"^\s*(?:\d+\s+)?P\w*\s*=\s*\(<6>(?:<,><N>){0,2}\s*\)\s*\(\s*\d+\s*,\s*-?\d+\s*\)",
        r"^\s*(?:\d+\s+)?J\w*\s*=\s*\(<joints6>(?:<,><N>){0,2}\s*\)",
    ),
    Program(  # XY(x, y, z, u, v, w), and .pts: U, V, W about the fixed z, y and x
        "Epson",
        _FIXED,
        r"\bXY\s*\(|^\s*rX\s*=|\b(?:JA|AglToPls)\s*\(",
        r"(?:\bXY\s*\(\s*|\brX\s*=\s*)<n><epson>",
        r"\b(?:JA|AglToPls)\s*\(<joints6>\s*\)",
        (*_MM, *_ANGLES[::-1]),
    ),
    Program(  # PTP("CPP",x,..,rz,..)
        "Techman",
        _FIXED,
        r"\b(?:PTP|Line)\s*\(\s*\"(?:CPP|CAP|CAR|JPP)\"",
        r"\b(?:PTP|Line)\s*\(\s*\"C(?:PP|AP|AR)\"\s*,\s*\{?<6>",
        r"\bPTP\s*\(\s*\"JPP\"\s*,\s*\{?<joints6>",
    ),
    Program(  # set_position(x=.., yaw=..)
        "xArm",
        _FIXED,
        r"\bset_(?:position|servo_angle)\s*\(",
        r"\bset_position\s*\(\s*(?:\*?\[\s*)?"
        + "<,>".join(rf"(?:{name}\s*=)?\s*<n>" for name in ("x", "y", "z", "roll", "pitch", "yaw")),
        r"\bset_servo_angle\s*\([^\[]*\[<joints>\s*\]",
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
#: Comments. A # before a name and a number is Kawasaki's joint, // before capitals Yaskawa's section.
_COMMENT = re.compile(
    r"(?<![^\s;,)\]}])#(?![A-Za-z]\w*(?:\[\d+\])?[ \t]+[-+.\d]).*|^[ \t]*;.*|(?:^|;)[ \t]*(?:\d+:[ \t]*)?!(?!=).*|"
    r"(?<![:/])//(?!/?[A-Z]{3,}\b).*",
    re.MULTILINE,
)
#: A comment that is the pose of the joints before it, in a file whose code has none.
_NOTED = re.compile(r"#\s*p\[[^\]]*\]\s*$")
#: A comment after the one ' of a line; strings have two.
_APOSTROPHE = re.compile(r"^([^'\"\n]*)'[^'\n]*$", re.MULTILINE)
#: Where a semicolon begins a comment, too: KUKA's and Kawasaki's.
_SEMICOLON = re.compile(rf"{_KRL.pattern}|^\s*\.(?:PROGRAM|TRANS|JOINTS)\b", re.MULTILINE)
#: What stands in the parentheses of a call, with two more within each other.
_ARGUMENTS = r"(?:[^()]|\((?:[^()]|\([^()]*\))*\))*"
_CALL = re.compile(rf"\w+\s*\({_ARGUMENTS}\)")
#: Tools, frames, loads and speeds, whose numbers have the form of points.
_BESIDE = re.compile(
    rf"\b(?:Set[TW]rf|set_tcp)\s*\({_ARGUMENTS}\)|\b(?:tool|wobj|load|speed|zone)data\b[^;\n]*|"
    r"^.*\b(?:BASE|TOOL)_DATA\b.*$|^[ \t]*(?:DECL\s+)?(?:GLOBAL\s+)?(?:FRAME\b.*)?\$.*$",
    re.MULTILINE | re.IGNORECASE,
)
#: What moves by numbers from where the arm is, or gives a pose in that of another one.
_RELATIVE = re.compile(
    r"\bMove(?:LinRel[TW]rf|JointsRel)\s*\(|\b\w+_REL\s*\{|\bDR_MV_MOD_REL\b|\brelative\s*=\s*True\b|"
    rf"\bpose_(?:trans|add|sub)\s*\({_ARGUMENTS}?\bp\[|\b(?:trans|addto)\s*\({_ARGUMENTS}?\bpos[xj]\s*\(|"
    rf"\ba?move[a-z]{{1,2}}\s*\({_ARGUMENTS}?,\s*(?:mod\s*=\s*1|ref\s*=\s*(?:1|DR_TOOL))\b|"
    r"\b(?:RelTool|Offs)\s*\(\s*\[\s*\[|\bP\[\d+.*\bINC\b|\bset_tool_position\s*\(",
    re.IGNORECASE,
)
#: Operators between poses, by maker: P1:{X 5,..}; p1+TRANS(..); P1 +X(5); P1*P2.
_COMPOSED = {
    "KUKA": r"\b\w{1,32}[ \t]*:[ \t]*\{[ \t]*(?:\w+[ \t]*:[ \t]*)?[XYZABC][ \t]+[-+.\d]|\}[ \t]*:[ \t]*[\w{]",
    "Kawasaki": r"[+*][ \t]*TRANS\s*\(|\bTRANS\s*\([^()]*\)[ \t]*[+*]|\b[A-Z]MOVE[ \t]+\w+[ \t]*\+",
    "Epson": r"\b(?:P\d+|Here)[ \t]*[+-][ \t]*(?:XY|[XYZUVW])\s*\(|\b(?:Go|Move|Jump)\b[^'\n]*?[+-][ \t]*[XYZUVW]\s*\(",
    "Mitsubishi": r"\bP\d+[ \t]*\*[ \t]*P\d+\b",
}


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
    code = _COMMENT.sub("", text)
    if not _UR.search(code):
        code = _COMMENT.sub(lambda found: found[0] if _NOTED.match(found[0]) else "", text)
    code = _APOSTROPHE.sub(r"\1", code)
    if _SEMICOLON.search(code):
        code = re.sub(";.*", "", code)
    kept = _BESIDE.sub(lambda beside: "\n" * beside[0].count("\n"), code)
    if relative := _relative(kept):
        raise InputError(
            f"{path}: line {_line(kept, relative)}: {' '.join(relative[0].split())!r} is a motion or pose relative to "
            "another one, not to the base: write the pose it ends at, or delete the line if no image was taken there"
        )
    found = _program_points(path, kept)
    passed = (f"{path}: tools, frames and loads are passed over",)
    return found if found is None or kept == code else found._replace(notes=(*passed, *found.notes))


def _relative(text: str) -> re.Match[str] | None:
    """Return the first relative motion or composed pose of a robot's program; None where there is none."""
    makers = [program.maker for program in PROGRAMS if re.search(program.mark, text, re.MULTILINE)]
    if _points_in(text):
        makers = ["KUKA"]
    elif _UR.search(text):
        makers = ["Universal Robots"]
    for pattern in (_RELATIVE.pattern, *(_COMPOSED[maker] for maker in makers if maker in _COMPOSED)):
        if makers and (found := re.search(pattern, text, re.IGNORECASE)):
            return found
    return None


def _program_points(path: Path, text: str) -> ProgramPoints | None:
    """Return the points of a program without its comments, tools and frames."""
    written = [(line, row.strip()) for line, row in enumerate(text.splitlines(), 1) if row.strip()]
    if any(_UR.search(row) for _, row in written):
        return ProgramPoints(["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"], _poses_of_ur(path, written), None, ())
    if any(_points_in(row) for _, row in written):
        return _points_of_krl(path, written)
    for program in PROGRAMS:
        if re.search(program.mark, text, re.MULTILINE) and (found := _points(path, text, program)):
            return found
    return None


def _points(path: Path, text: str, program: Program) -> ProgramPoints | None:
    """Return the points of one maker's program; None where it has none."""
    if program.maker == "Staubli":
        return _points_of_staubli(path, text)
    notes: tuple[str, ...] = ()
    if program.maker == "Yaskawa":
        text, notes = _rectangular(path, text)
    poses, joints = (
        [] if each is None else list(re.finditer(_pattern(each), text, re.MULTILINE))
        for each in (program.pose, program.joints)
    )
    joints = [one for one in joints if not any(one.start() == pose.start() for pose in poses)]
    if poses and joints:
        raise InputError(
            f"{path}: {program.maker}'s program holds {len(poses)} poses (line {_line(text, poses[0])}) and {len(joints)} "
            f"joints (line {_line(text, joints[0])}): keep one kind in a file"
        )
    frames = dict.fromkeys(re.findall(r"\bUF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)", text))
    if len(frames) > 1:  # FANUC's; their poses do not belong together
        named = ", ".join(f"UF {uf}, UT {ut}" for uf, ut in frames)
        raise InputError(f"{path}: its points are of several frames or tools ({named}): keep those of one in a file")
    if not poses and not joints:
        return None
    unit = _unit(path, text, joints or poses)
    if joints:
        return _joint_points(text, joints, unit, notes)
    return _pose_points(path, text, program, poses, unit, notes)


def _unit(path: Path, text: str, points: list[re.Match[str]]) -> str:
    """Return "deg", or "rad" where all motions of an xArm say is_radian=True, or the arm itself and none of them False."""
    arm = re.search(r"\bXArmAPI\s*\([^)]*\bis_radian\s*=\s*True|\bdefault_is_radian\s*=\s*True", text) is not None
    calls = (_CALL.match(text, point.start()) for point in points)
    said = (re.search(r"\bis_radian\s*=\s*(True|False)", call[0]) if call else None for call in calls)
    radian = {one[1] == "True" if one else arm for one in said}
    if len(radian) > 1:
        raise InputError(f"{path}: is_radian=True stands at some of its {len(points)} points: write it at all or none")
    return "rad" if True in radian else "deg"


def _joint_points(text: str, joints: list[re.Match[str]], unit: str, notes: tuple[str, ...]) -> ProgramPoints:
    """Return joints: of each one group with commas, or one a joint."""
    cells = [re.split(r"[\s,]+", one[1].strip()) if one.re.groups == 1 else list(one.groups()) for one in joints]
    rows = [(_line(text, one), [cell.strip() for cell in row]) for one, row in zip(joints, cells, strict=True)]
    return ProgramPoints([f"q{k}_{unit}" for k in range(1, len(cells[0]) + 1)], rows, None, notes)


def _pose_points(
    path: Path, text: str, program: Program, poses: list[re.Match[str]], unit: str, notes: tuple[str, ...]
) -> ProgramPoints:
    """Return poses, mm and angles or quaternions."""
    rows = [(_line(text, one), list(one.groups())) for one in poses]
    angles_in = "degrees" if unit == "deg" else "radians"
    how = f"{angles_in}, {program.rotation}" if program.rotation else "quaternions"
    said = f"{path}: {len(rows)} points read as {program.maker}'s: mm, {how}"
    names = [name.replace("_deg", f"_{unit}") for name in program.names]
    return ProgramPoints(names, rows, program.rotation or None, (*notes, said))


def _line(text: str, found: re.Match[str]) -> int:
    return bisect_left(_line_ends(text), found.start() + len(found[0]) - len(found[0].lstrip())) + 1


@functools.lru_cache(maxsize=2)
def _line_ends(text: str) -> list[int]:
    return [end.start() for end in re.finditer("\n", text)]


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
    """Return the numbers of the points of a line in KUKA's language by their names; other structures (speeds) have none."""
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
