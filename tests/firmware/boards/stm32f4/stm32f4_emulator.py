"""The Nucleo's ELF in an emulated processor (Unicorn) with the chip model behind its bus.

Unicorn has no interrupts: Python delivers them between two calls of the main loop, with all registers kept aside.
"""

import struct
from pathlib import Path

from stm32f4_chip import Chip
from stm32f4_registers import ADDRESS, NUCLEO, Part
from unicorn import UC_ARCH_ARM, UC_HOOK_CODE, UC_HOOK_MEM_WRITE, UC_MODE_MCLASS, UC_MODE_THUMB, Uc
from unicorn.arm_const import (
    UC_ARM_REG_LR,
    UC_ARM_REG_PC,
    UC_ARM_REG_PRIMASK,
    UC_ARM_REG_R0,
    UC_ARM_REG_R1,
    UC_ARM_REG_R2,
    UC_ARM_REG_R3,
    UC_ARM_REG_SP,
    UC_CPU_ARM_CORTEX_M4,
)

from armsight.firmware.elf import read_elf

FLASH, FLASH_BYTES = 0x08000000, 512 * 1024
RAM, RAM_BYTES = 0x20000000, 128 * 1024
RETURN = 0x0807FF00  # where nothing lies: a call returns here
STACK_FILL = b"\xa5"
PAGE = 0x1000
MOST_US = 60_000_000  # of one run: a loop that never ends is a failure, not a wait


class Emulator:
    """One chip with a program in its flash memory."""

    def __init__(self, elf_path: Path, part: Part = NUCLEO) -> None:
        self.chip = Chip(part)
        self.uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        self.uc.ctl_set_cpu_model(UC_CPU_ARM_CORTEX_M4)
        self.uc.mem_map(FLASH, FLASH_BYTES)
        self.uc.mem_map(RAM, RAM_BYTES)
        self.uc.mem_write(FLASH, b"\xff" * FLASH_BYTES)
        elf = read_elf(elf_path)
        self.symbols = elf.symbols
        for segment in elf.segments:
            self.uc.mem_write(segment.load_address, segment.data)
        for page in sorted({address & -PAGE for address in ADDRESS}):
            self.uc.mmio_map(page, PAGE, self._read, page, self._write, page)
        self.chip.memory_read = lambda at, size: bytes(self.uc.mem_read(at, size))
        self.chip.memory_write = self.uc.mem_write
        self.uc.hook_add(UC_HOOK_MEM_WRITE, self._program, None, FLASH, FLASH + FLASH_BYTES - 1)
        self._loop_poll = self.symbols.get("loop_poll", RETURN) & ~1
        self.uc.hook_add(UC_HOOK_CODE, self._pass, None, self._loop_poll, self._loop_poll)
        self._passes_left = 0

    def _read(self, _uc: Uc, offset: int, size: int, page: int) -> int:
        return self.chip.read(page + offset, size)

    def _write(self, _uc: Uc, offset: int, size: int, value: int, page: int) -> None:
        self.chip.write(page + offset, size, value)

    def _program(self, _uc: Uc, _access: int, at: int, size: int, value: int, _: None) -> None:
        self.chip.program(at, size, value & 0xFFFFFFFF)

    def word(self, at: int) -> int:
        """Return the word at an address or at a symbol's."""
        return struct.unpack("<I", self.uc.mem_read(at, 4))[0]

    def _vector(self, number: int) -> int:
        return self.word(FLASH + 4 * number)

    # running

    def _pass(self, uc: Uc, *_: object) -> None:
        if self._passes_left == 0:
            uc.emu_stop()
        self._passes_left -= 1

    def _run(self, begin: int, until: int, passes: int = 1) -> None:
        self._passes_left = passes
        self.uc.emu_start(begin | 1, RETURN, timeout=MOST_US)
        reached = self.uc.reg_read(UC_ARM_REG_PC)
        assert reached == until, f"stopped at {reached:#x} instead of {until:#x}"

    def call(self, function: str | int, *arguments: int) -> int:
        """Call a function of the program; return what it returns."""
        at = self.symbols[function] if isinstance(function, str) else function
        for register, value in zip(
            (UC_ARM_REG_R0, UC_ARM_REG_R1, UC_ARM_REG_R2, UC_ARM_REG_R3), arguments, strict=False
        ):
            self.uc.reg_write(register, value)
        self.uc.reg_write(UC_ARM_REG_LR, RETURN | 1)
        self._run(at, RETURN)
        return self.uc.reg_read(UC_ARM_REG_R0)

    def power_up(self, *steps: str) -> None:
        """Call these functions one after the other on a fresh stack, without the program's own start."""
        self.uc.reg_write(UC_ARM_REG_SP, self._vector(0))
        for step in steps:
            self.call(step)

    def boot(self) -> None:
        """Reset, and run until the main loop begins its first pass."""
        self.uc.mem_write(RAM, STACK_FILL * RAM_BYTES)
        self.uc.reg_write(UC_ARM_REG_SP, self._vector(0))
        self._run(self._vector(1), self._loop_poll, passes=0)

    def interrupt(self, number: int) -> None:
        """Run an interrupt's handler and come back to where the main loop was."""
        assert not self.masked()
        before = self.uc.context_save()
        # The processor puts 26 words (with the floating-point registers' space) and at most one for alignment on the stack.
        self.uc.reg_write(UC_ARM_REG_SP, (self.uc.reg_read(UC_ARM_REG_SP) - 4 * 27) & ~7)
        self.call(self._vector(number))
        self.uc.context_restore(before)

    def masked(self) -> bool:
        """Return whether interrupts wait."""
        return bool(self.uc.reg_read(UC_ARM_REG_PRIMASK))

    def run_into(self, number: int, instructions: int) -> None:
        """Run so many instructions of a handler that never comes back."""
        self.uc.emu_start(self._vector(number), RETURN, count=instructions)

    def main_loop(self) -> None:
        """Run one pass of the main loop."""
        self._run(self._loop_poll, self._loop_poll)

    def millisecond(self) -> bytes:
        """Let 1 ms pass: twenty PWM periods, a tick, a pass of the main loop; return what went out on the wire."""
        self.chip.scans(20)
        self.interrupt(15)
        assert self.chip.pended
        self.chip.pended = False
        self.interrupt(14)
        self.main_loop()
        return self.chip.send(92)

    def count_instructions(self, number: int) -> int:
        """Return how many instructions an interrupt's handler runs."""
        counted = 0

        def count(*_: object) -> None:
            nonlocal counted
            counted += 1

        self.uc.ctl_flush_tb()  # what is translated already has no hook in it
        hook = self.uc.hook_add(UC_HOOK_CODE, count)
        self.interrupt(number)
        self.uc.hook_del(hook)
        return counted

    def stack_used(self) -> int:
        """Return how many bytes of the stack were ever written."""
        top = self._vector(0)
        stack = bytes(self.uc.mem_read(RAM, top - RAM))
        return len(stack) - next(i for i in range(len(stack)) if stack[i : i + 1] != STACK_FILL)
