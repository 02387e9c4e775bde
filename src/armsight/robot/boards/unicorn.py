"""The firmware's ARM image under Unicorn: an emulated Cortex-M4F that comes by pip alone.

Unicorn has neither interrupts nor semihosting: ``pil_boot`` is called once and then ``pil_tick`` for every frame.
"""

from __future__ import annotations

import importlib
import mmap
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from armsight.errors import DeviceError, InputError
from armsight.firmware.elf import Elf, read_elf

_FLASH, _FLASH_BYTES = 0, 0x40000
_RAM, _RAM_BYTES = 0x20000000, 0x10000
_CONTROL, _CONTROL_BYTES = 0xE000E000, 0x1000  # the processor's own registers: here plain memory
_FPU_ON = 0x40000000  # FPEXC.EN
_THUMB = 1
#: What calls a function, at the end of the flash where nothing else lies: ``blx r4; wfi; b _END``. By the procedure call
#: standard a function leaves r4 and the stack pointer as they were, so neither has to be set again for the next tick. The
#: wait for an interrupt ends the emulation; where it ends by an address, Unicorn translates the code there anew every time.
_CALL, _CALLER = _FLASH_BYTES - 16, b"\xa0\x47\x30\xbf\x02\xe0"
_END = _CALL + 12


def _fill(code: int, data: int, _uc: object, address: int, _access: int, entry: Any, _user: object) -> bool:  # noqa: ANN401
    """Map a page that is not in the TLB to itself: code may be read and run, data read and written."""
    entry.paddr, entry.perms = address, code if address < _FLASH + _FLASH_BYTES else data
    return True


class UnicornEmulator:
    """The board ``pil``'s image in an emulated processor ``uc``; :meth:`open` reads it from a file."""

    def __init__(self, elf: Elf) -> None:
        try:
            unicorn: Any = importlib.import_module("unicorn")  # it comes without types
            arm_const: Any = importlib.import_module("unicorn.arm_const")
        except ImportError:
            raise InputError(
                "emulated:unicorn needs unicorn (GPL-2.0): pip install 'armsight[sim]'; or use emulated:qemu, emulated:host"
            ) from None
        self._error: type[Exception] = unicorn.UcError
        self._stack, self._callee = arm_const.UC_ARM_REG_SP, arm_const.UC_ARM_REG_R4
        self._symbols, self._sizes = elf.symbols, elf.sizes
        self.uc: Any = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self.uc.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)
        self.uc.mem_map(_FLASH, _FLASH_BYTES)
        self.uc.mem_map(_CONTROL, _CONTROL_BYTES)
        # The board's RAM is memory of ours, so that frames need no call to be written or read. No code runs there.
        self._ram = mmap.mmap(-1, _RAM_BYTES)
        data = unicorn.UC_PROT_READ | unicorn.UC_PROT_WRITE
        self.uc.mem_map_ptr(_RAM, _RAM_BYTES, data, np.frombuffer(self._ram, np.uint8).ctypes.data)
        # The processor's own map lets code run in RAM, and Unicorn takes every store to such a page through a slow path
        # that looks for translated code: more than half of a tick's time. These permissions are in place of that map.
        self.uc.ctl_set_tlb_mode(unicorn.UC_TLB_VIRTUAL)
        code = unicorn.UC_PROT_READ | unicorn.UC_PROT_EXEC
        self.uc.hook_add(unicorn.UC_HOOK_TLB_FILL, partial(_fill, code, data))
        for segment in elf.segments:
            self.uc.mem_write(segment.load_address, segment.data)
        self.uc.mem_write(_CALL, _CALLER)
        self.uc.reg_write(arm_const.UC_ARM_REG_FPEXC, _FPU_ON)
        self._request = self._address("pil_request_frame")
        self._answer = self._address("pil_answer_frame")
        self._called, self._tick = 0, self._symbols["pil_tick"] | _THUMB
        self._call(self._symbols["pil_boot"] | _THUMB)

    @classmethod
    def open(cls, image: Path) -> Self:
        """Boot an ELF file of the board ``pil``; InputError where it is none, or unicorn is not installed."""
        return cls(read_elf(image))

    def tick(self, request: bytes) -> bytes:
        """Run one tick on a request frame and return the answer frame."""
        self._ram[self._request] = request
        self._call(self._tick)
        return self._ram[self._answer]

    def close(self) -> None:
        """End the emulation."""
        self.uc = None

    def _address(self, name: str) -> slice:
        """Return the bytes of the RAM that a variable takes."""
        start = self._symbols[name] - _RAM
        return slice(start, start + self._sizes[name])

    def _call(self, function: int) -> None:
        try:
            if function != self._called:
                self.uc.reg_write(self._stack, self._symbols["stack_top"])
                self.uc.reg_write(self._callee, function)
                self._called = function
            self.uc.emu_start(_CALL | _THUMB, _END)
        except self._error as error:
            self._called = 0  # where the stack stands is not known
            raise DeviceError(f"the emulated board broke down: {error}") from None
