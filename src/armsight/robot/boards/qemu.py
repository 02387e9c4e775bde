"""The firmware's ARM image under QEMU: a whole Cortex-M4F board, mps2-an386, with its interrupts and SysTick.

Frames go through the emulation's standard input and output by semihosting. The emulated time is counted in
instructions, 128 ns each: it runs as fast as it can and always the same, and does not wait long for its timer.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from pathlib import Path
from typing import IO, Self, cast

from armsight.errors import DeviceError, InputError
from armsight.robot.boards.frames import ANSWER

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
