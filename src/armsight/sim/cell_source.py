"""The cell's two cameras as a source of shots: reading lets the cell's time pass."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from armsight.data import Array, Image, Shot
from armsight.errors import DeviceError
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.sim.workcell.cameras import ShotTimes, Timing, shot_times
from armsight.sim.cell_noise import noise_start, noise_strip
from armsight.sim.workcell.images import ArmSeen, CellCamera
from armsight.sim.cell_scene import arm_capsules, capsule_boxes
from armsight.sim.cell_solids import row_frames
from armsight.sim.workcell.plant import TICK_S, ArmPlant
from armsight.sim.render.render import Shutter, outline
from armsight.sim.render.scene import Pattern, Placed, plate

#: The body is within so far of its origin, m.
_BODY_M = 0.12
#: A card that is held before the body: its sides, m; how far before it, m; its grey.
_CARD_M, _CARD_BEFORE_M, _CARD_GREY = (0.34, 0.30), 0.08, 0.55
#: So many ticks after an exposure the path is there on both sides of all its times.
_SPARE_TICKS = 3
#: Where the path is looked at within an exposure: its mean is the body's place in the image.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


class CellSource:
    """The cell's cameras.

    Fulfils :class:`armsight.vision.sources.source.Source`: ``read`` waits for the next shot, in the cell's time.
    """

    def __init__(
        self,
        plant: ArmPlant,
        cameras: tuple[CellCamera, CellCamera],
        timing: Timing,
        body: tuple[tuple[Pattern, ...], Array],
        clock: tuple[Callable[[], float], Callable[[float], None]],
        seed: int,
    ) -> None:
        """Point the cameras at the arm.

        Args:
            plant: the arm.
            cameras: left and right.
            timing: when they look.
            body: the patterns on the tool, and T_tool_body (4, 4), m.
            clock: says the cell's time, s; lets so many seconds of it pass.
            seed: of noise and timing.
        """
        self._plant, self._cameras, self._timing, self._seed = plant, cameras, timing, seed
        self._now, self._advance = clock
        self._patterns, self._T_tool_body = body
        self._strip = noise_strip(seed, timing.image_size_px)
        self._next = 0
        self._begun: dict[int, list[Future[Image]]] = {}
        self._covers: list[tuple[float, float]] = []
        self._gone_s, self._gone = np.inf, ""
        self._pool = ThreadPoolExecutor(2)
        #: Name of each shot that was handed out -> when it was taken, for judging only.
        self.taken: dict[str, ShotTimes] = {}

    def cover(self, from_s: float, to_s: float) -> None:
        """Hold a card before the body from one time to another."""
        self._covers.append((from_s, to_s))

    def unplug(self, at_s: float, what: str = "left camera: no frame for 5 s: unplugged or stalled") -> None:
        """Let the cameras be gone from a time on: what is read then raises DeviceError with these words."""
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
            self._next = newest + 1
            shot = self._shot(newest)
        self._render_ahead(now)
        return shot

    def close(self) -> None:
        """Let go of the threads."""
        self._pool.shutdown()

    def clear(self, pattern: Pattern, T_left_body: Array) -> bool:
        """Tell whether nothing of the arm is before a pattern that is held somewhere, or in it, for both cameras.

        Args:
            pattern: what is held.
            T_left_body: (4, 4) where, m, left camera's frame.
        """
        q = self._plant.path[-1, 6:]
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
            if (over & (ends[..., 2].min(axis=1) - radius < p[:, 2].max())).any():
                return False
        return True

    def still(self, patterns: tuple[Pattern, ...], T_left_body: Array, number: int) -> Shot:
        """Return a shot of flat patterns that are held still before the cameras while the arm stands.

        Args:
            patterns: what is held.
            T_left_body: (4, 4) where, m, left camera's frame.
            number: of the shot; its noise follows from it.
        """
        now = ShotTimes(self._now(), self._now(), self._now())
        left, right = self._rendering(now, Shutter(), -1 - number, Placed(patterns, T_left_body))
        return Shot(f"{number:03d}", left.result(), right.result(), now.stamp_s)

    def _times(self, shot: int) -> ShotTimes:
        return shot_times(self._timing, self._seed, shot)

    def _shot(self, number: int) -> Shot:
        times, name = self._times(number), f"{number:06d}"
        left, right = self._begun.pop(number, None) or self._rendering(times, self._timing.shutter, number, None)
        self.taken[name] = times
        return Shot(name, left.result(), right.result(), times.stamp_s)

    def _render_ahead(self, now: float) -> None:
        """Begin with the next shot's images where both exposures are over, while they are still on their way."""
        times = self._times(self._next)
        over = max(times.left_s, times.right_s) + self._seen_s() / 2 + _SPARE_TICKS * TICK_S
        if self._next not in self._begun and over <= now < times.stamp_s:
            self._begun = {self._next: self._rendering(times, self._timing.shutter, self._next, None)}

    def _seen_s(self) -> float:
        """Return how long an image looks from its first row's beginning to its last row's end, s."""
        return self._timing.exposure_s + self._timing.row_s * self._timing.image_size_px[1]

    def _rendering(self, times: ShotTimes, shutter: Shutter, number: int, held: Placed | None) -> list[Future[Image]]:
        """Begin to render both images, each in a thread of its own: they share nothing that changes."""
        t_s = np.array([times.left_s, times.right_s])
        frames = [row_frames(self._plant.arm, q) for q in self._q(t_s)]
        bodies = self._bodies(t_s, shutter)
        return [
            self._pool.submit(self._image, side, float(t_s[side]), frames[side], bodies[side], shutter, number, held)
            for side in range(2)
        ]

    def _image(
        self, side: int, t_s: float, frames: Array, body: Placed, shutter: Shutter, number: int, held: Placed | None
    ) -> Image:
        """Render one camera's image of the arm in the middle of an exposure."""
        camera = self._cameras[side]
        bodies = [body]
        if held is not None:
            T_this_left = inverse(camera.T_base_camera) @ self._cameras[0].T_base_camera
            bodies.append(held.seen_from(T_this_left))
        if any(start <= t_s < end for start, end in self._covers):
            bodies.append(_card(body.T_camera_body))
        # A shot that is held for the calibration draws its noise from numbers of its own.
        start = noise_start(self._seed, side + (0 if number >= 0 else 2), abs(number))
        return camera.image(ArmSeen(self._plant.parts, frames), bodies, shutter, self._strip, start)

    def _q(self, t_s: Array) -> Array:
        """Return the links' true angles (N, 6) at times (N,), by a cubic through the four nearest milliseconds."""
        path = self._plant.path
        at = np.clip(t_s / TICK_S, 0.0, len(path) - 1.0)
        first = np.clip(np.floor(at).astype(int) - 1, 0, max(len(path) - 4, 0))
        x = (at - first)[:, None]
        p = [path[np.minimum(first + k, len(path) - 1), 6:] for k in range(4)]
        weights = (
            -(x - 1) * (x - 2) * (x - 3) / 6,
            x * (x - 2) * (x - 3) / 2,
            -x * (x - 1) * (x - 3) / 2,
            x * (x - 1) * (x - 2) / 6,
        )
        return np.asarray(sum(w * q for w, q in zip(weights, p, strict=True)))

    def _bodies(self, t_s: Array, shutter: Shutter) -> list[Placed]:
        """Return where the body is to each camera in an exposure about its time (2,).

        That is its mean place during the exposure of its own rows, and its velocity.
        """
        Ts_camera_base = np.array([inverse(camera.T_base_camera) for camera in self._cameras])[:, None]

        def at(times: Array) -> Array:
            """Return the poses (2, N, 4, 4) at times (2, N)."""
            Ts_base_tool = self._plant.arm.forward(self._q(times.ravel())).reshape(*times.shape, 4, 4)
            return np.asarray(Ts_camera_base @ Ts_base_tool @ self._T_tool_body)

        reach = max(shutter.exposure_s, TICK_S) / 2
        rows_s = np.zeros(2)
        if shutter.row_s:  # its rows are exposed at another time than the image's middle row
            for side, (camera, T) in enumerate(zip(self._cameras, at(t_s[:, None])[:, 0], strict=True)):
                row = camera.camera.project(T[None, :3, 3])[0, 1]
                rows_s[side] = shutter.row_s * float(row - (camera.camera.image_size_px[1] - 1) / 2)
        Ts = at((t_s + rows_s)[:, None] + reach * np.array([*_NODES, -1.0, 1.0]))
        turned = log_se3(inverse(Ts[:, [1, 1, 1, 3]]) @ Ts[:, [0, 1, 2, 4]])
        twists = turned[:, 3] / (2 * reach)
        shifts = 0.5 * (_WEIGHTS @ turned[:, :3]) if shutter.exposure_s else np.zeros((2, 6))
        to_mean, to_row = exp_se3(np.stack([shifts, -rows_s[:, None] * twists]))
        Ts_camera_body = Ts[:, 1] @ to_mean @ to_row
        return [Placed(self._patterns, T, twist) for T, twist in zip(Ts_camera_body, twists, strict=True)]


def _card(T_camera_body: Array) -> Placed:
    """Return a card that faces the camera, before the body."""
    p = T_camera_body[:3, 3]
    z = p / np.linalg.norm(p)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    at = p - _CARD_BEFORE_M * z
    return Placed((plate(*_CARD_M, _CARD_GREY),), pose(np.column_stack([x, np.cross(z, x), z]), at))
