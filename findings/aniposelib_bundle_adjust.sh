#!/bin/sh
# aniposelib 0.8.0: bundle_adjust removes k2 p1 p2 k3 and makes fy equal to fx, in cameras that had them.
#
# A Camera has OpenCV's K and five coefficients, and projects and triangulates by all of them: a CameraGroup may be loaded from
# another program's calibration. bundle_adjust, whose documentation says "fine-tune the parameters of the cameras", writes a
# focal length and k1 back (k2 with extra_dist, which a file does not keep: it is off after dump and load) and zeros for the
# rest. A rig that was right is made worse by exact points, and the error that it reports stays far below a
# pixel, for poses and points give way. only_extrinsics=True keeps the lenses.
#
# Four cameras around a volume of 0.7 x 0.5 x 0.7 m, 1.2 m away, all with fx 800, fy 804 px, -0.25 0.09 0.001 -0.0008 -0.01; 60
# points seen by all, exact; distances after the best similarity.
#
# Seen, before / after / with only_extrinsics: error 0.000 / 0.033 / 0.000 px, points off by up to 0.0 / 1.2 / 0.0 mm; fx fy
# 801.1 801.1, coefficients -0.233 0 0 0 0; of two cameras: 0.014 px, 54 mm, and lengths that are 12 % short. k2 of a group with
# extra_dist that was dumped, loaded and adjusted: 0.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 scipy==1.17.1 opencv-python-headless==5.0.0.93 jax==0.10.2 numba==0.68.1 \
  pandas==3.1.1 toml==0.10.2 tqdm==4.70.1
"$folder/venv/bin/pip" install --quiet --no-deps aniposelib==0.8.0
cd "$folder"
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from aniposelib.cameras import Camera, CameraGroup

K = [[800, 0, 310], [0, 804, 250], [0, 0, 1]]
LENS = [-0.25, 0.09, 0.001, -0.0008, -0.01]


def group(poses, extra=False):
    return CameraGroup(
        [Camera(K, LENS, (640, 480), r, t, f"c{i}", extra_dist=extra) for i, (r, t) in enumerate(poses)]
    )


def off_mm(found, true):
    """Largest distance of points, and the scale, after the best similarity (Umeyama)."""
    a, b = found - found.mean(0), true - true.mean(0)
    U, S, Vt = np.linalg.svd(a.T @ b)
    D = np.diag([1, 1, np.linalg.det(U @ Vt)])
    scale = (S * np.diag(D)).sum() / (a**2).sum()
    return 1e3 * np.linalg.norm(scale * a @ U @ D @ Vt - b, axis=1).max(), scale


def adjusted(rig, points, **options):
    uv = rig.project(points)
    rows = [(rig.average_error(uv), off_mm(rig.triangulate(uv), points)[0])]
    rig.bundle_adjust(uv, verbose=False, **options)
    distance, scale = off_mm(rig.triangulate(uv), points)
    return [*rows, (rig.average_error(uv), distance)], scale


g = np.random.default_rng(0)
around = [((0, a, 0), (0, 0, 1.2)) for a in (-0.9, -0.3, 0.3, 0.9)]
points = g.uniform(-0.35, 0.35, (60, 3)) * [1, 0.7, 1]
rig = group(around)
(before, after), _ = adjusted(rig, points)
(_, kept), _ = adjusted(group(around), points, only_extrinsics=True)
fx, fy = rig.cameras[0].get_focal_length(both=True)
lens = rig.cameras[0].get_distortions()
print(f"before {before[0]:.3f} px {before[1]:.2f} mm, after {after[0]:.3f} px {after[1]:.2f} mm, only_extrinsics {kept[0]:.3f} px "
      f"{kept[1]:.2f} mm; fx fy {fx:.1f} {fy:.1f}, coefficients {np.round(lens, 3)}")  # fmt: skip
assert before[0] < 1e-4 and before[1] < 1e-3 and kept[0] < 1e-4 and kept[1] < 1e-3
assert 0.02 < after[0] < 0.035 and 0.9 < after[1] < 1.7
assert fx == fy and (lens[1:] == 0).all() and abs(lens[0] + 0.236) < 0.005

pair = group([((0, 0, 0), (0, 0, 0)), ((0, -0.2, 0), (-0.2, 0, 0.02))])
g = np.random.default_rng(0)
seen = np.c_[g.uniform(-0.3, 0.3, 80), g.uniform(-0.2, 0.2, 80), g.uniform(0.9, 1.4, 80)]
(_, two), scale = adjusted(pair, seen)
print(f"two cameras: {two[0]:.3f} px, {two[1]:.0f} mm, lengths {1 / scale:.2f}")
assert two[0] < 0.05 and two[1] > 20 and not 0.95 < scale < 1.05

rig = group(around, extra=True)
rig.dump("rig.toml")
loaded = CameraGroup.load("rig.toml")
adjusted(rig, points)
adjusted(loaded, points)
k2 = rig.cameras[0].get_distortions()[1], loaded.cameras[0].get_distortions()[1]
print(f"k2 with extra_dist {k2[0]:.3f}, dumped and loaded {k2[1]:.3f}")
assert abs(k2[0]) > 0.01 and k2[1] == 0
PYTHON
