"""What no body may be, whatever is done with it: markers in one place, on one line, too few, or of an absurd size.

How well a body does its work is another question: ``armsight body check``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from armsight.data import Array, Body
from armsight.errors import InputError
from armsight.vision.markers.body_file import Marker

#: Two cameras that know millimetres see no disc body larger than this, and no disc of a larger radius, m.
SIZE_MAX_M, RADIUS_MAX_M = 10.0, 0.5
#: Points lie on one line where their second spread is below this share of the first, as :mod:`~armsight.vision.locate`
#: has it: such a body turns about the line unseen.
COLLINEAR = 1e-3
#: Two discs may share a place where they are the two faces of a thin plate: their normals are opposed this much.
_OPPOSED = -0.5


def check_discs(markers: Sequence[Marker], radii_m: Sequence[float]) -> None:
    """Refuse discs of one body that cannot all be there.

    Args:
        markers: their entries in the body file.
        radii_m: their radii, m.

    Raises:
        InputError: a radius or a distance that says the unit is wrong, or two discs in one place; the message names file
            and entry.
    """
    places = np.array([marker.position for marker in markers])
    away = np.linalg.norm(places - places[0], axis=1)
    for marker, radius, distance in zip(markers, radii_m, away, strict=True):
        if radius > RADIUS_MAX_M:
            raise marker.error(f"radius_mm is {1e3 * radius:g}, a disc {2 * radius:g} m across; is it in mm?")
        if distance > SIZE_MAX_M:
            raise marker.error(
                f"lies {distance:g} m from {markers[0].name}, and a body with discs is {SIZE_MAX_M:g} m across at most; "
                "is position_mm in mm?"
            )
    for i, j in sorted(cKDTree(places).query_pairs(max(radii_m))):
        gap, larger = float(np.linalg.norm(places[i] - places[j])), max(radii_m[i], radii_m[j])
        if gap < larger and not _back_to_back(markers[i], markers[j]):
            where = "in the same place as" if gap < 1e-6 else f"{1e3 * gap:.3g} mm from"
            raise markers[j].error(
                f"lies {where} {markers[i].name}, within a disc of radius {1e3 * larger:g} mm; are all lengths in mm?"
            )


def _back_to_back(one: Marker, other: Marker) -> bool:
    """Whether two discs are known to look opposite ways."""
    normals = one.normal(), other.normal()
    return normals[0] is not None and normals[1] is not None and float(normals[0] @ normals[1]) < _OPPOSED


def check_points(path: str | Path, body: Body) -> None:
    """Refuse a body whose points cannot fix a pose.

    Args:
        path: its file, for the message.
        body: all its points.

    Raises:
        InputError: fewer than three points, or all on one line.
    """
    count = len(body.points)
    if count < 3:
        raise InputError(
            f"{path}: {count} disc{'s' if count > 1 else ''} cannot fix a pose: give 3 or more that do not lie on one line"
        )
    if on_one_line(body.points):
        raise InputError(
            f"{path}: its points ({', '.join(body.point_names[:3])}{', ...' if count > 3 else ''}) lie on one line, so the "
            "turn about that line cannot be seen: move one of them off it"
        )


def on_one_line(points: Array) -> bool:
    """Whether points (N, 3), N >= 3, lie on one line or in one place."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= COLLINEAR * spread[0])
