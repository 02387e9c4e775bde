"""From images to poses of the target: one camera with its own calibration, or a rig.

In: image files, a target, a camera or a rig. Out: :class:`Seen`. One camera: the pose of least reprojection error, its
covariance from the pixels' scatter over all images; the camera may be calibrated from the same images.
"""

from __future__ import annotations

import glob
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from armsight.data import Array, Detections, Missed
from armsight.errors import InputError
from armsight.files import natural_key
from armsight.geometry.pose import pose
from armsight.geometry.rotation import nearest_rotation
from armsight.loop.handeye.poses import LEVER_M
from armsight.loop.handeye.recording import Seen
from armsight.vision.camera import Camera
from armsight.vision.camera_file import read_camera
from armsight.vision.image import BitDepth, grey, read_image
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import open_target
from armsight.vision.pose.locate import by_rig
from armsight.vision.pose.measure import measure
from armsight.vision.pose.pnp import body_poses
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from armsight.vision.rig import StereoRig
from armsight.vision.source import Source

#: Fewest images to calibrate a camera from; half: a camera of two views, double: sets of eight are rejected.
MIN_IMAGES = 5
#: Errors of the rig that do less than this part of what its largest one does, or of this, m, are nothing.
COMMON, LEAST_COMMON_M = 1e-2, 1e-6


def see_with_camera(
    pattern: str, camera_file: str, target: str, progress: Callable[[str], None] = lambda line: None
) -> Seen:
    """Measure the target in the images of one camera.

    ``camera_file``: its calibration (JSON, ROS's or OpenCV's YAML), or "fit": from these images. ``target``: a board's
    spec or a body's file.
    """
    files = sorted(map(Path, glob.glob(str(Path(pattern).expanduser()))), key=natural_key)
    if not files:
        raise InputError(f"{pattern}: no such images; quote the glob")
    if len(files) == 1 and files[0].is_dir():
        raise InputError(f"{pattern}: a folder; give a glob of its images, quoted: '{files[0]}/*.png'")
    found, detections = open_target(target), list[Detections]()
    camera = None if camera_file == "fit" else read_camera(Path(camera_file))
    size: tuple[int, int] | None = None if camera is None else camera.image_size_px
    depth = BitDepth.of_files(files)
    for file in files:
        progress(f"reading {file.name}")
        (image,) = depth.filled(read_image(file))
        here = (image.shape[1], image.shape[0])
        if size is not None and here != size:
            whose = "the first image" if camera is None else camera_file
            raise InputError(f"{file}: {here[0]}x{here[1]} px; {whose} has {size[0]}x{size[1]}")
        size = here
        detections.append(found.detect(grey(image)))
    notes = depth.notes
    if camera is None and size is not None:
        camera = fit_camera(found, detections, size)
        notes += (
            f"the camera was calibrated from these images: fx {camera.intrinsics[0]:.1f} px; one of its own, from "
            "tilted views of a large board, would be independent of the arm",
        )
    assert camera is not None
    return _posed(found, camera, detections, files, notes)


def fit_camera(target: Target, detections: Sequence[Detections], size: tuple[int, int]) -> Camera:
    """Calibrate a camera from the images of a flat target."""
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
        p, n = points[d.ids], len(d.ids)
        seen = PixelObservations(np.zeros(n, np.int64), np.arange(n), d.uv, np.tile(np.eye(2), (n, 1, 1)))
        candidates = body_poses(p, camera, d.uv) if n >= 4 else []
        fits = (fit_pose((camera, camera), np.eye(4), p, seen, T, robust=False) for T, _ in candidates[:2])
        best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.cost, default=None)
        Ts.append(np.eye(4) if best is None else best.T_left_body)
        informations.append(np.eye(6) if best is None else best.information)
        missed.append((d.problem or "its points do not determine a pose") if best is None else "")
        if best is not None:
            squares, count = squares + best.cost, count + 2 * n - 6
    if count == 0:
        raise InputError(f"the target was found in none of {len(files)} images ({missed[0]}): is --target right?")
    variance = squares / count
    return Seen(
        np.array(Ts),
        np.linalg.inv(np.array(informations)) * variance,
        tuple(file.name for file in files),
        tuple(missed),
        None,
        points.mean(axis=0),
        _motions(target),
        float(np.sqrt(variance)),
        (*notes, *unseen_row(target, [d.ids for d, why in zip(detections, missed, strict=True) if not why])),
    )


def _motions(target: Target) -> tuple[Array, ...]:
    """Return the motions of the body under which it looks the same."""
    p, middle = target.body.points, target.body.points.mean(axis=0)
    out = []
    for permutation in target.symmetries:
        q = p[permutation]
        R = nearest_rotation((q - q.mean(axis=0)).T @ (p - middle))
        out.append(pose(R, q.mean(axis=0) - R @ middle))
    return tuple(out)


def see_with_rig(
    rig_file: Path, source: Source, target: str, progress: Callable[[str], None] = lambda line: None
) -> Seen:
    """Measure the target in the pairs of a rig."""
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
        by[len(Ts)] = by_rig(result)
        Ts.append(result.T_left_body)
        covs.append(result.cov_noise)
        missed.append("")
        shown.append(result.points.ids)
        squares.append(result.reprojection_rms_px**2)
    if not squares:
        raise InputError(f"none of {len(names)} pairs was measured: are --target and --source right? {missed[0]}")
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
    """Return what the independent errors of a rig of one sigma do to N poses (N, 6, K); None where they do nothing."""
    values, vectors = np.linalg.eigh(cov)
    J = np.zeros((count, 6, len(cov)))
    for k, D in by.items():
        J[k] = D @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    sizes = np.repeat([1.0, LEVER_M], 3)[:, None]  # m, and rotations by how they move a point at LEVER_M
    _, s, Vt = np.linalg.svd((sizes * J).reshape(-1, J.shape[2]), full_matrices=False)
    kept = s > COMMON * max(float(s[0]), LEAST_COMMON_M)
    return np.asarray(J @ Vt[kept].T) if kept.any() else None
