"""A test rig to record with: two cameras, poses of a chessboard for their calibration, a path of a target to measure.

Poses are sampled from a seed and kept when the whole pattern is in view of both cameras at a readable slant.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import write_text
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.recording import Look, Truth, record, shot_names
from armsight.sim.render.render import OUTLINE, Shutter, outline
from armsight.sim.render.scene import Pattern, chessboard, marker_bits, plate, tag
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig

_TRIES = 400  # for one pose before giving up
_AT_ONCE = 32  # of them; half: more calls, double: more that are not used
_SLANT_MAX = np.radians(62.0)  # beyond it a board is hard to read
_MARGIN_PX = 4.0

BOARD = "chessboard:9x6:25mm"
EXPOSURE = Shutter(exposure_s=0.002)
#: The demo's end-effector: a dark plate (m) with four AprilTags, their side (m) and middles (m).
PLATE_M = (0.120, 0.095)
TAG_FAMILY, TAG_M = "tag36h11", 0.032
TAG_MIDDLES_M = ((-0.034, -0.024), (0.034, -0.024), (0.034, 0.024), (-0.034, 0.024))


def example_rig(
    image_size_px: tuple[int, int] = (1280, 720),
    focal_px: float = 900.0,
    baseline_m: float = 0.2,
    convergence_deg: float = 8.0,
    model: str = "brown5",
) -> StereoRig:
    """Return two slightly different cameras side by side that look at the same point."""
    coefficients = {
        "none": (),
        "brown4": (-0.12, 0.06, 0.0006, -0.0004),
        "brown5": (-0.12, 0.06, 0.0006, -0.0004, -0.01),
        "fisheye": (0.02, -0.008, 0.003, -0.001),
    }
    if model not in coefficients:
        raise InputError(f"the example rig's camera models are {', '.join(coefficients)}, not {model!r}")
    width, height = image_size_px
    fx, fy, cx, cy = focal_px, 1.001 * focal_px, (width - 1) / 2, (height - 1) / 2
    distortion = np.array(coefficients[model])
    left = Camera(image_size_px, model, np.array([fx, fy, cx + 4.3, cy - 2.8]), distortion)
    right = Camera(image_size_px, model, np.array([1.004 * fx, 1.005 * fy, cx - 3.1, cy + 5.4]), 0.93 * distortion)
    aside = np.array([1.0, 0.015, 0.01])
    T_left_right = pose(
        exp_so3(np.array([0.006, -np.radians(convergence_deg), 0.004])), baseline_m * aside / np.linalg.norm(aside)
    )
    count = left.parameters.size + right.parameters.size + 6
    return StereoRig(left, right, T_left_right, np.zeros((count, count)), 0.0, {"source": "armsight.sim.example_rig"})


def in_view(rig: StereoRig, Ts_left_pattern: Array, pattern: Pattern) -> NDArray[np.bool_]:
    """Return for poses (A, 4, 4) whether both cameras see all of a pattern, at a readable slant: (A,)."""
    whole, rows = np.column_stack([outline(pattern), np.zeros(4 * OUTLINE)]), np.arange(len(Ts_left_pattern))
    cameras = (rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right))
    # The corners first: most poses that are tried fail there already.
    for points, (camera, T_camera_left) in product((whole[::OUTLINE], whole), cameras):
        Ts = T_camera_left @ Ts_left_pattern[rows]
        p = transform(Ts[:, None], points)
        uv = camera.project(p.reshape(-1, 3)).reshape(*p.shape[:2], 2)
        high = np.array(camera.image_size_px) - 1 - _MARGIN_PX
        away = p / np.sqrt(np.einsum("api,api->ap", p, p))[..., None]
        slant = np.einsum("api,ai->ap", away, Ts[:, :3, 2]).min(axis=1)
        inside = ((uv >= _MARGIN_PX) & (uv <= high)).all(axis=(1, 2)) & (slant >= np.cos(_SLANT_MAX))
        rows, uv, away = rows[inside], uv[inside], away[inside]
        # Where a distortion polynomial folds back, a point far outside is projected inside: its ray shows that.
        folded = np.abs(camera.unproject(uv.reshape(-1, 2)).reshape(away.shape) - away).max(axis=(1, 2), initial=0.0)
        rows = rows[folded < 1e-6]
    return np.isin(np.arange(len(Ts_left_pattern)), rows)


def _between(rig: StereoRig, distances_m: Array) -> Array:
    """Return the points (A, 3) between both optical axes at distances from the cameras, m, left camera's frame."""
    ahead = distances_m[:, None] * np.array([0.0, 0.0, 1.0])
    return np.asarray(0.5 * (ahead + transform(rig.T_left_right, ahead)))


def board_poses(
    rng: np.random.Generator,
    rig: StereoRig,
    pattern: Pattern,
    count: int,
    *,
    fill: tuple[float, float] = (0.45, 1.1),
    tilt_deg: float = 45.0,
) -> Array:
    """Sample poses of a chessboard that calibrate a rig well: all over both images, near and far, tilted all ways.

    Return (count, 4, 4) in the left camera's frame, m, in full view of both. ``fill``: least and largest share of the
    image's height that the board's diagonal takes when it faces the camera. InputError: no such pose was found.
    """
    cells = rng.permutation(count)
    poses = []
    for n in range(count):
        for first in range(0, _TRIES, _AT_ONCE):
            state = rng.bit_generator.state
            Ts = _tried(rng.random((_AT_ONCE, 6)), rig, pattern, int(cells[n]), n % 2, first, fill, tilt_deg)
            seen = np.flatnonzero(in_view(rig, Ts, pattern))
            if len(seen):  # what comes next is drawn as if nothing had been tried beyond it
                rng.bit_generator.state = state
                rng.random((seen[0] + 1, 6))
                poses.append(Ts[seen[0]] @ inverse(pattern.T_body_pattern))
                break
        else:
            raise InputError(
                "no pose of the board fills both images: it is too large, too small for their distance, or they look apart"
            )
    return np.array(poses)


def _tried(
    draws: Array, rig: StereoRig, pattern: Pattern, number: int, side: int, first: int,
    fill: tuple[float, float], tilt_deg: float,
) -> Array:  # fmt: skip
    """Return poses (A, 4, 4) of a pattern in a cell of the image of one side, of draws (A, 6) in 0 to 1.

    The image is divided into 4 x 3 cells; the poses of later attempts, of which ``first`` is the first's number, are
    nearer to the middle.
    """
    width, height = rig.left.image_size_px
    corners = outline(pattern)
    diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
    p_middle = np.append((corners.min(axis=0) + corners.max(axis=0)) / 2, 0.0)
    uv = (np.array([number % 4, number // 4 % 3]) + draws[:, :2]) / (4, 3) * (width, height)
    distances = rig.left.intrinsics[0] * diagonal / ((fill[0] + (fill[1] - fill[0]) * draws[:, 2]) * height)
    p = distances[:, None] * rig.cameras[side].unproject(uv)
    p = transform(rig.T_left_right, p) if side else p
    p += (first + np.arange(len(draws)))[:, None] / _TRIES * (_between(rig, distances) - p)
    about, tilt = 2 * np.pi * draws[:, 3], np.radians(tilt_deg) * np.sqrt(draws[:, 4])
    none = np.zeros(len(draws))
    about_z = np.stack([none, none, -0.4 + 0.8 * draws[:, 5]], axis=1)
    R = exp_so3(about_z) @ exp_so3(np.stack([tilt * np.cos(about), tilt * np.sin(about), none], axis=1))
    Ts = np.tile(np.eye(4), (len(draws), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = R, p - R @ p_middle
    return Ts


def path(rig: StereoRig, patterns: Sequence[Pattern], times_s: Array) -> tuple[Array, Array]:
    """Return a smooth path of a target through the volume that both cameras see; its start comes back after some ten s.

    ``patterns``: the target; all of it stays in view. ``times_s``: (N,) times, s. Returns (N, 4, 4) poses of the target in
    the left camera's frame, m, and (N, 6) its velocity in its own axes, m/s, rad/s. Raises InputError: the target is not in
    view even at rest in the middle.
    """
    distance_m = 0.5  # of the path's middle from the cameras
    middle = _between(rig, np.array([distance_m]))[0]
    rates = np.array([0.7, 1.1, 0.5, 0.9, 0.6, 0.8])
    phases = np.array([0.0, 0.4, 1.0, 0.2, 1.7, 2.5])
    ranges = np.array([0.35 * distance_m, 0.2 * distance_m, 0.2 * distance_m, 0.5, 0.5, 0.4])

    def at(t: Array, size: float) -> Array:
        """Return poses (N, 4, 4) at times (N,)."""
        sway = size * ranges * np.sin(t[:, None] * rates + phases)
        T = exp_se3(np.concatenate([np.zeros_like(sway[:, 3:]), sway[:, 3:]], axis=1))
        T[:, :3, 3] = middle + sway[:, :3]
        return T

    size, step = 1.0, 1e-4
    while not all(in_view(rig, at(times_s, size) @ p.T_body_pattern, p).all() for p in patterns):
        size *= 0.9
        if size < 0.05:
            raise InputError(f"the target is not in full view of both cameras at {distance_m:g} m")
    before, after = at(times_s - step, size), at(times_s + step, size)
    return at(times_s, size), log_se3(inverse(before) @ after) / (2 * step)


def tag_plate() -> tuple[tuple[Pattern, ...], str]:
    """Return the demo's end-effector: its patterns, and the text of the body file that describes it."""
    patterns, text = [plate(*PLATE_M, value=0.12)], 'version = 2\nname = "plate"\n'
    for k, (x, y) in enumerate(TAG_MIDDLES_M):
        patterns.append(tag(marker_bits(TAG_FAMILY, k), TAG_M).on_body(pose(np.eye(3), np.array([x, y, 0.0]))))
        text += (
            f'\n[[markers]]\nname = "T{k}"\nposition_mm = [{x * 1e3:g}, {y * 1e3:g}, 0.0]\n'
            f'euler_zyx_deg = [0.0, 0.0, 0.0]\ntag = {{ family = "{TAG_FAMILY}", id = {k}, size_mm = {TAG_M * 1e3:g} }}\n'
        )
    return tuple(patterns), text


def demo_recording(
    folder: str | Path,
    *,
    seed: int = 0,
    image_size_px: tuple[int, int] = (960, 540),
    boards: int = 20,
    shots: int = 40,
    rate_hz: float = 15.0,
) -> tuple[Truth, Truth]:
    """Record with the test rig: a chessboard for calibration, and an end-effector on its way.

    Args:
        folder: where to: ``board`` and ``arm`` below it, and ``plate.toml``, the end-effector's body file.
        seed: of poses, background and noise.
        image_size_px: (width, height) of both cameras; the focal length goes with it.
        boards: pairs of the board.
        shots: pairs of the end-effector.
        rate_hz: of the end-effector's shots.

    Returns:
        The truth of ``board`` and of ``arm``; ``rig`` of either is the true rig, which ``rig.save`` writes.

    Raises:
        InputError: a file cannot be written.
    """
    rig = example_rig(image_size_px, focal_px=900 / 1280 * image_size_px[0])
    board = chessboard(9, 6, 0.025)
    Ts = board_poses(np.random.default_rng(seed), rig, board, boards)
    of_board = Truth(rig, BOARD, shot_names(boards), np.arange(float(boards)), Ts)
    record(Path(folder) / "board", of_board, [board], seed=seed)
    plate_patterns, body_file = tag_plate()
    times_s: Array = np.arange(shots) / rate_hz
    Ts, twists = path(rig, plate_patterns, times_s)
    of_arm = Truth(rig, "plate.toml", shot_names(shots), times_s, Ts)
    record(Path(folder) / "arm", of_arm, plate_patterns, twists=twists, look=Look(shutter=EXPOSURE), seed=seed + 1)
    write_text(Path(folder) / "plate.toml", body_file)
    return of_board, of_arm
