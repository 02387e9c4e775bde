"""Locate bodies that carry plain discs: identify the discs, subtract their perspective bias, locate all points together.

discs, detections --identify or assign--> ellipse centres --centred--> disc centres --locate--> PoseEstimate --.
                                              ^-------------- until the bias settles -------------------------'
"""

from __future__ import annotations

import numpy as np

from armsight.data import SIDES, Array, Body, Correspondences, Detections, Discs, Ids, Missed, PoseEstimate
from armsight.vision.discs.assign import assign
from armsight.vision.discs.bias import centred
from armsight.vision.discs.identify import IdentifiedDiscs, identify
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.match import match
from armsight.vision.pose.locate import locate
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import triangulate

#: The bias has settled when no centre moves by more than this, px; it shrinks a hundredfold each round.
SETTLED_PX, _ROUNDS = 1e-4, 6


def locate_composite(
    rig: StereoRig,
    body: Body,
    target: DiscTarget,
    coded: tuple[Detections, Detections],
    discs: tuple[Discs, Discs],
    *,
    symmetries: tuple[Ids, ...] = (),
) -> PoseEstimate | Missed:
    """Locate a body, its discs last in ``body``, from both cameras' detections of its coded parts and of its discs.

    The coded parts identify the discs where they determine a pose by themselves; else the discs are identified by their
    distances. ``symmetries`` as in :func:`~armsight.vision.match.match`.
    """
    names = match(rig, body, *coded, symmetries=symmetries)
    by_code = locate(rig, body, triangulate(rig, body, names)) if len(names.ids) else None
    if isinstance(by_code, PoseEstimate):
        seen = assign(rig, target, by_code.T_left_body, by_code.cov, *discs)
        if isinstance(seen, Missed):
            return by_code
        return locate_discs(rig, body, target, names, seen, by_code.T_left_body)
    found = identify(rig, target, *discs)
    if isinstance(found, Missed):
        if isinstance(identify(rig, target, discs[1], discs[0]), IdentifiedDiscs):
            return Missed(f"left and right are exchanged: the discs fit the rig the other way round ({found.reason})")
        reasons = [f"{side}: {d.problem}" for side, d in zip(SIDES, coded, strict=True) if d.problem]
        reasons += [by_code.reason] if by_code is not None and not reasons else []
        return Missed(
            "; ".join([*reasons, found.reason]) if len(body.points) > len(target.body.points) else found.reason
        )
    return locate_discs(rig, body, target, names, found.seen, found.T_left_body)


def locate_discs(
    rig: StereoRig, body: Body, target: DiscTarget, coded: Correspondences, seen: Correspondences, T_left_body: Array
) -> PoseEstimate | Missed:
    """Locate a body near T_left_body from named discs and coded points, the perspective bias of the discs subtracted.

    ``coded`` are by rows of ``body``, and may be empty; ``seen`` ellipse centres by rows of ``target.body``.
    """
    first = len(body.points) - len(target.body.points)
    before: Array | None = None
    for _ in range(_ROUNDS):
        centres = centred(rig, target, T_left_body, seen)
        if before is not None and np.nanmax(np.abs(centres.uv - before), initial=0.0) <= SETTLED_PX:
            break
        before = centres.uv
        together = Correspondences(
            np.concatenate([coded.ids, centres.ids + first]),
            np.concatenate([coded.uv, centres.uv]),
            np.concatenate([coded.cov_uv, centres.cov_uv]),
            coded.dropped + centres.dropped,
            centres.common,
        )
        result = locate(rig, body, triangulate(rig, body, together))
        if isinstance(result, Missed):
            return result
        T_left_body = result.T_left_body
    return result
