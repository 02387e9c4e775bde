"""A rendered recording with truth, made and calibrated once for all tests of the command line."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from armsight.sim.example_rig import demo_recording
from armsight.sim.recording import Truth
from cli_runs import run, said_of
from made_once import made_once


@pytest.fixture
def armsight(capsys, monkeypatch):
    """Run the command line, which does not say how far it is; returns what it printed."""
    monkeypatch.setattr("armsight.app.progress._EVERY_S", math.inf)
    return partial(said_of, capsys)


@dataclass(frozen=True)
class Files:
    """Where the recording lies, and what is true of it."""

    folder: Path
    of_board: Truth
    of_arm: Truth

    @property
    def board(self):
        """Arguments that name the pictures of the board."""
        return [*self.images("board"), "--target", "chessboard:9x6:25mm"]

    def images(self, name):
        """Arguments that name the pictures of a folder."""
        return ["--source", f"pairs:{self.folder / name}/left*.png,{self.folder / name}/right*.png"]

    @property
    def rig(self):
        """The rig calibrated on the board."""
        return self.folder / "rig.json"

    @property
    def plate(self):
        """The body that the arm's recording shows."""
        return self.folder / "plate.toml"


@pytest.fixture(scope="session")
def rendered():
    """Record 12 pairs of a board and 16 shots of an end-effector, 640x360, and calibrate."""

    def make(folder):
        truth = demo_recording(folder, seed=3, image_size_px=(640, 360), boards=12, shots=16, rate_hz=4.0)
        here = Files(folder, *truth)
        assert run("calibrate", *here.board, "--lens-model", "brown5", "--folds", 4, "-o", here.rig) == 0

    folder = made_once("rendered", make)
    return Files(folder, Truth.load(folder / "board"), Truth.load(folder / "arm"))


@pytest.fixture
def full_disk(small_disk):
    """A file system of one page, full."""
    disk = small_disk("4k")
    (disk / "ballast").write_bytes(bytes(4096))
    return disk
