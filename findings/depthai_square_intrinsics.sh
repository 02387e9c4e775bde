#!/bin/sh
# depthai 2.33.0 and 3.12.0: the intrinsics of a cropped image are those of one with borders.
#
# CalibrationHandler.getCameraIntrinsics(socket, width, height) with keepAspectRatio, the default, is documented to scale by
# width or height, by what gives the larger image, and to crop the other side. It always scales by the width: a sensor of
# 1280 x 800 asked for 400 x 400 has f 250 px, as an image with borders above and below has, where an image of 400 x 400
# that is cropped from it has f 400 px. A distance computed by it is too short by 1.6. Where the image asked for is wider
# than the sensor's the two agree (1280 x 720: f 800). The principal point is the same in both.
#
# Seen: 400 x 400: 250 px; 640 x 480: 400 px (480 cropped); 1280 x 720: 800 px; in both versions.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 2.33.0.0 3.12.0; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet numpy==2.3.5 depthai==$version
    "$folder/$version/bin/python" - 2> /dev/null <<'PYTHON'
import depthai

socket, f, width, height = depthai.CameraBoardSocket.CAM_B, 800.0, 1280, 800
camera = depthai.CameraInfo()
camera.width, camera.height, camera.intrinsicMatrix = width, height, [[f, 0, 640], [0, f, 400], [0, 0, 1]]
board = depthai.EepromData()
board.cameraData = {socket: camera}
handler = depthai.CalibrationHandler(board)
for size, by_width, cropped in (((400, 400), 250, 400), ((640, 480), 400, 480), ((1280, 720), 800, 800)):
    found = handler.getCameraIntrinsics(socket, *size, keepAspectRatio=True)
    print(f"{depthai.__version__} {size}: f {found[0][0]:.0f} px, principal point {found[0][2]:.0f} {found[1][2]:.0f}")
    assert cropped == f * max(size[0] / width, size[1] / height)
    assert abs(found[0][0] - by_width) < 1e-3
    assert (found[0][2], found[1][2]) == (size[0] / 2, size[1] / 2)
PYTHON
done
