#!/bin/sh
# opencv-python-headless 5.0.0.93 and Pillow 13.0.0 apply the orientation of a TIFF where they ignore a JPEG's.
#
# IMREAD_UNCHANGED and IMREAD_IGNORE_ORIENTATION leave the pixels of a JPEG where they are stored, whatever its EXIF says.
# Of a TIFF with the orientation tag (274) imdecode rotates and mirrors the array under every flag, these two included; the
# TIFF decoder does it itself. imread does so for orientations 1 to 4, and returns None where rows become columns: the same
# file is an image from memory and none from disk. Pillow's Image.open moves TIFFs alone, JPEGs need ImageOps.exif_transpose.
# tifffile returns the array as it is stored. A camera mounted on its side that writes the tag has its calibration in other
# pixels than its images, once one of both is stored as TIFF and the other is not, or is read by another library.
#
# Seen, orientations 2, 3, 4, 6, 8 of an image of 32 x 48 (rows x columns): TIFF moved by imdecode under both flags and by
# Pillow, as stored by tifffile, imread None for 6 and 8; JPEG as stored by imdecode under both flags and by Pillow.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 opencv-python-headless==5.0.0.93 pillow==13.0.0 tifffile==2026.3.3
"$folder/venv/bin/python" - "$folder/a.tiff" 2> /dev/null <<'PYTHON'
import io
import sys
from pathlib import Path

import cv2
import numpy as np
import tifffile
from PIL import Image

IGNORING = {"UNCHANGED": cv2.IMREAD_UNCHANGED, "IGNORE_ORIENTATION": cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION}
stored = np.kron(np.random.default_rng(1).integers(20, 235, (4, 6), np.uint8), np.ones((8, 8), np.uint8))
shown = {2: stored[:, ::-1], 3: stored[::-1, ::-1], 4: stored[::-1], 6: np.rot90(stored, -1), 8: np.rot90(stored)}


def written(form, orientation):
    exif = Image.Exif()
    exif[274] = orientation
    out = io.BytesIO()
    kept = {"tiffinfo": {274: orientation}} if form == "TIFF" else {"exif": exif.tobytes(), "quality": 100}
    Image.fromarray(stored).save(out, form, **kept)
    return out.getvalue()


def said(image, orientation):
    for word, other in (("as stored", stored), ("moved", shown[orientation])):
        if image.shape[:2] == other.shape and np.abs(image.reshape(*other.shape, -1)[..., 0].astype(int) - other).max() < 4:
            return word
    return "another"


for orientation in shown:
    for form in ("TIFF", "JPEG"):
        data = written(form, orientation)
        found = {
            name: said(cv2.imdecode(np.frombuffer(data, np.uint8), flag), orientation) for name, flag in IGNORING.items()
        }
        found["Pillow"] = said(np.asarray(Image.open(io.BytesIO(data))), orientation)
        if form == "TIFF":
            found["tifffile"] = said(tifffile.imread(io.BytesIO(data)), orientation)
            Path(sys.argv[1]).write_bytes(data)
            image = cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED)
            found["imread"] = "None" if image is None else said(image, orientation)
        print(orientation, form, found)
        moved = "moved" if form == "TIFF" else "as stored"
        assert [found[name] for name in (*IGNORING, "Pillow")] == 3 * [moved]
        if form == "TIFF":
            assert (found["tifffile"], found["imread"]) == ("as stored", "None" if orientation > 4 else "moved")
PYTHON
