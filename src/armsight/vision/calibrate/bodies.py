"""A known body moving in view of two cameras of known intrinsics: their relative pose, and a refined body.

Per shot, every pose that one camera alone allows, mirror solutions included; the relative pose that most shots agree
on; then the joint adjustment of relative pose, poses and (on request) the body's shape, within a tolerance that the shots
show themselves. Rigid motion and size of the body are held: they are not observable, for poses and baseline have the
same effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Correspondences
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, log_se3
from armsight.vision.calibrate import FOLDS
from armsight.vision.calibrate.heldout import (
    Trial,
    adjusted,
    concluded,
    cross_validate,
    require_choice,
    rig_of,
    summary,
)
from armsight.vision.calibrate.result import Calibration, RejectedPair
from armsight.vision.calibrate.start import relative_poses
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.pose.assign import candidates, instances, joined
from armsight.vision.pose.bundle import BundleModel, BundleState, Observations, minimise
from armsight.vision.pose.pnp import Candidate
from armsight.vision.pose.projection import every_point
from armsight.vision.rig import StereoRig

#: Standard deviation of each coordinate of a body's points from its drawing, m, before the shots show it; half, double: the
#: same.
_START_TOLERANCE_M = 4e-4
LEAST_SHOTS = 5
_START_SIGMA_PX = 2.0
_START_SHOTS = 40
Found = tuple[list[Candidate], list[Candidate]]
Progress = Callable[[str], None]


def calibrate_bodies(
    body: Body,
    shots: Sequence[SeenShot],
    cameras: tuple[Camera, Camera],
    *,
    refine_body: bool = False,
    folds: int = FOLDS,
    progress: Progress = lambda message: None,
) -> Calibration:
    """Find the relative pose of two cameras from detections of a known body.

    ``body``: the body's points, m, of its drawing; ``shots``: the detections of both cameras in every shot; ``cameras``:
    the cameras with their known intrinsics; ``refine_body``: estimate how the body differs from its drawing; ``folds``: how
    many parts the shots are split into for the held-out errors. Returns the rig, the body as estimated, held-out errors,
    and what was not used. Raises CalibrationError: too few shots, or no relative pose that they agree on.
    """
    require_choice(folds)
    progress("looking for the body in every image")
    found = [candidates(body.points, cameras, shot) for shot in shots]
    progress("estimating the relative pose of the cameras")
    rig, points = _start(body.points, cameras, shots, found), body.points
    for tolerance in (0.0, 0.0, _START_TOLERANCE_M, _START_TOLERANCE_M) if refine_body else (0.0, 0.0, 0.0):
        names, seen, poses, rejected = _assigned(points, rig, shots, found)
        if len(seen) < LEAST_SHOTS:
            why = "; ".join(f"shot {r.pair}: {r.reason}" for r in rejected[:2])
            raise CalibrationError(f"{len(seen)} of {len(shots)} shots are usable, {LEAST_SHOTS} are needed: {why}")
        observations, model = Observations.from_shots(seen), _model(body.points, tolerance)
        state = BundleState(cameras, rig.T_left_right, np.stack(poses), np.zeros(len(model.modes)))
        model, _, solution = adjusted(model, state, observations, _START_SIGMA_PX)
        rig = replace(rig, T_left_right=solution.state.T_left_right)
        points = model.body(solution.state.shape)
    progress("evaluating the rig on held-out shots")

    def fit(rows: NDArray[np.intp]) -> tuple[StereoRig, Array, None]:
        state = replace(solution.state, Ts_left_body=solution.state.Ts_left_body[rows])
        part = minimise(model, state, observations.shots(rows), solution.sigma_px)
        return rig_of(part), model.body(part.state.shape), None

    parts = min(folds, len(seen))
    errors = cross_validate(fit, body.points, observations, parts)
    heldout = summary(errors, parts)
    notes: tuple[str, ...] = ()
    if refine_body:
        tolerance_m = model.shape_sigma_m * np.sqrt(len(model.modes) / (3 * len(body.points)))
        notes = (f"the body differs from its drawing by {1e3 * tolerance_m:.2g} mm per coordinate, as the shots show",)
    return concluded(
        body,
        Trial(model, None, solution, errors, heldout),
        observations,
        models={cameras[0].model: heldout},
        pairs=tuple(names),
        pairs_found=len(shots),
        rejected=tuple(rejected),
        notes=notes,
    )


def _start(points: Array, cameras: tuple[Camera, Camera], shots: Sequence[SeenShot], found: list[Found]) -> StereoRig:
    """Return the rig under whose relative pose most detections belong to bodies that both cameras see."""
    both = [j for j, (left, right) in enumerate(found) if left and right]
    both = sorted(both, key=lambda j: -sum(len(side[0].rows) for side in found[j]))[:_START_SHOTS]
    if not both:
        raise CalibrationError("no shot shows three or more of the body's points in both cameras")
    views = [[[c.T_camera_body for c in found[j][side]] for j in both] for side in (0, 1)]
    best, most, count = None, -1, sum(camera.parameters.size for camera in cameras) + 6
    for T in relative_poses(views[0], views[1]):
        rig = StereoRig(*cameras, T, np.zeros((count, count)), 0.0)
        rig = _refined(points, rig, [shots[j] for j in both], [found[j] for j in both])
        # A body that one camera alone sees does not constrain the other: any relative pose explains it.
        explained = sum(
            sum(int(seen.seen.sum(axis=0).min()) for _, seen in instances(points, rig, shots[j], found[j]))
            for j in both
        )
        if explained > most:
            best, most = rig, explained
    assert best is not None
    return best


def _refined(points: Array, rig: StereoRig, shots: list[SeenShot], found: list[Found]) -> StereoRig:
    """Adjust a hypothesis of the relative pose to the pairs of candidates that agree with it."""
    seen, poses = [], []
    for shot, (left, right) in zip(shots, found, strict=True):
        pairs = [(a, b) for a in left for b in right]
        gaps = [
            np.linalg.norm(log_se3(inverse(rig.T_left_right) @ a.T_camera_body @ inverse(b.T_camera_body)))
            for a, b in pairs
        ]
        a, b = pairs[int(np.argmin(gaps))]
        seen.append(joined(shot, (a.rows, b.rows)))
        poses.append(a.T_camera_body)
    state = BundleState(rig.cameras, rig.T_left_right, np.stack(poses), np.zeros(0))
    try:
        found_state = minimise(_model(points, 0.0), state, Observations.from_shots(seen), _START_SIGMA_PX).state
    except (CalibrationError, np.linalg.LinAlgError):
        return rig
    return replace(rig, T_left_right=found_state.T_left_right)


def _assigned(
    points: Array, rig: StereoRig, shots: Sequence[SeenShot], found: list[Found]
) -> tuple[list[str], list[Correspondences], list[Array], list[RejectedPair]]:
    """Give every shot its detections of the body and its pose, or the reason why it has none."""
    names, seen, poses, rejected = [], [], [], []
    for shot, candidates_of_shot in zip(shots, found, strict=True):
        bodies = instances(points, rig, shot, candidates_of_shot)
        if not bodies:
            count = sum(len(ids) for ids in shot.ids)
            rejected.append(RejectedPair(shot.name, f"no pose of the body agrees with its {count} detections"))
            continue
        names.append(shot.name)
        poses.append(bodies[0][0])
        seen.append(bodies[0][1])
    return names, seen, poses, rejected


def _model(points: Array, tolerance_m: float) -> BundleModel:
    """The body of the drawing, or free within a tolerance."""
    if tolerance_m == 0:
        return BundleModel(points, np.zeros((0, len(points), 3)), 1.0, False)
    # A mode moves the points by one RMS: K modes of sigma s together give each coordinate a sigma of s sqrt(K / 3).
    modes = every_point(points)
    return BundleModel(points, modes, tolerance_m / np.sqrt(len(modes) / 3), False)
