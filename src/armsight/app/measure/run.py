"""One run of ``armsight measure``: a rig, a target and shots in; a line for each shot, poses as CSV and pictures out."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import click
import numpy as np

from armsight.app.measure.command import MeasureOptions
from armsight.app.measure.picture import SINGULAR
from armsight.app.measure.shots import DetectedShots, ImageShots, NamedShots, Requested, Result, requested_shutters
from armsight.app.measure.view import CHART, PictureFolder, view_folder
from armsight.app.options import DETECTIONS
from armsight.app.progress import bar
from armsight.app.show.messages import note, say, silence_stdout, warn
from armsight.app.stream.datum import Published
from armsight.data import Body, Dropped, Missed, PoseEstimate, Shot
from armsight.errors import NAMED, ArmsightError, InputError
from armsight.files import RowFile, check_writable
from armsight.loop.finding import make_finding
from armsight.loop.health import HealthFinding, HealthMonitor, health_lines, unseen_lines
from armsight.loop.running.data import Fanout, HealthNotes, Publisher, ShotDatum
from armsight.vision.follow.follower import measurer
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_fixed
from armsight.vision.match import gate
from armsight.vision.pose.shot_pose import ANGLES, CSV_COLUMNS, SHUTTER_COLUMNS, ShotPose, row_of, shot_pose
from armsight.vision.rig import Shutters, StereoRig
from armsight.vision.source import LIVE_S
from armsight.vision.sources import LIVE, open_rig

#: Standard deviation of the time between the two exposures of a shot, s: of cameras that nothing synchronises to better.
_SYNC_S = 1e-3
#: Shots that were missed are measured again with detections of this standard deviation, px, so many of them.
_WIDE_PX, _AGAIN = 2.0, 60
#: What to do about repeated shots of a recording.
_RECORDED = "they are no new measurements: leave them out, and record at the rate that the cameras really give"
#: Newest shots, of which the notes at the end are made; half: less is noted, double: twice the memory, 7 kB a shot.
_KEPT = 1_000
#: s, between two looks at the health of live cameras; half: nothing, double: a warning comes later.
_HEALTH_S = 1.0
#: Columns of the table for people, their widths and digits; the shot's name is before them.
_TABLE = (
    *((f"{axis} mm", 9, 3) if k == 0 else ("±", 6, 3) for axis in "xyz" for k in (0, 1)),
    *((f"{angle} deg", 9, 3) for angle in ANGLES),
    ("±", 6, 3),
    ("prec.", 7, 3),
    ("pts", 4, 0),
)


def measure_shots(options: MeasureOptions) -> tuple[HealthFinding, ...]:
    """Measure the pose of a target in every shot, and print a line for each."""
    requested = requested_shutters(options.skew, options.readout)
    _check_detections(options, requested)
    fixed = open_fixed(options.fixed, options.target)
    rig = open_rig(options.rig)
    folder = _checked_outputs(options)
    if not rig.cov.any():
        note(f"{options.rig} has no covariance: every ± is the share of the pixel noise alone")
    started = time.perf_counter()
    with contextlib.ExitStack() as stack:
        draws, given = folder is not None, options.detections
        opened = DetectedShots(options, rig) if given is not None else ImageShots(options, rig, requested, draws)
        shots = stack.enter_context(contextlib.closing(opened))
        view = None if folder is None else PictureFolder(folder, rig, shots.body, shots.discs, shots.total)
        run = MeasureRun(options, rig, shots, view, HealthMonitor(rig, shots.body, _SYNC_S, printed=shots.printed))
        # What was measured is written whatever ends the run; where one of the two cannot be written the other is.
        if view is not None:
            stack.callback(lambda: view.finish([*run.records]))
        stack.callback(run.close)
        publisher = stack.enter_context(contextlib.closing(_streams(options.stream, rig, shots.body)))
        if options.board is not None:
            from armsight.app.board.readings import BoardReadings  # not above: a pair of images needs no board

            board = stack.enter_context(contextlib.closing(BoardReadings(options.board)))
            board.start(publisher.put, say)
        missed = _Contradicting(rig, shots.body, shots.again)
        try:
            run.measure(_watched(rig, fixed, missed.keeping(shots.results), run.monitor), publisher)
        except KeyboardInterrupt:
            kept = f", kept in {options.output}" if options.output is not None and run.total else ""
            click.echo(f"armsight: stopped after {run.total} shots{kept}", err=True)
            raise
        shots.finish(run.records)
        other = shots.other_board() if run.total > 2 * run.measured else ""
        contradicted = make_finding("board", (run.total - run.measured, 0.0), words={"other": other}) if other else None
        contradicted = contradicted or missed.finding()
        if run.total and not run.measured:
            raise ArmsightError(run.nothing_measured(contradicted))
    click.echo(run.summary(time.perf_counter() - started), err=True)
    saved = run.keep_noise()
    health = run.concluded(contradicted)
    if options.as_json and health:
        click.echo(json.dumps({"health": [found.to_json() for found in health]}))
    if not saved and not health:
        click.get_current_context().exit(1)
    return health


def _checked_outputs(options: MeasureOptions) -> Path | None:
    if options.save_rig is not None:
        check_writable(options.save_rig, apart_from=(options.rig, options.target), outputs=(options.output,))
    folder = None if options.view_dir is None else view_folder(options.view_dir)
    if options.output is not None:
        chart = folder and folder / CHART
        read = options.rig, options.target, options.source.removeprefix(DETECTIONS)
        check_writable(options.output, apart_from=read, outputs=(folder, chart))
    return folder


def _check_detections(options: MeasureOptions, requested: Requested | None) -> None:
    """Reject options that need images where only detections are given, or live cameras where there are none."""
    if options.board is not None and not (options.stream and options.source.startswith(LIVE)):
        raise InputError("--board: joints are published beside live cameras: give --stream, and --source usb: or url:")
    for given, why in (
        (requested is not None, "--skew and --readout need images with times: detections have none"),
        (bool(options.fixed), "--fixed needs images: detections have the markers of the target alone"),
        (options.save_rig is not None, "--save-rig writes what images show of the cameras: detections have none"),
    ):
        if options.detections is not None and given:
            raise InputError(why)


@dataclass
class MeasureRun:
    """A run: what it has measured so far, and what is said of it."""

    options: MeasureOptions
    rig: StereoRig
    shots: DetectedShots | ImageShots
    view: PictureFolder | None
    monitor: HealthMonitor
    records: deque[ShotPose] = field(init=False)  #: the newest; all where a chart is drawn of them
    total: int = 0
    measured: int = 0
    ways: Counter[str] = field(default_factory=Counter)
    jumped: NamedShots = field(default_factory=NamedShots)
    contradicted: NamedShots = field(default_factory=NamedShots)
    misfit: NamedShots = field(default_factory=NamedShots)
    shutters: Shutters | None = None
    first: ShotPose | None = None
    file: RowFile | None = None
    unwritten: int = 0
    why: str = ""  #: why the last shot was missed, without figures
    alike: list[str] = field(default_factory=list)  #: shots since, missed for that reason

    def __post_init__(self) -> None:
        self.records = deque(maxlen=_KEPT if self.view is None else None)

    def measure(self, results: Iterator[Result], publisher: Publisher) -> None:
        """Measure every shot, print its line, keep its record and draw it; of live cameras also warn at once."""
        notes, looked_s, width, headed = HealthNotes(), 0.0, 0, False
        with bar("measuring", self.shots.total) as advance:
            for shot, measured, followed, shutters in results:
                result = self.monitor.measured(measured, shot.t_s) if isinstance(measured, PoseEstimate) else measured
                record = replace(shot_pose(shot.name, shot.t_s, self.shots.body, result), shutters=shutters)
                if followed is not None:
                    record = replace(record, way=followed.way, jump=followed.jump, took_ms=followed.took_ms)
                self._keep(record)
                now = time.monotonic()  # the time by the clock of live cameras; a recording has none
                arrival_s = now if shot.t_s is not None and 0.0 <= now - shot.t_s < LIVE_S else None
                publisher.put(ShotDatum(shot, result, arrival_s))
                if arrival_s is not None and arrival_s - looked_s > _HEALTH_S:
                    looked_s = arrival_s
                    for each in notes.of(arrival_s, self.monitor.findings(ends=False)):
                        (warn if each.level == "warning" else note)(each.text)
                        publisher.put(each)
                if self.options.as_json:
                    self._print(json.dumps(record.to_json()))
                else:
                    width = width or max(4, len(record.shot))
                    if record.ok and not headed:
                        headed = True
                        self._print(f"{'shot':<{width}}" + "".join(f"{name:>{wide}}" for name, wide, _ in _TABLE))
                    self._report(record, width)
                if self.view is not None:
                    self.view.add(shot, result, record)
                advance()
        self._report(None, width)

    def _report(self, record: ShotPose | None, width: int) -> None:
        """Print a shot's line; shots missed alike one after the other are reported together, once that has ended."""
        why = re.sub(r"[\d.]+", "", (record and record.reason) or "")
        if record is not None and why and why == self.why:
            self.alike.append(record.shot)
            return
        if self.alike:
            which = " to ".join(dict.fromkeys((self.alike[0], self.alike[-1])))
            self._print(f"{which}: missed: for the same reason ({len(self.alike)} in all)")
        self.why, self.alike = why, []
        if record is not None:
            self._print(_line(record, width))

    def _print(self, line: str) -> None:
        """Print a line; where nobody reads on (``| head``), go on for what is written and sent elsewhere."""
        try:
            click.echo(line)
        except BrokenPipeError:
            if self.options.output is None and self.view is None and not self.options.stream:
                raise
            silence_stdout()

    def _keep(self, record: ShotPose) -> None:
        self.records.append(record)
        self.first = self.first or record
        self.total += 1
        self.measured += record.ok
        self.shutters = self.shutters or record.shutters
        if record.way is not None:
            self.ways[record.way] += 1
        odd = record.ok and _contradicts(record.dropped, len(record.points_m))
        kinds = (self.jumped, record.jump is not None), (self.contradicted, odd)
        for shots, holds in (*kinds, (self.misfit, record.ok and record.misfit > 1)):
            if holds:
                shots.add(record.shot)
        if self.options.output is not None:
            self._write(record, self.options.output)

    def _write(self, record: ShotPose, output: Path) -> None:
        columns = CSV_COLUMNS + (SHUTTER_COLUMNS if self.shots.moves else ())
        try:
            self.file = self.file or RowFile(output, columns, replaces=True)
            self.file.add(row_of(record, columns))
        except InputError as error:
            if not self.unwritten:
                warn(f"{error}; measuring goes on")
            self.unwritten += 1

    def close(self) -> None:
        """Close the file of the poses."""
        if self.file is not None:
            self.file.close()
        if self.unwritten:
            raise InputError(f"{self.options.output}: {self.unwritten} of {self.total} rows could not be written")

    def nothing_measured(self, contradicted: HealthFinding | None) -> str:
        """Return why no shot could be measured: what was done to the images, or the first reason and what explains it."""
        first, mistake = self.first, self.shots.mistake()
        assert first is not None
        why = mistake or f"{first.shot}: {first.reason}"
        if contradicted is not None and contradicted.cause in ("rig", "body") and not mistake:
            why += f"; {contradicted.what}; {contradicted.advice}"
        written = "" if self.options.output is None else f" (the reason of each is in {self.options.output})"
        return f"none of {self.total} shots could be measured: {why}{written}"

    def summary(self, seconds: float) -> str:
        """Return what was measured and missed; raise an ArmsightError where there was nothing to measure."""
        if not self.total:
            raise ArmsightError("the source ended without a single shot")
        total, measured, output = self.total, self.measured, self.options.output
        missed = f", {total - measured} missed (their lines have the reasons)" if total > measured else ""
        said = [f"measured {measured} of {total} shots in {seconds:.1f} s{missed}", self._ways()]
        if self.jumped.count:
            said.append(f"jumped in {self.jumped}")
        if self.contradicted.count:
            why = "the body moved between the two exposures, or the images do not belong together"
            said.append(f"in {self.contradicted} most points contradict each other: do not use it; {why}")
        if odd := self.misfit.count:
            which = f" ({self.misfit})" if odd <= NAMED else ""
            said.append(f"{odd} fit the body worse than the noise allows{which} (misfit in their lines and sigma)")
            # The board as the rig's calibration found it, where it is measured by its drawing.
            given, board = self.rig.provenance.get("target"), self.rig.provenance.get("board")
            if given == self.options.target and isinstance(board, str) and (self.options.rig.parent / board).exists():
                file = self.options.rig.parent / board
                said.append(f"the rig's calibration found the shape of this board: measure with --target {file}")
        said.append(self.view.summary() if self.view is not None else "")
        said.append(f"written to {output}" if output is not None else "")
        return "; ".join(filter(None, said))

    def _ways(self) -> str:
        took: dict[str, list[float]] = {}
        for record in self.records:
            if record.way is not None and record.took_ms is not None:
                took.setdefault(record.way, []).append(record.took_ms)
        return ", ".join(
            f"{count} {way}" + (f" ({np.median(took[way]):.1f} ms each)" if way in took else "")
            for way, count in self.ways.most_common()
        )

    def keep_noise(self) -> bool:
        """Say how noisy the discs were, and write the rig with that and its shutters; False: there was nothing to."""
        rig, shots, save_rig = self.rig, self.shots, self.options.save_rig
        found = None if shots.noise is None or shots.skewed else shots.noise.found()
        if found is not None:
            left, right = found
            kept = "" if save_rig or rig.disc_noise else "; --save-rig keeps it for single shots"
            note(f"discs' centres vary {left} (left) and {right} (right) times as much as single images say{kept}")
        if save_rig is not None and found is None and self.shutters is None:
            few = "too few shots, or the body moved too little, to know the discs' noise"
            why = "the shots show a skew, which hides the discs' noise: give --skew find" if shots.skewed else few
            warn(f"{save_rig} was not written: {why}")
            return False
        if save_rig is not None:
            replace(rig, shutters=self.shutters or rig.shutters, disc_noise=found or rig.disc_noise).save(save_rig)
        return True

    def concluded(self, contradicted: HealthFinding | None) -> tuple[HealthFinding, ...]:
        """Say and return why the poses must not be trusted: findings of the run, and what all its shots show better."""
        shots = self.shots
        recorded = {"host"} if shots.recorded else set()
        found = self.monitor.findings()
        health = tuple(replace(each, advice=_RECORDED) if each.cause in recorded else each for each in found)
        note(*unseen_lines(self.monitor.fixed_never_seen))
        if contradicted is not None:
            health = (contradicted, *(each for each in health if each.cause not in ("rig", "body", "lens")))
        if shots.skewed and any(each.cause in ("rig", "time") for each in health):
            # Of a moving body a skew looks like cameras that moved against each other; all shots together size it best.
            health = (*shots.skewed, *(each for each in health if each.cause not in ("rig", "time")))
        else:  # a skew that changes no pose by more than its sigma
            note(*(f"{late.what}; {late.advice}" for late in shots.skewed))
        warn(*health_lines(health))
        return health


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
        for result in results:
            shot, measured = result[:2]
            few = isinstance(measured, PoseEstimate) and _contradicts(measured.dropped, len(measured.points.ids))
            self._few += few
            self._measured += isinstance(measured, PoseEstimate) and not few
            if (few or isinstance(measured, Missed)) and shot.problem is None:
                self._missed += 1
                if self._tried < _AGAIN:
                    self._tried += 1
                    if isinstance(wide := self._again(self._wide, shot), PoseEstimate):
                        seen = wide.points.seen
                        # Rays that miss each other by more than the rig allows: a body of another size does not do that.
                        if gate(self._rig, self._body, seen).paired.sum() < seen.paired.sum():
                            self._found.append(wide)
            yield result

    def finding(self) -> HealthFinding | None:
        count = round(len(self._found) / max(self._tried, 1) * self._missed)
        if self._found and count > self._measured:
            from armsight.loop.health.update import contradiction

            return contradiction(self._rig, self._body, self._found, (count, count + self._measured))
        if self._few <= self._measured:
            return None
        shots = {"shots": self._few + self._measured}
        return make_finding("inconsistent", (float(self._few), 0.0), words=shots)


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


def _streams(specs: Sequence[str], rig: StereoRig, body: Body) -> Publisher:
    if not specs:
        return Fanout()
    from armsight.app.stream.streams import open_streams

    return open_streams(specs, Published(rig, body, properties={"command": "measure"}), say)


def _line(record: ShotPose, width: int) -> str:
    """Return one shot as a row of the table for people: mm and degrees, one sigma; what is unusual comes last."""
    if not record.ok:
        return f"{record.shot}: missed: {record.reason}"
    sigma = np.sqrt(np.diag(record.cov_left))
    each = [1e3 * v for pair in zip(record.position_m, sigma[:3], strict=True) for v in pair]
    each += [*record.euler_zyx_deg, np.degrees(np.linalg.norm(sigma[3:])), 1e3 * record.position_sigmas_m[1]]
    cells = zip([*each, len(record.points_m)], _TABLE, strict=True)
    row = "".join(f"{value:>{wide}.{digits}f}" for value, (_, wide, digits) in cells)
    dropped = len(record.dropped)
    notes = (
        f"{dropped} point{'' if dropped == 1 else 's'} dropped" if dropped else "",
        f"misfit {record.misfit:.1f}" if record.misfit > 1 else "",
        record.jump,
        SINGULAR.strip(", ") if record.pitch_singular else "",
    )
    return f"{record.shot:<{width}}{row}  {', '.join(filter(None, notes))}".rstrip()
