"""One calibration: images or detections in, a calibration out, and how it was made."""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.calibrate.command import CalibrateOptions
from armsight.app.options import DETECTIONS, SIM
from armsight.app.progress import bar, steps
from armsight.app.record.recording import record
from armsight.data import SIDES, Detections, Shot
from armsight.errors import CalibrationError, InputError, naming
from armsight.files import natural_key, unused
from armsight.vision.calibrate import MODELS
from armsight.vision.calibrate.boards import LEAST_PAIRS, Pair, calibrate_boards, calibrate_recording
from armsight.vision.calibrate.bodies import calibrate_bodies
from armsight.vision.calibrate.result import Calibration
from armsight.vision.calibrate.weak import contradicted
from armsight.vision.camera_file import read_cameras
from armsight.vision.detections import read_detections
from armsight.vision.image import BitDepth, darkness, grey, one_image, read_image
from armsight.vision.markers.aruco import FAMILIES, detect_markers, family_size
from armsight.vision.markers.board import open_board
from armsight.vision.markers.body_file import load_body_csv, save_body_csv
from armsight.vision.markers.calibrated_board import save_board_file
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.rig import CONTRADICTED
from armsight.vision.sources import LIVE, Source, notes_of, open_source
from armsight.vision.sources.pairs import StoredSource, image_files, no_files, two_globs

#: Fewest markers of a family by which it is named as the one in view; in families of few cells less are chance.
_LEAST_CODES = 4

#: A person has so long to show the board to live cameras, s; half: too few poses, double: an arm that grows tired.
_RECORDED_S = 60.0
#: The simulated workcell as cameras, and how often its person shows the board.
_SIM_CAMERAS, _SIM_SHOTS = "1280x720@60", 24

Grey = NDArray[np.uint8]
_Timed = tuple[Pair, float | None]
_Sizes = tuple[tuple[int, int], tuple[int, int]]


class GivenDetections:
    """Detections of a known body, to calibrate from; the body's points are estimated into a file that is named."""

    board_file: Path | None = None
    notes: tuple[str, ...] = ()

    def __init__(self, options: CalibrateOptions) -> None:
        """Hold the files, which are read later."""
        detections, cameras, body = Path(options.source.removeprefix(DETECTIONS)), options.cameras, Path(options.target)
        assert cameras is not None  # the command's check
        self._options, self.files = options, (detections, cameras, body)
        self.named = {"detections": str(detections), "cameras": str(cameras), "body": str(body)}

    def calibrated(self) -> Calibration:
        """Read the files, and calibrate."""
        detections, cameras, body = self.files
        with naming("--cameras"):
            pair = read_cameras(cameras)
        known, refine = load_body_csv(body), self._options.refine_body is not None
        with steps() as progress:
            shots, folds = read_detections(detections, known), self._options.folds
            return calibrate_bodies(known, shots, pair, refine_body=refine, folds=folds, progress=progress)

    def save(self, calibration: Calibration) -> None:
        """Write what was found besides the rig."""
        if self._options.refine_body is not None:
            save_body_csv(calibration.body, self._options.refine_body)


def _open(spec: str, folder: Path, target: str) -> Source:
    """Open a folder or a recording; what cameras see is stored in a new folder first, so that it is there afterwards."""
    if not spec.startswith((*LIVE, SIM)):
        return open_source(spec)
    stored = unused(folder)
    simulated = spec.startswith(SIM)
    opened = _SimulatedBoard(spec, target) if simulated else open_source(spec)
    if simulated:
        click.echo(f"a simulated person shows the target {_SIM_SHOTS} times; the images go to {stored}", err=True)
    else:
        click.echo(f"recording for {_RECORDED_S:g} s into {stored}: move the target; Ctrl-C ends it earlier", err=True)
    with contextlib.closing(opened) as live, bar("recording shots", live.count) as advance:
        done = record(live, stored, seconds=_RECORDED_S, on_shot=lambda _: advance())
    if (done.stopped and not done.interrupted) or not done.shots:
        there = f"; {done.shots} shots are in {stored}" if done.shots else ""
        raise InputError(f"{spec.removesuffix(':')}: {done.stopped or 'no shot came'}{there}")
    return open_source(str(stored))


class _SimulatedBoard(Source):
    """What the workcell's cameras see of the board that a person shows them."""

    count: int | None = _SIM_SHOTS

    def __init__(self, spec: str, target: str) -> None:
        from armsight.sim.workcell.workcell import Workcell

        self._workcell = Workcell.open(cameras=spec.removeprefix(SIM) or _SIM_CAMERAS)
        self._shots = self._workcell.board_shots(_SIM_SHOTS, target)

    def read(self) -> Shot | None:
        """Return the next shot; the workcell's time stands still, so it has none."""
        shot = next(self._shots, None)
        return None if shot is None else replace(shot, t_s=None)

    def close(self) -> None:
        self._workcell.close()


class GivenImages:
    """Images of a board, to calibrate from; the board's shape as it is found goes into ``board_file``."""

    notes: tuple[str, ...] = ()  #: that Ctrl-C ended the reading

    def __init__(self, options: CalibrateOptions) -> None:
        """Open a source, or the images that two globs match, and find those of one camera alone."""
        self.named: dict[str, str] = {}
        self._options, self._spec, spec = options, str(options.target), options.source
        alone = ["", ""] if options.alone is None else options.alone.split(",")
        if len(alone) != len(SIDES):
            raise InputError(f"--alone {options.alone}: two globs are needed, LEFT,RIGHT; one of them may be empty")
        self._alone = [(side, file) for side, pattern in enumerate(alone) for file in _files_of(pattern)]
        self._board = open_board(self._spec)  # before anything is recorded
        self._source, self.named["source"] = _open(spec, options.output.with_suffix(".board"), self._spec), spec
        kind, _, rest = spec.partition(":")
        if kind == "pairs":
            self.named |= zip(SIDES, two_globs(rest), strict=True)
        self.board_file = options.output.parent / f"{options.output.stem}.board.toml"
        self.named |= {"target": self._spec, "board": self.board_file.name}
        self.named |= {f"{side}_intrinsics": each for side, each in zip(SIDES, alone, strict=True) if each}

    @property
    def files(self) -> tuple[Path, ...]:
        """All images that are files."""
        stored = self._source.files if isinstance(self._source, StoredSource) else ()
        return (*stored, *(file for _, file in self._alone))

    def calibrated(self) -> Calibration:
        """Detect the board in all images, and calibrate; Ctrl-C ends the detecting."""
        source, target = self._source, self._board
        pairs, singles = list[_Timed](), list[Pair]()
        sizes, unseen, total = None, _Unseen(target), None if source.count is None else source.count + len(self._alone)
        try:
            with bar("detecting the target", total) as advance:
                for shot, files in _shots(source):
                    if shot.left is None or shot.right is None:
                        nothing = Detections.none(shot.problem or "no image")
                        unread = (nothing, replace(nothing, problem=None))  # the problem names the file of one side
                        left, right = unread[::-1] if (shot.problem or "").startswith(f"{files[1]}:") else unread
                        pairs.append((Pair(shot.name, left, right), shot.t_s))
                    else:
                        images = grey(shot.left), grey(shot.right)
                        sizes = _one_size(sizes, images, files)
                        pairs.append((Pair(shot.name, target.detect(images[0]), target.detect(images[1])), shot.t_s))
                        unseen.keep(images, pairs[-1][0])
                    advance()
                depth = BitDepth.of_files([path for _, path in self._alone])
                for side, path in self._alone if sizes is not None else ():
                    singles.append(_single(path, depth, target, side, sizes[side] if sizes is not None else (0, 0)))
                    advance()
        except KeyboardInterrupt:
            if sum(not pair.left.problem and not pair.right.problem for pair, _ in pairs) < LEAST_PAIRS:
                raise
            read = f"{len(pairs) + len(singles)} of {total}" if total else f"{len(pairs)}"
            self.notes = (f"interrupted after {read}: made from these",)
            click.echo(f"armsight: {self.notes[0]}; Ctrl-C again ends it without a rig", err=True)
        if sizes is None:
            why = [f"none of {len(pairs)} pairs can be read; {pair.name}: {pair.left.problem}" for pair, _ in pairs[:1]]
            raise InputError(*why or ["the recording has no shots"])
        with unseen.explained(source):
            return self._fitted(pairs, sizes, singles)

    def _fitted(self, pairs: list[_Timed], sizes: _Sizes, singles: list[Pair]) -> Calibration:
        """Calibrate; where shots have times the board may move, and the skew is found."""
        o, board, known = self._options, self._board, [(pair, t) for pair, t in pairs if t is not None]
        how: Any = {"models": (o.lens_model,) if o.lens_model else MODELS, "flat": o.flat_target, "folds": o.folds}
        with steps() as progress:
            how |= {"singles": singles, "progress": progress}
            if not known:
                return calibrate_boards(board, [pair for pair, _ in pairs], sizes, **how)
            timed, t_s = zip(*known, strict=True)
            found = calibrate_recording(board, timed, np.array(t_s), sizes, **how)
            return replace(found, notes=(*notes_of(self._source), *found.notes))

    def save(self, calibration: Calibration) -> None:
        """Write the board as it was found."""
        radius_m, spec = calibration.disc_radius_m, self._spec
        if radius_m is not None and "radius=" not in spec:
            spec += f":radius={1e3 * radius_m:.6g}mm"
        save_board_file(self.board_file, spec, calibration.body.points)

    def close(self) -> None:
        """Close the source."""
        self._source.close()


def _files_of(pattern: str) -> list[Path]:
    files = sorted(image_files(pattern), key=natural_key) if pattern else []
    if pattern and not files:
        raise InputError(no_files(pattern))
    return files


def _single(path: Path, depth: BitDepth, target: CalibrationBoard, side: int, size: tuple[int, int]) -> Pair:
    """Detect the target in an image of one camera alone; its pixels are converted to those of the pairs."""
    image = grey(*depth.filled(read_image(path)))
    height, width = image.shape
    scale = size[0] / width
    if abs(height * scale - size[1]) > 0.5 * max(scale, 1.0):
        other = f"the {SIDES[side]} images in the pairs {size[0]}x{size[1]}"
        raise InputError(f"{path}: is {width}x{height}, {other}: take both with the same ratio of width to height")
    found, square = target.detect(image), scale**2
    uv, common = (found.uv + 0.5) * scale - 0.5, found.common * [scale, scale, 1.0]
    found = replace(found, uv=uv, cov_uv=found.cov_uv * square, shape=found.shape * square, common=common)
    nothing = Detections.none(f"{path.name} is of the {SIDES[side]} camera alone")
    return Pair(str(path), *((found, nothing) if side == 0 else (nothing, found)))


class _Unseen:
    """Images in which the target was not found, a few of each camera, to say why."""

    def __init__(self, target: CalibrationBoard) -> None:
        self._target = target
        self._kept: tuple[list[Grey], list[Grey]] = [], []
        self._missed = [0, 0]

    def keep(self, images: tuple[Grey, Grey], pair: Pair) -> None:
        """Keep the images without the target: of each camera the first one, the second, the fourth, the eighth, ..."""
        for side, found in enumerate((pair.left, pair.right)):
            if found.problem is not None:
                self._missed[side] += 1
                if self._missed[side].bit_count() == 1:
                    self._kept[side].append(images[side])

    @contextlib.contextmanager
    def explained(self, source: Source) -> Iterator[None]:
        """Add to a CalibrationError what is odd about the images without the target, and the notes of their source."""
        try:
            yield
        except CalibrationError as error:
            odd = [
                f"The {missed} {SIDES[side]} images without the target: {why}."
                for side, (kept, missed) in enumerate(zip(self._kept, self._missed, strict=True))
                if (why := self._why(kept))
            ]
            lines = [str(error), *odd, *(f"Note: {note}." for note in notes_of(source))]
            raise CalibrationError(" ".join(lines)) from None

    def _why(self, images: list[Grey]) -> str:
        if images and all(darkness(image) for image in images):
            return darkness(images[0])
        for image in images:
            if self._target.detect(np.ascontiguousarray(image[:, ::-1])).problem is None:
                return "the target is found once they are mirrored: does the driver mirror them? Switch it off"
        return self._codes(images[0]) if images else ""

    def _codes(self, image: Grey) -> str:
        family, ids = self._target.codes
        if not family or len(detect_markers(image, family)[1]) >= _LEAST_CODES:
            return ""
        most, least = "", max(_LEAST_CODES, len(ids) // 4) - 1
        for name in sorted(FAMILIES, key=family_size):  # of families that begin alike the smallest one is named
            if (found := len(detect_markers(image, name)[1])) > least:
                most, least = name, found
        return f"the first shows {least} markers of {most}, not of {family}" if most else ""


def _shots(source: Source) -> Iterator[tuple[Shot, tuple[Path | str, Path | str]]]:
    """Yield the shots of a source with the names of what they come from, for messages."""
    if isinstance(source, StoredSource):
        for stored, shot in zip(source.pairs, source, strict=True):
            yield shot, (stored.left or shot.name, stored.right or shot.name)
        return
    while (next_one := source.read()) is not None:
        yield next_one, (f"shot {next_one.name}", f"shot {next_one.name}")


def _one_size(sizes: _Sizes | None, images: tuple[Grey, Grey], files: tuple[Path | str, Path | str]) -> _Sizes:
    """Return the sizes of a pair's images; an InputError if they differ from those before, or both images are one."""
    now = tuple((image.shape[1], image.shape[0]) for image in images)
    for side, path in enumerate(files):
        if sizes is not None and sizes[side] != now[side]:
            (w, h), (w0, h0) = now[side], sizes[side]
            raise InputError(f"{path}: is {w}x{h}, the {SIDES[side]} images before it {w0}x{h0}: one size is needed")
    if one_image(*images):
        raise InputError(f"{files[0]}, {files[1]}: both images are the same: give the images of two cameras")
    return now[0], now[1]


def provenance(given: dict[str, str], calibration: Calibration) -> dict[str, Any]:
    """Return how the rig was made, as its file records it."""
    h, version = calibration.held_out, importlib.metadata.version("armsight")
    made: dict[str, Any] = {"made_by": f"armsight {version} calibrate, OpenCV {cv2.__version__}"}
    made |= {"made_utc": datetime.now(UTC).isoformat(timespec="seconds"), **given, "pairs_used": len(calibration.pairs)}
    made |= {f"heldout_{key}": getattr(h, key) for key in ("epipolar_rms_px", "rigid_rms_m", "scale_error")}
    return made | ({CONTRADICTED: round(h.epipolar_rms_px, 2)} if contradicted(calibration) else {})
