"""What tests share: one fixed hypothesis profile, the place of the real recordings, the firmware of this computer."""

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

from armsight.errors import DeviceError, InputError
from armsight.robot.boards.opening import open_emulator

ROOT = Path(__file__).resolve().parent.parent

# The same examples on every machine and in every run; no database, no clock.
settings.register_profile("ci", derandomize=True, max_examples=60, deadline=None, database=None)
settings.load_profile("ci")

# A shell's job in the background is started with interrupts ignored; tests of interrupts, and what they start, need them.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings, or a skip that says where it was looked for."""
    path = Path(os.environ.get("ARMSIGHT_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no real recordings at {path}; set ARMSIGHT_DATA to their folder")
    return path


@pytest.fixture(scope="session")
def host_firmware() -> None:
    """The firmware as code of this computer, or a skip that says why it is not there."""
    try:
        open_emulator("host").close()
    except (DeviceError, InputError) as error:
        pytest.skip(f"the firmware is not built: {error}")
