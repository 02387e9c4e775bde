"""Arms in the workcell that keep a controller of their own: an SO-101 on its servo bus, an AR4 with its Teensy, emulated.

In: the true table of the arm, an :class:`~armsight.sim.workcell.arm.Imperfections` and a seed. Out: a
:class:`ControlledArm`, which is both the arm that the cameras see and the controller at the wire, and the board that the
host opens on it. What is wrong with the joints is the emulators' own (``sim.boards``); a nominal arm has no backlash, true
zeros, and its servos' droop, counts and dead zone; the zeros of any other are off by up to so much as :data:`ZERO_DEG`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from armsight.data import Array, JointCommand
from armsight.robot.board_registry import AR4, FEETECH
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.robot.boards.contract import MotionBoard
from armsight.robot.boards.feetech.board import FeetechBoard
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.kinematics.arm import Arm
from armsight.sim.boards.ar4 import Ar4Mechanics, Ar4Teensy
from armsight.sim.boards.device import STEP_S, Device, SteppedLink
from armsight.sim.boards.so101 import SERVOS, So101Bus, So101Mechanics
from armsight.sim.workcell.arm import Imperfections
from armsight.sim.workcell.motors import gravity_torque, solids
from armsight.sim.workcell.plant import Travelled

#: Zeros of an arm that is not nominal: of an SO-101's servos, and of an AR4's homing, degrees.
ZERO_DEG = 1.0
#: Torque of the heaviest-loaded joint of an SO-101 with 0.2 kg in its gripper, N m.
_SO101_LOAD_N_M = 1.25
_LOADS = 400  # poses at which the load is looked at
_STEPS, _STEP_S = 8, 0.7  # in which an AR4 goes from where it is homed to the workcell's home


class ControlledDevice(Device, Protocol):
    """A controller whose joints are known truly."""

    @property
    def truth(self) -> tuple[Array, Array]:
        """(n,) angles where the sensors sit, and of the links, rad."""


class ControlledArm:
    """An arm of a true table with a controller of its own: what the cameras see, and a ``Device`` at the wire.

    ``stepped`` is called after every step; may be set.
    """

    def __init__(self, arm: Arm, device: ControlledDevice) -> None:
        self.arm, self.parts, self.device = arm, solids(arm), device
        self.stepped: Callable[[], None] = lambda: None
        self.travelled = Travelled(np.concatenate(device.truth))

    @property
    def t_s(self) -> float:
        """How much time has passed, s."""
        return self.travelled.ticks * STEP_S

    @property
    def path(self) -> Array:
        """(N, 2 n) true angles where the sensors sit, then of the links, rad, at each millisecond of the last minutes."""
        return self.travelled.recent

    def write(self, data: bytes) -> None:
        """Take bytes from the host."""
        self.device.write(data)

    def read(self) -> bytes:
        """Return the bytes that have left for the host."""
        return self.device.read()

    def step(self) -> None:
        """Let STEP_S pass."""
        self.device.step()
        self.travelled.add(np.concatenate(self.device.truth))
        self.stepped()

    def advance(self, dt_s: float) -> None:
        """Let time pass, to the nearest millisecond."""
        for _ in range(round(dt_s / STEP_S)):
            self.step()


@dataclass(frozen=True)
class Controlled:
    """A kind of arm with a controller of its own."""

    board: str  #: how its board's name begins, such as ``feetech:``
    #: returns arm and board, drives on, at home, from the true table, how far it is from nominal, and a seed
    open: Callable[[Arm, Imperfections, int], tuple[ControlledArm, MotionBoard]]


def _so101(true: Arm, given: Imperfections, seed: int) -> tuple[ControlledArm, MotionBoard]:
    """Return an SO-101 and its bus; gravity pulls at the links as they are."""
    nominal, n = given == Imperfections(), true.joints
    rng, parts = np.random.default_rng([seed, 30]), solids(true)
    zeros = tuple(np.radians(np.append(rng.uniform(-ZERO_DEG, ZERO_DEG, n), np.zeros(SERVOS - n))).tolist())
    mechanics = So101Mechanics(backlash_rad=0.0) if nominal else So101Mechanics(zero_rad=zeros)
    poses = rng.uniform(true.q_min, true.q_max, (_LOADS, n))
    most = max(float(np.abs(gravity_torque(true, parts, q)).max()) for q in poses)
    torque = np.zeros(SERVOS)

    def load(q: Array) -> Array:
        torque[:n] = gravity_torque(true, parts, q[:n]) * (-_SO101_LOAD_N_M / most)
        return torque

    q = np.append(true.home, np.zeros(SERVOS - n))
    arm = ControlledArm(true, So101Bus.made(mechanics, load, q))
    board = FeetechBoard.connect(ServoBus(SteppedLink(arm), "the emulated SO-101", now=lambda: arm.t_s), begin_s=0.0)
    board.enable()
    return arm, board


def _ar4(true: Arm, given: Imperfections, seed: int) -> tuple[ControlledArm, MotionBoard]:
    """Return an AR4 and its Teensy, homed."""
    homing = tuple(np.random.default_rng([seed, 30]).uniform(-ZERO_DEG, ZERO_DEG, 6).tolist())
    mechanics = Ar4Mechanics(homing_deg=homing)
    if given == Imperfections():
        mechanics = Ar4Mechanics((0.0,) * 6, (0.0,) * 6, 0.0)
    arm = ControlledArm(true, Ar4Teensy(seed=seed, homing_s=0.1, mechanics=mechanics))
    board = Ar4Board.connect(SteppedLink(arm), now=lambda: arm.t_s, name="the emulated AR4")
    board.home()
    board.enable()
    begin, rest = board.receive().q[-1], np.zeros(6)
    for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
        board.send(JointCommand(begin + share * (true.home - begin), rest, rest, STEP_S))
        board.receive(_STEP_S)
    return arm, board


#: Name of an arm's model -> its controller.
CONTROLLED: Mapping[str, Controlled] = {"so101": Controlled(FEETECH, _so101), "ar4": Controlled(AR4, _ar4)}
_UR = (0.0, -105.0, -108.0, 23.0, 73.0, 80.0)
#: Name of an arm's model -> joint angles at which it stands before the cameras, degrees: its tool looks at them, away from
#: its base, and no joint is near a limit or a singularity. Another stands at its own home.
STANDS: Mapping[str, tuple[float, ...]] = {
    "so101": (0.0, -20.0, 20.0, 0.0, 0.0),
    "ar4": (0.0, 10.0, -50.0, 0.0, 40.0, 0.0),
    "xarm6": (0.0, 20.0, -44.0, -8.0, -72.0, -15.0),
    "puma560": (0.0, 102.0, 13.0, -38.0, -40.0, -44.0),
    "irb120": (0.0, 21.0, 36.0, 2.0, -64.0, 105.0),
    **dict.fromkeys(("ur3", "ur5", "ur10", "ur3e", "ur5e", "ur10e"), _UR),
}


def standing(arm: Arm) -> Arm:
    """Return an arm whose home is where it stands before the workcell's cameras."""
    return replace(arm, home=np.radians(STANDS[arm.name])) if arm.name in STANDS else arm
