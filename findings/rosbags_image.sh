#!/bin/sh
# rosbags-image 0.10.4: images with padded rows come out sheared, and compressed ones of 16 bits have 8; nothing says so.
#
# sensor_msgs/Image gives the length of a row in memory as step, which is more than width times the pixel's size where a driver
# aligns rows (to 64 bytes and more, on GPUs above all). message_to_cvimage takes height x width pixels from the start and
# ignores step: each row is displaced further than the one before, and the last rows are missing.
# CompressedImage is decoded by IMREAD_ANYCOLOR, which reduces 16 bits to 8: a PNG of depth in mm, "16UC1; png compressed
# 16UC1", is an array of uint8, and 1500 mm are 5. The same depth uncompressed comes out in 16 bits.
#
# Seen: rows of 60 px in 64 bytes: a vertical line at column 30 is at 30 34 38 42 in the first four.
# 1500 as mono16: uint16 1500; as a PNG of 16 bits: uint8 5.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 rosbags==0.11.9 rosbags-image==0.10.4 opencv-python-headless==5.0.0.93
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np
from rosbags.image import message_to_cvimage
from rosbags.typesys import Stores, get_typestore

types = get_typestore(Stores.ROS2_HUMBLE).types
header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "camera")


def image(pixels, encoding, step):
    """The message of an image whose rows have step bytes."""
    rows = pixels.view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, step - rows.shape[1]))).ravel()
    return types["sensor_msgs/msg/Image"](header, *pixels.shape, encoding, 0, step, data)


line = np.zeros((40, 60), np.uint8)
line[:, 30] = 200
plain, padded = (message_to_cvimage(image(line, "mono8", step)) for step in (60, 64))
columns = [int(np.argmax(row > 100)) for row in padded[:4]]
print("the line at column 30 is without padding at", [int(np.argmax(row > 100)) for row in plain[:4]], "and with it at", columns)
assert (plain == line).all()
assert padded.shape == line.shape and columns == [30, 34, 38, 42]

depth = np.full((40, 60), 1500, np.uint16)
raw = message_to_cvimage(image(depth, "mono16", 120))
message = types["sensor_msgs/msg/CompressedImage"](header, "16UC1; png compressed 16UC1", cv2.imencode(".png", depth)[1].ravel())
packed = message_to_cvimage(message)
print(f"1500 as mono16: {raw.dtype} {raw[0, 0]}; as a PNG of 16 bits: {packed.dtype} {packed[0, 0]}")
assert (raw.dtype, raw[0, 0]) == (np.uint16, 1500)
assert (packed.dtype, packed[0, 0]) == (np.uint8, 5)
PYTHON
