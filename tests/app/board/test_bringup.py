"""A bring-up of one joint from a fresh board, its mistakes by name, and what becomes of a pulled cable and Ctrl-C."""

import io
import json
import os
import pty
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from armsight.app.board.bringup import Bringup, TerminalOperator
from armsight.app.board.command import command
from armsight.app.board.found import Found, JointFound
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.board import Board
from armsight.robot.boards.board_file import read_configuration
from armsight.robot.boards.codes import Reaction, SensorKind
from armsight.robot.boards.configuration import check_configuration, gains_array
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.robot.boards.identification import dead_spots, fit_swing
from armsight.sim.boards.workshop import Wiring, WorkshopPerson, drawn_encoders, drawn_workshop, swapped
from armsight.sim.encoders import EncodedPlant, EncoderFault
from cli_runs import assert_has


class Evening:
    """A fresh emulated board with an arm nobody knows, and a person."""

    def __init__(self, folder, wiring=None, *, seed=31, joints=(0,), mends=False, encoders=None):
        self.drawn = drawn_encoders(seed, {j: kind for j, (kind, _) in (encoders or {}).items()})
        self.plant, self.model = drawn_workshop(seed, encoders=self.drawn)
        if wiring is not None:
            self.plant.wiring = wiring
        self.person = WorkshopPerson(self.plant, seed=seed, mends=mends)
        self.link = EmulatedLink(open_emulator("host"), self.plant)
        self.board = Board.connect(self.link)
        self.bringup = Bringup(self.board, self.person, folder, joints, encoders=encoders)
        self.joints = self.bringup.found.joints


def known(evening):
    """Let the potentiometers of all joints be known, so that a test need not move them."""
    for each, sign in zip(evening.joints, evening.plant.wiring.potentiometer_signs, strict=True):
        counts = np.array([5000.0, 60000.0])
        each.noise_counts, each.range_counts = 15.0, counts.tolist()
        each.marks = [[c, sign * (c - 32767.5) / 11342.5] for c in counts]


def test_one_joint_is_identified_verified_and_stored(tmp_path):
    evening = Evening(tmp_path)
    evening.bringup.run()
    found, model = evening.joints[0], evening.model
    assert evening.person.problems == []
    assert found.resistance_ohm == pytest.approx(model.resistance_ohm[0], rel=0.07)  # and its current sensor is 3 % off
    assert found.constant_v_s == pytest.approx(model.constant_v_s[0], rel=0.03)
    assert found.inertia_kg_m2 == pytest.approx(model.inertia_kg_m2[0], rel=0.15)
    assert found.motor_direction == evening.plant.wiring.motor_signs[0]
    assert found.following_rms_rad < 0.01
    config, name = read_configuration(tmp_path / "board.toml")
    assert (name, config.tobytes()) == ("pil", evening.board.configuration().tobytes())
    assert config["silence_reaction"] == 1
    assert not evening.board.status.drives_on
    page = (tmp_path / "report.html").read_text()
    assert_has(page, "data:image/png", f"{found.constant_v_s:.3f}")
    # What is kept is taken up again: nothing is asked, nothing moves.
    evening.plant.drives_s = 0.0
    Bringup(evening.board, evening.person, tmp_path, [0]).run(["potentiometers", "motors", "swing"])
    assert evening.plant.drives_s == 0.0
    # Of another arm it is refuted, and nothing is stored.
    signs = evening.plant.wiring.motor_signs
    other = Evening(tmp_path, replace(evening.plant.wiring, motor_signs=tuple(-sign for sign in signs)))
    (tmp_path / "board.toml").unlink()
    other.bringup.run(["verify", "store"])
    assert other.bringup.refuted
    assert not other.bringup.found.verified
    assert not gains_array(other.board.configuration())[0, :6].any()  # those of its trial are taken back
    assert not (tmp_path / "board.toml").exists()


@pytest.fixture
def short_ways(monkeypatch):
    """Let the hand move joints less far, which takes less of the test's time."""
    monkeypatch.setattr("armsight.sim.boards.workshop.MARKS_DEG", (-60.0, 0.0, 60.0))


ENCODERS = {0: (SensorKind.QUADRATURE, 2), 1: (SensorKind.ABSOLUTE, 0)}


def test_encoders_are_found_by_their_counts_direction_and_zero_and_homed_where_they_stand(tmp_path, short_ways):
    evening = Evening(tmp_path, joints=[0, 1], encoders=ENCODERS, seed=53)
    evening.bringup.run(["readings", "potentiometers"])
    evening.bringup._joints = [0]
    evening.bringup.run(["motors"])
    assert evening.person.problems == []
    for j, found in enumerate(evening.joints[:2]):
        assert found.counts_per_rev == pytest.approx(evening.drawn.counts_per_rev[j], rel=0.01)
        # A protractor is read to 3 mrad.
        ends = found.encoder_angles(np.array(found.range_counts))
        assert np.sort(np.abs(ends)) == pytest.approx(
            [np.pi / 3, np.pi / 2], abs=0.05
        )  # to a mark, and to where it hangs
    assert evening.joints[0].motor_direction == evening.plant.wiring.motor_signs[0]
    here = evening.plant.plant.link[:2]
    assert evening.board.receive(0.05).q[-1, :2] == pytest.approx(here, abs=0.02)
    # Another run, of a board that was switched off meanwhile: a quadrature encoder's position is asked for.
    evening.link.restart()
    evening.plant.encoded = EncodedPlant(evening.plant.plant, evening.drawn)
    asked = []
    evening.person.ask = lambda kind, joint, said, ask=evening.person.ask: (asked.append(kind), ask(kind, joint, said))
    again = Bringup(Board.connect(evening.link), evening.person, tmp_path, [0, 1])
    again.run(["potentiometers"])
    again._use(again._configuration(Reaction.RELEASE, gains=False))
    assert asked == ["angle"]
    assert again._board.receive(0.05).q[-1, :2] == pytest.approx(evening.plant.plant.link[:2], abs=0.02)


@pytest.mark.parametrize(
    ("joint", "fault", "step", "said"),
    [
        (1, EncoderFault.LOW, "readings", "joint 2: its encoder gives no sound reading"),
        (1, EncoderFault.MAGNET, "readings", "joint 2: its encoder reports its magnet as too weak or too strong"),
        (0, EncoderFault.LOW, "potentiometers", r"does not follow the hand. Are both its lines in, A and B\?"),
    ],
)
def test_a_mistake_of_an_encoder_is_named(tmp_path, short_ways, joint, fault, step, said):
    evening = Evening(tmp_path, joints=[joint], encoders=ENCODERS)
    evening.plant.encoded.fault[joint] = fault
    evening.bringup.run(["readings", step])
    assert re.search(said, evening.person.problems[0])


def test_an_absolute_encoder_must_be_on_the_joints_axis_and_counts_must_be_even():
    found = JointFound(sensor="absolute", marks=[[100.0, -1.0], [100 + 16384 * 5 / np.pi, 1.0]])
    with pytest.raises(InputError, match=r"counts 81920 a revolution of the joint; .* on the joint's own axis\?"):
        found.fit_encoder()
    found = JointFound(sensor="quadrature", marks=[[0.0, -1.0], [500.0, 0.0], [2000.0, 1.0]])
    assert found.fit_encoder() > 0.1


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["2"], "--encoder 2: a joint and a kind are needed"),
        (["7:absolute"], "--encoder 7:absolute: a joint and a kind"),
        (["2:absolute", "2:quadrature:1"], "joint 2 has two encoders"),
        (["1:quadrature:3", "2:quadrature:3"], "two quadrature encoders are at one input"),
    ],
)
def test_encoders_that_cannot_be_are_rejected(tmp_path, given, said):
    options = [word for each in given for word in ("--encoder", each)]
    done = CliRunner().invoke(command, ["bringup", "--board", "emulated:host", "-o", str(tmp_path / "new"), *options])
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("wiring", "step", "said"),
    [
        (Wiring(open_potentiometers=frozenset({1})), "readings", "joint 2: its potentiometer is open"),
        (Wiring(potentiometers=swapped(1, 4)), "potentiometers", "potentiometers of joints 2 and 5 are swapped"),
        (Wiring(dead_spot=(1, 0.5, 0.55)), "potentiometers", "joint 2: its potentiometer has a dead spot at 2"),
        (Wiring(motors=swapped(1, 4)), "motors", "motors of joints 2 and 5 are swapped"),
        (Wiring(dead_motors=frozenset({1})), "motors", "joint 2: its motor is dead"),
    ],
)
def test_a_mistake_is_named_and_nothing_moves_by_it(tmp_path, wiring, step, said):
    evening = Evening(tmp_path, wiring, joints=[1])
    if step == "motors":
        known(evening)
    if step == "potentiometers":
        evening.joints[1].noise_counts = 10.0
    evening.bringup.run([step])
    assert len(evening.person.problems) == 1
    assert said in evening.person.problems[0]
    assert not evening.joints[1].done(step)
    assert not evening.board.status.drives_on


def test_a_pulse_moves_no_joint_further_than_3_degrees(tmp_path):
    evening = Evening(tmp_path, joints=[0, 3])
    known(evening)
    evening.plant.mark()
    evening.bringup.run(["motors"])
    assert [evening.joints[j].motor_direction for j in (0, 3)] == [evening.plant.wiring.motor_signs[j] for j in (0, 3)]
    assert np.degrees(evening.plant.far_rad.max()) < 3.0


@pytest.mark.parametrize("raised", [KeyboardInterrupt, DeviceError("gone")])
def test_the_motors_are_off_and_what_was_found_is_kept(tmp_path, raised):
    evening = Evening(tmp_path)
    known(evening)
    evening.joints[0].motor_direction = 1
    read = evening.link.read
    ticks = []

    def interrupted(wait_s=0.0):
        if evening.board.status.drives_on:
            ticks.append(wait_s)
        if len(ticks) == 30:
            if raised is not KeyboardInterrupt:
                evening.link.read = evening.link.write = broken
            raise raised
        return read(wait_s)

    def broken(*_):
        raise DeviceError("gone")

    evening.link.read = interrupted
    with pytest.raises((KeyboardInterrupt, DeviceError)) as came:
        evening.bringup.run(["motors", "swing"])
    assert raised is KeyboardInterrupt or "what was found is kept" in str(came.value)
    if raised is KeyboardInterrupt:  # switched off, not only left alone
        assert evening.board.status.state == 0
    evening.link.step(300)  # a board whose cable is pulled hears nothing
    assert not evening.link.answer["outputs"]["drives_on"]
    kept = Found.read(tmp_path / "bringup.json")
    assert kept.joints[0].marks == evening.joints[0].marks


def test_an_answer_must_be_one_and_q_or_the_end_of_stdin_ends_it(tmp_path, monkeypatch):
    evening = Evening(tmp_path)
    known(evening)
    said = []
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    typed = TerminalOperator(said.append)
    answers = ["perhaps"]
    monkeypatch.setattr(typed, "answer", lambda ask=typed.answer: answers.pop() if answers else ask())
    Bringup(evening.board, typed, tmp_path, [0]).run(["motors"])
    assert said[-3:] == ["'perhaps' is not understood; y, n or q is", said[-2], "ended; what was found is kept"]
    assert evening.plant.drives_s == 0.0


def test_typed_at_a_terminal_from_the_swing_to_the_stored_configuration(tmp_path, monkeypatch):
    evening = Evening(tmp_path)
    known(evening)
    evening.joints[0].motor_direction = evening.plant.wiring.motor_signs[0]
    evening.bringup.found.write(tmp_path / "bringup.json")
    master, slave = pty.openpty()
    answers = ["perhaps\n", "y\n", "y\n", "y\n"]

    def heard(line):
        if line.endswith("[y/n]: "):
            os.write(master, answers.pop(0).encode())

    with open(slave, encoding="utf-8") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        operator = TerminalOperator(heard)
        try:
            Bringup(evening.board, operator, tmp_path, [0]).run(["swing", "verify", "store"])
        finally:
            os.write(master, b"\x04")
            for _ in range(5000):  # until its reader has come to the end of the input, else stdin cannot be closed
                if operator.answer() == "q":
                    break
                time.sleep(0.001)
    os.close(master)
    assert answers == []
    config, _ = read_configuration(tmp_path / "board.toml")
    assert config.tobytes() == evening.board.configuration().tobytes()
    assert config["joint"]["gains"]["kp_per_rad"][0] > 0
    assert not evening.board.status.drives_on


def test_nobody_who_answers_ends_it(tmp_path, monkeypatch):
    monkeypatch.setattr("armsight.app.board.bringup._PATIENCE_S", 0.2)
    evening = Evening(tmp_path)
    known(evening)
    evening.person.answer = lambda: None
    with pytest.raises(InputError, match="no answer for 0 minutes; what was found is kept in"):
        Bringup(evening.board, evening.person, tmp_path, [0]).run(["motors"])


def test_the_command_prints_what_was_found(tmp_path):
    done = CliRunner().invoke(
        command, ["bringup", "--board", "emulated:host", "--step", "readings", "-o", str(tmp_path), "--json"]
    )
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert all(1 < each["noise_counts"] < 30 for each in found["joints"])


@pytest.mark.parametrize(("found_rad", "stored_rad"), [(None, 0.015), (0.0, 0.0), (0.004, 0.006)])
def test_the_backlash_that_was_found_is_configured_with_a_margin(found_rad, stored_rad):
    joint = JointFound(5.0, resistance_ohm=6.0, constant_v_s=2.4, inertia_kg_m2=0.05, viscous_n_m_s=0.02, dry_n_m=0.2)
    joint.backlash_rad = found_rad
    config = Found("pil", [joint] * 6).configuration(2.0, Reaction.HOLD, gains=True)
    assert config["joint"]["motor"]["backlash_rad"] == pytest.approx([stored_rad] * 6)
    check_configuration(config)


def test_an_angle_that_no_joint_has_is_asked_for_again(tmp_path, monkeypatch):
    evening = Evening(tmp_path)
    evening.joints[0].noise_counts = 10.0
    said, wrong = [], ["inf", "nan", "12 deg", "7000"]
    say, answer = evening.person.say, evening.person.answer
    marking = []
    monkeypatch.setattr(evening.person, "say", lambda line: (said.append(line), say(line)))
    ask = evening.person.ask
    monkeypatch.setattr(evening.person, "ask", lambda kind, *rest: (marking.append(kind), ask(kind, *rest)))
    monkeypatch.setattr(
        evening.person, "answer", lambda: wrong.pop(0) if wrong and marking[-1:] == ["mark"] else answer()
    )
    evening.bringup.run(["potentiometers"])
    assert [line for line in said if "is no angle" in line] == [
        f"{each!r} is no angle in degrees" for each in ("inf", "nan", "12 deg", "7000")
    ]
    assert np.isfinite(evening.joints[0].marks).all()


def test_a_foreign_file_of_what_was_found_is_rejected(tmp_path):
    (tmp_path / "bringup.json").write_text("[]")
    with pytest.raises(InputError, match=r"bringup\.json: not what a bring-up kept"):
        Evening(tmp_path)
    Found("nucleo-f446re", [JointFound() for _ in range(6)]).write(tmp_path / "bringup.json")
    with pytest.raises(InputError, match="is of board nucleo-f446re; this one is pil"):
        Evening(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("noise_counts", "abc"), ("noise_counts", -1.0), ("marks", 5), ("marks", [[1.0]]), ("motor_direction", 3)),
        *(("resistance_ohm", -2.0), ("constant_v_s", float("nan")), ("sensor", "laser"), ("range_counts", [9.0, 1.0])),
        *(("counts_per_rev", 0.0), ("zero_counts", None), ("encoder_input", "1")),
        *(("supply_v", "x"), ("supply_v", -1.0), ("joint_count", 9)),
    ],
)
def test_a_value_that_cannot_have_been_found_is_rejected_by_name(tmp_path, name, value):
    found = Found("pil", [JointFound() for _ in range(6)])
    of_board = hasattr(found, name)
    setattr(found if of_board else found.joints[2], name, value)
    found.write(tmp_path / "bringup.json")
    said = f"{'' if of_board else 'joint 3: '}{name} is .*remove it, or name another folder"
    with pytest.raises(InputError, match=said):
        Found.read(tmp_path / "bringup.json")


def test_a_motor_is_identified_exactly_without_noise_also_from_currents_without_a_sign():
    t = np.arange(0, 5, 0.002)
    q, w, a = (
        sum(
            s * np.real((2j * np.pi * f) ** n * np.exp(2j * np.pi * f * t) * -1j) for s, f in ((0.12, 0.5), (0.04, 2.0))
        )
        for n in range(3)
    )
    amperes = (0.05 * a + 0.03 * w + 0.2 * np.sign(w) + 1.5 * np.sin(q)) / 2.4
    volts = 6.0 * amperes + 2.4 * w
    for sensed, rel in ((amperes, 0.001), (np.abs(amperes), 0.05)):
        fit = fit_swing(t, volts, sensed, q)
        assert fit.motor.resistance_ohm == pytest.approx(6.0, rel=rel)
        assert fit.motor.constant_v_s == pytest.approx(2.4, rel=rel)
        assert fit.motor.inertia_kg_m2 == pytest.approx(0.05, rel=0.05)
        assert fit.motor.dry_n_m == pytest.approx(0.2, rel=0.1)
        assert fit.gravity_n_m == pytest.approx(1.5, rel=0.05)
        assert fit.backlash_rad < 1e-3
    with pytest.raises(InputError, match="too few to identify a motor"):
        fit_swing(t, volts, amperes, 0 * q)
    with pytest.raises(InputError, match="fits no motor"):
        fit_swing(t, -volts, amperes, q)


def test_dead_spots_are_where_contact_was_lost():
    counts = np.linspace(5000, 60000, 2000) + np.random.default_rng(1).normal(0, 20, 2000)
    assert dead_spots(counts, 20.0, 300, 65000) == []
    counts[700:706] = 65535
    counts[900] += 3000
    assert dead_spots(counts, 20.0, 300, 65000) == [(700, 705), (900, 900)]
