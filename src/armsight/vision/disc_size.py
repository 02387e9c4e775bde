"""Why discs that are in view are not the body's: a wrong radius, or a body of another size than it was said to be.

For the message of a miss only. The pairs that the epipolar planes allow are triangulated with nothing asked of their size;
where a few discs tell one ratio, it is named.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from armsight.data import Array, Discs
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.match import GATE_PX, epipolar_distances
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import midpoints

#: With more discs than these in view, or other ratios than these, nothing is said.
_MOST_DISCS, _LEAST, _MOST = 12, 0.2, 5.0
#: Ratios of one body agree within this; nearer to 1 they are no reason.
_ALIKE_RADIUS, _ALIKE_LENGTH = 0.08, 0.01


def wrong_size(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> str | None:
    """Say that discs in view have another radius, or lie further apart, than the body's, each by one ratio; or None."""
    if max(len(left.uv), len(right.uv)) > _MOST_DISCS or min(len(left.uv), len(right.uv)) < 3:
        return None
    i, j = np.divmod(np.arange(len(left.uv) * len(right.uv)), len(right.uv))
    keep = epipolar_distances(rig, left.uv[i], right.uv[j]).max(axis=1) <= GATE_PX
    i, j = i[keep], j[keep]
    p = midpoints(rig, left.uv[i], right.uv[j])
    keep = np.isfinite(p).all(axis=1)
    i, j, p = i[keep], j[keep], p[keep]
    if not 3 <= len(p) <= _MOST_DISCS:
        return None
    radii = left.radius_px[i] * p[:, 2] / rig.left.intrinsics[0]
    ratio = float(np.median(radii)) / float(np.median(target.radii_m))
    alike = np.abs(radii / np.median(radii) - 1).max() < _ALIKE_RADIUS
    if alike and len(set(target.radii_m)) == 1 and _telling(ratio, 2 * _ALIKE_RADIUS):
        return (
            f"the discs in view have a radius of about {1e3 * np.median(radii):.1f} mm, those of {target.body.name} "
            f"{1e3 * target.radii_m[0]:.1f} mm: is radius_mm right?"
        )
    scale = _scale(p, target.body.points)
    if scale is None or not _telling(scale, _ALIKE_LENGTH):
        return None
    return (
        f"three discs in view lie {scale:.3f} times as far apart as those of {target.body.name}: are the places in the "
        "body file right, and is it the body that the cameras see?"
    )


def _telling(ratio: float, tolerance: float) -> bool:
    """Whether a ratio is one that a mistake makes."""
    return _LEAST < ratio < _MOST and abs(ratio - 1) > tolerance


def _scale(p: Array, points: Array) -> float | None:
    """Return the one ratio by which a triangle of p (N, 3) is similar to the body's first three discs; None without one."""
    body = points[:3]
    found = []
    for rows in permutations(range(len(p)), 3):
        sides = [
            np.linalg.norm(p[rows[a]] - p[rows[b]]) / np.linalg.norm(body[a] - body[b])
            for a, b in ((0, 1), (1, 2), (2, 0))
        ]
        if np.ptp(sides) < _ALIKE_LENGTH * np.mean(sides):
            found.append(float(np.mean(sides)))
    return found[0] if found and np.ptp(found) < _ALIKE_LENGTH * found[0] else None
