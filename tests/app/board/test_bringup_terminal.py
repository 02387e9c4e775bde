"""``armsight board bringup`` as a person types it: a terminal, a board at a port, a cable that is pulled, Ctrl-C.

Time is real here, so nothing is asserted on it: whatever is waited for is waited for until it comes.
"""

import os
import pty
import select
import signal
import subprocess
import sys

import pytest
from board_rigs import PtyBoard

from armsight.app.board.found import Found, JointFound
from armsight.sim.boards.workshop import drawn_workshop

pytestmark = pytest.mark.real_time


class Terminal:
    """The command at a terminal of its own, beside a fresh board with a drawn arm."""

    def __init__(self, folder, *options, known=False):
        workshop, _ = drawn_workshop(31)
        self.board, self.folder, self.seen = PtyBoard(fresh=True, plant=workshop), folder, ""
        if known:
            joint = JointFound(noise_counts=15.0, range_counts=[5000.0, 60000.0])
            sign = workshop.wiring.potentiometer_signs[0]
            joint.marks = [[c, sign * (c - 32767.5) / 11342.5] for c in joint.range_counts]
            Found("pil", [joint, *(JointFound() for _ in range(5))]).write(folder / "bringup.json")
        self.master, slave = pty.openpty()
        line = ["bringup", "--board", f"serial:{self.board.port}", "-o", str(folder), "--joint", "1", *options]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "armsight", "board", *line],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            env=os.environ | {"NO_COLOR": "1"},
        )
        os.close(slave)

    def until(self, *words):
        """Read until one of these words comes; returns what came since the last call."""
        while not any(word in self.seen for word in words):
            assert self._read(), self.seen
        said, self.seen = self.seen, ""
        return said

    def _read(self):
        ready, _, _ = select.select([self.master], [], [], 60)
        try:
            data = os.read(self.master, 4096) if ready else b""
        except OSError:  # the other side has closed
            data = b""
        self.seen += data.decode()
        return bool(data)

    def type(self, text):
        os.write(self.master, text.encode())

    def ended(self):
        """The exit code, and the last line."""
        while self._read():
            pass
        return self.process.wait(60), self.seen.strip().splitlines()[-1].strip()

    def kept(self):
        return Found.read(self.folder / "bringup.json")

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.master)
        self.board.close()


@pytest.fixture
def opened(tmp_path):
    terminals = []

    def open_one(*options, **given):
        terminals.append(Terminal(tmp_path, *options, **given))
        return terminals[-1]

    yield open_one
    for each in terminals:
        each.close()


def driven(terminal):
    """Say yes to the first motion and wait until the drives are on."""
    terminal.until("[y/n]: ")
    terminal.type("y\n")
    while not terminal.board.link.answer["outputs"]["drives_on"]:
        assert terminal.process.poll() is None, terminal.ended()


def test_ctrl_c_in_motion_switches_the_motors_off_and_keeps_what_was_found(opened):
    terminal = opened("--step", "motors", known=True)
    before = terminal.kept()
    driven(terminal)
    terminal.process.send_signal(signal.SIGINT)
    code, last = terminal.ended()
    assert (code, "Traceback" in last) == (130, False)
    outputs = terminal.board.link.answer["outputs"]
    assert (outputs["drives_on"], outputs["state"]) == (0, 0)
    assert terminal.kept().joints[0].marks == before.joints[0].marks


def test_a_cable_pulled_in_motion_is_one_line_and_the_board_lets_go(opened):
    terminal = opened("--step", "motors", known=True)
    before = terminal.kept()
    driven(terminal)
    terminal.board.pull()
    code, last = terminal.ended()
    assert code == 2
    assert "was the cable pulled" in last
    assert f"what was found is kept in {terminal.folder}: the same command goes on there" in last
    terminal.board.link.step(300)
    assert not terminal.board.link.answer["outputs"]["drives_on"]
    assert terminal.kept().joints[0].marks == before.joints[0].marks
