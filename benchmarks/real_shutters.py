"""Metric 8: free-running web cameras (caliscope-charuco): skew of each pair, and epipolar errors moved to one time."""

from __future__ import annotations

import csv
import tomllib
from collections import defaultdict
from dataclasses import replace

import cv2
import numpy as np

from armsight.data import Correspondences, Detections, Missed, PoseEstimate
from armsight.geometry.pose import inverse, pose
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.camera import Camera
from armsight.vision.image import grey
from armsight.vision.markers.targets import open_target
from armsight.vision.match import epipolar_distances, join
from armsight.vision.measure import measure_detections
from armsight.vision.rig import StereoRig
from armsight.vision.shutter import LOOSE_PX, Shutters, TimedShot, aligned, at_one_time, estimate_shutters
from real_sets import DATA

FOLDER = DATA / "real" / "caliscope-charuco"
SIZE, TARGET = (1280, 720), "charuco:4x5:54mm:40.5mm:DICT_4X4_1000"
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
ROUNDS = 3


def skews() -> None:
    print(
        "\n8. Four free-running web cameras, a board in the hand: fitted on even frames, epipolar RMS of odd frames, px"
    )
    if not FOLDER.is_dir():
        print(f"  skipped: no {FOLDER}")
        return
    target, seen, stamps = open_target(TARGET), {}, defaultdict(dict)
    for c in range(4):
        capture = cv2.VideoCapture(str(FOLDER / f"cam_{c}.mp4"))
        frames = 0
        while (frame := capture.read())[0]:
            seen[c, frames] = target.detect(grey(frame[1]))
            frames += 1
    with open(FOLDER / "timestamps.csv", newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            stamps[int(row["sync_index"])][int(row["cam_id"])] = float(row["frame_time"])
    t_s = np.array([[stamps[k][c] for c in range(4)] for k in sorted(stamps)])
    config = tomllib.loads((FOLDER / "config.toml").read_text(encoding="utf-8"))
    for left, right in PAIRS:
        one_pair(target, seen, t_s, config, left, right)


def published(config: dict, left: int, right: int) -> StereoRig:
    cameras, Ts = [], []
    for entry in (config[f"cam_{left}"], config[f"cam_{right}"]):
        K = np.array(entry["matrix"])
        cameras.append(Camera(SIZE, "brown5", K[[0, 1, 0, 1], [0, 1, 2, 2]], np.array(entry["distortions"])))
        Ts.append(pose(np.array(entry["rotation"]), np.array(entry["translation"])))
    return StereoRig(*cameras, Ts[0] @ inverse(Ts[1]), np.zeros((24, 24)), 0.1)


def timed(rig: StereoRig, target, seen, t_s, left: int, right: int) -> dict[int, TimedShot]:
    """Return the frames that show the board in both cameras."""
    shots, loose = {}, replace(rig, sigma_px=3 * LOOSE_PX)
    for k in range(len(t_s)):
        a, b = seen[left, k], seen[right, k]
        found = measure_detections(loose, target.body, a, b)
        if isinstance(found, PoseEstimate):
            shots[k] = TimedShot(t_s[k, left], join(a, b), found.T_left_body, t_s[k, right] - t_s[k, left])
    return shots


def points(seen: Correspondences, odd: bool) -> Correspondences:
    keep = seen.ids % 2 == odd
    return Correspondences(seen.ids[keep], seen.uv[keep], seen.cov_uv[keep])


def sides(name: int, seen: Correspondences) -> Pair:
    found = []
    for c in range(2):
        keep = seen.seen[:, c]
        found.append(Detections(seen.ids[keep], seen.uv[keep, c], seen.cov_uv[keep, c]))
    return Pair(str(name), *found)


def epipolar(rig: StereoRig, shots: list[Correspondences]) -> np.ndarray:
    uv = np.concatenate([s.uv[s.paired] for s in shots])
    distance = epipolar_distances(rig, uv[:, 0], uv[:, 1])
    return np.sqrt(np.mean(distance**2))


def one_pair(target, seen, t_s, config, left: int, right: int) -> None:
    body, rig = target.body, published(config, left, right)
    shots = timed(rig, target, seen, t_s, left, right)
    before = epipolar(rig, [shot.seen for k, shot in shots.items() if k % 2])
    even = [sides(k, shot.seen) for k, shot in shots.items() if k % 2 == 0]
    plain = calibrate_boards(target, even, (SIZE, SIZE), models=("brown5",)).rig
    simultaneous = epipolar(plain, [shot.seen for k, shot in shots.items() if k % 2])
    rig = replace(plain, sigma_px=0.1)
    shutters: Shutters | Missed = Missed("")
    for _ in range(ROUNDS):
        shots = timed(rig, target, seen, t_s, left, right)
        shutters = estimate_shutters(rig, body, list(shots.values()))
        if isinstance(shutters, Missed):
            break
        alignments = aligned(rig, body, list(shots.values()), shutters)
        moved = [
            sides(k, at_one_time(rig, body, shot.seen, a, shutters))
            for (k, shot), a in zip(shots.items(), alignments, strict=True)
            if k % 2 == 0 and a.motion is not None and a.motion.centred
        ]
        rig = replace(calibrate_boards(target, moved, (SIZE, SIZE), models=("brown5",)).rig, sigma_px=0.1)
    name = f"  cameras {left}, {right}: {len(shots)} frames; published rig {before:.2f}, ours {simultaneous:.2f}"
    if isinstance(shutters, Missed):
        print(f"{name}; {shutters.reason}", flush=True)
        return
    lines = []
    for each in (replace(shutters, jitter_s=0.0), shutters):
        halves = [replace(shot, seen=points(shot.seen, False)) for shot in shots.values()]
        alignments = aligned(rig, body, halves, each)
        known = [
            at_one_time(rig, body, points(shot.seen, True), a, each)
            for (k, shot), a in zip(shots.items(), alignments, strict=True)
            if k % 2 and a.motion is not None and a.motion.centred
        ]
        alone = [epipolar(rig, [s]) for s in known if s.paired.any()]
        lines.append(f"{epipolar(rig, known):.2f} (median {np.median(alone):.2f})")
    print(f"{name}; {shutters}: {lines[0]}; each frame's skew found from the other corners: {lines[1]}", flush=True)


if __name__ == "__main__":
    skews()
