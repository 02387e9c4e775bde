"""The board's self-test: every scenario on a fresh board, a hash of its answers, its speed and its size.

In: the name of a board. Out: a :class:`SelftestResult`.
"""

from __future__ import annotations

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
#: Over how much the speed is measured: of an emulated board ticks, of a real one s.
_SPEED_TICKS, _SPEED_S = 4000, 1.0
#: Of an emulated image: flash memory, its variables without the stack, whether it is built for the floating-point unit.
_SIZES = ("flash_bytes", "ram_bytes", "hard_float")


@dataclass(frozen=True)
class ScenarioResult:
    """What one scenario found."""

    problems: tuple[str, ...]  #: what was not as it must be; empty where it passed
    trace_sha256: str | None  #: of every answer frame of the run, by time; None on a real board, which has none


@dataclass(frozen=True)
class SelftestResult:
    """What the self-test found."""

    board: str  #: its name
    scenarios: Mapping[str, ScenarioResult]  #: by name
    ticks_per_s: float  #: how fast the board runs, plant and telemetry with it; a real one by this computer's clock
    elf: dict[str, int | bool | None]  #: sizes of the emulated image, None where it is not known

    @property
    def passed(self) -> bool:
        """Whether every scenario passed."""
        return not any(each.problems for each in self.scenarios.values())

    def record(self) -> dict[str, Any]:
        """Return it ready for JSON."""
        scenarios = {
            name: {"passed": not each.problems, "trace_sha256": each.trace_sha256}
            for name, each in self.scenarios.items()
        }
        speed = round(self.ticks_per_s, 1)
        return {"board": self.board, "scenarios": scenarios, "ticks_per_s": speed, "elf": self.elf}


def run_scenario(scenario: Scenario, emulator: Emulator) -> ScenarioResult:
    """Run a scenario on a fresh emulated board; the emulator is closed after it."""
    trace, plant, problems = hashlib.sha256(), JointPlant(), list[str]()
    link = EmulatedLink(emulator, plant, watch=trace.update)
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
    scenarios = {}
    if board.startswith(SERIAL):
        port, home_rad = board.removeprefix(SERIAL), None
        for name in [each for each in DRIVEN if (each not in EMULATED_ONLY if drives else each in AT_REST)]:
            progress(name)
            scenarios[name], home_rad = _on_real(port, baud, DRIVEN[name], drives, home_rad)
        progress("speed")
        return SelftestResult(board, scenarios, _ticks_per_s(port, baud), dict.fromkeys(_SIZES))
    emulator = emulator_name(board)
    for name, scenario in DRIVEN.items():
        progress(name)
        scenarios[name] = run_scenario(scenario, open_emulator(emulator))
    progress("speed")
    elf = read_elf(firmware.image())
    sizes = {name: getattr(elf, name) for name in _SIZES}
    return SelftestResult(board, scenarios, speed(open_emulator(emulator)), sizes)


def _on_real(
    port: str, baud: int, scenario: Scenario, drives: bool, home_rad: Array | None
) -> tuple[ScenarioResult, Array]:
    """Run a scenario on a real board, its drives off afterwards; returns where its joints are at home, too."""
    problems, link = list[str](), SerialLink.open(port, baud)
    rig = BoardTestRig.connect(
        link, None, problems, amplitude_rad=_SMALL_RAD, home_rad=home_rad, driven=drives, name=port
    )
    try:
        scenario(rig)
    except ArmsightError as error:
        problems.append(str(error))
    finally:
        rig.end()
    return ScenarioResult(tuple(problems), None), rig.home_rad


def _ticks_per_s(port: str, baud: int) -> float:
    """Return how many ticks a real board makes in a second of this computer's clock."""
    with Board.connect(SerialLink.open(port, baud), name=port) as board:
        board.receive(0.1)
        start, from_s = time.perf_counter(), board.joints.t_s
        board.receive(_SPEED_S)
        took_s = time.perf_counter() - start
        return (board.joints.t_s - from_s) * board.welcome.ticks_per_s / took_s
