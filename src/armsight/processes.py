"""Functions that run in a second interpreter, on another core: threads of one interpreter run Python one at a time.

In: a function that makes what is called there, and its arguments. Out: what each call returns. Both sides exchange pickles
over the pipes of a child, arrays beside them without a copy. The child imports what it is asked for and nothing of the
program that started it: so a script needs no guard of its main module, as :mod:`multiprocessing` asks for.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any

from armsight.errors import ArmsightError

_SERVE = "from armsight.processes import serve; serve()"
_PIPE_BYTES = 1 << 20  # an image passes at once
_SMALL_BYTES = 1 << 14
#: A child gives way to who started it: with few cores, measuring does not wait for rendering.
_NICE = 5
_LENGTH = struct.Struct("<q")


def return_freed() -> None:
    """Return memory that was freed to the system; glibc keeps blocks as large as the largest that was freed before."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


class Process:
    """A function in a child process, which ends with :meth:`close` or with this process.

    The constructor returns at once, while the child still imports and makes. Calls of several threads wait for each other.

    Args:
        make: returns the function that is called; it can be imported by its name.
        arguments: of ``make``.
    """

    def __init__(self, make: Callable[..., Callable[..., Any]], *arguments: object) -> None:
        command = [sys.executable, "-P", "-c", _SERVE]
        self._child = subprocess.Popen(command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._lock = threading.Lock()
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        for pipe in (self._child.stdin, self._child.stdout):
            _widen(pipe)
        _send(self._child.stdin, (make, arguments))

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 - what the function returns
        """Call the function, and wait for what it returns."""
        with self._lock:
            assert self._child.stdin is not None
            assert self._child.stdout is not None
            try:
                _send(self._child.stdin, arguments)
                done, result = _receive(self._child.stdout)
            except (OSError, EOFError):
                code = self._child.poll()
                raise ArmsightError(f"a process that computes for this one has ended (exit code {code})") from None
        if not done:
            raise result
        return result

    def kill(self) -> None:
        """End the child at once, also in the middle of a call, which raises then; :meth:`close` it afterwards."""
        self._child.kill()

    def close(self) -> None:
        """End the child; harmless when called twice."""
        with self._lock:
            for pipe in (self._child.stdin, self._child.stdout):
                assert pipe is not None
                pipe.close()
            self._child.wait()


def caller(*modules: str) -> Callable[..., Any]:
    """Return what calls any function with its arguments, once these modules are imported: for :class:`Process`."""
    for module in modules:
        importlib.import_module(module)

    def call(function: Callable[..., Any], *arguments: object) -> Any:  # noqa: ANN401 - what the function returns
        return function(*arguments)

    return call


def serve() -> None:
    """Answer calls until the other side closes: what a child does. Ctrl-C is for the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(_NICE)
    requests, answers = os.fdopen(os.dup(0), "rb", 0), os.fdopen(os.dup(1), "wb", 0)
    os.dup2(2, 1)  # what is printed by accident is no answer
    function: Callable[..., Any] | None = None
    failed: Exception | None = None
    while True:
        try:
            request = _receive(requests)
        except EOFError:
            return
        if function is None and failed is None:
            make, arguments = request
            try:
                function = make(*arguments)
            except Exception as error:  # noqa: BLE001 - it is raised in the other process
                failed = error
            continue
        try:
            if failed is not None or function is None:
                raise failed or EOFError
            answer = True, function(*request)
        except Exception as error:  # noqa: BLE001 - likewise
            answer = False, error
        try:
            _send(answers, answer)
        except OSError:
            return


def _widen(pipe: IO[bytes]) -> None:
    """Make a pipe hold an image, where the system knows how and its user may; smaller ones serve as well."""
    with suppress(ImportError, AttributeError, OSError):
        import fcntl

        fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def _send(pipe: IO[bytes], content: object) -> None:
    """Write an object: the number and the sizes of its parts, its pickle, its arrays."""
    parts = [memoryview(b"")]

    def within(array: pickle.PickleBuffer) -> bool:
        """Leave a small array within the pickle."""
        raw = array.raw()
        if raw.nbytes >= _SMALL_BYTES:
            parts.append(raw)
        return raw.nbytes < _SMALL_BYTES

    parts[0] = memoryview(pickle.dumps(content, 5, buffer_callback=within))
    head = b"".join(_LENGTH.pack(size) for size in (len(parts), *(len(part) for part in parts)))
    for part in (memoryview(head), *parts):
        rest = part
        while len(rest):
            rest = rest[pipe.write(rest) :]


def _receive(pipe: IO[bytes]) -> Any:  # noqa: ANN401 - what was sent
    count = _LENGTH.unpack(_read(pipe, _LENGTH.size))[0]
    sizes = struct.unpack(f"<{count}q", _read(pipe, 8 * count))
    content, *arrays = [_read(pipe, size) for size in sizes]
    return pickle.loads(content, buffers=arrays)


def _read(pipe: Any, size: int) -> bytearray:  # noqa: ANN401 - an unbuffered file
    """Read so many bytes; other threads run meanwhile."""
    data = bytearray(size)
    rest = memoryview(data)
    while len(rest):
        count = pipe.readinto(rest)
        if not count:
            raise EOFError
        rest = rest[count:]
    return data
