"""One live stream of frames: MJPEG over HTTP, or RTSP.

In: an address. Out: the frames with their times of arrival (time.monotonic). MJPEG is multipart/x-mixed-replace (RFC
2046): a boundary line, a header that may tell the length, a JPEG file, over and over.
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
from typing import Protocol
from urllib.parse import unquote, urlsplit

import cv2

from armsight.data import Image
from armsight.errors import DeviceError
from armsight.vision.sources.capture import open_capture

TIMEOUT_S = 5.0  # without data for that long a stream has stalled
_SETTLE_S = 1.0  # FFmpeg hands out what it collected while it looked at an RTSP stream in one burst: passed over
_MAX_FRAME = 64 << 20  # bytes; beyond it the stream is not MJPEG

#: Time of arrival, s, and a JPEG file or an image; None for a frame that cannot be decoded.
Frame = tuple[float, bytes | Image | None]


class Stream(Protocol):
    """One stream of frames; ``url`` is how messages call it, without a password."""

    url: str

    def frames(self) -> Iterator[Frame]:
        """Connect, and yield time of arrival, s, and a JPEG file or an image; raise DeviceError when that ends."""
        ...

    def close(self) -> None:
        """Make ``frames`` end soon; called from another thread."""
        ...


class MjpegStream:
    """MJPEG over HTTP or HTTPS, with the user and password of the address if it has them."""

    def __init__(self, url: str, timeout_s: float = TIMEOUT_S) -> None:
        self.url = shown(url)
        self._address, self._timeout_s = urlsplit(url), timeout_s
        self._socket: socket.socket | None = None
        self._stop = threading.Event()

    def frames(self) -> Iterator[tuple[float, bytes]]:
        """Connect, and yield time of arrival, s, and JPEG file of each part.

        Raises:
            DeviceError: no connection, an HTTP error, something else than an MJPEG stream, a stall, or the end.
        """
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
        self._stop.set()
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def _connect(self, stack: contextlib.ExitStack) -> http.client.HTTPResponse:
        """Ask for the stream; the stack closes what was opened."""
        address, headers = self._address, {}
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


class RtspStream:
    """RTSP through OpenCV's FFmpeg, over TCP."""

    def __init__(self, url: str, timeout_s: float = TIMEOUT_S) -> None:
        self.url = shown(url)
        self._address, self._timeout_s = url, timeout_s
        self._stop = threading.Event()

    def frames(self) -> Iterator[tuple[float, Image | None]]:
        """Connect, and yield time of arrival, s, and image; None for a frame that cannot be decoded.

        Raises:
            DeviceError: no such stream, a stall, or the end.
        """
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

    def close(self) -> None:
        """End ``frames`` at the next frame: OpenCV's capture must not be released while it grabs."""
        self._stop.set()


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
