#!/bin/sh
# robotpy-apriltag 2026.2.2: tags below some 75 px are not found with the detector's own settings, those of 16 px would be.
#
# The package wraps the AprilTag library, as pyapriltags does. WPILib, whose class it is, sets one of its values otherwise: a
# cluster of edge pixels counts from 300 pixels on, where the library has 5.
# At the default decimation of 2, which both have, a tag of 70 px has fewer edge pixels than that. It is not in the list, and
# nothing says so; noise, light and hamming distance, where one would look, play no part. At decimation 1 the limit is some 38 px.
#
# What is right: q = detector.getQuadThresholdParameters(); q.minClusterPixels = 5; detector.setQuadThresholdParameters(q).
#
# Seen, tag36h11 in an image of 320x240 with noise of 2 grey levels: pyapriltags 3.4.3.1 finds sides of 16 to 100 px;
# robotpy-apriltag those of 80 px and more, at decimation 1 those of 40 px and more, with minClusterPixels 5 all.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 opencv-python-headless==4.14.0.94 robotpy-apriltag==2026.2.2 pyapriltags==3.4.3.1
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np
import pyapriltags
import robotpy_apriltag

SIDES = (16, 24, 32, 36, 40, 48, 60, 70, 80, 100)


def scene(side):
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tag = cv2.copyMakeBorder(cv2.aruco.generateImageMarker(family, 7, 192), 48, 48, 48, 48, cv2.BORDER_CONSTANT, value=255)
    place = np.array([[side / 192, 0, 100.3], [0, side / 192, 80]])
    image = cv2.warpAffine(tag, place, (320, 240), flags=cv2.INTER_AREA, borderValue=255)
    image = cv2.GaussianBlur(image, (0, 0), 0.6) * 0.6 + 60 + np.random.default_rng(1).normal(0, 2, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def found(decimate, cluster=None):
    detector = robotpy_apriltag.AprilTagDetector()
    config, quads = detector.getConfig(), detector.getQuadThresholdParameters()
    config.quadDecimate = decimate
    detector.setConfig(config)
    if cluster is not None:
        quads.minClusterPixels = cluster
        detector.setQuadThresholdParameters(quads)
    detector.addFamily("tag36h11")
    return [side for side in SIDES if detector.detect(scene(side))]


defaults = robotpy_apriltag.AprilTagDetector()
cluster, decimate = defaults.getQuadThresholdParameters().minClusterPixels, defaults.getConfig().quadDecimate
library = pyapriltags.Detector(families="tag36h11")
by_library = [side for side in SIDES if library.detect(scene(side))]
print(f"minClusterPixels {cluster}, decimation {decimate:g}")
print(f"pyapriltags {by_library}\nrobotpy-apriltag {found(2.0)}, decimation 1 {found(1.0)}, minClusterPixels 5 {found(2.0, 5)}")
assert (cluster, decimate) == (300, 2.0), "the behaviour has changed"
assert by_library == found(2.0, 5) == list(SIDES), "the behaviour has changed"
assert found(2.0) == [80, 100] and found(1.0) == [40, 48, 60, 70, 80, 100], "the behaviour has changed"
PYTHON
echo "as stated"
