#!/bin/sh
# opencv-python-headless 5.0.0.93, av 18.1.0: an AVI with dropped frames says more frames than it has; index / rate is no time.
#
# A recorder that misses a frame writes an empty chunk to an AVI: "as before". Its header counts those. OpenCV's
# CAP_PROP_FRAME_COUNT and PyAV's stream.frames give that number, reading gives the frames that are there, and OpenCV's
# CAP_PROP_POS_FRAMES counts and seeks among these: frame k is not at k / rate, and the last ones that the count promises
# cannot be read. imageio's FFMPEG plugin repeats frames instead, to the header's count. MP4 and MOV count what they have.
# A check that a file is whole by its count calls this one damaged. CAP_PROP_POS_MSEC and PyAV's pts are right.
#
# Seen, of frames 0 to 22 at 30 a second, 15 were stored: AVI: count 23, 15 read by OpenCV and PyAV, 23 by imageio; position 5
# is frame 7, at 233 ms; MP4: count 15, 15 read.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 av==18.1.0 opencv-python-headless==5.0.0.93 imageio==2.38.1 imageio-ffmpeg==0.8.1
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
from fractions import Fraction

import av
import cv2
import imageio.v3 as imageio
import numpy as np

KEPT, RATE = [0, 1, 2, 3, 4, 7, 8, 9, 12, 13, 14, 15, 20, 21, 22], 30


def number(image):
    """The number of a frame, which is its grey level."""
    return round(float(np.mean(image)) / 10)


for name, codec, pixels in (("a.avi", "mjpeg", "yuvj420p"), ("a.mp4", "libx264", "yuv420p")):
    with av.open(name, "w") as file:
        stream = file.add_stream(codec, RATE, width=64, height=48, pix_fmt=pixels)
        for k in KEPT:
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 10 * k, np.uint8), format="bgr24")
            frame.pts, frame.time_base = k, Fraction(1, RATE)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    with av.open(name) as file:
        promised = file.streams.video[0].frames
        times = [round(float(frame.time) * RATE) for frame in file.decode(video=0)]
    capture, read = cv2.VideoCapture(name), []
    while capture.grab():
        read.append((number(capture.retrieve()[1]), round(capture.get(cv2.CAP_PROP_POS_MSEC))))
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.set(cv2.CAP_PROP_POS_FRAMES, 5)
    fifth = number(capture.read()[1])
    repeated = len([number(image) for image in imageio.imiter(name, plugin="FFMPEG")])
    print(f"{name}: counts {count} and {promised}, read {len(read)} and {len(times)}, imageio {repeated}; position 5 is {fifth}")
    assert (count, promised) == ((23, 23) if name == "a.avi" else (15, 15))
    assert times == KEPT == [k for k, _ in read]
    assert all(abs(ms - 1000 * k / RATE) <= 1 for k, ms in read)
    assert fifth == 7
    assert name != "a.avi" or repeated == 23
PYTHON
