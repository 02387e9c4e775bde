"""Measuring, shot by shot, and whether the calibrations still hold.

The sigma is split into precision (the noise of this shot) and what the calibration leaves in all shots alike.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armsight.app.live.capture import LiveShot
from armsight.app.live.records import Drawn, asked, dots, polyline
from armsight.app.live.step import PageStep, Shared
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import LazyMcap, properties
from armsight.app.stream.streams import open_streams
from armsight.data import Array, Body, Missed, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.files import RowFile, made_folder
from armsight.geometry.pose import adjoint, inverse, left_axes, transform
from armsight.geometry.rotation import euler_zyx, skew
from armsight.loop.handeye.pivot import MIN_POSES, Pivot, calibrate_pivot
from armsight.loop.health import HealthMonitor
from armsight.loop.running.data import HealthNotes, ShotDatum
from armsight.loop.running.log import count
from armsight.vision.follow.follower import follows, measurer
from armsight.vision.markers.calibrated_board import is_print
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.locate import by_rig
from armsight.vision.pose.shot_pose import CSV_COLUMNS, row_of, shot_pose
from armsight.vision.rig import StereoRig

#: Health is asked for once a second; so many times as long as it took it is not.
_HEALTH_REST = 20.0
_AXIS_M = 0.05


@dataclass(frozen=True)
class PoseShown:
    """A measured pose, in the left camera's frame or relative to the zero; sigmas along the left camera's axes."""

    position_mm: tuple[float, ...]
    euler_zyx_deg: tuple[float, ...]
    sigma_mm: tuple[float, ...]  # all errors together
    precision_mm: tuple[float, ...]  # the share of this shot's noise
    calibration_mm: tuple[float, ...]  # what the calibration leaves
    sigma_deg: tuple[float, ...]
    misfit: float  # how many times larger the residuals are than the noise allows
    points: int  # that both cameras saw
    ellipsoid_mm: tuple[tuple[float, ...], ...]  # (3, 3) covariance of the position, mm^2


@dataclass(frozen=True)
class RelativeShown:
    """The pose of a second body in the first one's frame, sigmas along its axes; what moves both alike cancels."""

    target: str
    reason: str | None = None  # why it was missed
    position_mm: tuple[float, ...] = ()
    euler_zyx_deg: tuple[float, ...] = ()
    sigma_mm: tuple[float, ...] = ()
    sigma_deg: tuple[float, ...] = ()
    distance_mm: tuple[float, float] | None = None  # of the origins, and its sigma


@dataclass(frozen=True)
class Scene:
    """The rig and the body for a view in space, m, left camera's frame."""

    T_left_right: tuple[tuple[float, ...], ...]
    tangents: tuple[float, float]  # half width and half height of the left camera's view, per distance
    body: tuple[tuple[float, ...], ...]  # (M, 3) the body's points; empty while it is not seen
    trail: tuple[tuple[float, ...], ...]  # the last positions of the body


@dataclass(frozen=True)
class MeasureState:
    """What a page shows of measuring."""

    rig: str | None = None
    target: str | None = None
    ready: bool = False  # rig and target are there
    missing: str = ""  # what is missing
    pose: PoseShown | None = None  # the newest
    reason: str | None = None  # why it was missed
    rate_hz: float | None = None
    latency_ms: tuple[float, float] | None = None  # p50 and p99 from an image's arrival to its pose
    age_ms: float | None = None  # of the newest pose's image when it was shown
    dropped: tuple[str, ...] = ()  # points that were left out of the newest pose, with the reason
    measured: int = 0
    missed: tuple[tuple[str, int], ...] = ()  # misses by reason
    relative: bool = False  # poses are relative to a zero
    distance_mm: tuple[float, float] | None = None  # from the mark, and its sigma
    pivot: str = ""  # state of the pivot calibration
    pivoting: bool = False  # poses for it are collected
    tip_mm: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # where the tip is now, and one sigma
    second: RelativeShown | None = None
    recording: str | None = None  # the file that is written, and how many rows
    health: tuple[str, ...] = ()  # what no longer holds
    scene: Scene | None = None
    command: str = ""  # the command line that does the same
    drawn: tuple[Drawn, ...] = ()


@dataclass(eq=False)
class _Followed:
    """A body: what it is, what measures it, and how it was measured last."""

    spec: str
    target: Target
    measure: Callable[[Shot], PoseEstimate | Missed] | None = None
    newest: tuple[LiveShot, PoseEstimate | Missed] | None = None

    def prepare(self, rig: StereoRig | None, sync_s: float) -> None:
        self.measure, self.newest = None if rig is None else measurer(rig, self.target, sync_s), None

    def points(self, pose: PoseEstimate) -> Array:
        """Return its points (M, 3) at a pose, m, left camera's frame."""
        return transform(pose.T_left_body, self.target.body.points)


class _PoseFile:
    """Poses being written: a CSV whose rows are whole, and an MCAP file beside it."""

    def __init__(self, folder: Path, rig: StereoRig, body: Body, say: Callable[[str], None]) -> None:
        number, path = 1, folder / "poses-1.csv"
        while path.exists() or path.with_suffix(".mcap").exists():
            number += 1
            path = folder / f"poses-{number}.csv"
        self.path, self.body = path, body
        made_folder(folder)
        self._file = RowFile(path, CSV_COLUMNS)
        published = Published(rig, body, None, properties(rig, None, command="live"))
        self._mcap = LazyMcap(folder, published, say, path.with_suffix(".mcap").name)

    def add(self, live: LiveShot, result: PoseEstimate | Missed) -> None:
        """Write a row; an InputError ends the recording with the rows before."""
        try:
            self._file.add(row_of(shot_pose(live.shot.name, live.shot.t_s, self.body, result)))
        except InputError:
            self.close()
            raise
        self._mcap.put(ShotDatum(live.shot, result, time.monotonic()))

    @property
    def rows(self) -> int:
        return self._file.rows

    def close(self) -> None:
        self._mcap.close()
        with contextlib.suppress(InputError):  # a full disk: what it took is whole
            self._file.close()


class MeasureStep(PageStep[MeasureState]):
    """Measures a target in live shots."""

    def __init__(self, shared: Shared) -> None:
        super().__init__(shared, MeasureState())
        self.rig: StereoRig | None = None
        self.rig_path: Path | None = None
        self._body: _Followed | None = None
        self._second: _Followed | None = None
        self._monitor: HealthMonitor | None = None
        self._zero: Array | None = None
        self._mark: tuple[Array, Array] | None = None
        self._pivot_poses: list[Array] | None = None
        self._tip: Pivot | None = None
        self._recording: _PoseFile | None = None
        self._streams = open_streams((), Published(), self.warn)
        self._clear()

    def _clear(self) -> None:
        self._trail: deque[Array] = deque(maxlen=240)
        self._times: deque[float] = deque(maxlen=30)
        self._latency: deque[float] = deque(maxlen=600)
        self._missed: Counter[str] = Counter()
        self._recent: deque[tuple[float, PoseEstimate]] = deque(maxlen=12)  # for a mean
        self._health_s = 0.0
        self._notes = HealthNotes()
        self.show(measured=0, health=())

    @property
    def target_spec(self) -> str | None:
        """Spec or file of the target."""
        return None if self._body is None else self._body.spec

    @property
    def newest(self) -> tuple[LiveShot, PoseEstimate | Missed] | None:
        """The newest shot with its pose; None before."""
        return None if self._body is None else self._body.newest

    @property
    def followed(self) -> bool:
        """Whether the body that is measured can be followed from shot to shot."""
        return self._body is not None and follows(self._body.target)

    def use_rig(self, rig: StereoRig | None, path: Path | None) -> None:
        """Measure with a rig from now on; with none nothing is measured."""
        with self.lock:
            self.rig, self.rig_path = rig, path
            self._prepare()

    def use_target(self, spec: str) -> None:
        """Measure another target from now on."""
        body = _Followed(spec, open_target(spec))
        with self.lock:
            self._body = body
            self._prepare()

    @asked("measuring")
    def use_second_body(self, target: str) -> None:
        """Measure a second body too, and each relative to the other; an empty ``target`` ends it."""
        if target and target == self.target_spec:
            raise InputError(f"{target} is measured already: the second body must be another one")
        second = _Followed(target, open_target(target)) if target else None
        with self.lock:
            self._second = second
            if second is not None:
                second.prepare(self.rig, self.shared.options.sync_s)

    def _prepare(self) -> None:
        self._clear()
        self._streams.close()
        sync_s, rig, body = self.shared.options.sync_s, self.rig, self._body
        for each in (body, self._second):
            if each is not None:
                each.prepare(rig, sync_s)
        if rig is None or body is None:
            return
        self._monitor = HealthMonitor(rig, body.target.body, sync_s, printed=is_print(body.target))
        try:
            about = Published(rig, body.target.body, properties={"command": "live"}, hold=self.shared.hold)
            self._streams = open_streams(self.shared.options.streams, about, self.warn)
        except InputError as error:
            self.say("error", str(error))

    def look(self, live: LiveShot) -> None:
        """Measure a live shot. Called from one thread."""
        for body in (self._body, self._second):
            work = None if body is None else body.measure
            if body is None or work is None:
                continue
            result = work(live.shot)
            with self.lock:
                if body.measure is not work:  # another rig or target was chosen meanwhile
                    continue
                if body is self._body:
                    self.take(live, result)
                else:
                    body.newest = live, result

    def take(self, live: LiveShot, result: PoseEstimate | Missed) -> None:
        """Take in what was measured in a shot, here or in a control loop."""
        now = time.monotonic()
        with self.lock:
            if self._monitor is None or self._body is None:
                return
            if isinstance(result, PoseEstimate):
                result = self._monitor.measured(result, live.shot.t_s)
                self._trail.append(result.T_left_body[:3, 3])
                self._recent.append((now, result))
                self.show(measured=self.shown.measured + 1)
                if self._pivot_poses is not None:
                    self._pivot_poses.append(result.T_left_body)
            else:
                count(self._missed, result.reason)
            self._times.append(now)
            self._latency.append(1e3 * (now - live.arrived_s))
            self._body.newest = live, result
            self._write(live, result)
            self._streams.put(ShotDatum(live.shot, result, now))
            if now - self._health_s > 1.0:
                findings = self._monitor.findings(ends=False)
                self.show(health=tuple(found.line() for found in findings))
                for note in self._notes.of(now, findings):
                    self._streams.put(note)
                self._health_s = now + _HEALTH_REST * (time.monotonic() - now)

    def lately(self, within_s: float) -> list[PoseEstimate]:
        """Return the newest poses of the last so many seconds, oldest first."""
        now = time.monotonic()
        with self.lock:
            return [pose for at, pose in self._recent if now - at < within_s]

    @property
    def why_missed(self) -> str:
        """Why no pose is measured now; empty where one is."""
        newest = self.newest
        if newest is None:
            return self.lacking or "no pose is measured yet"
        return f"no pose is measured now: {newest[1].reason}" if isinstance(newest[1], Missed) else ""

    @asked("measuring")
    def zero(self) -> None:
        """Show poses relative to the present one from now on."""
        self._zero = inverse(self._pose().T_left_body)

    @asked("measuring")
    def clear_zero(self) -> None:
        """Show poses in the left camera's frame again."""
        self._zero = None

    @asked("measuring")
    def mark_position(self) -> None:
        """Mark the present position: distances are measured from it."""
        pose = self._pose()
        self._mark = np.array(pose.T_left_body[:3, 3]), left_axes(pose.T_left_body, pose.cov_noise)[:3, :3]

    @asked("measuring")
    def pivot_tip(self) -> None:
        """Collect poses for the calibration of a tip that stands still; a second time: compute it."""
        with self.lock:
            if self._pivot_poses is None:
                self._pose()
                self._pivot_poses = []
                self.show(pivot="")
                return
            poses, self._pivot_poses = self._pivot_poses, None
        if len(poses) < MIN_POSES:
            raise InputError(f"{len(poses)} poses are too few for a pivot calibration; 30 and more are advised")
        found = self._tip = calibrate_pivot(np.array(poses))
        sigma, held = 1e3 * np.sqrt(np.trace(found.cov[:3, :3])), 1e3 * np.sqrt(np.nanmean(found.held_out_m**2))
        at = ", ".join(f"{1e3 * x:.2f}" for x in found.p_body)
        text = f"tip at {at} mm in the body, sigma {sigma:.2g} mm; held out {held:.2g} mm RMS, {len(poses)} poses"
        self.show(pivot=text)

    @asked("measuring")
    def record_poses(self) -> None:
        """Write every measured pose to a new CSV file, and an MCAP file beside it; a second time: stop."""
        with self.lock:
            recording, self._recording = self._recording, None
            if recording is not None:
                recording.close()
                self.say("good", f"{recording.rows} poses written to {recording.path}")
            elif self.rig is None or self._body is None:
                raise InputError(self.lacking)
            else:
                self._recording = _PoseFile(self.folder, self.rig, self._body.target.body, self.warn)

    def _write(self, live: LiveShot, result: PoseEstimate | Missed) -> None:
        if (recording := self._recording) is None:
            return
        try:
            recording.add(live, result)
        except InputError as error:
            self._recording = None
            why = f"the recording has ended: {error}; it holds {recording.rows} poses"
            self.say("error", why)

    def close(self) -> None:
        """Close the recording and the streams."""
        super().close()
        with self.lock:
            if self._recording is not None:
                self._recording.close()
            self._streams.close()

    def _pose(self) -> PoseEstimate:
        newest = self.newest
        if newest is None or isinstance(newest[1], Missed):
            raise InputError(self.why_missed)
        return newest[1]

    @property
    def lacking(self) -> str:
        """What is missing to measure; empty where nothing is."""
        if self.rig is None:
            return "no calibrated rig yet: finish the calibration first, or give --rig"
        return "" if self._body is not None else "no body yet: choose one in the step Body"

    def now(self) -> MeasureState:
        """Return what is shown, with the newest pose."""
        path, rig, body = self.rig_path, self.rig, self._body
        shown = replace(self.shown, rig=None if path is None else str(path), target=self.target_spec)
        if rig is None or body is None:
            return replace(shown, missing=self.lacking)
        newest, p_body = body.newest, np.zeros((0, 3))
        if newest is not None:
            live, result = newest
            shown = replace(shown, age_ms=1e3 * live.age_s(time.monotonic()), second=self._relative(rig, newest))
            if isinstance(result, PoseEstimate):
                p_body = body.points(result)
                shown = replace(
                    shown,
                    pose=shown_pose(result, self._zero),
                    dropped=tuple(f"{each.point}: {each.reason}" for each in result.dropped),
                    distance_mm=self._distance(result),
                    tip_mm=self._tip_now(result),
                    drawn=self._drawings(rig, live, result),
                )
            else:
                shown = replace(shown, reason=result.reason)
        latency = np.percentile(list(self._latency), (50, 99)).tolist() if self._latency else None
        span = self._times[-1] - self._times[0] if len(self._times) > 2 else 0.0
        recording, source = self._recording, self.shared.source
        command = f"armsight measure {path} --target {body.spec} --source {source} -o poses.csv"
        if self.shared.simulated is not None:  # no camera: the workcell is measured by a run
            command = f"armsight run --rig {path} --target {body.spec} --source {source} --board emulated: -o run"
        if latency is not None:
            shown = replace(shown, latency_ms=(latency[0], latency[1]))
        if (pivoting := self._pivot_poses) is not None:
            shown = replace(shown, pivot=_pivoting(pivoting), pivoting=True)
        if recording is not None:
            shown = replace(shown, recording=f"{recording.path.name}: {recording.rows} poses")
        rate_hz, missed = (len(self._times) - 1) / span if span > 0 else None, tuple(self._missed.most_common(5))
        shown = replace(shown, rate_hz=rate_hz, missed=missed, relative=self._zero is not None)
        return replace(shown, ready=True, scene=self._scene(rig, p_body), command=command)

    def _distance(self, pose: PoseEstimate) -> tuple[float, float] | None:
        """Return the distance from the mark and its sigma by the noise of both poses, mm."""
        if self._mark is None:
            return None
        marked, cov = self._mark
        away = pose.T_left_body[:3, 3] - marked
        return _length_mm(away, cov + left_axes(pose.T_left_body, pose.cov_noise)[:3, :3])

    def _tip_now(self, pose: PoseEstimate) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        if self._tip is None:
            return None
        p, R = self._tip.p_body, pose.T_left_body[:3, :3]
        T = pose.T_left_body if self._zero is None else self._zero @ pose.T_left_body
        J = R @ np.hstack([np.eye(3), -skew(p)])
        cov = J @ pose.cov @ J.T + R @ self._tip.cov[:3, :3] @ R.T
        return _mm(transform(T, p)), _mm(np.sqrt(np.diag(cov)))

    def _scene(self, rig: StereoRig, body: Array) -> Scene:
        (width, height), (fx, fy) = rig.left.image_size_px, rig.left.intrinsics[:2]
        trail = np.array(self._trail).reshape(-1, 3)
        T, p, way = (tuple(map(tuple, each.tolist())) for each in (rig.T_left_right, body.round(5), trail.round(5)))
        return Scene(T, (0.5 * width / float(fx), 0.5 * height / float(fy)), p, way)

    def _drawings(self, rig: StereoRig, live: LiveShot, pose: PoseEstimate) -> tuple[Drawn, ...]:
        assert self._body is not None
        T, second = pose.T_left_body, self._second
        drawn = dots("body", rig.project(transform(T, self._body.target.body.points[pose.points.seen.ids])))
        ends = rig.project(transform(T, np.vstack([np.zeros(3), _AXIS_M * np.eye(3)])))
        axes = (Drawn(s, f"axis{k}", (polyline(uv[[0, k + 1]]),)) for s, uv in enumerate(ends) for k in range(3))
        drawn = (*drawn, *axes)
        if second is None or second.newest is None or isinstance(second.newest[1], Missed):
            return drawn
        near = abs(second.newest[0].number - live.number) <= 1
        return (*drawn, *dots("second", rig.project(second.points(second.newest[1])))) if near else drawn

    def _relative(self, rig: StereoRig, first: tuple[LiveShot, PoseEstimate | Missed]) -> RelativeShown | None:
        if self._second is None:
            return None
        (live, pose), spec, newest = first, self._second.spec, self._second.newest
        if newest is None:
            return RelativeShown(spec, "no shot yet")
        if isinstance(pose, Missed):
            return RelativeShown(spec, "the first body is not seen")
        if isinstance(newest[1], Missed):
            return RelativeShown(spec, newest[1].reason)
        if abs(newest[0].number - live.number) > 1:
            return RelativeShown(spec, "not measured while the arm moves")
        T, cov = relative_pose(rig, pose, newest[1])
        cov = left_axes(T, cov)
        angles = tuple(np.degrees(euler_zyx(T[:3, :3])[0]).tolist())
        distance = _length_mm(T[:3, 3], cov[:3, :3])
        return RelativeShown(spec, None, _mm(T[:3, 3]), angles, *_sigmas(cov), distance)


def shown_pose(pose: PoseEstimate, T_zero_left: Array | None) -> PoseShown:
    """Return a pose as people read it; relative to a zero where one is given."""
    whole, noise = left_axes(pose.T_left_body, pose.cov), left_axes(pose.T_left_body, pose.cov_noise)
    shown = pose.T_left_body if T_zero_left is None else T_zero_left @ pose.T_left_body
    (sigma_mm, sigma_deg), ellipsoid = _sigmas(whole), tuple(map(tuple, (1e6 * whole[:3, :3]).tolist()))
    angles = tuple(np.degrees(euler_zyx(shown[:3, :3])[0]).tolist())
    calibration = _mm(np.sqrt(np.maximum(np.diag(whole - noise), 0.0)[:3]))
    sigmas = sigma_mm, _sigmas(noise)[0], calibration, sigma_deg
    return PoseShown(_mm(shown[:3, 3]), angles, *sigmas, pose.misfit, len(pose.points.ids), ellipsoid)


def _sigmas(cov: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    sigma = np.sqrt(np.diag(cov))
    return _mm(sigma[:3]), tuple(np.degrees(sigma[3:]).tolist())


def _length_mm(p: Array, cov: Array) -> tuple[float, float]:
    """Return the length of a vector (3,), m, with covariance (3, 3), and its sigma, mm."""
    size = float(np.linalg.norm(p))
    u = p / size if size > 0 else np.array([0.0, 0.0, 1.0])
    return 1e3 * size, 1e3 * float(np.sqrt(u @ cov @ u))


def _mm(values: Array) -> tuple[float, ...]:
    return tuple((1e3 * values).tolist())


def relative_pose(rig: StereoRig, first: PoseEstimate, second: PoseEstimate) -> tuple[Array, Array]:
    """Return T_first_second (4, 4), m, of two bodies in one shot, and its covariance (6, 6), right tangent [m; rad].

    The noise of both adds up; what the calibration does to both alike cancels.
    """
    T = inverse(first.T_left_body) @ second.T_left_body
    Ad = adjoint(inverse(T))
    D = by_rig(second) - Ad @ by_rig(first)
    return T, second.cov_noise + Ad @ first.cov_noise @ Ad.T + D @ rig.cov @ D.T


def _pivoting(Ts: list[Array]) -> str:
    """Return what to do while poses (4, 4) are collected about a tip, and how far the body was rotated."""
    R = np.array(Ts).reshape(-1, 4, 4)[:, :3, :3]
    cosines = (np.einsum("ij,nij->n", R[0], R) - 1.0) / 2.0 if len(R) else np.ones(1)
    far = np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0)))
    how = "keep the tip where it is, and rotate the body about it by 30 degrees, all ways"
    return f"{len(R)} poses, rotated by up to {far:.0f} degrees: {how}"
