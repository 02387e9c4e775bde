"""A workcell as devices are: its board behind a pseudo-terminal, its cameras stamped by another clock, time of its own.

The board's clock goes on by itself, a millisecond at a time and not faster than real time; where the computer is loaded
it goes slower, and the host's waits with it. It does not wait for what the host computes: what the host does not read in
time is lost, and a host that is silent for SILENT_TICKS stops the arm. That is 15 times what boards usually allow, as the
simulation and other tests take time from the host; the calibrations take longer. The host's clock is tied to the board's.
"""

import time
from dataclasses import replace

import numpy as np
from board_rigs import PtyCable

from armsight.robot.board_registry import configured
from armsight.sim.workcell.workcell import Workcell

#: The host's clock when the board's is 0, s; by how much it is faster; how far stamps are off, s.
OFFSET_S, DRIFT, JITTER_S = 12345.678, 50e-6, 2e-4
SILENT_TICKS = 1500


class PtyWorkcell(PtyCable):
    """A workcell on the other side of a cable."""

    def __init__(self, **options):
        self.workcell = Workcell.open(emulator="host", **options)
        config = self.workcell.board.configuration()
        config["silence_ticks"] = SILENT_TICKS
        configured(self.workcell.link, config)
        super().__init__(self.workcell.link)

    def now(self):
        """Return the host's clock."""
        return self.host_s(self.workcell.t_s)

    def host_s(self, board_s):
        return OFFSET_S + (1 + DRIFT) * board_s

    def _say(self):
        """Give what the port takes; nobody reads the rest: lost."""
        super()._say()
        self._unread.clear()

    def close(self):
        super().close()
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
