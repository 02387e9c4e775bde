"""Rays that are cast in bunches meet what each of them meets alone."""

import numpy as np

from armsight.robot.arm_file import open_arm
from armsight.sim.render.render import corner_rays
from armsight.sim.workcell import raycast
from armsight.sim.workcell.motors import solids
from armsight.sim.workcell.raycast import LAMP_BASE, furniture, pixel_rays, view
from armsight.vision.camera import Camera

EYE = np.array([1.3, -0.2, 0.6])
TOWARDS = np.array(
    [[0.0, 0.2, -0.98], [1.0, 0.0, 0.0], [0.0, -0.98, -0.2]]
)  # camera's z along the base's -x, a bit down


def eye():
    u, _, vt = np.linalg.svd(TOWARDS)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ vt, EYE
    camera = Camera((90, 50), "none", np.array([70.0, 70.0, 44.5, 24.5]), np.zeros(0))
    return camera, T, pixel_rays(corner_rays(camera))


def cast(rays, T, seed=3):
    boxes, capsules = furniture(seed)
    out = (np.empty(len(rays), np.float32), np.empty(len(rays), np.float32), np.empty(len(rays), np.int16))
    R = np.ascontiguousarray(T[:3, :3])
    raycast.still(rays, R, EYE, boxes, capsules, LAMP_BASE, *out)
    return out


def test_what_a_ray_meets_does_not_depend_on_the_others_of_its_bunch():
    _, T, rays = eye()
    flat = rays.reshape(-1, 3)
    apart = np.random.default_rng(0).permutation(len(flat))  # bunches as wide as the image: hardly anything left out
    near, wide = cast(flat, T), cast(flat[apart], T)
    alone = [
        np.concatenate(column)
        for column in zip(*(cast(flat[j : j + 1], T) for j in range(0, len(flat), 7)), strict=True)
    ]
    for together, mixed, single in zip(near, wide, alone, strict=True):
        np.testing.assert_array_equal(together[apart], mixed)
        np.testing.assert_array_equal(together[::7], single)
    assert len(np.unique(near[2])) > 15  # much is in view


def test_a_view_is_cast_ray_by_ray_where_light_is_even():
    camera, T, rays = eye()
    foot = solids(open_arm("six_r"))
    seen = view(camera, rays, T, 3, foot)
    light, depth, ids = (flat.reshape(50, 90) for flat in cast(rays.reshape(-1, 3), T))
    without = (seen.ids == ids) & (np.abs(seen.depth - depth) < 1e-9)  # all but the arm's foot
    assert without.mean() > 0.95
    assert (seen.light[without] == light[without]).mean() > 0.4  # where it is not, four rays are cast
    assert np.abs(seen.light - light)[without].max() < 1.0
