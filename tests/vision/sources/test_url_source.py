"""Two live streams: a real HTTP server on loopback for MJPEG, hand-fed streams for the pairing in time."""

import base64
import contextlib
import http.server
import queue
import socket
import threading
import time
from functools import partial

import cv2
import numpy as np
import pytest

from armsight.errors import DeviceError
from armsight.vision.sources import open_source, url
from armsight.vision.sources.url import MjpegStream, RtspStream, UrlSource
from asserts import one_line

pytestmark = pytest.mark.real_time

PERIOD = 0.03
BOUNDARY = "frameboundary"


def jpeg(image):
    return cv2.imencode(".jpg", image)[1].tobytes()


class Server:
    """Serve one behaviour a path; ``stop`` ends the endless ones."""

    def __init__(self):
        self.routes, self.stop = {}, threading.Event()
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the client has seen enough
                    outer.routes[self.path](self)

            def log_message(self, *_):
                pass

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = False  # closing waits for them
        self.thread = threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.02})
        self.thread.start()
        self.host = f"127.0.0.1:{self.http.server_port}"

    def close(self):
        self.stop.set()
        self.http.shutdown()
        self.thread.join()
        self.http.server_close()

    def multipart(self, handler, said=f"multipart/x-mixed-replace; boundary={BOUNDARY}"):
        handler.send_response(200)
        handler.send_header("Content-Type", said)
        handler.end_headers()

    def part(self, handler, data, length=True):
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n" + (f"Content-Length: {len(data)}\r\n" if length else "")
        handler.wfile.write(head.encode() + b"\r\n" + data + b"\r\n")

    def stream(self, frames, length=True, said=f"multipart/x-mixed-replace; boundary={BOUNDARY}"):
        """Send the frames one a period, and again from the first, until stopped."""

        def serve(handler):
            self.multipart(handler, said)
            while True:
                for frame in frames:
                    self.part(handler, frame, length)
                    if self.stop.wait(PERIOD):
                        return

        return serve


def patience(monkeypatch, stream_s, source_s):
    """Set the time-outs."""
    monkeypatch.setitem(url.STREAMS, "http", partial(MjpegStream, timeout_s=stream_s))
    monkeypatch.setitem(url.STREAMS, "rtsp", partial(RtspStream, timeout_s=stream_s))
    monkeypatch.setattr(url, "UrlSource", partial(UrlSource, timeout_s=source_s))


@pytest.fixture
def server(monkeypatch):
    """A server, and time-outs that no busy computer comes to."""
    patience(monkeypatch, 60.0, 120.0)
    made = Server()
    yield made
    made.close()


@pytest.fixture
def films(picture):
    return {side: [jpeg(picture(side, k)) for k in range(20)] for side in ("left", "right")}


def threads():
    return {thread.name for thread in threading.enumerate() if "://" in thread.name}


@pytest.mark.opencv
@pytest.mark.parametrize(
    ("length", "said"),
    [
        (True, f"multipart/x-mixed-replace; boundary={BOUNDARY}"),
        (True, f"multipart/x-mixed-replace;boundary=--{BOUNDARY}"),  # the dashes counted in, as some servers do
        (False, f'multipart/x-mixed-replace; boundary="{BOUNDARY}"'),
    ],
)
def test_two_mjpeg_streams(server, films, read_back, length, said):
    for side in ("left", "right"):
        server.routes[f"/{side}?size=small"] = server.stream(films[side], length, said)
    before = time.monotonic()
    source = open_source(f"url:http://{server.host}/left?size=small,http://{server.host}/right?size=small")
    found = [source.read() for _ in range(6)]
    source.close()
    source.close()
    assert threads() == set()
    assert [shot.name for shot in found] == [f"{k:06d}" for k in range(6)]
    assert all(shot.problem is None for shot in found)
    assert all((read_back(shot.left)[0], read_back(shot.right)[0]) == ("left", "right") for shot in found)
    times = [before, *(shot.t_s for shot in found), time.monotonic()]
    assert times == sorted(times)


@pytest.mark.opencv
def test_grey_stays_grey_and_a_spoilt_frame_is_a_shot_with_a_problem(server):
    grey = jpeg(np.full((48, 64), 90, np.uint8))
    server.routes["/good"] = server.stream([grey])
    server.routes["/spoilt"] = server.stream([grey, grey[: len(grey) // 2], b"\xff\xd8no picture\xff\xd9", b""])
    source = open_source(f"url:http://{server.host}/good,http://{server.host}/spoilt")
    found = [source.read() for _ in range(12)]
    source.close()
    bad = {shot.problem for shot in found if shot.problem}
    assert bad == {f"http://{server.host}/spoilt: the frame cannot be decoded"}
    assert {shot.left.shape for shot in found if not shot.problem} <= {(48, 64)}


def read_on(source):
    while source.read() is not None:
        pass


def error_of(spec):
    with contextlib.closing(open_source(spec)) as source, pytest.raises(DeviceError) as caught:
        read_on(source)
    assert threads() == set()
    return str(caught.value)


def sending(server, frames=(), raw=b"", wait=False, **said):
    """Send a header, frames and bytes; then wait until stopped, or end."""

    def serve(handler):
        server.multipart(handler, **said)
        for frame in frames:
            server.part(handler, frame)
            time.sleep(PERIOD)
        handler.wfile.write(raw)
        if wait:
            server.stop.wait()

    return serve


def lasting(length):
    """The head of a part of so many bytes."""
    return f"--{BOUNDARY}\r\nContent-Length: {length}\r\n\r\n".encode()


def garbage(server, films):
    def serve(handler):
        server.multipart(handler)
        rng = np.random.default_rng(1)
        while not server.stop.wait(0.01):
            handler.wfile.write(rng.bytes(2000))

    return serve


def moved(server, films):
    def serve(handler):
        handler.send_response(302)
        handler.send_header("Location", "http://user:secret@elsewhere/stream")
        handler.end_headers()

    return serve


@pytest.mark.parametrize(
    ("behaviour", "said"),
    [
        (lambda server, films: sending(server, films["right"][:3], wait=True), "no answer for 0.6 s"),
        (garbage, "no frame for 1.5 s"),
        (lambda server, films: sending(server, films["right"][:3]), "the stream ended"),
        (lambda server, films: sending(server, raw=lasting(90_000) + films["right"][0]), "the stream ended"),
        (
            lambda server, films: sending(server, raw=lasting(99_999_999_999)),
            "says a frame has 99999999999 bytes: not an MJPEG stream",
        ),
        (
            lambda server, films: sending(server, raw=films["right"][0], said="image/jpeg"),
            "sends image/jpeg, expected an MJPEG stream (multipart/x-mixed-replace)",
        ),
        (moved, "HTTP 302 Found, it points to http://elsewhere/stream"),
        (lambda server, films: lambda handler: handler.send_error(404), "HTTP 404 Not Found"),
        (lambda server, films: lambda handler: server.stop.wait(), "no answer for 0.6 s"),
        (
            lambda server, films: lambda handler: handler.wfile.write(b"SSH-2.0-OpenSSH_9.2p1\r\n"),
            "SSH-2.0-OpenSSH_9.2p1",
        ),
    ],
)
def test_a_bad_stream_is_reported_by_its_address(server, films, behaviour, said, monkeypatch):
    if " for " in said:  # short enough to wait for
        patience(monkeypatch, 0.6, 1.5)
    server.routes["/left"] = server.stream(films["left"])
    server.routes["/right"] = behaviour(server, films)
    error = error_of(f"url:http://{server.host}/left,http://{server.host}/right")
    assert error.startswith(f"http://{server.host}/right: ")
    assert said in error
    assert "\n" not in error.strip()


def test_nobody_answers_and_no_such_host(server, films, capfd):
    server.routes["/left"] = server.stream(films["left"])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    for address, said in (
        (f"http://127.0.0.1:{port}/", "Connection refused"),
        (f"rtsp://user:secret@127.0.0.1:{port}/live", f"rtsp://127.0.0.1:{port}/live: no RTSP stream there"),
    ):
        error = error_of(f"url:http://{server.host}/left,{address}")
        assert said in error
        assert "secret" not in error
    assert capfd.readouterr().err == ""


def test_user_and_password_are_sent_and_not_shown(server, films):
    seen = []

    def guarded(handler):
        seen.append(handler.headers["Authorization"])
        handler.send_error(401)

    server.routes["/left"] = server.stream(films["left"])
    server.routes["/right"] = guarded
    error = error_of(f"url:http://{server.host}/left,http://me:p%40ss@{server.host}/right")
    assert error == f"http://{server.host}/right: HTTP 401 Unauthorized"
    assert seen == ["Basic " + base64.b64encode(b"me:p@ss").decode()]


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("", "expected url:URL_LEFT,URL_RIGHT"),
        ("http://a/", "expected url:URL_LEFT,URL_RIGHT"),
        ("http://a/,http://b/,http://c/", "expected url:URL_LEFT,URL_RIGHT"),
        ("http://a/,ftp://b/", "ftp://b/: not the address of a stream"),
        ("http://a/,http://", "http://: not the address of a stream"),
        ("http://a:port/,http://b/", "http://a:port/: not the address of a stream"),
        ("http://[::1,http://b/", "http://[::1: not the address of a stream"),
    ],
)
def test_addresses_that_cannot_be(rest, said):
    with one_line(said):
        open_source(f"url:{rest}")


class HandFed:
    """A stream whose frames a test pushes; ``push`` returns when the reader has taken the frame in."""

    def __init__(self, name):
        self.url, self.frames_in = f"hand://{name}", queue.Queue()

    def frames(self):
        while (frame := self.frames_in.get()) is not None:
            yield frame
            self.frames_in.task_done()

    def push(self, t_s, value):
        self.frames_in.put((t_s, np.full((2, 2), value, np.uint8)))
        self.frames_in.join()

    def close(self):
        self.frames_in.put(None)


@pytest.fixture
def fed(request):
    left, right = HandFed("left"), HandFed("right")
    source = UrlSource(left, right, timeout_s=getattr(request, "param", 0.3))
    source.start()
    yield source, left, right
    source.close()
    assert threads() == set()


def test_the_newest_frames_make_a_shot_and_none_is_used_twice(fed):
    source, left, right = fed
    for k in range(3):
        left.push(0.1 * k, k)
        right.push(0.1 * k + 0.02, k)
    shot = source.read()
    assert (shot.left[0, 0], shot.right[0, 0]) == (2, 2)
    assert shot.t_s == pytest.approx(0.21)
    left.push(0.3, 3)
    with pytest.raises(DeviceError, match=r"hand://right: no frame for 0.3 s"):
        source.read()


@pytest.mark.parametrize("fed", [120.0], indirect=True)
def test_a_frame_waits_for_the_partner_nearest_in_time(fed):
    source, left, right = fed
    for k in range(3):
        left.push(0.1 * k, k)
    right.push(0.04, 0)
    right.push(0.14, 1)  # 0.06 s from the newest left frame, more than half a period: not its partner
    late = threading.Timer(0.05, right.push, (0.24, 2))
    late.start()
    shot = source.read()
    late.join()
    assert (shot.left[0, 0], shot.right[0, 0]) == (2, 2)


def test_streams_that_never_meet_are_reported(fed):
    source, left, right = fed
    for k in range(3):
        left.push(0.1 * k, k)
        right.push(0.1 * k + 0.06, k)
    with pytest.raises(DeviceError) as caught:
        source.read()
    assert str(caught.value) == (
        "hand://left and hand://right: no two frames within half a frame period for 0.3 s: are their rates the same?"
    )


def test_the_kinds_of_stream_are_known():
    assert set(url.STREAMS) == {"http", "https", "rtsp", "rtsps"}
