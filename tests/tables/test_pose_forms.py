"""Poses and joints as the programs of the field write them: one table of inputs, each with its program and its right value.

Every text is built here from the same poses by SciPy's rotations, in the form that the named source documents.
"""

import json
import math

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from armsight.errors import InputError
from armsight.robot.arm_file import open_arm
from armsight.tables.cells import read_cells
from armsight.tables.lengths import number
from armsight.tables.nested import has_both
from armsight.tables.poses import read_pose_table

N = 6
_RNG = np.random.default_rng(37)
R = Rotation.random(N, random_state=37)
P = np.array([0.45, 0.05, 0.35]) + _RNG.uniform(-0.2, 0.2, (N, 3))
A = np.tile(np.eye(4), (N, 1, 1))
A[:, :3, :3], A[:, :3, 3] = R.as_matrix(), P
MM = 1e3 * P
XYZW, WXYZ, VECTOR = R.as_quat(), R.as_quat()[:, [3, 0, 1, 2]], R.as_rotvec()
FIXED, ROTATED = R.as_euler("xyz", degrees=True), R.as_euler("XYZ", degrees=True)
KUKA, ZYZ = R.as_euler("ZYX", degrees=True), R.as_euler("ZYZ", degrees=True)
#: What was seen, another set of poses.
B = A[::-1] @ A[0]
Q = _RNG.uniform(-1.5, 1.5, (N, 6))
DEG = np.degrees(Q)


def rows(form, *columns):
    """One line for each pose, the columns' numbers in order."""
    numbers = np.hstack([np.reshape(column, (N, -1)) for column in columns])
    return "".join(form.format(*(f"{value:.9f}" for value in row), k=k) + "\n" for k, row in enumerate(numbers))


def csv(head, *columns, mark=","):
    width = sum(np.reshape(column, (N, -1)).shape[1] for column in columns)
    return (head + "\n" if head else "") + rows(mark.join(["{}"] * width), *columns)


def vector(p):
    return dict(zip("xyz", map(float, p), strict=True))


def quaternion(q):
    return dict(zip("xyzw", map(float, q), strict=True))


def ros(keys=("translation", "rotation"), T=A):
    """A list of ROS's transforms or poses."""
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return [{keys[0]: vector(one[:3, 3]), keys[1]: quaternion(q)} for one, q in zip(T, quaternions, strict=True)]


def messages(each):
    return "".join(yaml.safe_dump(one, sort_keys=False) + "---\n" for one in each)


def stamped(k, **more):
    return {"header": {"seq": k, "stamp": {"secs": 1626900134 + k, "nsecs": 5000000}, "frame_id": "base"}, **more}


def opencv(name, matrix):
    matrix = np.atleast_2d(matrix)
    data = ", ".join(repr(float(one)) for one in matrix.ravel())
    height, width = matrix.shape
    return f"{name}: !!opencv-matrix\n   rows: {height}\n   cols: {width}\n   dt: d\n   data: [ {data} ]\n"


JBI = (
    "/JOB\n//NAME POSES\n//POS\n///NPOS 6,0,0,0,0,0\n///TOOL 0\n///POSTYPE BASE\n///RECTAN\n///RCONF 0,0,0,0,0,0,0,0\n"
)
LS = (
    "P[{k}:\"at {k}\"]{{\n   GP1:\n\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',\n"
    "\tX =  {}  mm,\tY =  {}  mm,\tZ =  {}  mm,\n\tW =  {} deg,\tP =  {} deg,\tR =  {} deg\n}};"
)
DTX = '<Database><Datas><Data name="p" access="public" xsi:type="array" type="pointRx" size="6">\n'

TARGET = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"

#: Program and its source -> file name, text, options. All give the poses A.
FORMS = {
    "quaternions by their names": ("q.csv", csv("x_m,y_m,z_m,qw,qx,qy,qz", P, WXYZ)),
    "quaternions without names": ("q.csv", csv("", P, WXYZ), {"rotation": "wxyz"}),
    "rotation vectors, mm": ("v.csv", csv("x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad", MM, VECTOR)),
    "columns named by hand": (
        "e.csv",
        csv("X,Y,Z,A,B,C", MM, KUKA[:, ::-1]),
        {"rotation": "ZYX", "unit": "mm", "columns": "x=X,y=Y,z=Z,rx_deg=A,ry_deg=B,rz_deg=C"},
    ),
    "geometry_msgs/Pose (rostopic echo -p)": (
        "ros.csv",
        csv(
            ",".join(["%time", *(f"pose.position.{k}" for k in "xyz"), *(f"pose.orientation.{k}" for k in "xyzw")]),
            np.arange(N),
            P,
            XYZW,
        ),
    ),
    "KUKA's columns": ("k.csv", csv("X,Y,Z,A,B,C", MM, KUKA)),
    "Fanuc's columns": ("f.csv", csv("X,Y,Z,W,P,R", MM, FIXED)),
    "lists of a UR's poses": ("l.csv", rows("[{}, {}, {}, {}, {}, {}]", P, VECTOR)),
    "matrices of four lines": ("m.txt", "\n".join(" ".join(map(repr, row)) for row in A.reshape(-1, 4).tolist())),
    "units in brackets": ("b.csv", csv("X [mm],Y [mm],Z [mm],Roll [deg],Pitch [deg],Yaw [deg]", MM, FIXED)),
    "easy_handeye 0.4 samples (TakeSample)": (
        "samples.yaml",
        yaml.safe_dump([{"robot": a, "tracking": b} for a, b in zip(ros(), ros(T=B), strict=True)]),
    ),
    "easy_handeye2 samples with TransformStamped (handeye_sampler.py: robot, optical)": (
        "s.yaml",
        yaml.safe_dump(
            {
                "samples": [
                    {"robot": {"transform": a}, "optical": {"t": b}} for a, b in zip(ros(), ros(T=B), strict=True)
                ]
            }
        ),
    ),
    "moveit_calibration saveSamples (handeye_control_widget.cpp)": (
        "m.yaml",
        yaml.safe_dump(
            [
                {"effector_wrt_world": a.ravel().tolist(), "object_wrt_sensor": b.ravel().tolist()}
                for a, b in zip(A, B, strict=True)
            ]
        ),
    ),
    "ethz-asl/hand_eye_calibration csv (datasets/*.csv)": (
        "t.csv",
        rows("{}, {}, {}, {}, {}, {}, {}, {}", 1491416639.9 + np.arange(N), P, XYZW),
        {"rotation": "xyzw"},
    ),
    "MRPT CPose3D::asString [x y z yaw pitch roll]": (
        "mrpt.txt",
        rows("[{} {} {} {} {} {}]", P, KUKA),
        {"columns": "x,y,z,rz_deg,ry_deg,rx_deg", "rotation": "xyz"},
    ),
    "OpenCV 4 FileStorage R_gripper2base, t_gripper2base as lists": (
        "cv.json",
        json.dumps(
            {
                "R_gripper2base": A[:, :3, :3].tolist(),
                "t_gripper2base": P[:, :, None].tolist(),
                "R_target2cam": B[:, :3, :3].tolist(),
                "t_target2cam": B[:, :3, 3:].tolist(),
            }
        ),
    ),
    "OpenCV 4 FileStorage of rvecs and tvecs, Nx3": (
        "cv.yml",
        "%YAML:1.0\n---\n" + opencv("rvecs", VECTOR) + opencv("tvecs", P),
    ),
    "KUKA KRL .src LIN with $TOOL and $BASE (KSS 8.3)": (
        "p.src",
        "DEF P()\n$BASE={{X 0,Y 0,Z 0,A 0,B 0,C 0}}\n$TOOL={{X 0,Y 0,Z 120,A 0,B 0,C 0}}\n".replace("{{", "{").replace(
            "}}", "}"
        )
        + rows("LIN {{X {},Y {},Z {},A {},B {},C {}}} C_DIS", MM, KUKA)
        + "END\n",
    ),
    "KUKA KRL .dat E6POS (KSS 8.3)": (
        "p.dat",
        "DEFDAT P\n"
        + rows("DECL E6POS XP{k}={{X {},Y {},Z {},A {},B {},C {},S 6,T 27,E1 0.0,E2 0.0}}", MM, KUKA)
        + "ENDDAT\n",
    ),
    "FANUC TP .LS (HandlingTool 9.40)": ("p.LS", "/PROG  P\n/MN\n/POS\n" + rows(LS, MM, FIXED) + "/END\n"),
    "Universal Robots URScript 5.11": (
        "p.script",
        "def p():\n  set_tcp(p[0,0,0.12,0,0,0])\n  set_payload(1.2)\n"
        + rows("  movel(p[{},{},{},{},{},{}], a=1.2, v=0.25)\n  sleep(0.5)", P, VECTOR)
        + "end\n",
    ),
    "Universal Robots RTDE actual_TCP_pose_0 .. 5 (rtde 2.4 csv)": (
        "r.csv",
        csv(" ".join(["timestamp", *(f"actual_TCP_pose_{k}" for k in range(6))]), np.arange(N), P, VECTOR, mark=" "),
    ),
    "ur_rtde 1.6.5 startFileRecording, named in order": (
        "r.csv",
        csv(",".join(["timestamp", *(f"actual_TCP_pose_{k}" for k in range(6))]), np.arange(N), P, VECTOR),
        {"columns": "t_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad"},
    ),
    "PlotJuggler 3 CSV, with the angles that it adds": (
        "p.csv",
        csv(
            "__time,/p/position/x,/p/position/y,/p/position/z,/p/orientation/roll,"
            "/p/orientation/x,/p/orientation/y,/p/orientation/z,/p/orientation/w",
            1690000000.5 + np.arange(N),
            P,
            VECTOR[:, :1],
            XYZW,
        ),
    ),
    "ros2 topic echo --csv of a PoseStamped": (
        "e.csv",
        rows("1690000000,{k}5000000,base_link,{},{},{},{},{},{},{}", P, XYZW),
    ),
    "ros2 topic echo --csv of a TransformStamped": (
        "e.csv",
        rows("1690000000,5000000,base_link,tool0,{},{},{},{},{},{},{}", P, XYZW),
    ),
    "ros2 topic echo --csv of a PoseStamped, named in order": (
        "e.csv",
        rows("1690000000,5000000,base_link,{},{},{},{},{},{},{}", P, XYZW),
        {"columns": "_,_,_,x_m,y_m,z_m,qx,qy,qz,qw"},
    ),
    "pandas' names of columns without names": ("n.csv", csv("0,1,2,3,4,5,6", P, XYZW), {"rotation": "xyzw"}),
    "a time and numbered columns": (
        "n.csv",
        csv("time,0,1,2,3,4,5,6", np.arange(N), P, XYZW),
        {"columns": "t_s=time,x_m=0,y_m=1,z_m=2,qx=3,qy=4,qz=5,qw=6"},
    ),
    "numbered columns that --columns names": (
        "n.csv",
        csv("0,1,2,3,4,5,6", P, XYZW),
        {"columns": "x_m=0,y_m=1,z_m=2,qx=3,qy=4,qz=5,qw=6"},
    ),
    "pandas' names and index of columns without names": (
        "i.csv",
        csv(",0,1,2,3,4,5,6", np.arange(N), P, XYZW),
        {"rotation": "xyzw"},
    ),
    "Yaskawa .JBI, RECTAN (DX100 manual 4.3.1)": (
        "p.JBI",
        JBI + rows("C{k:05d}={},{},{},{},{},{}", MM, FIXED) + "//INST\n",
    ),
    "Staubli VAL3 .dtx pointRx (VAL3 7)": (
        "p.dtx",
        DTX
        + rows('<Value key="{k}" x="{}" y="{}" z="{}" rx="{}" ry="{}" rz="{}" fatherId="world[0]" />', MM, ROTATED)
        + "</Data></Datas></Database>\n",
    ),
    "Mecademic MovePose (programming manual 8)": (
        "p.mxprog",
        "SetTRF(0,0,0,0,0,0)\n" + rows("MovePose({},{},{},{},{},{})", MM, ROTATED),
    ),
    "Doosan DRL posx (2.10)": ("p.drl", rows("p{k} = posx({}, {}, {}, {}, {}, {})", MM, ZYZ)),
    "DENSO PacScript P() (RC8, id 1939)": ("p.pcs", rows("P{k} = P({}, {}, {}, {}, {}, {}, 5)", MM, FIXED)),
    "xArm Python SDK set_position (1.13)": (
        "p.py",
        rows("arm.set_position(x={}, y={}, z={}, roll={}, pitch={}, yaw={}, speed=100, wait=True)", MM, FIXED),
    ),
    "xArm Python SDK set_position, radians (1.18.4)": (
        "p.py",
        rows(
            "arm.set_position(\n    x={}, y={}, z={}, roll={}, pitch={}, yaw={}, is_radian=True\n)",
            MM,
            np.radians(FIXED),
        ),
    ),
    "xArm Python SDK in degrees beside calls in radians": (
        "p.py",
        "# relative=True and set_tool_position(..) aren't used here\n"
        + rows("arm.set_position({}, {}, {}, {}, {}, {})", MM, FIXED)
        + "print(arm.get_position(is_radian=True))  # arm.set_position(1, 2, 3, 4, 5, 6)\n",
    ),
    "xArm Python SDK whose default is radians": (
        "p.py",
        "arm.default_is_radian = True\n" + rows("arm.set_position({}, {}, {}, {}, {}, {})", MM, np.radians(FIXED)),
    ),
    "Universal Robots with the tool and the motion in one line": (
        "p.script",
        rows("set_tcp(pose_add(t, p[0,0,0.12,0,0,0])); movel(p[{},{},{},{},{},{}]) # p[0,0,0,0,0,0]", P, VECTOR),
    ),
    "xArm JSON of positions": (
        "x.json",
        json.dumps(
            [
                dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), [*p, *r], strict=True))
                for p, r in zip(MM, FIXED, strict=True)
            ]
        ),
        {"unit": "mm"},
    ),
    "Kawasaki AS .TRANS (O A T are Euler's z, y, z; no manual was at hand)": (
        "p.as",
        ".PROGRAM p()\n  LMOVE p1\n.END\n.TRANS\n" + rows("p[{k}] {} {} {} {} {} {}", MM, ZYZ) + ".END\n",
    ),
    "Kawasaki AS TRANS() (no manual was at hand)": (
        "q.pg",
        rows("  POINT p{k} = TRANS({}, {}, {}, {}, {}, {})", MM, ZYZ),
    ),
    "Mitsubishi MELFA-BASIC V .prg (no manual was at hand)": (
        "p.prg",
        "1 Mov P0\n2 End\n" + rows("P{k}=({},{},{},{},{},{},+0.00,+0.00)(7,0)", MM, FIXED),
    ),
    "Epson SPEL+ XY() (U about z, V about y, W about x; no manual was at hand)": (
        "p.prg",
        "Function main\n" + rows("  P{k} = XY({}, {}, {}, {}, {}, {}) /R /A", MM, FIXED[:, ::-1]) + "Fend\n",
    ),
    "Epson RC+ 7.0 .pts": (
        "p.pts",
        rows(
            '[Point{k}]\nnNumber={k}\nsLabel="p{k}"\nrX={}\nrY={}\nrZ={}\nrU={}\nrV={}\nrW={}\nrR=0\nnHand=1\n',
            MM,
            FIXED[:, ::-1],
        ),
    ),
    "Techman TMscript PTP and Line (TMflow 1.80 expression editor; robodk 6.0.2 Techman_2_Pose)": (
        "p.script",
        rows('Line("CAP",{},{},{},{},{},{},125,200,0,false)', MM, FIXED),
    ),
    "Techman TMscript with an array": ("q.script", rows('PTP("CPP",{{{},{},{},{},{},{}}},10,200,0,false)', MM, FIXED)),
    "ABB RAPID robtargets beside tooldata (RobotWare 6)": (
        "p.mod",
        "MODULE P\nPERS tooldata t:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
        + rows("CONST robtarget p{k}:=[[{},{},{}],[{},{},{},{}],[0,0,-1,0],[9E9,9E9,9E9,9E9,9E9,9E9]];", MM, WXYZ)
        + "ENDMODULE\n",
    ),
    "ABB FlexPendant position log [[..],[..],[..]] alone": (
        "p.txt",
        rows("[[{},{},{}],[{},{},{},{}],[0,0,0,0]]", MM, WXYZ),
    ),
    "RoboDK 5 targets as csv (XYZRPW of Staubli and Mecademic)": (
        "r.csv",
        csv("X (mm),Y (mm),Z (mm),rx (deg),ry (deg),rz (deg)", MM, ROTATED),
        {"rotation": "XYZ"},
    ),
    "MATLAB's matrices printed transposed, four lines each": (
        "m.txt",
        "\n".join(" ".join(map(repr, map(float, row))) for row in A.swapaxes(1, 2).reshape(-1, 4)),
    ),
    "libfranka 0.9 O_T_EE, column by column": ("f.csv", csv("", A.swapaxes(1, 2))),
    "franka_msgs/FrankaState (rostopic echo)": (
        "f.yaml",
        messages(
            stamped(k, O_T_EE=T.T.ravel().tolist(), F_T_EE=np.eye(4).ravel().tolist(), q=[0.1] * 7)
            for k, T in enumerate(A)
        ),
    ),
    "geometry_msgs/PoseStamped (rostopic echo)": (
        "e.yaml",
        messages(stamped(k, pose=one) for k, one in enumerate(ros(("position", "orientation")))),
    ),
    "geometry_msgs/TransformStamped (ros2 topic echo)": (
        "e.txt",
        messages(
            {
                "header": {"stamp": {"sec": 7 + k, "nanosec": 500}, "frame_id": "base"},
                "child_frame_id": "tool0",
                "transform": one,
            }
            for k, one in enumerate(ros())
        ),
    ),
    "tf2_msgs/TFMessage of one transform (ros2 topic echo)": (
        "tf.yaml",
        messages({"transforms": [stamped(k, child_frame_id="tool0", transform=one)]} for k, one in enumerate(ros())),
    ),
    "geometry_msgs/PoseArray": ("a.yaml", yaml.safe_dump(stamped(0, poses=ros(("position", "orientation"))))),
    "nav_msgs/Odometry (rostopic echo)": (
        "o.yaml",
        messages(
            stamped(k, pose={"pose": one, "covariance": [0.0] * 36}, twist={"twist": {"linear": vector([1, 2, 3])}})
            for k, one in enumerate(ros(("position", "orientation")))
        ),
    ),
    "tf tf_echo (ROS 1 Noetic)": (
        "tf.txt",
        rows(
            "At time {}\n- Translation: [{}, {}, {}]\n- Rotation: in Quaternion [{}, {}, {}, {}]\n"
            "            in RPY (radian) [0.000, -0.001, 0.000]\n            in RPY (degree) [0.000, -0.046, 0.000]",
            1626900134 + np.arange(N),
            P,
            XYZW,
        ),
    ),
    "tf2_ros tf2_echo (ROS 2 Humble)": (
        "tf2.txt",
        rows(
            "At time {}\n- Translation: [{}, {}, {}]\n- Rotation: in Quaternion (xyzw) [{}, {}, {}, {}]\n"
            "- Rotation: in RPY (radian) [0.000, -0.000, 0.000]\n- Matrix:\n  1.0  0.0  0.0  0.1",
            42 + np.arange(N),
            P,
            XYZW,
        ),
    ),
    "numbers with their units": (
        "u.csv",
        "x;y;z;rx;ry;rz\n" + rows("{} mm;{} mm;{} mm;{}°;{}°;{}°", MM, FIXED).replace(".", ","),
        {"rotation": "xyz"},
    ),
    "psql table": (
        "p.txt",
        " x_mm | y_mm | z_mm | qw | qx | qy | qz\n------+------+------+----+----+----+----\n"
        + rows(" {} | {} | {} | {} | {} | {} | {}", MM, WXYZ)
        + "(6 rows)\n",
    ),
    "Markdown table": (
        "p.md",
        "| x_mm | y_mm | z_mm | qw | qx | qy | qz |\n|---|:-:|---|---|---|---|---|\n"
        + rows("| {} | {} | {} | {} | {} | {} | {} |", MM, WXYZ),
    ),
    "named poses in a mapping (YAML)": (
        "n.yaml",
        yaml.safe_dump(
            {
                f"pose_{k}": {"position": p.tolist(), "rvec": v.tolist()}
                for k, (p, v) in enumerate(zip(P, VECTOR, strict=True))
            }
        ),
    ),
    "JSON Lines of matrices with image names": (
        "j.jsonl",
        "".join(json.dumps({"image": f"{k}.png", "T_base_flange": T.tolist()}) + "\n" for k, T in enumerate(A)),
    ),
    "lists of translation and quaternion_xyzw, mm": (
        "q.json",
        json.dumps(
            {"data": [{"position_mm": p.tolist(), "quat_xyzw": q.tolist()} for p, q in zip(MM, XYZW, strict=True)]},
            indent=1,
        ),
    ),
    "Fortran's exponents and a typesetter's minus": (
        "d.csv",
        csv("x_m,y_m,z_m,qw,qx,qy,qz", P, WXYZ).replace("-", "\u2212").replace("\n", "D0\n").replace("qzD0", "qz"),
    ),
    "rotation before position": ("o.csv", csv("", VECTOR, P), {"columns": "rx,ry,rz,x,y,z", "rotation": "rotvec"}),
    "rotation before position, quaternion": ("o.csv", csv("", XYZW, P), {"columns": "qx,qy,qz,qw,x,y,z"}),
    "Kawasaki's X Y Z O A T": ("k.csv", csv("X,Y,Z,O,A,T", MM, ZYZ)),
    "Doosan's X Y Z A B C": ("d.csv", csv("X,Y,Z,A,B,C", MM, ZYZ), {"rotation": "ZYZ"}),
    "three angles about z, y' and z'' without names": ("z.csv", csv("", P, ZYZ), {"rotation": "ZYZ"}),
    "Kawasaki-like OAT given on as a table, with a column not used": (
        "k.csv",
        csv("", np.arange(N), MM, FIXED),
        {"columns": "_,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg", "rotation": "xyz"},
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_program_gives_the_same_poses(tmp_path, form):
    name, text, *options = FORMS[form]
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_pose_table(tmp_path / name, **dict(*options)).Ts, A, atol=1e-8)


def test_a_first_row_with_a_word_above_numbers_names_columns(tmp_path):
    (tmp_path / "h.csv").write_text(csv("time,1,2,3,4,5,6,7", np.arange(N), P, XYZW))
    assert read_cells(tmp_path / "h.csv").head == ["time", *"1234567"]
    (tmp_path / "h.csv").write_text(csv("x,y,z,nan,nan,nan,nan", P, XYZW))
    with pytest.raises(InputError, match="line 1 names a column twice: nan"):
        read_cells(tmp_path / "h.csv")


@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_numpys_files_of_matrices(tmp_path, suffix):
    path = tmp_path / f"T.{suffix}"
    np.save(path, A) if suffix == "npy" else np.savez(path, robot=A, target=B)
    np.testing.assert_allclose(read_pose_table(path).Ts, A, atol=1e-12)
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(InputError, match="damaged numpy file"):
        read_pose_table(tmp_path / "bad.npy")


def test_files_of_one_pose_each_are_one_table(tmp_path):
    """As ViSP 3.6 keeps them: pose_fPe_1.yaml .. with x, y, z and theta u, radians."""
    for k, row in enumerate(np.hstack([P, VECTOR]), 8):
        cells = "".join(f"  - [{value:.9f}]\n" for value in row)
        (tmp_path / f"pose_fPe_{k}.yaml").write_text(f"rows: 6\ncols: 1\ndata: \n{cells}")
    table = read_pose_table(tmp_path / "pose_fPe_*.yaml")
    np.testing.assert_allclose(table.Ts, A, atol=1e-8)
    assert table.names[:3] == ("pose_fPe_8", "pose_fPe_9", "pose_fPe_10")
    np.savetxt(tmp_path / "frame-000.txt", A[0])
    np.testing.assert_allclose(read_pose_table(tmp_path / "frame-*.txt").Ts, A[:1], atol=1e-12)
    np.savetxt(tmp_path / "frame-001.txt", A[:2].reshape(-1, 4))
    with pytest.raises(InputError, match=r"frame-001.txt: holds 2 rows .* expected one pose"):
        read_pose_table(tmp_path / "frame-*.txt")
    for k, row in enumerate(np.hstack([VECTOR, P])):
        np.savetxt(tmp_path / f"pos{k}.txt", row[:, None])  # a number a line
    table = read_pose_table(tmp_path / "pos*.txt", columns="rx,ry,rz,x_m,y_m,z_m", rotation="rotvec")
    np.testing.assert_allclose(table.Ts, A, atol=1e-12)
    np.savetxt(tmp_path / "pos0.txt", [[0.0], [1.0]])
    with pytest.raises(InputError, match=r"pos1.txt: holds 1 rows of x.*; expected one pose of 2 numbers, as pos0.txt"):
        read_pose_table(tmp_path / "pos*.txt")
    with pytest.raises(InputError, match="no such file; quote a glob"):
        read_pose_table(tmp_path / "none*.txt")


SIX = open_arm("six_r")
JOINTS = {
    "names of joints in another order": (
        "n.csv",
        csv(",".join(SIX.joint_names[k] for k in (2, 0, 1, 5, 4, 3)), Q[:, [2, 0, 1, 5, 4, 3]]),
    ),
    "KUKA {A1 ..}": ("a.dat", rows("PTP {{A1 {},A2 {},A3 {},A4 {},A5 {},A6 {}}}", DEG)),
    "FANUC .LS joints": (
        "j.LS",
        rows(
            "P[{k}]{{\n   GP1:\n\tUF : 0, UT : 1,\n\tJ1= {} deg,\tJ2= {} deg,\tJ3= {} deg,\n"
            "\tJ4= {} deg,\tJ5= {} deg,\tJ6= {} deg\n}};",
            DEG,
        ),
    ),
    "ABB jointtarget": ("j.mod", rows("CONST jointtarget j{k}:=[[{},{},{},{},{},{}],[9E9,9E9,9E9,9E9,9E9,9E9]];", DEG)),
    "Mecademic MoveJoints": ("j.mxprog", rows("MoveJoints({},{},{},{},{},{})", DEG)),
    "Doosan posj": ("j.drl", rows("j{k} = posj({}, {}, {}, {}, {}, {})", DEG)),
    "xArm set_servo_angle": ("j.py", rows("arm.set_servo_angle(angle=[{}, {}, {}, {}, {}, {}], speed=20)", DEG)),
    "xArm set_servo_angle of an arm in radians": (
        "j.py",
        "arm = XArmAPI('10.0.0.2', is_radian=True)\n" + rows("arm.set_servo_angle(angle=[{}, {}, {}, {}, {}, {}])", Q),
    ),
    "Staubli jointRx, zeros left out": (
        "j.dtx",
        '<Data name="j" type="jointRx" size="6">\n'
        + rows('<Value key="{k}" j1="{}" j2="{}" j3="{}" j4="{}" j5="{}" j6="{}" />', DEG)
        + "</Data>",
    ),
    "Kawasaki AS .JOINTS": ("j.as", ".JOINTS\n" + rows("#j{k} {} {} {} {} {} {}", DEG) + ".END\n"),
    "Mitsubishi MELFA-BASIC V joints": ("j.prg", rows("J{k}=({},{},{},{},{},{},+0.00,+0.00)", DEG)),
    "Epson SPEL+ JA()": ("j.prg", rows("  Go JA({}, {}, {}, {}, {}, {})", DEG)),
    "Techman TMscript JPP": ("j.script", rows('PTP("JPP",{},{},{},{},{},{},35,200,0,false)', DEG)),
    "sensor_msgs/JointState (rostopic echo)": (
        "js.yaml",
        messages(
            stamped(k, name=[*SIX.joint_names][::-1], position=q[::-1].tolist(), velocity=[], effort=[])
            for k, q in enumerate(Q)
        ),
    ),
    "moveit_calibration joint states": (
        "js.yaml",
        yaml.safe_dump({"joint_names": [*SIX.joint_names], "joint_values": Q.tolist()}),
        {"columns": ",".join(f"q{k}_rad" for k in range(1, 7))},
    ),
    "xArm Studio JSON with joints in degrees": ("x.json", json.dumps([{"joints_deg": q.tolist()} for q in DEG])),
}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("p.py", 'for i, x in enumerate(a):\n    print(f"{i}: {x}")\narm.set_position(300, 20, 400, 170, 5, 6)\n'),
        ("p.py", "if m in {1, 2}: go()\narm.set_position(300, 20, 400, 170, 5, 6)\n"),
        ("p.prg", "If A + X(3) Then\nGo XY(300, 20, 400, 170, 5, 6)\n"),
        ("p.py", "x" * 30000 + "\narm.set_position(300, 20, 400, 170, 5, 6)\n"),
    ],
)
def test_code_beside_points_composes_none(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert len(read_pose_table(tmp_path / name).Ts) == 1


@pytest.mark.parametrize("form", JOINTS)
def test_each_program_gives_the_same_joints(tmp_path, form):
    name, text, *options = JOINTS[form]
    (tmp_path / name).write_text(text)
    np.testing.assert_allclose(read_pose_table(tmp_path / name, arm=SIX, **dict(*options)).q, Q, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (
            "p.JBI",
            JBI.replace("RECTAN", "PULSE").replace("BASE", "PULSE") + rows("C{k:05d}={},{},{},{},{},{}", MM, FIXED),
            "pulses of the motors' encoders",
        ),
        ("p.LS", rows(LS, MM, FIXED).replace("UT : 1", "UT : 2", 1), "several frames or tools .UF 0, UT 2, UF 0, UT 1"),
        (
            "p.mod",
            "CONST robtarget p:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9]];\nCONST jointtarget j:=[[1,2,3,4,5,6],[9E9]];\n",
            "holds 1 poses .line 1. and 1 joints .line 2.: keep one kind",
        ),
        (
            "p.dtx",
            DTX + '<Value key="0" x="1" fatherId="a[0]" />\n<Value key="1" x="2" fatherId="b[0]" />\n</Data>',
            "points are of several frames",
        ),
        *(
            (name, f"{text}\n", f"line 2: .*{word}.* is a motion or pose relative to another one")
            for name, text, word in (
                ("p.mxprog", "MovePose(200,0,300,0,90,0)\nMoveLinRelWrf(0,0,50,0,0,0)", "MoveLinRelWrf"),
                ("p.src", "PTP {X 1,Y 2,Z 3,A 4,B 5,C 6}\nLIN_REL {X 0,Y 0,Z 9,A 0,B 0,C 0}", "LIN_REL"),
                ("p.drl", "movel(posx(1,2,3,4,5,6))\nmovel(posx(0,0,9,0,0,0), mod=DR_MV_MOD_REL)", "DR_MV_MOD_REL"),
                ("p.py", "a.set_position(1,2,3,4,5,6)\na.set_position(0,0,9,0,0,0, relative=True)", "relative=True"),
                ("p.src", "PTP {X 1,Y 2,Z 3,A 4,B 5,C 6} ; no LIN_REL {Z 1}\nLIN_REL {Z 9}", "LIN_REL"),
                ("p.drl", "movel(posx(1,2,3,4,5,6))\nmovel(posx(0,0,9,0,0,0), v=[9, 9], mod=1)", "mod=1"),
                ("p.drl", "movel(posx(1,2,3,4,5,6))\namovel(posx(0,0,9,0,0,0), ref=DR_TOOL)", "DR_TOOL"),
                ("p.drl", "movel(posx(1,2,3,4,5,6))\nmovel(trans(posx(1,2,3,4,5,6), [0,0,9,0,0,0]))", "trans"),
                ("p.mod", f"MODULE P\nMoveL RelTool({TARGET},0,0,100), v100, fine, tool0;", "RelTool"),
                ("p.py", "a.set_position(1,2,3,4,5,6)\na.set_tool_position(0,0,9,0,0,0)", "set_tool_position"),
                ("p.script", "movel(p[1,2,3,0,0,0])\nmovel(pose_trans(p1, p[0,0,0.1,0,0,0]))", "pose_trans"),
                ("p.script", "movel(p[1,2,3,0,0,0])\nmovel(pose_trans(get(),\n  p[0,0,0.1,0,0,0]))", "pose_trans"),
                ("p.src", "PTP {X 1,Y 2,Z 3,A 4,B 5,C 6}\nLIN P1:{X 0,Y 0,Z 9,A 0,B 0,C 0}", "P1:.X 0"),
                ("p.as", "POINT p1 = TRANS(1,2,3,4,5,6)\nLMOVE p1+TRANS(0,0,9,0,0,0)", "LMOVE p1"),
                ("p.prg", "Go XY(1,2,3,4,5,6)\nMove P1 +X(50)", "X"),
                ("p.prg", "P1=(1,2,3,4,5,6)(7,0)\nMvs P1*P2", "P1.P2"),
                (
                    "p.LS",
                    "/MN\n 1:L P[1] 100mm/sec FINE INC ;\n/POS\n" + rows(LS, MM, FIXED),
                    "P.1. 100mm/sec FINE INC",
                ),
            )
        ),
        (
            "p.py",
            "a.set_position(1,2,3,4,5,6)\na.set_position(1,2,3,0.1,0.2,0.3, is_radian=True)\n",
            "is_radian=True stands at some of its 2 points",
        ),
        ("a.yaml", "a: [1, 2\n", "not YAML"),
        ("a.json", '{"a": [1, 2}', "line 1: not JSON"),
        (
            "a.json",
            '{"image_width": 640, "image_height": 480}',
            "holds a mapping of image_width, image_height, and no poses",
        ),
        (
            "a.json",
            '[{"T": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}, {"T": "none"}]',
            "record 2 of 2 holds a mapping of T, and no pose",
        ),
        ("a.json", '[{"T": null}, null]', "and no poses"),
        (
            "a.csv",
            "x_m,y_m,z_m,qw,qx,qy,qz\n,,,,,,\nnan,1,2,1,0,0,0\n",
            "none of 2 rows has a pose; line 2: x_m is empty",
        ),
        (
            "a.json",
            json.dumps([{"a": np.eye(4).tolist(), "b": np.eye(4).tolist()}] * 2),
            "holds poses of a, b: say which, --columns pose=a",
        ),
        ("a.json", '{"x": {"rows": 10, "cols": 1, "data": "x"}}', "and no poses"),
        ("a.json", "[[[1, 2], [3]]]", "and no poses|holds"),
        ("a.json", "[[5]]", "and no poses"),
        ("a.json", '[{"name": ["j1"], "position": ["x"]}, {"name": ["j1"], "position": [[1, 2]]}]', "and no poses"),
        ("a.csv", "x,y,z,rx,ry,rz\n1 mm,2 mm,3 m,0,0,0\n4 m,5 mm,6 m,0,0,0\n", "column x has numbers in several units"),
        (
            "a.csv",
            csv("", XYZW, P),
            "the last four numbers are no quaternions, the first four are: the rotation comes before",
        ),
        ("a.csv", "1,2,3,4,5\n", "5 numbers without names.*--columns x_mm"),
    ],
)
def test_what_cannot_be_read_is_said_with_what_would_do(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_pose_table(tmp_path / name, rotation="wxyz" if name == "a.csv" and "0." in text else None)


def test_columns_in_order_and_by_name(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(csv("", P, XYZW))
    with pytest.raises(InputError, match="has 7 columns, --columns names 6"):
        read_pose_table(path, columns="x,y,z,qw,qx,qy")
    with pytest.raises(InputError, match="unknown name 'roll'"):
        read_pose_table(path, columns="x,y,z,roll,qx,qy,qz")
    both = tmp_path / "both.json"
    both.write_text(json.dumps([{"a": a.tolist(), "b": b.tolist()} for a, b in zip(A, B, strict=True)]))
    np.testing.assert_allclose(read_pose_table(both, columns="pose=b").Ts, B, atol=1e-12)
    assert not has_both(both)
    assert number("1e-05") == 1e-5
    assert number("1_000") is None
    assert np.isnan(number("nan"))


def test_a_stamp_that_is_none_is_passed_over(tmp_path):
    record = {"stamp": {"sec": "a", "nanosec": None}, "position": [0.1, 0.2, 0.3], "orientation_xyzw": [0, 0, 0, 1]}
    (tmp_path / "a.json").write_text(json.dumps([record] * 3))
    assert read_pose_table(tmp_path / "a.json").t_s is None


def test_arrays_of_both_sides_are_enough_alone(tmp_path):
    both, one = tmp_path / "both.npz", tmp_path / "one.npz"
    sides = {"R_gripper2base": A[:, :3, :3], "t_gripper2base": A[:, :3, 3]}
    np.savez(both, **sides, R_target2cam=B[:, :3, :3], t_target2cam=B[:, :3, 3])
    np.savez(one, **sides)
    assert has_both(both)
    assert not has_both(one)


@pytest.mark.parametrize(
    "form", ["json", "records", "sixteen", "columns of sixteen", "units", "four lines", "zeros", "zeros, four lines"]
)
def test_a_row_without_a_pose_stays_a_row_in_every_form(tmp_path, form):
    path, gone = tmp_path / "a.txt", 1
    nan = [0.0 if "zeros" in form else math.nan] * 16
    if form in ("json", "records"):
        path = tmp_path / "a.json"
        each = [None if k == gone else T.tolist() for k, T in enumerate(A)]
        path.write_text(json.dumps(each if form == "json" else [{"t_s": k, "T": T} for k, T in enumerate(each)]))
    elif form == "units":
        cells = [",,,,,," if k == gone else f"{p[0]} mm,{p[1]} mm,{p[2]} mm," + "{},{},{},{}" for k, p in enumerate(MM)]
        lines = [cell.format(*q) for cell, q in zip(cells, WXYZ, strict=True)]
        path.write_text("\n".join(["x,y,z,qw,qx,qy,qz", *lines]))
    else:
        Ts = [nan if k == gone else (T.T if "columns" in form else T).ravel() for k, T in enumerate(A)]
        np.savetxt(path, np.reshape(Ts, (-1, 4) if "four lines" in form else (-1, 16)), fmt="%.12f")
    table = read_pose_table(path, keep_missed=True)
    assert [k for k, why in enumerate(table.missed) if why] == [gone]
    kept = np.delete(np.arange(len(A)), gone)
    np.testing.assert_allclose(table.Ts[kept], A[kept], atol=1e-9)


def test_only_missed_rows_may_lack_a_name_and_their_notes_say_why(tmp_path):
    path = tmp_path / "a.csv"
    rows = ["x_m,y_m,z_m,qw,qx,qy,qz,image", "0.1,0.2,0.3,1,0,0,0,a", "0.1,inf,0.3,1,0,0,0,", "0.1,0.2,0.3,0,0,0,0,"]
    path.write_text("\n".join(rows))
    table = read_pose_table(path, keep_missed=True)
    assert table.missed == ("", "y_m is inf", "the rotation is all zeros")
    assert table.names == ("a", "", "")
    path.write_text("\n".join([*rows, "0.1,0.2,0.3,1,0,0,0,"]))
    with pytest.raises(InputError, match="line 5: image is empty"):
        read_pose_table(path)
