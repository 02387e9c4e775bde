"""The arms that come with armsight, by their makers' Denavit-Hartenberg tables; a new one is a row here.

``source`` says where lengths and limits are from. What is marked as chosen is not the maker's: accelerations that give full
speed in 0.25 s, jerks that give full acceleration in 0.1 s, and home poses off the singularities. The tool of an arm is its
flange, unless ``T_flange_tool`` says otherwise.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import pose
from armsight.robot.kinematics.arm import Arm


def _deg(*angles: float) -> Array:
    return np.deg2rad(angles)


def _m(*lengths: float) -> Array:
    return np.array(lengths)


#: The 6R arm of docs/concepts/method.md; its source gives no limits: those of a table-top arm are chosen.
_SIX_R = Arm(
    name="six_r",
    a=_m(0.0365, 0.2515, 0.125, 0.092, 0.0, 0.0),
    d=_m(0.438, 0.0, 0.0, 0.0, 0.0, 0.1528),
    alpha=_deg(-90.0, 0.0, 0.0, 90.0, -90.0, 0.0),
    home=_deg(0.0, 0.0, 0.0, 0.0, -90.0, 0.0),
    q_min=_deg(-170.0, -180.0, -150.0, -150.0, -170.0, -180.0),  # chosen
    q_max=_deg(170.0, 45.0, 150.0, 150.0, 170.0, 180.0),  # chosen; joint 2 downwards is positive
    qd_max=_deg(90.0, 90.0, 120.0, 150.0, 150.0, 180.0),  # chosen
    qdd_max=_deg(360.0, 360.0, 480.0, 600.0, 600.0, 720.0),  # chosen
    qddd_max=_deg(3600.0, 3600.0, 4800.0, 6000.0, 6000.0, 7200.0),  # chosen
    source="Application of Stereo Vision and ARM Processor for Motion Control, table 18.1; limits are chosen",
)
#: Standard table with Paul's signs of alpha, frame 0 at the shoulder; its home is "ready", both arms straight up.
_PUMA560 = Arm(
    name="puma560",
    a=_m(0.0, 0.4318, 0.0203, 0.0, 0.0, 0.0),
    d=_m(0.0, 0.0, 0.15005, 0.4318, 0.0, 0.0),
    alpha=_deg(90.0, 0.0, -90.0, 90.0, -90.0, 0.0),
    home=_deg(0.0, 90.0, -90.0, 0.0, 0.0, 0.0),
    q_min=_deg(-160.0, -45.0, -225.0, -110.0, -100.0, -266.0),
    q_max=_deg(160.0, 225.0, 45.0, 170.0, 100.0, 266.0),
    qd_max=_deg(80.0, 70.0, 120.0, 220.0, 240.0, 220.0),  # chosen
    qdd_max=_deg(320.0, 280.0, 480.0, 880.0, 960.0, 880.0),  # chosen
    qddd_max=_deg(3200.0, 2800.0, 4800.0, 8800.0, 9600.0, 8800.0),  # chosen
    source="Corke and Armstrong-Helouvry, ICRA 1994; limits Wang and Chen, 1991; speeds and beyond are chosen",
)
#: ABB IRB 120-3/0.6. At all zeros the upper arm is upright, the forearm level, and the flange looks along base +X as tool0.
_IRB120 = Arm(
    name="irb120",
    a=_m(0.0, 0.270, 0.070, 0.0, 0.0, 0.0),
    d=_m(0.290, 0.0, 0.0, 0.302, 0.0, 0.072),
    alpha=_deg(-90.0, 0.0, -90.0, 90.0, -90.0, 0.0),
    offset=_deg(0.0, -90.0, 0.0, 0.0, 0.0, 180.0),
    home=_deg(0.0, 0.0, 0.0, 0.0, 30.0, 0.0),  # chosen
    q_min=_deg(-165.0, -110.0, -110.0, -160.0, -120.0, -400.0),
    q_max=_deg(165.0, 110.0, 70.0, 160.0, 120.0, 400.0),
    qd_max=_deg(250.0, 250.0, 250.0, 320.0, 320.0, 420.0),
    qdd_max=_deg(1000.0, 1000.0, 1000.0, 1280.0, 1280.0, 1680.0),  # chosen
    qddd_max=_deg(10000.0, 10000.0, 10000.0, 12800.0, 12800.0, 16800.0),  # chosen
    source="ABB product specification IRB 120 (3HAC035960); accelerations and jerks are chosen",
)
#: AR4-MK3. ar4_ros_driver has the same lengths, but stands rotated by -90 degrees, rotates joint 1 the other way and moves
#: the forearm 7 mm sideways; its config/mk3.yaml and ar_macro.xacro give the limits.
_AR4 = Arm(
    name="ar4",
    a=_m(0.0642, 0.305, 0.0, 0.0, 0.0, 0.0),
    d=_m(0.16977, 0.0, 0.0, 0.22263, 0.0, 0.041),
    alpha=_deg(-90.0, 0.0, -90.0, 90.0, -90.0, 0.0),
    offset=_deg(0.0, -90.0, 0.0, 0.0, 0.0, 180.0),
    home=_deg(0.0, 0.0, 0.0, 0.0, 30.0, 0.0),  # chosen
    q_min=_deg(-170.0, -42.0, -89.0, -180.0, -105.0, -180.0),
    q_max=_deg(170.0, 90.0, 52.0, 180.0, 105.0, 180.0),
    qd_max=np.full(6, 1.0472),
    qdd_max=np.full(6, np.deg2rad(240.0)),  # chosen
    qddd_max=np.full(6, np.deg2rad(2400.0)),  # chosen
    source="Annin Robotics' table of the AR4-MK3; limits ar4_ros_driver; accelerations and jerks are chosen",
)
#: Of the SO-101, from joint 2 to 3 and from 3 to 4, along and across the printed parts, m; and the angles between.
_UPPER, _FORE = (0.11257, 0.028), (0.1349, 0.0052)
_UPPER_BEND, _FORE_BEND = (np.arctan2(across, along) for along, across in (_UPPER, _FORE))
_SO101_AXES = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: SO-101 follower; the gripper's jaw is no joint of the arm. Angles are 0 in the middle of their ranges, as LeRobot
#: calibrates them; the tool is the URDF's gripperframe, between the tips, with z where the gripper points. The SO-100 has
#: the same kinematics but for the gripper.
_SO101 = Arm(
    name="so101",
    a=_m(-0.0303992, np.hypot(*_UPPER), np.hypot(*_FORE), 0.0, 0.0),
    d=_m(-0.0542, -0.0182778, 0.0, 0.0181, -0.0611),
    alpha=_deg(-90.0, 0.0, 0.0, -90.0, 0.0),
    offset=np.array(
        [0.0, np.pi / 2 + _UPPER_BEND, np.pi / 2 - _UPPER_BEND - _FORE_BEND, np.pi / 2 + _FORE_BEND, np.pi]
    ),
    T_base_0=pose(_SO101_AXES, _m(0.0207909, -0.0230745, 0.0948817)),
    T_flange_tool=pose(_SO101_AXES, _m(-0.0079, -0.000218121, -0.0981274)),
    home=np.zeros(5),
    q_min=np.array([-1.91986, -1.74533, -1.69, -1.65806, -2.79253]),
    q_max=np.array([1.91986, 1.74533, 1.69, 1.65806, 2.79253]),
    qd_max=np.full(5, 3.0),  # chosen: the servo rotates at 4.7 rad/s without load at 7.4 V
    qdd_max=np.full(5, 15.0),  # chosen
    qddd_max=np.full(5, 150.0),  # chosen
    joint_names=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
    source="SO-ARM100 repository, so101_new_calib.urdf; speeds and beyond are chosen",
)


def _ur(name: str, a: tuple[float, float], d: tuple[float, float, float, float], *speeds_deg_s: float) -> Arm:
    """Return an arm of Universal Robots: lengths 2 and 3 of a, 1, 4, 5 and 6 of d, and the greatest speeds.

    Joint 6 of the UR3 and UR3e, which rotates without end, has the range of the others.
    """
    return Arm(
        name=name,
        a=_m(0.0, *a, 0.0, 0.0, 0.0),
        d=_m(d[0], 0.0, 0.0, *d[1:]),
        alpha=_deg(90.0, 0.0, 0.0, 90.0, -90.0, 0.0),
        home=_deg(0.0, -90.0, 90.0, -90.0, -90.0, 0.0),  # chosen: elbow bent, tool down
        q_min=np.full(6, -2 * np.pi),
        q_max=np.full(6, 2 * np.pi),
        qd_max=_deg(*speeds_deg_s),
        qdd_max=np.full(6, np.deg2rad(720.0)),  # chosen
        qddd_max=np.full(6, np.deg2rad(7200.0)),  # chosen
        joint_names=("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
        source="Universal Robots' article on DH parameters and user manual; accelerations and jerks are chosen",
    )


_SMALL, _MEDIUM, _LARGE = (180.0,) * 3 + (360.0,) * 3, (180.0,) * 6, (120.0,) * 2 + (180.0,) * 4
_UR10 = _ur("ur10", (-0.612, -0.5723), (0.1273, 0.163941, 0.1157, 0.0922), *_LARGE)
_UR5 = _ur("ur5", (-0.425, -0.39225), (0.089159, 0.10915, 0.09465, 0.0823), *_MEDIUM)
_URS = (
    _ur("ur3", (-0.24365, -0.21325), (0.1519, 0.11235, 0.08535, 0.0819), *_SMALL),
    _ur("ur3e", (-0.24355, -0.2132), (0.15185, 0.13105, 0.08535, 0.0921), *_SMALL),
    _ur("ur5e", (-0.425, -0.3922), (0.1625, 0.1333, 0.0997, 0.0996), *_MEDIUM),
    _ur("ur10e", (-0.6127, -0.57155), (0.1807, 0.17415, 0.11985, 0.11655), *_LARGE),
)
#: Of the xArm 6, from joint 2 to joint 3: across and along the upper arm, m.
_ACROSS, _ALONG = 0.0535, 0.2845
_BEND = np.arctan2(_ALONG, _ACROSS)
_XARM = "UFACTORY's article on kinematic parameters; limits xarm_ros2; jerks are chosen"
_XARM6 = Arm(
    name="xarm6",
    a=_m(0.0, 0.0, np.hypot(_ACROSS, _ALONG), 0.0775, 0.0, 0.076),
    d=_m(0.267, 0.0, 0.0, 0.3425, 0.0, 0.097),
    alpha=_deg(0.0, -90.0, 0.0, -90.0, 90.0, -90.0),
    offset=np.array([0.0, -_BEND, _BEND, 0.0, 0.0, 0.0]),
    convention="modified",
    home=_deg(0.0, -30.0, -60.0, 0.0, 90.0, 0.0),  # chosen: elbow bent, tool down
    q_min=np.array([-2 * np.pi, -2.059, -3.927, -2 * np.pi, -1.69297, -2 * np.pi]),
    q_max=np.array([2 * np.pi, 2.0944, 0.19198, 2 * np.pi, np.pi, 2 * np.pi]),
    qd_max=np.full(6, np.pi),
    qdd_max=np.full(6, np.deg2rad(1145.0)),
    qddd_max=np.full(6, np.deg2rad(11450.0)),  # chosen
    source=_XARM,
)
_XARM7 = Arm(
    name="xarm7",
    a=_m(0.0, 0.0, 0.0, 0.0525, 0.0775, 0.0, 0.076),
    d=_m(0.267, 0.0, 0.293, 0.0, 0.3425, 0.0, 0.097),
    alpha=_deg(0.0, -90.0, 90.0, 90.0, 90.0, 90.0, -90.0),
    convention="modified",
    home=_deg(0.0, -30.0, 0.0, 60.0, 0.0, 90.0, 0.0),  # chosen: elbow bent, tool down
    q_min=np.array([-2 * np.pi, -2.059, -2 * np.pi, -0.19198, -2 * np.pi, -1.69297, -2 * np.pi]),
    q_max=np.array([2 * np.pi, 2.0944, 2 * np.pi, 3.927, 2 * np.pi, np.pi, 2 * np.pi]),
    qd_max=np.full(7, np.pi),
    qdd_max=np.full(7, np.deg2rad(1145.0)),
    qddd_max=np.full(7, np.deg2rad(11450.0)),  # chosen
    source=_XARM,
)
#: Franka Emika Robot (Panda, FER), by the maker's own table, Craig's; its home is "ready" of the maker's examples.
_FRANKA = Arm(
    name="franka",
    a=_m(0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088),
    d=_m(0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0),
    alpha=_deg(0.0, -90.0, 90.0, 90.0, -90.0, 90.0, 90.0),
    convention="modified",
    T_flange_tool=pose(np.eye(3), _m(0.0, 0.0, 0.107)),
    home=_deg(0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0),
    q_min=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
    q_max=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
    qd_max=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
    qdd_max=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    qddd_max=np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
    source="Franka Control Interface documentation, robot and interface specifications",
)
#: KUKA LBR iiwa 14 R820; the tool is the media flange's face, 126 mm from the wrist, as in iiwa_stack.
_IIWA = Arm(
    name="iiwa",
    a=np.zeros(7),
    d=_m(0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.126),
    alpha=_deg(-90.0, 90.0, 90.0, -90.0, -90.0, 90.0, 0.0),
    home=_deg(0.0, 30.0, 0.0, -90.0, 0.0, 60.0, 0.0),  # chosen: elbow bent, tool down
    q_min=_deg(-170.0, -120.0, -170.0, -120.0, -170.0, -120.0, -175.0),
    q_max=_deg(170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0),
    qd_max=_deg(85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0),
    qdd_max=_deg(340.0, 340.0, 400.0, 300.0, 520.0, 540.0, 540.0),  # chosen
    qddd_max=_deg(3400.0, 3400.0, 4000.0, 3000.0, 5200.0, 5400.0, 5400.0),  # chosen
    source="KUKA specification LBR iiwa 14 R820; accelerations and jerks are chosen",
)
#: Name -> arm.
MODELS: dict[str, Arm] = {
    arm.name: arm
    for arm in (_SIX_R, _PUMA560, _UR5, _UR10, _IRB120, *_URS, _AR4, _SO101, _XARM6, _XARM7, _FRANKA, _IIWA)
}
