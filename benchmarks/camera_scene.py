"""Random scenes with a body before a stereo rig, seen through a camera of ``armsight.sim.camera``, with truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.camera.pipeline import SimulatedCamera
from armsight.sim.camera.stages import CameraPipeline, preset_names
from armsight.sim.example_rig import example_rig, in_view
from armsight.sim.render.background import BACKGROUNDS
from armsight.sim.render.render import radiance
from armsight.sim.render.scene import Pattern, PosedBody, chessboard, marker_bits, plate, tag
from armsight.sim.workcell.body import body_patterns, body_target
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.marker import Target
from armsight.vision.markers.tag import Tag, TagTarget
from armsight.vision.rig import StereoRig
from marker_plate import MARGIN_M, ellipses, project
from marker_report import disc_target

#: Tilt of the body, up to.
TILT_DEG = 40.0
#: Pairs that a camera has seen of a scene before the one that counts: automatic gain and temporal filter have settled.
BEFORE = 4
#: Inner corners of the chessboard and its squares' side, m; four tags' side and where they are about the plate's middle.
CHESSBOARD = (9, 6, 0.020)
TAG_M, TAGS_M = 0.045, ((-0.045, -0.045), (0.045, -0.045), (0.045, 0.045), (-0.045, 0.045))


@dataclass(frozen=True)
class Scene:
    """Two images of a body and what is true of them.

    Attributes:
        images: left and right, (H, W) uint8.
        rig: the true cameras.
        target: the body's markers.
        T_left_body: (4, 4) its pose in the middle of the left exposure's middle row, m.
        uv: left and right, (N, 2) images of its points, px; of discs the centroids of their projected rims.
        shapes: left and right, (N, 3) S11, S12, S22 of the discs' images, px^2: rim x^T S^-1 x = 1; none of other markers.
        patterns: what was painted.
    """

    images: tuple[np.ndarray, np.ndarray]
    rig: StereoRig
    target: Target | DiscTarget
    T_left_body: np.ndarray
    uv: tuple[np.ndarray, np.ndarray]
    shapes: tuple[np.ndarray, np.ndarray]
    patterns: tuple[Pattern, ...]


def body(kind: str) -> tuple[Target | DiscTarget, tuple[Pattern, ...]]:
    """Return a target and its patterns.

    Args:
        kind: ``nine`` for the workcell's body of nine bright discs, ``three`` or ``four`` for a plate with so many,
            ``tags`` for a plate of four AprilTags, ``chessboard``.
    """
    if kind == "chessboard":
        columns, rows, square_m = CHESSBOARD
        return Chessboard(columns, rows, square_m), (chessboard(columns, rows, square_m),)
    if kind == "tags":
        at = [pose(np.eye(3), np.array([x, y, 0.0])) for x, y in TAGS_M]
        tags = tuple(Tag(f"T{k}", "tag36h11", k, TAG_M, T) for k, T in enumerate(at))
        painted = [tag(marker_bits("tag36h11", k), TAG_M).on_body(T) for k, T in enumerate(at)]
        return TagTarget("tags", tags), (plate(0.16, 0.16, 0.85), *painted)
    if kind == "nine":
        target = body_target().discs
        assert target is not None
        return target, body_patterns()
    target = disc_target(count={"three": 3, "four": 4}[kind])
    low, high = target.body.points.min(axis=0) - MARGIN_M, target.body.points.max(axis=0) + MARGIN_M
    middle = (low + high) / 2
    discs = [(*(p - middle)[:2], r, 0.85) for p, r in zip(target.body.points, target.radii_m, strict=True)]
    return target, (plate(high[0] - low[0], high[1] - low[1], 0.06, discs).on_body(pose(np.eye(3), middle)),)


def random_pose(
    rig: StereoRig, patterns: tuple[Pattern, ...], distance_m: float, rng: np.random.Generator
) -> np.ndarray:
    """Return T_left_body (4, 4) of a body in full view of both cameras, rotated and tilted anyhow."""
    while True:
        axis = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(0, TILT_DEG)) * np.array([np.cos(axis), np.sin(axis), 0.0])
        R = exp_so3(tilt) @ exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        where = np.array([rng.uniform(-0.4, 0.6), rng.uniform(-0.35, 0.35), 1.0]) * distance_m
        T = pose(R, where)
        if all(in_view(rig, T @ pattern.T_body_pattern, pattern) for pattern in patterns):
            return T


def placed(
    seed: int,
    kind: str = "nine",
    distance_m: float | None = None,
    size: tuple[int, int] = (1280, 720),
) -> tuple[StereoRig, Target | DiscTarget, tuple[Pattern, ...], np.ndarray, np.random.Generator]:
    """Return rig, target, patterns and T_left_body (4, 4) of a scene, and the generator that its backgrounds come from."""
    rng = np.random.default_rng([seed, 1])
    rig = example_rig(size, 900 / 1280 * size[0])
    target, patterns = body(kind)
    distance = rng.uniform(0.5, 1.2) if distance_m is None else distance_m
    return rig, target, patterns, random_pose(rig, patterns, distance, rng), rng


def smallest_px(seed: int, kind: str) -> float:
    """Return the size of the smallest marker of both images of a scene, px; nothing is rendered.

    It is the smaller diameter of a disc, the shortest side of a tag or a board's square.
    """
    rig, target, _, T, _ = placed(seed, kind)
    at = (T, inverse(rig.T_left_right) @ T)
    if not isinstance(target, DiscTarget):
        step = 4 if isinstance(target, TagTarget) else 1
        sides = [
            np.linalg.norm(np.diff(project(camera, transform(A, target.body.points)), axis=0), axis=1)
            for camera, A in zip(rig.cameras, at, strict=True)
        ]
        return float(min(s[i] for s in sides for i in range(len(s)) if step == 1 or i % step != 3))
    shapes = np.vstack([ellipses(camera, target, A)[1] for camera, A in zip(rig.cameras, at, strict=True)])
    half, root = (shapes[:, 0] + shapes[:, 2]) / 2, np.hypot((shapes[:, 0] - shapes[:, 2]) / 2, shapes[:, 1])
    return float(2 * np.sqrt((half - root).min()))


def scene(
    seed: int,
    preset: str | CameraPipeline,
    distance_m: float | None = None,
    *,
    kind: str = "nine",
    background: str = "cluttered",
    size: tuple[int, int] = (1280, 720),
    twist: np.ndarray | None = None,
) -> Scene:
    """Render a random scene.

    Args:
        seed: of pose, background, cameras and noise; the same for every preset, so that presets see the same scene.
        preset: name or TOML file of the cameras, or their pipeline.
        distance_m: of the body; sampled from 0.5 to 1.2 m by default.
        kind: of the body, see :func:`body`.
        background: a key of ``BACKGROUNDS``; what is behind differs between both images.
        size: (width, height) of the images.
        twist: (6,) velocity of the body in its own axes, m/s and rad/s; at rest by default. The pipeline's shutter decides
            what it does to the image; both cameras expose at the same time.
    """
    pipeline = preset if isinstance(preset, CameraPipeline) else CameraPipeline.load(preset)
    rig, target, patterns, T, rng = placed(seed, kind, distance_m, size)
    posed = PosedBody(patterns, T, np.zeros(6) if twist is None else twist)
    images, uv, shapes = [], [], []
    for side, (camera, view) in enumerate(
        zip(rig.cameras, (posed, posed.seen_from(inverse(rig.T_left_right))), strict=True)
    ):
        behind = BACKGROUNDS[background](size, rng)
        light = radiance(camera, [view], behind, psf_sigma_px=pipeline.psf_sigma_px, shutter=pipeline.shutter(size[1]))
        device = SimulatedCamera(pipeline, size, 2 * seed + side)
        remembers = pipeline.auto_exposure is not None or pipeline.temporal_denoise is not None
        for k in range(BEFORE if remembers else 0):  # of a body at rest; a moving one's past is where it was not
            if twist is None:
                device.expose(light, k / 30)
        images.append(device.expose(light, BEFORE / 30))
        if isinstance(target, DiscTarget):
            centres, shape = ellipses(camera, target, view.T_camera_body)
        else:
            centres, shape = project(camera, transform(view.T_camera_body, target.body.points)), np.zeros((0, 3))
        uv.append(centres)
        shapes.append(shape)
    return Scene((images[0], images[1]), rig, target, T, (uv[0], uv[1]), (shapes[0], shapes[1]), patterns)


def sheet(path: Path, seed: int = 1, distance_m: float = 0.8) -> None:
    """Write the same body through every preset, its middle 3 times enlarged and one of its discs 10 times."""
    columns = []
    for name in preset_names():
        found = scene(seed, name, distance_m)
        image, middle = found.images[0], found.uv[0].mean(axis=0)
        largest = found.uv[0][found.shapes[0][:, 0].argmax()]
        parts = [_enlarged(image, at, half, times) for at, half, times in ((middle, 60, 3), (largest, 18, 10))]
        label = np.full((36, parts[0].shape[1]), 255, np.uint8)
        cv2.putText(label, name, (8, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 0, 2, cv2.LINE_AA)
        columns.append(np.pad(np.vstack([label, *parts]), ((0, 0), (0, 8)), constant_values=255))
    cv2.imwrite(str(path), np.hstack(columns)[:, :-8])


def _enlarged(image: np.ndarray, at: np.ndarray, half: int, times: int) -> np.ndarray:
    """Return a square about a point of an image, each pixel as a square; (2 half times, 2 half times)."""
    u, v = np.round(at).astype(int)
    return np.kron(image[v - half : v + half, u - half : u + half], np.ones((times, times), np.uint8))
