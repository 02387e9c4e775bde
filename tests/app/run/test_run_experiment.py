"""A board as an earlier run left it, taken over or rejected: the firmware itself, in lock-step."""

from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.run.experiment import enable, require_start
from armsight.app.run.motion_file import QUICK, read_motions
from armsight.data import JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import configured
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Fault, Reaction
from armsight.robot.boards.configuration import lab_configuration
from armsight.robot.boards.contract import Abilities
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.sim.joints import JointPlant, PotFault

ARM = open_arm("six_r")


@pytest.fixture
def made():
    """Opens a configured board; returns (board, link, plant)."""
    boards = []

    def opened(**given):
        config = lab_configuration()
        for name, value in given.items():
            config[name] = value
        plant = JointPlant()
        try:
            link = EmulatedLink(open_emulator("host"), plant)
        except (DeviceError, InputError) as error:
            pytest.skip(f"the firmware is not built: {error}")
        boards.append(configured(link, config))
        boards[-1].receive(0.1)
        return boards[-1], link, plant

    yield opened
    for board in boards:
        board.close()


def left_silent(board, link):
    """Do what an earlier run does: enable, move, go away. Returns a new host's board."""
    board.enable()
    board.send(JointCommand(np.full(6, 0.02), np.zeros(6), np.zeros(6), 0.05))
    board.receive(0.5)
    assert [each.fault for each in board.status.faults] == [Fault.HOST_SILENT]
    return Board.connect(link, name="the board")


def test_an_arm_that_is_held_is_taken_over_without_releasing_it(made):
    board, link, plant = made()
    again = left_silent(board, link)
    assert again.status.state is BoardState.HOLDING
    drives = []
    link._watch = lambda _: drives.append(bool(link.answer["outputs"]["drives_on"]))
    q = plant.q.copy()
    enable(again)
    assert again.status.state is BoardState.ENABLED
    assert again.status.faults == ()
    assert all(drives)
    assert np.abs(plant.q - q).max() < 1e-3


def test_an_arm_that_was_released_is_enabled_anew(made):
    board, link, _ = made(silence_reaction=Reaction.RELEASE)
    again = left_silent(board, link)
    assert again.status.state is BoardState.FAULTED
    enable(again)
    assert again.status.state is BoardState.ENABLED


def test_an_arm_that_still_slows_down_is_waited_for(made):
    board, _, _ = made()
    board.enable()
    board.send(JointCommand(np.full(6, 1.5), np.full(6, 1.5), np.zeros(6), 1.0))
    while board.status.state is not BoardState.STOPPING:
        board.receive(0.01)
    enable(board)
    assert board.status.state is BoardState.ENABLED


def test_other_faults_are_left_to_a_person(made):
    board, link, plant = made()
    again = left_silent(board, link)
    plant.break_pot(2, PotFault.OPEN)
    again.receive(0.2)
    with pytest.raises(DeviceError, match=r"the board is not ready: holding.*joint 3: potentiometer open") as caught:
        enable(again)
    assert "\n" not in str(caught.value)
    again.receive(0.05)
    assert again.status.state is BoardState.HOLDING  # nothing was cleared
    assert {each.fault for each in again.status.faults} >= {Fault.HOST_SILENT, Fault.POT_OPEN}


def test_an_emergency_stop_is_not_undone(made):
    board, _, _ = made()
    board.enable()
    board.stop()
    board.receive(0.1)
    with pytest.raises(DeviceError, match="emergency stop"):
        enable(board)
    board.receive(0.05)
    assert board.status.state is BoardState.STOPPED


def stands(q, own=False):
    """A board whose joints stand somewhere, with the lab's limits."""
    states = SimpleNamespace(q=q, t_s=np.ones(len(q)))
    limits = np.full(6, -2.4), np.full(6, 2.4)
    able = Abilities(6, 100.0, own_controller=own)
    return SimpleNamespace(receive=lambda wait_s: states, soft_limits=lambda: limits, abilities=able)


@pytest.mark.parametrize(
    ("shift_deg", "target", "said"),
    [
        ([0, 0, 30, 0, 0, 0], 0.0, r"joint 3 reads 30\.0 deg, the motion starts at 0\.0"),
        ([0, 0, 0, 0, 0, 0], 2.6, r"joint 6 is to go from .* to 149\.0 deg, the board allows -137\.5 to 137\.5"),
    ],
)
def test_an_arm_that_does_not_fit_the_board_is_rejected(shift_deg, target, said):
    q = ARM.home + np.radians(shift_deg)
    setup = SimpleNamespace(board=stands(q[None]), arm=ARM)
    targets = ARM.home[None] + np.array([[0, 0, 0, 0, 0, target]])
    with pytest.raises(InputError, match=said) as caught:
        require_start(setup, read_motions(ARM, QUICK), targets)
    assert "--arm six_r" in str(caught.value)


def test_an_arm_that_droops_before_its_own_controller_holds_it_is_at_the_start():
    drooping = (ARM.home + np.radians([0, 2.6, 0, 0, 0, 0]))[None]  # as an SO-101 does
    require_start(SimpleNamespace(board=stands(drooping, own=True), arm=ARM), read_motions(ARM, QUICK), ARM.home[None])
    with pytest.raises(InputError, match="the motion starts at"):
        require_start(SimpleNamespace(board=stands(drooping), arm=ARM), read_motions(ARM, QUICK), ARM.home[None])


def test_a_board_that_reports_no_angles(made):
    setup = SimpleNamespace(board=stands(np.zeros((0, 6))), arm=ARM)
    with pytest.raises(DeviceError, match="reports no joint angles"):
        require_start(setup, read_motions(ARM, QUICK), ARM.home[None])
