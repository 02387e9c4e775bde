"""The next poses of an identification: from what was measured already, and what the cameras can see and how well.

In: the nominal arm, poses measured already and a stereo rig, both optional. Out: the chosen poses, as JSON, CSV and text.
"""

from __future__ import annotations

import csv
import io

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.geometry.pose import inverse, transform
from armsight.loop.identify.fit import prior_sigma
from armsight.loop.identify.identify import begun
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.loop.identify.plan import Plan, plan_poses
from armsight.robot.kinematics.arm import Arm
from armsight.vision.rig import StereoRig

#: Assumed of an instrument of which nothing is known: sigma of a position, m, and of a rotation, rad.
NOISE = (1e-4, 5e-4)
#: RMS distance of a body's markers from their middle, m: larger makes its predicted rotation more certain.
SPREAD_M = 0.04
#: Sigma of a marker in an image, px: with the rig's geometry it gives the predicted covariance of a pose.
SIGMA_PX = 0.1
#: Markers of a body.
MARKERS = 6
#: A pose is seen where its body is this far from the images' edges, px.
MARGIN_PX = 60.0
#: Markers are on one side of a body: it is taken to be visible up to the rotation at which it was seen already, and this
#: much more, rad.
MORE_RAD = np.radians(10.0)


def plan_from(arm: Arm, done: Measured | None, rig: StereoRig | None, n: int, seed: int) -> tuple[Plan, Model]:
    """Choose poses.

    Args:
        arm: the nominal arm.
        done: what was measured already, which locates base and tool; None: all that can be reached counts as seen.
        rig: the stereo rig; None: all that can be reached counts as seen, equally well.
        n: how many.
        seed: of the candidates.

    Raises:
        InputError: ``done`` is too few poses, or not of this arm; or fewer than ``n`` poses can be reached and seen.
        CalibrationError: the poses of ``done`` are so alike that they do not determine where the arm is.
    """
    if done is None:
        T = arm.forward(arm.home[None])
        model = Model.of(arm, Measured(arm.home[None], T[:, None, :3, 3], T[:, :3, :3]), backlash=True)
        x, prior = model.nominal(), prior_sigma(model)
    else:
        model, x, prior = begun(arm, done)
    if rig is None or done is None:
        return plan_poses(model, x, prior, NOISE, n, done=done, seed=seed), model
    seen = rig

    limits = None if done.R_rig_body is None else _rotation_limits(seen, _stacked(done))

    def visible(Ts: Array) -> NDArray[np.bool_]:
        out = _visible(seen, Ts)
        if limits is not None:
            axes, most = limits
            out &= (_rotated(seen, Ts, axes) <= most + MORE_RAD).all(axis=1)
        return out

    def cov(Ts: Array) -> Array:
        return _covariance(seen, Ts, None if model.full else model.points)

    return plan_poses(model, x, prior, (1e-6, 1e-6), n, done=done, visible=visible, cov=cov, seed=seed), model


def _visible(rig: StereoRig, Ts: Array) -> NDArray[np.bool_]:
    """Return (N,) whether both cameras see a body's middle, away from their edges and in front."""
    good = np.ones(len(Ts), bool)
    for camera, p in zip(rig.cameras, _in_cameras(rig, Ts[:, :3, 3]), strict=True):
        uv = camera.project(p)
        w, h = camera.image_size_px
        low, high = MARGIN_PX, np.array([w, h]) - MARGIN_PX
        with np.errstate(invalid="ignore"):
            good &= (p[:, 2] > 0) & ((uv > low) & (uv < high)).all(axis=1)
    return good


def _stacked(done: Measured) -> Array:
    """Return the poses (N, 4, 4) of full poses."""
    assert done.R_rig_body is not None  # for the type checker: the caller has looked
    Ts = np.tile(np.eye(4), (len(done), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = done.R_rig_body, done.p_rig[:, 0]
    return Ts


def _to_cameras(rig: StereoRig, Ts: Array) -> Array:
    """Return the unit vectors (N, 2, 3) from the body to both cameras, in its own axes."""
    cameras = np.stack([np.zeros(3), rig.T_left_right[:3, 3]])
    rays = (cameras - Ts[:, None, :3, 3]) @ Ts[:, :3, :3]
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def _rotation_limits(rig: StereoRig, Ts: Array) -> tuple[Array, Array]:
    """Return the side (2, 3) from which each camera saw the body on the whole, and the largest rotation from it, rad."""
    axes = _to_cameras(rig, Ts).mean(axis=0)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return axes, np.asarray(_rotated(rig, Ts, axes).max(axis=0))


def _rotated(rig: StereoRig, Ts: Array, axes: Array) -> Array:
    """Return the rotations (N, 2) of bodies from the sides ``axes`` (2, 3), rad."""
    return np.asarray(np.arccos(np.clip(np.einsum("nci,ci->nc", _to_cameras(rig, Ts), axes), -1, 1)))


def _in_cameras(rig: StereoRig, p_rig: Array) -> tuple[Array, Array]:
    return p_rig, transform(inverse(rig.T_left_right), p_rig)


def _covariance(rig: StereoRig, Ts: Array, points: int | None) -> Array:
    """Return the covariance of bodies: of their middle from all markers, of their rotation from the markers' spread.

    With so many ``points`` of the tool instead of its full pose: theirs, each from its share of the markers.
    """
    H = np.zeros((len(Ts), 3, 3))
    R_right_left = inverse(rig.T_left_right)[:3, :3]
    rotations = (np.eye(3), R_right_left)
    for camera, p, R in zip(rig.cameras, _in_cameras(rig, Ts[:, :3, 3]), rotations, strict=True):
        J = camera.project_jacobians(p)[1] @ R
        H += J.swapaxes(1, 2) @ J / SIGMA_PX**2
    C = np.linalg.inv(H) / MARKERS
    if points is not None:
        return np.asarray(np.kron(np.eye(points), min(points, MARKERS) * C))
    back = Ts[:, :3, :3].swapaxes(1, 2)
    out = np.zeros((len(Ts), 6, 6))
    out[:, :3, :3] = back @ C @ Ts[:, :3, :3]
    # A rotation about one axis shows as displacement along the two others, so their mean stands for it.
    out[:, 3:, 3:] = np.eye(3) * (np.einsum("nii->n", C) / 3 / SPREAD_M**2)[:, None, None]
    return out


def plan_text(plan: Plan) -> str:
    """Return the plan as text: the predicted error after so many poses, then the poses, deg."""
    n = len(plan.q)
    lines = ["predicted error of the tool over the workspace, RMS:"]
    for k in sorted({0, n // 4, n // 2, 3 * n // 4, n}):
        random = plan.random_for(k)
        compared = (
            f"as good as {random} at random"
            if random
            else f"more than {len(plan.random_sigma_m) - 1} at random would do"
        )
        lines.append(f"  after {k:3d} more poses {1e3 * plan.sigma_m[k]:9.3f} mm" + (f"  ({compared})" if k else ""))
    lines.append(
        "joints, deg; approach each from the side given (+: its angle increases), over the last half degree in 1 to 2 s:"
    )
    for k, (q, side) in enumerate(zip(plan.q, plan.approach, strict=True), 1):
        lines.append(
            f"  {k:3d} "
            + "".join(f"{np.degrees(v):9.2f} {'+' if s > 0 else '-'}" for v, s in zip(q, side, strict=True))
        )
    return "\n".join(lines)


def plan_json(plan: Plan) -> dict[str, list[float]]:
    """Return the plan as JSON has it, SI units."""
    return {
        "q_rad": plan.q.tolist(),
        "approach": plan.approach.tolist(),
        "sigma_m": plan.sigma_m.tolist(),
        "random_sigma_m": plan.random_sigma_m.tolist(),
    }


def plan_csv(plan: Plan) -> str:
    """Return the poses as CSV: joint angles, and the direction of approach of each."""
    out = io.StringIO()
    writer, joints = csv.writer(out, lineterminator="\n"), range(plan.q.shape[1])
    writer.writerow([*(f"q{i + 1}_rad" for i in joints), *(f"approach{i + 1}" for i in joints), "sigma_after_mm"])
    for q, side, sigma in zip(plan.q, plan.approach, plan.sigma_m[1:], strict=True):
        writer.writerow([*(f"{v:.6f}" for v in q), *(f"{v:.0f}" for v in side), f"{1e3 * sigma:.4f}"])
    return out.getvalue()
