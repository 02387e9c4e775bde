"""Two live streams: MJPEG over HTTP, or RTSP.

In: two addresses. Out: shots from the newest frames of both, paired by the time of arrival (time.monotonic; it includes
the network's delay). Each stream has a thread that keeps its newest frame, so a slow user gets fresh shots and not a
growing lag. Frames without a partner within half a frame period are skipped.

MJPEG is multipart/x-mixed-replace (RFC 2046): a boundary line, a header that may give the length, a JPEG file, and again.
"""

from __future__ import annotations

import base64
import contextlib
import http.client
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from armsight.data import Image, Shot
from armsight.errors import DeviceError, InputError
from armsight.vision.image import jpeg_in
from armsight.vision.source import Source
from armsight.vision.sources.capture import STALL_S, Rhythm, allowed_skew, open_capture

_SETTLE_S = 1.0  # FFmpeg hands out what it collected while it looked at an RTSP stream in one burst: passed over
_MAX_FRAME = 64 << 20  # bytes; beyond it the stream is not MJPEG

#: Time of arrival, s, and a JPEG file or an image; None for a frame that cannot be decoded.
Frame = tuple[float, bytes | Image | None]


class Stream:
    """One stream of frames; ``url`` is how messages call it, without a password."""

    def __init__(self, url: str, timeout_s: float = STALL_S) -> None:
        self.url = shown(url)
        self._address, self._timeout_s = url, timeout_s
        self._stop = threading.Event()

    def frames(self) -> Iterator[Frame]:
        """Connect, and yield time of arrival, s, and a JPEG file or an image; raise DeviceError when that ends."""
        raise NotImplementedError

    def close(self) -> None:
        """Make ``frames`` end at the next frame; called from another thread."""
        self._stop.set()


class MjpegStream(Stream):
    """MJPEG over HTTP or HTTPS, with the user and password of the address if it has them."""

    _socket: socket.socket | None = None

    def frames(self) -> Iterator[Frame]:
        """Connect, and yield time of arrival, s, and JPEG file of each part; DeviceError where it stalls or ends."""
        with self._named_errors(), contextlib.ExitStack() as stack:
            response = self._connect(stack)
            boundary = self._boundary(response)
            self._to_boundary(response, boundary)
            while not self._stop.is_set():
                length = (http.client.parse_headers(response)["Content-Length"] or "").strip()
                t_s = time.monotonic()
                if not length.isdecimal():
                    yield t_s, self._to_boundary(response, boundary)
                    continue
                if int(length) > _MAX_FRAME:
                    raise DeviceError(f"{self.url}: says a frame has {length} bytes: not an MJPEG stream")
                yield t_s, response.read(int(length))
                self._to_boundary(response, boundary)

    def close(self) -> None:
        """Wake a thread that waits for data; ``frames`` then ends."""
        super().close()
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def _connect(self, stack: contextlib.ExitStack) -> http.client.HTTPResponse:
        """Ask for the stream; the stack closes what was opened."""
        address, headers = urlsplit(self._address), {}
        if address.username is not None:
            login = f"{unquote(address.username)}:{unquote(address.password or '')}"
            headers["Authorization"] = "Basic " + base64.b64encode(login.encode()).decode()
        kind = http.client.HTTPSConnection if address.scheme == "https" else http.client.HTTPConnection
        connection = kind(address.hostname or "", address.port, timeout=self._timeout_s)
        stack.callback(connection.close)
        connection.connect()
        self._socket = stack.enter_context(connection.sock)  # kept: the connection forgets it at the answer
        connection.request("GET", address._replace(scheme="", netloc="", fragment="").geturl() or "/", headers=headers)
        return stack.enter_context(connection.getresponse())

    def _boundary(self, response: http.client.HTTPResponse) -> bytes:
        """Check the answer's header and return the line between two frames, without its dashes."""
        if response.status != http.client.OK:
            to = response.headers["Location"]
            elsewhere = f", it points to {shown(to)}" if to else ""
            raise DeviceError(f"{self.url}: HTTP {response.status} {response.reason}{elsewhere}")
        boundary = response.headers.get_boundary()
        if response.headers.get_content_maintype() != "multipart" or not boundary:
            sent = response.headers["Content-Type"]
            raise DeviceError(f"{self.url}: sends {sent}, expected an MJPEG stream (multipart/x-mixed-replace)")
        return boundary.strip("-").encode()  # some servers count the leading dashes in, some do not

    def _to_boundary(self, response: http.client.HTTPResponse, boundary: bytes) -> bytes:
        """Read up to and with the next boundary line; return what stood before it."""
        before = bytearray()
        while len(before) < _MAX_FRAME:
            line = response.readline(_MAX_FRAME)
            if not line:
                raise DeviceError(f"{self.url}: the stream ended")
            if line.startswith(b"-") and line.strip().strip(b"-") == boundary:
                return bytes(before)
            before += line
        raise DeviceError(f"{self.url}: no boundary in {_MAX_FRAME >> 20} MB: not an MJPEG stream")

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        try:
            yield
        except TimeoutError:
            raise DeviceError(f"{self.url}: no answer for {self._timeout_s:g} s") from None
        except (OSError, http.client.HTTPException, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise DeviceError(f"{self.url}: {reason}") from None


class RtspStream(Stream):
    """RTSP through OpenCV's FFmpeg, over TCP; OpenCV's capture must not be released while it grabs."""

    def frames(self) -> Iterator[Frame]:
        """Connect, and yield time of arrival, s, and image, None where it cannot be decoded; DeviceError at its end."""
        limit_ms = int(self._timeout_s * 1000)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
        capture = open_capture(self._address, cv2.CAP_FFMPEG, limits)
        if capture is None:
            raise DeviceError(f"{self.url}: no RTSP stream there, or no answer for {self._timeout_s:g} s")
        try:
            live_s = time.monotonic() + _SETTLE_S
            while not self._stop.is_set():
                if not capture.grab():
                    raise DeviceError(f"{self.url}: the stream ended, or no frame for {self._timeout_s:g} s")
                t_s = time.monotonic()
                if t_s < live_s:
                    continue
                ok, image = capture.retrieve()
                yield t_s, image if ok else None
        finally:
            capture.release()


#: What an address begins with -> how to connect; another protocol is one line here.
STREAMS: dict[str, Callable[[str], Stream]] = {
    "http": MjpegStream,
    "https": MjpegStream,
    "rtsp": RtspStream,
    "rtsps": RtspStream,
}


def shown(url: str) -> str:
    """Return an address without its user and password, for messages."""
    return re.sub(r"(?<=://)[^/@]*@", "", url)


class _Reader(threading.Thread):
    """The thread of one stream; its fields are guarded by ``changed``."""

    def __init__(self, stream: Stream, changed: threading.Condition) -> None:
        super().__init__(name=stream.url, daemon=True)
        self.stream, self.changed = stream, changed
        self.rhythm = Rhythm()
        self.newest: Frame | None = None
        self.ended: DeviceError | None = None

    def run(self) -> None:
        """Keep the newest frame until the stream ends."""
        try:
            for frame in self.stream.frames():
                with self.changed:
                    self.newest = frame
                    self.rhythm.tick(frame[0])
                    self.changed.notify_all()
        except DeviceError as error:
            with self.changed:
                self.ended = error
                self.changed.notify_all()


class UrlSource(Source):
    """Two live streams."""

    count: int | None = None

    def __init__(self, left: Stream, right: Stream, timeout_s: float = STALL_S + 2) -> None:
        self._changed = threading.Condition()
        self._readers = [_Reader(stream, self._changed) for stream in (left, right)]
        self._timeout_s = timeout_s
        self._shots = 0

    def start(self) -> None:
        """Connect both streams, each in a thread of its own."""
        for reader in self._readers:
            reader.start()

    def read(self) -> Shot | None:
        """Return the newest pair of frames; waits for one that was not handed out yet."""
        (left_s, left), (right_s, right) = self._next_pair()
        name, t_s = f"{self._shots:06d}", (left_s + right_s) / 2
        self._shots += 1
        images = [_image(left), _image(right)]
        for reader, image in zip(self._readers, images, strict=True):
            if image is None:
                return Shot(name, None, None, t_s, f"{reader.stream.url}: the frame cannot be decoded")
        encoded = (left, right) if isinstance(left, bytes) and isinstance(right, bytes) else None
        return Shot(name, images[0], images[1], t_s, None, encoded)

    def close(self) -> None:
        """Stop both threads."""
        for reader in self._readers:
            reader.stream.close()
        for reader in self._readers:
            reader.join(self._timeout_s)

    def _next_pair(self) -> tuple[Frame, Frame]:
        """Wait for two new frames that belong together, and take them."""
        left, right = self._readers
        deadline = time.monotonic() + self._timeout_s
        with self._changed:
            while True:
                for reader in self._readers:
                    if reader.ended is not None:
                        raise reader.ended
                a, b = left.newest, right.newest
                if a and b and abs(a[0] - b[0]) <= allowed_skew(left.rhythm, right.rhythm):
                    left.newest = right.newest = None
                    return a, b
                if not self._changed.wait(max(0.0, deadline - time.monotonic())):
                    raise DeviceError(self._why_no_pair())

    def _why_no_pair(self) -> str:
        """Return which stream is silent, or that their frames never come close in time."""
        silent = [reader.stream.url for reader in self._readers if reader.newest is None]
        if silent:
            return f"{' and '.join(silent)}: no frame for {self._timeout_s:g} s"
        urls = " and ".join(reader.stream.url for reader in self._readers)
        return f"{urls}: no two frames within half a frame period for {self._timeout_s:g} s: are their rates the same?"


def open_url(rest: str) -> UrlSource:
    """Open ``URL_LEFT,URL_RIGHT``."""
    urls = re.split(r",(?=[a-z]+://)", rest)
    if len(urls) != 2:
        raise InputError(f"url:{shown(rest)}: expected url:URL_LEFT,URL_RIGHT")
    left, right = (_stream(url) for url in urls)
    source = UrlSource(left, right)
    source.start()
    return source


def _stream(url: str) -> Stream:
    try:
        parts = urlsplit(url)
        if parts.scheme in STREAMS and parts.hostname and parts.port != 0:
            return STREAMS[parts.scheme](url)
    except ValueError:  # a port that is no number, half an IPv6 address
        pass
    known = ", ".join(f"{scheme}://" for scheme in STREAMS)
    raise InputError(f"{shown(url)}: not the address of a stream; it begins with one of {known} and names a host")


def _image(frame: bytes | Image | None) -> Image | None:
    """Decode a JPEG file; None if it is not one or is truncated."""
    if not isinstance(frame, bytes):
        return frame
    whole = jpeg_in(frame)
    return None if whole is None else cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_UNCHANGED)
