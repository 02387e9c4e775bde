"""The contract of what data are published to: a queue and a thread, so that whoever publishes never waits.

To write a new one: derive from :class:`Sink` and implement ``write``; ``tick`` and ``finish`` where they are needed. All
three run in the sink's thread.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, replace

from armsight.loop.running.data import Datum, ShotDatum

#: How often ``tick`` is called at least, s.
TICK_S = 0.25
#: A sink that has this share of what may wait does not pause: before data are dropped a command may come late.
_BEHIND = 0.25
#: Images that wait, MB: 46 pairs of 720p in colour; half: a pause of a second costs images, double: half a gigabyte.
_IMAGES_MB = 256
#: How long :meth:`Sink.close` waits for the thread, s, where nothing else is said.
CLOSE_S = 10.0


def _image_bytes(datum: Datum) -> int:
    shot = datum.shot if isinstance(datum, ShotDatum) else None
    raw = (shot.left, shot.right) if shot is not None else ()
    return sum(each.nbytes for each in raw if each is not None) + sum(map(len, (shot and shot.encoded) or ()))


def _without_images(datum: Datum) -> Datum:
    if not isinstance(datum, ShotDatum):
        return datum
    return replace(datum, shot=replace(datum.shot, left=None, right=None, encoded=None))


@dataclass(slots=True)
class _Waiting:
    """A datum in the queue, what its images take, bytes, and whether it is counted as dropped."""

    datum: Datum
    image_bytes: int
    counted: bool = False


class Sink:
    """A publisher with a thread. The oldest datum is dropped where more than ``limit`` wait: the latest win, counted.

    Where the images that wait take too much memory, the oldest of these are dropped, and their data counted, once each.

    Args:
        wakes: so many that wait wake the thread; fewer wait for at most ``TICK_S``. A thread that is woken for every datum
            takes the interpreter from the loop as often.
        close_s: how long :meth:`close` waits for the thread, s.
        images: whether it writes images; else none wait for its thread.

    Attributes:
        problem: what ended the publishing early; None where nothing did.
    """

    def __init__(self, limit: int = 512, wakes: int = 1, close_s: float = CLOSE_S, *, images: bool = True) -> None:
        self._images = images
        self.taken = self.dropped = 0
        self.cpu_s = 0.0
        self.problem: str | None = None
        self._limit, self._wakes, self._close_s = limit, wakes, close_s
        self._queue: deque[_Waiting] = deque()
        self._pictured: deque[_Waiting] = deque()  # those of it that have images
        self._bytes = 0  # of the images in it; those that are being written wait no more
        self._changed = threading.Condition()
        self._closing = False
        self._may_write = threading.Event()
        self._may_write.set()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, datum: Datum) -> None:
        """Take a datum and return at once."""
        datum = datum if self._images else _without_images(datum)
        with self._changed:
            if self._closing or self.problem is not None:
                return
            self.taken += 1
            if len(self._queue) >= self._limit:
                oldest = self._queue.popleft()
                self.dropped += not oldest.counted
                if oldest.image_bytes:
                    self._bytes -= self._pictured.popleft().image_bytes
            waiting = _Waiting(datum, _image_bytes(datum))
            self._queue.append(waiting)
            if waiting.image_bytes:
                self._pictured.append(waiting)
                self._bytes += waiting.image_bytes
            while self._bytes > _IMAGES_MB * 1e6:
                oldest = self._pictured.popleft()
                self._bytes -= oldest.image_bytes
                oldest.datum, oldest.image_bytes, oldest.counted = _without_images(oldest.datum), 0, True
                self.dropped += 1
            if len(self._queue) >= self._wakes:
                self._changed.notify()

    def pause(self) -> None:
        """Begin to write no other datum until :meth:`resume`, for ``TICK_S`` each at the most, unless much waits.

        A thread that runs Python when a command is due delays it by up to the interpreter's switch interval.
        """
        self._may_write.clear()

    def resume(self) -> None:
        """Write again."""
        self._may_write.set()

    def close(self) -> None:
        """Publish what waits, and end the thread; a second call has no effect."""
        self._may_write.set()
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(self._close_s)

    def _run(self) -> None:
        ticked = time.monotonic()
        try:
            while True:
                with self._changed:
                    if len(self._queue) < self._wakes and not self._closing:
                        self._changed.wait(TICK_S)
                    waiting, self._queue, self._pictured, self._bytes = self._queue, deque(), deque(), 0
                    closing = self._closing
                for n, each in enumerate(waiting):
                    if len(waiting) - n + len(self._queue) < _BEHIND * self._limit:
                        self._may_write.wait(TICK_S)
                    self.write(each.datum)
                if time.monotonic() - ticked >= TICK_S:
                    self.tick()
                    ticked = time.monotonic()
                if closing and not waiting:
                    break
        except OSError as error:
            self.problem = error.strerror or str(error)
        except Exception as error:  # noqa: BLE001 - nobody else watches this thread; the measurement goes on
            self.problem = f"{type(error).__name__}: {error}"
        finally:
            try:
                self.finish()
            except OSError as error:
                self.problem = self.problem or error.strerror or str(error)
            self.cpu_s = time.thread_time()

    def write(self, datum: Datum) -> None:
        """Publish one datum."""
        raise NotImplementedError

    def tick(self) -> None:
        """Do what is due now and then."""

    def finish(self) -> None:
        """Release what was opened."""
