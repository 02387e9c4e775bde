"""Draw the arm's links over what stands still: capsules in a camera's image, without GL.

Light as in ``cell_rays``, with a Phong highlight.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array, Ids, Image
from armsight.sim.cell_rays import AMBIENT, LAMP, Light

#: Share of the lamp's reflection in the light.
GLOSS = 0.25
_TILE = 16  # pixels on a side that are passed over together
_BALL = 1e-12  # square of the length, m^2, of what has none: it has no sides


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _axis(a: Array, b: Array, radius: float, out: Array) -> None:
    """Write into out (11,) what of a capsule between a and b :func:`_side` and :func:`_row` ask for: all but the ray."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    long = max(bx * bx + by * by + bz * bz, _BALL)
    ba = -(bx * a[0] + by * a[1] + bz * a[2])
    out[0], out[1], out[2], out[3], out[4] = bx, by, bz, long, ba
    out[5] = long * (a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - radius * radius) - ba * ba
    out[6], out[7], out[8] = by * a[2] - bz * a[1], bz * a[0] - bx * a[2], bx * a[1] - by * a[0]
    out[9] = a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - radius * radius
    out[10] = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] - radius * radius


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _side(d: Array, a: Array, axis: Array) -> int:
    """Return on which side the unit ray d (3,) from the origin passes a cylinder without ends: 1, -1; 0 where it meets."""
    if axis[3] <= _BALL:
        return 0
    bd = axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2]
    B = -axis[3] * (a[0] * d[0] + a[1] * d[1] + a[2] * d[2]) - axis[4] * bd
    if (axis[3] - bd * bd) * axis[5] <= B * B:
        return 0
    return 1 if axis[6] * d[0] + axis[7] * d[1] + axis[8] * d[2] > 0.0 else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _row(
    x: Array,
    y: Array,
    z: Array,
    a: Array,
    axis: Array,
    radius: float,
    shown: tuple[float, int],
    lamp: Array,
    light: Array,
    depth: Light,
    ids: Image,
) -> None:
    """Draw a capsule into a part of a row: its rays (n,) x, y, z; its light, depth and ids. Without branches.

    Light falls off with the cosine to the lamp, and what faces away from the viewer is a little darker: that tells one
    link from the next. ``shown`` is the capsule's albedo and its id.
    """
    bx, by, bz, long, ba, C = axis[0], axis[1], axis[2], axis[3], axis[4], axis[5]
    for u in range(x.size):
        ad = a[0] * x[u] + a[1] * y[u] + a[2] * z[u]
        bd = bx * x[u] + by * y[u] + bz * z[u]
        A, B = max(long - bd * bd, 1e-12 * long), -long * ad - ba * bd
        h = B * B - A * C
        t = (-B - np.sqrt(max(h, 0.0))) / A
        along = (ba + t * bd) / long
        end = 0.0 if along < 0.5 else 1.0
        # The ball at the nearer end, where the cylinder is met beyond it.
        ed = ad + end * bd
        ball = ed * ed - (axis[9] + end * (axis[10] - axis[9]))
        between = 0.0 < along < 1.0
        t = t if between else ed - np.sqrt(max(ball, 0.0))
        seen = (h if between else ball) >= 0.0 and 0.0 < t < depth[u]
        along = min(max((ba + t * bd) / long, 0.0), 1.0)
        nx = (t * x[u] - a[0] - along * bx) / radius
        ny = (t * y[u] - a[1] - along * by) / radius
        nz = (t * z[u] - a[2] - along * bz) / radius
        cosine = nx * lamp[0] + ny * lamp[1] + nz * lamp[2]
        away = nx * x[u] + ny * y[u] + nz * z[u]
        lamp_d = lamp[0] * x[u] + lamp[1] * y[u] + lamp[2] * z[u]
        mirror = max(2 * cosine * away - lamp_d, 0.0) if cosine > 0.0 else 0.0
        square = mirror * mirror
        square = square * square
        square = square * square
        shade = (AMBIENT + LAMP * max(cosine, 0.0)) * (0.75 - 0.25 * away) + GLOSS * square * square
        light[u] = shown[0] * shade if seen else light[u]
        depth[u] = np.float32(t) if seen else depth[u]
        ids[u] = shown[1] if seen else ids[u]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moving(
    rays: Array,
    window: tuple[int, int, int, int],
    boxes_px: Ids,
    capsules: tuple[Array, Array, Array],
    lamp: Array,
    light: Array,
    depth: Light,
    ids: Image,
) -> None:
    """Draw capsules over an image that knows its depths; all is in the camera's frame.

    Args:
        rays: (3, H, W) unit rays of all pixels.
        window: first column, first row, end column, end row of the image that ``light``, ``depth`` and ``ids`` are of.
        boxes_px: (K, 4) the same of what each capsule can cover.
        capsules: ends (K, 2, 3), m; radii (K,), m; albedos (K,).
        lamp: (3,) unit vector to the lamp.
        light: drawn over.
        depth: distance of what is there, m; brought up to date.
        ids: the number of the capsule that is drawn, counted from 1, is written here.
    """
    ends, radius, albedo = capsules
    u_first, v_first, u_end, v_end = window
    axis, d = np.empty(11), np.empty(3)
    for k in np.argsort(ends[:, 0, 2] + ends[:, 1, 2]):  # what is near first: it hides the rest
        a, b = ends[k, 0], ends[k, 1]
        _axis(a, b, radius[k], axis)
        u0, u1 = max(boxes_px[k, 0], u_first), min(boxes_px[k, 2], u_end)
        v0, v1 = max(boxes_px[k, 1], v_first), min(boxes_px[k, 3], v_end)
        for v_tile in range(v0, v1, _TILE):
            v_last = min(v_tile + _TILE, v1)
            for u_tile in range(u0, u1, _TILE):
                u_last = min(u_tile + _TILE, u1)
                sides = 0
                for corner in range(4):
                    v, u = (v_tile if corner < 2 else v_last - 1), (u_tile if corner % 2 else u_last - 1)
                    d[0], d[1], d[2] = rays[0, v, u], rays[1, v, u], rays[2, v, u]
                    sides += _side(d, a, axis)
                if abs(sides) == 4:  # all of the tile is to one side of it
                    continue
                for v in range(v_tile, v_last):
                    x, y, z = rays[0, v, u_tile:u_last], rays[1, v, u_tile:u_last], rays[2, v, u_tile:u_last]
                    row, first, last = v - v_first, u_tile - u_first, u_last - u_first
                    parts = light[row, first:last], depth[row, first:last], ids[row, first:last]
                    _row(x, y, z, a, axis, radius[k], (albedo[k], k + 1), lamp, parts[0], parts[1], parts[2])
