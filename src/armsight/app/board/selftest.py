"""The board's self-test: every scenario on a fresh board, what it did as a hash, how fast it runs, how large it is."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from armsight import firmware
from armsight.app.board.scenarios import AT_REST, DRIVEN, EMULATED_ONLY, Bench, Scenario
from armsight.data import Array
from armsight.errors import ArmsightError
from armsight.firmware.elf import read_elf
from armsight.robot.boards.board import Board
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.link import Emulator
from armsight.robot.boards.opening import SERIAL, configured, emulator_name, open_emulator
from armsight.robot.boards.serial import BAUD, SerialLink
from armsight.sim.joints import JointPlant

#: A real arm swings by so much where it is told to move: less than 3 degrees.
_SMALL_RAD = 0.05
_SPEED_TICKS = 4000
_SPEED_S = 1.0


@dataclass(frozen=True)
class ScenarioResult:
    """What one scenario found.

    Attributes:
        problems: what was not as it must be; empty where it passed.
        trace_sha256: of every answer frame of the run, in order; None on a real board, which has none.
    """

    problems: tuple[str, ...]
    trace_sha256: str | None


@dataclass(frozen=True)
class Selftest:
    """What the self-test found.

    Attributes:
        board: its name.
        scenarios: by name.
        ticks_per_s: how fast the board runs, plant and telemetry with it; a real one by this computer's clock.
        elf: flash_bytes, ram_bytes and hard_float of the emulated image; None each where the image is not known.
    """

    board: str
    scenarios: Mapping[str, ScenarioResult]
    ticks_per_s: float
    elf: Mapping[str, int | bool | None]

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
            "elf": dict(self.elf),
        }


def run_scenario(scenario: Scenario, machine: Emulator) -> ScenarioResult:
    """Run a scenario on a fresh emulated board; the machine is closed after it."""
    trace, plant = hashlib.sha256(), JointPlant()
    link = EmulatedLink(machine, plant, watch=trace.update)
    problems: list[str] = []
    try:
        configured(link)
        scenario(Bench(link, plant, problems))
    except ArmsightError as error:
        problems.append(str(error))
    finally:
        link.close()
    return ScenarioResult(tuple(problems), trace.hexdigest())


def speed(machine: Emulator, ticks: int = _SPEED_TICKS) -> float:
    """Return how many ticks a second an emulated board runs, plant and telemetry with it; the machine is closed."""
    link = EmulatedLink(machine, JointPlant())
    try:
        configured(link)
        start = time.perf_counter()
        link.step(ticks)
        return ticks / (time.perf_counter() - start)
    finally:
        link.close()


def selftest(board: str, *, drives: bool = False, baud: int = BAUD, told: Callable[[str], None] = print) -> Selftest:
    """Run the scenarios on a board.

    Args:
        board: ``emulated:unicorn``, ``emulated:qemu``, ``emulated:host`` or ``serial:PORT``.
        drives: let a real board move its arm, by less than 3 degrees; without it its drives are never switched on.
        baud: of a serial port.
        told: called with what is being done, a line at a time.

    Raises:
        DeviceError: the board is not there, or of another version.
        InputError: there is no such kind of board.
    """
    if board.startswith(SERIAL):
        return _of_real(board, drives, baud, told)
    machine = emulator_name(board)
    scenarios = {}
    for name, scenario in DRIVEN.items():
        told(name)
        scenarios[name] = run_scenario(scenario, open_emulator(machine))
    told("speed")
    elf = read_elf(firmware.image())
    figures = {"flash_bytes": elf.flash_bytes, "ram_bytes": elf.ram_bytes, "hard_float": elf.hard_float}
    return Selftest(board, scenarios, speed(open_emulator(machine)), figures)


def _of_real(board: str, drives: bool, baud: int, told: Callable[[str], None]) -> Selftest:
    """Run what is safe on a real board; it is told to stay, or after moving to switch its drives off."""
    port = board.removeprefix(SERIAL)
    chosen = {name: run for name, run in DRIVEN.items() if name not in EMULATED_ONLY} if drives else AT_REST
    scenarios = {}
    home_rad: Array | None = None
    for name, scenario in chosen.items():
        told(name)
        problems: list[str] = []
        link = SerialLink.open(port, baud)
        bench = Bench(link, None, problems, amplitude_rad=_SMALL_RAD, home_rad=home_rad, name=port)
        home_rad = bench.home_rad
        try:
            scenario(bench)
        except ArmsightError as error:
            problems.append(str(error))
        finally:
            bench.end()
        scenarios[name] = ScenarioResult(tuple(problems), None)
    told("speed")
    unknown = {"flash_bytes": None, "ram_bytes": None, "hard_float": None}
    return Selftest(board, scenarios, _ticks_per_s(port, baud), unknown)


def _ticks_per_s(port: str, baud: int) -> float:
    """Return how many ticks a real board makes in a second of this computer's clock."""
    with Board.connect(SerialLink.open(port, baud), name=port) as board:
        board.receive(0.1)
        start, from_s = time.perf_counter(), board.joints.t_s
        board.receive(_SPEED_S)
        took_s = time.perf_counter() - start
        return (board.joints.t_s - from_s) * board.welcome.ticks_per_s / took_s
