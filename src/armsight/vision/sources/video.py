"""Video files: one for each camera, or one with both images side by side.

In: file names. Out: one shot a frame, with the file's own time stamps. Frames are paired by time stamp, so that a frame
one recorder dropped costs one shot and does not shift the rest. Matroska, MPEG-TS and MP4 with an empty edit hold when a
file begins, too: two of one clock (of one GStreamer pipeline: matroskamux 1.22) need not begin at the same moment. (OpenCV
5.0.0 and ffmpeg take both beginnings for 0.)

:class:`Film` decodes by PyAV, which brings FFmpeg with the decoders that cameras and LeRobot use (AV1 among them, which
opencv-python's wheels open, count and do not decode). A rotation by right angles or a mirroring that was noted for players
is applied, as ffmpeg does; PyAV's frame.rotation (18.1.0) and OpenCV (5.0.0) take a mirroring for a rotation, or for none.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from armsight import MOST_PIXELS
from armsight.data import Array, Image, Shot
from armsight.errors import InputError, some
from armsight.files import check_readable
from armsight.vision.source import Source
from armsight.vision.sources.pairs import split_names

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

#: Two rates that differ by more than this share are said.
_RATES = 0.01
#: Of how many rows and columns one is compared between frames.
_EVERY = 4
#: A frame repeats the one before if its mean squared difference from it is below this share of those nearby, in as many
#: frames before it and after it; re-encoding leaves some difference. Where frames nearby differ by less, nothing changes,
#: grey levels squared.
_REPEAT_SHARE, _NEARBY, _LEAST_CHANGE = 1 / 16, 3, 0.25
#: Repeated and interpolated frames are said from this share on: what moves and stops has a few that look like it.
_REPEATS_SAID = 0.15
#: A frame is interpolated if a mixture of its neighbours is so much nearer to it than mixtures are to frames nearby. The
#: share of one neighbour in it is at least this, otherwise it is a repeated one. Only pixels count that differ by so many
#: grey levels between the neighbours: noise where nothing moves is averaged by codecs, too.
_MIXED, _MOVED_GREY = 0.08, 12.0
#: Share of such pixels below which nothing is said to move.
_MOVED_LEAST = 0.002

_DURATION = re.compile(r"(\d+):(\d+):(\d+(?:\.\d+)?)")
#: What a player would fetch: a file may name others, and addresses.
_OPTIONS = {"protocol_whitelist": "file"}


class VideoSource(Source):
    """Two video files, or one side-by-side file."""

    count: int | None = None  # what a container promises is an estimate
    timed = True

    def __init__(self, files: Sequence[_File]) -> None:
        self._files = list(files)
        first, last = self._files[0], self._files[-1]
        rates = [1 / file.period_s for file in (first, last)]
        self._odd: tuple[str, ...] = ()
        if min(rates) > 0 and abs(rates[0] - rates[1]) > _RATES * max(rates):
            self._odd = (
                f"{first.path} has {rates[0]:.4g} frames a second and {last.path} {rates[1]:.4g}: only those of nearly the "
                "same time are paired, up to half a frame apart; set both cameras to one rate, or use what stands still",
            )
        width, height = first.size_px
        if len(self._files) == 1 and width < 2 * height:
            self._odd = (
                f"{first.path}: frames of {width}x{height} px have the shape of one picture, and are taken as two of "
                f"{width // 2}x{height} side by side; two files are video:LEFT,RIGHT",
            )
        self._odd += _one_clock(first, last)
        self._shots = 0
        self._steps_s: list[float] = []  # between frames of either file, s, sorted
        self._ended = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd: different rates, and frames among those read that are damaged, repeat or are mixtures."""
        return (*self._odd, *(text for file in self._files for text in file.notes()))

    @property
    def odd_frames(self) -> dict[str, dict[str, list[int]]]:
        """File -> ``repeated``, ``interpolated`` -> numbers of such frames among those read; only where there are."""
        found = {file.path: {"repeated": file.repeated[0], "interpolated": file.mixed[0]} for file in self._files}
        some = {path: {kind: numbers for kind, numbers in kinds.items() if numbers} for path, kinds in found.items()}
        return {path: kinds for path, kinds in some.items() if kinds}

    @staticmethod
    def open(left: str | Path, right: str | Path | None = None) -> VideoSource:
        """Open a file for each camera, or with no ``right`` one of both images side by side.

        Raises InputError: a file is missing or not a video, both are the same, or a side-by-side frame has an odd width.
        """
        if right is not None and Path(left).resolve() == Path(right).resolve():
            raise InputError(f"{left}: given as both left and right video; a side-by-side video is video:{left}")
        files = [_File(str(path)) for path in (left, right) if path is not None]
        width, _ = files[0].size_px
        if right is None and width % 2:
            files[0].close()
            raise InputError(f"{left}: a side-by-side video must have an even width, this one is {width} px wide")
        return VideoSource(files)

    def read(self) -> Shot | None:
        """Return the next shot, or None where the shorter file ends."""
        if self._ended:
            return None
        name = f"{self._shots:06d}"
        self._shots += 1
        before_s = [file.t_s for file in self._files]
        grabbed = [file.grab() for file in self._files]
        if not all(grabbed):
            self._ended = True
            problem = self._unexpected_end(grabbed)
            return Shot(name, None, None, None, problem) if problem else None
        for file, t_s in zip(self._files, before_s, strict=True):
            if file.t_s > t_s:  # one that was held has not moved on
                bisect.insort(self._steps_s, file.t_s - t_s)
        first, last = self._files[0], self._files[-1]
        if abs(first.t_s - last.t_s) > self._period_s() / 2:
            early, late = sorted((first, last), key=lambda file: file.t_s)
            late.held = True
            problem = (
                f"{late.path} has no frame for {early.path}'s at {early.t_s:.3f} s: its next is at {late.t_s:.3f} s"
            )
            return Shot(name, None, None, early.t_s, problem)
        images = [file.image() for file in self._files]
        left, right = images if len(images) == 2 else np.split(images[0], 2, axis=1)
        return Shot(name, left, right, first.t_s)

    def close(self) -> None:
        """Close the files."""
        self._ended = True
        for file in self._files:
            file.close()

    def _period_s(self) -> float:
        """Return the median step so far, s: a file's own period is a mean, and long where frames were dropped."""
        number = len(self._steps_s)
        middle = self._steps_s[(number - 1) // 2 : number // 2 + 1]
        return float(np.mean(middle)) if middle else self._files[0].period_s

    def _unexpected_end(self, grabbed: list[bool]) -> str | None:
        """Return what is wrong with the end of the files; None where nothing is."""
        for file, ok in zip(self._files, grabbed, strict=True):
            if (
                not ok and file.end_s - file.late_s < file.promised_s - file.period_s
            ):  # some containers estimate: one frame less is fine
                ends = f"it ends at {file.end_s - file.late_s:.3f} s of {file.promised_s:.3f} s"
                return f"{file.path} is damaged or cut short: {ends}"
        if any(grabbed):
            short, long = sorted(self._files, key=lambda file: file.frames)
            return f"{short.path} ends after {short.frames} frames, {long.path} goes on: stopped there"
        return None


class Film:
    """An open video file and its current frame; InputError where it is missing, no video or of an unknown codec.

    Attributes:
        path: the file.
        size_px: width and height of its images.
        period_s: between two frames, s; infinite where the file does not say.
        promised_s: how long the file says its images last, s, an estimate in some containers; 0 where it does not say.
        begin_s: when it begins by its own clock, s.
        late_s: how much later than the times' zero it begins, s.
        coded_s: when its first frame is to be decoded by its own clock, s: before it is shown, where frames are reordered.
        frames: how many were decoded.
        undecoded: how many could not be.
        t_s, end_s: when the current frame is shown, from the beginning, and until when, s.
    """

    def __init__(self, path: str) -> None:
        import av  # not before it is needed: it takes a tenth of a second

        av.logging.set_level(av.logging.PANIC)
        self.path = check_readable(path)
        self._error: type[Exception] = av.error.FFmpegError
        try:
            self._container: InputContainer = av.open(f"file:{path}", options=_OPTIONS)
        except (self._error, ValueError):
            raise InputError(f"{path}: not a video file, or one that is cut short at its beginning") from None
        if not self._container.streams.video:
            self._container.close()
            raise InputError(f"{path}: holds no video")
        self._stream: VideoStream = self._container.streams.video[0]
        problem = self._problem()
        if problem:
            self._container.close()
            raise InputError(f"{path}: {problem}")
        self._stream.thread_type = "AUTO"
        average = self._stream.average_rate  # an AVI's may be that of its clock; else the guess may be
        rate = min(filter(None, (average, self._stream.guessed_rate)), default=None)
        self.period_s = float(1 / rate) if rate else np.inf
        self._time_base: Fraction = self._stream.time_base or Fraction(1)
        self._start = self._stream.start_time or 0
        self.begin_s, self.late_s = float(self._start * self._time_base), 0.0
        self.promised_s = self._promised_s()
        self.frames = self.undecoded = 0
        self.t_s = self.end_s = 0.0
        self.coded_s: float | None = None
        self._frame: VideoFrame | None = None
        self._frames: Iterator[VideoFrame] = self._decoded()
        first = list(itertools.islice(self._frames, 1))  # the rotation stands in the frames alone
        self._frames = itertools.chain(first, self._frames)
        self._swapped, self._steps = _shown(first[0]) if first else (False, (1, 1))
        size = (self._stream.width, self._stream.height)
        self.size_px = size[::-1] if self._swapped else size

    def _problem(self) -> str | None:
        """Return why the stream cannot be decoded."""
        context = self._stream.codec_context
        if context is None:
            return "its codec is not one that this PyAV decodes; convert it: ffmpeg -i IN -c:v libx264 -crf 10 OUT.mp4"
        if context.width * context.height > MOST_PIXELS:
            return f"frames of {context.width}x{context.height} px, more than {MOST_PIXELS >> 20} Mpx"
        return None if context.width * context.height else "damaged: its frames have no size"

    @property
    def is_transport_stream(self) -> bool:
        """Whether its container is an MPEG-TS."""
        return "mpegts" in self._container.format.name

    def _promised_s(self) -> float:
        """Return how long the file says its images last, s; the container's duration is that of its sound, too."""
        if self._stream.frames and self._stream.average_rate and "mp4" not in self._container.format.name:
            return float(
                self._stream.frames / self._stream.average_rate
            )  # an MP4 counts those that its edit list hides
        if self._stream.duration:
            return float(self._stream.duration * self._time_base)
        said = _DURATION.fullmatch(self._stream.metadata.get("DURATION", ""))
        if said:  # Matroska's, which counts from zero as the container's does
            return 3600 * int(said[1]) + 60 * int(said[2]) + float(said[3]) - self.begin_s
        alone_us = self._container.duration if len(self._container.streams) == 1 else None
        return alone_us / 1e6 - self.begin_s if alone_us else 0.0

    def _decoded(self) -> Iterator[VideoFrame]:
        """Yield what can be decoded; a damaged packet is counted, a damaged container is the end."""
        with contextlib.suppress(self._error, ValueError):
            for packet in self._container.demux(self._stream):
                if self.coded_s is None and packet.dts is not None:
                    self.coded_s = float(packet.dts * self._time_base)
                try:
                    yield from packet.decode()
                except self._error:
                    self.undecoded += 1

    def next(self) -> bool:
        """Go to the next frame; False at the end."""
        self._frame = next(self._frames, None)
        if self._frame is None:
            return False
        if self._frame.pts is None:
            self.t_s = self.late_s + (self.frames * self.period_s if self.frames else 0.0)
        else:
            self.t_s = self.late_s + float((self._frame.pts - self._start) * self._time_base)
        self.end_s = self.t_s + max(self.period_s, float((self._frame.duration or 0) * self._time_base))
        self.frames += 1
        return True

    def image(self) -> Image:
        """Return the current frame, (H, W, 3) BGR, uint8."""
        assert self._frame is not None
        image = self._frame.to_ndarray(format="bgr24")
        down, right = self._steps
        return np.ascontiguousarray((image.transpose(1, 0, 2) if self._swapped else image)[::down, ::right])

    def seek(self, t_s: float) -> None:
        """Go to a frame at a time or before it, from which the frames up to that time can be decoded."""
        with contextlib.suppress(self._error):
            self._container.seek(int(t_s / self._time_base) + self._start, stream=self._stream)
            self._frames = self._decoded()

    def close(self) -> None:
        """Close the file."""
        self._frames = iter(())
        self._frame = None
        self._container.close()


def _shown(frame: VideoFrame) -> tuple[bool, tuple[int, int]]:
    """Return whether a frame is shown with its rows as columns, and then in which steps, 1 or -1, down and right.

    The display matrix (ISO 14496-12, 8.3.2) takes pixel (x, y) to (a x + c y, b x + d y), less a translation.
    """
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    a, b, _, c, d = (1, 0, 0, 0, 1) if matrix is None else np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    swapped = abs(b) + abs(c) > abs(a) + abs(d)
    right, down = (c, b) if swapped else (a, d)
    return swapped, (-1 if down < 0 else 1, -1 if right < 0 else 1)


class _File(Film):
    """One open video file, and what is odd about its frames."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.held = False  # the current frame waits for a partner: the next grab keeps it
        self._before: Array | None = None
        self._two_before: Array | None = None
        self._numbers: list[int] = []  # of the frames that were decoded, from 0
        self._changes: list[float] = []  # mean squared differences from the frame before, grey levels squared
        # Of each frame between two others what is left of it without the best mixture of both, as a share of the square
        # of their difference, and the first one's share in the mixture; infinite and 0 where nothing moves.
        self._mixtures: list[tuple[float, float]] = []

    def grab(self) -> bool:
        """Go to the next frame, unless the current one waits; False at the end."""
        going = self.held or self.next()
        self.held = False
        return going

    def image(self) -> Image:
        """Decode the current frame, and compare it with those before."""
        image = super().image()
        self._numbers.append(self.frames - 1)
        some = np.asarray(image[::_EVERY, ::_EVERY], np.float64)
        if self._before is not None:
            self._changes.append(float(np.mean((some - self._before) ** 2)))
        if self._before is not None and self._two_before is not None:
            self._mixtures.append(_mixture(self._two_before, self._before, some))
        self._two_before, self._before = self._before, some
        return image

    @property
    def repeated(self) -> tuple[list[int], float]:
        """Numbers of the frames that repeat the ones before them, and their share; none where they are few."""
        changes = np.array(self._changes)
        return self._odd(changes, _LEAST_CHANGE, np.ones(len(changes), bool))

    @property
    def mixed(self) -> tuple[list[int], float]:
        """Numbers of the frames that are mixtures of their neighbours, and their share; none where they are few."""
        left, first = np.array(self._mixtures).reshape(-1, 2).T
        return self._odd(left, -1.0, np.abs(first - 0.5) < 0.5 - _MIXED)

    def _odd(self, values: Array, least: float, may_be: NDArray[np.bool_]) -> tuple[list[int], float]:
        """Return the numbers of frames of far smaller values (N,) than those nearby, and their share of those that change.

        Nothing changes where those nearby are below ``least`` or infinite; none are returned where the share is too small.
        """
        if len(values) <= 2 * _NEARBY:
            return [], 0.0
        runs = np.lib.stride_tricks.sliding_window_view(values, _NEARBY).max(axis=1)
        nearby, own = np.minimum(runs[: -_NEARBY - 1], runs[_NEARBY + 1 :]), values[_NEARBY:-_NEARBY]
        changing = (nearby > least) & np.isfinite(nearby) & np.isfinite(own)
        odd = changing & may_be[_NEARBY:-_NEARBY] & (own < _REPEAT_SHARE * nearby)
        share = float(odd.sum() / max(changing.sum(), 1))
        numbers = np.array(self._numbers)[1 + _NEARBY :][: len(odd)]
        return (numbers[odd].tolist(), share) if share > _REPEATS_SAID else ([], 0.0)

    def notes(self) -> Iterator[str]:
        """Yield what to say of frames that cannot be decoded, repeat (a slower camera's) or are mixed (another rate's)."""
        if self.undecoded:
            yield f"{self.path}: {self.undecoded} frames are damaged: left out"
        numbers, share = self.repeated
        if numbers:
            given, rate = (1 - share) / self.period_s, 1 / self.period_s
            yield (
                f"{self.path}: {100 * share:.0f} % of the frames repeat the one before: the camera gave about {given:.0f} "
                f"images a second and the file has {rate:.0f}; a repeated image is no new measurement, and its time is "
                f"late: {_listed(numbers)}"
            )
        numbers, share = self.mixed
        if numbers:
            yield (
                f"{self.path}: {100 * share:.0f} % of the frames are interpolated, mixtures of those before and after: "
                "they show markers twice, or where they never were; record at the camera's own rate, or leave them out: "
                f"{_listed(numbers)}"
            )


def _one_clock(first: Film, last: Film) -> tuple[str, ...]:
    """Make the later of two files begin later, where their own clocks say so and they overlap; return what to say of it."""
    early, later = sorted((first, last), key=lambda file: file.begin_s)
    late_s = later.begin_s - early.begin_s
    if late_s <= early.period_s / 2:
        return ()
    # FFmpeg's muxer (9.0) begins a file with its first frame in the order of decoding: one with B-frames begins that later.
    if early.is_transport_stream and later.is_transport_stream and early.coded_s == later.coded_s:
        return (
            f"{later.path} begins {late_s:.3f} s after {early.path} as its frames are reordered: paired from the first on",
        )
    if 0 < early.promised_s <= late_s:
        return (f"{later.path} begins {late_s:.3f} s after {early.path}, past its end: their beginnings are paired",)
    later.late_s = later.t_s = late_s
    return (
        f"{later.path} begins {late_s:.3f} s after {early.path} by their stamps, and is paired so; of two clocks: "
        "ffmpeg -i IN -c copy OUT makes a file begin at 0",
    )


def _listed(numbers: Sequence[int]) -> str:
    """Name the first few frames of many."""
    return f"frames {some(numbers)} (from 0)"


def _mixture(before: Array, frame: Array, after: Array) -> tuple[float, float]:
    """Return what the best mixture of two frames leaves of the one between them, and the first one's share in it.

    The former is a share of the square of their difference, over the pixels that differ; infinite where nothing moves.
    """
    moved = np.abs(before - after) > _MOVED_GREY
    if moved.sum() < _MOVED_LEAST * moved.size:
        return np.inf, 0.0
    step, own = (before - after)[moved], (frame - after)[moved]
    share = float(own @ step / (step @ step))
    return float(np.sum((own - share * step) ** 2) / (step @ step)), share


def open_video(rest: str) -> VideoSource:
    """Open ``LEFT.mp4,RIGHT.mp4`` or ``SIDE_BY_SIDE.mp4``."""
    names = (rest,) if os.path.isfile(rest) or "," not in rest else split_names(rest, os.path.isfile)
    if names is None or not all(names):
        raise InputError(f"video:{rest}: expected video:LEFT.mp4,RIGHT.mp4 or video:SIDE_BY_SIDE.mp4")
    return VideoSource.open(*names)
