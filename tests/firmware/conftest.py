"""The firmware as a shared library, built once for the whole run."""

import ctypes

import pytest
from firmware_arm import LabArm, declare
from firmware_build import HOST_FILE, build_host, compilers
from firmware_layout import c
from firmware_pil import BAUD, Host, PilBoard, working_board
from firmware_wire import BareWire

from armsight.firmware import build
from made_once import made_once


@pytest.fixture(scope="session")
def mavlink():
    """The folder of the dialect's generated C headers."""
    pytest.importorskip("pymavlink", reason="needs pymavlink to generate the dialect: pip install pymavlink")
    return made_once("mavlink", lambda folder: build.generate("C", folder))


@pytest.fixture(scope="session")
def library_files(mavlink):
    """The host build of every compiler found, by the compiler's name."""
    found = compilers()
    if not found:
        pytest.skip("no C compiler: install gcc, or ziglang from PyPI")

    def built(name):
        return made_once(f"host-{name}", lambda folder: build_host(found[name], folder, mavlink)) / HOST_FILE

    return {name: built(name) for name in found}


@pytest.fixture(scope="session")
def libraries(library_files):
    """The same, loaded."""
    return {name: declare(ctypes.CDLL(str(path))) for name, path in library_files.items()}


@pytest.fixture
def working(library_files, tmp_path):
    """An emulated board with a good configuration, and a host that has greeted it."""
    return working_board(next(iter(library_files.values())), tmp_path)


@pytest.fixture
def fresh(library_files, tmp_path):
    """An emulated board just unpacked, and a host that has not said anything yet."""
    board = PilBoard(next(iter(library_files.values())), tmp_path)
    return board, Host(board)


@pytest.fixture(scope="session")
def library(libraries):
    """The host build of the first compiler found."""
    return next(iter(libraries.values()))


@pytest.fixture
def arm(library):
    """An arm fresh from power-up."""
    return LabArm(library)


@pytest.fixture
def moving(arm):
    """An arm that follows a sine without a fault."""
    arm.enable()
    arm.wander(500)
    assert (arm.outputs.state, arm.outputs.faults) == (c.STATE_ENABLED, 0)
    return arm


@pytest.fixture
def fresh_wire(library):
    """A wire without a board, that nobody has greeted."""
    return BareWire(library, BAUD)
