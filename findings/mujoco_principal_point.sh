#!/bin/sh
# mujoco 4.0.0: one camera has three principal points: the renderer's, that of the sensor camprojection, and the rangefinder's.
#
# MJCF gives a camera its intrinsics by focalpixel, principalpixel, sensorsize and resolution; the headers call the third
# "principal point" and no more. The frustum that is rendered has it at W/2 - x, H/2 - y: who writes OpenCV's cx - W/2 and
# cy - H/2 there moves the image the other way. The sensor camprojection, the pixel of a site, leaves it out. The rays of
# a rangefinder with a camera, its depth image, count it from the image's corner, as a cx, cy: with 0 0, the default, the depth
# image is of what lies to the right of and below the axis. A camera with fovy alone has the centre in all three.
# (Known, and not what this is about: up to 3.5.0 the frustum had H/2 + y; google-deepmind/mujoco, pull request 3150, in 3.6.0.)
#
# A camera of 640 x 480, f 800 and 780 px, and a site off its axis; pixels count from the corner, centres at 0.5.
#
# Seen, cx cy of the renderer, camprojection, rangefinder: principalpixel 10 -20 (OpenCV's 330 220): 310 260, 320 240, 10 -20;
# 0 0: 320 240, 320 240, 0 0; fovy: 320 240 in all.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat >"$folder/cameras.py" <<'PYTHON'
import mujoco
import numpy as np

print(mujoco.__version__)
W, H, x, y = 640, 480, 0.1, 0.05


def principal_points(intrinsics, fx, fy):
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><camera name="eye" resolution="{W} {H}" {intrinsics}/>
      <body pos="0 0 -2"><geom type="box" size="9 9 0.1"/></body><site name="mark" pos="{x} {y} -1"/></worldbody>
      <sensor><camprojection camera="eye" site="mark"/><rangefinder camera="eye" data="point"/></sensor></mujoco>""")
    data, scene, view = mujoco.MjData(model), mujoco.MjvScene(model, 10), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
    frustum = scene.camera[0]
    near = frustum.frustum_near
    # the axis in the window that is rendered, left edge 0, top edge 0
    high = frustum.frustum_top - frustum.frustum_bottom
    rendered = W / 2 - fx * frustum.frustum_center / near, frustum.frustum_top / high * H
    u, v = data.sensordata[:2]
    first = data.sensordata[2:5]  # what the ray of the first pixel hits, its centre at 0.5 0.5
    ray = 0.5 - fx * first[0] / -first[2], 0.5 + fy * first[1] / -first[2]
    return np.round([rendered, (u - fx * x, v + fy * y), ray], 2) + 0.0


size = 'sensorsize="0.0064 0.0048" focalpixel="800 780"'
f = H / 2 / np.tan(np.radians(20))
moved, plain, fovy = (
    principal_points(*row)
    for row in ((f'{size} principalpixel="10 -20"', 800, 780), (size, 800, 780), ('fovy="40"', f, f))
)
for name, found in (("10 -20", moved), ("0 0", plain), ("fovy", fovy)):
    print(f"{name}: renderer, camprojection, rangefinder", *map(list, found.tolist()))
assert np.allclose(moved, [(310, 260), (320, 240), (10, -20)], atol=0.05)
assert np.allclose(plain, [(320, 240), (320, 240), (0, 0)], atol=0.05)
assert np.allclose(fovy, [(320, 240)] * 3, atol=0.05)
PYTHON
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 mujoco==4.0.0
cd "$folder"
"$folder/venv/bin/python" cameras.py
