#!/bin/sh
# depthai 3.12.0: ImageManip on the host flips and rotates about another pixel: one column is lost, one is black.
#
# addFlipHorizontal, addFlipVertical and addRotateDeg by right angles put column x to WIDTH - x, not to WIDTH - 1 - x: the
# image is that of numpy or cv2.flip displaced by one pixel. The first column (row) of the result is 0, which no pixel of the
# camera was, and the camera's own first one is gone; of 320 x 200 a rotation by 90 degrees makes 199 x 320. Two cameras of
# which one is mounted upside down and put right by ImageManip differ by a pixel in x and in y from a calibration
# that was made with images that another program rotated: 1 px of disparity is 5 mm at 1 m (f 800 px, 0.25 m apart).
# The frame's own ImgTransformation says the same as its pixels do.
#
# Seen, a row 3 4 5 .. 34: flipped 0 34 33 32 .. 4, numpy 34 33 32 .. 3; rotated by 180 degrees the same, and its first row is
# all 0; 320 x 200 by 90 degrees: 199 x 320.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 opencv-python-headless==5.0.0.93 depthai==3.12.0
"$folder/venv/bin/python" - 2> /dev/null <<'PYTHON'
import time

import depthai
import numpy as np


def manipulated(image, change):
    """Return what ImageManip on this computer makes of an image, and where it says that pixel (2, 1) is."""
    with depthai.Pipeline(False) as pipeline:
        node = pipeline.create(depthai.node.ImageManip)
        node.setRunOnHost(True)
        node.setMaxOutputFrameSize(1 << 20)
        change(node.initialConfig)
        given, taken = node.inputImage.createInputQueue(), node.out.createOutputQueue()
        pipeline.start()
        frame = depthai.ImgFrame()
        frame.setCvFrame(image, depthai.ImgFrame.Type.GRAY8)
        frame.setTransformation(depthai.ImgTransformation(image.shape[1], image.shape[0]))
        given.send(frame)
        end, out = time.monotonic() + 30, None
        while out is None and time.monotonic() < end:
            out = taken.tryGet()
            time.sleep(0.02)
        said = out.getTransformation().transformPoint(depthai.Point2f(2, 1))
        return out.getCvFrame().reshape(out.getHeight(), out.getWidth(), -1)[..., 0], (round(said.x), round(said.y))


image = (np.arange(24 * 32).reshape(24, 32) % 251 + 3).astype(np.uint8)
changes = {
    "flipped": (lambda config: config.addFlipHorizontal(), image[:, ::-1], (30, 1), (1, 0)),
    "upside down": (lambda config: config.addFlipVertical(), image[::-1], (2, 23), (0, 1)),
    "rotated by 180": (lambda config: config.addRotateDeg(180), image[::-1, ::-1], (30, 23), (1, 1)),
}
for name, (change, expected, place, (x, y)) in changes.items():
    found, said = manipulated(image, change)
    print(f"{name}: rows begin {found[y][:4].tolist()}, numpy's {expected[0][:4].tolist()}; pixel (2, 1) is said to be at {said}")
    assert (found[y:, x:] == expected[: 24 - y, : 32 - x]).all()
    assert not found[:y].any() and not found[:, :x].any()
    assert said == place and found[said[1], said[0]] == image[1, 2]
found, _ = manipulated(np.zeros((200, 320), np.uint8), lambda config: config.addRotateDeg(90))
print("320 x 200 rotated by 90 degrees: {} x {}".format(*found.shape[::-1]))
assert found.shape[::-1] == (199, 320)
PYTHON
