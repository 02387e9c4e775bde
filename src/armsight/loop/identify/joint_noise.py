"""Scatter of each joint about its reading, from pose to pose: backlash that nothing holds on one side, jitter.

In: a fit, and poses with the instrument's covariance. Out: one sigma per joint, and how far each joint was off at each
pose.

What the residuals show beyond the instrument's covariance is attributed to the joints: each moves the body along its own
column of the Jacobian, so that a joint that lies anywhere in its backlash affects nothing but its own direction. The
variances are those of the greatest likelihood, found by expectation and maximisation (Dempster, Laird and Rubin, Journal of
the Royal Statistical Society B 39, 1977).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.identify import model as chain
from armsight.loop.identify.fit import Solution, noise_cov
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model

#: Steps; the variances have settled to some per cent by then, which is better than so few poses determine them.
STEPS = 60
#: Where a step starts, rad and m: what is not there shrinks from it.
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


def joint_noise(model: Model, solution: Solution, weighted: Measured, measured: Measured) -> JointNoise:
    """Attribute residuals beyond the instrument's covariance to the joints.

    Args:
        model: the arm.
        solution: a fit of it.
        weighted: the poses with the covariance that the fit used.
        measured: the poses, with the instrument's covariance alone.
    """
    phi = model.feature_values(measured.q, measured.approach)
    e, J = model.linearised(solution.x, measured, phi)
    free = J[:, :, solution.free]
    spread = (free @ _part(solution)) @ free.swapaxes(1, 2)  # of the predictions
    taken = float(np.einsum("nij,nji->", spread, _inverse_noise(weighted, solution)))
    share = float(np.clip(1 - taken / e.size, 0.2, 1.0))  # what the fit has left of the residuals' variance
    B = np.concatenate(
        [by_joints(model, J), np.broadcast_to(np.eye(e.shape[1]), (len(e), e.shape[1], e.shape[1]))], axis=2
    )
    measured = with_joint_noise(model, solution.x, measured, np.zeros(model.arm.joints))
    axes = np.arange(e.shape[1]) // 3  # the residual noise of position (0) and of rotation (1): one variance each
    if not model.full:
        axes[:] = 0
    joints = model.arm.joints
    variance = np.concatenate([np.full(joints, START_RAD**2), np.where(axes == 0, START_M, START_RAD) ** 2])
    used = solution.used
    for _ in range(STEPS):
        mean, spread = _expected(e, B, variance, measured)
        second = (mean**2 / share + spread)[used].mean(axis=0)
        variance = second
        for k in np.unique(axes):
            variance[joints:][axes == k] = second[joints:][axes == k].mean()
    mean, spread = _expected(e, B, variance, measured)
    return JointNoise(np.sqrt(variance[:joints]), mean[:, :joints], np.sqrt(spread[:, :joints]))


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


def _expected(e: Array, B: Array, variance: Array, measured: Measured) -> tuple[Array, Array]:
    """Return mean (N, K) and variance (N, K) of every source at every pose, given the residuals."""
    assert measured.cov is not None  # for the type checker: without it nothing is attributed to the joints
    S = measured.cov + (B * variance) @ B.swapaxes(1, 2)
    gain = variance[:, None] * np.linalg.solve(S, B).swapaxes(1, 2)
    mean = (gain @ e[..., None])[..., 0]
    return mean, np.maximum(variance - np.einsum("nkm,nmk->nk", gain, B * variance), 0.0)


def _part(solution: Solution) -> Array:
    return np.asarray(solution.cov[np.ix_(solution.free, solution.free)])


def _inverse_noise(measured: Measured, solution: Solution) -> Array:
    return np.asarray(np.linalg.inv(noise_cov(measured, solution.noise)))
