"""A rendered recording with truth, made and calibrated once for all tests of the command line."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from armsight.app.cli.main import main
from armsight.sim.bench import demo_recording
from armsight.sim.recording import Truth


@dataclass(frozen=True)
class Said:
    """What one run of the command line printed, and how it ended."""

    code: int
    out: str
    err: str

    @property
    def lines(self):
        """The JSON objects on stdout, one a line; NaN and infinity are no JSON."""
        return [json.loads(line, parse_constant=_refused) for line in self.out.splitlines()]


def _refused(text):
    raise AssertionError(f"{text} is not JSON")


def run(*arguments):
    """Run ``armsight`` with arguments in this process and return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["armsight", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    return end.value.code


@pytest.fixture
def armsight(capsys):
    """Run the command line; returns a :class:`Said`."""

    def said(*arguments):
        capsys.readouterr()
        code = run(*arguments)
        got = capsys.readouterr()
        return Said(code, got.out, got.err)

    return said


@dataclass(frozen=True)
class Bench:
    """Where the recording lies, and what is true of it."""

    folder: Path
    of_board: Truth
    of_arm: Truth

    @property
    def board(self):
        """Arguments that name the pictures of the board."""
        return [*self.images("board"), "--board", "chessboard:9x6:25mm"]

    def images(self, name):
        """Arguments that name the pictures of a folder."""
        return ["--left", f"{self.folder / name}/left*.png", "--right", f"{self.folder / name}/right*.png"]

    @property
    def rig(self):
        """The rig calibrated on the board."""
        return self.folder / "rig.json"

    @property
    def plate(self):
        """The body that the arm's recording shows."""
        return self.folder / "plate.toml"


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """Record 12 pairs of a board and 16 shots of an end-effector, 640x360, and calibrate."""
    folder = tmp_path_factory.mktemp("bench")
    of_board, of_arm = demo_recording(folder, seed=3, image_size_px=(640, 360), boards=12, shots=16, rate_hz=4.0)
    here = Bench(folder, of_board, of_arm)
    assert run("calibrate", *here.board, "--model", "brown5", "--folds", 4, "-o", here.rig) == 0
    return here
