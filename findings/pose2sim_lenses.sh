#!/bin/sh
# pose2sim 0.10.49: a converted Qualisys calibration of 540p video has half of the lens's distortion; an EasyMocap one has no k3.
#
# Pose2Sim converts other programs' calibrations to its Calib.toml. For Qualisys the settings say binning_factor = 2 for video in
# 540p, where 2 x 2 pixels become one. That halves fx fy cx cy and the image's size, as it must, and also k1 k2 p1 p2, which
# are of normalised coordinates and do not depend on pixels: straight edges stay bent, by 13 px near a side of 960 px. An
# image whose fov_video begins at a column beyond 0 has its principal point off, too: the column is subtracted unhalved.
# Of EasyMocap's files (k1 k2 p1 p2 k3) k3 is dropped, for a Calib.toml holds four: 24 px near a corner. Its image size is twice
# the principal point, for EasyMocap's K has none. Nothing is said; the toml has the form of aniposelib's, which others read.
#
# Seen, pixels of one ray by the toml's model less the camera's: Qualisys, 1080p: 0.0, 540p: 13.0; fov_video from column 320:
# cx 320 less than 0 .. 1919's half; EasyMocap: 23.9, size 1312 x 704 of an image of 1280 x 720.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
# Of its requirements those that the conversion imports; the rest (pose estimation, OpenSim) is a gigabyte.
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3 opencv-python-headless==4.14.0.94 pandas==3.1.1 matplotlib==3.11.2 \
    rtoml==0.14.0 c3d==0.6.0 anytree==2.13.0 lxml==6.1.3
"$folder/venv/bin/pip" install --quiet --no-deps pose2sim==0.10.49
cd "$folder"
"$folder/venv/bin/python" -W ignore - 2>errors.txt <<'PYTHON' || { cat errors.txt; exit 1; }
import tomllib
from pathlib import Path

import cv2
import numpy as np
from Pose2Sim import calibration

QUALISYS = """<calibration><cameras><camera serial="1" model="Miqus Video" avg-residual="0.5">
<fov_video left="{left}" top="0" right="1919" bottom="1079"/>
<transform x="0" y="0" z="0" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>
<intrinsic focalLengthU="76800" focalLengthV="76800" centerPointU="61440" centerPointV="34560"
radialDistortion1="-7.68" radialDistortion2="3.2" tangentalDistortion1="0.064" tangentalDistortion2="-0.064"/>
</camera></cameras></calibration>"""  # in 1/64: f 1200, cx 960, cy 540 px, k1 -0.12, k2 0.05, p1 0.001, p2 -0.001


def converted(convert, *arguments):
    """Return size, K and distortion as the converter's Calib.toml has them."""
    _, *camera = convert(*arguments)
    calibration.toml_write("Calib.toml", *camera)
    (found, *_) = tomllib.loads(Path("Calib.toml").read_text()).values()
    return found["size"], np.array(found["matrix"]), np.array(found["distortions"])


def pixel(ray, K, distortion):
    return cv2.projectPoints(np.array([ray]), np.zeros(3), np.zeros(3), np.array(K), np.array(distortion))[0].ravel()


def qualisys(binning_factor, left=0):
    Path("a.qca.txt").write_text(QUALISYS.format(left=left))
    return converted(calibration.calib_qca_fun, "a.qca.txt", binning_factor)


# The camera itself: a pixel of 540p is two of 1080p (the half pixel between their centres is left aside).
side = [0.75, 0.2, 1.0]
lens = [-0.12, 0.05, 0.001, -0.001]
full = pixel(side, [[1200, 0, 960], [0, 1200, 540.0], [0, 0, 1]], lens)
off = {}
for binning_factor in (1, 2):
    size, K, distortion = qualisys(binning_factor)
    off[binning_factor] = np.linalg.norm(pixel(side, K, distortion) - full / binning_factor)
    print(f"Qualisys, binning {binning_factor}: size {size}, f {K[0, 0]:.0f}, distortion {distortion}; off by {off[binning_factor]:.1f} px")
assert np.allclose(distortion, np.array(lens) / 2)
assert off[1] < 1e-6
assert 12 < off[2] < 14

(_, whole, _), (_, cropped, _) = qualisys(2), qualisys(2, left=320)
moved = whole[0, 2] - cropped[0, 2]
print(f"fov_video from column 320, binning 2: cx less by {moved:.0f} px, where it is 160")
assert moved == 320

K, lens = np.array([[900, 0, 656], [0, 900, 352.0], [0, 0, 1]]), np.array([-0.25, 0.12, 0.001, -0.001, -0.12])
for name, values in (("intri.yml", {"K_01": K, "dist_01": lens[None]}), ("extri.yml", {"R_01": np.zeros((3, 1)), "T_01": np.zeros((3, 1))})):
    file = cv2.FileStorage(name, cv2.FILE_STORAGE_WRITE)
    file.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    file.write("", "01")
    file.endWriteStruct()
    for key, value in values.items():
        file.write(key, value)
    file.release()
size, K_toml, distortion = converted(calibration.calib_easymocap_fun, ["extri.yml", "intri.yml"])
corner = [0.7, 0.4, 1.0]
off_easymocap = np.linalg.norm(pixel(corner, K_toml, distortion) - pixel(corner, K, lens))
print(f"EasyMocap: size {size}, distortion {distortion}; off by {off_easymocap:.1f} px at {pixel(corner, K, lens).round()}")
assert np.allclose(distortion, lens[:4])
assert size == [1312, 704]
assert off_easymocap > 5
PYTHON
