"""An emulated board whose joints are read by encoders: zero, motion, faults, the same bits on host and processor."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from board_rigs import written

from armsight.data import JointCommand
from armsight.errors import ArmsightError, InputError
from armsight.robot.board_registry import configured
from armsight.robot.boards.board_file import configuration_text, read_configuration
from armsight.robot.boards.codes import Command, Fault, SensorKind
from armsight.robot.boards.configuration import lab_configuration
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.robot.boards.reports import BoardAbilities
from armsight.sim.encoders import EncodedPlant, EncoderFault, Encoders
from armsight.sim.joints import JointPlant, drawn_model

KIND = np.array([SensorKind.POTENTIOMETER, SensorKind.QUADRATURE, SensorKind.ABSOLUTE] * 2)
PER_REV = np.array([1.0, 40000.0, -16384.0, 1.0, -12345.6, 16384.0])
HOME_RAD = 0.2
ZERO = np.array([0, 0, 3000, 0, 0, 16000])


def encoder_configuration():
    config = lab_configuration()
    for j, joint in enumerate(config["joint"]):
        if KIND[j]:
            zero = ZERO[j] if KIND[j] == SensorKind.ABSOLUTE else 0
            joint["encoder"] = (
                KIND[j],
                j + 1,
                abs(PER_REV[j]),
                np.sign(PER_REV[j]),
                zero,
                HOME_RAD * (KIND[j] == SensorKind.QUADRATURE),
            )
    return config


class Encoded:
    """A board at joints read by encoders."""

    def __init__(self, emulator="host", watch=None):
        self.arm = JointPlant(np.full(6, HOME_RAD), model=drawn_model(5, load=0.0, inertia=1.0))
        self.plant = EncodedPlant(self.arm, Encoders(KIND, PER_REV, ZERO))
        self.link = EmulatedLink(open_emulator(emulator), self.plant, watch=watch)
        self.board = configured(self.link, encoder_configuration())

    def home(self):
        """Take the arm at its home, as a hand has brought it there."""
        self.board.receive(0.01)
        self.board.confirm(self.board.command(Command.HOME))

    def move(self, goal, steps):
        for _ in range(steps):
            self.board.send(JointCommand(np.full(6, goal), np.zeros(6), np.zeros(6), 0.01))
            self.board.receive(0.01)


def test_nothing_is_driven_before_the_zero_is_known_and_then_the_joints_follow():
    here = Encoded()
    assert here.board.status.not_homed == sum(1 << int(j) for j in np.flatnonzero(KIND == SensorKind.QUADRATURE))
    assert here.board.status.joints_not_homed == [int(j) + 1 for j in np.flatnonzero(KIND == SensorKind.QUADRATURE)]
    assert not here.board.homed
    with pytest.raises(ArmsightError, match="an encoder does not know its zero"):
        here.board.enable()
    here.home()
    assert here.board.homed
    here.board.enable()
    here.move(0.3, 100)
    assert here.board.status.faults == ()
    assert here.arm.link == pytest.approx(np.full(6, 0.3), abs=0.02)


@pytest.mark.parametrize("fault", [each for each in EncoderFault if each])
def test_an_absolute_encoder_without_sound_readings_is_named_within_10_ms(fault):
    here = Encoded()
    here.home()
    here.board.enable()
    here.move(0.2, 5)
    here.plant.fault[2] = fault
    here.link.step(10)
    here.board.receive(0.02)
    first = here.board.status.first_fault
    assert (first.fault, first.joint) == (Fault.ENCODER, 2)
    assert here.link.answer["outputs"]["duty"][2] == 0.0


def test_a_quadrature_encoder_that_counts_no_more_is_found_by_its_motor():
    here = Encoded()
    here.home()
    here.board.enable()
    here.move(0.5, 12)
    here.plant.fault[1] = EncoderFault.LOW
    here.move(0.5, 10)
    assert here.link.answer["outputs"]["joint_faults"][1] & 1 << Fault.POT_FROZEN


def test_host_and_processor_compute_the_same_bits():
    digests = []
    for emulator in ("host", "unicorn"):
        digest = hashlib.sha256()
        here = Encoded(emulator, watch=digest.update)
        here.home()
        here.board.enable()
        here.move(0.3, 15)
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]


def test_a_board_says_what_it_has_and_is_given_no_more():
    here = Encoded()
    assert (here.board.welcome.abilities.joints, here.board.welcome.abilities.quadrature_inputs) == (6, 6)
    for said, has in (
        ("joint_count is 6; pil has 4 joints", BoardAbilities(4, tuple(SensorKind), 6)),
        ("joint 2: sensor is quadrature; pil reads potentiometer", BoardAbilities(6, (SensorKind.POTENTIOMETER,), 0)),
        ("joint 5: encoder input is 5; pil has 1 to 3", BoardAbilities(6, tuple(SensorKind), 3)),
    ):
        here.board.welcome = replace(here.board.welcome, abilities=has)
        with pytest.raises(InputError, match=said):
            here.board.store(encoder_configuration())


def test_a_file_has_of_each_sensor_what_it_needs_and_is_read_back(tmp_path):
    path = written(tmp_path, encoder_configuration())
    assert "short_counts" not in path.read_text().split("[joint.2.pot]")[1].split("[joint.3]")[0]
    text = configuration_text(read_configuration(path)[0], "pil")
    assert text == path.read_text()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("counts_per_rev = 40000.0  # 16 to 1e+07\n", ""), "joint.2.encoder.counts_per_rev is missing"),
        (("input = 5", "input = 2"), "joints 2 and 5 are both on encoder input 2"),
        (
            ('sensor = "quadrature"', 'sensor = "resolver"'),
            "joint.2.encoder.sensor is 'resolver'; there are potentiometer",
        ),
        (("zero_counts = 3000", "zero_counts = 16384"), "joint 3: zero_counts is 16384; 0 to 16383 is allowed"),
        (("counts_per_rev = 40000.0", "counts_per_rev = 400.0"), "joint 2: jump_rad must be two counts"),
        (("home_rad = 0.2", "home_rad = 14.0"), "joint 2: home_rad is 14; -13 to 13 is allowed"),
    ],
)
def test_what_is_wrong_with_an_encoder_is_named_with_the_file(tmp_path, change, said):
    path = written(tmp_path, encoder_configuration(), change)
    with pytest.raises(InputError, match=rf"board\.toml: .*{said}"):
        read_configuration(path)
