"""One run of ``armsight measure``: a rig, a target and shots in; a line for each shot, poses as CSV and pictures out."""

from __future__ import annotations

import contextlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from armsight.app.measure.moving import NOTED_SHOTS, Requested, moved_results, requested_shutters, skew_finding
from armsight.app.measure.picture import SINGULAR
from armsight.app.measure.poses import ANGLES, ShotPose, csv_text, shot_pose
from armsight.app.measure.view import CHART, PictureFolder, view_folder
from armsight.app.messages import colour, weak
from armsight.app.progress import bar
from armsight.app.stream.datum import Published, ShotDatum
from armsight.app.stream.sink import Fanout, Publisher
from armsight.data import SIDES, Body, Dropped, Image, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import check_writable, write_text
from armsight.loop.health import HealthFinding, HealthMonitor, health_lines, unseen_lines
from armsight.loop.health.update import contradiction
from armsight.vision.detections import SeenShot, read_detections
from armsight.vision.follow.follower import Follower, follows, measurer
from armsight.vision.image import one_image
from armsight.vision.markers.calibrated_board import is_print
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_body, open_fixed, open_target
from armsight.vision.match import gate
from armsight.vision.measure import measure, measure_seen, size_problem
from armsight.vision.noise import DiscNoise
from armsight.vision.rig import Shutters, StereoRig
from armsight.vision.shutter import LOOSE_PX
from armsight.vision.sources import PairsSource, Source, notes_of, open_source
from armsight.vision.sources.bag import BagSource
from armsight.vision.sources.bag.camera_info import open_rig
from armsight.vision.sources.bag.tags import read_tags
from armsight.vision.sources.lerobot import LeRobotSource
from armsight.vision.sources.pairs import StoredSource
from armsight.vision.sources.video import VideoSource

#: Standard deviation of the time between the two exposures of a shot, s: of cameras that nothing synchronises to better.
_SYNC_S = 1e-3
#: Shots that were missed are measured again with detections of this standard deviation, px, so many of them.
_WIDE_PX, _AGAIN = 2.0, 60
#: So many shots that fit badly are named.
_NAMED = 3
#: So much a board that looks the same when it is rotated may be rotated less than by that, degrees.
_ROTATED_SPARE_DEG = 35.0
#: What to do about repeated shots of a recording.
_RECORDED = "they are no new measurements: leave them out, and record at the rate that the cameras really give"
#: A shot that is younger by its own stamp was stamped by a live camera, s.
_LIVE_S = 10.0


@dataclass(frozen=True)
class _Followed:
    """How the follower found the body in a shot, what it noticed about a jump, and how long it took, ms."""

    way: str
    jump: str | None
    took_ms: float


#: Shot, result, how a followed body was found, and the shutters by which it was moved to one time; None where not.
Result = tuple[Shot, PoseEstimate | Missed, _Followed | None, Shutters | None]


def measure_shots(
    rig: Path,
    target: str,
    *,
    left: str | None,
    right: str | None,
    source: str | None,
    detections: Path | None,
    fixed: Sequence[str],
    skew: str | None,
    readout: str | None,
    save_rig: Path | None,
    output: Path | None,
    streams: Sequence[str],
    view_dir: Path | None,
    as_json: bool,
) -> tuple[HealthFinding, ...]:
    """Measure the pose of a target in every shot, and print a line for each.

    Args:
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
        streams: what to publish each pose to.
        view_dir: folder for pictures.
        as_json: whether each line is a JSON object.

    Returns:
        Why the poses must not be trusted; empty where nothing says so.

    Raises:
        ArmsightError: the input is wrong, or no shot could be measured.
    """
    requested: Requested | Shutters | None = requested_shutters(skew, readout)
    if requested is not None and detections is not None:
        raise InputError("--skew and --readout need images with times: detections have none")
    if fixed and detections is not None:
        raise InputError("--fixed needs images: --detections has the markers of the target alone")
    fixed_targets = open_fixed(fixed, target)
    if save_rig is not None:
        if detections is not None:
            raise InputError("--save-rig writes what images show of the cameras: --detections has none")
        check_writable(save_rig, apart_from=(rig, target, output))
    stereo = open_rig(rig)
    folder = None if view_dir is None else view_folder(view_dir)
    if output is not None:
        check_writable(output, apart_from=(rig, target, detections, folder, folder and folder / CHART))
    if not stereo.cov.any():
        click.echo(f"note: {rig} has no covariance: every ± is the share of the pixel noise alone", err=True)
    records: list[ShotPose] = []
    started = time.perf_counter()
    results: Iterator[Result]
    total: int | None
    discs: DiscTarget | None = None
    skewed: list[HealthFinding] = []
    first: list[Shot] = []
    noise: DiscNoise | None = None
    with contextlib.ExitStack() as stack:
        if detections is not None:
            body, shots, printed = _detected(detections, target)
            results = ((Shot(s.name, None, None, s.t_s), measure_seen(stereo, body, s), None, None) for s in shots)
            total = len(shots)
            by_name = {s.name: s for s in shots}
            missed = _Contradicting(stereo, body, lambda rig, shot: measure_seen(rig, body, by_name[shot.name]))
        else:
            found = open_target(target)
            body, discs, printed = found.body, found.discs, is_print(found)
            if discs is not None:
                noise = DiscNoise(stereo, found)
            elif save_rig is not None and requested is None:
                raise InputError(
                    "--save-rig writes skew, readout and the noise of discs: give --skew find, or a body of discs"
                )
            opened = stack.enter_context(contextlib.closing(_opened(left, right, source)))
            said = notes_of(opened)
            _say(said)
            if output is not None and isinstance(opened, StoredSource):
                check_writable(output, apart_from=opened.files)
            total, timed = opened.count, _timed(opened)
            recorded = timed or isinstance(opened, StoredSource)
            if requested is not None and not timed:
                raise InputError("--skew and --readout need a recording with times: they show the motion of the body")
            if requested is None and stereo.shutters is not None:
                if timed:
                    requested = stereo.shutters
                else:
                    click.echo(f"note: {rig} has {stereo.shutters}, not used: no recording with times", err=True)
            if requested is None:
                results = _measured(stereo, found, _shots(opened, stereo, rig))
                results = _noted(stereo, body, results, skewed) if timed else results
            else:
                again = _opened(left, right, source) if folder is not None else None
                if again is not None:
                    stack.enter_context(contextlib.closing(again))
                results = _moved(stereo, found, _shots(opened, stereo, rig), requested, again)
            results = _keeping(results, first, noise)
            missed = _Contradicting(stereo, body, lambda rig, shot: measure(rig, found, shot))
        view = None if folder is None else PictureFolder(folder, stereo, body, discs, total)
        # What was measured is written whatever ends the run; where one of the two cannot be written the other is.
        if view is not None:
            stack.callback(view.finish, records)
        if output is not None:
            stack.callback(_write, output, records)
        monitor = HealthMonitor(stereo, body, _SYNC_S, printed=printed)
        publisher = stack.enter_context(contextlib.closing(_streams(streams, stereo, body)))
        try:
            _run(
                _watched(stereo, fixed_targets, missed.keeping(results), monitor),
                total,
                body,
                records,
                as_json,
                view,
                monitor,
                publisher,
            )
        except KeyboardInterrupt:
            kept = f", kept in {output}" if output is not None and records else ""
            click.echo(f"armsight: stopped after {len(records)} shots{kept}", err=True)
            raise
        if detections is None:  # what only the images showed
            _say(note for note in notes_of(opened) if note not in said)
            if as_json and isinstance(opened, VideoSource) and (odd := opened.odd_frames):
                click.echo(json.dumps({"odd_frames": odd}))
            _say(reversed_notes(found, records))
            rank = {name: k for k, name in enumerate(found.body.point_names)}
            of_shots = [[rank[name] for name in r.points_m if name in rank] for r in records if r.ok]
            _say(unseen_row(found, [np.array(ids, np.int64) for ids in of_shots]))
    contradicted = missed.finding()
    if records and not any(record.ok for record in records):
        mistake = _mistaken(stereo, found, first) if detections is None else ""
        written = "" if output is None else f" (the reason of each is in {output})"
        raise ArmsightError(_nothing_measured(records, mistake, contradicted) + written)
    _close(records, time.perf_counter() - started, output, view, _board_file(rig, stereo, target))
    moved = next((r.shutters for r in records if r.shutters is not None), None)
    saved = _keep_noise(stereo, noise, bool(skewed), moved, save_rig)
    health = tuple(
        replace(each, advice=_RECORDED) if each.cause == "host" and (detections is not None or recorded) else each
        for each in monitor.findings()
    )
    for line in unseen_lines(monitor.fixed_never_seen):
        click.echo(f"note: {line}", err=True)
    if contradicted is not None:
        health = (contradicted, *(each for each in health if each.cause not in ("rig", "body", "lens")))
    if skewed and any(each.cause in ("rig", "time") for each in health):
        # Of a moving body a skew looks like cameras that moved against each other; all shots together size it best.
        health = (*skewed, *(each for each in health if each.cause not in ("rig", "time")))
    else:  # a skew that changes no pose by more than its sigma
        for late in skewed:
            click.echo(f"note: {late.what}; {late.advice}", err=True)
    for line in health_lines(health):
        click.echo(weak(line), err=True, color=colour())
    if as_json and health:
        click.echo(json.dumps({"health": [found.to_json() for found in health]}))
    if not saved and not health:
        click.get_current_context().exit(1)
    return health


def _keep_noise(
    rig: StereoRig, noise: DiscNoise | None, skewed: bool, moved: Shutters | None, save_rig: Path | None
) -> bool:
    """Say how noisy the cameras' discs were, and write the rig with that and with the shutters that were found.

    Returns False where a rig was to be written and the shots showed nothing to write. Of shots that show a skew the
    residuals are those of the motion, not of the discs.
    """
    found = None if noise is None or skewed else noise.found()
    if found is not None:
        left, right = found
        kept = "" if save_rig is not None or rig.disc_noise is not None else "; --save-rig keeps it for single shots"
        click.echo(
            f"note: discs' centres vary {left} (left) and {right} (right) times as much as single images say{kept}",
            err=True,
        )
    if save_rig is None:
        return True
    if found is None and moved is None:
        few = "too few shots, or the body moved too little, to know the discs' noise"
        why = "the shots show a skew, which hides the discs' noise: give --skew find" if skewed else few
        click.echo(weak(f"{save_rig} was not written: {why}"), err=True, color=colour())
        return False
    replace(rig, shutters=moved or rig.shutters, disc_noise=found or rig.disc_noise).save(save_rig)
    return True


def _keeping(results: Iterator[Result], first: list[Shot], noise: DiscNoise | None) -> Iterator[Result]:
    """Yield the results; keep the first shot that was missed although both images are there, and what shows the noise."""
    for result in results:
        shot = result[0]
        if noise is not None and isinstance(result[1], PoseEstimate):
            noise.add(result[1])
        if not first and isinstance(result[1], Missed) and shot.left is not None and shot.right is not None:
            first.append(shot)
        yield result


def _contradicts(dropped: Sequence[Dropped], used: int) -> bool:
    """Whether more points of a shot contradict each other than were used."""
    return len({each.point for each in dropped if each.contradicts}) > used


class _Contradicting:
    """Shots that show the target and contradict the rig, all of it or most: their poses, measured with a wide gate."""

    def __init__(self, rig: StereoRig, body: Body, again: Callable[[StereoRig, Shot], PoseEstimate | Missed]) -> None:
        self._rig, self._body, self._again = rig, body, again
        self._wide = replace(rig, sigma_px=max(rig.sigma_px, _WIDE_PX))
        self._found: list[PoseEstimate] = []
        self._missed = self._tried = self._measured = self._few = 0

    def keeping(self, results: Iterator[Result]) -> Iterator[Result]:
        """Yield the results; keep what those that were missed show."""
        for result in results:
            shot, measured = result[:2]
            few = isinstance(measured, PoseEstimate) and _contradicts(measured.dropped, len(measured.points.ids))
            self._few += few
            self._measured += isinstance(measured, PoseEstimate) and not few
            if (few or isinstance(measured, Missed)) and shot.problem is None:
                self._missed += 1
                if self._tried < _AGAIN:
                    self._tried += 1
                    if isinstance(wide := self._again(self._wide, shot), PoseEstimate) and self._apart(wide):
                        self._found.append(wide)
            yield result

    def _apart(self, found: PoseEstimate) -> bool:
        """Whether rays of a shot miss each other by more than the rig allows; a body of another size does not do that."""
        seen = found.points.seen
        return bool(gate(self._rig, self._body, seen).paired.sum() < seen.paired.sum())

    def finding(self) -> HealthFinding | None:
        """Return what explains them, where they are more than those that were measured; None elsewhere."""
        count = round(len(self._found) / max(self._tried, 1) * self._missed)
        if self._found and count > self._measured:
            return self._explained(count)
        if self._few <= self._measured:
            return None
        return HealthFinding(
            "rig",
            f"in {self._few} of {self._few + self._measured} shots that were measured most points contradict each other, "
            "and no motion of the cameras explains most of them: one camera has another zoom or focus, or shows a part of "
            "its image, or left and right images do not belong together",
            None,
            float(self._few),
            0.0,
            "measurements",
            "look at the pairs of images; calibrate the rig again with images as they are now",
            ("lens", "time"),
        )

    def _explained(self, count: int) -> HealthFinding:
        """Return what explains that so many shots contradict the rig."""
        return contradiction(self._rig, self._body, self._found, (count, count + self._measured))


def _watched(
    rig: StereoRig, fixed: Sequence[Target], results: Iterator[Result], monitor: HealthMonitor
) -> Iterator[Result]:
    """Yield the results; measure the fixed bodies in their shots meanwhile, for a monitor."""
    monitor.watch_fixed([each.body.name for each in fixed])
    measures = [measurer(rig, each) for each in fixed]
    for result in results:
        shot = result[0]
        for row, measured in enumerate(each(shot) for each in measures if shot.left is not None):
            if isinstance(measured, PoseEstimate):
                monitor.fixed_measured(row, measured, shot.t_s)
        yield result


def _opened(left: str | None, right: str | None, source: str | None) -> Source:
    """Open what the user named."""
    return PairsSource.open(left, right) if left is not None and right is not None else open_source(str(source))


def _detected(detections: Path, target: str) -> tuple[Body, list[SeenShot], bool]:
    """Return the body, and what was detected of it, in a table or a recording of tags (bag:FILE); whether it is a print."""
    opened = open_body(target) if target.lower().endswith(".csv") else open_target(target)
    body, printed = (opened, False) if isinstance(opened, Body) else (opened.body, is_print(opened))
    if not str(detections).startswith("bag:"):
        return body, read_detections(detections, body), printed
    shots, notes = read_tags(str(detections), opened)
    _say(notes)
    return body, shots, printed


def _say(notes: Iterable[str]) -> None:
    """Print notes on stderr."""
    for note in notes:
        click.echo(f"note: {note}", err=True)


def _streams(specs: Sequence[str], rig: StereoRig, body: Body) -> Publisher:
    """Open the streams of the command line."""
    if not specs:
        return Fanout()
    from armsight.app.stream.streams import open_streams

    return open_streams(specs, Published(rig, body), lambda line: click.echo(line, err=True))


def _arrival_s(shot: Shot) -> float | None:
    """Return the time by the clock of live cameras, s; None where the shot is of a recording."""
    now = time.monotonic()
    return now if shot.t_s is not None and 0.0 <= now - shot.t_s < _LIVE_S else None


def _timed(source: Source) -> bool:
    """Whether a source is a recording whose shots have times."""
    if isinstance(source, StoredSource):
        return any(pair.t_s is not None for pair in source.pairs)
    return isinstance(source, VideoSource | BagSource | LeRobotSource)


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
        yield shot, result, _Followed(follower.way, follower.jump, 1e3 * (time.perf_counter() - begun)), None


def _run(
    results: Iterator[Result],
    total: int | None,
    body: Body,
    records: list[ShotPose],
    as_json: bool,
    view: PictureFolder | None,
    monitor: HealthMonitor,
    publisher: Publisher,
) -> None:
    """Measure every shot, print its line, keep its record and draw it."""
    with bar("measuring", total) as advance:
        for shot, measured, followed, shutters in results:
            result = monitor.measured(measured, shot.t_s) if isinstance(measured, PoseEstimate) else measured
            record = replace(shot_pose(shot.name, shot.t_s, body, result), shutters=shutters)
            if followed is not None:
                record = replace(record, way=followed.way, jump=followed.jump, took_ms=followed.took_ms)
            records.append(record)
            publisher.put(ShotDatum(shot, result, _arrival_s(shot)))
            click.echo(json.dumps(record.to_json()) if as_json else _line(record))
            if view is not None:
                view.add(shot, result, record)
            advance()


def _write(output: Path, records: list[ShotPose]) -> None:
    """Write the poses, where there are any."""
    if records:
        write_text(output, csv_text(records))


def _line(record: ShotPose) -> str:
    """Return one shot as a line for people: mm and degrees, one sigma."""
    if not record.ok:
        return f"{record.shot}: missed: {record.reason}"
    sigma = np.sqrt(np.diag(record.cov))
    position = " ".join(
        f"{axis} {1e3 * value:.3f} ± {1e3 * s:.3f}"
        for axis, value, s in zip("xyz", record.position_m, sigma[:3], strict=True)
    )
    angles = " ".join(f"{name} {value:.3f}" for name, value in zip(ANGLES, record.euler_zyx_deg, strict=True))
    sigma_deg = np.degrees(np.linalg.norm(sigma[3:]))
    dropped = len(record.dropped)
    note = f", {dropped} point{'' if dropped == 1 else 's'} dropped" if dropped else ""
    note += f", misfit {record.misfit:.1f}" if record.misfit > 1 else ""
    note += f", {record.jump}" if record.jump else ""
    singular = SINGULAR if record.pitch_singular else ""
    _, precision, calibration = (1e3 * sigma for sigma in record.position_sigmas_m)
    return (
        f"{record.shot}: {position} mm, {angles} deg ± {sigma_deg:.3f}{singular}; precision {precision:.3f} mm, "
        f"calibration {calibration:.3f} mm; {len(record.points_m)} points{note}"
    )


def _board_file(path: Path, rig: StereoRig, target: str) -> Path | None:
    """Return the file of the board as the rig's calibration found it, where that board is measured by its drawing."""
    name = rig.provenance.get("board")
    if rig.provenance.get("target") != target or not isinstance(name, str):
        return None
    beside = path.parent / name
    return beside if beside.exists() else None


def _nothing_measured(records: list[ShotPose], mistake: str, contradicted: HealthFinding | None) -> str:
    """Return why no shot could be measured: what was done to the images, or the first reason and what explains it."""
    why = mistake or f"{records[0].shot}: {records[0].reason}"
    if contradicted is not None and contradicted.cause == "rig" and not mistake:
        why += f"; {contradicted.what}; {contradicted.advice}"
    return f"none of {len(records)} shots could be measured: {why}"


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
    shown = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
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


def _close(
    records: list[ShotPose], seconds: float, output: Path | None, view: PictureFolder | None, board_file: Path | None
) -> None:
    """Print on stderr what was measured and missed; raise an error if nothing was measured."""
    good = [r for r in records if r.ok]
    missed = [r for r in records if not r.ok]
    if not records:
        raise ArmsightError("the source ended without a single shot")
    summary = f"measured {len(good)} of {len(records)} shots in {seconds:.1f} s"
    summary += f", {len(missed)} missed (their lines have the reasons)" if missed else ""
    ways = Counter(r.way for r in records if r.way is not None)
    if ways:
        took = {way: np.median([r.took_ms for r in records if r.way == way and r.took_ms is not None]) for way in ways}
        summary += "; " + ", ".join(f"{count} {way} ({took[way]:.1f} ms each)" for way, count in ways.most_common())
    if jumps := [r.shot for r in records if r.jump]:
        summary += f"; jumped in {', '.join(jumps[:5])}" + (f" and {len(jumps) - 5} more" if len(jumps) > 5 else "")
    if few := [r.shot for r in good if _contradicts(r.dropped, len(r.points_m))]:
        which = ", ".join(few[:_NAMED]) + (f" and {len(few) - _NAMED} more" if len(few) > _NAMED else "")
        summary += f"; in {which} most points contradict each other: do not use it; the body moved between the two "
        summary += "exposures, or the images do not belong together"
    if odd := [r.shot for r in good if r.misfit > 1]:
        which = f" ({', '.join(odd)})" if len(odd) <= _NAMED else ""
        summary += f"; {len(odd)} fit the body worse than the noise allows{which}"
        summary += " (misfit in their lines; their sigma includes it)"
        if board_file is not None:
            summary += f"; the rig's calibration found the shape of this board: measure with --target {board_file}"
    summary += f"; {view.summary()}" if view is not None else ""
    click.echo(summary + (f"; written to {output}" if output is not None else ""), err=True)
