#!/bin/sh
# av 18.1.0 and opencv-python-headless 5.0.0.93: a video that is shown mirrored is read as rotated by 180 degrees, or as it is.
#
# An MP4 says how to show its frames by a matrix, which phones write. For rotations by right angles OpenCV's VideoCapture
# rotates the images (CAP_PROP_ORIENTATION_AUTO), and PyAV's frame.rotation says by how much. A mirroring in the matrix, as
# front cameras and ffmpeg -display_hflip write, is lost in both, which take the angle of its first row: left and
# right exchanged is a rotation by 180 degrees, top and bottom exchanged is nothing. The image is then the mirror image of
# what is shown, at another place: poses from it are of a mirrored world. The ffmpeg program shows all of them right.
#
# Seen, grey levels of the quarters (top left, top right, bottom left, bottom right); stored 247 147 77 0:
#   left and right exchanged:  ffmpeg 147 247 0 77, OpenCV 0 77 147 247, PyAV's rotation -180
#   top and bottom exchanged:  ffmpeg 77 0 247 147, OpenCV 247 147 77 0, PyAV's rotation 0
#   rotated by 180 degrees:    ffmpeg 0 77 147 247, OpenCV 0 77 147 247, PyAV's rotation -180
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 av==18.1.0 opencv-python-headless==5.0.0.93 imageio-ffmpeg==0.8.1
"$folder/venv/bin/python" - "$folder/a.mp4" <<'PYTHON'
import struct
import subprocess
import sys
from pathlib import Path

import av
import cv2
import imageio_ffmpeg
import numpy as np

WIDTH, HEIGHT = 96, 64
path = Path(sys.argv[1])
scene = np.kron(np.array([[[250], [150]], [[80], [0]]], np.uint8), np.ones((HEIGHT // 2, WIDTH // 2, 3), np.uint8))
with av.open(str(path), "w") as file:
    stream = file.add_stream("libx264", 10, width=WIDTH, height=HEIGHT, pix_fmt="yuv420p")
    for _ in range(3):
        file.mux(stream.encode(av.VideoFrame.from_ndarray(scene, format="bgr24")))
    file.mux(stream.encode(None))
data = bytearray(path.read_bytes())
at = data.index(b"tkhd") + 44  # the matrix of a track header of version 0, ISO 14496-12


def quarters(image):
    return [int(image[y, x].mean()) for y in (HEIGHT // 4, 3 * HEIGHT // 4) for x in (WIDTH // 4, 3 * WIDTH // 4)]


def by_ffmpeg():
    form = ("-frames:v", "1", "-f", "rawvideo", "-pix_fmt", "bgr24", "-")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), *form]
    out = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(out, np.uint8).reshape(HEIGHT, WIDTH, 3)


for name, a, d, shown, opencv, rotation in (
    ("left and right exchanged", -1, 1, np.fliplr, lambda image: image[::-1, ::-1], -180),
    ("top and bottom exchanged", 1, -1, np.flipud, lambda image: image, 0),
    ("rotated by 180 degrees", -1, -1, lambda image: image[::-1, ::-1], lambda image: image[::-1, ::-1], -180),
):
    moved = WIDTH * (a < 0), HEIGHT * (d < 0)
    data[at : at + 36] = struct.pack(">9i", a << 16, 0, 0, 0, d << 16, 0, moved[0] << 16, moved[1] << 16, 1 << 30)
    path.write_bytes(data)
    with av.open(str(path)) as file:
        frame = next(file.decode(video=0))
    found = cv2.VideoCapture(str(path)).read()[1]
    print(f"{name}: ffmpeg {quarters(by_ffmpeg())}, OpenCV {quarters(found)}, PyAV's rotation {frame.rotation}")
    assert np.allclose(quarters(by_ffmpeg()), quarters(shown(scene)), atol=6)
    assert np.allclose(quarters(found), quarters(opencv(scene)), atol=6)
    assert frame.rotation == rotation
PYTHON
