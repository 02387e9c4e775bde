#!/bin/sh
# ezc3d 1.7.2: a take of more than 65535 frames, written and read by ezc3d itself, ends after 65535; nothing says so.
#
# C3D's header counts frames in 16 bits. Takes longer than 11 minutes at 100 Hz exceed it, and other parameters hold their
# number (TRIAL:ACTUAL_END_FIELD, POINT:LONG_FRAMES). ezc3d writes all frames into the file and, reading it again,
# returns the first 65535: no error, no warning, and no parameter with the true number. The rest of the take is still in the
# file. The package c3d 0.6.0 returns no frame at all of it, with a warning of an overflow (NumPy 2).
#
# Seen: 70000 frames written, a file of 70000 frames' size, read 65535; c3d reads 0; of 60000 both read 60000.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 ezc3d==1.7.2 c3d==0.6.0
"$folder/venv/bin/python" -W ignore - "$folder/take.c3d" <<'PYTHON'
import sys
from pathlib import Path

import c3d
import ezc3d
import numpy as np

path = Path(sys.argv[1])
for count, read, read_by_c3d in ((60000, 60000, 60000), (70000, 65535, 0)):
    take = ezc3d.c3d()
    take["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    take["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    take["parameters"]["POINT"]["LABELS"]["value"] = ("A",)
    points = np.zeros((3, 1, count))
    points[0, 0] = 1e-3 * np.arange(count)
    take["data"]["points"] = points
    take.write(str(path))
    again = ezc3d.c3d(str(path))
    found = again["data"]["points"].shape[2]
    known = {f"{group}:{name}" for group in again["parameters"] for name in again["parameters"][group]}
    with path.open("rb") as file:
        frames = sum(1 for _ in c3d.Reader(file).read_frames())
    size = path.stat().st_size
    print(f"{count} frames written, {size} bytes: ezc3d reads {found}, c3d {frames}; ends at {again['data']['points'][0, 0, -1]:.3f} m")
    assert (found, frames) == (read, read_by_c3d)
    assert size >= 16 * count
    assert not {"TRIAL:ACTUAL_END_FIELD", "POINT:LONG_FRAMES"} & known
PYTHON
