"""What people get wrong, typed: 150 wrong inputs, each with the words of its right cause.

In: nothing. Out: how many are named for what they are, which are not and what is said of them, and how many are silent.
Run: ``python benchmarks/wrong_inputs.py``; minutes, as each is tried by the closed form of hand-eye.
"""

import json
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.handeye.recording import paired, seen_in_table
from armsight.loop.identify.misread import require_plausible
from armsight.robot.arm_file import open_arm
from armsight.robot.calibration_file import read_calibration
from armsight.robot.models import MODELS
from armsight.robot.urdf.write import urdf_text
from armsight.tables.poses import read_pose_table

N = 16
SIX = open_arm("six_r")
_RNG = np.random.default_rng(11)
Q = SIX.home + _RNG.uniform(-0.6, 0.6, (N, 6))
A = SIX.forward(Q)
X, Z = exp_se3(np.array([0.03, -0.02, 0.08, 0.2, -0.1, 1.2])), exp_se3(np.array([0.5, 0.1, 0.4, 2.0, 0.3, -0.4]))
B = inverse(A @ X) @ Z @ exp_se3(_RNG.normal(0, [2e-4] * 3 + [5e-4] * 3, (N, 6)))
QUATERNION = "x_m,y_m,z_m,qw,qx,qy,qz"
EULER = "x_m,y_m,z_m,rx_deg,ry_deg,rz_deg"
JOINTS = ",".join(f"q{k}_deg" for k in range(1, 7))


def rotations_as(T, convention):
    """The numbers of rotations in a convention; angles in degrees, vectors in radians."""
    R = Rotation.from_matrix(T[:, :3, :3])
    if convention in ("xyzw", "wxyz"):
        return R.as_quat()[:, [3, 0, 1, 2] if convention == "wxyz" else [0, 1, 2, 3]]
    if convention == "rotvec":
        return R.as_rotvec()
    angles = R.as_euler(convention, degrees=True)
    return angles[:, np.argsort(["xyz".index(axis) for axis in convention.lower()])]


def csv(head, *columns):
    return (
        "\n".join([*([head] if head else []), *(",".join(f"{v:.9g}" for v in row) for row in np.hstack(columns))])
        + "\n"
    )


def poses(T, convention="wxyz", by=1.0, head=None):
    """A table of poses, positions multiplied."""
    return csv(head, by * T[:, :3, 3], rotations_as(T, convention))


def quaternions(T, by=1.0, head=QUATERNION):
    return poses(T, "wxyz", by, head)


def wrong(robot=None, said="", *, seen=None, name="robot.csv", in_hand=True, arm=None, by=None, **options):
    """One wrong input: the tables, their options, and the words of the right cause."""
    return {
        "robot": quaternions(A) if robot is None else robot,
        "seen": quaternions(B) if seen is None else seen,
        "name": name,
        "in_hand": in_hand,
        "arm": arm,
        "options": options,
        "seen_options": by or {},
        "said": said,
    }


def transposed(T):
    out = T.copy()
    out[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    return out


def moved(T, columns, signs=(1, 1, 1)):
    out = T.copy()
    out[:, :3, 3] = T[:, columns, 3] * signs
    return out


def cut(text, line, to):
    lines = text.splitlines()
    lines[line - 1] = to(lines[line - 1])
    return "\n".join(lines) + "\n"


ORDER, FIRST = "the rotation comes before the position", "--columns seen:rx,ry,rz,x,y,z"
URDF = urdf_text(SIX)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
CASES = {}
# columns in another order
for convention in ("rotvec", "xyz", "ZYX", "XYZ"):
    first = csv("", rotations_as(A, convention), A[:, :3, 3])
    seen_first = csv("", rotations_as(B, convention), B[:, :3, 3])
    CASES[f"{convention} before position"] = wrong(first, ORDER, rotation=convention)
    CASES[f"{convention} before position, seen"] = wrong(None, FIRST, seen=seen_first, by={"rotation": convention})
    CASES[f"{convention} before position, both"] = wrong(
        first, ORDER, rotation=convention, seen=seen_first, by={"rotation": convention}
    )
for order in ("xyzw", "wxyz"):
    CASES[f"{order} before position"] = wrong(csv("", rotations_as(A, order), A[:, :3, 3]), ORDER, rotation=order)
    CASES[f"{order} before position, seen"] = wrong(
        None, ORDER, seen=csv("", rotations_as(B, order), B[:, :3, 3]), by={"rotation": order}
    )
for columns in ((1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0)):
    axes = ", ".join("xyz"[k] for k in np.argsort(columns))
    CASES[f"positions as {axes}"] = wrong(quaternions(moved(A, columns)), f"positions fit as {axes}")
for signs in ((-1, 1, 1), (1, -1, 1), (1, 1, -1)):
    axes = ", ".join(("-" if s < 0 else "") + "xyz"[k] for k, s in enumerate(signs))
    CASES[f"positions as {axes}"] = wrong(quaternions(moved(A, (0, 1, 2), signs)), f"positions fit as {axes}")
# units of lengths
for length, by in (("millimetres", 1e3), ("cm", 1e2), ("in", 1 / 0.0254)):
    CASES[f"{length} taken for metres"] = wrong(quaternions(A, by), "millimetres" if by == 1e3 else f"or in .*{length}")
    CASES[f"{length} taken for metres, seen"] = wrong(
        None, "millimetres" if by == 1e3 else f"or in .*{length}", seen=quaternions(B, by)
    )
CASES["metres taken for mm"] = wrong(quaternions(A, head=QUATERNION.replace("_m", "_mm")), "are they metres")
CASES["metres taken for mm, seen"] = wrong(
    None, "are they metres", seen=quaternions(B, head=QUATERNION.replace("_m", "_mm"))
)
CASES["mm without a unit"] = wrong(quaternions(A, 1e3, "x,y,z,qw,qx,qy,qz"), "units=mm")
CASES["mm without names"] = wrong(poses(A, "wxyz", 1e3), "units=mm", rotation="wxyz")
mixed = A.copy()
mixed[5:9, :3, 3] *= 1e3
CASES["some rows in mm"] = wrong(quaternions(mixed), "are some rows in millimetres")
CASES["a target of half its size"] = wrong(
    None, "2 times as large as given", seen=quaternions(moved(B, (0, 1, 2), (0.5,) * 3))
)
# units of angles
CASES["degrees as rx_rad"] = wrong(
    poses(A, "xyz", 1.0, EULER.replace("deg", "rad")), "are these degrees", rotation="xyz"
)
CASES["radians as rx_deg"] = wrong(
    csv(EULER, A[:, :3, 3], np.radians(rotations_as(A, "xyz"))),
    "the rotations are in radians, not degrees",
    rotation="xyz",
)
CASES["rotation vector in degrees as rad"] = wrong(
    csv(EULER.replace("deg", "rad"), A[:, :3, 3], np.degrees(rotations_as(A, "rotvec"))), "are these degrees"
)
CASES["rotation vector in radians as deg"] = wrong(
    csv(EULER, A[:, :3, 3], rotations_as(A, "rotvec")), "the rotations are in radians, not degrees", rotation="rotvec"
)
CASES["p[] with degrees"] = wrong(
    "".join(
        f"p[{', '.join(f'{v:.7f}' for v in row)}]\n"
        for row in np.hstack([A[:, :3, 3], np.degrees(rotations_as(A, "rotvec"))])
    ),
    "are these degrees",
)
# conventions
for true, given in (
    *(
        ("xyz", "XYZ"),
        ("xyz", "zyx"),
        ("XYZ", "xyz"),
        ("ZYX", "XYZ"),
        ("zyx", "xyz"),
        ("xyz", "rotvec"),
        ("yxz", "xyz"),
    ),
    *(("ZXY", "xyz"), ("XZY", "ZYX")),
):
    alike = {"xyz": "xyz|ZYX", "zyx": "zyx|XYZ", "XYZ": "zyx|XYZ", "ZYX": "xyz|ZYX", "yxz": "yxz|ZXY", "ZXY": "yxz|ZXY"}
    CASES[f"{true} given as {given}"] = wrong(
        poses(A, true, 1.0, EULER), f"the rotations are ({alike.get(true, 'yzx|XZY')}), not {given}", rotation=given
    )
CASES["rotvec given as xyz"] = wrong(
    csv(EULER, A[:, :3, 3], np.degrees(rotations_as(A, "rotvec"))), "the rotations are rotvec, not xyz", rotation="xyz"
)
for true, given in (("wxyz", "xyzw"), ("xyzw", "wxyz")):
    CASES[f"{true} given as {given}"] = wrong(poses(A, true), f"the rotations are {true}, not {given}", rotation=given)
    CASES[f"{true} given as {given}, seen"] = wrong(
        None,
        f"the rotations are {true}, not {given}: --columns seen:rotation",
        seen=poses(B, true),
        by={"rotation": given},
    )
CASES["quaternion columns exchanged"] = wrong(
    csv("x_m,y_m,z_m,qw,qx,qy,qz", A[:, :3, 3], rotations_as(A, "xyzw")), "the rotations are xyzw, not wxyz"
)
CASES["conjugate quaternions"] = wrong(quaternions(transposed(A)), "the rotations are inverse")
CASES["conjugate quaternions, seen"] = wrong(None, "the rotations are inverse", seen=quaternions(transposed(B)))
CASES["no convention of three angles"] = wrong(poses(A, "xyz", 1.0, EULER), "give --columns rotation=")
CASES["no convention of a quaternion"] = wrong(poses(A), "which of the four numbers of a quaternion is w")
CASES["an unknown convention"] = wrong(poses(A), "known are wxyz, xyzw, rotvec", rotation="rpy")
CASES["a quaternion convention for angles"] = wrong(
    poses(A, "xyz", 1.0, EULER), "give --columns rotation=", rotation="wxyz"
)
CASES["KUKA's angles as Fanuc's"] = wrong(
    csv("X,Y,Z,W,P,R", 1e3 * A[:, :3, 3], rotations_as(A, "ZYX")[:, ::-1]), "about x and z are exchanged|W about x"
)
# matrices
CASES["rotations transposed in matrices"] = wrong(csv("", transposed(A).reshape(N, 16)), "the rotations are inverse")
CASES["matrices that end otherwise"] = wrong(csv("", A.reshape(N, 16) + np.eye(16)[15]), "ends with 0 0 0 1")
CASES["a mirrored matrix"] = wrong(csv("", (A * np.array([1, -1, 1, 1])).reshape(N, 16)), "left-handed")
CASES["a matrix that is none"] = wrong(csv("", (A * 1.2)[:, :3].reshape(N, 12)), "no rotation")
CASES["four lines a matrix, cut"] = wrong(
    "\n".join(" ".join(map(str, row)) for row in A.reshape(-1, 4)[:-1]), "ends within a matrix"
)
other_end = A.copy()
other_end[3, 3, 3] = 2.0
CASES["four lines, the last otherwise"] = wrong(
    "\n".join(" ".join(map(str, row)) for row in other_end.reshape(-1, 4)), "line 16: expected 0 0 0 1"
)
# mountings, transforms, rows
CASES["to-hand given as in-hand"] = wrong(None, "fit --eye in-hand, not to-hand", in_hand=False)
CASES["inverse robot poses"] = wrong(quaternions(inverse(A)), "inverse transforms")
CASES["inverse target poses"] = wrong(None, "inverse transforms|fit --eye", seen=quaternions(inverse(B)))
CASES["rows shifted by one"] = wrong(quaternions(np.roll(A, 1, axis=0)), "shifted by 1")
CASES["rows shifted by two"] = wrong(quaternions(np.roll(A, -2, axis=0)), "shifted by 2")
CASES["rows in reverse"] = wrong(quaternions(A[::-1]), "reverse order")
CASES["one row too few"] = wrong(quaternions(A[:-1]), "15 robot poses, but 16")
CASES["tables exchanged"] = wrong(quaternions(B), "inverse transforms|fit --eye|exchanged", seen=quaternions(A))
CASES["a left-handed frame"] = wrong(quaternions(MIRROR @ A @ MIRROR), "left-handed frame: one axis is mirrored")
CASES["another motion"] = wrong(
    quaternions(SIX.forward(SIX.home + np.random.default_rng(5).uniform(-0.6, 0.6, (N, 6)))), "not of the same motion"
)
displaced = A.copy()
displaced[9:] = A[9:] @ exp_se3(np.array([0.0, 0.0, 0.1, 0.4, 0.0, 0.3]))
CASES["a camera displaced"] = wrong(quaternions(displaced), "fit one mounting each, but not the same")
CASES["one pose again and again"] = wrong(quaternions(np.repeat(A[:1], N, axis=0)), "the very same pose")
# joints
DEG = np.degrees(Q)
CASES["joints in another order"] = wrong(csv(JOINTS, DEG[:, [0, 2, 1, 3, 4, 5]]), "in another order", arm="six_r")
CASES["a joint of the other sense"] = wrong(csv(JOINTS, DEG * [1, 1, -1, 1, 1, 1]), "counts the other way", arm="six_r")
CASES["a joint of another zero"] = wrong(csv(JOINTS, np.add(DEG, [0, 90, 0, 0, 0, 0])), "another zero", arm="six_r")
CASES["radians as degrees, joints"] = wrong(csv(JOINTS, Q), "the joints are in radians", arm="six_r")
CASES["degrees as radians, joints"] = wrong(csv(JOINTS.replace("deg", "rad"), DEG), "are these degrees", arm="six_r")
CASES["joints and no model"] = wrong(csv(JOINTS, DEG), "give --model")
CASES["a gripper beside the joints"] = wrong(csv(f"{JOINTS},q7_deg", DEG, DEG[:, :1]), "gripper", arm="six_r")
CASES["a joint missing"] = wrong(csv(",".join(JOINTS.split(",")[:5]), DEG[:, :5]), "q6_deg is missing", arm="six_r")
CASES["joints from 0"] = wrong(csv(",".join(f"q{k}_deg" for k in range(6)), DEG), "q0_deg where q1_deg", arm="six_r")
CASES["joints in two units"] = wrong(
    csv(JOINTS.replace("q3_deg", "q3_rad"), DEG), "all in degrees or all in radians", arm="six_r"
)
CASES["joints without a unit"] = wrong(csv("j1,j2,j3,j4,j5,j6", DEG), "joints without a unit", arm="six_r")
CASES["another arm"] = wrong(csv(JOINTS, DEG), "fit --model|not of the same motion|joint", arm="ur5")
CASES["another arm of seven joints"] = wrong(csv(JOINTS, DEG), "6 joints.*has 7", arm="franka")
CASES["a joint's name misspelt"] = wrong(csv(",".join([*SIX.joint_names[:5], "jont6"]), Q), "is it joint6", arm="six_r")
CASES["a list that may be joints"] = wrong(
    "".join(f"{row.tolist()}\n" for row in Q), "a pose, or joint angles", arm="six_r"
)
CASES["percent of LeRobot"] = wrong(
    csv(
        ",".join(f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")),
        Q[:, :5],
    ),
    "degrees, or percent",
    arm="so101",
)
CASES["servo counts as degrees"] = wrong(
    csv(JOINTS, 2048 + DEG * 4096 / 360), "are these|fit|not of the same", arm="six_r"
)
# counts, cells, separators
CASES["a row cut short"] = wrong(cut(quaternions(A), 5, lambda row: row.rpartition(",")[0]), "line 5: 6 fields where 7")
CASES["a row too long"] = wrong(cut(quaternions(A), 6, lambda row: row + ",1,2"), "line 6: 9 fields where 7")
CASES["a word in a row"] = wrong(cut(quaternions(A), 7, lambda row: "oops" + row), "line 7: x_m is 'oops")
CASES["an empty cell"] = wrong(cut(quaternions(A), 7, lambda row: row[row.index(",") :]), "line 7: x_m is ''")
CASES["NaN"] = wrong(cut(quaternions(A), 8, lambda row: "nan" + row[row.index(",") :]), "line 8: x_m is 'nan'")
CASES["an underscore in a number"] = wrong(
    cut(quaternions(A), 8, lambda row: "1_0" + row[row.index(",") :]), "x_m is '1_0'"
)
CASES["a quaternion not normed"] = wrong(csv(QUATERNION, A[:, :3, 3], 2 * rotations_as(A, "wxyz")), "length 2, not 1")
CASES["a quaternion of zeros"] = wrong(csv(QUATERNION, A[:, :3, 3], 0 * rotations_as(A, "wxyz")), "length 0, not 1")
CASES["names and no rows"] = wrong(QUATERNION + "\n", "no rows")
CASES["nothing"] = wrong("", "no rows")
CASES["blanks"] = wrong("\n \n", "no rows")
CASES["a column twice"] = wrong(quaternions(A, head=QUATERNION.replace("qz", "qy")), "names a column twice: qy")
CASES["a column missing"] = wrong(
    csv("x_m,y_m,z_m,qw,qx,qy", A[:, :3, 3], rotations_as(A, "wxyz")[:, :3]), "column qz is missing"
)
CASES["no rotation"] = wrong(csv("x_m,y_m,z_m", A[:, :3, 3]), "no rotation")
CASES["no position"] = wrong(csv("qw,qx,qy,qz", rotations_as(A, "wxyz")), "no positions")
CASES["names nobody knows"] = wrong(quaternions(A, head="a,b,c,d,e,f,g"), "no positions.*--columns x_m=NAME")
CASES["five numbers"] = wrong(csv("", A[:, :3, 3], rotations_as(A, "xyz")[:, :2]), "5 numbers without names")
CASES["nine numbers"] = wrong(csv("", A[:, :3, :3].reshape(N, 9)), "9 numbers without names")
CASES["three numbers"] = wrong(csv("", A[:, :3, 3]), "3 numbers without names")
CASES["decimal commas between commas"] = wrong(quaternions(A).replace(".", ","), "decimal commas")
CASES["points and decimal commas"] = wrong(
    cut(quaternions(A).replace(",", ";"), 3, lambda row: row.replace(".", ",")), "is the comma"
)
CASES["units that differ in a column"] = wrong(
    "x,y,z,qw,qx,qy,qz\n1 mm,2 mm,3 mm,1,0,0,0\n1 m,2 mm,3 mm,1,0,0,0\n", "several units"
)
CASES["a name for two rows"] = wrong(
    "name," + QUATERNION + "\n" + "".join(f"a,{row}\n" for row in quaternions(A).splitlines()[1:]), "names two rows"
)
CASES["names that are not those seen"] = wrong(
    "name," + QUATERNION + "\n" + "".join(f"a{k},{row}\n" for k, row in enumerate(quaternions(A).splitlines()[1:])),
    "none of its names .* is among those seen",
)
# the option --columns
CASES["--columns of too few"] = wrong(poses(A), "has 7 columns, --columns names 3", columns="x,y,z")
CASES["--columns of an unknown name"] = wrong(poses(A), "unknown name 'foo'", columns="x,y,z,foo,qx,qy,qz")
CASES["--columns of a name twice"] = wrong(poses(A), "repeats a name", columns="x,y,z,qw,qx,qy,qy")
CASES["--columns of no form"] = wrong(quaternions(A), "expected NAME=COLUMN", columns="x_m")
CASES["--columns of a column that is not there"] = wrong(quaternions(A), "no column 'X' for x_m", columns="x_m=X")
CASES["--columns of poses that are not there"] = wrong(
    json.dumps([{"a": T.tolist()} for T in A]), "has no poses 'robot'; there are a", name="a.json", columns="pose=robot"
)
# files of another program, or of another kind
CAMERA = "image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n"
CAMERA += "  cols: 3\n  data: [500, 0, 320, 0, 500, 240, 0, 0, 1]\n"
CASES["a ROS camera calibration"] = wrong(CAMERA, "holds a mapping of image_width.*no poses", name="left.yaml")
CASES["a Kalibr target"] = wrong(
    "target_type: 'aprilgrid'\ntagCols: 6\ntagSize: 0.088\n", "holds a mapping of target_type.*no poses", name="t.yaml"
)
CASES["a URDF"] = wrong(URDF, "begins no table", name="arm.urdf")
CASES["a TOML of motions"] = wrong(
    "[[motion]]\nkind = 'line'\nto_mm = [1, 2, 3]\n", "begins no table|no table", name="m.toml"
)
CASES["JSON cut short"] = wrong(json.dumps(A.tolist())[:-2], "not JSON", name="a.json")
CASES["YAML that is none"] = wrong("a: [1, 2\nb: {", "not YAML", name="a.yaml")
CASES["an image"] = wrong(b"\x89PNG\r\n\x1a\n\xff\xfe\x00\x80", "not a text file", name="a.png")
CASES["a spreadsheet"] = wrong(b"PK\x03\x04\x14\x00\xff\xfe\x80", "not a text file", name="a.xlsx")
CASES["no file"] = wrong(None, "no such file", name="none/robot.csv")
CASES["KRL without points"] = wrong(
    "DEF P()\nDECL FDAT FP1={TOOL_NO 1,BASE_NO 0}\nEND\n", "begins no table|no table", name="p.src"
)
CASES["a KRL point cut short"] = wrong("XP1={X 1,Y 2,Z 3,A 4,B 5}\n", "a point needs X, Y, Z, A, B, C", name="p.dat")
CASES["pulses of a Yaskawa"] = wrong(
    "/JOB\n//POS\n///POSTYPE PULSE\n///PULSE\nC00000=0,1,2,3,4,5\n", "pulses of the motors'", name="p.JBI"
)
CASES["G-code"] = wrong(
    "G21\nG1 X10 Y20 Z30 F100\nG1 X11 Y20 Z30\n", "fields where|no positions|numbers without", name="p.gcode"
)
CASES["a UR pose cut short"] = wrong("p[0.1, 0.2, 0.3, 0, 0]\n", "5 fields where 6", name="p.txt")
CASES["two UR poses in a line"] = wrong(
    "pose_trans(p[0,0,0,0,0,0], p[0,0,1,0,0,0])\n", "expected one p", name="p.script"
)
CASES["positions of both sides nobody named"] = wrong(
    json.dumps([{"first": a.tolist(), "second": b.tolist()} for a, b in zip(A, B, strict=True)]),
    "say which, --columns pose=first",
    name="b.json",
)
CASES["joint states and no model"] = wrong(
    "".join(f"name: [a, b]\nposition: [0.1, {k}]\n---\n" for k in range(4)),
    "no positions.*--model|joints",
    name="js.yaml",
)
CASES["a calibration file of a UR"] = wrong(
    "kinematics:\n  shoulder:\n    x: 0\n    roll: 0\n", "holds a mapping of kinematics.*no poses", name="c.yaml"
)
CASES["Python's objects in YAML"] = wrong(
    "a: !!python/object/apply:numpy.core.multiarray.scalar [1]\n", "Python object", name="a.yaml"
)
CASES["a record without its pose"] = wrong(
    json.dumps([*({"T": T.tolist()} for T in A[:5]), {"T": None}]), "record 6 of 6 holds", name="a.json"
)


def said_of(folder: Path, case) -> tuple[bool, str]:
    """Return whether an input is rejected, and all that is said of it."""
    for name, content in ((case["name"], case["robot"]), ("seen.csv", case["seen"])):
        path = folder / name
        if path.parent == folder:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
    arm = None if case["arm"] is None else open_arm(case["arm"])
    try:
        robot = read_pose_table(folder / case["name"], arm=arm, **case["options"])
        seen = seen_in_table(read_pose_table(folder / "seen.csv", side="seen", **case["seen_options"]))
        checked = require_plausible(paired(robot, seen, case["in_hand"], arm), arm)
    except InputError as error:
        return True, str(error)
    return False, " ".join(checked.notes)


ARMS = {
    "xacro": (URDF.replace("<robot", '<robot xmlns:xacro="x"><xacro:macro/', 1), "expand them first|not XML"),
    "an SDF": ("<sdf version='1.7'><model name='a'/></sdf>", "outermost element is <sdf>, must be <robot>"),
    "a MuJoCo model": ("<mujoco model='a'><worldbody/></mujoco>", "outermost element is <mujoco>"),
    "an encoding that is not known": (
        "<?xml version='1.0' encoding='ebcdic-x'?><robot/>",
        "declares encoding 'ebcdic-x'",
    ),
    "not XML": ("robot: a\n", "not XML"),
    "three joints": (URDF.replace('type="revolute"', 'type="fixed"', 3), "3 rotary joints"),
    "a linear axis within": (
        URDF.replace('name="joint3" type="revolute"', 'name="joint3" type="prismatic"'),
        "'joint3' is prismatic",
    ),
    "degrees as limits": (URDF.replace('upper="2.9670597283903604"', 'upper="170"'), "are these degrees"),
    "a joint type nobody knows": (URDF.replace('type="revolute"', 'type="hinge"', 1), "type 'hinge' is unknown"),
    "a link that is not there": (
        URDF.replace('<child link="link3" />', '<child link="elbow" />'),
        "there is no link 'elbow'",
    ),
}


#: What is no calibration of a UR5, and the words of its cause.
CALIBRATIONS = {
    "a camera's": (CAMERA, "holds image_width.*expected kinematics:"),
    "another arm's": ("kinematics:\n  shoulder:\n    x: 0\n", "upper_arm is missing"),
    "a list": ("- 1\n", "expected a YAML mapping"),
}


def said_of_arm(folder: Path, text: str, *, calibration: bool) -> tuple[bool, str]:
    """Return whether an arm's file is rejected, and what is said of it."""
    path = folder / ("arm.yaml" if calibration else "arm.urdf")
    path.write_text(text)
    try:
        read_calibration(path, MODELS["ur5"]) if calibration else open_arm(path)
    except InputError as error:
        return True, str(error)
    return False, ""


def main() -> int:
    """Try all, print those that are not named for what they are; return 1 where these are more than a tenth.

    Of two tables that are exchanged nothing can be said: A X B = Z is B inv(Z) A = inv(X), and fits as well.
    """
    right, silent, count = 0, 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tried = {case: (lambda case=case: said_of(folder, CASES[case]), CASES[case]["said"]) for case in CASES}
        for calibration, table in ((False, ARMS), (True, CALIBRATIONS)):
            for case, (text, said) in table.items():
                tried[f"arm: {case}"] = (
                    lambda text=text, calibration=calibration: said_of_arm(folder, text, calibration=calibration),
                    said,
                )
        for case, (try_it, expected) in tried.items():
            rejected, said = try_it()
            named = rejected and re.search(expected, said, re.DOTALL) is not None and "\n" not in said
            right, silent, count = right + named, silent + (not said), count + 1
            if not named:
                print(f"{case}: expected {expected!r}, {'rejected' if rejected else 'read'}: {said}", flush=True)
    print(f"{right} of {count} named for what they are, {silent} silent")
    return int(right < 0.9 * count)


if __name__ == "__main__":
    sys.exit(main())
