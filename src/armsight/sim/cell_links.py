"""Draw the arm's links over what stands still: capsules in a camera's image, without GL.

Light as in ``cell_rays``, with a Phong highlight.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array, Ids, Image
from armsight.sim.workcell.raycast import AMBIENT, LAMP, Light

#: Share of the lamp's reflection in the light.
GLOSS = 0.25
_TILE = 16  # pixels on a side that are passed over together
_BALL = 1e-12  # square of the length, m^2, of what has none: it has no sides
# Numbers of single precision, for a row is drawn in that: four times as many pixels at once.
_ZERO, _QUARTER, _HALF, _THREE_QUARTERS, _ONE, _TWO, _LEAST = (
    np.float32(number) for number in (0.0, 0.25, 0.5, 0.75, 1.0, 2.0, 1e-12)
)
_AMBIENT, _LAMP, _GLOSS = np.float32(AMBIENT), np.float32(LAMP), np.float32(GLOSS)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _axis(a: Array, b: Array, radius: float, out: Light) -> None:
    """Write into out (14,) what of a capsule between a and b :func:`_side` and :func:`_row` ask for: all but the ray."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    out[0], out[1], out[2] = bx, by, bz
    out[3] = max(bx * bx + by * by + bz * bz, _BALL)
    out[4] = -(bx * a[0] + by * a[1] + bz * a[2])
    out[5] = radius
    out[6], out[7], out[8] = by * a[2] - bz * a[1], bz * a[0] - bx * a[2], bx * a[1] - by * a[0]
    out[9] = a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - radius * radius
    out[10] = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] - radius * radius
    out[11], out[12], out[13] = a[0], a[1], a[2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _side(x: float, y: float, z: float, axis: Light) -> int:
    """Return on which side the unit ray x, y, z passes a cylinder without ends: 1, -1; 0 where it meets."""
    if axis[3] <= _BALL:
        return 0
    bd = axis[0] * x + axis[1] * y + axis[2] * z
    past = axis[6] * x + axis[7] * y + axis[8] * z
    if past * past <= axis[5] * axis[5] * (axis[3] - bd * bd):
        return 0
    return 1 if past > 0.0 else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _row(
    x: Light,
    y: Light,
    z: Light,
    axis: Light,
    shown: tuple[np.float32, int],
    lamp: Light,
    light: Light,
    depth: Light,
    ids: Image,
) -> None:
    """Draw a capsule into a part of a row: its rays (n,) x, y, z; its light, depth and ids. Without branches.

    Light falls off with the cosine to the lamp, and what faces away from the viewer is a little darker: that tells one
    link from the next. ``shown`` is the capsule's albedo and its id.
    """
    bx, by, bz, long, ba, radius = axis[0], axis[1], axis[2], axis[3], axis[4], axis[5]
    ax, ay, az = axis[11], axis[12], axis[13]
    for u in range(x.size):
        ad = ax * x[u] + ay * y[u] + az * z[u]
        bd = bx * x[u] + by * y[u] + bz * z[u]
        past = axis[6] * x[u] + axis[7] * y[u] + axis[8] * z[u]  # by which it passes the axis, times the next's root
        A = max(long - bd * bd, _LEAST * long)
        h = long * (radius * radius * A - past * past)
        t = (long * ad + ba * bd - np.sqrt(max(h, _ZERO))) / A
        along = (ba + t * bd) / long
        end = _ZERO if along < _HALF else _ONE
        # The ball at the nearer end, where the cylinder is met beyond it.
        ed = ad + end * bd
        ball = ed * ed - (axis[9] + end * (axis[10] - axis[9]))
        between = _ZERO < along < _ONE
        t = t if between else ed - np.sqrt(max(ball, _ZERO))
        seen = (h if between else ball) >= _ZERO and _ZERO < t < depth[u]
        along = min(max((ba + t * bd) / long, _ZERO), _ONE)
        nx = (t * x[u] - ax - along * bx) / radius
        ny = (t * y[u] - ay - along * by) / radius
        nz = (t * z[u] - az - along * bz) / radius
        cosine = nx * lamp[0] + ny * lamp[1] + nz * lamp[2]
        away = nx * x[u] + ny * y[u] + nz * z[u]
        lamp_d = lamp[0] * x[u] + lamp[1] * y[u] + lamp[2] * z[u]
        mirror = max(_TWO * cosine * away - lamp_d, _ZERO) if cosine > _ZERO else _ZERO
        square = mirror * mirror
        square = square * square
        square = square * square
        shade = (_AMBIENT + _LAMP * max(cosine, _ZERO)) * (_THREE_QUARTERS - _QUARTER * away) + _GLOSS * square * square
        light[u] = shown[0] * shade if seen else light[u]
        depth[u] = t if seen else depth[u]
        ids[u] = shown[1] if seen else ids[u]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moving(
    rays: Light,
    window: tuple[int, int, int, int],
    boxes_px: Ids,
    capsules: tuple[Array, Array, Array],
    lamp: Light,
    light: Light,
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
    axis = np.empty(14, np.float32)
    for k in np.argsort(ends[:, 0, 2] + ends[:, 1, 2]):  # what is near first: it hides the rest
        _axis(ends[k, 0], ends[k, 1], radius[k], axis)
        shown = np.float32(albedo[k]), k + 1
        u0, u1 = max(boxes_px[k, 0], u_first), min(boxes_px[k, 2], u_end)
        v0, v1 = max(boxes_px[k, 1], v_first), min(boxes_px[k, 3], v_end)
        for v_tile in range(v0, v1, _TILE):
            v_last = min(v_tile + _TILE, v1)
            u_begin, u_stop = u1, u0  # of the tiles that are not all to one side of it: one after the other
            for u_tile in range(u0, u1, _TILE):
                u_last, sides = min(u_tile + _TILE, u1), 0
                for corner in range(4):
                    v, u = (v_tile if corner < 2 else v_last - 1), (u_tile if corner % 2 else u_last - 1)
                    sides += _side(rays[0, v, u], rays[1, v, u], rays[2, v, u], axis)
                if abs(sides) != 4:
                    u_begin, u_stop = min(u_begin, u_tile), u_last
            first, last = u_begin - u_first, u_stop - u_first
            for v in range(v_tile, v_last if u_begin < u_stop else v_tile):
                x, y, z = rays[0, v, u_begin:u_stop], rays[1, v, u_begin:u_stop], rays[2, v, u_begin:u_stop]
                row = v - v_first
                _row(x, y, z, axis, shown, lamp, light[row, first:last], depth[row, first:last], ids[row, first:last])
