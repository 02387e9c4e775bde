"""The board for several threads: a stop goes before whoever drives it, and loses no reading."""

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.board.command import NOT_HOMED
from armsight.app.live import arm
from armsight.app.live.arm import ArmStep
from armsight.app.live.step import SessionOptions, Shared
from armsight.data import JointStates, Missed
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.robot.boards.codes import BoardState, Command
from armsight.robot.boards.contract import Abilities
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.boards.stoppable import StoppableBoard
from armsight.robot.models import MODELS
from armsight.sim.boards.ar4 import Ar4Teensy
from armsight.sim.boards.device import SteppedLink
from armsight.sim.boards.so101 import So101Bus
from cli_runs import assert_rejected

pytestmark = pytest.mark.real_time


class FakeBoard:
    """A board that reports its stop two receptions later, and notes who called it at once with whom."""

    abilities = Abilities(6, 250.0)

    def __init__(self):
        self.status, self.calls, self.within, self.together, self.t = (
            SimpleNamespace(state=BoardState.ENABLED),
            [],
            0,
            0,
            0,
        )
        self.inside, self.go_on = threading.Event(), threading.Event()

    def receive(self, wait_s):
        self.within += 1
        self.together = max(self.together, self.within)
        self.calls.append("receive")
        self.t += 1
        if "stop" in self.calls and len(self.calls) - self.calls.index("stop") > 2:
            self.status.state = BoardState.STOPPED
        self.within -= 1
        return JointStates(np.array([float(self.t)]), np.full((1, 6), float(self.t)))

    def stop(self):
        self.calls.append("stop")

    def command(self, command):
        self.calls.append(command)
        return 1

    def confirm(self, sequence, wait_s=0.5):
        self.inside.set()
        self.go_on.wait(10.0)
        self.status.state = BoardState.DISABLED


def test_a_stop_loses_no_reading_and_is_cleared_by_a_command():
    board = StoppableBoard(fake := FakeBoard())
    board.receive(0.0)
    board.stop()
    assert board.stopped
    assert board.rests
    taken = board.receive(0.0)
    assert taken.t_s.tolist() == [float(k) for k in range(2, fake.t + 1)]
    fake.go_on.set()
    board.clear_stop()
    assert fake.calls[-1] is Command.CLEAR_STOP
    assert not board.stopped


def test_no_drive_is_switched_on_between_a_stop_and_its_end():
    board = StoppableBoard(fake := FakeBoard())
    board.stop()
    for switch_on in (
        board.enable,
        lambda: board.command(Command.ENABLE),
        lambda: board.command(Command.ENABLE_INWARD),
    ):
        with pytest.raises(DeviceError, match="stopped by a person: allow the drives again first"):
            switch_on()
    assert not {Command.ENABLE, Command.ENABLE_INWARD} & set(fake.calls)


def test_a_stop_goes_before_a_thread_that_never_lets_go():
    board, ended = StoppableBoard(fake := FakeBoard()), threading.Event()

    def drive():
        while not ended.is_set():
            board.receive(0.0)

    thread = threading.Thread(target=drive)
    thread.start()
    board.stop()
    ended.set()
    thread.join(10.0)
    assert board.rests
    assert fake.together == 1


def test_a_long_wait_is_made_of_short_ones():
    waited = []
    board = StoppableBoard(fake := FakeBoard())
    fake.receive = lambda wait_s: waited.append(wait_s) or JointStates(np.array([float(len(waited))]), np.zeros((1, 6)))
    assert board.receive(0.0).t_s.tolist() == [1.0]
    assert board.receive(0.0101).t_s.tolist() == [2.0, 3.0, 4.0]
    assert sum(waited) == pytest.approx(0.0101)
    assert max(waited) < 0.005


def test_a_stop_is_sent_while_another_call_waits_for_an_answer():
    board = StoppableBoard(fake := FakeBoard())
    thread = threading.Thread(target=lambda: board.confirm(1))
    thread.start()
    fake.inside.wait(10.0)
    stopping = threading.Thread(target=board.stop)
    stopping.start()
    while "stop" not in fake.calls:
        stopping.join(0.01)
    assert thread.is_alive()
    fake.status.state = BoardState.STOPPED
    fake.go_on.set()
    stopping.join(10.0)
    thread.join(10.0)
    assert not stopping.is_alive()


def test_a_board_with_another_controller_is_stopped_when_it_follows_no_command():
    link = SteppedLink(So101Bus.made())
    board = StoppableBoard(FeetechBoard.connect(ServoBus(link, "feetech:PORT", now=link.now)))
    board.enable()
    assert not board.rests
    board.stop()
    assert board.rests
    assert board.stopped
    board.clear_stop()
    assert not board.stopped


def arm_step(tmp_path, board, measuring=None):
    options = SessionOptions(tmp_path, "usb:0,1", board=board)
    measuring = measuring or SimpleNamespace(rig=None, rig_path=None, target_spec=None, newest=None, lacking="")
    return ArmStep(Shared(options, tmp_path, lambda level, text: None), measuring, MODELS["six_r"])


def test_the_angles_of_an_arm_that_is_not_homed_are_not_shown(tmp_path):
    """All six encoders of a Teensy that was just switched on read 0, which are up to 170 degrees."""
    link = SteppedLink(Ar4Teensy(homing_s=0.2))
    inner = Ar4Board.connect(link, now=link.now)
    seen = {"rig": None, "rig_path": None, "target_spec": None, "newest": None, "lacking": "", "followed": True}
    board, step = StoppableBoard(inner), arm_step(tmp_path, "ar4:PORT", SimpleNamespace(**seen))
    step._board = board
    shown = []

    def receive(wait_s):
        if len(shown) == 3:
            inner.home()
        shown.append(step.state)
        if len(shown) == 6:
            step._closing.set()
        return inner.receive(wait_s)

    board.receive = receive
    step._work(board)
    assert [(state.q_deg, state.missing) for state in shown[:3]] == [((), NOT_HOMED)] * 3
    assert len(step.state.q_deg) == 6
    assert step.state.missing == ""


@pytest.mark.parametrize(
    ("name", "source", "says"),
    [
        ("nonsense", "usb:0,1", "no board 'nonsense'; there are"),
        ("poses:", "usb:0,1", "no board 'poses:'"),
        ("poses:nothing.csv", "usb:0,1", "nothing.csv"),
        ("emulated:unicorn", "usb:0,1", "go together: --source sim:"),
    ],
)
def test_a_board_that_cannot_be_right_is_rejected(name, source, says):
    with pytest.raises(InputError, match=says):
        ArmStep.check_board(name, source, MODELS["six_r"])


def test_logged_joint_angles_stand_beside_the_shot_they_belong_to(tmp_path):
    (tmp_path / "q.csv").write_text("shot,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\na,1,2,3,4,5,6\nb,2,2,3,4,5,6\n")
    newest = SimpleNamespace(shot=SimpleNamespace(name="b", t_s=None)), None
    measuring = SimpleNamespace(rig=None, rig_path=None, target_spec=None, newest=newest, lacking="")
    step = arm_step(tmp_path, f"poses:{tmp_path}/q.csv", measuring)
    step.open_arm()
    assert step.state.q_deg == pytest.approx((2, 2, 3, 4, 5, 6))
    assert not step.state.moves
    with pytest.raises(InputError, match="commands no motion"):
        step.run_motions(closed=False)
    (tmp_path / "q.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n1,2,3,4,5,6\n2,2,3,4,5,6\n")
    other = arm_step(tmp_path, f"poses:{tmp_path}/q.csv")
    with pytest.raises(InputError, match="neither a column shot nor t_s"):
        other.open_arm()
    step.close()
    other.close()


def test_what_is_shown_waits_for_the_command_of_a_shot(tmp_path, monkeypatch):
    monkeypatch.setattr(arm, "_PATIENCE_S", 60.0)
    monkeypatch.setattr(arm, "_WATCHES_S", 60.0)
    step = arm_step(tmp_path, None)
    step.between_shots()  # nothing moves: at once
    step.shared.capture = SimpleNamespace(newest=None)
    loop = SimpleNamespace(log=SimpleNamespace(joints=[], poses=[], shots=0), mounting=None)
    step._begun(loop)
    step.between_shots()  # it watches no shot yet: at once
    loop.log.poses.append(("0", 0.0, Missed("not seen")))
    loop.log.shots = 1
    loop.on_period()
    shown = threading.Event()
    thread = threading.Thread(target=lambda: (step.between_shots(), shown.set()))
    thread.start()
    loop.on_period()  # no shot was answered
    assert not shown.wait(0.05)
    while not shown.wait(0.01):
        loop.log.shots = 2
        loop.on_period()
    thread.join()


@pytest.mark.parametrize(("found", "opened"), [("feetech:P", "feetech:P,so.json"), ("ar4:P", "ar4:P")])
def test_a_bus_that_is_found_has_the_calibration_that_was_given(tmp_path, monkeypatch, found, opened):
    names = []

    def opening(name):
        names.append(name)
        raise DeviceError("no more of it is needed")

    step = arm_step(tmp_path, None)
    step.shared.options = replace(step.shared.options, servo_calibration=Path("so.json"))
    monkeypatch.setattr(arm, "find_board", lambda say, ports: found)
    monkeypatch.setattr(arm, "check_model", lambda name, model: None)
    monkeypatch.setattr(arm, "check_arm", lambda name: None)
    monkeypatch.setattr(arm, "open_motion_board", opening)
    with pytest.raises(DeviceError, match="no more"):
        step._find()
    assert names == [opened]
    step.close()


def test_a_calibration_that_belongs_to_no_bus_is_one_line(tmp_path, armsight, monkeypatch):
    given = ("live", "-o", tmp_path / "live", "--calibration", tmp_path / "so.json")
    assert_rejected(armsight(*given), "so.json", "no such file")
    monkeypatch.setattr("armsight.robot.boards.feetech.calibration.read_calibration", lambda path: None)
    assert_rejected(armsight(*given, "--board", "serial:P"), "so.json", "feetech:PORT, not to serial:P")
    assert_rejected(armsight(*given, "--board", "feetech:P,a.json"), "feetech:P,a.json has a calibration file already")
