"""Boards for tests: the host build behind a lock-step link, and a link that replays what a board might send."""

import contextlib
import os
import pty
import select
import threading
import time
import tty

import pytest

from armsight.data import JointCommand
from armsight.errors import DeviceError
from armsight.firmware import dialect
from armsight.robot.board_registry import configured
from armsight.robot.boards import serial
from armsight.robot.boards.board_file import configuration_text
from armsight.robot.boards.configuration import CONFIG, CONFIG_VERSION
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.sim.joints import JointPlant


def written(tmp_path, config, *changes):
    """A board.toml of a configuration with pieces of its text replaced."""
    text = configuration_text(config, "pil")
    for before, after in changes:
        assert before in text
        text = text.replace(before, after, 1)
    path = tmp_path / "board.toml"
    path.write_text(text, encoding="utf-8")
    return path


def host_board(config=None, **options):
    """A configured board of the host build: (board, link, plant)."""
    plant = JointPlant()
    link = EmulatedLink(open_emulator("host"), plant, **options)
    return configured(link, config), link, plant


def hold(q, duration_s=0.01):
    """A command to be at rest at these angles."""
    return JointCommand(q, [0.0] * 6, [0.0] * 6, duration_s)


def keep_on(board, *, sends=None, times=100, wait_s=0.02):
    """Receive again and again, and send something each time: for what is to raise sooner or later."""
    for _ in range(times):
        if sends is not None:
            board.send(sends)
        board.receive(wait_s)


class ScriptedLink:
    """A link whose far side is a function: bytes written -> bytes to be read."""

    def __init__(self, answer=lambda data: b""):
        self.answer, self.waiting, self.written, self.waited_s, self.closed = answer, b"", [], 0.0, False

    def write(self, data):
        self.written.append(bytes(data))
        self.waiting += self.answer(bytes(data))

    def read(self, wait_s=0.0):
        self.waited_s += wait_s
        taken, self.waiting = self.waiting, b""
        return taken

    def close(self):
        self.closed = True


class Speaker:
    """Packs messages as a board would."""

    def __init__(self):
        self.mav = dialect().MAVLink(None, 1, 1)
        self.mav.send = lambda message, **_: self.packed.append(message.pack(self.mav)) or self._count()
        self.packed = []

    def _count(self):
        self.mav.seq = (self.mav.seq + 1) % 256

    def say(self, kind, *fields):
        self.packed.clear()
        getattr(self.mav, f"{kind}_send")(*fields)
        return self.packed[0]

    def welcome(self, *, dialect_version=None, config_version=CONFIG_VERSION, tick=0):
        ours = dialect().ARMSIGHT_DIALECT_VERSION if dialect_version is None else dialect_version
        return self.say("welcome", ours, config_version, 1, tick, 1000, 921600, 0, 6, b"stm32f4", b"9.9.9", 77)

    def status(self, tick=0, *, state=0, rejected=(0, 0, 0)):
        sequence, count, rejection = rejected
        head = (tick, state, 0, [0] * 6, 0, 255, 0, 0, sequence, count, rejection)
        return self.say("board_status", *head, 12000, 0, 0, 0, 0, 0, 0, 0)

    def joints(self, tick=0):
        return self.say("joints", tick, *[[0.0] * 6 for _ in range(4)], [0] * 6)

    def angles(self, tick, angle_rad=0.0):
        return self.say("angles", tick, [angle_rad] * 6)

    def config_part(self, offset, data):
        return self.say("config_part", offset, CONFIG.itemsize, len(data), list(data.ljust(200, b"\0")))


class PtyCable:
    """A link behind a pseudo-terminal, as a real board behind its USB cable; :attr:`port` is its name.

    Every poll of the far side lets one tick pass, not faster than real time and on a busy computer slower. The host's
    waits for the port count these ticks: what a test sees does not depend on how the computer shares its time.
    """

    def __init__(self, link):
        self.link, self.lock, self._ticks, self._unread = link, threading.Lock(), 0, bytearray()
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.port = os.ttyname(self._slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self._patch = pytest.MonkeyPatch()
        self._patch.setattr(serial, "time", self)

    def monotonic(self):
        """Return the time that the port's waits count, s."""
        return 1e-3 * self._ticks if self._thread.is_alive() else time.monotonic()

    def sleep(self, _):
        """Nap until the next look at the time."""
        time.sleep(0.0005)

    def _run(self):
        while not self._stop.wait(0.0005):
            ready, _, _ = select.select([self.master], [], [], 0)
            try:
                with self.lock:
                    if ready:
                        self.link.write(os.read(self.master, 4096))
                    self.link.step(1)
                    self._unread += self.link.read(0.0)
                    self._ticks += 1
                self._say()
            except (OSError, DeviceError):
                return

    def _say(self):
        """Give what the port takes; the rest waits."""
        with contextlib.suppress(BlockingIOError):
            del self._unread[: os.write(self.master, self._unread)]

    def pull(self):
        """Pull the cable: the port is gone, the board runs on by hand (``link.step``)."""
        self._stop.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self.master)

    def close(self):
        self._patch.undo()
        if not self._stop.is_set():
            self.pull()


class PtyBoard(PtyCable):
    """The host build behind a pseudo-terminal."""

    def __init__(self, *, fresh=False, plant=None):
        self.plant = JointPlant() if plant is None else plant
        link = EmulatedLink(open_emulator("host"), self.plant)
        if not fresh:
            configured(link)
        super().__init__(link)
