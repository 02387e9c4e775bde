"""The whole Nucleo: a host on the wire, potentiometers on the converter, PWM on the pins, against the core on this host.

Every tick the same inputs go to the core's host build; what it asks for must stand in the timers' registers.
"""

import ctypes
import zlib
from dataclasses import dataclass

import numpy as np
import pytest
from firmware_arm import LabArm, lab_config
from firmware_layout import c
from stm32f4_build import COMPILERS, fresh
from stm32f4_emulator import FLASH
from stm32f4_registers import ADC_CHANNEL

from armsight.firmware import dialect


@dataclass(frozen=True)
class Wiring:
    """A board's pins, one of each for a joint, and its PWM's steps."""

    board: str
    pwm: tuple[str, ...]
    direction: tuple[str, ...]
    pots: tuple[str, ...]
    supply: str
    enable: str
    steps: int


NUCLEO = Wiring(
    "stm32f4",
    ("PA8", "PA9", "PA10", "PC6", "PC7", "PC8"),
    ("PB2", "PB14", "PB15", "PB8", "PB9", "PB10"),
    ("PC0", "PC1", "PC2", "PC3", "PC4", "PC5"),
    "PA5",
    "PC9",
    4500,
)
PWM_PINS = NUCLEO.pwm
COPIES = (FLASH + 0x4000, FLASH + 0x8000)
SUPPLY_LEVEL = 709  # of 4096: 12 V behind the divider by 21
SUPPLY_MV = 16 * SUPPLY_LEVEL * 69300 >> 16


def sealed(config, serial: int) -> bytes:
    copy = c.config_copy(0x31435341, c.CONFIG_VERSION, serial, config, 0)
    return bytes(copy)[:-4] + zlib.crc32(bytes(copy)[:-4]).to_bytes(4, "little")


class Nucleo:
    """An emulated Nucleo with an arm and a host, and the same arm on the core's host build."""

    def __init__(
        self, compiler: str, library, *, watchdog: bool = False, wiring: Wiring = NUCLEO, joints: int = 0
    ) -> None:
        self.wiring, self.emulator = wiring, fresh(compiler, wiring.board)
        self.chip = self.emulator.chip
        self.chip.inputs |= {"PA6": 0, "PB12": 0}
        if watchdog:
            self.chip["RCC.CSR"] |= 1 << 29
        self.config = lab_config(library)
        self.config.joint_count = joints or len(wiring.pwm)
        for copy, at in enumerate(COPIES):
            self.emulator.uc.mem_write(at, sealed(self.config, copy + 1))
        self.arm = LabArm(library, self.config, watchdog=watchdog)
        self.arm.spoil = self._converter
        self.emulator.boot()
        self.host = dialect().MAVLink(None)
        self.host.robust_parsing = True
        self.said: dict[str, list] = {}
        self.sequence = 0

    def _converter(self, arm) -> None:
        """What the converter makes of the plant's angles: 12 bits, the same in every scan."""
        arm.inputs.supply_mv = SUPPLY_MV
        for i, pin in enumerate(self.wiring.pots):
            level = arm.inputs.counts[i] >> 4
            arm.inputs.counts[i] = 16 * level
            self.chip.levels[ADC_CHANNEL[pin]] = level
        self.chip.levels[ADC_CHANNEL[self.wiring.supply]] = SUPPLY_LEVEL
        arm.inputs.stop_pressed = self.chip.input("PB12")

    def run(self, ticks: int = 1) -> None:
        """Let both run, and compare what the pins do with what the core asks for."""
        for _ in range(ticks):
            self.arm.tick()
            data = self.emulator.millisecond()
            for message in self.host.parse_buffer(data) or []:
                self.said.setdefault(message.get_type(), []).append(message)
            self.compare()

    def compare(self) -> None:
        expected = self.arm.outputs
        wiring = self.wiring
        duties = np.array(expected.duty, np.float32)[: len(wiring.pwm)]
        steps = np.floor(np.abs(duties) * np.float32(wiring.steps) + np.float32(0.5)).astype(int)
        assert self.chip.output(wiring.enable) == float(bool(expected.drives_on or expected.windings_shorted))
        assert [self.chip.output(pin) for pin in wiring.pwm] == [
            step / wiring.steps * expected.drives_on for step in steps.tolist()
        ]
        if expected.drives_on or expected.windings_shorted:
            assert [self.chip.output(pin) for pin in wiring.direction] == (duties < 0.0).astype(float).tolist()
        assert self.chip.wrongs == []

    def send(self, message) -> None:
        """Send a message; what it asks for comes into force a tick after the next, as bytes take their time."""
        self.chip.receive(message.pack(self.host))
        self.run()

    def hello(self) -> None:
        version = dialect().ARMSIGHT_DIALECT_VERSION
        self.send(dialect().MAVLink_hello_message(version, c.CONFIG_VERSION, 77))
        self.run(2)

    def command(self, kind: int) -> None:
        self.sequence += 1
        self.send(dialect().MAVLink_command_message(self.sequence, self.session, kind))
        self.arm.inputs.command.kind, self.arm.inputs.command.sequence = kind, self.sequence
        self.run()

    def move(self, position_rad: float, ticks: int) -> None:
        self.sequence += 1
        positions = [position_rad * (-1) ** i for i in range(c.JOINTS)]
        self.send(dialect().MAVLink_move_message(self.sequence, self.session, ticks, positions, [0.0] * 6, [0.01] * 6))
        command = self.arm.inputs.command
        command.kind, command.sequence, command.move.duration_ticks = c.COMMAND_MOVE, self.sequence, ticks
        for i in range(c.JOINTS):
            command.move.position_rad[i] = positions[i]
            command.move.gravity_duty[i] = 0.01
        self.run()

    @property
    def session(self) -> int:
        """The session that the last hello began."""
        return self.said["WELCOME"][-1].session

    @property
    def status(self):
        return self.said["BOARD_STATUS"][-1]


@pytest.fixture(params=COMPILERS)
def nucleo(request, library):
    return Nucleo(request.param, library)


@pytest.fixture
def moving(nucleo):
    """One whose arm is under way."""
    nucleo.hello()
    nucleo.command(c.COMMAND_ENABLE)
    nucleo.move(0.3, 100)
    nucleo.run(60)
    assert nucleo.arm.outputs.state == c.STATE_ENABLED
    assert max(map(nucleo.chip.output, PWM_PINS)) > 0.02
    return nucleo


def test_it_says_who_it_is(nucleo):
    nucleo.run(3)
    nucleo.hello()
    (welcome,) = nucleo.said["WELCOME"]
    assert (welcome.board, welcome.baud, welcome.joints, welcome.nonce) == ("nucleo-f446re", 921600, 6, 77)
    assert welcome.config_source == c.CONFIG_NEWEST


def test_a_potentiometers_counts_become_compare_values(moving):
    """Through converter, DMA, core, wire and timers, for half a second there and back: ``run`` compares every tick."""
    for swing in range(8):
        moving.move((0.3, -0.2)[swing % 2], 50)
        moving.run(50)
    assert moving.arm.outputs.faults == 0
    last = moving.said["ANGLES"][-1]
    assert last.angle_rad == pytest.approx(list(moving.arm.outputs.angle_rad), abs=0.02)
    assert moving.status.acknowledged_sequence == moving.sequence
    assert moving.status.supply_mv == SUPPLY_MV
    assert (moving.status.crc_errors, moving.status.lost_bytes, moving.status.overrun_bytes) == (0, 0, 0)


def test_the_angles_reported_are_those_of_the_tick_they_name(moving):
    moving.arm.history.clear()
    begin = moving.arm.inputs.tick
    moving.run(40)
    reported = {message.tick: message for message in moving.said["ANGLES"]}
    compared = 0
    for offset, raw in enumerate(moving.arm.history, start=1):
        if message := reported.get(begin + offset):
            assert list(message.angle_rad) == list(c.core_outputs.from_buffer_copy(raw).angle_rad)
            compared += 1
    assert compared > 20


def test_a_silent_host_lets_the_arm_slow_down(moving):
    """The silence limit passes, the arm stops by itself; again every tick as the core on this computer has it."""
    moving.run(moving.config.silence_ticks + 200)
    assert moving.status.first_fault == c.FAULT_HOST_SILENT


def test_the_emergency_stop_acts_before_the_tick_and_is_reported(moving):
    moving.chip.set_input("PA6", 1)
    moving.chip.set_input("PB12", 1)
    assert [moving.chip.output(pin) for pin in PWM_PINS] == [0.0] * 6
    moving.run(3)
    assert moving.arm.outputs.state == moving.status.state == c.STATE_STOPPED
    moving.chip.set_input("PA6", 0)
    moving.chip.set_input("PB12", 0)
    moving.run(20)
    moving.command(c.COMMAND_CLEAR_STOP)
    moving.command(c.COMMAND_ENABLE)
    moving.move(0.1, 50)
    moving.run(60)
    assert moving.status.state == c.STATE_ENABLED
    assert moving.chip.output("PC9") == 1.0


def test_a_dead_converter_releases_the_arm(moving):
    """Nothing is converted any more: the readings are open ones, not the last ones for ever."""
    moving.chip.scans = lambda count: None
    for _ in range(moving.config.pot_ticks + 2):
        moving.emulator.millisecond()
    assert moving.chip.output("PC9") == 1.0  # awake at no duty: the windings are shorted
    assert [moving.chip.output(pin) for pin in PWM_PINS] == [0.0] * 6
    assert moving.chip.wrongs == []


def test_a_tick_that_takes_too_long_is_reported_and_its_millisecond_counted(moving):
    """SysTick comes while the tick still runs."""
    running = moving.emulator.symbols["running"]
    moving.emulator.uc.mem_write(running, b"\1\0\0\0")
    moving.emulator.interrupt(15)
    moving.emulator.uc.mem_write(running, b"\0\0\0\0")
    moving.arm.inputs.tick += 1
    moving.arm.inputs.overrun = 1
    moving.run()
    moving.arm.inputs.overrun = 0
    moving.run(200)
    assert moving.status.faults == 1 << c.FAULT_TICK_MISSED | 1 << c.FAULT_TICK_OVERRUN
    assert moving.status.state == c.STATE_HOLDING
    moving.command(c.COMMAND_CLEAR_FAULTS)  # rejected as long as a cause stands: reported once, it does not
    moving.run(10)
    assert (moving.status.state, moving.status.faults) == (c.STATE_HOLDING, 0)


def test_the_watchdog_is_fed_once_a_tick_and_not_by_a_broken_core(moving):
    fed = moving.chip.fed
    moving.run(25)
    assert moving.chip.fed == fed + 25
    guard = moving.emulator.symbols["loop"] + 4  # the core follows the pointer to its board
    moving.emulator.uc.mem_write(guard, b"\0\0\0\0")
    for _ in range(5):
        moving.emulator.millisecond()
    assert moving.chip.fed == fed + 25
    assert moving.chip.output("PC9") == 0.0


@pytest.mark.parametrize("compiler", COMPILERS)
def test_a_restart_by_the_watchdog_keeps_the_drives_off_until_it_is_cleared(compiler, library):
    nucleo = Nucleo(compiler, library, watchdog=True)
    nucleo.hello()
    nucleo.run(30)
    assert nucleo.status.first_fault == c.FAULT_WATCHDOG
    nucleo.command(c.COMMAND_ENABLE)
    nucleo.run(30)
    assert nucleo.status.rejection == c.REJECTION_WRONG_STATE
    assert nucleo.chip.output("PC9") == 0.0


def test_a_configuration_from_the_wire_is_stored_beside_the_newest(nucleo):
    """Part by part, checked, sealed and written; the ticks go on without a gap in their count."""
    nucleo.hello()
    config = type(nucleo.config).from_buffer_copy(bytes(nucleo.config))
    config.silence_ticks = 321
    raw = bytes(config)
    for offset in range(0, len(raw), 200):
        part = raw[offset : offset + 200]
        padded = list(part.ljust(200, b"\0"))
        nucleo.send(dialect().MAVLink_config_part_message(offset, len(raw), len(part), padded))
        nucleo.run(3)
    nucleo.send(dialect().MAVLink_config_store_message(1, zlib.crc32(raw), nucleo.session))
    nucleo.run(30)
    assert nucleo.status.config_stored == 1
    size = ctypes.sizeof(c.config_copy)
    copies = [bytes(nucleo.emulator.uc.mem_read(at, size)) for at in COPIES]
    assert copies == [sealed(config, 3), sealed(nucleo.config, 2)]
    assert nucleo.status.faults == 0
    assert nucleo.chip.watchdog_ms() == 10.0


def test_a_tick_and_its_stack_are_small(moving, capsys):
    """Budget: 5% of a millisecond at 180 MHz, were every instruction one clock; and half the stack."""
    moving.chip.scans(20)
    moving.emulator.interrupt(15)
    instructions = moving.emulator.count_instructions(14)
    used = moving.emulator.stack_used()
    with capsys.disabled():
        print(f"\nstm32f4: {instructions} instructions in a tick, {used} bytes of stack")
    assert 1000 < instructions < 0.05 * 180e3
    assert used < 8192
