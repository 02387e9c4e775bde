"""Interrupts (Ctrl-C, SIGTERM), and those that must wait until something is complete."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType


def terminate_as_interrupt() -> None:
    """Let SIGTERM end this process as Ctrl-C does: the arm is stopped, what was measured is kept. Workers end at once."""
    if threading.current_thread() is not threading.main_thread():
        return
    process = os.getpid()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if os.getpid() == process:
            signal.default_int_handler(number, frame)
        os._exit(128 + number)

    signal.signal(signal.SIGTERM, interrupt)


@contextlib.contextmanager
def uninterrupted() -> Iterator[list[int]]:
    """Delay interrupts within the block; it is given a list to which those that came are appended."""
    held: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # only the main thread is interrupted
        yield held
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda came, _: held.append(came)) for number in numbers]
    try:
        yield held
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
