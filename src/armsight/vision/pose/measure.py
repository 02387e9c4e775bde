"""Measure a body's pose from one shot: detect, match, triangulate, locate.

from armsight import StereoRig, measure, open_source, open_target rig, target = StereoRig.load("rig.json"),
open_target("chessboard:9x6:25mm") estimate = measure(rig, target, open_source("recording").read())

Plain discs are identified, their perspective bias is subtracted, and all points are located together:

discs, detections --identify or assign--> ellipse centres --centred--> disc centres --locate--> PoseEstimate --.
                                              ^-------------- until the bias settles -------------------------'
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Body, Correspondences, Detections, Discs, Ids, Image, Missed, PoseEstimate, Shot
from armsight.errors import require
from armsight.geometry.pose import inverse
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.discs.assign import assign
from armsight.vision.discs.bias import apparent_radii, centred
from armsight.vision.discs.identify import IdentifiedDiscs, identify
from armsight.vision.image import darkness, grey
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.marker import Target
from armsight.vision.match import gate, join, match
from armsight.vision.pose.assign import instances, plain
from armsight.vision.pose.locate import locate
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import triangulate

#: Fewest common points with which exchanged cameras are distinguishable from bad detections; half: two fit by chance,
#: double: small bodies are not checked.
_EXCHANGED_POINTS = 4
#: A given radius of a board's discs that differs from the images' by more than this share, and by more than so many px (a
#: rim blurred by 1.5 px moves by 0.7 with sRGB's tone curve, by 0.6 in saturation), is a mistake. Half: true radii of discs
#: of 5 px are rejected; double: a radius 30 % wrong passes for discs of 4 px.
_RADIUS_SHARE, _RADIUS_PX = 0.1, 0.7


def measure(rig: StereoRig, target: Target, shot: Shot) -> PoseEstimate | Missed:
    """Measure one shot.

    ``target``: the body to find; ``shot``: two simultaneous images. Returns the pose of the target's body in the left
    camera's frame, or why there is none. Raises InputError: an argument has another type.
    """
    require_arguments("measure(rig, target, shot)", rig=rig, target=target, shot=shot)
    if shot.problem is not None or shot.left is None or shot.right is None:
        return Missed(shot.problem or "no image")
    images = (shot.left, shot.right)
    for side, camera, image in zip(SIDES, rig.cameras, images, strict=True):
        if (problem := size_problem(camera.image_size_px, image, side)) is not None:
            return Missed(problem)
    left, right = (grey(image) for image in images)
    result = _measured(rig, target, left, right)
    if isinstance(result, PoseEstimate):
        return result
    dark = [f"{side}: {d}" for side, d in zip(SIDES, map(darkness, (left, right)), strict=True) if d]
    return replace(result, reason="; ".join([result.reason, *dark]))


#: Argument -> whether a value is one, and what opens one.
_ARGUMENTS: dict[str, tuple[Callable[[object], bool], str]] = {
    "rig": (lambda value: isinstance(value, StereoRig), 'StereoRig.load("rig.json")'),
    "target": (lambda value: hasattr(value, "detect"), 'open_target("chessboard:9x6:25mm")'),
    "board": (lambda value: hasattr(value, "codes"), 'open_board("chessboard:9x6:25mm")'),
    "shot": (
        lambda value: isinstance(value, Shot),
        'Shot("name", left, right) of two images, or open_source("recording").read()',
    ),
    "source": (lambda value: hasattr(value, "read") and hasattr(value, "count"), 'open_source("recording")'),
}


def require_arguments(call: str, **given: object) -> None:
    """Raise an InputError that names the argument of a wrong type, and what opens a right one."""
    for name, value in given.items():
        fits, opener = _ARGUMENTS[name]
        require(call, name, value, fits(value), opener)


def _measured(
    rig: StereoRig, target: Target, left: NDArray[np.uint8], right: NDArray[np.uint8]
) -> PoseEstimate | Missed:
    """Measure one shot, given as grey images of the rig's size."""
    found = target.detect(left), target.detect(right)
    if target.discs is not None:
        factors = rig.disc_variance_factors
        seen = [target.discs.find(image) for image in (left, right)]
        first, second = (replace(d, cov_uv=f * d.cov_uv) for f, d in zip(factors, seen, strict=True))
        return locate_composite(rig, target.body, target.discs, found, (first, second), symmetries=target.symmetries)
    problems = [f"{side}: {d.problem}" for side, d in zip(SIDES, found, strict=True) if d.problem is not None]
    if problems:
        return Missed("; ".join(problems))
    result = measure_detections(rig, target.body, *found, symmetries=target.symmetries)
    if isinstance(result, Missed) or not any(len(d.shape) for d in found):
        return result
    return _without_bias(rig, target, *found, result)


def _without_bias(
    rig: StereoRig, target: Target, left: Detections, right: Detections, rough: PoseEstimate
) -> PoseEstimate | Missed:
    """Measure a board of discs again from a rough pose: the centres of ellipses are not the images of the middles."""
    Ts = rough.T_left_body, inverse(rig.T_left_right) @ rough.T_left_body
    seen_m, problem = seen_radius(target, list(zip(rig.cameras, Ts, (left, right), strict=True)))
    if problem is not None:
        return Missed(problem)
    radius_m, n = seen_m if target.disc_radius_m is None else target.disc_radius_m, len(target.body.points)
    discs = DiscTarget(target.body, np.full(n, radius_m), np.zeros(n, bool), np.tile([0.0, 0.0, -1.0], (n, 1)))
    nothing = Correspondences(np.zeros(0, np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, 2, 2)))
    seen = match(rig, target.body, left, right, symmetries=target.symmetries)
    return locate_discs(rig, target.body, discs, nothing, seen, rough.T_left_body)


def seen_radius(
    board: Target, views: Sequence[tuple[Camera, Array, Detections]], about_m: float | None = None
) -> tuple[float, str | None]:
    """Return the radius of a board's discs that views of it show, m, and what is wrong with the one that is given.

    The areas of the ellipses show it, against the spacing of the discs at the poses T_camera_board (4, 4) of the views;
    ``about_m``: a radius of about the right size.
    """
    points = board.body.points
    about_m = about_m or 0.25 * float(np.linalg.norm(points[1] - points[0]))
    radii = [apparent_radii(camera, T, points[found.ids], found.shape, about_m) for camera, T, found in views]
    seen_m, given_m = float(np.nanmedian(np.concatenate(radii))), board.disc_radius_m
    shape = np.concatenate([found.shape for _, _, found in views])
    radius_px = float(np.median((shape[:, 0] * shape[:, 2] - shape[:, 1] ** 2) ** 0.25))
    if given_m is None or abs(given_m / seen_m - 1.0) <= max(_RADIUS_SHARE, _RADIUS_PX / radius_px):
        return seen_m, None
    return seen_m, (
        f"{board.body.name}: a radius of {1e3 * given_m:.4g} mm is given, and the images show {1e3 * seen_m:.4g} mm: "
        "measure pitch and radius (not the diameter), or leave the radius out"
    )


def size_problem(size_px: tuple[int, int], image: Image, side: str) -> str | None:
    """Return a message where an image does not have the size that a camera was calibrated at, or None."""
    got = (image.shape[1], image.shape[0])
    if got == tuple(size_px):
        return None
    return (
        f"the {side} image is {got[0]}x{got[1]}, the rig was calibrated at {size_px[0]}x{size_px[1]}: measure at the size "
        "the rig was calibrated at"
    )


def measure_detections(
    rig: StereoRig, body: Body, left: Detections, right: Detections, *, symmetries: tuple[np.ndarray, ...] = ()
) -> PoseEstimate | Missed:
    """Measure a body from what each camera detected; ``symmetries`` as in :func:`~armsight.vision.match.match`."""
    result = locate(rig, body, triangulate(rig, body, match(rig, body, left, right, symmetries=symmetries)))
    if isinstance(result, Missed) and _exchanged(rig, body, left, right):
        return Missed(f"left and right are exchanged: the images fit the rig the other way round ({result.reason})")
    return result


def _exchanged(rig: StereoRig, body: Body, left: Detections, right: Detections) -> bool:
    """Whether the detections fit the rig only with the cameras exchanged."""
    common = join(left, right)
    if common.paired.sum() < _EXCHANGED_POINTS:
        return False
    exchanged = triangulate(rig, body, gate(rig, body, join(right, left)))
    return len(exchanged.ids) > 0.8 * int(common.paired.sum())


def measure_seen(rig: StereoRig, body: Body, shot: SeenShot) -> PoseEstimate | Missed:
    """Measure a body from detections of a file; where a name occurs twice, use the body with most detections."""
    if shot.problem is not None:
        return Missed(shot.problem)
    seen = plain(shot)
    if seen is None:
        bodies = instances(body.points, rig, shot)
        if not bodies:
            return Missed("markers occur twice in one image, and no pose of the body agrees with them")
        seen = bodies[0][1]
    return locate(rig, body, triangulate(rig, body, gate(rig, body, seen)))


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
        reasons = [*(reasons if len(body.points) > len(target.body.points) else []), found.reason]
        if min(len(seen.uv) for seen in discs) >= len(target.radii_m):
            reasons.append(
                "or it moved too far between the two exposures, if they are apart: start both by one trigger"
            )
        return Missed("; ".join(reasons))
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
