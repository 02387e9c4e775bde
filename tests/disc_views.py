"""What two cameras find of a body's discs, without images: ellipses through rims by OpenCV's projection, noise, clutter."""

from functools import partial

import numpy as np

from armsight.data import Body, Discs
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.rig import StereoRig
from disc_rims import disc_ellipses
from views import pixels

SIZE = (1280, 720)
SIGMA = 0.03
#: Relative noise of an ellipse's area.
SHAPE_NOISE = 0.02


def hd_rig(known=False):
    """Two HD cameras 220 mm apart, f 900 px, as well calibrated as a good board calibration leaves them, or exactly."""
    left = Camera(SIZE, "brown4", np.array([900.0, 901.0, 643.0, 357.0]), np.array([-0.12, 0.06, 6e-4, -4e-4]))
    right = Camera(SIZE, "brown4", np.array([903.0, 905.0, 637.0, 365.0]), np.array([-0.11, 0.055, 5e-4, -3e-4]))
    T = pose(exp_so3(np.array([0.006, -0.2, 0.004])), np.array([0.22, 0.003, 0.02]))
    camera = [0.3, 0.3, 0.4, 0.4, 5e-4, 1e-3, 1e-4, 1e-4]
    sigma = np.array([*camera, *camera, 1e-4, 5e-5, 1e-4, 3e-4, 4e-4, 1e-4])
    return StereoRig(left, right, T, np.zeros((22, 22)) if known else np.diag((sigma / 2) ** 2), 0.0)


def discs_of(points, radius=0.008, normal=(0.0, 0.0, -1.0), names=None, bright=True):
    """A target of discs; one radius and normal for all, or one each. Normal None: not given."""
    points = np.array(points, float)
    n = len(points)
    normals = np.full((n, 3), np.nan) if normal is None else np.broadcast_to(np.array(normal, float), (n, 3))
    names = names or tuple(f"P{i + 1}" for i in range(n))
    body = Body("plate", tuple(names), points)
    return DiscTarget(
        body,
        np.broadcast_to(float(radius) if np.isscalar(radius) else np.array(radius), n).copy(),
        np.broadcast_to(bright, n).copy(),
        normals.copy(),
    )


PLATE = discs_of([[-0.055, 0, 0], [0.055, 0, 0], [0, 0.085, 0]])


def someplace(rng, z=(0.6, 1.2), tilt=0.6):
    """A pose before both cameras of hd_rig, its face towards them; ``tilt`` rad at most."""
    far = rng.uniform(*z)
    axis = rng.normal(size=3) * [1, 1, 0]
    R = exp_so3(axis / np.linalg.norm(axis) * rng.uniform(0, tilt)) @ exp_so3(
        np.array([0, 0, rng.uniform(-np.pi, np.pi)])
    )
    return pose(R, np.array([0.11 + 0.3 * far * rng.uniform(-1, 1), 0.2 * far * rng.uniform(-1, 1), far]))


def views(rig, target, Ts, rng=None, sigma=SIGMA, clutter=0, hidden=(), radii=(4.0, 20.0)):
    """Let both cameras see bodies at poses Ts, and ``clutter`` other discs each.

    Args:
        hidden: (body, disc, camera) that is not seen.

    Returns:
        Discs of the left and the right camera, shuffled, and per camera (N, 2) body and disc of each, -1 for clutter.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    found = []
    for side, camera in enumerate(rig.cameras):
        uv, shape, bright, owner = [], [], [], []
        for b, T in enumerate(Ts):
            T = T if side == 0 else inverse(rig.T_left_right) @ T
            normals = np.where(np.isnan(target.normals), [0.0, 0.0, -1.0], target.normals)
            p = target.body.points @ T[:3, :3].T + T[:3, 3]
            at, ellipse = disc_ellipses(partial(pixels, camera), p, normals @ T[:3, :3].T, target.radii_m)
            keep = [
                m
                for m in range(len(p))
                if (b, m, side) not in hidden
                and np.isfinite(at[m, 0])
                and p[m] @ T[:3, :3] @ normals[m] < 0
                and (at[m] > 0).all()
                and (at[m] < np.array(SIZE) - 1).all()
            ]
            uv.append(at[keep])
            shape.append(ellipse[keep])
            bright.append(target.bright[keep])
            owner.append(np.column_stack([np.full(len(keep), b), keep]).reshape(-1, 2))
        uv.append(rng.uniform(0, 1, (clutter, 2)) * (np.array(SIZE) - 1))
        r, squeeze, angle = rng.uniform(*radii, clutter), rng.uniform(0.5, 1, clutter), rng.uniform(0, np.pi, clutter)
        c, s = np.cos(angle), np.sin(angle)
        a, b2 = r**2, (r * squeeze) ** 2
        shape.append(np.column_stack([a * c**2 + b2 * s**2, (a - b2) * c * s, a * s**2 + b2 * c**2]))
        bright.append(rng.random(clutter) < 0.5 if len(set(target.bright)) > 1 else np.full(clutter, target.bright[0]))
        owner.append(np.full((clutter, 2), -1))
        uv, shape, bright, owner = (np.concatenate(x) for x in (uv, shape, bright, owner))
        order = rng.permutation(len(uv))
        uv = uv + sigma * rng.normal(size=uv.shape)
        shape = shape * (1 + SHAPE_NOISE * rng.normal(size=(len(uv), 1)))
        found.append(
            (
                Discs(
                    uv[order], np.tile(sigma**2 * np.eye(2), (len(uv), 1, 1)), shape[order], bright[order].astype(bool)
                ),
                owner[order].astype(int),
            )
        )
    return found[0][0], found[1][0], (found[0][1], found[1][1])
