"""What controllers of their own have in common: goals that are none are rejected, and a pulled cable is one line."""

import numpy as np
import pytest

from armsight.data import JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.sim.boards.ar4 import Ar4Teensy
from armsight.sim.boards.device import SteppedLink
from armsight.sim.boards.so101 import So101Bus


@pytest.fixture(params=["so101", "ar4"])
def driven(request):
    """A board whose joints are driven, the link to it, and the true angles of its joints."""
    servos = request.param == "so101"
    link = SteppedLink(device := So101Bus.made(load=lambda q: np.zeros(6)) if servos else Ar4Teensy(homing_s=0.5))
    board = FeetechBoard.connect(ServoBus(link, "P", now=link.now)) if servos else Ar4Board.connect(link, now=link.now)
    if not servos:
        board.home()
    board.enable()
    board.receive(0.5)
    return board, link, lambda: device.truth[1]


@pytest.mark.parametrize(
    ("of_first", "said"),
    [
        (25.0, r"joint 1.* is at .* deg and is to go to .* at once; 20 at most: send goals step by step"),
        (400.0, r"joint 1.* is to go to [34].* deg; .* is allowed -1[78]0.0 to 1[78]"),
        (np.nan, "q_ref of joint 1 is nan; it must be finite"),
        (None, r"q_ref is of shape .4,.; this board has [56] joints: is it the right arm"),
    ],
)
def test_a_wrong_goal_is_rejected_and_nothing_moves(driven, of_first, said):
    board, _, joints = driven
    q, before = board.receive(0.0).q[-1].copy(), joints().copy()
    q[0] += 0.0 if of_first is None else np.radians(of_first)
    none = np.zeros(len(q))
    with pytest.raises(InputError, match=said):
        board.send(JointCommand(q[:4] if of_first is None else q, none, none, 0.02))
    board.receive(0.3)
    assert joints() == pytest.approx(before, abs=1e-9)


def test_a_cable_that_is_pulled_is_one_line(driven):
    board, link, _ = driven
    link.pulled = True
    with pytest.raises(DeviceError, match="was the cable pulled"):
        board.receive(0.1)
