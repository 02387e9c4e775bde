#!/bin/sh
# rerun-sdk 0.41.0: matrices that are logged by rows come back by columns.
#
# Pinhole and Transform3D take numpy matrices as everybody writes them, K with cx, cy in its last column. The recording
# keeps nine numbers column by column, and the catalogue's reader, the SDK's way back to numpy, pandas and Arrow, returns
# them so, without a shape. A rotation that is reshaped to 3 x 3 is its inverse, without any sign of it; camera
# matrices written again as they were read have cx, cy in their last row.
#
# Seen: K of 600, 610, 320, 240 read as [600, 0, 0, 0, 610, 0, 320, 240, 1]; a rotation by +30 deg about z, reshaped,
# is one by -30 deg.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 "rerun-sdk[catalog]==0.41.0"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import math

import numpy as np
import rerun

camera = np.array([[600.0, 0, 320], [0, 610, 240], [0, 0, 1]])
c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
rerun.init("matrices", recording_id="one")
rerun.save("one.rrd")
rerun.set_time("frame", sequence=0)
rerun.log("camera", rerun.Pinhole(image_from_camera=camera, width=640, height=480))
rerun.log("tool", rerun.Transform3D(mat3x3=rotation))
rerun.disconnect()

server = rerun.server.Server(datasets={"recordings": ["one.rrd"]})
client = server.client()  # kept: a reader whose client is gone fails
recordings = client.get_dataset("recordings")
row = recordings.reader(index="frame").to_pandas().iloc[0]
read = np.asarray(row["/camera:Pinhole:image_from_camera"][0])
print("K read as", read)
assert np.allclose(read, camera.T.ravel()), read
read = np.asarray(row["/tool:Transform3D:mat3x3"][0]).reshape(3, 3)
angle = math.degrees(math.atan2(read[1, 0], read[0, 0]))
print(f"+30 deg about z read and reshaped: {angle:+.1f} deg")
assert abs(angle + 30) < 1e-3
PYTHON
