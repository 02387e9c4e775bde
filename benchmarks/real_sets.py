"""Metrics 1 to 3 on the chessboard recordings: ours beside cv2.calibrateCamera + cv2.stereoCalibrate."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import real_mrcal
from armsight.data import Correspondences, PoseEstimate
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.heldout import pair_errors, summary
from armsight.vision.camera import Camera
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from armsight.vision.match import join
from armsight.vision.pose.bundle import Observations
from armsight.vision.pose.measure import measure_detections
from armsight.vision.rig import StereoRig
from armsight.vision.sources import PairsSource

DATA = Path(os.environ.get("ARMSIGHT_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
#: Set -> image type, board, and the pairs a person would throw out after looking (a moving board, wrong corners).
SETS = {
    "webcams-360p": ("jpg", "chessboard:9x6:24.23mm", ("left3", "left16", "left23")),
    "opencv-480p": ("jpg", "chessboard:9x6:25mm", ("left08",)),
    "stereopi-240p": ("png", "chessboard:9x6:25mm", ("left_15",)),
}
CORNERS = 54


@dataclass
class Set:
    name: str
    board: object
    size: tuple[int, int]
    pairs: list[Pair]
    opencv: dict[str, dict[str, Correspondences]]
    bad: tuple[str, ...]


@cache
def load(name: str) -> Set:
    kind, spec, bad = SETS[name]
    board = open_board(spec)
    folder = DATA / "stereo" / name
    source = PairsSource.open(f"{folder}/left*.{kind}", f"{folder}/right*.{kind}")
    pairs, opencv = [], {"findChessboardCorners+cornerSubPix": {}, "findChessboardCornersSB": {}}
    for stored in source.pairs:
        shot = stored.load()
        images = grey(shot.left), grey(shot.right)
        pairs.append(Pair(shot.name, board.detect(images[0]), board.detect(images[1])))
        for finder, corners in (("findChessboardCorners+cornerSubPix", plain), ("findChessboardCornersSB", saddle)):
            found = [corners(image) for image in images]
            if all(c is not None for c in found):
                if np.dot(found[0][8] - found[0][0], found[1][8] - found[1][0]) < 0:
                    found[1] = found[1][::-1]
                uv = np.stack(found, axis=1).astype(float)
                opencv[finder][shot.name] = Correspondences(np.arange(CORNERS), uv, np.zeros((CORNERS, 2, 2, 2)))
    return Set(name, board, images[0].shape[::-1], pairs, opencv, bad)


def plain(image):
    found, corners = cv2.findChessboardCorners(image, (9, 6))
    if not found:
        return None
    grid = corners.reshape(6, 9, 2)
    spacing = min(np.linalg.norm(np.diff(grid, axis=k), axis=2).min() for k in (0, 1))
    half = int(np.clip(spacing / 3, 2, 11))  # a larger window reaches the next corners
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
    return cv2.cornerSubPix(image, corners.reshape(-1, 1, 2), (half, half), (-1, -1), criteria).reshape(-1, 2)


def saddle(image):
    found, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
    return corners.reshape(-1, 2) if found else None


#: How stereoCalibrate is called: the intrinsics of calibrateCamera held, or refined by both cameras together.
REFINE = {
    "": cv2.CALIB_FIX_INTRINSIC,
    ", intrinsics refined, FIX_K3": cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
}


def opencv_rig(points, shots: list[Correspondences], size, flags: int = cv2.CALIB_FIX_INTRINSIC) -> StereoRig:
    objects = [points[c.ids].astype(np.float32) for c in shots]
    left, right = ([np.ascontiguousarray(c.uv[:, i], np.float32) for c in shots] for i in (0, 1))
    k3 = flags & cv2.CALIB_FIX_K3
    _, K1, D1, _, _ = cv2.calibrateCamera(objects, left, size, None, None, flags=k3)
    _, K2, D2, _, _ = cv2.calibrateCamera(objects, right, size, None, None, flags=k3)
    _, K1, D1, K2, D2, R, T, _, _ = cv2.stereoCalibrate(objects, left, right, K1, D1, K2, D2, size, flags=flags)
    T_left_right = np.eye(4)
    T_left_right[:3, :3], T_left_right[:3, 3] = R.T, (-R.T @ T).ravel()
    cameras = [
        Camera(size, "brown5", np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), D.ravel()[:5].copy())
        for K, D in ((K1, D1), (K2, D2))
    ]
    return StereoRig(cameras[0], cameras[1], T_left_right, np.zeros((24, 24)), 0.1)


def parity(name: str) -> int:
    return int("".join(ch for ch in name if ch.isdigit())) % 2


def ours_of(pairs: list[Pair]) -> dict[str, Correspondences]:
    joined = {p.name: join(p.left, p.right) for p in pairs}
    return {name: c for name, c in joined.items() if c.paired.sum() >= 6}


def errors_on(rig, points, shots: list[Correspondences], estimated=None, motion=None):
    observations = Observations.from_shots(shots)
    return summary(pair_errors(rig, points, observations, estimated=estimated, motion=motion), 1)


def line(who: str, n: int, h) -> str:
    return f"  {who:76s} {n:3d} pairs  epipolar {h.epipolar_rms_px:.4f} px  board {1e3 * h.rigid_rms_m:.4f} mm"


def heldout_beside_opencv() -> None:
    print("\n1. Fitted on even pairs, measured on odd ones (RMS over all points)")
    for name in SETS:
        s = load(name)
        points = s.board.body.points
        print(f" {name}")
        ours = calibrate_boards(s.board, [p for p in s.pairs if parity(p.name) == 0], (s.size, s.size))
        odd = ours_of([p for p in s.pairs if parity(p.name)])
        best = {}
        for finder, shots in s.opencv.items():
            mine = {k: c for k, c in shots.items() if parity(k)}
            for how, flags in REFINE.items():
                rig = opencv_rig(points, [c for k, c in shots.items() if parity(k) == 0], s.size, flags)
                h = errors_on(rig, points, list(mine.values()))
                print(line(f"OpenCV, {finder}{how}", len(mine), h))
                for key in ("epipolar_rms_px", "rigid_rms_m"):
                    best[key] = min(best.get(key, np.inf), getattr(h, key))
            cross = errors_on(ours.rig, points, list(mine.values()))
            print(line("   our rig on those same OpenCV corners", len(mine), cross))
        for who, shots in (
            ("findChessboardCornersSB", s.opencv["findChessboardCornersSB"]),
            ("our corners", ours_of(s.pairs)),
        ):
            mine = [c for k, c in shots.items() if parity(k)]
            even = [c for k, c in shots.items() if parity(k) == 0]
            for lens in real_mrcal.MODELS if real_mrcal.available() else ():
                rig = real_mrcal.mrcal_rig(even, s.size, float(np.linalg.norm(points[1] - points[0])), lens)
                print(line(f"mrcal, {who}, {lens}", len(mine), errors_on(rig, points, mine)))
        h = errors_on(ours.rig, points, list(odd.values()))
        print(line(f"armsight ({ours.rig.left.model}, {len(ours.pairs)} pairs fitted)", len(odd), h))
        gain = [100 * (1 - getattr(h, key) / best[key]) for key in ("epipolar_rms_px", "rigid_rms_m")]
        print(f"  better than the best of OpenCV's metrics by {gain[0]:.0f}% (epipolar), {gain[1]:.0f}% (board)")
        everything = calibrate_boards(s.board, s.pairs, (s.size, s.size))
        chosen = calibrate_boards(s.board, [p for p in s.pairs if p.name not in s.bad], (s.size, s.size))
        good = [c for k, c in ours_of(s.pairs).items() if k not in s.bad]
        a, b = (errors_on(c.rig, points, good) for c in (everything, chosen))
        print(
            f"  all pairs / without {', '.join(s.bad)}: epipolar {a.epipolar_rms_px / b.epipolar_rms_px - 1:+.2%}, board "
            f"{a.rigid_rms_m / b.rigid_rms_m - 1:+.2%} on the good pairs; rejected: "
            f"{', '.join(r.pair for r in everything.rejected) or 'none'}"
        )


def half_subsets(count: int = 40) -> None:
    print(f"\n2. {count} seeded random halves of each set")
    for name in SETS:
        s = load(name)
        full = calibrate_boards(s.board, s.pairs, (s.size, s.size), models=("brown5",))
        rng = np.random.default_rng(20)
        ratio, focal, wrong = [], [], 0
        for _ in range(count):
            rows = rng.choice(len(s.pairs), len(s.pairs) // 2, replace=False)
            half = calibrate_boards(s.board, [s.pairs[i] for i in sorted(rows)], (s.size, s.size), models=("brown5",))
            ratio.append(half.reprojection_rms_px / full.reprojection_rms_px)
            focal += [
                abs(h.intrinsics[0] / f.intrinsics[0] - 1)
                for h, f in zip(half.rig.cameras, full.rig.cameras, strict=True)
            ]
            wrong += ratio[-1] > 1.5 or max(focal[-2:]) > 0.05
        print(
            f"  {name}: {wrong} in a wrong minimum; fit over the full set's at most {max(ratio):.2f}, focal length off "
            f"by at most {100 * max(focal):.2f}%"
        )


def normalised_residuals() -> None:
    print("\n3b. Held-out (odd) pairs: residual of triangulated corners over its predicted sigma, RMS (1 is honest)")
    for name in SETS:
        s = load(name)
        ours = calibrate_boards(s.board, [p for p in s.pairs if parity(p.name) == 0], (s.size, s.size))
        shots = ours_of([p for p in s.pairs if parity(p.name)])
        points = s.board.body.points
        good = [c for k, c in shots.items() if k not in s.bad]
        rig, found = ours.rig, ours.body.points
        if ours.motion is not None:
            rig = replace(rig, sigma_px=ours.solution.sigma_px)  # the rig's own holds the motion, as measuring needs it
        everything, chosen = (
            errors_on(rig, points, part, found, ours.motion).normalised_rms for part in (list(shots.values()), good)
        )
        print(
            f"  {name}: {everything:.3f} on all odd pairs, {chosen:.3f} without those a person would throw out{said(ours)}"
        )
        filed = errors_on(ours.rig, points, list(shots.values()), found).normalised_rms
        estimates = [
            r
            for p in s.pairs
            if parity(p.name)
            and isinstance(r := measure_detections(ours.rig, ours.body, p.left, p.right), PoseEstimate)
        ]
        print(
            f"    with the rig file's sigma_px of {ours.rig.sigma_px:.3f} px and no motion: {filed:.3f}; measured with it: "
            f"{len(estimates)} of {len(shots)}, misfit {np.mean([r.misfit for r in estimates]):.2f} mean, "
            f"{max(r.misfit for r in estimates):.2f} at most"
        )


def said(ours) -> str:
    if ours.motion is None:
        return "; boards found to stand still between the exposures"
    way, angle = 1e3 * ours.motion.rms_m, 1e3 * ours.motion.rms_rad
    return f"; boards found to move by {way:.3f} mm and {angle:.2f} mrad RMS an axis between the exposures"
