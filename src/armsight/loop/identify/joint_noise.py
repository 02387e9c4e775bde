"""Scatter of each joint about its reading, from pose to pose: backlash that nothing holds on one side, jitter.

In: a fit, and poses with the instrument's covariance. Out: one sigma per joint, and how far each joint was off at each
pose.

What the residuals show beyond the instrument's covariance is attributed to the joints: each moves the body along its own
column of the Jacobian, so that a joint that lies anywhere in its backlash affects nothing but its own direction. The
variances are those of the greatest restricted likelihood (:mod:`armsight.estimate.variance`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.estimate.solve import covariances
from armsight.estimate.variance import restricted
from armsight.loop.identify import model as chain
from armsight.loop.identify.fit import MAX_NOISE, MIN_NOISE, Solution, linear_of
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model

#: Where the search starts, rad and m: what is not there shrinks from it.
START_RAD, START_M = 1e-3, 1e-4


class JointNoise(NamedTuple):
    """What is off by chance.

    Attributes:
        sigma_rad: (n,) of each joint.
        off_rad: (N, n) by how much each joint was off at each pose, as far as the residuals show it.
        sigma_off_rad: (N, n) their sigmas.
    """

    sigma_rad: Array
    off_rad: Array
    sigma_off_rad: Array


def no_noise(joints: int) -> JointNoise:
    """Return what is said of so many joints where the instrument's covariance is unknown."""
    return JointNoise(np.zeros(joints), np.zeros((0, joints)), np.zeros((0, joints)))


def joint_noise(model: Model, solution: Solution, prior: Array, measured: Measured) -> JointNoise:
    """Attribute residuals beyond the instrument's covariance to the joints.

    Args:
        model: the arm.
        solution: a fit of it.
        prior: (P,) the prior sigmas of that fit.
        measured: the poses, with the instrument's covariance alone.
    """
    phi = model.feature_values(measured.q, measured.approach)
    with_sides = with_joint_noise(model, solution.x, measured, np.zeros(model.arm.joints))
    linear = linear_of(model, solution.x, with_sides, phi, solution.free, prior)
    B = by_joints(model, model.linearised(solution.x, measured, phi)[1])
    joints = {f"joint {i + 1}": B[:, :, [i]] for i in range(model.arm.joints)}
    linear = replace(linear, own=joints | linear.own)
    start = np.array([START_RAD] * len(joints) + [START_M, START_RAD][: len(linear.own) - len(joints)]) ** 2
    variances = restricted(linear.rows(np.flatnonzero(solution.used)), start, MIN_NOISE, MAX_NOISE)
    of = variances[: len(joints)]
    gain = of[:, None] * B.swapaxes(1, 2) @ np.linalg.inv(covariances(linear, variances))
    spread = np.maximum(of - np.einsum("nkm,nmk->nk", gain, B * of), 0.0)
    return JointNoise(np.sqrt(of), (gain @ linear.e[..., None])[..., 0], np.sqrt(spread))


def with_joint_noise(model: Model, x: Array, measured: Measured, sigma_rad: Array) -> Measured:
    """Return the poses with the joints' scatter added to their covariance.

    Added, too, is the uncertainty on which side of its backlash a joint lies where gravity and friction are about as
    strong.
    """
    if measured.cov is None:
        return measured
    phi = model.feature_values(measured.q, measured.approach)
    variance = sigma_rad**2 + _of_sides(model, x, phi)
    if not variance.any():
        return measured
    _, J = model.linearised(x, measured, phi)
    B = by_joints(model, J) * np.sqrt(variance)[:, None]
    return replace(measured, cov=measured.cov + B @ B.swapaxes(1, 2))


def _of_sides(model: Model, x: Array, phi: Array) -> Array:
    """Return the variance (N, n), rad^2, of joints in backlash that gravity closes: 1 - mean^2 of a side of +-1."""
    out = np.zeros((len(phi), model.arm.joints))
    for k, f in enumerate(model.features):
        if f.kind == "gravity_backlash":
            half = 0.5 * x[model.sources_at + k]
            out[:, f.joint] = half**2 * (1 - (2 * phi[:, k]) ** 2) * phi[:, k].any()
    return out


def by_joints(model: Model, J: Array) -> Array:
    """Return the derivative (N, M, n) by the joints' angles, from that by all parameters (N, M, P)."""
    return np.asarray(J[:, :, model.table_at + chain.OFFSET : model.sources_at : len(chain.COLUMNS)])
