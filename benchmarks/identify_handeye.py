"""Hand-eye calibration on real recordings: a camera in a KUKA's hand, and pairs of streams with an unknown time offset."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.loop.handeye.handeye import calibrate_handeye
from armsight.loop.handeye.streams import PoseStream, calibrate_streams
from armsight.vision.image import grey, read_image
from armsight.vision.markers.board import open_board

#: Archive -> the ends of the names of the hand's and the eye's stream.
PAIRS = {
    "robot_arm_w_color_camera_sim": ("sim_hand.csv", "sim_camera.csv"),
    "robot_arm_w_color_camera_real": ("sr300_hinge.csv", "target_ir.csv"),
    "prime_sense_color_w_vicon_1": ("vicon_prime_sense.csv", "rgb_image_raw.csv"),
}
#: Poses of the simulated arm's eye in a second.
BLOCK = 30


def kuka2(folder: Path, report) -> None:
    """Fit on even poses, the camera's own numbers too; the board's middle in the base on odd ones."""
    if not folder.is_dir():
        return
    board = open_board("chessboard:24x17:15mm")
    A = np.loadtxt(folder / "RobotPosesVec.txt").reshape(-1, 4, 4)
    seen = [board.detect(grey(read_image(folder / f"im_{i + 1:02d}.png"))) for i in range(len(A))]
    p, middle = board.body.points, board.body.points.mean(axis=0)
    even, odd = np.arange(0, len(A), 2), np.arange(1, len(A), 2)
    points = [p[seen[i].ids].astype(np.float32) for i in even]
    positions = [seen[i].uv.astype(np.float32) for i in even]
    _, K, k, _, _ = cv2.calibrateCamera(points, positions, (1920, 1200), None, None)
    B = []
    for d in seen:
        _, r, t = cv2.solvePnP(p[d.ids], d.uv, K, k)
        B.append(pose(cv2.Rodrigues(r)[0], t.ravel()))
    B = np.array(B)
    h = calibrate_handeye(A[even], B[even], eye="in_hand", centre=middle)
    off = transform(A[odd] @ h.T_flange_held @ B[odd], middle) - transform(h.T_base_still, middle)
    report(
        "kuka2, board's middle, even to odd",
        1e3 * float(np.linalg.norm(off, axis=1).mean()),
        0.55,
        more=f", {h.structure}",
    )


def stream(archive: zipfile.ZipFile, end: str) -> tuple[np.ndarray, np.ndarray]:
    name = next(name for name in archive.namelist() if name.endswith(end))
    D = np.loadtxt(io.BytesIO(archive.read(name)), delimiter=",")
    T = np.tile(np.eye(4), (len(D), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(D[:, 4:8]).as_matrix(), D[:, 1:4]
    return D[:, 0], T


def pair(folder: Path, name: str) -> tuple[PoseStream, np.ndarray, np.ndarray]:
    """The hand's stream, and times and poses of what the eye sees."""
    hand_end, eye_end = PAIRS[name]
    with zipfile.ZipFile(folder / f"{name}.zip") as archive:
        t, T = stream(archive, eye_end)
        return PoseStream.of(*stream(archive, hand_end), "hand"), t, inverse(T)


def eth_pairs(folder: Path, report) -> None:
    """The time offset of both halves of each recording."""
    if not folder.is_dir():
        return
    for name in PAIRS:
        hand, t, B = pair(folder, name)
        late = t > np.median(t)
        found = [calibrate_streams(hand, PoseStream.of(t[r], B[r], "eye"), eye="in_hand") for r in (~late, late)]
        a, b = (f.offset_s for f in found)
        sigma = float(np.hypot(*(f.sigma_offset_s for f in found)))
        more = f": {1e3 * a:.2f} and {1e3 * b:.2f} ms, sigma of the difference {1e3 * sigma:.2f}"
        report(f"{name}, halves apart", 1e3 * abs(a - b), 2.0, "ms", more)
    simulated(folder, report)


def simulated(folder: Path, report, seeds: int = 4) -> None:
    """The simulated arm: one clock, so no offset; and its own motion and residuals with a mounting that is known.

    The mounting that its authors simulated is in no file of theirs. What the hand did is taken from the recording, what the
    eye saw of it is made from the mounting found, and the residuals of the recording are put on it in blocks of 1 s sampled
    anew: their size and how neighbours hang together are the recording's, and the answer is known.
    """
    hand, t, B = pair(folder, "robot_arm_w_color_camera_sim")
    found = calibrate_streams(hand, PoseStream.of(t, B, "eye"), eye="in_hand")
    more = f": {1e3 * found.offset_s:.2f} ms, sigma {1e3 * found.sigma_offset_s:.2f}; stamps are whole milliseconds"
    report(
        "simulated arm, offset from its one clock's zero",
        abs(found.offset_s) / found.sigma_offset_s,
        3.0,
        "sigma",
        more,
    )
    A, good = hand.at(t + found.offset_s)
    t, A, B = t[good], A[good], B[good]
    seen = found.handeye.predict(A)
    left = log_se3(inverse(seen) @ B)
    off = []
    for seed in range(seeds):
        starts = np.random.default_rng(seed).integers(0, len(t) - BLOCK, len(t) // BLOCK + 1)
        sampled = np.concatenate([left[s : s + BLOCK] for s in starts])[: len(t)]
        again = calibrate_streams(hand, PoseStream.of(t, seen @ exp_se3(sampled), "eye"), eye="in_hand")
        h, true = again.handeye, found.handeye
        e = np.concatenate(
            [
                log_se3(inverse(true.T_base_body) @ h.T_base_still),
                log_se3(inverse(true.T_flange_rig) @ h.T_flange_held),
            ]
        )
        off += [*(e / np.sqrt(np.diag(h.cov))), (again.offset_s - found.offset_s) / again.sigma_offset_s]
    rms = float(np.sqrt(np.mean(np.square(off))))
    report(
        f"simulated arm, known answer, furthest of {len(off)}",
        float(np.abs(off).max()),
        3.5,
        "sigma",
        f", RMS {rms:.2f}",
    )
