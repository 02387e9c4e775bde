"""A folder of state of its own for each test, a free port, and a wait for what other threads do."""

import socket
import time

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("cryptography")


@pytest.fixture(autouse=True)
def own_state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def port():
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


@pytest.fixture
def wait():
    """Return what waits until something holds, or fails."""

    def until(holds, most_s=20.0):
        end = time.monotonic() + most_s
        while not (found := holds()):
            assert time.monotonic() < end, "it did not come to hold"
            time.sleep(0.02)
        return found

    return until
