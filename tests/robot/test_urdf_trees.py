"""URDF trees as robots' makers publish them: rails, grippers, wheels and heads beside the arm; pinocchio is the oracle."""

from pathlib import Path

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.robot.arm_file import open_arm
from armsight.robot.urdf.read import read_urdf

pin = pytest.importorskip("pinocchio")
DATA = Path(__file__).parent / "data"
#: Origin and axis of seven joints of no special arm.
SEVEN = [
    ("0 0 0.3", "0 0 0", "0 0 1"),
    ("0 0.1 0", "-1.5707963267948966 0 0", "0 0 1"),
    ("0.02 -0.3 0", "1.5707963267948966 0 0", "0 0 1"),
    ("0.08 0 0", "1.5707963267948966 0 0", "0 1 0"),
    ("-0.08 0.38 0", "-1.5707963267948966 0 0.2", "0 0 1"),
    ("0 0 0.1", "1.5707963267948966 0 0", "0 0 -1"),
    ("0.088 0 0", "1.5707963267948966 0 0", "0 0 1"),
]
LIMIT = '<limit lower="-2.9" upper="2.9" velocity="2" effort="9"/>'


def joint(name, kind, parent, child, xyz="0 0 0", rpy="0 0 0", axis="0 0 1", more=None):
    more = (LIMIT if kind in ("revolute", "prismatic") else "") if more is None else LIMIT + more
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def serial(count, *, base="base_link", prefix="", kinds=None):
    """Joints 1 to count, the last one's link is link{count}."""
    links = [base, *(f"{prefix}link{k}" for k in range(1, count + 1))]
    return [
        joint(f"{prefix}joint{k + 1}", (kinds or {}).get(k + 1, "revolute"), links[k], links[k + 1], *SEVEN[k])
        for k in range(count)
    ]


def written(path, joints):
    """A URDF of joints; their links are those that they name."""
    text = "".join(joints)
    links = dict.fromkeys(part.split('"')[0] for part in text.split('link="')[1:])
    path.write_text('<robot name="r">' + "".join(f'<link name="{link}"/>' for link in links) + text + "</robot>")
    return path


def assert_as_pinocchio(path, tool, joints, spec=None):
    arm = open_arm(spec or path)
    assert arm.joint_names == tuple(joints)
    model = pin.buildModelFromUrdf(str(path))
    data, frame = model.createData(), model.getFrameId(tool)
    for q in np.random.default_rng(0).uniform(-1.5, 1.5, (5, len(joints))):
        full = pin.neutral(model)
        for name, angle in zip(joints, q, strict=True):
            one = model.joints[model.getJointId(name)]
            full[one.idx_q : one.idx_q + one.nq] = [angle] if one.nq == 1 else [np.cos(angle), np.sin(angle)]
        pin.framesForwardKinematics(model, data, full)
        np.testing.assert_allclose(arm.forward(q), data.oMf[frame].homogeneous, atol=1e-9)


def named(count, prefix=""):
    return [f"{prefix}joint{k}" for k in range(1, count + 1)]


#: What hangs behind link6 or link7 of known robots: joints, the link that is the tool then, and what is left out.
FLANGE = joint("f", "fixed", "link6", "tool0", "0 0 0.05")
GRIPPERS = {
    "two fingers, one a mimic (Franka's hand)": (
        [
            joint("hand_joint", "fixed", "link6", "hand", "0 0 0.1", "0 0 -0.785"),
            joint("tcp", "fixed", "hand", "hand_tcp", "0 0 0.1034"),
            joint("finger_joint1", "prismatic", "hand", "left", "0 0 0.0584", axis="0 1 0"),
            joint("finger_joint2", "prismatic", "hand", "right", more='<mimic joint="finger_joint1"/>'),
        ],
        "hand_tcp",
        "finger_joint1, finger_joint2",
    ),
    "a knuckle that mimics follow (xArm's gripper)": (
        [
            joint("eef", "fixed", "link6", "link_eef"),
            joint("base", "fixed", "link_eef", "gripper_base"),
            joint("drive_joint", "revolute", "gripper_base", "left_outer", "0 0.035 0.06", axis="1 0 0"),
            joint("lf", "revolute", "left_outer", "left_finger", more='<mimic joint="drive_joint"/>'),
            joint("rk", "revolute", "gripper_base", "right_outer", more='<mimic joint="drive_joint"/>'),
            joint("tcp", "fixed", "gripper_base", "link_tcp", "0 0 0.172"),
        ],
        "link_tcp",
        "drive_joint, lf, rk",
    ),
    "two-finger gripper behind tool0 (Universal Robots and Robotiq)": (
        [
            FLANGE,
            joint("ft", "fixed", "link6", "ft_frame"),
            joint("c", "fixed", "tool0", "robotiq_base", "0 0 0.01"),
            joint("finger_joint", "revolute", "robotiq_base", "lo", axis="1 0 0"),
            joint("ri", "continuous", "robotiq_base", "ro", more='<mimic joint="finger_joint" multiplier="-1"/>'),
        ],
        "tool0",
        "finger_joint, ri",
    ),
    "three fingers that move by themselves (Kinova Jaco)": (
        [
            joint("ee", "fixed", "link6", "end_effector", "0 0 -0.16", "3.14159265358979 0 0"),
            *(joint(f"joint_finger_{k}", "revolute", "link6", f"f{k}", f"0.0{k} 0 0") for k in (1, 2, 3)),
        ],
        "end_effector",
        "joint_finger_1, joint_finger_2, joint_finger_3",
    ),
}


@pytest.mark.parametrize("gripper", GRIPPERS)
def test_grippers_are_left_out_with_a_note(tmp_path, caplog, gripper):
    behind, tool, left_out = GRIPPERS[gripper]
    path = written(tmp_path / "arm.urdf", [*serial(6), *behind])
    assert_as_pinocchio(path, tool, named(6))
    assert f"the tool is {tool}; joints beside the arm are left out: {left_out}" in caplog.text


def test_what_stands_before_or_beside_the_arm_is_held_or_left_out(tmp_path, caplog):
    """As on Fetch: a lift before the arm, wheels and a head beside it, fingers behind it."""
    beside = [
        joint("r_wheel_joint", "continuous", "base_link", "r_wheel"),
        joint("torso_lift_joint", "prismatic", "base_link", "torso", "-0.08 0 0.37", axis="0 0 1"),
        joint("head_pan_joint", "revolute", "torso", "head_pan"),
        joint("head_tilt_joint", "revolute", "head_pan", "head_tilt"),
    ]
    arm = serial(7, base="torso", kinds={3: "continuous", 5: "continuous", 7: "continuous"})
    fingers = [
        joint("gripper_axis", "fixed", "link7", "gripper_link", "0.16 0 0"),
        *(joint(f"{side}_gripper_finger_joint", "prismatic", "gripper_link", side) for side in "rl"),
    ]
    assert_as_pinocchio(written(tmp_path / "f.urdf", [*beside, *arm, *fingers]), "gripper_link", named(7))
    assert "held at zero: torso_lift_joint" in caplog.text
    assert "left out: r_wheel_joint, head_pan_joint, head_tilt_joint, r_gripper_finger_joint, l_gripper" in caplog.text


def test_continuous_joints_have_a_revolution_either_way(tmp_path):
    assert_as_pinocchio(DATA / "continuous.urdf", "l6", [f"j{k}" for k in range(1, 7)])
    arm = read_urdf(DATA / "continuous.urdf")
    np.testing.assert_allclose([arm.q_min[0], arm.q_max[0]], [-2 * np.pi, 2 * np.pi])
    assert_as_pinocchio(written(tmp_path / "a.urdf", serial(6, kinds={1: "continuous"})), "link6", named(6))


@pytest.mark.parametrize("name", ["fingers", "robotiq"])
def test_a_gripper_on_tool0(name, caplog):
    path = DATA / f"{name}.urdf"
    for spec in (path, f"{path}#tool0"):
        assert_as_pinocchio(path, "tool0", [f"j{k}" for k in range(1, 7)], spec)
    np.testing.assert_allclose(
        open_arm(path).forward(np.radians([10, -20, 30, 40, 50, 60]))[:3, 3], [0.618408, -0.026581, 0.076793], atol=5e-7
    )
    assert_as_pinocchio(path, "camera_link", [f"j{k}" for k in range(1, 6)], f"{path}#camera_link") if name == (
        "fingers"
    ) else None


@pytest.mark.parametrize(
    ("joints", "said"),
    [
        ([*serial(5), joint("gripper", "revolute", "link5", "jaw")], "is a gripper's by its name.*#link5"),
        (
            [*serial(4, prefix="l_"), *serial(4, prefix="r_")],
            "holds 2 arms: give the link that is the tool, .*#l_link4, or r_link4",
        ),
        (
            [*serial(2), joint("z", "prismatic", "link2", "quill"), joint("w", "revolute", "quill", "hand")],
            "only arms of 4 to 7 rotary joints are read here; 'z' is prismatic",
        ),
        (
            [*serial(4), joint("z", "prismatic", "link4", "quill"), joint("w", "revolute", "quill", "hand")],
            "'z' is prismatic: give the link that is the tool, .*#link4",
        ),
        (
            [*serial(6), joint("a", "revolute", "link6", "x"), joint("b", "revolute", "link6", "y")],
            "do not follow one another.*#x, or y, or link6",
        ),
        ([*serial(3), joint("j4", "revolute", "link3", "l4", more='<mimic joint="joint2"/>')], "'j4' is a mimic"),
    ],
)
def test_what_is_no_one_arm_is_said_with_the_links_to_choose_from(tmp_path, joints, said):
    with pytest.raises(InputError, match=said):
        read_urdf(written(tmp_path / "a.urdf", joints))


@pytest.mark.parametrize("encoding", ["iso-8859-1", "windows-1252", "utf-16", "utf-16-be", "gb2312", "shift_jis"])
def test_xml_is_read_in_the_encoding_that_it_declares(tmp_path, encoding):
    note = "90° about x" if "8859" in encoding or "1252" in encoding else "关节" if encoding == "gb2312" else "関節"
    head = f'<?xml version="1.0" encoding="{encoding.removesuffix("-be")}"?><!-- {note} -->'
    path = tmp_path / "arm.urdf"
    path.write_bytes((head + (DATA / "continuous.urdf").read_text().partition("?>")[2]).encode(encoding))
    np.testing.assert_array_equal(read_urdf(path).table, read_urdf(DATA / "continuous.urdf").table)
    path.write_text(
        '<?xml version="1.0" encoding="utf-16"?>' + (DATA / "continuous.urdf").read_text().partition("?>")[2]
    )
    np.testing.assert_array_equal(read_urdf(path).table, read_urdf(DATA / "continuous.urdf").table)  # it is UTF-8
    for name in ("klingon", "zlib", "undefined"):
        path.write_text(f'<?xml version="1.0" encoding="{name}"?><robot/>')
        with pytest.raises(InputError, match=f"declares encoding '{name}', which is not known"):
            read_urdf(path)
