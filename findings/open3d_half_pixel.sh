#!/bin/sh
# open3d-cpu 0.20.0: a depth image of its own ray casting becomes points half a pixel off; the two count pixels differently.
#
# RaycastingScene.create_rays_pinhole(K, ..) sends the ray of pixel (u, v) through (u + 0.5, v + 0.5): its K counts from the
# corner of an image. PointCloud.create_from_depth_image(depth, K) puts the same pixel at (u, v): its K counts from the centre
# of the first pixel, as OpenCV's does; so does the legacy class. With one K for both, points are displaced by z / (2 f) to
# the left and upwards. The docstring of the rays names neither the centre nor the corner of a pixel. Rays by a K of OpenCV
# need 0.5 px more in cx and cy.
#
# Seen: f 50 px, a wall 1 m away: all points 10.00 mm left of and above where the rays hit it; 0.00 mm with 0.5 px more.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 open3d-cpu==0.20.0
"$folder/venv/bin/python" - <<'PYTHON'
import re

import numpy as np
import open3d as o3d

said = o3d.t.geometry.RaycastingScene.create_rays_pinhole.__doc__.partition("2. create_rays_pinhole(fov_deg")[0]
assert "upper triangular intrinsic matrix" in said
assert not re.search(r"\bpixel\b|0\.5|half|corner|cent(er|re)", said, re.IGNORECASE), said
width, height, f = 64, 48, 50.0
K = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
wall = o3d.t.geometry.TriangleMesh.create_box(4.0, 4.0, 0.1)
wall.translate([-2.0, -2.0, 1.0])
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(wall)


def in_order(points):  # threads of the tensor class write points in an order of their own, another one each run
    return points[np.lexsort(np.round(1e4 * points[:, :2]).T)]


for added, expected in ((0.0, -10.0), (0.5, 0.0)):
    rays = scene.create_rays_pinhole(K + [[0, 0, added], [0, 0, added], [0, 0, 0]], np.eye(4), width, height)
    hits = (scene.cast_rays(rays)["t_hit"].numpy()[..., None] * rays.numpy()[..., 3:]).reshape(-1, 3)
    depth = np.ascontiguousarray(hits[:, 2].reshape(height, width))
    new = o3d.t.geometry.PointCloud.create_from_depth_image(o3d.t.geometry.Image(depth), o3d.core.Tensor(K), depth_scale=1.0)
    old = o3d.geometry.PointCloud.create_from_depth_image(
        o3d.geometry.Image(depth), o3d.camera.PinholeCameraIntrinsic(width, height, K), depth_scale=1.0
    )
    for points in (new.point.positions.numpy(), np.asarray(old.points)):
        off = 1e3 * (in_order(points) - in_order(hits))
        print(f"{o3d.__version__}: {added} px more: points are off by x {off[:, 0].mean():.2f}, y {off[:, 1].mean():.2f}, z {off[:, 2].mean():.2f} mm")
        assert np.allclose(off, [expected, expected, 0.0], atol=0.01)  # single precision at 1 m
PYTHON
