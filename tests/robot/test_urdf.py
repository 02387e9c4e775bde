"""URDF: what is written comes back to the last digit; what no table holds, and what is malformed, is rejected by name."""

import itertools
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import strategies as ours
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.robot.kinematics.arm import Arm
from armsight.robot.models import MODELS
from armsight.robot.urdf.read import decompose, read_urdf
from armsight.robot.urdf.write import urdf_text, write_urdf

SIX_R = MODELS["six_r"]
TABLE = ("a", "d", "alpha", "offset", "direction", "T_base_0", "T_flange_tool")
LIMITS = ("q_min", "q_max", "qd_max", "qdd_max", "qddd_max", "home")


def probes(n=50, seed=0, joints=6):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, joints))


def returned(arm, tmp_path):
    path = tmp_path / "arm.urdf"
    write_urdf(arm, path)
    return read_urdf(path)


def chain_pose(path, q):
    """The tool by the URDF itself: every joint's origin, then its rotation, up to the last link (slow and obvious)."""
    T, angles = np.eye(4), iter(q)
    joints = {joint.find("parent").get("link"): joint for joint in ET.parse(path).getroot().findall("joint")}
    link = (set(joints) - {joint.find("child").get("link") for joint in joints.values()}).pop()
    while link in joints:
        joint = joints[link]
        origin = joint.find("origin")
        xyz, rpy = (np.array(origin.get(key, "0 0 0").split(), float) for key in ("xyz", "rpy"))
        T = T @ pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)
        if joint.get("type") == "revolute":
            axis = np.array(joint.find("axis").get("xyz").split(), float)
            T = T @ pose(Rotation.from_rotvec(axis / np.linalg.norm(axis) * next(angles)).as_matrix(), np.zeros(3))
        link = joint.find("child").get("link")
    return T


@pytest.mark.parametrize("name", MODELS)
def test_a_model_comes_back_with_the_same_table(name, tmp_path):
    arm = MODELS[name]
    back = returned(arm, tmp_path)
    for field in (*(TABLE if arm.convention == "standard" else ()), *LIMITS):
        np.testing.assert_allclose(getattr(back, field), getattr(arm, field), atol=1e-15, err_msg=field)
    assert (back.name, back.joint_names, back.source) == (arm.name, arm.joint_names, arm.source)
    many = probes(joints=arm.joints)
    np.testing.assert_allclose(back.forward(many), arm.forward(many), atol=1e-12)
    for q in probes(5, joints=arm.joints):
        np.testing.assert_allclose(chain_pose(tmp_path / "arm.urdf", q), arm.forward(q), atol=1e-12)


RIGHT = st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi])
LENGTHS = st.one_of(st.just(0.0), ours.finite(-1, 1).filter(lambda x: abs(x) > 1e-3))


@st.composite
def arms(draw):
    """Arms of any table: right angles and others, no lengths and others, either direction, either convention."""
    alpha = [draw(st.one_of(RIGHT, ours.finite(0.05, 3.0))) for _ in range(6)]
    return replace(
        SIX_R,
        a=np.array([draw(LENGTHS) for _ in range(6)]),
        d=np.array([draw(LENGTHS) for _ in range(6)]),
        alpha=np.array(alpha),
        offset=np.array([draw(st.one_of(RIGHT, ours.finite(-3, 3))) for _ in range(6)]),
        direction=np.array([draw(st.sampled_from([1.0, -1.0])) for _ in range(6)]),
        convention=draw(st.sampled_from(["standard", "modified"])),
        T_base_0=draw(st.one_of(st.just(np.eye(4)), ours.poses(0.5))),
        T_flange_tool=draw(st.one_of(st.just(np.eye(4)), ours.poses(0.5))),
    )


@given(arms())
def test_any_arm_comes_back_with_the_same_forward_kinematics(arm):
    with tempfile.TemporaryDirectory() as folder:
        back = returned(arm, Path(folder))
    np.testing.assert_allclose(back.forward(probes(20)), arm.forward(probes(20)), atol=1e-12)


@given(arms())
def test_a_standard_table_comes_back_where_it_is_unique(arm):
    arm = replace(arm, convention="standard")
    with tempfile.TemporaryDirectory() as folder:
        back = returned(arm, Path(folder))
    for field in ("a", "d"):
        np.testing.assert_allclose(getattr(back, field), getattr(arm, field), atol=1e-12, err_msg=field)
    for field in ("alpha", "offset"):
        apart = np.remainder(getattr(back, field) - getattr(arm, field) + 1.0, 2 * np.pi) - 1.0
        np.testing.assert_allclose(apart, 0, atol=1e-12, err_msg=field)
    assert (back.direction == arm.direction).all()


def moved(text, rng):
    """The same arm with its frames put anywhere: links rotated and shifted, axes no longer along z."""
    robot = ET.fromstring(text)
    frames = {"base": np.eye(4), "tool": np.eye(4)}
    for joint in robot.findall("joint"):
        parent, child = (joint.find(tag).get("link") for tag in ("parent", "child"))
        origin = joint.find("origin")
        xyz, rpy = (np.array(origin.get(key).split(), float) for key in ("xyz", "rpy"))
        T = pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)
        # A child's new frame must stay on its joint's axis: rotate it anyhow, shift it along the axis.
        R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        F = frames.setdefault(child, pose(R, np.array([0, 0, rng.normal() * 0.1])))
        T = np.linalg.inv(frames[parent]) @ T @ F
        origin.set("xyz", " ".join(map(repr, map(float, T[:3, 3]))))
        origin.set("rpy", " ".join(map(repr, map(float, Rotation.from_matrix(T[:3, :3]).as_euler("xyz")))))
        axis = joint.find("axis")
        if axis is not None:
            axis_new = F[:3, :3].T @ np.array(axis.get("xyz").split(), float)
            axis.set("xyz", " ".join(map(repr, map(float, 2.5 * axis_new))))
    return ET.tostring(robot, encoding="unicode")


@pytest.mark.parametrize(("name", "seed"), list(itertools.product(MODELS, range(3))))
def test_the_table_is_found_whatever_frames_the_file_uses(name, seed, tmp_path):
    arm = MODELS[name]
    path = tmp_path / "arm.urdf"
    path.write_text(moved(urdf_text(arm), np.random.default_rng(seed)))
    back = read_urdf(path)
    many = probes(joints=arm.joints)
    np.testing.assert_allclose(back.forward(many), arm.forward(many), atol=1e-9)


@given(ours.poses(1.0))
def test_a_step_between_axes_is_split_exactly(C):
    step = decompose(C)
    sine = np.hypot(C[0, 2], C[1, 2])
    if 0 < sine < 1e-3:  # the common normal of nearly parallel axes is far away
        return

    def rotation(axis, angle):
        return pose(Rotation.from_euler(axis, angle).as_matrix(), np.zeros(3))

    def shift(x, z):
        return pose(np.eye(3), np.array([x, 0, z]))

    made = (
        rotation("z", step.beta)
        @ shift(step.a, step.d)
        @ rotation("x", step.alpha)
        @ shift(0, step.e)
        @ rotation("z", step.gamma)
    )
    np.testing.assert_allclose(made, C, atol=1e-14 / max(sine, 1e-3) ** 2)


def changed(old, new, count=1):
    text = urdf_text(SIX_R)
    assert old in text
    return text.replace(old, new, count)


RPY = 'rpy="-1.5707963267948966 0.0 0.0"'
#: Entities that grow to 20 MB.
BOMB = (
    '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {b} "{8 * f"&{a};"}">' for a, b in itertools.pairwise("abcdefgh"))
    + ']><robot name="&h;"/>'
)
PRISMATIC = (
    '<link name="finger"/><joint name="grip" type="{}"><parent link="tool"/><child link="finger"/>'
    '<limit lower="0" upper="1" velocity="1"/></joint></robot>'
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "not XML: no element found"),
        ("<robot", "not XML"),
        ("<arm/>", "outermost element is <arm>, must be <robot>"),
        ("<robot name='x'/>", "0 rotary joints"),
        (changed("<link", '<xacro:x xmlns:xacro="http://www.ros.org/wiki/xacro"/><link'), "expand them first"),
        (changed('name="joint2"', ""), "a <joint> has no name"),
        (changed('type="revolute"', 'type="rotary"'), "joint 'joint1': type 'rotary' is unknown"),
        (changed('name="joint3" type="revolute"', 'name="joint3" type="prismatic"'), "'joint3' is prismatic"),
        (changed('type="revolute"', 'type="fixed"'), "must be 5 numbers"),
        (changed("</robot>", PRISMATIC.format("revolute")), "joint 'grip' is a gripper's by its name"),
        (changed('<axis xyz="0 0 1" />', '<axis xyz="0 0 1"/><mimic joint="joint2"/>'), "'joint1' is a mimic"),
        (changed('<parent link="link1" />', ""), "joint 'joint2': no <parent link=\"...\">"),
        (changed('<parent link="link1" />', '<parent link="elbow" />'), "joint 'joint2': there is no link 'elbow'"),
        (
            changed('<child link="link2" />', '<child link="link3" />'),
            "link 'link3' hangs on two joints, 'joint2' and 'joint3'",
        ),
        (changed('<parent link="base" />', '<parent link="tool" />'), "hangs on itself|do not follow"),
        (changed('<parent link="link3" />', '<parent link="link1" />'), "do not follow one another"),
        (changed(RPY, 'rpy="-1.57 0"'), "joint 'joint2': <origin rpy=\"-1.57 0\"> must be 3 numbers"),
        (changed(RPY, 'rpy="a b c"'), "must be 3 numbers"),
        (changed(RPY, 'rpy="0 0 nan"'), "must be 3 numbers"),
        (changed(RPY, 'quat_xyzw="0 0 0 1"'), "joint 'joint2': <origin> has quat_xyzw, which needs <robot version"),
        *(
            (
                changed("<robot", f'<robot version="{old}"').replace(RPY, 'quat_xyzw="0 0 0 1"'),
                "which needs <robot version",
            )
            for old in ("0.9", "1.0", "1", "1.00", " 1.0 ", "", "abc", "1.1.0", "-1.1")
        ),
        (changed("<robot", '<robot version="1.1"').replace(RPY, f'{RPY} quat_xyzw="0 0 0 1"'), "and no rpy beside it"),
        (changed("<robot", '<robot version="1.1"').replace(RPY, 'quat_xyzw="0 0 1"'), "must be 4 numbers"),
        (changed("<robot", '<robot version="1.1"').replace(RPY, 'quat_xyzw="0 0 0 0"'), "quat_xyzw of length zero"),
        (changed('xyz="0 0 1"', 'xyz="0 0 0"'), "joint 'joint1': <axis> is zero"),
        (changed("<limit", "<boundary"), "not XML|no <limit>"),
        (
            changed('lower="-2.9670597283903604"', 'lower="9"'),
            r"joint 'joint1': <limit> goes from lower=9 to upper=2.96",
        ),
        (changed('lower="-2.9670597283903604"', 'lower="x"'), "joint 'joint1': <limit lower=\"x\"> must be a number"),
        (changed('velocity="1.5707963267948966"', ""), "joint 'joint1': <limit> has no velocity"),
        (
            changed('velocity="1.5707963267948966"', 'velocity="0"'),
            "joint 'joint1': <limit> velocity=0 must be more than 0",
        ),
        (changed('<link name="link2">', '<link name="link1">'), "two links are called 'link1'"),
        (changed('name="joint2"', 'name="joint1"'), "two joints are called 'joint1'"),
        (
            changed('upper="2.9670597283903604"', 'upper="170"'),
            "q_max has an angle of more than 20 rad; are these degrees",
        ),
        (BOMB, "not XML|0 rotary joints"),
        (changed("home_rad", "home_deg"), '<armsight>: home_rad="" must be 6 numbers'),
    ],
)
def test_a_malformed_file_is_rejected_in_one_line_that_names_the_element(text, said, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as found:
        read_urdf(path)
    assert str(found.value).startswith(str(path))
    assert "\n" not in str(found.value)


def test_files_that_are_none_are_rejected(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_urdf(tmp_path / "none.urdf")
    (tmp_path / "b.urdf").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_urdf(tmp_path / "b.urdf")


def tilted(arm, sizes, seed=0):
    """URDF text of an arm whose joints' origins are rotated a little, and its forward kinematics as a plain product."""
    rng, robot = np.random.default_rng(seed), ET.fromstring(urdf_text(arm))
    frames = []
    for i, joint in enumerate(robot.findall("joint")):
        origin = joint.find("origin")
        rotation = Rotation.from_euler("xyz", [float(word) for word in origin.get("rpy").split()])
        if 0 < i < 6:
            rotation = rotation * Rotation.from_rotvec(rng.normal(0, sizes, 3))
            origin.set("rpy", " ".join(repr(float(v)) for v in rotation.as_euler("xyz")))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.as_matrix(), [float(word) for word in origin.get("xyz").split()]
        frames.append(T)

    def forward(q):
        out = np.eye(4)
        for i, T in enumerate(frames):
            spin = np.eye(4)
            if i < 6:
                spin[:3, :3] = Rotation.from_rotvec([0, 0, arm.direction[i] * q[i]]).as_matrix()
            out = out @ T @ spin
        return out

    return ET.tostring(robot, encoding="unicode"), forward


@pytest.mark.parametrize("size", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("name", ["six_r", "puma560"])
def test_axes_a_little_off_parallel_are_read_exactly_and_inverted(name, size, tmp_path):
    text, forward = tilted(MODELS[name], size)
    (tmp_path / "arm.urdf").write_text(text)
    arm = read_urdf(tmp_path / "arm.urdf")
    found = 0
    for q in np.random.default_rng(1).uniform(np.maximum(arm.q_min, -2), np.minimum(arm.q_max, 2), (10, 6)):
        T = forward(q)
        np.testing.assert_allclose(arm.forward(q), T, atol=1e-9)
        best = arm.inverse(T, near=q).best
        found += best is not None and np.abs(best - q).max() < 1e-6
    assert found >= 9  # one may be next to a singularity
    # The common normals of such axes are metres away: an arm's size is that of its links all the same.
    assert arm.size_m == pytest.approx(MODELS[name].size_m, rel=0.03)


def test_axes_too_near_to_parallel_for_any_digits_are_rejected(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(changed('xyz="0.2515 0.0 0.0" rpy="0.0 0.0 0.0"', 'xyz="0.2515 0.1 0.0" rpy="0.00000001 0.0 0.0"'))
    with pytest.raises(InputError, match=r"joints 'joint2' and 'joint3' are 5.7e-07 deg from parallel"):
        read_urdf(path)
    path.write_text(changed(RPY, 'rpy="-1.5707963268 0.0 0.0"'))
    np.testing.assert_allclose(read_urdf(path).forward(probes()), SIX_R.forward(probes()), atol=1e-9)


def test_the_tool_must_be_named_where_several_links_end_the_chain(tmp_path):
    path = tmp_path / "arm.urdf"
    camera = (
        '<link name="eye"/><joint name="mount" type="fixed"><parent link="flange"/><child link="eye"/>'
        '<origin xyz="0 0.05 0.1" rpy="0 0 0"/></joint></robot>'
    )
    path.write_text(changed("</robot>", camera))
    with pytest.raises(InputError, match=r"several links end the chain.*#tool, or eye"):
        read_urdf(path)
    with pytest.raises(InputError, match=r"link 'hand' is not behind 4 to 7 rotary joints alone; these are: tool, eye"):
        read_urdf(path, tool_link="hand")
    T = pose(np.eye(3), np.array([0, 0.05, 0.1]))
    seen = read_urdf(path, tool_link="eye").forward(probes())
    np.testing.assert_allclose(seen, SIX_R.forward(probes()) @ T, atol=1e-12)
    np.testing.assert_allclose(read_urdf(path, tool_link="tool").forward(probes()), SIX_R.forward(probes()), atol=1e-12)
    flange = read_urdf(path, tool_link="flange").forward(probes())
    np.testing.assert_allclose(flange, SIX_R.forward(probes()), atol=1e-12)


def test_what_plain_urdf_leaves_out_is_filled_in(tmp_path):
    path = tmp_path / "arm.urdf"
    robot = ET.fromstring(urdf_text(SIX_R))
    robot.remove(robot.find("armsight"))
    for limit in robot.iter("limit"):
        for key in ("acceleration", "deceleration", "jerk"):
            del limit.attrib[key]
    path.write_text(ET.tostring(robot, encoding="unicode"))
    arm = read_urdf(path)
    assert isinstance(arm, Arm)
    np.testing.assert_allclose(arm.qdd_max, arm.qd_max / 0.25)
    np.testing.assert_allclose(arm.qddd_max, arm.qdd_max / 0.1)
    assert (arm.home == 0).all()
    assert arm.source == "URDF arm.urdf"


@pytest.mark.parametrize("version", ["1.1", "1.2"])
def test_origins_with_quaternions_are_those_with_angles(version, tmp_path):
    path = tmp_path / "arm.urdf"
    write_urdf(SIX_R, path)
    robot = ET.parse(path).getroot()
    robot.set("version", version)
    for origin in robot.iterfind("joint/origin"):
        angles = np.array(origin.attrib.pop("rpy").split(), float)
        origin.set("quat_xyzw", " ".join(map(repr, (2 * Rotation.from_euler("xyz", angles).as_quat()).tolist())))
    expected = [chain_pose(path, q) for q in probes(5)]
    path.write_text(ET.tostring(robot, encoding="unicode"))
    np.testing.assert_allclose(read_urdf(path).forward(probes(5)), expected, atol=1e-12)
    pinocchio = pytest.importorskip("pinocchio")
    peer = pinocchio.buildModelFromUrdf(str(path))
    data = peer.createData()
    for q, T in zip(probes(5), expected, strict=True):
        pinocchio.framesForwardKinematics(peer, data, q)
        np.testing.assert_allclose(data.oMf[peer.getFrameId("tool")].homogeneous, T, atol=1e-12)


def test_nothing_half_written_is_left(tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        write_urdf(SIX_R, tmp_path / "none" / "arm.urdf")
    assert list(tmp_path.iterdir()) == []


#: UR5 as its makers' ROS description has it: where each joint stands (xyz, rpy) and its axis; angles of twelve digits.
UR5_ROS = (
    ("shoulder_pan", "0 0 0.089159", "0 0 0", "0 0 1"),
    ("shoulder_lift", "0 0.13585 0", "0 1.57079632679 0", "0 1 0"),
    ("elbow", "0 -0.1197 0.425", "0 0 0", "0 1 0"),
    ("wrist_1", "0 0 0.39225", "0 1.57079632679 0", "0 1 0"),
    ("wrist_2", "0 0.093 0", "0 0 0", "0 0 1"),
    ("wrist_3", "0 0 0.09465", "0 0 0", "0 1 0"),
)


def test_an_arm_as_ros_describes_it_is_the_one_of_the_makers_table(tmp_path, caplog):
    rows = ['<link name="world"/><link name="base_link"/><link name="base"/><link name="tool0"/><link name="ee_link"/>']
    links = '<parent link="{0}"/><child link="{1}"/>'
    fixed = '<joint name="{0}-{1}" type="fixed">' + links + '<origin xyz="{2}" rpy="{3}"/></joint>'
    rows += [fixed.format("world", "base_link", "0 0 0", "0 0 0")]
    rows += [fixed.format("base_link", "base", "0 0 0", "0 0 -3.14159265359")]
    rows += [fixed.format("wrist_3", "ee_link", "0 0.0823 0", "0 0 1.57079632679")]
    rows += [fixed.format("wrist_3", "tool0", "0 0.0823 0", "-1.57079632679 0 0")]
    parent = "base_link"
    for name, xyz, rpy, axis in UR5_ROS:
        rows.append(
            f'<link name="{name}"/><joint name="{name}_joint" type="revolute"><parent link="{parent}"/>'
            f'<child link="{name}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            '<limit lower="-6.28318530718" upper="6.28318530718" velocity="3.15" effort="150"/></joint>'
        )
        parent = name
    rows.append('<transmission name="t"><joint name="elbow_joint"/></transmission>')
    path = tmp_path / "ur5.urdf"
    path.write_text(f'<robot name="ur5" xmlns:xacro="http://wiki.ros.org/xacro">{"".join(rows)}</robot>')
    arm = read_urdf(path)  # at tool0, the flange by REP 199
    assert "#LINK names another: ee_link" in caplog.text
    assert (read_urdf(path, tool_link="tool0").table == arm.table).all()
    base = pose(Rotation.from_euler("z", -np.pi).as_matrix(), np.zeros(3))
    # Each of seven angles is 5e-12 rad off, a metre or less from the tool.
    off = np.linalg.inv(base) @ arm.forward(probes()) - MODELS["ur5"].forward(probes())
    assert np.abs(off).max() < 7 * 5e-12
    assert len(arm.inverse(arm.forward(np.array([0.3, -1.2, 1.4, -0.5, 1.0, 0.2])))) == 8


@pytest.mark.parametrize("name", MODELS)
def test_a_written_arm_loads_in_mujoco_and_can_hold_itself(name):
    mujoco = pytest.importorskip("mujoco")
    arm = MODELS[name]
    text = urdf_text(arm)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    assert model.njnt == arm.joints
    assert (model.body_mass[1:] > 0).all()
    assert (model.body_inertia[1:] > 0).all()
    np.testing.assert_allclose(model.jnt_range, np.column_stack([arm.q_min, arm.q_max]), atol=1e-12)
    efforts = model.jnt_actfrcrange[:, 1]
    assert (efforts > 0).all()
    rng = np.random.default_rng(1)
    data.qpos[:] = arm.home
    mujoco.mj_forward(model, data)
    T_6_tool = np.linalg.inv(pose(data.xmat[-1].reshape(3, 3), data.xpos[-1])) @ arm.forward(arm.home)
    for q in rng.uniform(arm.q_min, arm.q_max, (50, arm.joints)):
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(model, data)
        at = pose(data.xmat[-1].reshape(3, 3), data.xpos[-1])  # of link 6: flange and tool are fused with it
        np.testing.assert_allclose(at @ T_6_tool, arm.forward(q), atol=1e-12)
        assert (np.abs(data.qfrc_bias) < efforts).all()  # what gravity asks for


def test_every_link_that_moves_has_a_shape_and_the_file_says_that_they_are_stand_ins():
    text = urdf_text(SIX_R)
    assert "masses, inertias, efforts and shapes are stand-ins" in text
    links = ET.fromstring(text).findall("link")
    shaped = {link.get("name") for link in links if link.find("visual/geometry/cylinder") is not None}
    assert shaped >= {f"link{i}" for i in range(1, 7)}
    sizes = [float(c.get(key)) for c in ET.fromstring(text).iter("cylinder") for key in ("radius", "length")]
    assert min(sizes) > 0


@pytest.mark.parametrize(
    ("key", "factor", "says"),
    [("xyz", 1e3, "look like mm; write metres"), ("rpy", 180 / np.pi, "expected are radians")],
)
def test_units_that_urdf_does_not_have_are_rejected(tmp_path, key, factor, says):
    path = tmp_path / "arm.urdf"
    write_urdf(MODELS["ur5e"], path)
    tree = ET.parse(path)
    for origin in tree.iter("origin"):
        origin.set(key, " ".join(str(factor * float(word)) for word in origin.get(key, "0 0 0").split()))
    tree.write(path)
    with pytest.raises(InputError, match=says):
        read_urdf(path)
