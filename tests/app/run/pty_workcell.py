"""A workcell as devices are: its board behind a pseudo-terminal, its cameras stamped by another clock, time of its own.

The board's clock goes on by itself, a millisecond at a time and not faster than real time; where the computer is loaded
it goes slower. It does not wait for the host: what the host does not read in time is lost, and a host that is silent for
SILENT_TICKS stops the arm. That is four times what boards usually allow, because on a loaded computer the host's thread
may not run for a while; the calibrations take longer still. The host's clock is tied to the board's.
"""

import contextlib
import os
import pty
import select
import threading
import time
import tty
from dataclasses import replace

import numpy as np

from armsight.errors import DeviceError
from armsight.robot.board_registry import configured
from armsight.sim.workcell.workcell import Workcell

#: The host's clock when the board's is 0, s; by how much it is faster; how far stamps are off, s.
OFFSET_S, DRIFT, JITTER_S = 12345.678, 50e-6, 2e-4
SILENT_TICKS = 400


class PtyWorkcell:
    """A workcell on the other side of a cable."""

    def __init__(self, **options):
        self.workcell = Workcell.open(emulator="host", **options)
        config = self.workcell.board.configuration()
        config["silence_ticks"] = SILENT_TICKS
        configured(self.workcell.link, config)
        self.lock = threading.Lock()
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.port = os.ttyname(self.slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def now(self):
        """Return the host's clock."""
        return self.host_s(self.workcell.t_s)

    def host_s(self, board_s):
        return OFFSET_S + (1 + DRIFT) * board_s

    def _run(self):
        link = self.workcell.link
        while not self._stop.wait(0.0005):
            ready, _, _ = select.select([self.master], [], [], 0)
            try:
                with self.lock:
                    if ready:
                        link.write(os.read(self.master, 4096))
                    link.step(1)
                    said = link.read(0.0)
                with contextlib.suppress(BlockingIOError):  # nobody reads: lost
                    os.write(self.master, said)
            except (OSError, DeviceError):
                return

    def pull(self):
        """Pull the cable: the port is gone."""
        self._stop.set()
        self._thread.join()
        os.close(self.slave)
        os.close(self.master)

    def close(self):
        if not self._stop.is_set():
            self.pull()
        self.workcell.close()


class HostStamped:
    """The workcell's cameras, stamped by the host's clock."""

    def __init__(self, far, seed=0):
        self._far, self._rng = far, np.random.default_rng(seed)
        self.closed = False

    def read(self):
        while not self.closed:
            with self._far.lock:
                shot = self._far.workcell.source.poll()
            if shot is not None:
                return replace(shot, t_s=self._far.host_s(shot.t_s) + JITTER_S * self._rng.standard_normal())
            time.sleep(0.001)
        return None

    def close(self):
        self.closed = True
