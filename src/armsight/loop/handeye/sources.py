"""Sources of the error of hand-eye residuals, and what a unit of each does to them.

In: poses and their residuals. Out: independent sources as maps (:func:`error_maps`), shared ones as columns
(:func:`over_poses`, :func:`over_time`), for :class:`~armsight.estimate.linear.Linear`.

Independent from pose to pose:

- ``flange_m``, ``flange_rad``: the flange by the joints, about the flange.
- ``lateral_m``, ``depth_m``: the measured body's middle across and along the optical axis; ``seen_rad``: its rotation about
  its middle. ``image``: the covariance given, times the square of this.
- ``time_s``: the time stamp, along the motion (streams).

Shared, by the arm (one of the two pairs):

- ``link_m``, ``link_rad``: a constant error of every link's frame, along and about its three axes, where the joints and a
  model are known: what an arm whose lengths and zeros are not its model's does in each of its poses.
- ``drift_m``, ``drift_rad``: the same where they are not known: a constant error and a smooth function of the pose, a
  Gaussian process (Rasmussen and Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.31).

Shared, by the eye:

- ``size``: all that is seen is too far away by one share: the target's size is wrong, or the arm's lengths are.
- ``focal``: only its depth is: the camera's focal length is wrong.

Shared, over time:

- ``time_drift_m``, ``time_drift_rad``: the arm, a smooth function of time (it warms up).
- ``time_walk_m``, ``time_walk_rad``: the arm, a random walk (it slips, settles, loses steps: what it has gained stays).
- ``walk_m``, ``walk_rad``: a random walk of the eye's own pose (visual odometry).
- ``scale_walk``: the scale of one moving camera, which has none of its own, walks over time: the eye's way from the body's
  origin is too long by a share that is a Wiener process.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.estimate.linear import factor, spread
from armsight.geometry.pose import adjoint, exp_se3, inverse, small_adjoint
from armsight.geometry.rotation import skew
from armsight.loop.handeye.poses import Poses

#: Sources of the arm that are not independent from pose to pose: with its model, and without.
LINKS, DRIFT = ("link_m", "link_rad"), ("drift_m", "drift_rad")
EYE = ("size", "focal")  # what is constantly off in the eye
#: Sources that change over time, each a pair or one: what is taken up together.
OVER_TIME = (
    ("time_drift_m", "time_drift_rad"),
    ("time_walk_m", "time_walk_rad"),
    ("walk_m", "walk_rad"),
    ("scale_walk",),
)
OF_THE_ARM = ("flange_m", "flange_rad", *LINKS, *DRIFT, *OVER_TIME[0], *OVER_TIME[1])  # sources that are the arm's
#: Shared source -> the map that says what it does to a pose.
MAP_OF = {name: f"flange_{name.rpartition('_')[2]}" for name in (*DRIFT, *OVER_TIME[0], *OVER_TIME[1])} | {
    "scale_walk": "size"
}
#: What people read of a source, by its name without the unit.
SAID = {
    "link": "robot's geometry off",
    "drift": "robot drifting over its poses",
    "time_drift": "robot drifting over time",
    "time_walk": "robot walking over time",
    "walk": "camera walking",
    "scale_walk": "camera's scale walking",
    "size": "target's size or robot's lengths off",
    "focal": "focal length off",
}
#: Where a drift over poses has forgotten itself: this rotation, rad, or this way, m; and over time, a share of the whole.
FORGETS_RAD, FORGETS_M, FORGETS_SHARE = 1.0, 0.4, 0.15
#: The constant part of an arm's error over its changing part, sigmas: links of six arms give 0.8 to 2.3.
CONSTANT = 1.7


def error_maps(
    poses: Poses, e: Array, carry: Array, speed: Array | None, links: Array | None = None
) -> dict[str, Array]:
    """Return what unit errors of each independent source do to the residuals.

    ``poses``: N poses. ``e``: (N, 6) the residuals. ``carry``: (N, 6, 6) adjoints that map an error of the flange to
    the residuals. ``speed``: (N, 6) twist of the flange, right tangent, m/s and rad/s; None: no streams. ``links``: (N,
    L, 4, 4) T_link_flange, m; None: no model.
    """
    n = len(poses.A)
    axes = np.zeros((n, 6, 3))
    axes[:, :3] = np.swapaxes(poses.B[:, :3, :3], 1, 2)  # the rig's axes in the body's
    about = np.zeros((n, 6, 3))
    about[:, :3], about[:, 3:] = skew(poses.centre), np.eye(3)
    # Where the flange says that it was seen: with the noise of what was, a share of -1 would explain that noise, too.
    at = (poses.B @ exp_se3(-e if poses.in_hand else e))[:, :3, 3:]
    maps = {
        "flange_m": carry[..., :3],
        "flange_rad": carry[..., 3:],
        "lateral_m": axes[..., :2],
        "depth_m": axes[..., 2:],
        "seen_rad": about,
        "size": axes @ at,
        "focal": axes[..., 2:] * at[:, 2:],
    }
    if speed is not None:
        maps["time_s"] = carry @ speed[..., None]
    if links is not None:
        # As the derivative by the mounting is: an error of the flange's frame and one of the mounting are the same.
        bent = (np.eye(6) + 0.5 * small_adjoint(e)) @ carry
        moved = np.swapaxes(bent[:, None] @ adjoint(inverse(links)), 1, 2)  # (N, 6, L, 6)
        maps["link_m"], maps["link_rad"] = (moved[..., part].reshape(n, 6, -1) for part in (slice(3), slice(3, 6)))
    return maps


def pose_kernel(A: Array) -> Array:
    """Return the correlation (N, N) of a smooth error between poses (N, 4, 4)."""
    way = np.sum((A[:, None, :3, 3] - A[None, :, :3, 3]) ** 2, axis=-1)
    # Chords, not angles: an exponential of squared angles is no covariance (Feragen et al., CVPR 2015).
    chords = 3 - np.einsum("iab,jab->ij", A[:, :3, :3], A[:, :3, :3])
    return np.asarray(np.exp(-0.5 * (way / FORGETS_M**2 + chords / FORGETS_RAD**2)))


def time_kernel(t_s: Array) -> Array:
    """Return the correlation (N, N) of a slow error between times (N,), s."""
    span = max(float(t_s.max() - t_s.min()), 1e-9) * FORGETS_SHARE
    return np.asarray(np.exp(-0.5 * ((t_s[:, None] - t_s[None]) / span) ** 2))


def over_poses(A: Array, maps: dict[str, Array]) -> dict[str, Array]:
    """Return the columns (N, 6, c) of an arm whose error is a smooth function of its pose (N, 4, 4)."""
    F = np.column_stack([np.full(len(A), CONSTANT), factor(pose_kernel(A))])
    return {name: spread(F, maps[MAP_OF[name]]) for name in DRIFT}


def over_time(t_s: Array, poses: Poses, maps: dict[str, Array], scale: bool) -> dict[str, Array]:
    """Return the columns (N, 6, c) of what changes over time (N,), s; ``scale``: whether the scale is fitted."""
    drift = np.column_stack([np.ones(len(t_s)), factor(time_kernel(t_s))])
    steps = np.sqrt(np.diff(t_s) / max(float(t_s[-1] - t_s[0]), 1e-9))  # a Wiener process of variance 1 over the whole
    walk = np.tril(np.ones((len(t_s), len(t_s))), 0)[:, 1:] * steps
    columns = {
        name: spread(F, maps[MAP_OF[name]]) for F, of in ((drift, OVER_TIME[0]), (walk, OVER_TIME[1])) for name in of
    }
    if poses.in_hand:
        # The eye's pose in the body is off by steps exp(xi_j), each in the eye's own axes: in the body's they add up.
        axes = adjoint(inverse(poses.B))
        for name, part in (("walk_m", axes[..., :3]), ("walk_rad", axes[..., 3:])):
            columns[name] = np.cumsum(spread(np.vstack([0 * steps, np.diag(steps)]), part), axis=0)
    if scale:
        columns["scale_walk"] = spread(walk, maps["size"])
    return columns
