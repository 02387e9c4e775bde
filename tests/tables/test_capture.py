"""Exports of motion capture programs are one body's poses; what they leave open is rejected with what to export instead."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.tables.poses import read_pose_table

RNG = np.random.default_rng(20261)
R = Rotation.random(4, random_state=RNG)
P = RNG.uniform(-0.8, 0.8, (4, 3))  # m
Q, M = R.as_quat(), R.as_matrix()
LOST = 2  # the frame in which the body was not seen


def motive(body="Tool", unit="Millimeters", scale=1e3, rotation="Quaternion", parent=True):
    """Motive 3's CSV, and Motive 2's without parents; a marker's columns stand before the body's."""
    axes = "XYZW" if rotation == "Quaternion" else "XYZ"
    kinds = ["Marker"] * 3 + ["Rigid Body"] * (len(axes) + 4)
    what = ["Position"] * 3 + ["Rotation"] * len(axes) + ["Position"] * 3 + ["Mean Marker Error"]
    label = ("Type", "Name", "ID", "Parent") if parent else ("",) * 4
    lines = [
        "Format Version,1.25,Take Name,take 1,Take Notes,,Capture Frame Rate,100.000000,Rotation Type,"
        f"{rotation},Length Units,{unit},Coordinate Space,Global",
        "",
        ",".join(["", label[0], *kinds]),
        ",".join(["", label[1], *['"Tool:Marker1"'] * 3, *[f'"{body}"'] * (len(kinds) - 3)]),
        ",".join(["", label[2], *["1"] * len(kinds)]),
        *([",".join(["", label[3], *[""] * len(kinds)])] if parent else []),
        ",".join(["", "", *what]),
        ",".join(["Frame", "Time (Seconds)", *"XYZ", *axes, *"XYZ", ""]),
    ]
    for k in range(4):
        cells = (
            [f"{x:.6f}" for x in (*Q[k][: len(axes)], *(scale * P[k]), 0.2)] if k != LOST else [""] * (len(axes) + 4)
        )
        lines.append(",".join([str(k), f"{k / 100:.6f}", "1", "2", "3", *cells]))
    return "\n".join(lines) + "\n"


def qtm(names=("Tool",), residual=True):
    """QTM's TSV of 6D data, as in github.com/shiplab/dt_cv; zeros where a body is lost."""
    heads = ["Y", "Z", "Roll", "Pitch", "Yaw", *["Residual"] * residual, *(f"Rot[{i}]" for i in range(9))]
    above = {"NO_OF_FRAMES": 4, "NO_OF_BODIES": len(names), "FREQUENCY": 100, "TIME_STAMP": "2026-01-22, 17:47:17\t1.5"}
    lines = [f"{key}\t{value}" for key, value in above.items()] + ["BODY_NAMES\t" + "\t".join(names)]
    lines.append("\t".join(["Frame", "Time", *(cell for name in names for cell in (f"{name} X", *heads))]) + "\t")
    for k in range(4):
        one = [*(1e3 * P[k]), *R[k].as_euler("XYZ", degrees=True), *[0.3] * residual, *M[k].T.ravel()]
        one = [f"{x if k != LOST else 0.0:.5f}" for x in one]
        other = ["0.00000"] * len(one)
        bodies = [one if name == "Tool" else other for name in names]
        lines.append("\t".join([str(k + 1), f"{k / 100:.5f}", *(cell for body in bodies for cell in body)]) + "\t")
    return "\n".join(lines) + "\n"


def vicon(rotation="RX,RY,RZ,RW", unit="mm", scale=1e3):
    """Vicon Tracker's CSV of objects, and what else was exported behind them."""
    count = rotation.count(",") + 1
    units = ",".join(["", "", *["deg" if count == 3 else ""] * count, *[unit] * 3])
    lines = ["Objects", "100", f",,Tool:Tool{',' * (count + 2)}", f"Frame,Sub Frame,{rotation},TX,TY,TZ", units]
    for k in range(4):
        cells = [f"{x:.6f}" for x in (*Q[k][:count], *(scale * P[k]))] if k != LOST else [""] * (count + 3)
        lines.append(",".join([str(k + 1), "0", *cells]))
    return "\n".join([*lines, "", "Trajectories", "100", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm", "1,0,1,2,3"]) + "\n"


FILES = {
    "motive 3": ("a.csv", motive(), 0.0),
    "motive 2, metres": ("a.csv", motive(unit="Meters", scale=1.0, parent=False), 0.0),
    "motive, centimetres": ("a.csv", motive(unit="Centimeters", scale=100.0), 0.0),
    "qtm": ("a.tsv", qtm(), 0.0),
    "qtm, two bodies": ("a.tsv", qtm(("Robot base", "Tool")), 0.0),
    "vicon": ("a.csv", vicon(), 0.01),
    "vicon, metres": ("a.csv", vicon(unit="m", scale=1.0), 0.01),
}


@pytest.mark.parametrize("program", FILES)
def test_each_program_gives_the_same_poses_without_the_frames_that_lack_the_body(tmp_path, program):
    name, text, begin_s = FILES[program]
    (tmp_path / name).write_text(text)
    table = read_pose_table(tmp_path / name, columns="pose=Tool" if "two" in program else None)
    seen = [k for k in range(4) if k != LOST]
    np.testing.assert_allclose(table.Ts, pose(M, P)[seen], atol=2e-5)
    np.testing.assert_allclose(table.t_s, begin_s + np.array(seen) / 100, atol=1e-9)
    assert "1 of 4 rows have no pose, and are left out: line " in table.notes[1]
    kept = read_pose_table(tmp_path / name, columns="pose=Tool" if "two" in program else None, keep_missed=True)
    assert kept.missed == tuple("x_m is empty" if k == LOST else "" for k in range(4))
    np.testing.assert_allclose(kept.Ts[seen], table.Ts)
    assert table.names is None  # rows of a robot's table have other names, or none
    assert table.unused == ()
    assert [text.splitlines()[line - 1].split("\t" if name == "a.tsv" else ",")[0] for line in table.lines] == [
        str(k + round(100 * begin_s or name == "a.tsv")) for k in seen
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (motive(rotation="XYZ"), "OptiTrack's Motive whose rotations are three numbers: .* Rotation Type Quaternion"),
        (
            motive().replace("Rigid Body", "Bone"),
            "Motive without the poses of a rigid body: export CSV with Rigid Bodies",
        ),
        (motive(unit="Furlongs"), "lengths in 'Furlongs'; known are meters"),
        (motive().replace("Frame,", "frame,"), "OptiTrack's Motive without the poses"),
        (qtm().replace("Rot[", "R["), "Qualisys' QTM whose rotations are three numbers: export TSV with 6D data"),
        ("NO_OF_FRAMES\t1\nMARKER_NAMES\ta\n1\t2\t3\n", "Qualisys' QTM without the poses of a rigid body"),
        (
            qtm(("Robot base", "Plate", "Tool")),
            "poses of Robot base, Plate, Tool: say which, --columns pose=Robot base",
        ),
        (vicon("RX,RY,RZ"), "Vicon whose rotations are three numbers: export objects or segments with quaternions"),
        ("Trajectories\n100\n,,a,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n1,0,1,2,3\n", "Vicon without the poses"),
        (vicon(unit="ells"), "lengths in 'ells'"),
        *(
            (
                vicon().replace("\n100\n", f"\n{rate}\n", 1),
                f"a.csv: line 2: '{rate}' frames a second; expected a positive",
            )
            for rate in ("0", "-100", "nan", "inf", "fast", "")
        ),
        (
            motive().partition("\n3,")[0].partition("\n0,")[0] + "\n0,0.0,1,2,3,,,,,,,,\n",
            "none of 1 rows has a pose; line 9: x_m is empty",
        ),
    ],
)
def test_what_an_export_leaves_open_is_rejected_with_the_export_to_choose(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_pose_table(tmp_path / "a.csv")


@pytest.mark.parametrize("program", [name for name in FILES if "two" not in name])
@pytest.mark.parametrize("damage", ["garbage", "x", '"x', "9" * 140_000, ""])
def test_a_damaged_line_is_named_and_left_out_and_those_beneath_are_read(tmp_path, program, damage):
    """Instead of a whole line, of the frame's number, and of the rotation's last number."""
    name, text, begin_s = FILES[program]
    mark = "\t" if name == "a.tsv" else ","
    lines = text.split("\n")
    first = next(k for k, line in enumerate(lines) if line.startswith(("Frame", '"Frame'))) + 1 + ("vicon" in program)
    path = tmp_path / name
    for cell in (None, 0, {"m": 8, "q": -2, "v": 5}[program[0]]):
        for k in (0, 1):
            cells = lines[first + k].split(mark)
            if cell is not None:
                cells[cell] = damage
            path.write_text(
                "\n".join([*lines[: first + k], damage if cell is None else mark.join(cells), *lines[first + k + 1 :]])
            )
            table = read_pose_table(path)
            seen = [each for each in range(4) if each not in (LOST, k)]
            np.testing.assert_allclose(table.Ts, pose(M, P)[seen], atol=2e-5)
            np.testing.assert_allclose(table.t_s, begin_s + np.array(seen) / 100, atol=1e-9)
            if damage or cell == 0:  # an empty line is none, an empty number a body that was not seen
                assert table.notes[0].endswith(f"; damaged: line {first + k + 1}")


def test_many_damaged_lines_are_counted(tmp_path):
    head, rows = vicon().partition("\n1,0")[0], vicon().split("\n")[5:7]
    (tmp_path / "a.csv").write_text("\n".join([head, *rows, *["?"] * 9, *rows]))
    table = read_pose_table(tmp_path / "a.csv")
    assert table.notes[0].endswith("; damaged: line 8, 9, 10, 11, 12 and 4 more")


def test_a_table_of_ones_own_that_begins_with_frames_is_none_of_them(tmp_path):
    (tmp_path / "a.csv").write_text("Frame,Time,x_mm,y_mm,z_mm,qw,qx,qy,qz\n1,0.5,100,2,3,1,0,0,0\n")
    np.testing.assert_allclose(read_pose_table(tmp_path / "a.csv").Ts[0, :3, 3], [0.1, 0.002, 0.003])
