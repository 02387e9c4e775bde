"""The tick may come at any instruction of the main loop: nothing is torn, no command is lost or acknowledged twice.

The real image runs under Unicorn; the main loop is stopped after so many instructions, the tick is called as an interrupt
would call it, and the main loop goes on.
"""

import ctypes

import pytest
from firmware_arm import lab_config
from firmware_layout import c
from firmware_pil import Host

from armsight import firmware
from armsight.errors import InputError
from armsight.firmware.elf import read_elf
from armsight.robot.boards.emulators import open_emulator

RETURN = 0x3FFE0
STACKED = 26 * 4 + 8
#: Primes, so that in time every kind of instruction is met.
EVERY = {"pil_begin": 11, "pil_end": 5}


class Interrupted:
    """The board in Unicorn, its parts called one by one."""

    def __init__(self):
        unicorn = pytest.importorskip("unicorn", reason="needs unicorn: pip install unicorn")
        self.arm = pytest.importorskip("unicorn.arm_const")
        self.unicorn = unicorn
        try:
            self.emulator = open_emulator("unicorn")
        except InputError as missing:
            pytest.skip(str(missing))
        self.uc, self.elf = self.emulator.uc, read_elf(firmware.image())
        self.sent = bytearray()
        self.host = Host(self)
        self.number, self.said = 0, {}
        self.answer_at = self.elf.symbols["pil_answer_frame"]
        self.greet()

    def frame(self, data=b"", *, restart=0) -> bytes:
        request = c.pil_request(c.FRAME_REQUEST, c.FRAME_VERSION, self.number, restart, supply_mv=12000)
        # Every tick reads something else, so that a report put together of two is not one of either.
        request.counts[:] = [32768 + (self.number * 37 + 11 * joint) % 97 for joint in range(c.JOINTS)]
        request.length = len(data)
        request.bytes[: len(data)] = data
        self.number += 1
        return bytes(request)

    def whole(self, data=b"", *, restart=0) -> c.pil_answer:
        """A tick without an interrupt at a wrong instruction."""
        answer = c.pil_answer.from_buffer_copy(self.emulator.tick(self.frame(data, restart=restart)))
        self.keep(answer)
        return answer

    def keep(self, answer) -> None:
        self.said[answer.outputs.tick] = answer.outputs
        self.sent += bytes(answer.bytes[: answer.length])

    def greet(self) -> None:
        library = ctypes.CDLL(str(firmware.host_library()))
        config = lab_config(library)
        self.whole(self.host.hello())
        for _ in range(3):  # the answer takes more than a tick
            self.whole()
        for message in [*self.host.parts(config), self.host.store(config)]:
            self.whole(message)
        self.whole()
        self.whole(restart=c.RESTART_POWER)
        self.sent.clear()  # a message that the restart cut
        self.whole(self.host.hello())
        for _ in range(30):
            self.whole()
        self.host.sequence = 0
        self.whole(self.host.command(c.COMMAND_ENABLE))

    def call(self, name: str, stack: int, count: int = 0) -> None:
        self.uc.reg_write(self.arm.UC_ARM_REG_SP, stack)
        self.uc.reg_write(self.arm.UC_ARM_REG_LR, RETURN | 1)
        if count:
            self.uc.ctl_flush_tb()  # what is translated already is not counted
        self.uc.emu_start(self.elf.symbols[name] | 1, RETURN, count=count)

    def interrupt(self, name: str, count: int) -> bool:
        """Run a part of the main loop with the tick after ``count`` instructions; returns whether it was that long."""
        self.call(name, self.elf.symbols["stack_top"], count)
        at = self.uc.reg_read(self.arm.UC_ARM_REG_PC)
        if at == RETURN:
            return False
        kept, stack = self.uc.context_save(), self.uc.reg_read(self.arm.UC_ARM_REG_SP)
        self.call("pil_control", (stack - STACKED) & ~7)
        self.uc.context_restore(kept)
        self.uc.emu_start(at | 1, RETURN)
        return True

    def answer(self) -> c.pil_answer:
        return c.pil_answer.from_buffer_copy(bytes(self.uc.mem_read(self.answer_at, ctypes.sizeof(c.pil_answer))))

    def check(self, answers) -> None:
        """Every message says what the core said in the tick it names."""
        parser = self.host.dialect.MAVLink(None)
        parser.robust_parsing = True
        data = b"".join(bytes(answer.bytes[: answer.length]) for answer in answers)
        for message in parser.parse_buffer(data) or []:
            core = self.said.get(getattr(message, "tick", None))
            if core is None:
                continue
            if message.get_type() == "ANGLES":
                assert message.angle_rad == list(core.angle_rad)
            elif message.get_type() == "JOINTS":
                assert (message.speed_rad_s, message.duty) == (list(core.speed_rad_s), list(core.duty))
            elif message.get_type() == "BOARD_STATUS":
                assert (message.state, message.acknowledged_count) == (core.state, core.acknowledged_count)
                assert (message.crc_errors, message.stale_commands) == (0, 0)


@pytest.mark.parametrize("part", sorted(EVERY))
def test_the_tick_may_come_at_any_instruction(part):
    """A motion command comes in and telemetry of all kinds goes out; the tick comes in the midst of either."""
    board = Interrupted()
    for _ in range(16):
        board.whole()
    ram = bytes(board.uc.mem_read(0x20000000, 0x10000))
    said, number, sequence, count = dict(board.said), board.number, board.host.sequence, 1
    while True:
        board.uc.mem_write(0x20000000, ram)
        board.said, board.number, board.host.sequence = dict(said), number, sequence
        before = board.answer().outputs.acknowledged_count
        move = board.host.move(0.2)
        board.uc.mem_write(board.elf.symbols["pil_request_frame"], board.frame(move))
        if part == "pil_begin":
            if not board.interrupt(part, count):
                break
        else:  # two ticks to one frame: the second one while the first one's report is read
            board.call("pil_begin", board.elf.symbols["stack_top"])
            board.call("pil_control", board.elf.symbols["stack_top"])
            board.keep(board.answer())
            board.uc.mem_write(board.elf.symbols["pil_request_frame"], board.frame(move))
            if not board.interrupt(part, count):
                break
        board.keep(board.answer())
        if part == "pil_begin":
            board.call("pil_end", board.elf.symbols["stack_top"])
        answers = [board.answer(), *(board.whole() for _ in range(3))]
        assert answers[-1].outputs.acknowledged_count == before + 1, count
        assert answers[-1].outputs.acknowledged_sequence == board.host.sequence
        board.check(answers)
        count += EVERY[part]
    assert count > 1000, "the main loop ran to its end each time"
