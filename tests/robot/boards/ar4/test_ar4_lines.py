"""The lines of the AR4's Teensy: worked examples of its firmware, both ways, and lines with anything in them."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from armsight.geometry.pose import inverse
from armsight.robot.arm_file import open_arm
from armsight.robot.boards.ar4 import lines
from armsight.robot.boards.ar4.lines import Ar4Start, Ar4Stopped, Ar4Text, Ar4Values, Heading, LineReader, read_line
from armsight.robot.boards.ar4.models import MODELS, SENSE


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (lines.start("2.1.0", "mk3"), b"STA2.1.0Bmk3\n"),
        (lines.POSITIONS, b"JP\n"),
        (lines.SPEEDS, b"JV\n"),
        (lines.RESET_STOP, b"RE\n"),
        (lines.home("0012345"), b"JC0012345\n"),
        (lines.move([1, -2.5, 0, 4, 5, -6]), b"MTA1.000000B-2.500000C0.000000D4.000000E5.000000F-6.000000\n"),
        (lines.move([0.0] * 6, speeds=True), b"MVA0.000000B0.000000C0.000000D0.000000E0.000000F0.000000\n"),
    ],
)
def test_what_is_sent(line, text):
    assert line == text


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("STA1B2.1.0C1Dmk3", Ar4Start(True, "2.1.0", True, "mk3")),
        ("STA0B2.0.4C0D", Ar4Start(False, "2.0.4", False, "")),
        ("JPA-170.5B1.000000C2D3E4F5", Ar4Values(Heading.POSITIONS, (-170.5, 1, 2, 3, 4, 5))),
        ("JVA0.0B0.0C0.0D0.0E0.0F-0.5", Ar4Values(Heading.SPEEDS, (0, 0, 0, 0, 0, -0.5))),
        (
            "JCA76119B-23230C28757D-89498E-11242F39897",
            Ar4Values(Heading.HOMED, (76119, -23230, 28757, -89498, -11242, 39897)),
        ),
        ("ES0", Ar4Stopped(False)),
        ("ES1", Ar4Stopped(True)),
        ("ER: Failed to move to limit switches.", Ar4Text(Heading.ERROR, "Failed to move to limit switches.")),
        ("WN: Failed to return", Ar4Text(Heading.WARNING, "Failed to return")),
        ("ES2", None),
        ("JPA1B2C3D4E5", None),
        ("JPA1B2C3D4E5Fx", None),
        ("STA1", None),
        ("XX1", None),
        ("", None),
    ],
)
def test_what_is_read(line, answer):
    assert read_line(line) == answer


numbers = st.floats(-400, 400).map(lambda value: round(value, 6))


@settings(deadline=None, max_examples=50)
@given(st.lists(numbers, min_size=6, max_size=6))
def test_positions_come_back_as_they_were_sent(values):
    text = lines.move(values).decode().strip()
    read = read_line("JP" + text[2:])
    assert read.values == pytest.approx(values, abs=1e-6)


@settings(deadline=None, max_examples=50)
@given(st.binary(max_size=300), st.integers(1, 20))
def test_any_bytes_are_lines_or_none(data, size):
    reader = LineReader()
    for at in range(0, len(data), size):
        for line in reader.take(data[at : at + size]):
            read_line(line)


def test_a_line_without_an_end_is_dropped():
    reader = LineReader()
    assert reader.take(b"x" * 5000) == []
    assert reader.take(b"\nJP\r\n") == ["JP"]
    assert reader.broken == 1


def test_the_models_limits_and_steps():
    mk3 = MODELS["mk3"]
    # REST_MOTOR_STEPS of the firmware is where all joints are at 0.
    rest = [7555, 2333, 4944, 8960, 2295, 4000]
    direction = [-1, 1, 1, 1, 1, 1]
    reported = [rest[k] * direction[k] / mk3.steps_per_deg[k] for k in range(6)]
    assert reported + mk3.offset_deg == pytest.approx(0.0, abs=0.05)
    # joint_offsets/mk2.yaml of the driver.
    assert MODELS["mk2"].offset_deg.tolist() == [170, -42, -89, -165, -105, -155]


def test_joint_angles_are_those_of_our_ar4_and_joint_1_has_the_other_sense_in_the_drivers_urdf():
    # annin_ar4_description/urdf/ar_macro.xacro: origin (xyz, rpy) and axis; without its 7 mm sideways at joint 3.
    half = np.pi / 2
    chain = [
        ((0, 0, 0), (np.pi, 0, 0), (0, 0, 1)),
        ((0, 0.0642, -0.16977), (half, 0, -half), (0, 0, -1)),
        ((0, -0.305, 0), (0, 0, np.pi), (0, 0, -1)),
        ((0, 0, 0), (half, 0, -half), (0, 0, -1)),
        ((0, 0, -0.22263), (np.pi, 0, -half), (1, 0, 0)),
        ((0, 0, 0.041), (0, 0, np.pi), (0, 0, 1)),
    ]

    def driver(q):
        T = np.eye(4)
        for (xyz, rpy, axis), angle in zip(chain, q, strict=True):
            step = np.eye(4)
            step[:3, 3] = xyz
            step[:3, :3] = (Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec(angle * np.array(axis))).as_matrix()
            T = T @ step
        return T

    arm, rng = open_arm("ar4"), np.random.default_rng(1)
    q = rng.uniform(-0.6, 0.6, (5, 6))
    ours, theirs = arm.forward(SENSE * q), np.array([driver(each) for each in q])
    # The bases differ by a rotation about z, the flanges by a constant transform.
    base = np.eye(4)
    base[:2, :2] = [[0, 1], [-1, 0]]
    flange = inverse(base @ ours[0]) @ theirs[0]
    assert base @ ours @ flange == pytest.approx(theirs, abs=1e-9)
    assert base @ arm.forward(q) @ flange != pytest.approx(theirs, abs=1e-2)
