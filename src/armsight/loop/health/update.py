"""The relative pose of the cameras estimated again from a body in view, where the cameras moved after their calibration.

In: a calibrated rig, a body, and detections of it. Out: the rig with what these say of it, with its covariance; or why
they say too little. Model and sums are those of :mod:`armsight.loop.health.rig`. All parameters of the rig are estimated,
with the calibration as their prior; the prior of the right camera's pose is dropped, except for the length of the
baseline: the shots cannot distinguish it from the size of the body.

Where there are shots from before the change as well, the change f alone is estimated: of both,

    r = B x + S e + n before,    r = B (x + F f) + S e + n after

with the calibration's error x and the body's e the same. What both have in common cancels, and poses stay in the frame in
which they were before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armsight.data import Array, Body, Correspondences, Missed, PoseEstimate, Record
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.finding import HealthFinding, make_finding
from armsight.loop.health.residuals import ResidualSums
from armsight.loop.health.rig import RigWatch, free_directions
from armsight.vision.detections import SeenShot
from armsight.vision.match import epipolar_distances, gate
from armsight.vision.pose.locate import locate
from armsight.vision.pose.measure import measure_seen
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import triangulate

#: Depths at which the effect is given, m.
DEPTHS_M = (0.5, 1.0, 2.0)
#: Fewer shots that differ than this are rejected, and a rotation of the right camera less well known than this, rad.
LEAST_STAYS, MOST_SIGMA_RAD = 8, float(np.radians(0.02))
#: The cameras may have moved so far across the baseline (2), m, and about their axes (3), rad: the prior.
_FREED = np.array([0.01, 0.01, *np.radians([2.0, 2.0, 2.0])])
#: Standard deviations by which detections are gated, step by step, px (0: the rig's); and the one that the fit starts
#: with.
_GATES_PX, _NOISE_PX = (20.0, 2.0, 0.0, 0.0), 0.1
#: A rotation about the baseline's normal hardly changes epipolar distances: chance makes them so many times larger at most.
_WORSE = 1.2
#: A change of the cameras is meant where this share of the shots that contradict the rig fits with it.
_EXPLAINED = 0.8
#: In so many shots at most the uncertainty of the body is computed.
_SIZED = 12


@dataclass(frozen=True, eq=False)
class RigUpdate(Record):
    """A rig whose relative pose was estimated again."""

    rig: StereoRig
    rotation_rad: float  #: rotation of the right camera against the old rig
    sigma_rad: float  #: standard deviation of the rotation about its worst axis
    shift_m: float  #: distance of the right camera from where the old rig has it, across the baseline
    #: error of the depth that the old rig measures on the left camera's axis at DEPTHS_M
    depth_errors_m: tuple[float, ...]
    #: RMS distance of the detections from their epipolar lines (Sampson), before and after
    epipolar_px: tuple[float, float]
    shots: int
    stays: int  #: how many of them differ from one another
    #: standard deviation of the body's position with the new rig, and what it would be with the calibration's, m
    sigma_m: tuple[float, float]

    def figures(self) -> dict[str, Any]:
        """Return the figures as JSON has them."""
        return {
            "rotation_changed_deg": float(np.degrees(self.rotation_rad)),
            "rotation_sigma_deg": float(np.degrees(self.sigma_rad)),
            "shift_across_baseline_m": self.shift_m,
            "depth_error_of_old_rig_m": {
                f"{depth:g}": value if math.isfinite(value) else None
                for depth, value in zip(DEPTHS_M, self.depth_errors_m, strict=True)
            },
            "epipolar_rms_before_px": self.epipolar_px[0],
            "epipolar_rms_after_px": self.epipolar_px[1],
            "shots": self.shots,
            "differing_shots": self.stays,
        }

    def lines(self) -> list[str]:
        """Return the figures as lines for people."""
        depths = ", ".join(
            f"{f'{1e3 * value:+.2f} mm' if math.isfinite(value) else 'unknown'} at {depth:g} m"
            for depth, value in zip(DEPTHS_M, self.depth_errors_m, strict=True)
        )
        before, after = self.epipolar_px
        return [
            f"right camera: rotated by {np.degrees(self.rotation_rad):.3f} +- {np.degrees(self.sigma_rad):.3f} deg, "
            f"shifted across the baseline by {1e3 * self.shift_m:.3f} mm",
            f"depth error of the old rig: {depths}",
            f"epipolar distance, RMS: {before:.3f} px before, {after:.3f} px after",
            f"{self.shots} shots used, {self.stays} differ from one another",
        ]


def updated_rig(
    rig: StereoRig, body: Body, shots: Sequence[SeenShot], before: Sequence[SeenShot] = ()
) -> RigUpdate | Missed:
    """Estimate the relative pose of a rig's cameras again, by detections anywhere in view, before and after the change."""
    if not rig.cov.any():
        return Missed("the rig has no covariance: what is known of the cameras themselves must stand in its file")
    free = free_directions(rig)
    prior = rig.cov + (free * _FREED**2) @ free.T
    new, stays, found, noise_px = rig, 0, list[PoseEstimate](), _NOISE_PX
    for gate_px in _GATES_PX:
        gate = replace(new, cov=prior, sigma_px=gate_px or rig.sigma_px)
        measured = [measure_seen(gate, body, shot) for shot in shots]
        found = [each for each in measured if isinstance(each, PoseEstimate)]
        if not found:
            reason = next((each.reason for each in measured if isinstance(each, Missed)), "no shot")
            return Missed(f"the body is measured in no shot: {reason}")
        watch = RigWatch(replace(new, cov=prior, sigma_px=noise_px), body, 0.0)
        sums, stays = watch.information(found)
        if stays < LEAST_STAYS:
            return Missed(
                f"{stays} of {len(found)} shots differ from one another, {LEAST_STAYS} are needed: move the body through "
                "the view"
            )
        new, noise = _estimated(rig, new, body, before, sums, noise_px)
        noise_px *= noise
    some = shots[:: -(-len(shots) // _SIZED)]
    now, then = (_position_sigma(each, body, some) for each in (new, replace(new, cov=rig.cov)))
    return _checked(rig, new, body, found, (stays, (now, then)))


def contradiction(rig: StereoRig, body: Body, missed: Sequence[PoseEstimate], shots: tuple[int, int]) -> HealthFinding:
    """Return what explains that most shots that show a body contradict the rig."""
    moved, resized, found = RigWatch(rig, body, 0.0).explained(missed)
    seen = [each.points.seen for each in missed]
    again = [locate(moved, resized, triangulate(moved, resized, gate(moved, resized, each))) for each in seen]
    right = sum(isinstance(each, PoseEstimate) for each in again)
    uv = np.concatenate([each.uv[each.paired] for each in seen])
    low, off_px, high = np.percentile(epipolar_distances(rig, uv[:, 0], uv[:, 1]).max(axis=1), (16.0, 50.0, 84.0))
    shown = (
        f"{shots[0]} of {shots[1]} shots that show the target contradict the rig, {off_px:.1f} px off epipolar lines"
    )
    if right >= _EXPLAINED * len(missed):
        question = "did the cameras move? " if found.cause == "rig" else ""
        return replace(found, what=f"{question}{shown}; {right} of {len(missed)} fit if {found.what}")
    return make_finding("contradicted", (float(off_px), float(high - low) / 2.0), words={"shown": shown})


def _estimated(
    rig: StereoRig, new: StereoRig, body: Body, before: Sequence[SeenShot], later: ResidualSums, noise_px: float
) -> tuple[StereoRig, float]:
    """Estimate the right camera's pose again, from shots before its change and the sums of those after it, about ``new``.

    Returns:
        The rig, and by how much the standard deviation of its residuals is larger than the one they were whitened with.
    """
    watch = RigWatch(replace(rig, sigma_px=noise_px), body, 0.0)
    measured = [measure_seen(rig, body, shot) for shot in before]
    sooner, _ = watch.information([each for each in measured if isinstance(each, PoseEstimate)])
    count, size = rig.parameter_count, len(later.b)
    F, so_far = np.zeros((size, 5)), np.zeros(size)
    F[:count], so_far[:count] = free_directions(rig), _difference(rig, new)
    HF, b = later.H @ F, later.b + later.H @ so_far
    H = np.block([[sooner.H + later.H, HF], [HF.T, F.T @ HF]])
    M = np.zeros((size + 5, size + 5))
    M[:size, :size], M[size:, size:] = watch.prior, np.diag(_FREED)
    cov = M @ np.linalg.solve(M.T @ H @ M + np.eye(size + 5), M.T)
    found = cov @ np.concatenate([sooner.b + b, F.T @ b])
    x, f = found[:size], found[size:]
    left = _left(sooner, x) + _left(later, x + F @ f - so_far)
    # Poses stay in the frame in which they were before, where it is known: then the change alone moves the rig.
    B = np.hstack([np.zeros((size, size)) if before else np.eye(size), F])[:count]
    spread = B @ cov @ B.T + (rig.cov if before else 0.0)
    moved = replace(rig.perturbed(B @ found), cov=(spread + spread.T) / 2)
    return moved, float(np.sqrt(left / max(sooner.freedom + later.freedom, 1.0)))


def _left(sums: ResidualSums, x: Array) -> float:
    return max(sums.square - 2.0 * float(x @ sums.b) + float(x @ sums.H @ x), 0.0)


def _position_sigma(rig: StereoRig, body: Body, shots: Sequence[SeenShot]) -> float:
    """Return the RMS standard deviation of the body's position in some shots, m; NaN where none is measured."""
    measured = [measure_seen(rig, body, shot) for shot in shots]
    variances = [np.trace(each.cov[:3, :3]) for each in measured if isinstance(each, PoseEstimate)]
    return float(np.sqrt(np.mean(variances))) if variances else float("nan")


def _checked(
    old: StereoRig, new: StereoRig, body: Body, found: Sequence[PoseEstimate], said: tuple[int, tuple[float, float]]
) -> RigUpdate | Missed:
    """Return the update with its figures, or why it is rejected; the last two figures are given."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(new.cov[-3:, -3:])[-1]))
    if sigma > MOST_SIGMA_RAD:
        return Missed(
            f"the shots leave the rotation of the right camera uncertain by {np.degrees(sigma):.3f} deg, at most "
            f"{np.degrees(MOST_SIGMA_RAD):.3f} is accepted: move the body through the whole view, and nearer"
        )
    uv = np.concatenate([each.points.seen.uv[each.points.seen.paired] for each in found])
    before, after = (
        float(np.sqrt(np.mean(np.square(epipolar_distances(each, uv[:, 0], uv[:, 1]))))) for each in (old, new)
    )
    if after > _WORSE * before:
        return Missed(
            f"the new pose explains the shots worse than the old one: epipolar distance {after:.3f} px, {before:.3f} "
            "before; was the body moving, or are cameras or body others than the files say?"
        )
    moved = _difference(old, new)[-6:]
    along = old.T_left_right[:3, :3].T @ old.T_left_right[:3, 3] / old.baseline_m
    across = moved[:3] - along * float(along @ moved[:3])
    return RigUpdate(
        new,
        float(np.linalg.norm(moved[3:])),
        sigma,
        float(np.linalg.norm(across)),
        tuple(_depth_error(old, new, depth) for depth in DEPTHS_M),
        (before, after),
        len(found),
        *said,
    )


def _difference(old: StereoRig, new: StereoRig) -> Array:
    """Return the step (P,) with ``old.perturbed(step)`` the other rig."""
    cameras = [b.parameters - a.parameters for a, b in zip(old.cameras, new.cameras, strict=True)]
    return np.concatenate([*cameras, log_se3(inverse(old.T_left_right) @ new.T_left_right)])


def _depth_error(old: StereoRig, new: StereoRig, depth_m: float) -> float:
    """Return the error of the depth, m, that the old rig measures of a point on the left axis at a depth, m; or NaN."""
    point = np.array([[0.0, 0.0, depth_m]])
    there = inverse(new.T_left_right)
    uv = [new.left.project(point), new.right.project(point @ there[:3, :3].T + there[:3, 3])]
    seen = Correspondences(np.zeros(1, np.int64), np.stack(uv, axis=1), np.tile(1e-4 * np.eye(2), (1, 2, 1, 1)))
    points = triangulate(old, Body("axis", ("point",), point), seen)
    return float(points.p_left[0, 2] - depth_m) if len(points.ids) else float("nan")
