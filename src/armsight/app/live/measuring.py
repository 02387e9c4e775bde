"""Measuring, shot by shot, and whether the calibrations still hold.

In: live shots, a rig, a target. Out: a :class:`MeasureState` at any time; poses as CSV, in the form of ``armsight
measure``. The sigma is split into precision (the noise of this shot) and what the calibration leaves in all shots alike.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from armsight.app.live.capture import LiveShot
from armsight.app.live.records import Drawn, polyline
from armsight.app.show.messages import Note
from armsight.app.stream.datum import Published, ShotDatum
from armsight.app.stream.mcap_file import LazyMcap, properties
from armsight.app.stream.streams import open_streams
from armsight.data import Array, Missed, PoseEstimate
from armsight.errors import InputError
from armsight.geometry.pose import adjoint, inverse, transform
from armsight.geometry.rotation import euler_zyx, skew
from armsight.loop.handeye.pivot import MIN_POSES, Pivot, calibrate_pivot
from armsight.loop.health import HealthMonitor
from armsight.vision.follow.follower import Follower, follows
from armsight.vision.markers.calibrated_board import is_print
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.locate import by_rig
from armsight.vision.pose.measure import measure
from armsight.vision.pose.shot_pose import csv_text, shot_pose
from armsight.vision.rig import StereoRig

#: Health is asked for once a second; so many times as long as it took it is not.
_HEALTH_REST = 20.0
#: Poses of the path and of the chart that are kept, and latencies for the percentiles.
_TRAIL, _LATENCIES = 240, 600
_AXIS_M = 0.05
#: Newest poses that are kept for a mean.
_RECENT = 12


@dataclass(frozen=True)
class PoseShown:
    """A measured pose in mm and degrees, in the left camera's frame or relative to the zero.

    Attributes:
        position_mm: (3,) position.
        euler_zyx_deg: (3,) angles about z, y, x.
        sigma_mm: (3,) one sigma of the position along the left camera's axes, all errors together.
        precision_mm: (3,) the share of this shot's noise.
        calibration_mm: (3,) what the calibration leaves.
        sigma_deg: (3,) one sigma of the rotation about these axes.
        misfit: how many times larger the residuals are than the noise allows.
        points: number of points that both cameras saw.
        ellipsoid_mm: (3, 3) covariance of the position, mm^2.
    """

    position_mm: tuple[float, ...]
    euler_zyx_deg: tuple[float, ...]
    sigma_mm: tuple[float, ...]
    precision_mm: tuple[float, ...]
    calibration_mm: tuple[float, ...]
    sigma_deg: tuple[float, ...]
    misfit: float
    points: int
    ellipsoid_mm: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class RelativeShown:
    """The pose of a second body in the first one's frame.

    Attributes:
        target: the second body.
        reason: why it was missed; None where it is measured.
        position_mm: (3,) its position.
        euler_zyx_deg: (3,) angles about z, y, x.
        sigma_mm: (3,) one sigma along the first body's axes; what the calibration does to both alike cancels.
        sigma_deg: (3,) one sigma of the rotation about these axes.
        distance_mm: distance of the origins, and its sigma.
    """

    target: str
    reason: str | None = None
    position_mm: tuple[float, ...] = ()
    euler_zyx_deg: tuple[float, ...] = ()
    sigma_mm: tuple[float, ...] = ()
    sigma_deg: tuple[float, ...] = ()
    distance_mm: tuple[float, float] | None = None


@dataclass(frozen=True)
class Scene:
    """The rig and the body for a view in space, m, left camera's frame.

    Attributes:
        T_left_right: (4, 4) the right camera.
        tangents: half width and half height of the left camera's view, per distance.
        body: (M, 3) the body's points where it is now; empty while it is not seen.
        trail: the last positions of the body.
    """

    T_left_right: tuple[tuple[float, ...], ...]
    tangents: tuple[float, float]
    body: tuple[tuple[float, ...], ...]
    trail: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class MeasureState:
    """What a page shows of measuring.

    Attributes:
        rig: the rig's file; None without one.
        target: what is measured.
        ready: whether rig and target are there.
        missing: what is missing, one line.
        pose: the newest pose; None where it was missed.
        reason: why it was missed.
        rate_hz: poses a second.
        latency_ms: p50 and p99 from an image's arrival to its pose, ms.
        age_ms: age of the newest pose's image when it was shown, ms.
        dropped: points that were left out of the newest pose, with the reason.
        measured: number of poses so far.
        missed: number of misses so far, by reason.
        relative: whether poses are relative to a zero.
        distance_mm: distance from the mark, and its sigma, mm; None without a mark.
        pivot: state of the pivot calibration, one line.
        pivoting: whether poses for it are collected.
        tip_mm: (3,) where the tip is now, left camera's frame or relative to the zero, and one sigma of it; None before.
        second: the second body relative to this one; None without.
        recording: the file that is written, and how many rows; None while nothing is.
        health: what no longer holds.
        scene: for a view in space.
        command: the command line that does the same.
        drawn: what to draw over the views.
    """

    rig: str | None = None
    target: str | None = None
    ready: bool = False
    missing: str = ""
    pose: PoseShown | None = None
    reason: str | None = None
    rate_hz: float | None = None
    latency_ms: tuple[float, float] | None = None
    age_ms: float | None = None
    dropped: tuple[str, ...] = ()
    measured: int = 0
    missed: tuple[tuple[str, int], ...] = ()
    relative: bool = False
    distance_mm: tuple[float, float] | None = None
    pivot: str = ""
    pivoting: bool = False
    tip_mm: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    second: RelativeShown | None = None
    recording: str | None = None
    health: tuple[str, ...] = ()
    scene: Scene | None = None
    command: str = ""
    drawn: tuple[Drawn, ...] = ()


class MeasureStep:
    """Measures a target in live shots.

    Args:
        folder: of the session; recordings go there.
        source: spec of the cameras, for the command line shown.
        say: called with a note for the person.
        streams: what every shot is published to: see ``armsight measure -h``.

    Attributes:
        rig: the rig; None before there is one.
        rig_path: its file.
        target_spec: spec or file of the target.
        newest: the newest shot with its pose; None before.
    """

    def __init__(
        self,
        folder: Path,
        source: str,
        say: Callable[[Note], None],
        streams: tuple[str, ...] = (),
        sync_s: float = 1e-3,
    ) -> None:
        self.folder, self.source, self._say, self._sync_s = folder, source, say, sync_s
        self.rig: StereoRig | None = None
        self.rig_path: Path | None = None
        self.target_spec: str | None = None
        self.newest: tuple[LiveShot, PoseEstimate | Missed] | None = None
        self._lock = threading.RLock()
        self._measure: Callable[[LiveShot], PoseEstimate | Missed] | None = None
        self._monitor: HealthMonitor | None = None
        self._zero: Array | None = None
        self._mark: tuple[Array, Array] | None = None
        self._pivot_poses: list[Array] | None = None
        self._pivot_text, self._tip = "", None
        self._second: _Second | None = None
        self._file: TextIO | None = None
        self._mcap: LazyMcap | None = None
        self._file_path, self._rows, self._whole = Path(), 0, 0
        self._specs, self._streams = streams, open_streams((), Published(), self._said)
        self._clear()

    def _clear(self) -> None:
        """Forget what was measured with another rig or target."""
        self._trail: deque[Array] = deque(maxlen=_TRAIL)
        self._times: deque[float] = deque(maxlen=30)
        self._latency: deque[float] = deque(maxlen=_LATENCIES)
        self._missed: Counter[str] = Counter()
        self._measured, self._health_s, self._health = 0, 0.0, ()
        self._recent: deque[tuple[float, PoseEstimate]] = deque(maxlen=_RECENT)
        self.newest = None

    _health: tuple[str, ...]
    _tip: Pivot | None

    def use_rig(self, rig: StereoRig, path: Path) -> None:
        """Measure with a rig from now on."""
        with self._lock:
            self.rig, self.rig_path = rig, path
            self._prepare()

    @property
    def followed(self) -> bool:
        """Whether the body that is measured can be followed from shot to shot."""
        return self._measure is not None and follows(self._target)

    def use_target(self, spec: str) -> None:
        """Measure another target from now on.

        Raises:
            InputError: it cannot be opened.
        """
        open_target(spec)
        with self._lock:
            self.target_spec = spec
            self._prepare()

    def use_second(self, spec: str) -> None:
        """Measure a second target too; none where ``spec`` is empty.

        Raises:
            InputError: it cannot be opened, or it is the first one.
        """
        if spec and spec == self.target_spec:
            raise InputError(f"{spec} is measured already: the second body must be another one")
        second = _Second(spec, open_target(spec)) if spec else None
        with self._lock:
            self._second = second
            if second is not None:
                second.prepare(self.rig, self._sync_s)

    def _prepare(self) -> None:
        """Get ready for rig and target."""
        self._clear()
        self._streams.close()
        self._measure = None
        if self._second is not None:
            self._second.prepare(self.rig, self._sync_s)
        if self.rig is None or self.target_spec is None:
            return
        rig, target = self.rig, open_target(self.target_spec)
        self._target, self._measure = target, _measuring(rig, target, self._sync_s)
        self._monitor = HealthMonitor(rig, target.body, self._sync_s, printed=is_print(target))
        try:
            self._streams = open_streams(self._specs, Published(rig, target.body), self._said)
        except InputError as error:
            self._say(Note("error", str(error)))

    def look(self, live: LiveShot) -> None:
        """Measure a live shot. Called from one thread."""
        with self._lock:
            work = self._measure
        if work is not None:
            result = work(live)
            with self._lock:
                if self._measure is work:  # else another rig or target was chosen meanwhile
                    self.take(live, result)
        with self._lock:
            second = self._second
            work = None if second is None else second.measure
        if second is not None and work is not None:
            result = work(live)
            with self._lock:
                if second.measure is work:
                    second.newest = live.number, result

    def take(self, live: LiveShot, result: PoseEstimate | Missed) -> None:
        """Take in what was measured in a shot, here or in a control loop."""
        now = time.monotonic()
        with self._lock:
            if self._monitor is None:
                return
            if isinstance(result, PoseEstimate):
                result = self._monitor.measured(result, live.shot.t_s)
                self._trail.append(result.T_left_body[:3, 3])
                self._recent.append((now, result))
                self._measured += 1
                if self._pivot_poses is not None:
                    self._pivot_poses.append(result.T_left_body)
            else:
                self._missed[result.reason] += 1
            self._times.append(now)
            self._latency.append(1e3 * (now - live.arrived_s))
            self.newest = live, result
            self._write(live, result)
            self._streams.put(ShotDatum(live.shot, result, now))
            if now - self._health_s > 1.0:
                self._health = tuple(found.line() for found in self._monitor.findings())
                self._health_s = now + _HEALTH_REST * (time.monotonic() - now)

    def lately(self, within_s: float) -> list[PoseEstimate]:
        """Return the newest poses of the last so many seconds, oldest first."""
        now = time.monotonic()
        with self._lock:
            return [pose for at, pose in self._recent if now - at < within_s]

    @property
    def why_missed(self) -> str:
        """Why no pose is measured now; empty where one is."""
        newest = self.newest
        if newest is None:
            return self._lacking() or "no pose is measured yet"
        return f"no pose is measured now: {newest[1].reason}" if isinstance(newest[1], Missed) else ""

    def zero(self) -> None:
        """Show poses relative to the present one from now on."""
        self._zero = inverse(self._pose().T_left_body)

    def clear_zero(self) -> None:
        """Show poses in the left camera's frame."""
        self._zero = None

    def mark(self) -> None:
        """Measure distances from the present position."""
        pose = self._pose()
        R = pose.T_left_body[:3, :3]
        self._mark = np.array(pose.T_left_body[:3, 3]), R @ pose.cov_noise[:3, :3] @ R.T

    def pivot(self) -> None:
        """Begin to collect poses about a tip that stands still; or end, and compute the tip.

        Raises:
            InputError: too few poses.
            CalibrationError: too little rotation.
        """
        with self._lock:
            if self._pivot_poses is None:
                self._pose()
                self._pivot_poses, self._pivot_text = [], ""
                return
            poses, self._pivot_poses = self._pivot_poses, None
        if len(poses) < MIN_POSES:
            raise InputError(f"{len(poses)} poses are too few for a pivot calibration; 30 and more are advised")
        found = self._tip = calibrate_pivot(np.array(poses))
        tip, sigma = 1e3 * found.p_body, 1e3 * float(np.sqrt(np.trace(found.cov[:3, :3])))
        held = 1e3 * float(np.sqrt(np.nanmean(found.held_out_m**2)))
        at = ", ".join(f"{x:.2f}" for x in tip)
        self._pivot_text = (
            f"tip at {at} mm in the body, sigma {sigma:.2g} mm; held out {held:.2g} mm RMS, {len(poses)} poses"
        )

    def record(self) -> None:
        """Begin to write every pose to a new CSV file, and an MCAP file beside it; or end.

        Raises:
            InputError: nothing is measured, or the file cannot be made.
        """
        with self._lock:
            if self._file is not None:
                self._close_file()
                self._say(Note("good", f"{self._rows} poses written to {self._file_path}"))
                return
            if self._measure is None:
                raise InputError(self._lacking())
            number, path = 1, self.folder / "poses-1.csv"
            while path.exists() or path.with_suffix(".mcap").exists():
                number += 1
                path = self.folder / f"poses-{number}.csv"
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                self._file = path.open("x", encoding="utf-8")  # open while the recording lasts
                self._file.write(csv_text([]))
            except OSError as error:
                self._close_file()
                raise InputError(f"{path}: cannot be written: {error.strerror}") from None
            self._file_path, self._rows, self._whole = path, 0, len(csv_text([]).encode())
            published = Published(self.rig, self._target.body, None, properties(self.rig, None, command="live"))
            self._mcap = LazyMcap(self.folder, published, self._said, path.with_suffix(".mcap").name)

    def _said(self, line: str) -> None:
        """Pass a line about the recording on to the person."""
        self._say(Note("warn", line.removeprefix("note: ")))

    def _write(self, live: LiveShot, result: PoseEstimate | Missed) -> None:
        """Write a row, whole; a full disk ends the recording."""
        if self._file is None:
            return
        text = csv_text([shot_pose(live.shot.name, live.shot.t_s, self._target.body, result)])
        row = text.partition("\n")[2]
        try:
            self._file.write(row)
            self._file.flush()
            self._rows, self._whole = self._rows + 1, self._whole + len(row.encode())
            if self._mcap is not None:
                self._mcap.put(ShotDatum(live.shot, result, time.monotonic()))
        except OSError as error:
            self._close_file()
            with contextlib.suppress(OSError):  # a row that is there in part goes
                os.truncate(self._file_path, self._whole)
            why = f"the recording has ended: {error.strerror}; {self._rows} poses are in {self._file_path}"
            self._say(Note("error", why))

    def _close_file(self) -> None:
        file, self._file = self._file, None
        mcap, self._mcap = self._mcap, None
        if mcap is not None:
            mcap.close()
        if file is not None:
            with contextlib.suppress(OSError):  # what is still buffered may not fit on the disk: the row that failed
                file.flush()
                os.fsync(file.fileno())
            with contextlib.suppress(OSError):
                file.close()

    def close(self) -> None:
        """Close the recording and the streams."""
        with self._lock:
            self._close_file()
            self._streams.close()

    def _pose(self) -> PoseEstimate:
        newest = self.newest
        if newest is None or isinstance(newest[1], Missed):
            raise InputError(self.why_missed)
        return newest[1]

    def _lacking(self) -> str:
        if self.rig is None:
            return "no calibrated rig yet: finish the calibration first, or give --rig"
        return "" if self.target_spec is not None else "no body yet: choose one in the step Body"

    @property
    def state(self) -> MeasureState:
        """What to show now."""
        with self._lock:
            return self._shown()

    def _shown(self) -> MeasureState:
        if self._measure is None or self.rig is None or self.target_spec is None:
            return MeasureState(
                None if self.rig_path is None else str(self.rig_path), self.target_spec, missing=self._lacking()
            )
        newest, now = self.newest, time.monotonic()
        pose = reason = age_ms = distance = None
        dropped: tuple[str, ...] = ()
        drawn: tuple[Drawn, ...] = ()
        body = np.zeros((0, 3))
        if newest is not None:
            live, result = newest
            age_ms = 1e3 * live.age_s(now)
            if isinstance(result, PoseEstimate):
                pose = shown_pose(result, self._zero)
                dropped = tuple(f"{each.point}: {each.reason}" for each in result.dropped)
                drawn = self._drawings(result)
                if self._second is not None:
                    drawn = (*drawn, *self._second.drawings(self.rig, live.number))
                body = transform(result.T_left_body, self._target.body.points)
                distance = self._distance(result)
            else:
                reason = result.reason
        latency = np.percentile(list(self._latency), (50, 99)) if self._latency else None
        span = self._times[-1] - self._times[0] if len(self._times) > 2 else 0.0
        pivot = self._pivot_text
        if self._pivot_poses is not None:
            far = 0.0 if not self._pivot_poses else _most_rotated_deg(np.array(self._pivot_poses))
            pivot = (
                f"{len(self._pivot_poses)} poses, rotated by up to {far:.0f} degrees: keep the tip where it is, and "
            )
            pivot += "rotate the body about it by 30 degrees, all ways"
        return MeasureState(
            str(self.rig_path),
            self.target_spec,
            True,
            "",
            pose,
            reason,
            (len(self._times) - 1) / span if span > 0 else None,
            None if latency is None else (float(latency[0]), float(latency[1])),
            age_ms,
            dropped,
            self._measured,
            tuple(self._missed.most_common(5)),
            self._zero is not None,
            distance,
            pivot,
            self._pivot_poses is not None,
            None if newest is None else self._tip_now(newest[1]),
            None if self._second is None or newest is None else self._second.shown(self.rig, newest),
            None if self._file is None else f"{self._file_path.name}: {self._rows} poses",
            self._health,
            self._scene(body),
            f"armsight measure {self.rig_path} --target {self.target_spec} --source {self.source} -o poses.csv",
            drawn,
        )

    def _distance(self, pose: PoseEstimate) -> tuple[float, float] | None:
        """Return the distance from the mark and its sigma by the noise of both poses, mm."""
        if self._mark is None:
            return None
        marked, cov = self._mark
        R = pose.T_left_body[:3, :3]
        away = pose.T_left_body[:3, 3] - marked
        size = float(np.linalg.norm(away))
        both = cov + R @ pose.cov_noise[:3, :3] @ R.T
        along = away / size if size > 0 else np.array([0.0, 0.0, 1.0])
        return 1e3 * size, 1e3 * float(np.sqrt(along @ both @ along))

    def _tip_now(self, pose: PoseEstimate | Missed) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Return where the tip is, and one sigma of it, mm."""
        if self._tip is None or isinstance(pose, Missed):
            return None
        p, R = self._tip.p_body, pose.T_left_body[:3, :3]
        T = pose.T_left_body if self._zero is None else self._zero @ pose.T_left_body
        J = R @ np.hstack([np.eye(3), -skew(p)])
        cov = J @ pose.cov @ J.T + R @ self._tip.cov[:3, :3] @ R.T
        return _mm(transform(T, p)), _mm(np.sqrt(np.diag(cov)))

    def _scene(self, body: Array) -> Scene:
        assert self.rig is not None
        camera = self.rig.left
        width, height = camera.image_size_px
        trail = tuple(map(tuple, np.round(np.array(self._trail).reshape(-1, 3), 5).tolist()))
        return Scene(
            tuple(tuple(float(x) for x in row) for row in self.rig.T_left_right),
            (0.5 * width / float(camera.intrinsics[0]), 0.5 * height / float(camera.intrinsics[1])),
            tuple(tuple(round(float(x), 5) for x in p) for p in body),
            trail,
        )

    def _drawings(self, pose: PoseEstimate) -> tuple[Drawn, ...]:
        """Return the body's points and axes as both cameras see them."""
        assert self.rig is not None
        rig, T = self.rig, pose.T_left_body
        drawn = []
        axes = transform(T, np.vstack([np.zeros(3), _AXIS_M * np.eye(3)]))
        points = transform(T, self._target.body.points[pose.points.seen.ids])
        for side, camera in enumerate(rig.cameras):
            to = np.eye(4) if side == 0 else inverse(rig.T_left_right)
            uv, ends = camera.project(transform(to, points)), camera.project(transform(to, axes))
            drawn.append(Drawn(side, "body", tuple(polyline(each[None]) for each in uv)))
            drawn += [Drawn(side, f"axis{k}", (polyline(ends[[0, k + 1]]),)) for k in range(3)]
        return tuple(drawn)


def shown_pose(pose: PoseEstimate, T_zero_left: Array | None) -> PoseShown:
    """Return a pose as people read it; relative to a zero where one is given."""
    T = pose.T_left_body
    R = T[:3, :3]
    whole, noise = R @ pose.cov[:3, :3] @ R.T, R @ pose.cov_noise[:3, :3] @ R.T
    rotation = R @ pose.cov[3:, 3:] @ R.T
    shown = T if T_zero_left is None else T_zero_left @ T
    left = np.sqrt(np.maximum(np.diag(whole - noise), 0.0))
    return PoseShown(
        _mm(shown[:3, 3]),
        tuple(float(x) for x in np.degrees(euler_zyx(shown[:3, :3])[0])),
        _mm(np.sqrt(np.diag(whole))),
        _mm(np.sqrt(np.diag(noise))),
        _mm(left),
        tuple(float(x) for x in np.degrees(np.sqrt(np.diag(rotation)))),
        pose.misfit,
        len(pose.points.ids),
        tuple(tuple(float(x) for x in row) for row in 1e6 * whole),
    )


def _mm(values: Array) -> tuple[float, ...]:
    return tuple(float(1e3 * x) for x in values)


def _measuring(rig: StereoRig, target: Target, sync_s: float) -> Callable[[LiveShot], PoseEstimate | Missed]:
    """Return what measures a target in live shots whose two exposures are so far apart, s (standard deviation)."""
    if follows(target):
        follower = Follower(rig, target, sync_s)
        return lambda live: follower.measure(live.shot)
    return lambda live: measure(rig, target, live.shot)


@dataclass(eq=False)
class _Second:
    """A second body: what it is, and how it was measured last."""

    spec: str
    target: Target
    measure: Callable[[LiveShot], PoseEstimate | Missed] | None = None
    newest: tuple[int, PoseEstimate | Missed] | None = None

    def prepare(self, rig: StereoRig | None, sync_s: float) -> None:
        """Get ready for a rig, and for exposures that are so far apart, s."""
        self.measure, self.newest = None if rig is None else _measuring(rig, self.target, sync_s), None

    def drawings(self, rig: StereoRig, number: int) -> tuple[Drawn, ...]:
        """Return its points as both cameras see them, if they are of the shot of a number or of its neighbour."""
        if self.newest is None or abs(self.newest[0] - number) > 1 or isinstance(self.newest[1], Missed):
            return ()
        points = transform(self.newest[1].T_left_body, self.target.body.points)
        views = rig.left.project(points), rig.right.project(transform(inverse(rig.T_left_right), points))
        return tuple(Drawn(side, "second", tuple(polyline(p[None]) for p in uv)) for side, uv in enumerate(views))

    def shown(self, rig: StereoRig, first: tuple[LiveShot, PoseEstimate | Missed]) -> RelativeShown | None:
        """Return it relative to the first body, as people read it; None before both were measured in one shot."""
        live, pose = first
        if self.newest is None or isinstance(pose, Missed):
            return RelativeShown(self.spec, "no shot yet" if self.newest is None else "the first body is not seen")
        number, other = self.newest
        if isinstance(other, Missed):
            return RelativeShown(self.spec, other.reason)
        if abs(number - live.number) > 1:
            return RelativeShown(self.spec, "not measured while the arm moves")
        T, cov = relative_pose(rig, pose, other)
        R, t = T[:3, :3], T[:3, 3]
        size = float(np.linalg.norm(t))
        u = R.T @ t / max(size, 1e-12)
        return RelativeShown(
            self.spec,
            None,
            _mm(t),
            tuple(float(x) for x in np.degrees(euler_zyx(R)[0])),
            _mm(np.sqrt(np.diag(R @ cov[:3, :3] @ R.T))),
            tuple(float(x) for x in np.degrees(np.sqrt(np.diag(R @ cov[3:, 3:] @ R.T)))),
            (1e3 * size, 1e3 * float(np.sqrt(u @ cov[:3, :3] @ u))),
        )


def relative_pose(rig: StereoRig, first: PoseEstimate, second: PoseEstimate) -> tuple[Array, Array]:
    """Return the pose of a second body in the first one's frame, and its covariance.

    The noise of both adds up; the calibration moves both bodies, and what it does to both alike cancels: its covariance
    passes through the difference of the derivatives.

    Args:
        rig: the calibrated cameras.
        first: pose of the first body.
        second: pose of the second body in the same shot.

    Returns:
        (4, 4) T_first_second, m, and (6, 6) covariance of the right tangent [m; rad].
    """
    T = inverse(first.T_left_body) @ second.T_left_body
    Ad = adjoint(inverse(T))
    D = by_rig(second) - Ad @ by_rig(first)
    return T, second.cov_noise + Ad @ first.cov_noise @ Ad.T + D @ rig.cov @ D.T


def _most_rotated_deg(Ts: Array) -> float:
    """Return the largest angle between the first pose and another, degrees."""
    cosines = (np.einsum("ij,nij->n", Ts[0, :3, :3], Ts[:, :3, :3]) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))
