"""Metric 8: free-running web cameras (caliscope-charuco): each pair by ``armsight calibrate --source``."""

from __future__ import annotations

import cv2
import numpy as np

from armsight.vision.calibrate.boards import Pair, calibrate_boards, calibrate_recording
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from real_sets import DATA

FOLDER = DATA / "real" / "caliscope-charuco"
SIZE, TARGET, RATE_HZ = (1280, 720), "charuco:4x5:54mm:40.5mm:DICT_4X4_1000", 6.0
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
#: Fewest corners with which a frame counts.
CORNERS = 6


def skews() -> None:
    print("\n8. Four free-running web cameras, a board in the hand: epipolar RMS of frames left out of the fit, px")
    if not FOLDER.is_dir():
        print(f"  skipped: no {FOLDER}")
        return
    board, seen = open_board(TARGET), {}
    for c in range(4):
        capture, frames = cv2.VideoCapture(str(FOLDER / f"cam_{c}.mp4")), 0
        while (frame := capture.read())[0]:
            seen[c, frames] = board.detect(grey(frame[1]))
            frames += 1
    for left, right in PAIRS:
        pairs = [Pair(f"{k:03d}", seen[left, k], seen[right, k]) for k in range(frames)]
        both = [p for p in pairs if min(len(p.left.ids), len(p.right.ids)) >= CORNERS]
        plain = calibrate_boards(board, both, (SIZE, SIZE), models=("brown5",)).held_out.epipolar_rms_px
        c = calibrate_recording(board, pairs, np.arange(frames) / RATE_HZ, (SIZE, SIZE), models=("brown5",))
        print(
            f"  cameras {left}, {right}: {len(both)} frames, as simultaneous {plain:.2f}; "
            f"at one time {c.held_out.epipolar_rms_px:.2f} ({len(c.pairs)} frames); {c.notes[-1]}",
            flush=True,
        )


if __name__ == "__main__":
    skews()
