#!/bin/sh
# pypylon 26.9: one frame of 12 bits is two images of 16: saved by pylon it is 16 times as bright as its array.
#
# GrabResult.Array of Mono10 and Mono12 has the converter's bits at the low end of uint16 (GenICam's PFNC), up to 1023 and
# 4095, and ImageFormatConverter's Mono16 has them there, too. PylonImage.Save writes the same frame with them at the high end,
# as PNG and TIFF. Both files are of 16 bits and say no more. Who divides by 257, as 16 bits are made 8, has 17 grey levels of
# what OpenCV wrote of the array, and 5 of 10 bits; saturation is at 16, not 255.
#
# Seen, with pylon's emulated camera, whose test image goes from 0 to 255/256 of full scale: Mono12 array 4080, saved 65280;
# Mono10 1020 and 65280; Mono16 65280 both. Grey levels of 8 bits from the array: 17 and 5, saved 255.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 pypylon==26.9 opencv-python-headless==5.0.0.93
cd "$folder"
PYLON_CAMEMU=1 "$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np
from pypylon import pylon


def levels(image):
    """Return how many grey levels are left when 16 bits are made 8."""
    return len(np.unique(np.rint(image / 257.0)))


camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateFirstDevice())
camera.Open()
converter = pylon.ImageFormatConverter()
converter.OutputPixelFormat = pylon.PixelType_Mono16
found = {}
for name in ("Mono10", "Mono12", "Mono16"):
    camera.PixelFormat.Value = name
    result = camera.GrabOne(5000)
    image = pylon.PylonImage()
    image.AttachGrabResultBuffer(result)
    image.Save(pylon.ImageFileFormat_Png, f"{name}.png")
    image.Save(pylon.ImageFileFormat_Tiff, f"{name}.tif")
    png, tif = (cv2.imread(f"{name}.{suffix}", cv2.IMREAD_UNCHANGED) for suffix in ("png", "tif"))
    array, converted = result.Array, converter.Convert(result).GetArray()
    assert png.dtype == tif.dtype == array.dtype == converted.dtype == np.uint16
    assert (png == tif).all() and (array == converted).all()
    found[name] = int(array.max()), int(png.max()), levels(array), levels(png)
    print(f"{name}: array up to {found[name][0]}, saved {found[name][1]}; grey levels of 8 bits {found[name][2]}, {found[name][3]}")
    image.Release()
camera.Close()
assert found == {
    "Mono10": (1020, 65280, 5, 255),
    "Mono12": (4080, 65280, 17, 255),
    "Mono16": (65280, 65280, 255, 255),
}
PYTHON
