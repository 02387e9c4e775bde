"""RTSP against a real server on loopback: Motion-JPEG over RTP (RFC 2435), interleaved in the RTSP connection."""

import contextlib
import itertools
import socketserver
import struct
import threading
from functools import partial

import cv2
import pytest

from armsight.errors import DeviceError
from armsight.vision.sources import open_source
from armsight.vision.sources.url import STREAMS, RtspStream

pytestmark = [pytest.mark.opencv, pytest.mark.real_time]

PERIOD = 0.04
SDP = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=-\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\nm=video 0 RTP/AVP 26\r\na=control:t\r\n"
ANSWERS = {
    "OPTIONS": ("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n", ""),
    "DESCRIBE": ("Content-Type: application/sdp\r\n", SDP),
    "SETUP": ("Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n", ""),
    "PLAY": ("Session: 1\r\n", ""),
}


def packets(jpeg, number, time_stamp):
    """Yield the RTP packets of one JPEG file: its tables and its scan without the other headers."""
    tables, position = {}, 2
    while jpeg[position + 1] != 0xDA:
        body = jpeg[position + 4 : position + 2 + int.from_bytes(jpeg[position + 2 : position + 4], "big")]
        if jpeg[position + 1] == 0xDB:
            tables.update((body[i] & 15, body[i + 1 : i + 65]) for i in range(0, len(body), 65))
        elif jpeg[position + 1] == 0xC0:
            height, width = struct.unpack(">HH", body[1:5])
        position += 4 + len(body)
    scan = jpeg[position + 2 + int.from_bytes(jpeg[position + 2 : position + 4], "big") : -2]
    for k, start in enumerate(range(0, len(scan), 1300)):
        last = start + 1300 >= len(scan)
        head = struct.pack(">BBHII", 0x80, 26 | (last << 7), (number + k) & 0xFFFF, time_stamp, 7)
        kind = struct.pack(
            ">IBBBB", start, 1, 255, width // 8, height // 8
        )  # 1: colour at half resolution; 255: tables
        reported = b"\0\0\0\x80" + tables[0] + tables[1] if start == 0 else b""
        packet = head + kind + reported + scan[start : start + 1300]
        yield b"$\0" + struct.pack(">H", len(packet)) + packet


class Handler(socketserver.StreamRequestHandler):
    def handle(self):
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            while (request := self.rfile.readline().decode().split()) and request[0] != "PLAY":
                self.answer(request[0])
            if request:
                self.answer("PLAY")
                self.send_frames()

    def answer(self, method):
        lines = iter(lambda: self.rfile.readline().decode().strip(), "")
        number = next(value for name, _, value in (line.partition(":") for line in lines) if name == "CSeq")
        list(lines)
        extra, body = ANSWERS[method]
        length = f"Content-Length: {len(body)}\r\n" if body else ""
        self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq:{number}\r\n{extra}{length}\r\n{body}".encode())

    def send_frames(self):
        number = 0
        for k in itertools.count():
            for packet in packets(self.server.frames[k % len(self.server.frames)], number, int(90_000 * PERIOD * k)):
                self.wfile.write(packet)
                number += 1
            if self.server.stop.wait(PERIOD):
                return
            if self.server.stall.is_set():
                self.server.stop.wait()
                return


@pytest.fixture
def serve(picture):
    """Serve the frames of a side; returns the server, with events that stall or stop it."""
    with contextlib.ExitStack() as stack:

        def start(side):
            server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
            server.frames = [cv2.imencode(".jpg", picture(side, k))[1].tobytes() for k in range(20)]
            server.stop, server.stall = threading.Event(), threading.Event()
            server.url = f"rtsp://127.0.0.1:{server.server_address[1]}/{side}"
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
            thread.start()
            for step in (server.server_close, thread.join, server.shutdown, server.stop.set):
                stack.callback(step)
            return server

        yield start


def test_two_streams_then_one_stalls(serve, read_back, monkeypatch):
    monkeypatch.setitem(STREAMS, "rtsp", partial(RtspStream, timeout_s=2.0))
    left, right = serve("left"), serve("right")
    with contextlib.closing(open_source(f"url:{left.url},{right.url}")) as source:
        found = [source.read() for _ in range(8)]
        assert all(shot.problem is None for shot in found)
        assert [(read_back(shot.left)[0], read_back(shot.right)[0]) for shot in found] == [("left", "right")] * 8
        times = [shot.t_s for shot in found]
        assert times == sorted(set(times))
        right.stall.set()
        with pytest.raises(DeviceError) as caught:
            list(iter(source.read, None))
    assert str(caught.value) == f"{right.url}: the stream ended, or no frame for 2 s"
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("rtsp://")]
