"""What ``armsight measure`` measures: images of a target, or detections of a body; each gives shots with their results.

In: the options of the command, a rig. Out: :class:`ImageShots` or :class:`DetectedShots`, whose ``results`` are read one
after the other, and which say afterwards what the images showed besides.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from armsight.app.measure.moving import NOTED_SHOTS, Requested, moved_results, skew_finding
from armsight.data import SIDES, Body, Image, Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.files import check_writable
from armsight.loop.health import HealthFinding
from armsight.vision.detections import SeenShot, read_detections
from armsight.vision.follow.follower import Follower, follows
from armsight.vision.image import one_image
from armsight.vision.markers.calibrated_board import is_print
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_body, open_target
from armsight.vision.pose.measure import measure, measure_seen, size_problem
from armsight.vision.pose.noise import DiscNoise
from armsight.vision.pose.shot_pose import ShotPose
from armsight.vision.pose.shutter import LOOSE_PX
from armsight.vision.rig import Shutters, StereoRig
from armsight.vision.sources import PairsSource, Source, notes_of, open_source
from armsight.vision.sources.pairs import StoredSource

#: So many shots that fit badly are named.
NAMED = 3
#: So much a board that looks the same when it is rotated may be rotated less than by that, degrees.
_ROTATED_SPARE_DEG = 35.0


@dataclass(frozen=True)
class MeasureOptions:
    """What ``armsight measure`` is given.

    Attributes:
        rig: the rig's file.
        target: a board's spec or a body's file.
        left: glob of the left images; with ``right``.
        right: glob of the right images.
        source: a source's spec, where the images are not given by globs.
        detections: a file of detections, where there are no images.
        fixed: bodies in view that do not move.
        skew: time by which the right camera is later, with its unit, or ``find``.
        readout: time from the first row to the last, with its unit, or ``find``.
        save_rig: file for the rig with the skew and readout that were found or given.
        output: CSV file of the poses.
        stream: what to publish each pose to.
        view_dir: folder for pictures.
        as_json: whether each line is a JSON object.
    """

    rig: Path
    target: str
    left: str | None
    right: str | None
    source: str | None
    detections: Path | None
    fixed: Sequence[str]
    skew: str | None
    readout: str | None
    save_rig: Path | None
    output: Path | None
    stream: Sequence[str]
    view_dir: Path | None
    as_json: bool

    def open_source(self) -> Source:
        """Open the images that are named."""
        if self.left is not None and self.right is not None:
            return PairsSource.open(self.left, self.right)
        return open_source(str(self.source))


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

    def __init__(self, options: MeasureOptions, rig: StereoRig) -> None:
        """Read them."""
        self.body, shots, self.printed = _detected(Path(str(options.detections)), options.target)
        self._by_name = {shot.name: shot for shot in shots}
        self.total = len(shots)
        self.skewed: list[HealthFinding] = []
        self.results: Iterator[Result] = (
            (Shot(s.name, None, None, s.t_s), measure_seen(rig, self.body, s), None, None) for s in shots
        )

    def again(self, rig: StereoRig, shot: Shot) -> PoseEstimate | Missed:
        """Measure a shot with another rig."""
        return measure_seen(rig, self.body, self._by_name[shot.name])

    def close(self) -> None:
        """Close nothing: all was read."""

    def finish(self, records: list[ShotPose]) -> None:
        """Say nothing more."""

    def mistake(self) -> str:
        """Return nothing: only images show what was done to them."""
        return ""


class ImageShots:
    """Shots of images.

    Attributes:
        body, discs, printed: of the target.
        total: how many there are; None where nobody knows.
        results: what each shot shows, as they are read.
        recorded: whether they were taken before.
        noise: what gathers the noise of discs.
        skewed: filled at the end: that the cameras do not expose at one time.
    """

    def __init__(
        self, options: MeasureOptions, rig: StereoRig, requested: Requested | Shutters | None, draws: bool
    ) -> None:
        """Open target and source, say what is known of them; ``draws``: whether the images are drawn afterwards."""
        self._options, self._rig = options, rig
        self._target = target = open_target(options.target)
        self.body, self.discs, self.printed = target.body, target.discs, is_print(target)
        self.noise = None if self.discs is None else DiscNoise(rig, target)
        if self.noise is None and options.save_rig is not None and requested is None:
            raise InputError(
                "--save-rig writes skew, readout and the noise of discs: give --skew find, or a body of discs"
            )
        self.skewed: list[HealthFinding] = []
        self._first: list[Shot] = []
        self._again: Source | None = None
        self._source = options.open_source()
        try:
            self.results = _keeping(self._results(requested, draws), self._first, self.noise)
        except BaseException:
            self.close()
            raise
        self.total = self._source.count

    def _results(self, requested: Requested | Shutters | None, draws: bool) -> Iterator[Result]:
        """Return what measures shot after shot, by the shutters that are requested or stand in the rig's file."""
        source, rig, path = self._source, self._rig, self._options.rig
        self._said = notes_of(source)
        say(self._said)
        if self._options.output is not None and isinstance(source, StoredSource):
            check_writable(self._options.output, apart_from=source.files)
        timed = source.timed
        self.recorded = timed or isinstance(source, StoredSource)
        if requested is not None and not timed:
            raise InputError("--skew and --readout need a recording with times: they show the motion of the body")
        if requested is None and rig.shutters is not None:
            if timed:
                requested = rig.shutters
            else:
                click.echo(f"note: {path} has {rig.shutters}, not used: no recording with times", err=True)
        shots = _shots(source, rig, path)
        if requested is not None:
            self._again = self._options.open_source() if draws else None
            return _moved(rig, self._target, shots, requested, self._again)
        results = _measured(rig, self._target, shots)
        return _noted(rig, self.body, results, self.skewed) if timed else results

    def again(self, rig: StereoRig, shot: Shot) -> PoseEstimate | Missed:
        """Measure a shot with another rig."""
        return measure(rig, self._target, shot)

    def close(self) -> None:
        """Close the source."""
        for each in (self._source, self._again):
            if each is not None:
                each.close()

    def finish(self, records: list[ShotPose]) -> None:
        """Say what only the images showed."""
        source, target = self._source, self._target
        say(note for note in notes_of(source) if note not in self._said)
        if self._options.as_json and (odd := getattr(source, "odd_frames", None)):
            click.echo(json.dumps({"odd_frames": odd}))
        say(reversed_notes(target, records))
        rank = {name: k for k, name in enumerate(self.body.point_names)}
        of_shots = [[rank[name] for name in r.points_m if name in rank] for r in records if r.ok]
        say(unseen_row(target, [np.array(ids, np.int64) for ids in of_shots]))

    def mistake(self) -> str:
        """Return what was done to the images where a missed shot can be measured once it is undone; empty otherwise."""
        return _mistaken(self._rig, self._target, self._first)


def open_shots(
    options: MeasureOptions, rig: StereoRig, requested: Requested | Shutters | None, draws: bool
) -> DetectedShots | ImageShots:
    """Open the shots that options name; ``draws``: whether their images are drawn afterwards.

    Raises:
        InputError: target or source cannot be opened, or do not have what the options ask for.
    """
    if options.detections is not None:
        return DetectedShots(options, rig)
    return ImageShots(options, rig, requested, draws)


def _keeping(results: Iterator[Result], first: list[Shot], noise: DiscNoise | None) -> Iterator[Result]:
    """Yield the results; keep the first shot that was missed although both images are there, and what shows the noise."""
    for result in results:
        shot = result[0]
        if noise is not None and isinstance(result[1], PoseEstimate):
            noise.add(result[1])
        if not first and isinstance(result[1], Missed) and shot.left is not None and shot.right is not None:
            first.append(shot)
        yield result


def _detected(detections: Path, target: str) -> tuple[Body, list[SeenShot], bool]:
    """Return the body, and what was detected of it, in a table or a recording of tags (bag:FILE); whether it is a print."""
    opened = open_body(target) if target.lower().endswith(".csv") else open_target(target)
    body, printed = (opened, False) if isinstance(opened, Body) else (opened.body, is_print(opened))
    if not str(detections).startswith("bag:"):
        return body, read_detections(detections, body), printed
    from armsight.vision.sources.bag.tags import read_tags

    shots, notes = read_tags(str(detections), opened)
    say(notes)
    return body, shots, printed


def say(notes: Iterable[str]) -> None:
    """Print notes on stderr."""
    for note in notes:
        click.echo(f"note: {note}", err=True)


def _noted(rig: StereoRig, body: Body, results: Iterator[Result], skewed: list[HealthFinding]) -> Iterator[Result]:
    """Yield the results, and add to ``skewed`` at the end where they show that the cameras do not expose at one time."""
    first: list[tuple[float | None, PoseEstimate | Missed]] = []
    for result in results:
        if len(first) < NOTED_SHOTS:
            first.append((result[0].t_s, result[1]))
        yield result
    found = skew_finding(rig, body, first)
    if found is not None:
        skewed.append(found)


def _moved(
    rig: StereoRig, target: Target, shots: Iterator[Shot], requested: Requested | Shutters, again: Source | None
) -> Iterator[Result]:
    """Measure all shots, then move their detections to one time and measure again; ``again`` has the images to draw."""
    measured = _measured(replace(rig, sigma_px=max(rig.sigma_px, LOOSE_PX)), target, shots)
    first = [(replace(shot, left=None, right=None), result, followed) for shot, result, followed, _ in measured]
    moved, shutters = moved_results(rig, target.body, [(shot.t_s, result) for shot, result, _ in first], requested)
    click.echo(f"note: {shutters}", err=True)
    for (shot, _, followed), (result, is_moved) in zip(first, moved, strict=True):
        drawn = again.read() if again is not None else None
        yield drawn or shot, result, followed, shutters if is_moved else None


def _shots(source: Source, rig: StereoRig, path: Path) -> Iterator[Shot]:
    """Yield a source's shots; the first image that can be read must have the rig's size."""
    checked = False
    while (shot := source.read()) is not None:
        if not checked and shot.left is not None and shot.right is not None:
            checked = True
            for side, camera, image in zip(SIDES, rig.cameras, (shot.left, shot.right), strict=True):
                if (problem := size_problem(camera.image_size_px, image, side)) is not None:
                    raise InputError(f"{path}: shot {shot.name}: {problem}")
        yield shot


def _measured(rig: StereoRig, target: Target, shots: Iterator[Shot]) -> Iterator[Result]:
    """Measure shot after shot; a body of discs is followed from one to the next."""
    if not follows(target):
        yield from ((shot, measure(rig, target, shot), None, None) for shot in shots)
        return
    follower = Follower(rig, target)
    for shot in shots:
        begun = time.perf_counter()
        result = follower.measure(shot)
        yield shot, result, Followed(follower.way, follower.jump, 1e3 * (time.perf_counter() - begun)), None


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
    for what, undo in _FLIPS.items():
        sides = {
            "images": (undo(left), undo(right)),
            "left images": (undo(left), right),
            "right images": (left, undo(right)),
        }
        for which, images in sides.items():
            said = f"the {which} are {what} against those of the calibration; the cameras must deliver both alike"
            undone[said] = images
    return undone


def reversed_notes(target: Target, records: list[ShotPose]) -> list[str]:
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
    shown = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    return [
        f"{shown}: rotated by {least + _ROTATED_SPARE_DEG:.0f} degrees or so against the shot before; this board looks the "
        "same then, and its origin is the corner most to the upper left in the image: codes, rings, or one even and one "
        "odd count of a chessboard distinguish its ends"
    ]


def _mistaken(rig: StereoRig, target: Target, shots: list[Shot]) -> str:
    """Return what was done to the images where a missed shot can be measured once it is undone; empty otherwise.

    Rotated images of two parallel cameras nearly fit the rig exchanged, and the other way round: the better fit decides.
    """
    for shot in shots:
        assert shot.left is not None
        assert shot.right is not None
        if one_image(shot.left, shot.right):
            return "the left and the right image are the same: give the images of two cameras"
        fits = {}
        for what, images in _undone(shot.left, shot.right).items():
            left, right = map(np.ascontiguousarray, images)
            found = measure(rig, target, replace(shot, left=left, right=right))
            if isinstance(found, PoseEstimate) and len(found.points.ids) > len(found.dropped):
                fits[-len(found.points.ids), found.reprojection_rms_px] = what
        if fits:
            return fits[min(fits)]
    return ""
