#!/bin/sh
# opencv-python-headless 5.0.0.93, imageio-ffmpeg 0.8.1 (FFmpeg 9.0): two files of one clock are paired as if both began at 0.
#
# Cameras that one program records do not begin at the same moment: 0.1 to 0.7 s apart over USB. Matroska keeps that: files of
# one GStreamer pipeline (matroskamux 1.22, offset-to-zero is off) begin at the pipeline's time of their first frame. Its
# qtmux and avimux drop it. OpenCV's CAP_PROP_POS_MSEC counts from each file's first frame, and ffmpeg takes each input's start
# away before a filter sees it: hstack puts images side by side that were taken apart. Only PyAV's pts are the clock's.
# A pair of cameras sees what moves at 0.5 m/s 117 mm apart then, and all that rests right.
#
# Seen: frame k is taken at k / 30 s, the left file holds 3 and on, the right one 10 and on. First frame, ms: OpenCV 0 and 0,
# PyAV 100 and 333; hstack's first: 3 beside 10.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 av==18.1.0 opencv-python-headless==5.0.0.93 imageio-ffmpeg==0.8.1
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import subprocess
from fractions import Fraction

import av
import cv2
import imageio_ffmpeg
import numpy as np


def record(path, first):
    """Write frames of 30 a second on one clock, each with its number as its grey level."""
    with av.open(path, "w") as file:
        stream = file.add_stream("ffv1", 30, width=64, height=48, pix_fmt="gray")
        for k in range(first, first + 20):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64), 5 * k, np.uint8), format="gray")
            frame.pts, frame.time_base = k, Fraction(1, 30)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def first_frame(path):
    with av.open(path) as file:
        frame = next(file.decode(video=0))
        return frame.to_ndarray(format="gray"), round(1000 * frame.time)


record("left.mkv", 3)
record("right.mkv", 10)
opencv, pyav = [], []
for path in ("left.mkv", "right.mkv"):
    capture = cv2.VideoCapture(path)
    assert capture.read()[0]
    opencv.append(round(capture.get(cv2.CAP_PROP_POS_MSEC)))
    pyav.append(first_frame(path)[1])
ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", "left.mkv", "-i", "right.mkv"]
subprocess.run([*ffmpeg, "-filter_complex", "hstack", "-c:v", "ffv1", "-frames:v", "1", "both.mkv"], check=True)
both, _ = first_frame("both.mkv")
beside = [int(both[24, column]) // 5 for column in (32, 96)]
print("first frame, ms: OpenCV", opencv, "PyAV", pyav, "; beside each other in hstack's first:", beside)
assert opencv == [0, 0] and pyav == [100, 333] and beside == [3, 10]
PYTHON
