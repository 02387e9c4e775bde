"""Metric 7: boards of discs, real ones beside findCirclesGrid and cv2.stereoCalibrate, and rendered before wide lenses."""

from __future__ import annotations

import time

import cv2
import numpy as np

from armsight.geometry.pose import inverse, transform
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.optics import Optics
from armsight.sim.render.render import render_pair
from armsight.sim.render.scene import PosedBody, circle_grid
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.heldout import pair_errors, summary
from armsight.vision.discs.bias import disc_bias
from armsight.vision.image import grey, read_image
from armsight.vision.markers.board import open_board
from armsight.vision.match import join
from armsight.vision.pose.bundle import Observations
from armsight.vision.sources import PairsSource
from real_sets import DATA, opencv_rig, ours_of

#: Folder -> images, board, and the size and layout that OpenCV's finder takes.
SETS = {
    "discocal": ("*.png", "circles:4x3:90mm", (4, 3), cv2.CALIB_CB_SYMMETRIC_GRID),
    "dice-dots": ("*.jpg", "circles:14x10:7mm:rings=2x7,11x7,2x2", (14, 10), cv2.CALIB_CB_SYMMETRIC_GRID),
    "boof-circle-regular": ("*.jpg", "circles:10x8:25mm", (10, 8), cv2.CALIB_CB_SYMMETRIC_GRID),
    "boof-circle-asym": ("*.jpg", "acircles:4x5:30mm", (4, 5), cv2.CALIB_CB_ASYMMETRIC_GRID),
    "open3dv-discs": ("*.png", "acircles:7x11:10mm", (7, 11), cv2.CALIB_CB_ASYMMETRIC_GRID),
}


def blob_detector(image) -> cv2.SimpleBlobDetector:
    """OpenCV's blob detector, opened for discs of any size."""
    p = cv2.SimpleBlobDetector_Params()
    p.minArea, p.maxArea, p.filterByConvexity = 30, image.size / 20, False
    p.filterByInertia = p.filterByCircularity = False
    p.minThreshold, p.maxThreshold, p.thresholdStep = 10, 240, 10
    return cv2.SimpleBlobDetector_create(p)


def opencv_discs(image, size, layout):
    for pixels in (image, 255 - image):
        for flags in (layout, layout | cv2.CALIB_CB_CLUSTERING):
            ok, uv = cv2.findCirclesGrid(pixels, size, flags=flags, blobDetector=blob_detector(image))
            if ok:
                return uv.reshape(-1, 2).astype(float)
    return None


def found_beside_opencv() -> None:
    print("\n7. Boards of discs: images in which the board is found; time of ours")
    for name, (images, spec, size, layout) in SETS.items():
        paths = sorted((DATA / "real" / name).glob(images))
        if not paths:
            print(f"  {name}: not here")
            continue
        board, ours, theirs, spent = open_board(spec), 0, 0, []
        for path in paths:
            image = grey(read_image(path))
            started = time.perf_counter()
            ours += board.detect(image).problem is None
            spent.append(time.perf_counter() - started)
            theirs += opencv_discs(image, size, layout) is not None
        print(f"  {name}: {ours} of {len(paths)}, findCirclesGrid {theirs}; {1e3 * np.median(spent):.0f} ms")


def heldout_beside_opencv() -> None:
    print(
        "\n7. Held-out errors of disc boards (folds), and those of stereoCalibrate on the same detections (even, odd pairs)"
    )
    for name, published in {
        "discocal": "f 496.3, 491.1 px, baseline 96.65 mm",
        "dice-dots": "the same kind of rig: f 6673/6669, 6608/6603 px, baseline 123.5 mm",
    }.items():
        folder = DATA / "real" / name
        images, spec, _, _ = SETS[name]
        if not folder.is_dir():
            continue
        board, pairs = open_board(spec), []
        for stored in PairsSource.open(f"{folder}/left{images}", f"{folder}/right{images}").pairs:
            shot = stored.load()
            seen = [grey(shot.left), grey(shot.right)]
            pairs.append(Pair(shot.name, *(board.detect(image) for image in seen)))
        size = seen[0].shape[::-1]
        c = calibrate_boards(board, pairs, (size, size))
        left, right = c.rig.left.intrinsics, c.rig.right.intrinsics
        print(
            f"  {name}: {len(c.pairs)} of {len(pairs)} pairs, epipolar {c.held_out.epipolar_rms_px:.3f} px (pairs' median "
            f"{np.median(c.errors.epipolar_px):.3f}), board {1e3 * c.held_out.rigid_rms_m:.4f} mm, the board's deviation "
            f"{1e3 * c.deviation_m:.4f} mm, {c.rig.left.model}\n    f {left[0]:.1f} {left[1]:.1f}, {right[0]:.1f} "
            f"{right[1]:.1f} px, baseline {1e3 * c.rig.baseline_m:.2f} mm, radius {1e3 * c.disc_radius_m:.3f} mm\n"
            f"    published: {published}"
        )
        shots = list(ours_of(pairs).values())
        whole = [shot for shot in shots if shot.paired.sum() >= 6]
        whole = [type(s)(s.ids[s.paired], s.uv[s.paired], s.cov_uv[s.paired]) for s in whole]
        rig = opencv_rig(board.body.points, whole[::2], size)
        e = summary(pair_errors(rig, board.body.points, Observations.from_shots(whole[1::2])), 1)
        print(
            f"    stereoCalibrate, bias not modelled: epipolar {e.epipolar_rms_px:.3f} px, board {1e3 * e.rigid_rms_m:.4f} "
            f"mm, f {rig.left.intrinsics[0]:.1f}, {rig.right.intrinsics[0]:.1f} px, baseline {1e3 * rig.baseline_m:.2f} mm"
        )


def rendered_wide(count: int = 12) -> None:
    print(f"\n7. Rendered boards of discs, {count} pairs of 1280x720: middles against truth, and the rig")
    for name, lens, focal, spec, kind in (
        ("wide lens, few large discs", "brown5", 450.0, "circles:4x3:90mm", {"radius_m": 0.035}),
        ("fisheye", "fisheye", 380.0, "circles:7x5:40mm", {"radius_m": 0.014}),
        ("many small discs", "brown5", 900.0, "circles:10x10:12mm", {"radius_m": 0.003}),
        ("staggered", "brown5", 600.0, "acircles:4x11:20mm", {"radius_m": 0.007, "asymmetric": True}),
    ):
        rig, board = example_rig(focal_px=focal, model=lens, baseline_m=0.1, convergence_deg=4.0), open_board(spec)
        columns, rows = (int(n) for n in spec.split(":")[1].split("x"))
        pattern, rng = circle_grid(columns, rows, board.pitch_m, **kind), np.random.default_rng(7)
        optics, pairs, errors = Optics(0.8, 0.3, (0.2, -0.1)), [], []
        for n, T in enumerate(board_poses(np.random.default_rng(3), rig, pattern, count)):
            images = render_pair(rig.cameras, rig.T_left_right, [PosedBody((pattern,), T)], optics=optics, rng=rng)
            pairs.append(Pair(f"{n}", *(board.detect(image) for image in images)))
            poses = T, inverse(rig.T_left_right) @ T
            for camera, pose, seen in zip(rig.cameras, poses, (pairs[-1].left, pairs[-1].right), strict=True):
                off = []
                for order in (np.arange(len(board.body.points)), *board.symmetries):
                    p = board.body.points[order[seen.ids]]
                    off.append(
                        seen.uv - disc_bias(camera, pose, p, kind["radius_m"]) - camera.project(transform(pose, p))
                    )
                errors.append(min(off, key=lambda e: np.abs(e).sum()))
        found = sum(join(pair.left, pair.right).paired.sum() for pair in pairs)
        c = calibrate_boards(board, pairs, (rig.left.image_size_px,) * 2)
        focal_error = max(
            abs(100 * (a / b - 1))
            for x, y in zip(c.rig.cameras, rig.cameras, strict=True)
            for a, b in zip(x.intrinsics[:2], y.intrinsics[:2], strict=True)
        )
        print(
            f"  {name}: {found} of {count * columns * rows} discs in both images, middles off by "
            f"{np.sqrt((np.concatenate(errors) ** 2).mean()):.4f} px RMS an axis; f within {focal_error:.4f}%, baseline "
            f"within {1e3 * abs(c.rig.baseline_m - rig.baseline_m):.4f} mm"
        )
