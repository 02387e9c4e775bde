"""What tests share: one fixed hypothesis profile, the folder of the real recordings, the firmware of this computer."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

# As the commands set it, before numpy is imported: small matrices are ten times slower where OpenBLAS's threads wait.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import pytest
from _pytest.runner import runtestprotocol
from hypothesis import settings

from armsight.errors import DeviceError, InputError
from armsight.robot.boards.emulators import open_emulator
from made_once import begin, made_once

ROOT = Path(__file__).resolve().parent.parent

# The same examples on every machine and in every run; no database, no clock.
settings.register_profile("ci", derandomize=True, max_examples=60, deadline=None, database=None)
settings.load_profile("ci")

# A shell's job in the background is started with interrupts ignored; tests of interrupts, and what they start, need them.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_report_header() -> str:
    """Name what differs between the environments in which the tests run."""
    return f"OpenCV {cv2.__version__}"


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test against the clock a second time where it failed: the computer may have stood still meanwhile."""
    if item.get_closest_marker("real_time") is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports = runtestprotocol(item, log=False, nextitem=nextitem)
    if failed := [each for each in reports if each.failed]:
        reports = _again(item, nextitem)
        for each in reports:  # shown where the second run fails, too
            each.sections.extend(("the first run", one.longreprtext) for one in failed)
    for each in reports:
        item.ihook.pytest_runtest_logreport(report=each)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def _again(item: pytest.Item, nextitem: pytest.Item | None) -> list[pytest.TestReport]:
    """Run a test again as if it were for the first time: with new fixtures of its module, after the tests before it."""
    elsewhere = next((each for each in item.session.items if each.path != item.path), None)
    item.session._setupstate.teardown_exact(elsewhere)
    module = [each for each in item.session.items if each.path == item.path]
    run = module[: module.index(item) + 1]
    for each, following in zip(run, [*run[1:], nextitem], strict=True):
        each._initrequest()  # type: ignore[attr-defined]
        reports = runtestprotocol(each, log=False, nextitem=following)
    return reports


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings, or a skip that says where it was looked for."""
    path = Path(os.environ.get("ARMSIGHT_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no real recordings at {path}; set ARMSIGHT_DATA to their folder")
    return path


@pytest.fixture(scope="session", autouse=True)
def _made_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    begin(tmp_path_factory)


def _demo(folder: Path) -> None:
    command = [sys.executable, "-m", "armsight", "demo", "--quick", "--cameras", "1280x720@30", "-o", "demo"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    (folder / "demo.txt").write_text(ran.stdout, encoding="utf-8")


@pytest.fixture(scope="session")
def quick_demo() -> Path:
    """The folder in which ``armsight demo --quick -o demo`` ran, at half its rate, with what it printed in demo.txt."""
    return made_once("quick_demo", _demo)


def _example(folder: Path) -> None:
    command = [sys.executable, ROOT / "examples" / "05_render_a_recording.py", "recording", "--small"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    (folder / "said.txt").write_text(ran.stdout, encoding="utf-8")


@pytest.fixture(scope="session")
def example_recording() -> Path:
    """The folder in which the example renders into ``recording``, with what it printed in said.txt."""
    return made_once("example_recording", _example)


@pytest.fixture(scope="session")
def host_firmware() -> None:
    """The firmware as code of this computer, or a skip that says why it is not there."""
    try:
        open_emulator("host").close()
    except (DeviceError, InputError) as error:
        pytest.skip(f"the firmware is not built: {error}")


@pytest.fixture
def small_disk(tmp_path):
    """Mount file systems of a few kB: ``small_disk("64k")`` returns the folder of one. Skips where that is not allowed."""
    mounted = []

    def mount(size):
        folder = tmp_path / f"disk{len(mounted)}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"cannot mount a small tmpfs here: {done.stderr.strip()}")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", folder], check=True)


@pytest.fixture
def forbidden():
    """Yield a folder in which this process may not write. Root may write anywhere, so it is nobody for the test."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if os.geteuid() == 0:
            folder.chmod(0o755)
            os.seteuid(65534)
            try:
                yield folder
            finally:
                os.seteuid(0)
        else:
            folder.chmod(0o500)
            yield folder
            folder.chmod(0o700)
