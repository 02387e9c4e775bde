"""From images to poses of the target: one camera with its own calibration, or a rig.

In: image files, a target, a camera or a rig. Out: :class:`Seen`. One camera: the pose of least reprojection error, its
covariance from the pixels' scatter over all images; the camera may be calibrated from the same images.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Detections, Missed, Record
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, transform
from armsight.geometry.rotation import skew
from armsight.loop.handeye.poses import LEVER_M
from armsight.tables.poses import PoseTable
from armsight.vision.camera import Camera
from armsight.vision.camera_file import read_camera
from armsight.vision.image import grey, read_image
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.locate import by_rig
from armsight.vision.pose.measure import measure
from armsight.vision.pose.pnp import body_poses
from armsight.vision.rig import StereoRig
from armsight.vision.source import Source

#: Steps of the refinement of a pose, and the change, m and rad, below which it has settled.
STEPS, SETTLED = 20, 1e-10
#: Fewest images to calibrate a camera from.
MIN_IMAGES = 5
#: Errors of the rig that do less than this part of what its largest one does, or of this, m, are nothing.
COMMON, LEAST_COMMON_M = 1e-2, 1e-6


@dataclass(frozen=True, eq=False)
class Seen(Record):
    """Poses of the target.

    Attributes:
        Ts: (N, 4, 4) T_rig_body, m; where the target was not found, the identity.
        covs: (N, 6, 6) their covariance, right tangent; zero where it is not known.
        names: of the images.
        missed: (N,) why there is no pose; "" where there is one.
        t_s: (N,) times, s; None where there are none.
        centre: (3,) the middle of the target's points, body frame, m.
        symmetries: motions (4, 4) of the body that change nothing to see.
        scatter_px: RMS of the reprojection; 0 where there are no images.
        notes: what was found out.
        common: (N, 6, K) what K independent errors of the rig of one sigma do to the poses; None where unknown.
        table: the table that the poses are from; None where they are from images.
    """

    Ts: Array
    covs: Array
    names: tuple[str, ...]
    missed: tuple[str, ...]
    t_s: Array | None
    centre: Array
    symmetries: tuple[Array, ...] = ()
    scatter_px: float = 0.0
    notes: tuple[str, ...] = ()
    common: Array | None = None
    table: PoseTable | None = None


def see_with_camera(
    pattern: str, camera_file: str, target: str, progress: Callable[[str], None] = lambda line: None
) -> Seen:
    """Measure the target in the images of one camera.

    Args:
        pattern: glob of the images, sorted as a person would.
        camera_file: its calibration (JSON, ROS's or OpenCV's YAML), or "fit": from these images.
        target: a board's spec or a body's file.
        progress: called with the name of each image.

    Raises:
        InputError: no such images, of another size than the camera's, or hardly one with the target.
    """
    files = sorted(map(Path, glob.glob(str(Path(pattern).expanduser()))), key=_natural)
    if not files:
        raise InputError(f"{pattern}: no such images; quote the glob")
    if len(files) == 1 and files[0].is_dir():
        raise InputError(f"{pattern}: a folder; give a glob of its images, quoted: '{files[0]}/*.png'")
    found = open_target(target)
    camera = None if camera_file == "fit" else read_camera(Path(camera_file))
    detections: list[Detections] = []
    size: tuple[int, int] | None = None if camera is None else camera.image_size_px
    for file in files:
        progress(f"reading {file.name}")
        image = read_image(file)
        here = (image.shape[1], image.shape[0])
        if size is not None and here != size:
            whose = "the first image" if camera is None else camera_file
            raise InputError(f"{file}: {here[0]}x{here[1]} px; {whose} has {size[0]}x{size[1]}")
        size = here
        detections.append(found.detect(grey(image)))
    notes: tuple[str, ...] = ()
    if camera is None and size is not None:
        camera = fit_camera(found, detections, size)
        notes = (
            f"the camera was calibrated from these images: fx {camera.intrinsics[0]:.1f} px; one of its own, from "
            "tilted views of a large board, would be independent of the arm",
        )
    assert camera is not None
    return _posed(found, camera, detections, files, notes)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts image2 before image10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def fit_camera(target: Target, detections: Sequence[Detections], size: tuple[int, int]) -> Camera:
    """Calibrate a camera from the images of a flat target.

    Raises:
        InputError: too few images with the target.
    """
    seen = [d for d in detections if len(d.ids) >= 6]
    if len(seen) < MIN_IMAGES:
        why = next((f"; {each.problem}" for each in detections if each.problem is not None), "")
        raise InputError(
            f"the target was found in {len(seen)} of {len(detections)} images; {MIN_IMAGES} are needed to calibrate the"
            f" camera{why}"
        )
    points = [np.asarray(target.body.points[d.ids], np.float32) for d in seen]
    _, K, k, _, _ = cv2.calibrateCamera(points, [d.uv.astype(np.float32) for d in seen], size, None, None)
    return Camera(size, "brown5", np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), np.asarray(k, np.float64).ravel()[:5])


def _posed(
    target: Target, camera: Camera, detections: list[Detections], files: list[Path], notes: tuple[str, ...]
) -> Seen:
    """Return the poses of one camera's detections."""
    points = target.body.points
    Ts, informations, missed, squares, count = [], [], [], 0.0, 0
    for d in detections:
        candidates = body_poses(points[d.ids], camera, d.uv) if len(d.ids) >= 4 else []
        if not candidates:
            Ts.append(np.eye(4))
            informations.append(np.eye(6))
            missed.append(d.problem or "its points do not determine a pose")
            continue
        refined = [_refined(points[d.ids], camera, T, d.uv) for T, _ in candidates[:2]]
        T, H, left = min(refined, key=lambda one: one[2])
        Ts.append(T)
        informations.append(H)
        missed.append("")
        squares, count = squares + left, count + 2 * len(d.ids) - 6
    if count == 0:
        raise InputError(f"the target was found in none of {len(files)} images ({missed[0]}): is --target right?")
    variance = squares / count
    covs = np.array([np.linalg.inv(H) * variance for H in informations])
    return Seen(
        np.array(Ts),
        covs,
        tuple(file.name for file in files),
        tuple(missed),
        None,
        points.mean(axis=0),
        _motions(target),
        float(np.sqrt(variance)),
        (*notes, *unseen_row(target, [d.ids for d, why in zip(detections, missed, strict=True) if not why])),
    )


def _refined(p: Array, camera: Camera, T: Array, uv: Array) -> tuple[Array, Array, float]:
    """Return the pose of least reprojection error, its information per px^2, and the sum of squares, px^2."""
    by_body = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -skew(p)], axis=2)
    H = np.eye(6)
    e = np.zeros_like(uv)
    for _ in range(STEPS):
        at, J_p, _ = camera.project_jacobians(transform(T, p))
        e, J = at - uv, J_p @ T[:3, :3] @ by_body
        H = np.einsum("nki,nkj->ij", J, J)
        step = -np.linalg.solve(H, np.einsum("nki,nk->i", J, e))
        T = T @ exp_se3(step)
        if np.abs(step).max() < SETTLED:
            break
    return T, H, float((e**2).sum())


def _motions(target: Target) -> tuple[Array, ...]:
    """Return the motions of the body under which it looks the same."""
    p = target.body.points
    out = []
    for permutation in target.symmetries:
        q = p[permutation]
        U, _, Vt = np.linalg.svd((p - p.mean(axis=0)).T @ (q - q.mean(axis=0)))
        R = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, q.mean(axis=0) - R @ p.mean(axis=0)
        out.append(T)
    return tuple(out)


def see_with_rig(
    rig_file: Path, source: Source, target: str, progress: Callable[[str], None] = lambda line: None
) -> Seen:
    """Measure the target in the pairs of a rig.

    Args:
        rig_file: the rig.
        source: its pairs of images.
        target: a board's spec or a body's file.
        progress: called with the name of each shot.

    Raises:
        InputError: no such files, or hardly a pair with the target.
    """
    rig, found = StereoRig.load_trusted(rig_file), open_target(target)
    Ts, covs, names, missed, squares, times, shown = [], [], [], [], [], [], []
    by: dict[int, Array] = {}
    while (shot := source.read()) is not None:
        progress(f"reading {shot.name}")
        result = measure(rig, found, shot)
        names.append(Path(shot.name).name)
        times.append(shot.t_s)
        if isinstance(result, Missed):
            Ts.append(np.eye(4))
            covs.append(np.eye(6))
            missed.append(result.reason)
            continue
        Ts.append(result.T_left_body)
        covs.append(result.cov_noise)
        by[len(Ts) - 1] = by_rig(result)
        missed.append("")
        shown.append(result.points.ids)
        squares.append(result.reprojection_rms_px**2)
    if not squares:
        raise InputError(
            f"none of {len(names)} pairs was measured: are --target, --left and --right right? {missed[0]}"
        )
    return Seen(
        np.array(Ts),
        np.array(covs),
        tuple(names),
        tuple(missed),
        None if None in times else np.array(times, float),
        found.body.points.mean(axis=0),
        _motions(found),
        float(np.sqrt(np.mean(squares))),
        unseen_row(found, shown),
        common=_common(rig.cov, by, len(Ts)),
    )


def _common(cov: Array, by: dict[int, Array], count: int) -> Array | None:
    """Return what the independent errors of a rig of one sigma do to the poses (N, 6, K); None where they do nothing.

    Args:
        cov: (P, P) covariance of the rig's parameters.
        by: pose -> (6, P) its derivative by them.
        count: N; poses that are missing are zero.
    """
    values, vectors = np.linalg.eigh(cov)
    J = np.zeros((count, 6, len(cov)))
    for k, D in by.items():
        J[k] = D @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    sizes = np.repeat([1.0, LEVER_M], 3)[:, None]  # m, and rotations by how they move a point at LEVER_M
    _, s, Vt = np.linalg.svd((sizes * J).reshape(-1, J.shape[2]), full_matrices=False)
    kept = s > COMMON * max(float(s[0]), LEAST_COMMON_M)
    return np.asarray(J @ Vt[kept].T) if kept.any() else None


def upright(A: Array, B: Array, symmetries: tuple[Array, ...], in_hand: bool) -> tuple[Array, NDArray[np.int64]]:
    """Decide which way up a board was that looks the same rotated: angles between poses are the same on both sides.

    Args:
        A: (N, 4, 4) poses of the flange.
        B: (N, 4, 4) poses of the body, some of them rotated by a symmetry.
        symmetries: the motions of the body that change nothing to see.
        in_hand: whether the eye is in the hand.

    Returns:
        B with the rotated ones rotated back to agree with the first, and which symmetry was used, -1 for none.
    """
    choices = [np.eye(4), *symmetries]
    options = np.stack([B @ S for S in choices])  # (S, N, 4, 4)
    RA = A[:, :3, :3]
    angle_A = _angles(np.swapaxes(RA, 1, 2)[:, None] @ RA[None])
    chosen = np.zeros(len(A), np.int64)
    for _ in range(20):
        R = options[chosen, np.arange(len(A))][:, :3, :3]
        costs = []
        for option in options[:, :, :3, :3]:
            if in_hand:  # A_i X B_i = Z: relative rotations of B_i^-1
                angle_B = _angles(option[:, None] @ np.swapaxes(R, 1, 2)[None])
            else:
                angle_B = _angles(np.swapaxes(option, 1, 2)[:, None] @ R[None])
            costs.append(np.abs(angle_B - angle_A).sum(axis=1))
        cost = np.array(costs)
        gain = cost[chosen, np.arange(len(A))] - cost.min(axis=0)
        gain[0] = 0.0
        worst = int(np.argmax(gain))
        if gain[worst] < 1e-6:
            break
        chosen[worst] = int(np.argmin(cost[:, worst]))
    return np.asarray(options[chosen, np.arange(len(A))]), chosen - 1


def steady(B: Array, symmetries: tuple[Array, ...]) -> Array:
    """Return poses B (N, 4, 4) of a stream, each rotated by the symmetry (4, 4) that is nearest to the pose before it."""
    out = B.copy()
    choices = np.stack([np.eye(4), *symmetries])
    for k in range(1, len(B)):
        options = B[k] @ choices
        out[k] = options[int(np.argmin(_angles(out[k - 1, :3, :3].T @ options[:, :3, :3])))]
    return out


def _angles(R: Array) -> Array:
    """Return the angles of rotations (..., 3, 3), rad."""
    return np.asarray(np.arccos(np.clip((np.trace(R, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))
