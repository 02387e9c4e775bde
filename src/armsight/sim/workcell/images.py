"""One camera's images of the workcell: what stands still is kept, the arm and the body are rendered where they are.

The arm's links, capsules, are rendered anew within the pixels they can cover, at the middle of the exposure; light as in
``raycast``, with a Phong highlight. Flat patterns (the body, a board, a card) are painted exactly over it by ``faces``,
once for about every pixel they move during the exposure, and what of the arm is nearer stays before them. Then the lens's
blur, light and vignetting, noise and rounding, as in ``optics``. Noise comes from a long strip sampled once, begun
elsewhere for every image.

:func:`picture` is the workcell seen from the side, in colour: arm, body, table and the two cameras. It is for people, not
for measuring.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids, Image, Record
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, pose, transform
from armsight.kernels import kernel
from armsight.sim.render.faces import Exposure, paint_faces, palette
from armsight.sim.render.optics import Optics, Radiance, Sensor, Window, exposed_window, part_taps, shaded, spread
from armsight.sim.render.render import OUTLINE, Shutter, corner_rays, outline
from armsight.sim.render.scene import Pattern, PosedBody
from armsight.sim.workcell.controlled import ControlledArm
from armsight.sim.workcell.motors import Solids, row_frames
from armsight.sim.workcell.plant import ArmPlant
from armsight.sim.workcell.raycast import (
    AMBIENT,
    LAMP,
    LAMP_BASE,
    PLAIN,
    Light,
    StillView,
    arm_capsules,
    block,
    capsule_boxes,
    furniture,
    pixel_rays,
    view,
)
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig

#: Share of the lamp's reflection in the light.
GLOSS = 0.25
_TILE = 16  # pixels on a side that are passed over together
_BALL = 1e-12  # square of the length, m^2, of what has none: it has no sides
# Numbers of single precision, for a row is rendered in that: four times as many pixels at once.
_ZERO, _QUARTER, _HALF, _THREE_QUARTERS, _ONE, _TWO, _LEAST = (
    np.float32(number) for number in (0.0, 0.25, 0.5, 0.75, 1.0, 2.0, 1e-12)
)
_AMBIENT, _LAMP, _GLOSS = np.float32(AMBIENT), np.float32(LAMP), np.float32(GLOSS)


@kernel(nogil=True)
def _axis(a: Array, b: Array, radius: float, out: Light) -> None:
    """Write into out (14,) what of a capsule between a and b :func:`_side` and :func:`_row` ask for: all but the ray."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    out[0], out[1], out[2] = bx, by, bz
    out[3] = max(bx * bx + by * by + bz * bz, _BALL)
    out[4] = -(bx * a[0] + by * a[1] + bz * a[2])
    out[5] = radius
    out[6], out[7], out[8] = by * a[2] - bz * a[1], bz * a[0] - bx * a[2], bx * a[1] - by * a[0]
    out[9] = a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - radius * radius
    out[10] = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] - radius * radius
    out[11], out[12], out[13] = a[0], a[1], a[2]


@kernel(nogil=True)
def _side(x: float, y: float, z: float, axis: Light) -> int:
    """Return on which side the unit ray x, y, z passes a cylinder without ends: 1, -1; 0 where it meets."""
    if axis[3] <= _BALL:
        return 0
    bd = axis[0] * x + axis[1] * y + axis[2] * z
    past = axis[6] * x + axis[7] * y + axis[8] * z
    if past * past <= axis[5] * axis[5] * (axis[3] - bd * bd):
        return 0
    return 1 if past > 0.0 else -1


@kernel(nogil=True)
def _row(
    x: Light,
    y: Light,
    z: Light,
    axis: Light,
    shown: tuple[np.float32, int],
    lamp: Light,
    light: Light,
    depth: Light,
    ids: Image,
) -> None:
    """Draw a capsule into a part of a row: its rays (n,) x, y, z; its light, depth and ids.

    Every number is computed before it is chosen: a branch left in the loop, and the compiler takes one pixel at a time.

    Light falls off with the cosine to the lamp, and what faces away from the viewer is a little darker, which distinguishes
    one link from the next. ``shown`` is the capsule's albedo and its id.
    """
    bx, by, bz, long, ba, radius = axis[0], axis[1], axis[2], axis[3], axis[4], axis[5]
    cx, cy, cz, foot, head = axis[6], axis[7], axis[8], axis[9], axis[10]
    ax, ay, az = axis[11], axis[12], axis[13]
    lx, ly, lz = lamp[0], lamp[1], lamp[2]
    albedo, number = shown[0], np.int16(shown[1])
    for u in range(x.size):
        was_light, was_depth, was_id = light[u], depth[u], ids[u]
        ad = ax * x[u] + ay * y[u] + az * z[u]
        bd = bx * x[u] + by * y[u] + bz * z[u]
        past = cx * x[u] + cy * y[u] + cz * z[u]  # by which it passes the axis, times the next's root
        A = max(long - bd * bd, _LEAST * long)
        h = long * (radius * radius * A - past * past)
        t_side = (long * ad + ba * bd - np.sqrt(max(h, _ZERO))) / A
        along = (ba + t_side * bd) / long
        end = _ZERO if along < _HALF else _ONE
        # The ball at the nearer end, where the cylinder is met beyond it.
        ed = ad + end * bd
        ball = ed * ed - (foot + end * (head - foot))
        t_ball = ed - np.sqrt(max(ball, _ZERO))
        between = (along > _ZERO) & (along < _ONE)
        t = t_side if between else t_ball
        root = h if between else ball
        seen = (root >= _ZERO) & (t > _ZERO) & (t < was_depth)
        along = min(max((ba + t * bd) / long, _ZERO), _ONE)
        nx = (t * x[u] - ax - along * bx) / radius
        ny = (t * y[u] - ay - along * by) / radius
        nz = (t * z[u] - az - along * bz) / radius
        cosine = nx * lx + ny * ly + nz * lz
        away = nx * x[u] + ny * y[u] + nz * z[u]
        lamp_d = lx * x[u] + ly * y[u] + lz * z[u]
        mirror = max(_TWO * cosine * away - lamp_d, _ZERO)
        mirror = mirror if cosine > _ZERO else _ZERO
        square = mirror * mirror
        square = square * square
        square = square * square
        shade = (_AMBIENT + _LAMP * max(cosine, _ZERO)) * (_THREE_QUARTERS - _QUARTER * away) + _GLOSS * square * square
        shade *= albedo
        light[u] = shade if seen else was_light
        depth[u] = t if seen else was_depth
        ids[u] = number if seen else was_id


@kernel(
    "f4[:, :, ::1], (i8, i8, i8, i8), i8[:, ::1], (f8[:, :, ::1], f8[::1], f8[::1]), f4[::1], f4[:, ::1], "
    "f4[:, ::1], i2[:, ::1]",
    "f8[:, :, ::1], (i8, i8, i8, i8), i8[:, ::1], (f8[:, :, ::1], f8[::1], f8[::1]), f8[::1], f8[:, ::1], "
    "f4[:, ::1], i2[:, ::1]",
    nogil=True,
)
def moving(
    rays: Light,
    window: tuple[int, int, int, int],
    boxes_px: Ids,
    capsules: tuple[Array, Array, Array],
    lamp: Light,
    light: Light,
    depth: Light,
    ids: Image,
) -> None:
    """Draw capsules over an image that knows its depths; all is in the camera's frame.

    rays (3, H, W): of all pixels; ``window``: first column and row, end column and row of light, depth, m, and ids,
    which are brought up to date; boxes_px (K, 4): what each capsule can cover; ``capsules``: ends (K, 2, 3), m, radii
    (K,), m, albedos (K,); ids count them from 1.
    """
    ends, radius, albedo = capsules
    u_first, v_first, u_end, v_end = window
    axis = np.empty(14, np.float32)
    for k in np.argsort(ends[:, 0, 2] + ends[:, 1, 2]):  # what is near first: it hides the rest
        _axis(ends[k, 0], ends[k, 1], radius[k], axis)
        shown = np.float32(albedo[k]), k + 1
        u0, u1 = max(boxes_px[k, 0], u_first), min(boxes_px[k, 2], u_end)
        v0, v1 = max(boxes_px[k, 1], v_first), min(boxes_px[k, 3], v_end)
        for v_tile in range(v0, v1, _TILE):
            v_last = min(v_tile + _TILE, v1)
            u_begin, u_stop = u1, u0  # of the tiles that are not all to one side of it: one after the other
            for u_tile in range(u0, u1, _TILE):
                u_last, sides = min(u_tile + _TILE, u1), 0
                for corner in range(4):
                    v, u = (v_tile if corner < 2 else v_last - 1), (u_tile if corner % 2 else u_last - 1)
                    sides += _side(rays[0, v, u], rays[1, v, u], rays[2, v, u], axis)
                if abs(sides) != 4:
                    u_begin, u_stop = min(u_begin, u_tile), u_last
            first, last = u_begin - u_first, u_stop - u_first
            for v in range(v_tile, v_last if u_begin < u_stop else v_tile):
                x, y, z = rays[0, v, u_begin:u_stop], rays[1, v, u_begin:u_stop], rays[2, v, u_begin:u_stop]
                row = v - v_first
                _row(x, y, z, axis, shown, lamp, light[row, first:last], depth[row, first:last], ids[row, first:last])


#: The lens and the light, after the shading correction that cameras do themselves.
LENS = Optics(0.7, vignetting=0.08, light_gradient=(0.04, -0.04))
#: Points around a pattern or a disc that bound it in the image, and by how much those around a disc are further out.
EDGE, _OUT = 16, 1.02
#: One room at a time is looked at: it takes ten times the memory of what it leaves, and workcells may share a camera.
_LOOKING = threading.Lock()
_STILL_PX = 0.05  # what moves less is painted once


@dataclass(frozen=True, eq=False)
class ArmSeen(Record):
    """The arm at the moment of an exposure, with its row frames Ts_base_link (n + 1, 4, 4)."""

    parts: Solids
    Ts_base_link: Array


@lru_cache(maxsize=64)
def _edges(patterns: tuple[Pattern, ...]) -> Array:
    """Return points (N, EDGE, 3) around each pattern's cells, and then each of its discs, m, body frame."""
    angle = np.arange(EDGE) * (math.tau / EDGE)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = []
    for pattern in patterns:
        for line in (outline(pattern)[:: 4 * OUTLINE // EDGE], *(d[:2] + _OUT * d[2] * circle for d in pattern.discs)):
            around.append(transform(pattern.T_body_pattern, np.column_stack([line, np.zeros(EDGE)])))
    return np.array(around)


_nodes = lru_cache(np.polynomial.legendre.leggauss)


def _moved(body: PosedBody, t_s: Array) -> Array:
    """Return a body's poses (N, 4, 4) so long (N,) after the middle of an exposure."""
    return np.asarray(body.T_camera_body @ exp_se3(np.outer(t_s, body.twist)))


@dataclass(frozen=True, eq=False)
class LedSeen(Record):
    """A round LED that shines at a camera, or one that does so for a part of an exposure, at a depth, m.

    ``share`` (h, w): of each pixel of the window that it covers, times its light; ``spread``: the same through the lens.
    """

    window: Window
    share: Radiance
    spread: Radiance
    depth_m: float

    def lit(self, rows: Array) -> LedSeen:
        """Return it as it looks if it is on for a share (h,) of the exposure of each row of its window."""
        on = rows[:, None].astype(np.float32)
        return LedSeen(self.window, self.share * on, self.spread * on, self.depth_m)


class _Room(NamedTuple):
    """What a camera sees while nothing moves, and what its images are made of.

    Rays of the pixels' ``corners`` and unit ``rays`` (3, H, W); ``light`` (H, W) of what is ``still`` through the lens,
    ``grey`` the same, shaded, in grey levels; ``gain`` (H, W): grey levels of a reflectance of 1; ``lamp`` (3,): unit
    vector to it.
    """

    corners: Array
    rays: Radiance
    still: StillView
    light: Radiance
    grey: Radiance
    gain: Radiance
    lamp: Radiance


class WorkcellCamera:
    """A camera that stands in the workcell at T_base_camera (4, 4), m."""

    def __init__(
        self,
        camera: Camera,
        T_base_camera: Array,
        foot: Solids,
        seed: int,
        *,
        sensor: Sensor | None = None,
        psf_sigma_px: float = LENS.psf_sigma_px,
        more: Array | None = None,
    ) -> None:
        """Stand there; the first image takes a second longer.

        Args:
            camera: its lens.
            T_base_camera: (4, 4) where it is, m.
            foot: the arm's solids, whose base stands still.
            seed: of the clutter.
            sensor: noise of 2 grey levels by default.
            psf_sigma_px: blur of its lens, px.
            more: boxes that stand there besides, see ``raycast``.
        """
        self.camera, self.T_base_camera = camera, T_base_camera
        self._foot, self._seed, self._more = foot, seed, more
        self._sensor, self._psf_sigma_px = sensor or Sensor(), psf_sigma_px
        self._seen_room: _Room | None = None

    @property
    def _room(self) -> _Room:
        """What it sees while nothing moves: found when it looks for the first time, in a second; some 40 MB."""
        if self._seen_room is None:
            with _LOOKING:
                if self._seen_room is None:
                    self._seen_room = self._look()
        return self._seen_room

    def _look(self) -> _Room:
        corners = corner_rays(self.camera)
        rays = pixel_rays(corners)
        still = view(self.camera, rays, self.T_base_camera, self._seed, self._foot, self._more)
        width, height = self.camera.image_size_px
        gain = shaded(np.full((height, width), self._sensor.gain, np.float32), LENS)
        light = spread(still.light, self._psf_sigma_px)
        to_lamp = inverse(self.T_base_camera)[:3, :3] @ LAMP_BASE
        return _Room(
            corners,
            np.ascontiguousarray(rays.transpose(2, 0, 1), np.float32),
            still,
            light,
            light * gain,
            gain,
            (to_lamp / np.linalg.norm(to_lamp)).astype(np.float32),
        )

    def forget(self) -> None:
        """Drop what it sees while nothing moves; the next image finds it anew."""
        self._seen_room = None

    @property
    def still(self) -> StillView:
        """What stands still before it."""
        return self._room.still

    def led(self, p_base: Array, radius_m: float, light: float) -> LedSeen:
        """Return an LED at p_base (3,), m, as it looks while it is on, its light as of a reflectance."""
        p = transform(inverse(self.T_base_camera), p_base)
        uv, radius_px = self.camera.project(p[None])[0], radius_m * self.camera.matrix[0, 0] / p[2]
        margin = math.ceil(radius_px) + _reach(self._psf_sigma_px) + 1
        (u0, v0), (u1, v1) = np.floor(uv).astype(int) - margin, np.floor(uv).astype(int) + margin + 1
        width, height = self.camera.image_size_px
        if u0 < 0 or v0 < 0 or u1 > width or v1 > height:
            raise InputError(f"the sync LED is out of a camera's view, at {uv[0]:.0f}, {uv[1]:.0f} px")
        fine = (np.arange(16) + 0.5) / 16 - 0.5
        u, v = np.add.outer(np.arange(u0, u1), fine) - uv[0], np.add.outer(np.arange(v0, v1), fine) - uv[1]
        inside = (v * v)[:, :, None, None] + (u * u)[None, None] <= radius_px**2
        share = (light * inside.mean(axis=(1, 3))).astype(np.float32)
        return LedSeen((int(u0), int(v0), int(u1), int(v1)), share, spread(share, self._psf_sigma_px), float(p[2]))

    def image(
        self,
        arm: ArmSeen | None,
        bodies: Sequence[PosedBody],
        shutter: Shutter,
        strip: Radiance,
        start: int,
        led: LedSeen | None = None,
    ) -> Image:
        """Return what the camera hands out, (H, W) uint8.

        ``arm`` None leaves it out; ``bodies`` are flat patterns, posed in the camera's frame in the middle of the exposure
        of its middle row; noise is that of ``strip`` from ``start`` on (:func:`~armsight.sim.render.optics.noise_strip`).
        """
        seen, window, core = self._seen(arm, bodies, shutter, led)
        still = self._room.grey
        if led is not None:
            still = still.copy()
            at = _part(led.window, (0, 0, 0, 0))
            still[at] += led.spread * self._room.gain[at]
        out: Image = np.empty(still.shape, np.uint8)
        s = self._sensor
        noises = (s.offset, s.read_noise, s.shot_noise)
        exposed_window(still, seen, window, core, self._room.gain, strip, start, noises, out)
        return out

    def radiance(
        self, arm: ArmSeen | None, bodies: Sequence[PosedBody], shutter: Shutter, led: LedSeen | None = None
    ) -> Radiance:
        """Return the light (H, W) of each pixel before the lens's shading and the sensor; arguments as :meth:`image`."""
        seen, window, core = self._seen(arm, bodies, shutter, led)
        out = self._room.light.copy()
        if led is not None:
            out[_part(led.window, (0, 0, 0, 0))] += led.spread
        if seen.size:
            out[_part(core, (0, 0, 0, 0))] = seen[_part(core, window)]
        return out

    def _seen(
        self, arm: ArmSeen | None, bodies: Sequence[PosedBody], shutter: Shutter, led: LedSeen | None = None
    ) -> tuple[Radiance, Window, Window]:
        """Return the light of a window that holds all that moves, the window, and its core, which is exact."""
        ends, radius, albedo = (np.zeros((0, 2, 3)), np.zeros(0), np.zeros(0))
        if arm is not None:
            ends, radius, albedo = arm_capsules(arm.parts, arm.Ts_base_link, self.T_base_camera)
        boxes = capsule_boxes(self.camera, ends, radius)
        exposure = self._exposure(bodies, shutter)
        margin = _reach(self._psf_sigma_px)
        crop = (0, 0, 0, 0) if exposure is None else self._around(exposure.shown(), 2 * margin)
        window = self._around(np.concatenate([[crop], boxes]), 2 * margin)
        u0, v0, u1, v1 = window
        light = self.still.light[v0:v1, u0:u1].copy()
        depth, ids = self.still.depth[v0:v1, u0:u1].copy(), np.zeros(light.shape, np.int16)
        if led is not None:
            _shine(led, window, light, depth)
        moving(self._room.rays, window, boxes, (ends, radius, albedo), self._room.lamp, light, depth, ids)
        seen = spread(light, self._psf_sigma_px) if light.size else light
        if exposure is not None and crop[0] < crop[2] and crop[1] < crop[3]:
            core = self._core(crop, margin)
            painted = self._painted(exposure, crop, window, (light, depth, ids))
            seen[_part(core, window)] = painted[_part(core, crop)]
        return seen, window, self._core(window, margin)

    def arm_ids(self, arm: ArmSeen) -> Image:
        """Return (H, W) which of the arm's moving solids each pixel sees, counted from 1; 0 where it sees none."""
        width, height = self.camera.image_size_px
        capsules = arm_capsules(arm.parts, arm.Ts_base_link, self.T_base_camera)
        boxes, window = capsule_boxes(self.camera, *capsules[:2]), (0, 0, width, height)
        light, depth, ids = self.still.light.copy(), self.still.depth.copy(), np.zeros((height, width), np.int16)
        moving(self._room.rays, window, boxes, capsules, self._room.lamp, light, depth, ids)
        return ids

    def _around(self, boxes: Ids, margin: int) -> Window:
        """Return what holds all boxes (N, 4) that are not empty, with a margin, within the image."""
        full = boxes[(boxes[:, :2] < boxes[:, 2:]).all(axis=1)]
        if not len(full):
            return 0, 0, 0, 0
        u0, v0 = np.maximum(full[:, :2].min(axis=0) - margin, 0)
        u1, v1 = np.minimum(full[:, 2:].max(axis=0) + margin, self.camera.image_size_px)
        return int(u0), int(v0), int(u1), int(v1)

    def _exposure(self, bodies: Sequence[PosedBody], shutter: Shutter) -> Exposure | None:
        """Return what is painted: all that faces the camera, with boxes in the whole image; None where nothing does."""
        patterns = tuple(pattern for body in bodies for pattern in body.patterns)
        if not patterns:
            return None
        width, height = self.camera.image_size_px
        rolling = shutter.row_s > 0 and any(body.twist.any() for body in bodies)
        rows_s = (np.arange(height) - (height - 1) / 2) * shutter.row_s if rolling else np.zeros(1)
        ends_s = np.add.outer(np.array([-0.5, 0.5]) * shutter.exposure_s, rows_s[[0, -1] if rolling else [0]]).ravel()
        uv = self._each(lambda body: self._outlines(_moved(body, ends_s), body.patterns), bodies)
        bounds = np.concatenate([np.floor(uv.min(axis=(0, 2))) - 1, np.ceil(uv.max(axis=(0, 2))) + 2], axis=1)
        # What is behind the camera has no number there, and so no position in the image.
        boxes = np.fmax(np.fmin(bounds, (width, height, width, height)), 0.0).astype(np.int64)
        way_px = float(np.fmax.reduce(np.abs(uv[len(uv) // 2 :] - uv[: len(uv) // 2]), axis=None, initial=0.0))
        nodes, weights = _nodes(1 + math.ceil(max(way_px - _STILL_PX, 0.0)))
        t_s = np.add.outer(0.5 * shutter.exposure_s * nodes, rows_s)

        def posed(body: PosedBody) -> Array:
            Ts = _moved(body, t_s.ravel()).reshape(*t_s.shape, 4, 4)
            on = np.array([pattern.T_body_pattern for pattern in body.patterns])
            return np.asarray(Ts[:, None] @ on[:, None])

        Ts = self._each(posed, bodies)  # (S, P, R, 4, 4)
        # Its face is on the side that z points away from; what is behind the camera is not seen.
        faces = ((Ts[..., :3, 2] * Ts[..., :3, 3]).sum(axis=-1) > 0).all(axis=2) & (Ts[..., 2, 3] > 0).all(axis=2)
        order = np.argsort(np.where(faces, -np.linalg.norm(Ts[:, :, 0, :3, 3], axis=2), np.inf), axis=1, kind="stable")
        order = np.where(np.take_along_axis(faces, order, axis=1), order, -1)
        Ms = np.asarray(np.linalg.inv(Ts[..., :3, [0, 1, 3]]), dtype=np.float64)
        return Exposure(palette(patterns), 0.5 * weights, order, Ms, boxes)

    @staticmethod
    def _each(of: Callable[[PosedBody], Array], bodies: Sequence[PosedBody]) -> Array:
        """Return what each body gives, side by side along the second axis."""
        found = [of(body) for body in bodies if body.patterns]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def _outlines(self, Ts_camera_body: Array, patterns: tuple[Pattern, ...]) -> Array:
        """Return the edges of a body's patterns in pixels, (R, N, EDGE, 2), at poses (R, 4, 4)."""
        p = transform(Ts_camera_body[:, None, None], _edges(patterns))
        return self.camera.project(p.reshape(-1, 3)).reshape(*p.shape[:3], 2)

    def _painted(
        self, exposure: Exposure, crop: Window, window: Window, behind: tuple[Radiance, Radiance, Image]
    ) -> Radiance:
        """Return the light of the crop with the patterns painted in, through the lens, over the whole exposure."""
        u0, v0, u1, v1 = crop
        boxes = np.clip(exposure.boxes - (u0, v0, u0, v0), 0, (u1 - u0, v1 - v0) * 2)
        Ms = exposure.Ms
        Ms = np.ascontiguousarray(Ms[:, :, v0:v1]) if Ms.shape[2] > 1 else Ms
        total, edges = np.empty((v1 - v0, u1 - u0), np.float32), np.zeros((v1 - v0, u1 - u0), np.float32)
        layers = (behind[0][_part(crop, window)], behind[1][_part(crop, window)], behind[2][_part(crop, window)])
        shown, taps = exposure._replace(Ms=Ms, boxes=boxes), part_taps(self._psf_sigma_px)
        paint_faces(self._room.corners, self._room.rays, shown, (u0, v0), layers, taps, total, edges)
        return np.asarray(spread(total, self._psf_sigma_px) + edges)

    def _core(self, window: Window, margin: int) -> Window:
        """Return a window but for a margin where its blur did not know what is around; none at the image's border."""
        (width, height), (u0, v0, u1, v1) = self.camera.image_size_px, window
        return u0 + margin * (u0 > 0), v0 + margin * (v0 > 0), u1 - margin * (u1 < width), v1 - margin * (v1 < height)


def _part(part: Window, window: Window) -> tuple[slice, slice]:
    """Return the rows and columns of a part of a window."""
    return slice(part[1] - window[1], part[3] - window[1]), slice(part[0] - window[0], part[2] - window[0])


def _shine(led: LedSeen, window: Window, light: Radiance, depth: Radiance) -> None:
    """Add an LED to the light and the depths of a window, where it is within it."""
    (u0, v0, u1, v1), (a0, b0, a1, b1) = led.window, window
    both = max(u0, a0), max(v0, b0), min(u1, a1), min(v1, b1)
    if both[0] < both[2] and both[1] < both[3]:
        here, there = _part(both, window), _part(both, led.window)
        light[here] += led.share[there]
        depth[here] = np.where(led.share[there] > 0, np.minimum(depth[here], led.depth_m), depth[here])


def _reach(sigma_px: float) -> int:
    """Return how far the lens spreads light, px."""
    return math.ceil(4.5 * sigma_px + 0.5)


#: Where it is seen from and what is in the middle, m; focal length over the image's width.
_EYE, _MIDDLE, _FOCAL = np.array([2.05, -1.75, 1.25]), np.array([0.62, -0.08, 0.30]), 0.95
#: Tints, BGR, of what is grey otherwise: wood, wall and floor, the arm's links, its housings; things use them alternately.
_WOOD, _ROOM, _LINK, _HOUSING = (0.62, 0.85, 1.10), (1.06, 1.02, 0.98), (0.55, 0.85, 1.30), (1.05, 1.0, 1.0)
_THINGS = ((1.25, 0.95, 0.7), (0.75, 1.15, 0.85), (0.75, 0.85, 1.3), (1.1, 1.1, 0.7), (1.0, 0.8, 1.15))
_CAMERAS = (1.0, 1.0, 1.0)
_SAME = 3  # grey levels


def picture(
    size_px: tuple[int, int],
    plant: ArmPlant | ControlledArm,
    body: tuple[tuple[Pattern, ...], Array],
    rig: tuple[Array, StereoRig],
    seed: int,
) -> Image:
    """Return the workcell as it is now.

    ``size_px``: (width, height); ``body``: the patterns on the tool, and T_tool_body (4, 4), m; ``rig``: T_base_rig (4, 4),
    m, and the cameras. Returns (H, W, 3) BGR, uint8.
    """
    width, height = size_px
    focal = _FOCAL * width
    camera = Camera(size_px, "none", np.array([focal, focal, (width - 1) / 2, (height - 1) / 2]), np.zeros(0))
    z = (_MIDDLE - _EYE) / np.linalg.norm(_MIDDLE - _EYE)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T_base_eye = pose(np.column_stack([x, np.cross(z, x), z]), _EYE)
    more = _rig_boxes(*rig)
    eye = WorkcellCamera(camera, T_base_eye, plant.parts, seed, sensor=Sensor(read_noise=0.0), more=more)
    q = plant.path[-1, plant.arm.joints :]
    arm = ArmSeen(plant.parts, row_frames(plant.arm, q))
    posed = PosedBody(body[0], inverse(T_base_eye) @ plant.arm.forward(q) @ body[1])
    grey = eye.image(arm, [posed], Shutter(), np.zeros(width * height, np.float32), 0)
    bare = eye.image(arm, [], Shutter(), np.zeros(width * height, np.float32), 0)
    tints = _tints(len(furniture(seed)[0]), len(more))
    tint = tints[np.minimum(eye.still.ids, len(tints) - 1)]
    tint[eye.still.ids < 0] = _ROOM
    ids = eye.arm_ids(arm)
    housing = np.append(False, plant.parts.housing[plant.parts.link > 0][:-1])
    tint[ids > 0] = np.where(housing[ids[ids > 0]][:, None], _HOUSING, _LINK)
    tint[np.abs(grey.astype(int) - bare) > _SAME] = 1.0  # the body is black and white
    tint *= grey[..., None]
    np.clip(np.rint(tint, out=tint), 0, 255, out=tint)
    return tint.astype(np.uint8)


def _tints(count: int, more: int) -> Array:
    """Return the tints (N + 1, 3) of so many boxes of furniture, the cameras' boxes and, last, all that is round."""
    things = np.array([_THINGS[k % len(_THINGS)] for k in range(count)])
    things[0], things[1:3], things[3:7] = _WOOD, _ROOM, _CAMERAS
    things[7:9], things[9:12], things[12:14] = _CAMERAS, _WOOD, _CAMERAS
    return np.concatenate([things, np.tile(_CAMERAS, (more, 1)), [_THINGS[2]]])


def _rig_boxes(T_base_rig: Array, rig: StereoRig) -> Array:
    """Return boxes that look like two cameras on a bar on a post."""
    Ts = (T_base_rig, T_base_rig @ rig.T_left_right)
    boxes = []
    for T in Ts:
        heading_deg = float(np.degrees(np.arctan2(T[1, 2], T[0, 2])))
        p, ahead = T[:3, 3], T[:3, 2]
        for back, size, albedo in ((0.035, (0.06, 0.062, 0.05), 0.10), (-0.005, (0.03, 0.04, 0.04), 0.22)):
            x, y, z = (p - back * ahead).tolist()
            boxes.append(block((x, y, z), size, heading_deg, albedo, PLAIN))
    middle = 0.5 * (Ts[0][:3, 3] + Ts[1][:3, 3]) - 0.04 * T_base_rig[:3, 2]
    heading_deg = float(np.degrees(np.arctan2(T_base_rig[1, 2], T_base_rig[0, 2])))
    x, y, z = middle.tolist()
    boxes.append(block((x, y, z - 0.04), (0.04, rig.baseline_m + 0.12, 0.02), heading_deg, 0.4, PLAIN))
    boxes.append(block((x, y, (z - 0.05 - 0.74) / 2), (0.035, 0.035, z - 0.05 + 0.74), heading_deg, 0.3, PLAIN))
    return np.array(boxes)
