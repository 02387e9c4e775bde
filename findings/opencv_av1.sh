#!/bin/sh
# opencv-python-headless 5.0.0.93: an AV1 video is opened, its frames are counted, and none is read; nothing says why.
#
# The wheel's FFmpeg has the demuxers and no decoder of AV1: isOpened() is True, size, rate and CAP_PROP_FRAME_COUNT are right,
# and the first grab() is False, as at the end of a file. PyAV's wheels of the same platform decode it (libdav1d). LeRobot
# records AV1 by default.
#
# Seen: opened True, 64x64, 10 frames, read 0; PyAV 18.1.0 reads 10.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 av==18.1.0
OPENCV_FFMPEG_LOGLEVEL=-8 "$folder/venv/bin/python" - "$folder/a.mp4" <<'PYTHON'
import sys

import av
import cv2
import numpy as np

with av.open(sys.argv[1], "w") as file:
    stream = file.add_stream("libsvtav1", 10, width=64, height=64, pix_fmt="yuv420p")
    for k in range(10):
        file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), 20 * k, np.uint8), format="bgr24")))
    file.mux(stream.encode(None))
capture = cv2.VideoCapture(sys.argv[1])
opened, count = capture.isOpened(), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
size = [int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
read = 0
while capture.grab():
    read += 1
with av.open(sys.argv[1]) as file:
    decoded = sum(1 for _ in file.decode(video=0))
print(f"opened {opened}, {size[0]}x{size[1]}, {count} frames, read {read}; PyAV reads {decoded}")
assert (opened, size, count, read, decoded) == (True, [64, 64], 10, 0, 10)
PYTHON
