"""The emulators that run the firmware, behind :class:`~armsight.robot.boards.link.Emulator`; EMULATORS are all.

- host: compiled for this computer, the same bits as on the board, and the fastest.
- unicorn: the ARM image in an emulated Cortex-M4F that comes by pip alone. Unicorn has neither interrupts nor semihosting:
  ``pil_boot`` is called once and then ``pil_tick`` for every frame.
- qemu: the same image on a whole board, mps2-an386, with its interrupts and SysTick. Frames go through standard input and
  output by semihosting. The emulated time is counted in instructions, 128 ns each: it runs as fast as it can and always
  the same, and does not wait long for its timer.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import mmap
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import IO, Any, Self, cast

import numpy as np

from armsight import firmware
from armsight.errors import DeviceError, InputError
from armsight.firmware.elf import Elf, read_elf
from armsight.robot.boards.frames import ANSWER, REQUEST
from armsight.robot.boards.link import Emulator


class HostEmulator:
    """The board's code in a shared library, loaded for this board alone by :meth:`open`."""

    def __init__(self, loaded: ctypes.CDLL) -> None:
        self._request = (ctypes.c_char * REQUEST.itemsize).in_dll(loaded, "pil_request_frame")
        self._answer = (ctypes.c_char * ANSWER.itemsize).in_dll(loaded, "pil_answer_frame")
        self._tick, self._start = loaded.pil_tick, loaded.pil_start

    @classmethod
    def open(cls, library: Path) -> Self:
        """Load a library of the board ``host`` and start it, or raise InputError: it cannot be loaded."""
        # A library's variables exist once however often it is loaded: a second board needs a second file.
        handle, name = tempfile.mkstemp(suffix=library.suffix)
        os.close(handle)
        try:
            shutil.copyfile(library, name)
            emulator = cls(ctypes.CDLL(name))
            emulator._start()
        except (OSError, AttributeError, ValueError) as error:
            raise InputError(
                f"{library}: no host build of the firmware ({error}); run `armsight board build`"
            ) from None
        finally:
            os.unlink(name)
        return emulator

    def tick(self, request: bytes) -> bytes:
        """Run one tick on a request frame and return the answer frame."""
        ctypes.memmove(self._request, request, REQUEST.itemsize)
        self._tick()
        return self._answer.raw

    def close(self) -> None:
        """Nothing to end: the library stays loaded as long as the process lives."""


PROGRAM = "qemu-system-arm"
_OPTIONS = (
    *("-M", "mps2-an386", "-icount", "shift=7,align=off,sleep=off", "-display", "none"),
    *("-monitor", "none", "-serial", "none", "-parallel", "none", "-semihosting-config", "enable=on,target=native"),
)
_END_S = 5.0


class QemuEmulator:
    """The board's image in QEMU, a process with pipes to its input, output and error; :meth:`open` starts it."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        pipes = (process.stdin, process.stdout, process.stderr)
        self._in, self._out, self._said = (cast(IO[bytes], pipe) for pipe in pipes)

    @classmethod
    def open(cls, image: Path) -> Self:
        """Start QEMU on an ELF file of the board ``pil``, or raise InputError: QEMU is not installed."""
        program = shutil.which(PROGRAM)
        if program is None:
            raise InputError(f"{PROGRAM} is not installed: apt install qemu-system-arm, or use emulated:unicorn")
        process = subprocess.Popen(
            [program, *_OPTIONS, "-kernel", str(image)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,  # an interrupt from the keyboard is for us: the arm is to be stopped through the board
        )
        return cls(process)

    def tick(self, request: bytes) -> bytes:
        """Run one tick on a request frame and return the answer frame."""
        try:
            self._in.write(request)
            answer = self._out.read(ANSWER.itemsize)
            while answer and len(answer) < ANSWER.itemsize:
                more = self._out.read(ANSWER.itemsize - len(answer))
                answer = answer + more if more else b""
        except (BrokenPipeError, ValueError):
            answer = b""
        if not answer:
            raise DeviceError(f"the emulated board broke down: {PROGRAM} ended{self._stderr_text()}")
        return answer

    def close(self) -> None:
        """End the emulation."""
        with contextlib.suppress(BrokenPipeError):
            self._in.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._out.close()
        self._said.close()

    def _stderr_text(self) -> str:
        self._process.wait(_END_S)
        said = self._said.read().decode(errors="replace").strip()
        return f": {said}" if said else ""


#: Addresses of both memories, and of the processor's own registers: here plain memory.
_FLASH, _RAM, _CONTROL = range(0x40000), range(0x20000000, 0x20010000), range(0xE000E000, 0xE000F000)
_FPU_ON = 0x40000000  # FPEXC.EN
_THUMB = 1
#: What calls a function, at the end of the flash where nothing else lies: ``blx r4; wfi; b _END``. By the procedure call
#: standard a function leaves r4 and the stack pointer as they were, so neither has to be set again for the next tick. The
#: wait for an interrupt ends the emulation; where it ends by an address, Unicorn translates the code there anew every time.
_CALL, _CALLER = len(_FLASH) - 16, b"\xa0\x47\x30\xbf\x02\xe0"
_END = _CALL + 12


def _fill(code: int, data: int, _uc: object, address: int, _access: int, entry: Any, _user: object) -> bool:  # noqa: ANN401
    """Map a page that is not in the TLB to itself: code may be read and run, data read and written."""
    entry.paddr, entry.perms = address, code if address in _FLASH else data
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
        for memory in (_FLASH, _CONTROL):
            self.uc.mem_map(memory.start, len(memory))
        # The board's RAM is memory of ours, so that frames need no call to be written or read. No code runs there.
        self._ram = mmap.mmap(-1, len(_RAM))
        data = unicorn.UC_PROT_READ | unicorn.UC_PROT_WRITE
        self.uc.mem_map_ptr(_RAM.start, len(_RAM), data, np.frombuffer(self._ram, np.uint8).ctypes.data)
        # The processor's own map lets code run in RAM, and Unicorn takes every store to such a page through a slow path
        # that looks for translated code: more than half of a tick's time. These permissions are in place of that map.
        self.uc.ctl_set_tlb_mode(unicorn.UC_TLB_VIRTUAL)
        self.uc.hook_add(unicorn.UC_HOOK_TLB_FILL, partial(_fill, unicorn.UC_PROT_READ | unicorn.UC_PROT_EXEC, data))
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
        start = self._symbols[name] - _RAM.start
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


#: Name -> what opens the emulator of a file, and the file the package carries for it.
EMULATORS: Mapping[str, tuple[Callable[[Path], Emulator], Callable[[], Path]]] = {
    "unicorn": (UnicornEmulator.open, firmware.image),
    "qemu": (QemuEmulator.open, firmware.image),
    "host": (HostEmulator.open, firmware.host_library),
}


def open_emulator(name: str, image: Path | None = None) -> Emulator:
    """Start an emulator with a fresh board, on the package's image (for host: library) or another one.

    InputError: there is none, or what it needs is not installed. DeviceError: the firmware was not built.
    """
    if name not in EMULATORS:
        raise InputError(f"no emulator {name!r}; there are {', '.join(EMULATORS)}")
    make, built = EMULATORS[name]
    return make(image or built())
