"""The link to a real board: a serial port, most often USB (``/dev/ttyACM0``, ``/dev/ttyUSB0``).

An error of a port is one line: which port, what is wrong with it, what to do.
"""

from __future__ import annotations

import errno
import os
import time
from typing import Any, Self

from armsight.errors import DeviceError, InputError

BAUD = 921600
#: The longest a write may take: the port takes no more where the other side does not read.
_WRITE_S = 1.0
_NAP_S = 0.002


class SerialLink:
    """A serial port behind the contract of :class:`~armsight.robot.boards.link.Link`; :meth:`open` opens it."""

    def __init__(self, port: str, opened: Any, error: type[Exception]) -> None:  # noqa: ANN401 - pyserial has no types
        self._port, self._serial, self._error = port, opened, error

    @classmethod
    def open(cls, port: str, baud: int = BAUD) -> Self:
        """Open a serial port that nobody else has open; a board on native USB does not care for ``baud``, bits a second.

        DeviceError: it cannot be opened, and why. InputError: pyserial is not installed.
        """
        try:
            import serial
        except ImportError:
            raise InputError("serial boards need pyserial: pip install 'armsight[board]'") from None
        try:
            opened = serial.Serial(port, baud, timeout=0, write_timeout=_WRITE_S, exclusive=True)
        except (serial.SerialException, ValueError, OSError) as error:
            raise DeviceError(_why_not_opened(port, baud, error)) from None
        opened.reset_input_buffer()
        return cls(port, opened, serial.SerialException)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._serial.write(data)
        except (self._error, OSError) as error:
            raise self._gone(error) from None

    def read(self, wait_s: float = 0.0) -> bytes:
        """Return what has come, after waiting ``wait_s``."""
        until = time.monotonic() + wait_s
        data = bytearray()
        try:
            while True:
                left = until - time.monotonic()
                data += self._serial.read(max(1, self._serial.in_waiting))
                if left <= 0:
                    return bytes(data)
                time.sleep(min(left, _NAP_S))
        except (self._error, OSError, TypeError) as error:  # TypeError: pyserial's own on a port closed meanwhile
            raise self._gone(error) from None

    def close(self) -> None:
        """Close the port."""
        self._serial.close()

    def _gone(self, error: Exception) -> DeviceError:
        if not self._serial.is_open:
            return DeviceError(f"{self._port} is closed")
        return DeviceError(f"{self._port} is gone: was the cable pulled, or the board switched off? ({error})")


def require_port(port: str, baud: int) -> None:
    """Raise a DeviceError if there is no such port; only where ports are files."""
    if os.name == "posix" and not os.path.exists(port):
        raise DeviceError(_why_not_opened(port, baud, FileNotFoundError(errno.ENOENT, port)))


def list_ports() -> list[str]:
    """Return the serial ports of this computer that something is plugged into."""
    from serial.tools import list_ports as tools

    return sorted(
        port.device for port in tools.comports() if port.vid is not None or "ACM" in port.device or "USB" in port.device
    )


def _why_not_opened(port: str, baud: int, error: Exception) -> str:
    code = getattr(error, "errno", None)
    port = port or "''"
    if code == errno.ENOENT:
        found = ", ".join(list_ports())
        return f"{port}: no such port; {f'there is {found}' if found else 'no board is plugged in'}"
    if code in (errno.EACCES, errno.EPERM):
        return f"{port}: no permission; `sudo usermod -aG dialout $USER`, then log out and in again"
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{port}: in use by another program; close it first"
    if code in (errno.EISDIR, errno.ENXIO) or "Inappropriate ioctl" in str(error):
        return f"{port}: not a serial port"
    if isinstance(error, ValueError):
        return f"{port}: {baud} baud is not possible with it"
    return f"{port}: cannot be opened: {error}"
