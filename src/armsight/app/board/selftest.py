"""The board's self-test: every scenario on a fresh board, a hash of its answers, its speed and its size.

In: the name of a board. Out: a :class:`SelftestResult`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from armsight import firmware
from armsight.app.board.scenarios import AT_REST, DRIVEN, EMULATED_ONLY, BoardTestRig, Scenario
from armsight.data import Array
from armsight.errors import ArmsightError
from armsight.firmware.elf import read_elf
from armsight.robot.board_registry import SERIAL, configured, emulator_name, open_emulator
from armsight.robot.boards.board import Board
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.link import Emulator
from armsight.robot.boards.serial import BAUD, SerialLink
from armsight.sim.joints import JointPlant

#: A real arm swings by this much where it may move, rad: less than 3 degrees.
_SMALL_RAD = 0.05
#: The speed of an emulated board is measured over this many ticks.
_SPEED_TICKS = 4000
#: The speed of a real board is measured over this time, s.
_SPEED_S = 1.0


@dataclass(frozen=True)
class ScenarioResult:
    """What one scenario found.

    Attributes:
        problems: what was not as it must be; empty where it passed.
        trace_sha256: of every answer frame of the run, by time; None on a real board, which has none.
    """

    problems: tuple[str, ...]
    trace_sha256: str | None


@dataclass(frozen=True)
class ImageSize:
    """The size of an emulated image; None each where the image is not known.

    Attributes:
        flash_bytes: of flash memory.
        ram_bytes: of its variables, without the stack.
        hard_float: whether it is built for the processor's floating-point unit.
    """

    flash_bytes: int | None
    ram_bytes: int | None
    hard_float: bool | None


@dataclass(frozen=True)
class SelftestResult:
    """What the self-test found.

    Attributes:
        board: its name.
        scenarios: by name.
        ticks_per_s: how fast the board runs, plant and telemetry with it; a real one by this computer's clock.
        elf: size of the emulated image.
    """

    board: str
    scenarios: Mapping[str, ScenarioResult]
    ticks_per_s: float
    elf: ImageSize

    @property
    def passed(self) -> bool:
        """Whether every scenario passed."""
        return not any(each.problems for each in self.scenarios.values())

    def record(self) -> dict[str, Any]:
        """Return it ready for JSON."""
        return {
            "board": self.board,
            "scenarios": {
                name: {"passed": not each.problems, "trace_sha256": each.trace_sha256}
                for name, each in self.scenarios.items()
            },
            "ticks_per_s": round(self.ticks_per_s, 1),
            "elf": dataclasses.asdict(self.elf),
        }


def run_scenario(scenario: Scenario, emulator: Emulator) -> ScenarioResult:
    """Run a scenario on a fresh emulated board; the emulator is closed after it."""
    trace, plant = hashlib.sha256(), JointPlant()
    link = EmulatedLink(emulator, plant, watch=trace.update)
    problems: list[str] = []
    try:
        configured(link)
        scenario(BoardTestRig.connect(link, plant, problems))
    except ArmsightError as error:
        problems.append(str(error))
    finally:
        link.close()
    return ScenarioResult(tuple(problems), trace.hexdigest())


def speed(emulator: Emulator, ticks: int = _SPEED_TICKS) -> float:
    """Return how many ticks a second an emulated board runs, plant and telemetry with it; the emulator is closed."""
    link = EmulatedLink(emulator, JointPlant())
    try:
        configured(link)
        start = time.perf_counter()
        link.step(ticks)
        return ticks / (time.perf_counter() - start)
    finally:
        link.close()


def selftest(
    board: str, *, drives: bool = False, baud: int = BAUD, progress: Callable[[str], None] = print
) -> SelftestResult:
    """Run the scenarios on a board.

    Args:
        board: ``emulated:unicorn``, ``emulated:qemu``, ``emulated:host`` or ``serial:PORT``.
        drives: let a real board move its arm, by less than 3 degrees; without it its drives are never switched on.
        baud: of a serial port.
        progress: called with what is being done, a line at a time.

    Raises:
        DeviceError: the board is not there, or of another version.
        InputError: there is no such kind of board.
    """
    if board.startswith(SERIAL):
        return _of_real(board, drives, baud, progress)
    emulator = emulator_name(board)
    scenarios = {}
    for name, scenario in DRIVEN.items():
        progress(name)
        scenarios[name] = run_scenario(scenario, open_emulator(emulator))
    progress("speed")
    elf = read_elf(firmware.image())
    size = ImageSize(elf.flash_bytes, elf.ram_bytes, elf.hard_float)
    return SelftestResult(board, scenarios, speed(open_emulator(emulator)), size)


def _of_real(board: str, drives: bool, baud: int, progress: Callable[[str], None]) -> SelftestResult:
    """Run what is safe on a real board; its drives stay off, or are switched off after it has moved."""
    port = board.removeprefix(SERIAL)
    chosen = {name: run for name, run in DRIVEN.items() if name not in EMULATED_ONLY} if drives else AT_REST
    scenarios = {}
    home_rad: Array | None = None
    for name, scenario in chosen.items():
        progress(name)
        problems: list[str] = []
        link = SerialLink.open(port, baud)
        test_rig = BoardTestRig.connect(link, None, problems, amplitude_rad=_SMALL_RAD, home_rad=home_rad, name=port)
        home_rad = test_rig.home_rad
        try:
            scenario(test_rig)
        except ArmsightError as error:
            problems.append(str(error))
        finally:
            test_rig.end()
        scenarios[name] = ScenarioResult(tuple(problems), None)
    progress("speed")
    return SelftestResult(board, scenarios, _ticks_per_s(port, baud), ImageSize(None, None, None))


def _ticks_per_s(port: str, baud: int) -> float:
    """Return how many ticks a real board makes in a second of this computer's clock."""
    with Board.connect(SerialLink.open(port, baud), name=port) as board:
        board.receive(0.1)
        start, from_s = time.perf_counter(), board.joints.t_s
        board.receive(_SPEED_S)
        took_s = time.perf_counter() - start
        return (board.joints.t_s - from_s) * board.welcome.ticks_per_s / took_s
