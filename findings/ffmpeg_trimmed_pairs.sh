#!/bin/sh
# imageio-ffmpeg 0.8.1 (FFmpeg 9.0): two videos trimmed at the same time without re-encoding stay in step in MP4, not in Matroska.
#
# ffmpeg -ss 0.5 -c copy can only begin at a keyframe. In MP4 it keeps the frames from there to 0.5 s, hidden by an edit list:
# OpenCV and PyAV begin at 0.5 s. In Matroska they are shown: each file begins at its own keyframe, and
# both begin at time 0. Cameras put keyframes where they like, so a pair that was in step is out of it by up to the
# longest distance of keyframes, and no stamp says so. What the edit list hides still counts: OpenCV's CAP_PROP_FRAME_COUNT and
# PyAV's stream.frames promise frames that reading does not give.
#
# Seen, frame k at k / 30 s, keyframes each 30 (left) and each 12 (right), trimmed at 0.5 s: first frames MP4 15 and 15, Matroska
# 0 and 12, both at 0 ms; MP4's left has 60 frames by its count and 45 that are read.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 av==18.1.0 opencv-python-headless==5.0.0.93 imageio-ffmpeg==0.8.1
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import subprocess

import av
import cv2
import imageio_ffmpeg
import numpy as np


def record(path, keyframes):
    """Write 60 frames of 30 a second, each with its number as its grey level."""
    with av.open(path, "w") as file:
        stream = file.add_stream("libx264", 30, width=64, height=48, pix_fmt="yuv420p")
        stream.options = {"g": str(keyframes), "bf": "0", "sc_threshold": "0", "qp": "0"}
        for k in range(60):
            frame = av.VideoFrame.from_ndarray(np.full((72, 64), 128, np.uint8), format="yuv420p")
            np.frombuffer(frame.planes[0], np.uint8)[:] = 20 + 3 * k
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def read(path):
    """Return the first frame's number and time, ms, how many frames there are, and how many the file promises."""
    capture, times = cv2.VideoCapture(path), []
    with av.open(path) as file:
        promised = file.streams.video[0].frames
        numbers = [(int(frame.to_ndarray()[10, 10]) - 20) // 3 for frame in file.decode(video=0)]
    while capture.grab():
        if not times:  # OpenCV's grey is of the range 0 to 255, the file's of 16 to 235
            first = round((int(capture.retrieve()[1][10, 10, 0]) * 219 / 255 - 4) / 3)
        times.append(round(capture.get(cv2.CAP_PROP_POS_MSEC)))
    assert (first, len(times)) == (numbers[0], len(numbers))  # both read the same
    if path.endswith("mp4"):
        assert promised == int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    return first, times[0], len(times), promised


record("left.mp4", 30)
record("right.mp4", 12)
found = {}
for kind in ("mp4", "mkv"):
    for side in ("left", "right"):
        trimmed = f"{side}_trimmed.{kind}"
        copy = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-ss", "0.5", "-i", f"{side}.mp4", "-c", "copy"]
        subprocess.run([*copy, trimmed], check=True)
        found[kind, side] = read(trimmed)
        print("{}: first frame {} at {} ms, {} read, {} promised".format(trimmed, *found[kind, side]))
assert [found["mp4", side][:2] for side in ("left", "right")] == [(15, 0), (15, 0)]
assert [found["mkv", side][:2] for side in ("left", "right")] == [(0, 0), (12, 0)]
assert found["mp4", "left"][2:] == (45, 60)
PYTHON
