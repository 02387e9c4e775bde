"""The server: who may connect and command, the stop, the newest image alone, and pages that misbehave."""

import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.live.arm import StopAnswer
from armsight.app.live.capture import LiveShot
from armsight.app.live.records import Event, Hold
from armsight.app.live.server import LiveServer
from armsight.data import Shot
from armsight.errors import InputError
from waiting import until

pytest.importorskip("websockets")
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

pytestmark = pytest.mark.real_time


class FakeSession:
    """A session of two grey images, an arm that moves, and commands that are noted."""

    def __init__(self):
        self.executed, self.held, self.said = [], [], []
        self.arm = SimpleNamespace(busy=False, hold_for=self.held.append, between_shots=lambda: None)
        self.step, self.number = "cameras", 1

    capture = property(lambda self: self)

    @property
    def newest(self):
        image = np.full((90, 160), self.number % 250, np.uint8)
        return LiveShot(Shot(str(self.number), image, image), self.number, time.monotonic())

    def sections(self):
        return {"overview": SimpleNamespace, "cameras": {"step": self.step}} | {"overview": {"step": self.step}}

    def events(self, after=0):
        return (Event(1, "12:00:00", "good", "begun"),) if after < 1 else ()

    def execute(self, command):
        if isinstance(command, Hold):
            raise InputError("nothing moves")
        self.executed.append(command)

    def stop(self):
        return StopAnswer(True, "emergency stop", 1.0)

    def say(self, level, text):
        self.said.append(text)


@pytest.fixture
def serving():
    """Start servers; returns the session and the server."""
    started = []

    def start(**more):
        session = FakeSession()
        server = LiveServer(session, port=0, **more)
        server.start()
        started.append(server)
        return session, server

    yield start
    for server in started:
        server.close()


def page(server, path="/live", origin=None, token=""):
    at = f"127.0.0.1:{server.port}"
    return connect(f"ws://{at}{path}{token}", origin=origin or f"http://{at}", max_size=2**22, open_timeout=60)


def heard(opened, key, patience_s=60.0):
    """Return the next message with a key; images are answered."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        message = opened.recv(timeout=patience_s)
        if isinstance(message, bytes):
            continue
        said = json.loads(message)
        if key in said:
            return said[key]
    raise AssertionError(f"no {key}")


def get(server, path="/", host=None):
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}")
    if host:
        request.add_header("Host", host)
    return urllib.request.urlopen(request, timeout=60)


def test_the_page_is_one_file_that_takes_nothing_from_outside(serving):
    _, server = serving()
    with get(server) as answer:
        html, policy = answer.read().decode(), answer.headers["Content-Security-Policy"]
    assert len(html) < 150_000
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    nonce = policy.split("nonce-")[1].split("'")[0]
    assert html.count(f'nonce="{nonce}"') == 2
    assert "http://" not in html.replace("http://127", "")
    assert "https://" not in html
    with get(server) as again:
        assert nonce not in again.read().decode()


def test_foreign_names_pages_and_tokens_are_rejected(serving):
    _, server = serving()
    for path, host, code in (("/", f"evil.example:{server.port}", 421), ("/etc/passwd", None, 404)):
        with pytest.raises(urllib.error.HTTPError) as error:
            get(server, path, host)
        assert error.value.code == code
        error.value.close()
    for path in ("/live", "/stop"):
        for origin in ("http://evil.example", f"http://localhost:{server.port}", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                page(server, path, origin)
    _, guarded = serving(token="right")
    for token in ("", "?token=wrong", "?token="):
        with pytest.raises(urllib.error.HTTPError) as error:
            get(guarded, "/" + token)
        assert error.value.code == 401
        error.value.close()
        with pytest.raises(InvalidStatus, match="401"):
            page(guarded, "/stop", token=token)
    assert guarded.address.endswith("?token=right")
    with get(guarded, "/?token=right") as answer, page(guarded, token="?token=right") as opened:
        assert answer.status == 200
        assert heard(opened, "you")["commands"]


def test_one_page_commands_the_others_look_on_and_can_stop(serving):
    session, server = serving()
    with page(server) as first, page(server) as second:
        assert heard(first, "you")["commands"]
        assert not heard(second, "you")["commands"]
        second.send('{"command": "Zero"}')
        assert "another page commands" in heard(second, "rejected")
        assert session.executed == []
        first.send('{"command": "Zero"}')
        until(lambda: session.executed)
        with page(server, "/stop") as stop:
            stop.send("stop")
            assert json.loads(stop.recv(timeout=60)) == {"stopped": True, "state": "emergency stop", "took_ms": 1.0}
        second.send('{"take_over": true}')
        until(lambda: "another page took over" in session.held)
        while not heard(second, "you")["commands"]:
            pass
        first.send('{"command": "Zero"}')
        assert "another page commands" in heard(first, "rejected")


def test_a_page_that_is_closed_or_silent_holds_the_arm(serving):
    session, server = serving()
    session.arm.busy = True
    with page(server) as silent:
        heard(silent, "you")
        until(lambda: "the page that commands does not answer" in session.held)
    session.held.clear()
    with page(server) as torn:
        heard(torn, "you")
        torn.socket.shutdown(socket.SHUT_RDWR)  # as when the connection is lost: no farewell
        until(lambda: any("connection was lost" in why for why in session.held))


def test_a_stop_does_not_wait_for_a_page_that_hangs(serving):
    session, server = serving()
    hanging, begun = threading.Event(), threading.Event()
    session.execute = lambda command: (begun.set(), hanging.wait(120))
    with page(server) as first, page(server, "/stop") as stop:
        first.send('{"command": "Zero"}')
        begun.wait(60)
        stop.send("stop")
        assert json.loads(stop.recv(timeout=60))["stopped"]
        assert not hanging.is_set()
        hanging.set()


def test_a_slow_page_gets_the_newest_image_alone(serving):
    session, server = serving()
    with page(server) as opened:
        heads = []
        while len(heads) < 2:
            message = opened.recv(timeout=60)
            heads += [struct.unpack_from("<BI", message)] if isinstance(message, bytes) else []
        assert sorted(heads) == [(0, 1), (1, 1)]
        for session.number in range(2, 50):  # nothing is shown meanwhile, and nothing more is sent
            time.sleep(0.002)
        opened.send('{"shown": [0, 1]}')
        while not isinstance(message := opened.recv(timeout=60), bytes):
            pass
        assert struct.unpack_from("<BI", message) == (0, 49)
        assert message[5:7] == b"\xff\xd8"
        opened.send('{"visible": false}')
        opened.send('{"shown": [0, 49]}')
        session.number = 60
        with pytest.raises(TimeoutError):
            assert not any(isinstance(opened.recv(timeout=0.5), bytes) for _ in range(10**6))
        opened.send('{"visible": true}')
        while not isinstance(message := opened.recv(timeout=60), bytes):
            pass
        assert struct.unpack_from("<BI", message)[1] == 60


def flood(opened):
    for n in range(10_000):
        opened.send(["{", "[]", '{"shown": 3}', b"\x00", '{"command": 1}'][n % 5])
        if n > 1000:
            opened.recv(timeout=60)


def test_malformed_messages_are_answered_and_many_of_them_end_the_connection(serving):
    session, server = serving()
    with page(server) as good, page(server) as bad:
        bad.send('{"command": "Nothing"}')
        assert "no command 'Nothing'" in heard(bad, "rejected")
        with pytest.raises(ConnectionClosed):
            flood(bad)
        good.send('{"command": "Zero"}')
        until(lambda: session.executed)
        good.send("x" * 10_000)  # longer than any message of a page
        with pytest.raises(ConnectionClosed):
            heard(good, "nothing of this name", 1000.0)


def test_a_port_in_use_is_one_line(serving):
    _, server = serving()
    other = LiveServer(FakeSession(), port=server.port)
    with pytest.raises(InputError, match=f"port {server.port} is in use.*--http"):
        other.start()


def test_no_screen_is_needed():
    """On a computer without X nothing may be imported that wants one."""
    graphical = ("tkinter", "PyQt5", "PyQt6", "PySide2", "PySide6", "wx", "gi", "matplotlib.pyplot")
    code = (
        "import sys, armsight.app.live.session, armsight.app.live.server; "
        f"print([name for name in {graphical} if name in sys.modules])"
    )
    bare = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    found = subprocess.run([sys.executable, "-c", code], env=bare, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
