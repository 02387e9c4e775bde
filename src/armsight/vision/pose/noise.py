"""How far a camera's disc centres are off, over what each image says of it: measured from the shots of a moving body.

In: poses of a body of discs. Out: a :class:`~armsight.vision.rig.CameraNoise` for each camera, for the rig's file.
An image shows the noise along its rims, from few discs. What it does not show (a colour mosaic, the blocks of JPEG,
light that slopes) moves centres by as much again. The residuals of many poses have all of it: their squares over their
degrees of freedom are the factor. A body that deviates from its file has residuals that move with it; the offsets of
its points are estimated from all shots together, the poses' own adjustment eliminated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids, PoseEstimate
from armsight.geometry.pose import inverse
from armsight.geometry.rotation import skew
from armsight.vision.markers.marker import Target
from armsight.vision.rig import CameraNoise, StereoRig

#: Shots that are kept at most, and degrees of freedom that each camera needs at least: then the factor is within 15 %.
_MOST_SHOTS, _LEAST_FREEDOM = 300, 100.0
#: What repeats with the pixels (mosaic, blocks of eight) shows only once discs have moved, px RMS.
_LEAST_MOTION_PX = 4.0
#: A factor outside is that of something else, or the rig's ``sigma_px`` hides it.
_FACTORS = 0.05, 50.0
_ROUNDS = 12


class _Shot(NamedTuple):
    """The N detections of discs in a shot: rows of the body, cameras, px, and derivatives by the pose and by the points."""

    ids: Ids
    side: Ids
    uv: Array
    residual: Array
    cov: Array
    by_pose: Array
    by_point: Array


class DiscNoise:
    """Collects the residuals of poses."""

    def __init__(self, rig: StereoRig, target: Target) -> None:
        """Prepare for a body; one without discs gives nothing."""
        self.rig, self._points = rig, target.body.points
        self._first = len(self._points) - (0 if target.discs is None else len(target.discs.body.points))
        self._shots: list[_Shot] = []

    def add(self, pose: PoseEstimate) -> None:
        """Add the detections of a shot."""
        seen = pose.points.seen
        if len(self._shots) >= _MOST_SHOTS:
            return
        here, side = np.nonzero((seen.ids >= self._first)[:, None] & np.isfinite(seen.uv[:, :, 0]))
        if len(here) <= 3:
            return
        ids, uv, cov = seen.ids[here], seen.uv[here, side], seen.cov_uv[here, side]
        p, expected, by_point = self._points[ids], np.empty((len(ids), 2)), np.empty((len(ids), 2, 3))
        Ts = pose.T_left_body, inverse(self.rig.T_left_right) @ pose.T_left_body
        for s, (camera, T) in enumerate(zip(self.rig.cameras, Ts, strict=True)):
            m = side == s
            expected[m], by_p, _ = camera.project_jacobians(p[m] @ T[:3, :3].T + T[:3, 3])
            by_point[m] = by_p @ T[:3, :3]
        by_pose = np.concatenate([by_point, by_point @ np.array([-skew(each) for each in p])], axis=2)
        image = cov / np.array(self.rig.disc_variance_factors)[side][:, None, None]
        self._shots.append(_Shot(ids - self._first, side, uv, uv - expected, image, by_pose, by_point))

    def found(self) -> tuple[CameraNoise, CameraNoise] | None:
        """Return the noise of both cameras; None where too few shots or too little motion show it."""
        if not self._shots or self._motion_px() < _LEAST_MOTION_PX:
            return None
        side = np.concatenate([shot.side for shot in self._shots])
        points = len(np.unique(np.concatenate([shot.ids for shot in self._shots])))
        unknowns = 6 * len(self._shots) + max(3 * points - 6, 0)
        count = np.array([(side == s).sum() for s in (0, 1)])
        freedom = 2 * count * max(1 - unknowns / (2 * len(side)), 0.0)
        if freedom.min() < _LEAST_FREEDOM:
            return None
        factors = np.ones(2)
        for _ in range(_ROUNDS):
            square, share = self._squares(factors)
            # Each detection counts as much as the image's share is of its variance.
            part = np.array([share[side == s].sum() for s in (0, 1)])
            change = np.array([(share * square)[side == s].sum() for s in (0, 1)]) / part * count / freedom
            factors *= change
            if not (_FACTORS[0] < factors.min() and factors.max() < _FACTORS[1]):
                return None
            if np.abs(change - 1).max() < 1e-3:
                break
        left, right = (CameraNoise(*map(float, each)) for each in zip(factors, freedom * part / count, strict=True))
        return left, right

    def _motion_px(self) -> float:
        """Return how far the discs moved in the left image, px RMS about their mean."""
        ids, uv = (np.concatenate([getattr(s, name)[s.side == 0] for s in self._shots]) for name in ("ids", "uv"))
        return float(np.sqrt(np.mean([uv[ids == m].var(axis=0) for m in np.unique(ids)])))

    def _squares(self, factors: Array) -> tuple[Array, Array]:
        """Return each detection's squared residual over its variance, and the image's share in that (N,)."""
        columns = 3 * (len(self._points) - self._first)
        H, g = np.zeros((columns, columns)), np.zeros(columns)
        whitened, shares = [], []
        for shot in self._shots:
            image = factors[shot.side][:, None, None] * shot.cov
            W = np.linalg.inv(np.linalg.cholesky(image + self.rig.sigma_px**2 * np.eye(2)))
            D = np.zeros((len(shot.ids), 2, columns))
            for k, m in enumerate(shot.ids):
                D[k, :, 3 * m : 3 * m + 3] = W[k] @ shot.by_point[k]
            Q, _ = np.linalg.qr((W @ shot.by_pose).reshape(-1, 6))
            rows, r = D.reshape(-1, columns), (W @ shot.residual[..., None]).ravel()
            rows, r = rows - Q @ (Q.T @ rows), r - Q @ (Q.T @ r)
            H += rows.T @ rows
            g += rows.T @ r
            whitened.append((rows, r))
            shares.append(np.einsum("nij,njk,nik->n", W, image, W) / 2)
        offsets = np.linalg.lstsq(H, g, rcond=1e-9)[0]  # six of them are a pose
        left = np.concatenate([r - rows @ offsets for rows, r in whitened]).reshape(-1, 2)
        return (left**2).sum(axis=1), np.concatenate(shares)
