"""What two cameras saw of a body's discs, and how closely a detection must agree with the body to be one of its discs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armsight.data import Array, Discs, Ids, Record
from armsight.vision.expected import Expected
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.rig import StereoRig

#: An ellipse may be this much longer or shorter than the disc would look, beyond so many standard deviations of its rim.
SIZE_TOLERANCE, SIZE_SIGMAS = 0.15, 6.0
#: The same along any of its axes, where it is known how the disc is turned.
SHAPE_TOLERANCE = 0.25
#: What neither noise nor calibration explain: shutters that are not quite simultaneous, ink that ran, px; and a body that
#: is not made as drawn, as a share of its size. One standard deviation each.
UNMODELLED_PX, UNMODELLED_SHARE = 0.1, 2e-3


@dataclass(frozen=True, eq=False)
class DiscView(Record):
    """One shot of a body's discs, with what is asked of it again and again.

    Attributes:
        rig: the calibrated pair.
        target: the body's discs.
        discs: what the left and the right camera saw.
        cov_uv: per camera (N, 2, 2) covariance of the centres with all that adds to what the image tells, px^2.
        radius_px: per camera (N,) longer half axes; NaN, which fits nothing, where a disc was found a second time.
        slack_px: per camera (N,) how far noise alone may take a half axis.
        rig_root: (P, R) with rig_root @ rig_root.T the rig's covariance, without the directions that are exact.
        unmade_m: standard deviation of a disc's place on the body as it was made, m.
    """

    rig: StereoRig
    target: DiscTarget
    discs: tuple[Discs, Discs]
    cov_uv: tuple[Array, Array]
    radius_px: tuple[Array, Array]
    slack_px: tuple[Array, Array]
    rig_root: Array
    unmade_m: float

    @staticmethod
    def of(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> DiscView:
        """Gather one shot."""
        more = (rig.sigma_px**2 + UNMODELLED_PX**2) * np.eye(2)
        slack = (SIZE_SIGMAS * np.sqrt(np.trace(seen.cov_uv, axis1=1, axis2=2) / 2) for seen in (left, right))
        return DiscView(
            rig,
            target,
            (left, right),
            (left.cov_uv + more, right.cov_uv + more),
            (_radius_once(left), _radius_once(right)),
            (next(slack), next(slack)),
            _root(rig.cov),
            UNMODELLED_SHARE * float(np.linalg.norm(np.ptp(target.body.points, axis=0))),
        )

    def alike(self, m: int, side: int, radius_px: float) -> NDArray[np.bool_]:
        """(N,) whether detections of one camera have disc m's brightness and about a longer half axis of ``radius_px``."""
        seen, slack = self.radius_px[side], self.slack_px[side]
        size = (seen >= (1 - SIZE_TOLERANCE) * radius_px - slack) & (seen <= (1 + SIZE_TOLERANCE) * radius_px + slack)
        return np.asarray(size & (self.discs[side].bright == self.target.bright[m]))

    def congruent(self, expected: Expected, m: int, side: int) -> NDArray[np.bool_]:
        """(N,) whether detections of one camera are as large and as slim as disc m, and lie the same way."""
        alike = self.alike(m, side, float(expected.radius_px[m, side]))
        if np.isnan(expected.facing[m, side]):
            return alike
        a, b, c = expected.shape[m, side]
        det = a * c - b * b
        s11, s12, s22 = self.discs[side].shape[alike].T
        # Squares of how many times longer each ellipse is: the eigenvalues of S_expected^-1 S.
        mean, product = (c * s11 - 2 * b * s12 + a * s22) / (2 * det), (s11 * s22 - s12**2) / det
        half = np.sqrt(np.maximum(mean**2 - product, 0.0))
        slack = SHAPE_TOLERANCE + self.slack_px[side][alike] / np.sqrt(det / max(a, c))
        slim = (np.sqrt(np.maximum(mean - half, 0.0)) < 1 - slack) | (np.sqrt(mean + half) > 1 + slack)
        alike[np.flatnonzero(alike)[slim]] = False
        return alike

    def covariances(self, expected: Expected, m: Ids, side: int, rows: Ids) -> Array:
        """Return (K, 2, 2) covariance of detections ``rows`` as discs ``m``, px^2: noise, and how the body was made."""
        made = self.unmade_m * expected.radius_px[m, side] / self.target.radii_m[m]
        return np.asarray(
            self.cov_uv[side][rows] + made[:, None, None] ** 2 * np.eye(2) + expected.cov_bias[m, side], np.float64
        )


def _radius_once(discs: Discs) -> Array:
    """Return (N,) longer half axes, NaN where a disc as large lies within half of it: that is the same disc again."""
    radius = discs.radius_px
    if len(radius) < 2:
        return radius
    one, again = cKDTree(discs.uv).query_pairs(radius.max() / 2, output_type="ndarray").T
    near = np.linalg.norm(discs.uv[one] - discs.uv[again], axis=1) < radius[one] / 2
    same = near & (np.abs(radius[one] - radius[again]) < SIZE_TOLERANCE * radius[one])
    radius[again[same & (discs.bright[one] == discs.bright[again])]] = np.nan
    return radius


def _root(cov: Array) -> Array:
    """Return (P, R) with root @ root.T = cov, without the directions that are exact."""
    sigma = np.sqrt(np.diag(cov))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    keep = values > 1e-12
    return np.asarray(scale[:, None] * vectors[:, keep] * np.sqrt(values[keep]))
