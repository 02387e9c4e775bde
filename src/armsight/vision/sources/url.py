"""Two live streams: MJPEG over HTTP, or RTSP.

In: two addresses. Out: shots from the newest frames of both, paired by the time of arrival (time.monotonic; the
network's delay is in it). Each stream has a thread that keeps its newest frame, so a slow user gets fresh shots and not
a growing lag. Frames that no partner reaches within half a frame period are passed over.
"""

from __future__ import annotations

import re
import threading
import time
from urllib.parse import urlsplit

import cv2
import numpy as np

from armsight.data import Image, Shot
from armsight.errors import DeviceError, InputError
from armsight.vision.sources.streams import STREAMS, TIMEOUT_S, Frame, Stream, shown
from armsight.vision.sources.timing import Rhythm, allowed_skew


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


class UrlSource:
    """Two live streams."""

    def __init__(self, left: Stream, right: Stream, timeout_s: float = TIMEOUT_S + 2) -> None:
        self._changed = threading.Condition()
        self._readers = [_Reader(stream, self._changed) for stream in (left, right)]
        self._timeout_s = timeout_s
        self._shots = 0
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
        return Shot(name, images[0], images[1], t_s)

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
        """Say which stream is silent, or that their frames never come close in time."""
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
    return UrlSource(left, right)


def _stream(url: str) -> Stream:
    """Return the stream at an address, not yet connected."""
    try:
        parts = urlsplit(url)
        if parts.scheme in STREAMS and parts.hostname and parts.port != 0:
            return STREAMS[parts.scheme](url)
    except ValueError:  # a port that is no number, half an IPv6 address
        pass
    known = ", ".join(f"{scheme}://" for scheme in STREAMS)
    raise InputError(f"{shown(url)}: not the address of a stream; it begins with one of {known} and names a host")


def _image(frame: bytes | Image | None) -> Image | None:
    """Decode a JPEG file; None if it is none or cut short."""
    if not isinstance(frame, bytes):
        return frame
    whole = frame.startswith(b"\xff\xd8") and frame.rstrip(b"\r\n\0").endswith(b"\xff\xd9")
    return cv2.imdecode(np.frombuffer(frame, np.uint8), cv2.IMREAD_UNCHANGED) if whole else None
