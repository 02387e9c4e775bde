#!/bin/sh
# depthai 3.12.0: a length is millimetres in one function, centimetres in the next; a file's own unit is passed over.
#
# Its depth images are millimetres, and ImgTransformation.projectPointTo(to, pixel, depth) takes its depth so, as documented.
# project3DPointTo(to, point) and remap3DPointTo(to, point) of the same class, whose documentation names no unit, add the
# extrinsics in centimetres to the point: one in millimetres moves by a tenth of the baseline. The Extrinsics' lengthUnit is
# respected there, but not by CalibrationHandler: it writes lengthUnit into the JSON of a calibration, reads it back, and
# takes translations for centimetres, whichever the unit: in getCameraExtrinsics (both ways), getCameraTranslationVector and
# getBaselineDistance, of the calibration and of the design.
#
# Seen: baseline 75 mm, f 800 px, a point at 1000 mm on the axis: projectPointTo moves it by 60 px, project3DPointTo by 6 px,
# remap3DPointTo by 7.5; a calibration with -0.075 m (lengthUnit 0) has a baseline of 0.75 mm, one with -75 mm (2) 750 mm.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 depthai==3.12.0
DEPTHAI_LEVEL=error "$folder/venv/bin/python" - <<'PYTHON'
import re

import depthai as dai
import numpy as np

left, right, f = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C, 800.0
K = [[f, 0, 640], [0, f, 400], [0, 0, 1]]


def extrinsics(x, unit, to):
    made = dai.Extrinsics()
    made.rotationMatrix, made.translation, made.specTranslation = np.eye(3).tolist(), dai.Point3f(x, 0, 0), dai.Point3f(x, 0, 0)
    made.lengthUnit, made.toCameraSocket = unit, to
    return made


units = dai.LengthUnit
views = [
    dai.ImgTransformation(1280, 800, K, dai.CameraModel.Perspective, [], extrinsics(x, unit, right))
    for x, unit in ((-7.5, units.CENTIMETER), (-0.075, units.METER), (0.0, units.CENTIMETER))
]
assert "(mm) Depth" in dai.ImgTransformation.projectPointTo.__doc__
for each in (dai.ImgTransformation.project3DPointTo, dai.ImgTransformation.remap3DPointTo):
    assert not re.search(r"\b(m|mm|cm|units?|(milli|centi)?met(er|re)s?)\b", each.__doc__, re.IGNORECASE), each.__doc__
for view in views[:2]:  # the unit of the extrinsics is respected
    pixel = view.projectPointTo(views[2], dai.Point2f(640, 400), 1000.0).x
    point = dai.Point3f(0, 0, 1000)
    projected, moved = view.project3DPointTo(views[2], point).x, view.remap3DPointTo(views[2], point).x
    print(f"{dai.__version__}: 1000 mm away: projectPointTo {pixel - 640:.1f} px, project3DPointTo {projected - 640:.1f} px, moved by {moved:.2f}")
    assert abs(pixel - 580) < 0.01 and abs(projected - 634) < 0.01 and abs(moved + 7.5) < 1e-3

for x, unit in ((-0.075, units.METER), (-75.0, units.MILLIMETER), (-7.5, units.CENTIMETER)):
    board, camera, other = dai.EepromData(), dai.CameraInfo(), dai.CameraInfo()
    for each in (camera, other):
        each.width, each.height, each.intrinsicMatrix = 1280, 800, K
    camera.extrinsics = extrinsics(x, unit, right)
    board.cameraData = {left: camera, right: other}
    own = camera.extrinsics.getTranslationVector(unit=units.MILLIMETER)[0]
    for handler in (dai.CalibrationHandler(board), dai.CalibrationHandler.fromJson(dai.CalibrationHandler(board).eepromToJson())):
        written = dict(handler.eepromToJson()["cameraData"])[1]["extrinsics"]["lengthUnit"]
        mm = []
        for spec in (False, True):
            mm.append(handler.getCameraExtrinsics(left, right, spec, units.MILLIMETER)[0][3])
            mm.append(-handler.getCameraExtrinsics(right, left, spec, units.MILLIMETER)[0][3])
            mm.append(handler.getCameraTranslationVector(left, right, spec, units.MILLIMETER)[0])
            mm.append(-handler.getBaselineDistance(left, right, spec, units.MILLIMETER))
        print(f"lengthUnit {written} ({unit.name}), translation {x}: read as {mm[0]:.2f} mm, by Extrinsics itself as {own:.1f} mm")
        assert written == int(unit.value)
        assert abs(own + 75.0) < 1e-3
        assert np.allclose(mm, 10 * x, rtol=1e-5), mm
PYTHON
