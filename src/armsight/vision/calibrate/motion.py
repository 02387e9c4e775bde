"""How far the board moves between the two exposures of a pair: a random effect, learned from the pairs themselves.

Cameras that are not synchronised see a board in the hand at two positions. Each pair has its own motion, small for most
and large for a few: normal with a variance of the pair's own, whose inverse is gamma distributed, which makes motions
of Student's t distribution (Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989).
Scale and weights are found by EM, with MacKay's step for the scale, which reaches zero where nothing moves. A pair that
moved far pulls less on the relative pose of the cameras, and none on what is inside them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.geometry.pose import transform
from armsight.geometry.rotation import skew
from armsight.vision.pose.bundle import BundleSolution

#: Degrees of freedom of the motions' distribution: four leave the variance finite, and let one pair move five times as
#: far as the rest.
TAIL = 4.0
#: A motion of one standard deviation at first, as a share of the board's diagonal, and the least it may be.
START_SHARE, _LEAST = 1e-3, 1e-8


@dataclass(frozen=True, eq=False)
class ExposureMotion(Record):
    """How boards move between the exposures: the motion's scale, and how each of S pairs departs from it."""

    #: (2,) scale of the translation of the board's middle along each axis, m, and of the rotation about each, rad
    scales: Array
    #: (S,) by how much each pair's variance is smaller than the scale's square: 1 usual, near 0 moved far
    weights: Array
    rms: Array  #: (2,) root mean square of both over all pairs, m and rad: the prediction for a new pair

    @staticmethod
    def guessed(points: Array, count: int) -> ExposureMotion:
        """Return the motion to begin with for a board of points (M, 3), m, in ``count`` pairs."""
        scales = START_SHARE * np.array([np.linalg.norm(np.ptp(points, axis=0)), 2.0])
        return ExposureMotion(scales, np.ones(count), scales)

    @property
    def rms_m(self) -> float:
        """Root mean square of the translation along an axis, m."""
        return float(self.rms[0])

    @property
    def sigmas(self) -> Array:
        """(S, 6) standard deviation of every pair's motion, as a model of bundle adjustment takes it."""
        return np.asarray(np.repeat(self.scales, 3) / np.sqrt(self.weights)[:, None])

    @property
    def variance(self) -> Array:
        """(6,) variance of a new pair's motion."""
        return np.repeat(self.rms**2, 3)

    def shots(self, rows: NDArray[np.intp]) -> ExposureMotion:
        """Return the motion of some of the pairs only."""
        return replace(self, weights=self.weights[rows])

    def scaled(self, factor: float) -> ExposureMotion:
        """Return the motion with every standard deviation multiplied."""
        return replace(self, scales=factor * self.scales, rms=factor * self.rms)

    def seen_from(self, T_camera_board: Array, middle: Array) -> Array:
        """Return the (6, 6) covariance of a new pair's motion as a tangent [translation; rotation] in a camera's frame.

        Args:
            T_camera_board: (4, 4) pose of the board.
            middle: (3,) middle of the board in its own frame, m.
        """
        R, centre = T_camera_board[:3, :3], transform(T_camera_board, middle)
        A = np.block([[R, skew(centre) @ R], [np.zeros((3, 3)), R]])
        return np.asarray(A * self.variance @ A.T)

    def updated(self, solution: BundleSolution) -> tuple[ExposureMotion, float]:
        """Learn from an adjustment under this motion: the better motion, and how many freedoms the pairs' motions took."""
        estimate, unsure = solution.state.motions**2, np.diagonal(solution.cov_motions, axis1=1, axis2=2)
        q = ((estimate + unsure) / np.repeat(self.scales, 3) ** 2).sum(axis=1)
        weights = (TAIL + 6) / (TAIL + q)
        freed = 3 * len(q) - (unsure / self.sigmas**2).reshape(-1, 2, 3).sum(axis=(0, 2))
        moved = (weights[:, None, None] * estimate.reshape(-1, 2, 3)).sum(axis=(0, 2))
        scales = np.maximum(np.sqrt(moved / np.maximum(freed, 1e-3)), _LEAST)
        rms = np.sqrt((estimate + unsure).reshape(-1, 2, 3).mean(axis=(0, 2)))
        return ExposureMotion(scales, weights, rms), float(freed.sum())
