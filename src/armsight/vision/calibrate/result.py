"""The result of a calibration: the rig, the errors on held-out pairs, what was rejected, what is weak."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from armsight.data import Array, Body, Record
from armsight.errors import InputError
from armsight.plots import new_figure
from armsight.vision.calibrate.motion import CameraChange, ExposureMotion
from armsight.vision.markers.board import open_board
from armsight.vision.pose.bundle import BundleSolution, Observations
from armsight.vision.rig import StereoRig

LEAST_SIGMA_PX = 1e-6

#: Degree of the polynomials in which a printed board may differ from its drawing.
BOARD_DEGREE = 4


@dataclass(frozen=True)
class RejectedPair:
    """A pair that was not used, or not all of it, and why."""

    pair: str
    reason: str


@dataclass(frozen=True, eq=False)
class PairErrors(Record):
    """Errors of pairs that a rig was not fitted on."""

    pair: Array  #: (S,) rows of the pairs
    epipolar_px: Array  #: (S,) RMS distance from the epipolar lines, both images, undistorted px
    rigid_m: Array  #: (S,) RMS distance of the triangulated board from the perfect one after a rigid fit
    scale: Array  #: (S,) how many times larger than the perfect board the triangulated one is
    weight: Array  #: (S,) matched points of the pair
    normalised: Array  #: (S,) RMS of the rigid residual over its predicted sigma
    over_noise: Array  #: (S,) RMS of the rigid residual over the sigma that the corners' noise alone gives it


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on pairs left out of the fit, RMS over all their points."""

    folds: int  #: how many times the pairs were split
    epipolar_rms_px: float  #: distance from the epipolar line, undistorted px, both images
    rigid_rms_m: float  #: triangulated board against the perfect one, after a rigid fit, m
    scale_error: float  #: relative error of the triangulated board's size, mean over pairs; 0.001 is 0.1%
    normalised_rms: float  #: rigid residual over its predicted sigma; 1 where the uncertainty is honest
    #: rigid residual over the sigma that the corners' noise alone gives it, without calibration or motion
    over_noise_rms: float
    #: how far the board is expected to move along an axis between the exposures of a left-out pair, m; 0 where boards
    #: stand still
    motion_rms_m: float = 0.0
    motion_rms_rad: float = 0.0  #: by how much it is expected to rotate about an axis, rad


@dataclass(frozen=True, eq=False)
class Calibration(Record):
    """A calibrated rig with the estimates and errors of its calibration."""

    rig: StereoRig  #: the result
    body: Body  #: the board or body as estimated, aligned to its drawing
    deviation_m: float  #: RMS distance of the estimated body from its drawing, m; zero where it was held to it
    #: names of the pairs used, in the order of the observations' shots; images of one camera alone come last and have
    #: no name here
    pairs: tuple[str, ...]
    pairs_found: int  #: how many pairs were given
    observations: Observations  #: the detections that were fitted
    solution: BundleSolution  #: the adjusted state and residuals
    epipolar_rms_px: float  #: epipolar RMS of the fit, px
    held_out: HeldOutErrors  #: errors on held-out pairs
    errors: PairErrors  #: the same per pair
    models: dict[str, HeldOutErrors]  #: held-out errors of every distortion model that was tried
    rejected: tuple[RejectedPair, ...]  #: pairs rejected, and why
    notes: tuple[str, ...]  #: what was corrected or partly dropped, and why
    weaknesses: tuple[str, ...]  #: what is weak, and what to do about it
    #: how far the board moved between the two exposures of a pair; None where it stood still
    motion: ExposureMotion | None = None
    #: radius of the board's discs, m, given or as the images show it; None for other boards
    disc_radius_m: float | None = None
    recorded: bool = False  #: whether the pairs had times, so that the skew of the cameras was looked for
    change: CameraChange | None = None  #: how the cameras changed while the pairs were taken; None where they did not
    spread: float = 1.0  #: how many times as large sigmas are at most as corners of a pair are off together

    def __repr__(self) -> str:
        """Return the errors on pairs left out of the fit, px and mm."""
        errors, rig = self.held_out, self.rig
        return (
            f"Calibration({len(self.pairs)} of {self.pairs_found} pairs; held out {errors.epipolar_rms_px:.3f} px "
            f"epipolar, {1e3 * errors.rigid_rms_m:.3f} mm; {rig.left.model}, baseline {1e3 * rig.baseline_m:.3f} mm; "
            f"{len(self.weaknesses)} weaknesses)"
        )

    def plot(self) -> Any:  # noqa: ANN401 - matplotlib is no dependency
        """Draw the errors of every pair when it was left out of the fit, mm and px; return matplotlib's figure.

        Raises InputError: matplotlib is not installed.
        """
        figure, axes = new_figure(2, 1, sharex=True)
        axes[0].bar(self.errors.pair, 1e3 * self.errors.rigid_m)
        axes[1].bar(self.errors.pair, self.errors.epipolar_px)
        axes[0].set(ylabel="board's points, mm RMS", title="errors of pairs left out of the fit")
        axes[1].set(ylabel="epipolar, px RMS", xlabel="pair")
        return figure

    @property
    def drawing(self) -> Array | None:
        """(M, 3) the drawing of the calibration target, m; None where the calibration is from a body of markers."""
        with contextlib.suppress(InputError):
            points = open_board(self.body.name).body.points
            return points if points.shape == self.body.points.shape else None
        return None

    @property
    def reprojection_rms_px(self) -> float:
        """RMS distance of the fitted detections from their projections, px."""
        return float((self.solution.residuals_px**2).sum(axis=1).mean() ** 0.5)


def corner_variance_px2(calibration: Calibration) -> Array:
    """Return (2,) the variance of a typical corner in the left and the right image, px^2: its own and the rig's share."""
    observations, base = calibration.observations, max(calibration.rig.sigma_px, LEAST_SIGMA_PX) ** 2
    image = np.trace(observations.cov_uv, axis1=1, axis2=2) / 2
    sides = [image[observations.camera == side] for side in (0, 1)]
    return np.array([base + (float(np.median(values)) if len(values) else 0.0) for values in sides])
