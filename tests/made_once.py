"""What takes long to make and no test changes is made once for all of pytest-xdist's processes."""

import contextlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

#: The folder of what is made; conftest.py sets it when tests begin.
_root: list[Path] = []


def begin(factory: pytest.TempPathFactory) -> None:
    """Take the temporary folder of this run of pytest; where there are no file locks, that of this process."""
    own = factory.getbasetemp()
    _root[:] = [own.parent if "PYTEST_XDIST_WORKER" in os.environ and sys.platform != "win32" else own]


def made_once(name: str, make: Callable[[Path], object]) -> Path:
    """Return the folder ``name`` that ``make(folder)`` has filled: whichever process asks first makes it, others wait."""
    folder, done = _root[0] / "made_once" / name, _root[0] / "made_once" / f"{name}.done"
    folder.parent.mkdir(exist_ok=True)
    with _locked(folder.with_name(f"{name}.lock")):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of an attempt that failed
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock that ends with its process at the latest."""
    if sys.platform == "win32":
        yield
        return
    import fcntl

    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
