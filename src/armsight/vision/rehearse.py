"""Everything that finding a body of discs runs is run once before a live loop, so that nothing is compiled within it.

A body that is nowhere in the images leaves most of it untouched; so the discs are put where a body before the cameras would
show them.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Correspondences, Detections, Discs, Shot
from armsight.vision.expected import LEAST_FACING, expect
from armsight.vision.discs.predict import view
from armsight.vision.discs.locate import locate_composite, locate_discs
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.markers.marker import Target
from armsight.vision.measure import measure
from armsight.vision.discs.pairing import DEPTHS_M
from armsight.vision.rig import StereoRig

#: Where the body is put, in sizes of it from the cameras; and how well its discs are known, px.
_AWAY, _SIGMA_PX = 5.0, 0.05


def rehearse(rig: StereoRig, target: Target, discs: DiscTarget) -> None:
    """Search for a body in black images, and name and locate it where its discs are given.

    Args:
        rig: the calibrated pair.
        target: the body.
        discs: its discs.
    """
    black = [np.zeros(camera.image_size_px[::-1], np.uint8) for camera in rig.cameras]
    measure(rig, target, Shot("", black[0], black[1]))
    points = discs.body.points
    away = np.clip(_AWAY * float(np.linalg.norm(np.ptp(points, axis=0))), *DEPTHS_M)
    T = view(rig, points, discs.normals, float(away)).T_left_body
    expected = expect(rig, discs, T)
    rows = np.flatnonzero(np.isfinite(expected.uv).all(axis=(1, 2)) & ~(expected.facing < LEAST_FACING).any(axis=1))
    cov = np.tile(_SIGMA_PX**2 * np.eye(2), (len(rows), 2, 1, 1))
    left, right = (
        Discs(expected.uv[rows][:, s].copy(), cov[:, s].copy(), expected.shape[rows][:, s].copy(), discs.bright[rows])
        for s in (0, 1)
    )
    coded = Detections.none("")
    locate_composite(rig, target.body, discs, (coded, coded), (left, right))
    # A body whose naming is ambiguous there may not be so elsewhere: it is located by the names it is known to have too.
    seen = Correspondences(rows, expected.uv[rows], cov)
    nothing = Correspondences(np.zeros(0, np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, 2, 2)))
    locate_discs(rig, target.body, discs, nothing, seen, T, _SIGMA_PX**2 * np.eye(6))
