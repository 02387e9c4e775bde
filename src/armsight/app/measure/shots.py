"""What ``armsight measure`` measures: images of a target, or detections of a body; each gives shots with their results.

A recording of a moving body before cameras that do not expose at one time is measured twice: first as if all exposures were
simultaneous, with a wide gate, from which skew and readout are found where they are not given; then with every detection
moved to its shot's time.
"""

from __future__ import annotations

import itertools
import json
import re
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import click
import numpy as np

from armsight.app.measure.command import MeasureOptions
from armsight.app.show.messages import note
from armsight.data import SIDES, Body, Image, Missed, PoseEstimate, Shot
from armsight.errors import NAMED, InputError
from armsight.files import check_writable
from armsight.loop.finding import HealthFinding, make_finding
from armsight.vision.detections import SeenShot, read_detections
from armsight.vision.follow.follower import Follower, follows
from armsight.vision.image import grey, one_image
from armsight.vision.markers.board import BOARDS, board_in_view
from armsight.vision.markers.calibrated_board import EstimatedBoard, is_print, load_board_file
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_body, open_target
from armsight.vision.pose.measure import measure, measure_seen, size_problem
from armsight.vision.pose.noise import DiscNoise
from armsight.vision.pose.shot_pose import ShotPose
from armsight.vision.pose.shutter import LOOSE_PX, TimedShot, estimate_shutters, measure_moving
from armsight.vision.rig import Shutters, StereoRig
from armsight.vision.sources import Source, notes_of, open_source
from armsight.vision.sources.folder import INDEX
from armsight.vision.sources.pairs import StoredSource

#: So much a board that looks the same when it is rotated may be rotated less than by that, degrees.
_ROTATED_SPARE_DEG = 35.0


_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
#: A skew beyond so many sigmas, and so many seconds, is said; from the first so many shots.
_NOTED_SIGMAS, _NOTED_S, NOTED_SHOTS = 5.0, 1e-4, 200


@dataclass(frozen=True)
class Requested:
    """What a user requests of the shutters; None is to be found."""

    skew_s: float | None
    readout_s: float | None


def requested_shutters(skew: str | None, readout: str | None) -> Requested | None:
    """Read ``--skew`` and ``--readout``; None where neither is given. Where only one is, the skew is found, no readout."""
    if skew is None and readout is None:
        return None
    found = Requested(_seconds("--skew", skew or "find"), _seconds("--readout", readout or "0ms"))
    if found.readout_s is not None and found.readout_s < 0:
        raise InputError(f"--readout {readout}: must not be below zero")
    if found.readout_s is None and found.skew_s is not None:
        raise InputError("--readout find needs --skew find: both are found together")
    return found


def _seconds(option: str, text: str) -> float | None:
    if text.strip() == "find":
        return None
    match = re.fullmatch(r"([+-]?\d*\.?\d+)\s*(s|ms|us)", text.strip())
    if match is None:
        raise InputError(f"{option} {text!r}: expected a time with its unit, such as 5ms, or find")
    return float(match[1]) * _UNITS[match[2]]


def moved_results(
    rig: StereoRig,
    body: Body,
    first: Sequence[tuple[float | None, PoseEstimate | Missed]],
    requested: Requested | Shutters,
) -> tuple[list[tuple[PoseEstimate | Missed, bool]], Shutters]:
    """Return the result of every shot with its detections moved to its time, and whether they were; and the shutters.

    ``first``: time, s, and result of every shot as measured; ``requested``: shutters, or which are to be found.
    """
    if any(t_s is None and isinstance(result, PoseEstimate) for t_s, result in first):
        why = "these shots have no times, so nothing is known of the body's motion between two exposures"
        raise InputError(f"{why}: record them with `armsight record`, or give a video")
    shots = _timed(first)
    shutters = requested if isinstance(requested, Shutters) else _shutters(rig, body, shots, requested)
    moved = iter(measure_moving(rig, body, shots, shutters))
    return [next(moved) if isinstance(result, PoseEstimate) else (result, False) for _, result in first], shutters


def _timed(first: Sequence[tuple[float | None, PoseEstimate | Missed]]) -> list[TimedShot]:
    measured = [(t_s, r) for t_s, r in first if t_s is not None and isinstance(r, PoseEstimate)]
    return [TimedShot(t_s, r.points.seen, r.T_left_body) for t_s, r in measured]


def _shutters(rig: StereoRig, body: Body, shots: Sequence[TimedShot], requested: Requested) -> Shutters:
    given = Shutters(requested.skew_s or 0.0, requested.readout_s or 0.0, np.zeros((2, 2)))
    if requested.skew_s is not None:
        return given
    found = estimate_shutters(rig, body, shots, known=given, readout=requested.readout_s is None)
    if isinstance(found, Missed):
        raise InputError(f"the skew of the cameras cannot be found: {found.reason}; or give it: --skew 5ms")
    return found


def skew_finding(
    rig: StereoRig, body: Body, first: Sequence[tuple[float | None, PoseEstimate | Missed]]
) -> HealthFinding | None:
    """Return what is wrong where shots that were measured as simultaneous show that they are not, or None."""
    shots = _timed(first)
    if any(b.t_s <= a.t_s for a, b in itertools.pairwise(shots)):
        return None
    found = estimate_shutters(rig, body, shots) if shots else Missed("")
    if not isinstance(found, Shutters) or abs(found.skew_s) <= max(_NOTED_SIGMAS * found.sigmas[0], _NOTED_S):
        return None
    evidence = found.skew_s, float(found.sigmas[0])
    return make_finding("shutters", evidence, shots[0].t_s, words={"shutters": str(found)})


@dataclass(frozen=True)
class Followed:
    """How the follower found the body in a shot, what it noticed about a jump, and how long it took, ms."""

    way: str
    jump: str | None
    took_ms: float


#: Shot, result, how a followed body was found, and the shutters by which it was moved to one time; None where not.
Result = tuple[Shot, PoseEstimate | Missed, Followed | None, Shutters | None]


class DetectedShots:
    """Shots of a table of detections, or of a recording of tags."""

    discs = noise = None
    recorded = True
    moves = False

    def __init__(self, options: MeasureOptions, rig: StereoRig) -> None:
        """Read them."""
        self.body, shots, self.printed = _detected(str(options.detections), options.target)
        self._by_name, self.total = {shot.name: shot for shot in shots}, len(shots)
        self.skewed: list[HealthFinding] = []
        self.results: Iterator[Result] = (
            (Shot(s.name, None, None, s.t_s), measure_seen(rig, self.body, s), None, None) for s in shots
        )

    def again(self, rig: StereoRig, shot: Shot) -> PoseEstimate | Missed:
        """Measure a shot with another rig."""
        return measure_seen(rig, self.body, self._by_name[shot.name])

    def close(self) -> None:
        """Close nothing: all was read."""

    def finish(self, records: Collection[ShotPose]) -> None:
        """Say nothing more."""

    def mistake(self) -> str:
        """Return nothing: only images show what was done to them."""
        return ""

    other_board = mistake


class ImageShots:
    """Shots of images."""

    def __init__(
        self, options: MeasureOptions, rig: StereoRig, requested: Requested | Shutters | None, draws: bool
    ) -> None:
        """Open target and source, say what is known of them; ``draws``: whether the images are drawn afterwards."""
        self._options, self._rig, self._target = options, rig, open_target(options.target)
        self.body, self.discs, self.printed = self._target.body, self._target.discs, is_print(self._target)
        self.noise = None if self.discs is None else DiscNoise(rig, self._target)  #: what gathers the noise of discs
        if self.noise is None and options.save_rig is not None and requested is None:
            raise InputError("--save-rig writes skew, readout and discs' noise: give --skew find, or a body of discs")
        note(*board_notes(options, rig, self._target))
        self.skewed: list[HealthFinding] = []  #: filled at the end: that the cameras do not expose at one time
        self._missed: list[Shot] = []  # the first with both images
        self._again: Source | None = None
        self._source = source = open_source(options.source)
        try:
            self._said = notes_of(source)
            note(*self._said)
            if options.output is not None and isinstance(source, StoredSource):
                indices = {file.parent / INDEX for file in source.files}
                check_writable(options.output, apart_from=(*source.files, *indices))
            self._timed = source.timed
            self.recorded = self._timed or isinstance(source, StoredSource)
            if requested is not None and not self._timed:
                raise InputError("--skew and --readout need a recording with times: they show the motion of the body")
            if requested is None and rig.shutters is not None and not self._timed:
                note(f"{options.rig} has {rig.shutters}, not used: no recording with times")
            self._requested = rig.shutters if requested is None and self._timed else requested
            self.moves = self._requested is not None
            self._again = open_source(options.source) if self.moves and draws else None
        except BaseException:
            self.close()
            raise
        self.total, self.results = source.count, self._results()

    def _results(self) -> Iterator[Result]:
        first: list[tuple[float | None, PoseEstimate | Missed]] = []  # of cameras that are taken for simultaneous
        for result in self._measured(self._rig) if self._requested is None else self._moved(self._requested):
            shot, found = result[:2]
            if self.noise is not None and isinstance(found, PoseEstimate):
                self.noise.add(found)
            if isinstance(found, Missed) and shot.left is not None and shot.right is not None:
                self._missed.extend([shot] * (len(self._missed) < _LOOKED_AT))
            if self._requested is None and self._timed and len(first) < NOTED_SHOTS:
                first.append((shot.t_s, found))
            yield result
        if (skewed := skew_finding(self._rig, self.body, first) if first else None) is not None:
            self.skewed.append(skewed)

    def _measured(self, rig: StereoRig) -> Iterator[Result]:
        """Measure shot after shot; a body of discs is followed from one to the next."""
        follower = Follower(rig, self._target) if follows(self._target) else None
        for shot in self._shots():
            if follower is None:
                yield shot, measure(rig, self._target, shot), None, None
                continue
            begun = time.perf_counter()
            found = follower.measure(shot)
            yield shot, found, Followed(follower.way, follower.jump, 1e3 * (time.perf_counter() - begun)), None

    def _moved(self, requested: Requested | Shutters) -> Iterator[Result]:
        wide = self._measured(replace(self._rig, sigma_px=max(self._rig.sigma_px, LOOSE_PX)))
        first = [(replace(shot, left=None, right=None), found, followed) for shot, found, followed, _ in wide]
        timed = [(shot.t_s, found) for shot, found, _ in first]
        moved, shutters = moved_results(self._rig, self.body, timed, requested)
        note(shutters)
        for (shot, _, followed), (found, is_moved) in zip(first, moved, strict=True):
            drawn = self._again.read() if self._again is not None else None
            yield drawn or shot, found, followed, shutters if is_moved else None

    def _shots(self) -> Iterator[Shot]:
        """Yield the source's shots; the first image that can be read must have the rig's size."""
        checked = False
        while (shot := self._source.read()) is not None:
            if not checked and shot.left is not None and shot.right is not None:
                checked = True
                for side, camera, image in zip(SIDES, self._rig.cameras, (shot.left, shot.right), strict=True):
                    if (problem := size_problem(camera.image_size_px, image, side)) is not None:
                        raise InputError(f"{self._options.rig}: shot {shot.name}: {problem}")
            yield shot

    def again(self, rig: StereoRig, shot: Shot) -> PoseEstimate | Missed:
        """Measure a shot with another rig."""
        return measure(rig, self._target, shot)

    def close(self) -> None:
        """Close the source."""
        for each in (self._source, self._again):
            if each is not None:
                each.close()

    def finish(self, records: Collection[ShotPose]) -> None:
        """Say what only the images showed."""
        source, target = self._source, self._target
        note(*(line for line in notes_of(source) if line not in self._said))
        if self._options.as_json and (odd := getattr(source, "odd_frames", None)):
            click.echo(json.dumps({"odd_frames": odd}))
        note(*reversed_notes(target, records))
        rank = {name: k for k, name in enumerate(self.body.point_names)}
        of_shots = [[rank[name] for name in r.points_m if name in rank] for r in records if r.ok]
        note(*unseen_row(target, [np.array(ids, np.int64) for ids in of_shots]))

    def mistake(self) -> str:
        """Return what was done to the images where a missed shot can be measured once it is undone; empty otherwise."""
        shot = next(iter(self._missed), None)
        if shot is None or shot.left is None or shot.right is None:
            return ""
        if one_image(shot.left, shot.right):
            return "the left and the right image are the same: give the images of two cameras"
        fits = {}
        for what, images in _undone(shot.left, shot.right).items():
            left, right = map(np.ascontiguousarray, images)
            found = measure(self._rig, self._target, replace(shot, left=left, right=right))
            if isinstance(found, PoseEstimate) and len(found.points.ids) > len(found.dropped):
                fits[-len(found.points.ids), found.reprojection_rms_px] = what
        return fits[min(fits)] if fits else ""

    def other_board(self) -> str:
        """Return which board most images of missed shots show whole, where the target is no such board or a part of it."""
        kind, counts, points = *_board(self.body), len(self.body.points)
        images = [grey(image) for shot in self._missed for image in (shot.left, shot.right) if image is not None]
        if kind not in BOARDS or not images:
            return ""
        shown = [board.body for image in images if (board := board_in_view(image)) is not None]
        seen = Counter(_board(body) for body in shown if _board(body)[0] != kind or len(body.points) > points)
        (said, of), count = next(iter(seen.most_common(1)), (("", ""), 0))
        return f"the board has {of} ({said}), not {counts}" if 2 * count > max(len(shown), 2) else ""


def board_notes(options: MeasureOptions, rig: StereoRig, target: Target | Body) -> list[str]:
    """Say where a target is the board of the rig's calibration, its counts exchanged or from another calibration."""
    given, board = (rig.provenance.get(key) for key in ("target", "board"))
    kind, counts, rest = (*str(given).split(":", 2), "", "")[:3]
    if isinstance(given, str) and given != options.target == f"{kind}:{'x'.join(counts.split('x')[::-1])}:{rest}":
        return [f"the rig was calibrated with {given}: {options.target} has its counts exchanged, and so other axes"]
    if isinstance(target, EstimatedBoard) and isinstance(board, str) and (own := options.rig.parent / board).is_file():
        found = load_board_file(own)
        if found.drawing.body.name == target.drawing.body.name and not np.array_equal(found.points, target.points):
            return [f"{options.target} is of another calibration than {options.rig}, whose board is in {own}"]
    return []


def _board(body: Body) -> tuple[str, str]:
    """Return the kind of a board, and its counts as its name has them, the larger first; empty for other bodies."""
    kind, _, rest = body.name.partition(":")
    counts = rest.partition(":")[0].split("x")
    ordered = sorted(counts, key=int, reverse=True) if all(each.isdigit() for each in counts) else []
    return kind, "x".join(ordered)


def _detected(detections: str, target: str) -> tuple[Body, list[SeenShot], bool]:
    """Return the body, and what was detected of it, in a table or a recording of tags (bag:FILE); whether it is a print."""
    opened = open_body(target) if target.lower().endswith(".csv") else open_target(target)
    body, printed = (opened, False) if isinstance(opened, Body) else (opened.body, is_print(opened))
    if not detections.startswith("bag:"):
        return body, read_detections(Path(detections), body), printed
    from armsight.vision.sources.bag.tags import read_tags

    shots, notes = read_tags(detections, opened)
    note(*notes)
    return body, shots, printed


@dataclass
class NamedShots:
    """Shots of one kind: how many they are, and the names of the first."""

    count: int = 0
    names: list[str] = field(default_factory=list)

    def add(self, name: str) -> None:
        """Count one."""
        self.count += 1
        if len(self.names) < NAMED:
            self.names.append(name)

    def __str__(self) -> str:
        """Return the names, and how many more there are."""
        more = self.count - len(self.names)
        return ", ".join(self.names) + (f" and {more} more" if more else "")


#: Missed shots whose images are looked at again; half: one odd image decides, double: the end takes seconds.
_LOOKED_AT = 5
#: What a camera's driver may have done to its images -> how it is undone.
_FLIPS: dict[str, Callable[[Image], Image]] = {
    "rotated by 180 degrees": lambda image: image[::-1, ::-1],
    "mirrored": lambda image: image[:, ::-1],
    "upside down and mirrored": lambda image: image[::-1],
}


def _undone(left: Image, right: Image) -> dict[str, tuple[Image, Image]]:
    """Return the images with each mistake undone that may have been made with them, by what to say of it."""
    undone = {
        "left and right are exchanged: the images fit the rig the other way round": (right, left),
        "it is in view inverted, light where its file or spec has dark: correct that (`bright` of a disc), or the print": (
            np.iinfo(left.dtype).max - left,
            np.iinfo(right.dtype).max - right,
        ),
    }
    said = "the {} are {} against those of the calibration; the cameras must deliver both alike"
    for what, undo in _FLIPS.items():
        undone[said.format("images", what)] = undo(left), undo(right)
        undone[said.format("left images", what)] = undo(left), right
        undone[said.format("right images", what)] = left, undo(right)
    return undone


def reversed_notes(target: Target, records: Iterable[ShotPose]) -> list[str]:
    """Say which shots show a board that looks the same when it is rotated, rotated so against the shot before."""
    if not target.symmetries:
        return []
    least = (90.0 if len(target.symmetries) > 1 else 180.0) - _ROTATED_SPARE_DEG
    measured = [record for record in records if record.ok]
    q = np.array([record.quaternion_wxyz for record in measured]).reshape(-1, 4)
    angles = np.degrees(2.0 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=1)), 0.0, 1.0)))
    names = [record.shot for record, angle in zip(measured[1:], angles, strict=True) if angle > least]
    if not names:
        return []
    return [
        f"{NamedShots(len(names), names[:NAMED])}: rotated by {least + _ROTATED_SPARE_DEG:.0f} degrees or so against the "
        "shot before; this board "
        "looks the same then, and its origin is the corner most to the upper left in the image: codes, rings, or one even "
        "and one odd count of a chessboard distinguish its ends"
    ]
