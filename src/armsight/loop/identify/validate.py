"""Validation: the error of the predicted tool pose on poses that the arm was not fitted to.

Where the poses were taken in another set-up (the tracker moved, another target), base and tool are fitted again, for the
nominal arm as for the identified one, and ``placement_refitted`` says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError, require
from armsight.estimate.solve import covariances
from armsight.loop.identify.fit import fit, linear_of, variances_of, with_joint_noise
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.measured import Measured, Read, measured_of
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.selection import PLACEMENT

OTHER = 5.0  # another set-up: the error is this many times that with base and tool fitted again,
OTHER_M = 0.02  # and this far, m: no arm moves so far by itself between two recordings of one set-up
MIN_POSES = 10  # poses needed to fit base and tool again


class Errors(NamedTuple):
    """Distances between the predicted and the measured tool."""

    position_m: Array  #: (N, K) of every point
    angle_rad: Array  #: (N,) of the body's rotation; empty with points only

    def summary(self) -> dict[str, float]:
        """Return mean_m, rms_m and max_m, and of full poses also mean_rad, rms_rad and max_rad."""
        out: dict[str, float] = {}
        for name, e in (("m", self.position_m), ("rad", self.angle_rad)):
            if e.size:
                out |= {f"mean_{name}": float(e.mean()), f"rms_{name}": float(np.sqrt(np.mean(e**2)))}
                out[f"max_{name}"] = float(e.max())
        return out


class Validation(NamedTuple):
    """Nominal and identified arm on one set of poses."""

    nominal: Errors  #: errors of the nominal arm, its base and tool fitted to the same poses as the identified one's
    identified: Errors  #: errors of the identified arm
    placement_refitted: bool  #: whether base and tool were fitted to these very poses
    residual_over_predicted: float  #: RMS residual over the predicted sigma; 1 where the sigmas are honest

    def __repr__(self) -> str:
        """Return the mean errors of both arms, mm, and whether the sigmas are honest."""
        mean, nominal = (1e3 * float(each.position_m.mean()) for each in (self.identified, self.nominal))
        return (
            f"Validation({len(self.identified.position_m)} poses: {mean:.3f} mm mean, nominal arm {nominal:.3f} mm; "
            f"residual over sigma {self.residual_over_predicted:.2f})"
        )


def errors(model: Model, x: Array, measured: Measured) -> Errors:
    """Return the errors of a parameter vector on poses."""
    e = model.residuals(x, measured, model.feature_values(measured.q, measured.approach))
    if measured.R_rig_body is None:
        return Errors(np.linalg.norm(e.reshape(len(e), -1, 3), axis=2), np.zeros(0))
    return Errors(np.linalg.norm(e[:, None, :3], axis=2), np.linalg.norm(e[:, 3:], axis=1))


def validate(found: Identified, measured: Measured | Read) -> Validation:
    """Evaluate an identified arm on poses that it was not fitted to.

    Args:
        found: the identified arm.
        measured: other poses, as ``read_poses`` returns them; points or full poses as it was identified with.

    Raises:
        InputError: another number of points, or points instead of poses.
    """
    call = "validate(identified, poses)"
    require(call, "identified", found, isinstance(found, Identified), "what identify(arm, poses) returns")
    measured = measured_of(call, measured)
    require_alike(measured, found.model.points, found.model.full)

    def of(model: Model, nominal: Array, x: Array, refitted: bool) -> Validation:
        both = errors(model, nominal, measured), errors(model, x, measured)
        return Validation(*both, refitted, _over(model, found, x, measured))

    kept = of(found.model, found.nominal, found.solution.x, False)
    kept_m = float(np.median(kept.identified.position_m))
    if len(measured) < MIN_POSES or kept_m < OTHER_M:
        return kept
    new = of(*placement_refitted(found, measured), True)
    return kept if kept_m < OTHER * float(np.median(new.identified.position_m)) else new


def require_alike(measured: Measured, points: int, full: bool) -> None:
    """Reject poses with another number of points, or points instead of poses (InputError)."""
    have, need = (
        "full poses" if f else f"{p} tracked point{'s' if p > 1 else ''} a pose"
        for p, f in ((measured.points, measured.R_rig_body is not None), (points, full))
    )
    if have != need:
        raise InputError(f"the poses to validate with have {have}; those identified with have {need}")


def placement_refitted(found: Identified, measured: Measured) -> tuple[Model, Array, Array]:
    """Return the model, the nominal and the identified vector with base and tool fitted to other poses."""
    model, start = with_placement(found.model, measured)
    placement = np.array([p.kind in PLACEMENT for p in model.parameters]) & found.solution.free
    out = []
    for x in (found.nominal, found.solution.x):
        out.append(fit(model, np.where(placement, start, x), measured, placement, found.prior).x)
    return model, out[0], out[1]


def _over(model: Model, found: Identified, x: Array, measured: Measured) -> float:
    """Return the RMS of residuals over their predicted sigma: noise and the parameters' covariance."""
    weighted, free = with_joint_noise(model, x, measured, found.joint_sigma_rad), found.solution.free
    phi = model.feature_values(measured.q, measured.approach)
    linear = linear_of(model, x, weighted, phi, free, found.prior)
    by_fit = linear.J @ found.solution.cov[np.ix_(free, free)] @ linear.J.swapaxes(1, 2)
    C = covariances(linear, variances_of(linear, found.solution.noise)) + by_fit
    squares = np.einsum("ni,nij,nj->", linear.e, np.linalg.inv(C), linear.e)
    return float(np.sqrt(squares / linear.e.size))
