"""The workcell's two cameras as a source of shots: when they expose, when their images arrive, where they stand.

Reading lets the workcell's time pass. Shot k is exposed about ``phase + k / rate``; the right camera by ``skew`` later,
give or take ``sync``. An image arrives ``delay`` after its exposure has ended, and is stamped then, give or take
``jitter``. Everything about shot k follows from the seed and k alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Image, Shot
from armsight.errors import DeviceError, InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.processes import Process
from armsight.robot.boards.link import TICK_S
from armsight.robot.kinematics.arm import Arm
from armsight.sim.camera.pipeline import SimulatedCamera
from armsight.sim.camera.stages import CameraPipeline, preset_names
from armsight.sim.example_rig import example_rig
from armsight.sim.render.optics import Radiance, noise_start, noise_strip
from armsight.sim.render.render import Shutter, outline
from armsight.sim.render.scene import Pattern, PosedBody, plate
from armsight.sim.workcell.controlled import ControlledArm
from armsight.sim.workcell.images import ArmSeen, LedSeen, WorkcellCamera
from armsight.sim.workcell.motors import Solids, row_frames
from armsight.sim.workcell.plant import ArmPlant
from armsight.sim.workcell.raycast import arm_capsules, capsule_boxes
from armsight.vision.rig import StereoRig
from armsight.vision.sources import Source

_FORM = "WIDTHxHEIGHT@HZ, NAME or NAME:WIDTHxHEIGHT@HZ; such as 1280x720@60 or webcams:640x480@30"
#: Focal length over the image's width: 900 px at 1280.
_FOCAL = 900 / 1280
_WIDTHS, _RATES = (320, 3840), (1.0, 500.0)
_OPEN_AT_MOST = 0.95  # share of the period that a camera with a pipeline exposes
_SETTLED = 5  # images of what stands still before a camera's gain and temporal filter have settled
#: Where the cameras' middle is, seen from where the body is at home: distance, m; to the side and up, degrees.
DISTANCE_M, ASIDE_DEG, ABOVE_DEG = 0.85, 14.0, 12.0
_AIM_M = 0.10  # they aim at a point so far behind the body, at home: the arm works there
BASELINE_M = 0.2


@dataclass(frozen=True)
class CameraTiming:
    """The timing of two cameras, s; a row is exposed for ``exposure_s``, ``row_s`` after the one above.

    ``delay_s``: from the end of the exposure until the image has arrived; ``jitter_s``: sigma of the stamp, beside the
    arrival; the exposures of both begin ``sync_s`` apart at most, by chance, the right one always by ``skew_s`` later.
    """

    image_size_px: tuple[int, int] = (1280, 720)
    rate_hz: float = 60.0
    exposure_s: float = 0.002
    delay_s: float = 0.012
    jitter_s: float = 5e-5
    sync_s: float = 1e-4
    skew_s: float = 0.0
    row_s: float = 0.0

    @property
    def shutter(self) -> Shutter:
        """How each camera exposes."""
        return Shutter(self.exposure_s, self.row_s)


WEBCAMS = CameraTiming((1280, 720), 30.0, 0.008, 0.040, 1e-3, 5e-4, 4e-3, 2e-5)


@dataclass(frozen=True)
class ShotTimes:
    """When a shot was exposed, middle row of both cameras, and when the driver says that it came, s, and hands it out."""

    left_s: float
    right_s: float
    stamp_s: float


@lru_cache(maxsize=256)
def shot_times(timing: CameraTiming, seed: int, shot: int) -> ShotTimes:
    """Return the times of a shot, counted from 0."""
    phase = np.random.default_rng([seed, 6]).uniform(0.0, 1.0)
    rng = np.random.default_rng([seed, 7, shot])
    left = (phase + shot) / timing.rate_hz + timing.exposure_s / 2
    apart = timing.skew_s + rng.uniform(-timing.sync_s, timing.sync_s)
    late = timing.exposure_s / 2 + timing.delay_s + timing.jitter_s * float(np.clip(rng.standard_normal(), -3, 3))
    return ShotTimes(left, left + apart, left + max(late, timing.exposure_s / 2))


def open_cameras(spec: str) -> tuple[CameraTiming, CameraPipeline | None]:
    """Return the timing of a user's ``[NAME:]WIDTHxHEIGHT@HZ``, and what lies between light and file, None for white noise.

    A name is ``webcams``, a preset of :class:`~armsight.sim.camera.stages.CameraPipeline`, or a TOML file of its
    stages. InputError: of another form, an unknown name, a bad file, or out of range.
    """
    name, size_rate = camera_name(spec)
    pipeline, base = None, WEBCAMS if name == "webcams" else CameraTiming()
    if name not in ("webcams", "clean") and (name or size_rate is None):
        if name not in preset_names() and not name.endswith(".toml"):
            known = ", ".join(("webcams", *preset_names()))
            raise InputError(f"cameras {spec!r}: expected {_FORM}; a NAME is one of {known}, or a TOML file")
        pipeline = CameraPipeline.load(name)
        base = _timing(pipeline)
    if size_rate is None:
        return base, pipeline
    width, height, rate = size_rate
    if not _WIDTHS[0] <= width <= _WIDTHS[1] or not 240 <= height <= width:
        raise InputError(
            f"cameras {spec!r}: images must be {_WIDTHS[0]} to {_WIDTHS[1]} px wide, 240 px to the width high"
        )
    if not _RATES[0] <= rate <= _RATES[1]:
        raise InputError(f"cameras {spec!r}: the rate must be {_RATES[0]:g} to {_RATES[1]:g} Hz")
    exposure = min(base.exposure_s, (_OPEN_AT_MOST if pipeline else 0.5) / rate)
    timing = replace(
        base, image_size_px=(width, height), rate_hz=rate, exposure_s=exposure, row_s=base.row_s * 720 / height
    )
    return timing, None if pipeline is None else pipeline.exposed_for(exposure)


def camera_name(spec: str) -> tuple[str, tuple[int, int, float] | None]:
    """Return the name in what a user asks for, empty where there is none, and width, height and rate, None without."""
    text = spec.strip()
    match = re.fullmatch(r"(?:(.+):)?(\d+)x(\d+)@(\d+(?:\.\d+)?)", text)
    return (text, None) if match is None else (match[1] or "", (int(match[2]), int(match[3]), float(match[4])))


def _timing(pipeline: CameraPipeline) -> CameraTiming:
    """Return a preset's timing, at 1280 x 720."""
    given = pipeline.timing
    if given is None:
        return CameraTiming()
    shutter = pipeline.shutter(720)
    delay, jitter, sync, skew = (1e-3 * ms for ms in (given.delay_ms, given.jitter_ms, given.sync_ms, given.skew_ms))
    return CameraTiming((1280, 720), given.rate_hz, shutter.exposure_s, delay, jitter, sync, skew, shutter.row_s)


#: Name -> by how much the right camera is rotated to the left one's axis, as a share of what would make them look at one
#: point DISTANCE_M away; parallel cameras are parallel to a fraction of a degree, as mounts are.
RIGS = {"parallel": 0.02, "verging": 1.0}


def open_rig(name: str, size: tuple[int, int], baseline_m: float = BASELINE_M) -> StereoRig:
    """Return the true cameras of a preset, a key of RIGS, with images of a size, px; else InputError."""
    if name not in RIGS:
        raise InputError(f"rig {name!r} is unknown; known are {', '.join(RIGS)}")
    if not 0.02 <= baseline_m <= 1.0:
        raise InputError(f"baseline_m is {baseline_m}; the cameras must be 0.02 to 1 m apart")
    rotation_deg = RIGS[name] * float(np.degrees(np.arctan2(baseline_m, DISTANCE_M)))
    return example_rig(size, _FOCAL * size[0], baseline_m, rotation_deg)


def rig_pose(model: Arm, rig: StereoRig, T_tool_body: Array, seed: int, distance_m: float = DISTANCE_M) -> Array:
    """Return where the rig's left camera stands, T_base_rig (4, 4), m: it looks at the body of an arm at home.

    ``model``: the nominal arm; ``T_tool_body``: (4, 4) where the body is on the tool, m; ``seed``: nobody mounts cameras to
    the millimetre; ``distance_m``: from the cameras to the body of an arm at home. Raises InputError: cameras cannot stand
    at this distance.
    """
    if not 0.3 <= distance_m <= 3.0:
        raise InputError(f"distance_m is {distance_m}; the cameras must be 0.3 to 3 m from the body")
    T_base_tool = model.forward(model.home)
    p_body = (T_base_tool @ T_tool_body)[:3, 3]
    ahead = T_base_tool[:3, 2]
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    across = np.cross(ahead, up)
    across /= np.linalg.norm(across)
    aside, above = np.radians((ASIDE_DEG, ABOVE_DEG))
    level = np.cross(up, across) if ahead @ np.cross(up, across) > 0 else -np.cross(up, across)
    towards = np.cos(above) * (np.cos(aside) * level + np.sin(aside) * across) + np.sin(above) * up
    z = p_body - _AIM_M * level - (p_body + distance_m * towards)
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T_base_middle = pose(np.column_stack([x, np.cross(z, x), z]), p_body + distance_m * towards)
    T_middle_left = pose(np.eye(3), -0.5 * rig.T_left_right[:3, 3])
    off = np.random.default_rng([seed, 8]).normal(0, 1, 6) * np.repeat((0.004, np.radians(0.4)), 3)
    return np.asarray(T_base_middle @ T_middle_left @ exp_se3(off))


#: The sync LED: its radius, m, and its light, as of a reflectance; where it is, seen from the left camera, over the
#: distance from the cameras to the body of an arm at home.
_LED, LED_AT = (0.004, 0.5), (-0.40, 0.33, 1.25)
#: The body is within so far of its origin, m.
_BODY_M = 0.12
#: A card that is held before the body: its sides, m; how far before it, m; its grey.
_CARD_M, _CARD_BEFORE_M, _CARD_GREY = (0.34, 0.30), 0.08, 0.55
#: So many ticks after an exposure the path is there on both sides of all its times.
_SPARE_TICKS = 2
#: Where the path is looked at within an exposure: its mean is the body's position in the image.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


class _Exposed(NamedTuple):
    """What is before a camera in an exposure with its middle at t_s, s.

    ``number``: of the shot, below zero where something is held before the cameras for the calibration; ``first``: the
    millisecond of the first row of ``q`` (M, n), the links' true angles about the exposure, rad; ``covered``: a card is
    held before it; ``held``: what else is, left camera's frame.
    """

    number: int
    t_s: float
    shutter: Shutter
    first: int
    q: Array
    covered: bool
    held: PosedBody | None
    led: LedSeen | None


class _OneCamera:
    """One of the two cameras (side 0 left, 1 right): what is before it becomes an image."""

    def __init__(
        self,
        side: int,
        cameras: tuple[WorkcellCamera, WorkcellCamera],
        arm: Arm,
        parts: Solids,
        body: tuple[tuple[Pattern, ...], Array],
        seed: int,
        pipeline: CameraPipeline | None,
    ) -> None:
        self._side, self._camera, self._arm, self._parts, self._seed = side, cameras[side], arm, parts, seed
        self._patterns, self._T_tool_body = body
        size = self._camera.camera.image_size_px
        self._T_this_left = inverse(self._camera.T_base_camera) @ cameras[0].T_base_camera
        self._strip = noise_strip(seed, size) if pipeline is None else None
        self._device = None if pipeline is None else SimulatedCamera(pipeline, size, 2 * seed + side)

    def __call__(self, seen: _Exposed) -> Image:
        """Return the image (H, W) of an exposure, uint8."""
        body = self._body(seen)
        bodies = [body]
        if seen.held is not None:
            bodies.append(seen.held.seen_from(self._T_this_left))
        if seen.covered:
            bodies.append(_card(body.T_camera_body))
        arm = ArmSeen(self._parts, row_frames(self._arm, _q(seen, np.array([seen.t_s]))[0]))
        if self._strip is None:
            return self._through(self._camera.radiance(arm, bodies, seen.shutter, seen.led), seen.t_s, seen.number)
        # A shot for the calibration takes its noise from numbers of its own.
        start = noise_start(self._seed, self._side + (0 if seen.number >= 0 else 2), abs(seen.number))
        return self._camera.image(arm, bodies, seen.shutter, self._strip, start, seen.led)

    def _body(self, seen: _Exposed) -> PosedBody:
        """Return the body as the camera sees it: its mean pose during the exposure of its own rows, and its velocity."""
        T_camera_base = inverse(self._camera.T_base_camera)
        shutter, camera = seen.shutter, self._camera.camera

        def at(t_s: Array) -> Array:
            """Return the poses (N, 4, 4) at times (N,)."""
            return np.asarray(T_camera_base @ self._arm.forward(_q(seen, t_s)) @ self._T_tool_body)

        reach, rows_s = max(shutter.exposure_s, TICK_S) / 2, 0.0
        if shutter.row_s:  # its rows are exposed at another time than the image's middle row
            row = camera.project(at(np.array([seen.t_s]))[:, :3, 3])[0, 1]
            rows_s = shutter.row_s * float(row - (camera.image_size_px[1] - 1) / 2)
        Ts = at(seen.t_s + rows_s + reach * np.array([*_NODES, -1.0, 1.0]))
        moved = log_se3(inverse(Ts[[1, 1, 1, 3]]) @ Ts[[0, 1, 2, 4]])
        twist = moved[3] / (2 * reach)
        shift = 0.5 * (_WEIGHTS @ moved[:3]) if shutter.exposure_s else np.zeros(6)
        to_mean, to_row = exp_se3(np.stack([shift, -rows_s * twist]))
        return PosedBody(self._patterns, Ts[1] @ to_mean @ to_row, twist)

    def _through(self, light: Radiance, t_s: float, number: int) -> Image:
        """Return what a camera makes of the light; a board that is held still has been there for some images."""
        device = self._device
        assert device is not None
        if number >= 0:
            return device.expose(light, t_s, number)
        device.forget()
        first = 2**40 - _SETTLED * number  # noise of numbers of its own
        return [device.expose(light, t_s, first + k) for k in range(_SETTLED)][-1]


def _q(seen: _Exposed, t_s: Array) -> Array:
    """Return the links' true angles (N, n) at times (N,), by a cubic through the four nearest milliseconds."""
    count = seen.first + len(seen.q)
    at = np.clip(t_s / TICK_S, 0.0, count - 1.0)
    first = np.clip(np.floor(at).astype(int) - 1, 0, max(count - 4, 0))
    x = (at - first)[:, None]
    p = [seen.q[np.minimum(first + k, count - 1) - seen.first] for k in range(4)]
    weights = (
        -(x - 1) * (x - 2) * (x - 3) / 6,
        x * (x - 2) * (x - 3) / 2,
        -x * (x - 1) * (x - 3) / 2,
        x * (x - 1) * (x - 2) / 6,
    )
    return np.asarray(sum(w * q for w, q in zip(weights, p, strict=True)))


class WorkcellSource(Source):
    """The workcell's cameras.

    Fulfils :class:`armsight.vision.source.Source`: ``read`` waits for the next shot, in the workcell's time.
    """

    count: int | None = None

    def __init__(
        self,
        plant: ArmPlant | ControlledArm,
        cameras: tuple[WorkcellCamera, WorkcellCamera],
        timing: CameraTiming,
        body: tuple[tuple[Pattern, ...], Array],
        clock: tuple[Callable[[], float], Callable[[float], None]],
        seed: int,
        pipeline: CameraPipeline | None = None,
        led: tuple[Array, bytearray] | None = None,
        *,
        processes: bool = False,
    ) -> None:
        """Point the cameras at the arm.

        Args:
            plant: the arm.
            cameras: left and right.
            timing: when they look.
            body: the patterns on the tool, and T_tool_body (4, 4), m.
            clock: returns the workcell's time, s; lets so many seconds of it pass.
            seed: of noise and timing.
            pipeline: what lies between light and file; white noise by default.
            led: where the sync LED is (3,), m, base frame, and whether it is on in each millisecond; None without one.
            processes: whether each camera's images are rendered in a process of its own.
        """
        self._plant, self._cameras, self._timing, self._seed = plant, cameras, timing, seed
        self._now, self._advance = clock
        _, self._T_tool_body = body
        self._next = 0
        self._begun: dict[int, list[Future[Image]]] = {}
        self._over_s = self._over(0)
        plant.stepped = self._render_ahead
        self._covers: list[tuple[float, float]] = []
        self._gone_s, self._gone = np.inf, ""
        #: A thread for each side: a camera that remembers its images exposes them one after the other.
        self._threads = (ThreadPoolExecutor(1), ThreadPoolExecutor(1))
        self._led = None if led is None else ([camera.led(led[0], *_LED) for camera in cameras], led[1])
        given = (cameras, plant.arm, plant.parts, body, seed, pipeline)
        self._sides = [
            Process(_OneCamera, side, *given) if processes else _OneCamera(side, *given) for side in range(2)
        ]
        #: Name of each shot that was handed out -> when it was taken, for evaluation only.
        self.taken: dict[str, ShotTimes] = {}

    def cover(self, from_s: float, to_s: float) -> None:
        """Hold a card before the body from one time to another."""
        self._covers.append((from_s, to_s))

    def unplug(self, at_s: float, what: str = "left camera: no frame for 5 s: unplugged or stalled") -> None:
        """Let the cameras be gone from a time on: what is read then raises DeviceError with this text."""
        self._gone_s, self._gone = at_s, what

    def read(self) -> Shot | None:
        """Return the newest shot that has come, or wait for the next."""
        shot = self.poll()
        if shot is None:
            wait_s = min(self._times(self._next).stamp_s, self._gone_s) - self._now()
            self._advance(max(np.ceil(wait_s / TICK_S - 1e-9), 0.0) * TICK_S)
            shot = self.poll()
        return shot

    def poll(self) -> Shot | None:
        """Return the newest shot that has come and was not handed out yet; None where there is none. No time passes."""
        now = self._now()
        if now >= self._gone_s - 1e-9:
            raise DeviceError(self._gone)
        newest = self._next - 1
        start = max(self._next, int((now - self._timing.delay_s) * self._timing.rate_hz) - 2)
        for k in range(start, start + 5):
            if self._times(k).stamp_s <= now + 1e-9:
                newest = k
        shot = None
        if newest >= self._next:
            self._next, self._over_s = newest + 1, np.inf  # an emergency stop may let time pass while this waits
            shot = self._shot(newest)
            self._over_s = self._over(self._next)
        return shot

    @property
    def shows_led(self) -> bool:
        """Whether the sync LED is in view."""
        return self._led is not None

    @property
    def rendering(self) -> bool:
        """Whether the next shot's images are being rendered: a poll may have to wait for them."""
        begun = self._begun.get(self._next)
        return begun is not None and not all(image.done() for image in begun)

    def close(self) -> None:
        """End the threads, and the processes."""
        for thread, side in zip(self._threads, self._sides, strict=True):
            thread.shutdown()
            if isinstance(side, Process):
                side.close()

    def clear(self, pattern: Pattern, T_left_body: Array, *, body_seen: bool = False) -> bool:
        """Return whether nothing of the arm is before, or in, a pattern held at T_left_body (4, 4), m, for both cameras.

        ``body_seen``: the pattern must not be before the arm's body either.
        """
        q = self._plant.path[-1, self._plant.arm.joints :]
        p_body = (self._plant.arm.forward(q) @ self._T_tool_body)[:3, 3]
        edge = np.column_stack([outline(pattern), np.zeros(len(outline(pattern)))])
        for camera in self._cameras:
            T_camera_base = inverse(camera.T_base_camera)
            ends, radius, _ = arm_capsules(self._plant.parts, row_frames(self._plant.arm, q), camera.T_base_camera)
            ball = np.tile(transform(T_camera_base, p_body), (1, 2, 1))
            ends, radius = np.concatenate([ends, ball]), np.append(radius, _BODY_M)
            p = transform(T_camera_base @ self._cameras[0].T_base_camera @ T_left_body @ pattern.T_body_pattern, edge)
            uv, boxes = camera.camera.project(p), capsule_boxes(camera.camera, ends, radius)
            over = (boxes[:, :2] < uv.max(axis=0)).all(axis=1) & (boxes[:, 2:] > uv.min(axis=0)).all(axis=1)
            if (over & (ends[..., 2].min(axis=1) - radius < p[:, 2].max())).any() or (body_seen and over[-1]):
                return False
        return True

    def still(self, patterns: tuple[Pattern, ...], T_left_body: Array, number: int) -> Shot:
        """Return a shot of flat patterns held at T_left_body (4, 4), m, while the arm stands; noise by ``number``."""
        now = ShotTimes(self._now(), self._now(), self._now())
        left, right = self._rendering(now, Shutter(), -1 - number, PosedBody(patterns, T_left_body))
        return Shot(f"{number:03d}", left.result(), right.result(), now.stamp_s)

    def _times(self, shot: int) -> ShotTimes:
        return shot_times(self._timing, self._seed, shot)

    def _shot(self, number: int) -> Shot:
        times, name = self._times(number), f"{number:06d}"
        left, right = self._begun.pop(number, None) or self._rendering(times, self._timing.shutter, number, None)
        self.taken[name] = times
        return Shot(name, left.result(), right.result(), times.stamp_s)

    def _render_ahead(self) -> None:
        """Begin with the next shot's images as soon as both exposures are over, while they are still on their way."""
        if self._plant.t_s < self._over_s:
            return
        times, self._over_s = self._times(self._next), np.inf
        if self._now() < times.stamp_s:
            self._begun = {self._next: self._rendering(times, self._timing.shutter, self._next, None)}

    def _over(self, shot: int) -> float:
        """Return when both exposures of a shot are over and the path about them is known, s."""
        times = self._times(shot)
        return max(times.left_s, times.right_s) + self._seen_s() / 2 + (_SPARE_TICKS - 1e-6) * TICK_S

    def _seen_s(self) -> float:
        """Return how long an image looks from its first row's beginning to its last row's end, s."""
        return self._timing.exposure_s + self._timing.row_s * self._timing.image_size_px[1]

    def _rendering(
        self, times: ShotTimes, shutter: Shutter, number: int, held: PosedBody | None
    ) -> list[Future[Image]]:
        """Begin to render both images, each in a thread of its own: they share nothing that changes."""
        path, n, begin = self._plant.path, self._plant.arm.joints, self._plant.travelled.begin

        def seen(side: int, t_s: float) -> _Exposed:
            first = max(int((t_s - self._seen_s()) / TICK_S) - _SPARE_TICKS, 0)
            first = begin + min(max(first - begin, 0), max(len(path) - 4, 0))
            covered = any(start <= t_s < end for start, end in self._covers)
            led = None if held is not None else self._lit(side, t_s, shutter)
            return _Exposed(number, t_s, shutter, first, path[first - begin :, n:].copy(), covered, held, led)

        return [
            thread.submit(draw, seen(side, t_s))
            for side, (thread, draw, t_s) in enumerate(
                zip(self._threads, self._sides, (times.left_s, times.right_s), strict=True)
            )
        ]

    def _lit(self, side: int, t_s: float, shutter: Shutter) -> LedSeen | None:
        """Return the sync LED as a camera sees it in an exposure about a time, s; row by row."""
        if self._led is None:
            return None
        led, on = self._led[0][side], self._led[1]
        rows = np.arange(led.window[1], led.window[3])
        middle = t_s + shutter.row_s * (rows - (self._timing.image_size_px[1] - 1) / 2)
        half = max(shutter.exposure_s, 1e-6) / 2
        first, last = int((middle[0] - half) / TICK_S) - 1, int((middle[-1] + half) / TICK_S) + 2
        lit = np.frombuffer(bytes(on[max(first, 0) : last]), np.uint8)  # from the tick of its number on, for one
        edges = (max(first, 0) + np.arange(len(lit) + 1)) * TICK_S
        total = np.concatenate([[0.0], np.cumsum(lit) * TICK_S])
        gathered = np.interp(middle + half, edges, total) - np.interp(middle - half, edges, total)
        return led.lit(gathered / (2 * half))


def _card(T_camera_body: Array) -> PosedBody:
    """Return a card that faces the camera, before the body."""
    p = T_camera_body[:3, 3]
    z = p / np.linalg.norm(p)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    at = p - _CARD_BEFORE_M * z
    return PosedBody((plate(*_CARD_M, _CARD_GREY),), pose(np.column_stack([x, np.cross(z, x), z]), at))
