"""Validation: the error of the predicted tool pose on poses that the arm was not fitted to, and what it makes of sigmas.

Where the poses were taken in another set-up (the tracker moved, another target), base and tool are fitted again, for the
nominal arm as for the identified one, and ``placement_refitted`` says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from armsight.data import Array
from armsight.errors import CalibrationError, InputError, noted, require
from armsight.estimate.change import matters
from armsight.estimate.solve import covariances
from armsight.loop.handeye.poses import HeldOut
from armsight.loop.identify.fit import fit, linear_of, variances_of, with_joint_noise
from armsight.loop.identify.identify import Identified, LeftOut, Validation, identify
from armsight.loop.identify.measured import Measured, Read, measured_of, visits
from armsight.loop.identify.misread import check_plausible, without_tool
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.selection import PLACEMENT, change_at, changed_from, lacking
from armsight.robot.kinematics.arm import Arm

OTHER = 5.0  # another set-up: the error is this many times that with base and tool fitted again,
OTHER_M = 0.02  # and this far, m: no arm moves so far by itself between two recordings of one set-up
SAME = 2e-6  # of joints, rad, and points, m: the same measurement; half: rounded copies pass, double: nothing
MIN_POSES = 10  # poses needed to fit base and tool again
#: Parts of the poses that are left out one after the other without others to validate with; with more than MANY, one.
FOLDS, MANY = 5, 500
#: Residuals of poses left out that chance makes so large with this probability only show that the sigmas are too small.
TOO_SMALL = 1e-3
#: Few poses to validate with that are further from the nominal arm than this, m, are not of it: no arm is so inaccurate.
FAR_M = 0.1


def errors(model: Model, x: Array, measured: Measured) -> HeldOut:
    """Return the errors of a parameter vector on poses."""
    e = model.residuals(x, measured)
    if measured.length_m is not None:
        return HeldOut(np.abs(e), np.zeros(0))
    if measured.R_rig_body is None:
        return HeldOut(np.linalg.norm(e.reshape(len(e), -1, 3), axis=2), np.zeros(0))
    return HeldOut(np.linalg.norm(e[:, None, :3], axis=2), np.linalg.norm(e[:, 3:], axis=1))


def validate(found: Identified, measured: Measured | Read) -> Validation:
    """Evaluate an identified arm on poses that it was not fitted to.

    Args:
        found: the identified arm.
        measured: other poses, as ``read_poses`` returns them; points or full poses as it was identified with.

    Returns:
        How far the nominal and the identified arm are off at these poses, m and rad. Where the poses are of another setup,
        base and tool are fitted to them first, for both, and it says so.

    Raises:
        InputError: another number of points, or points instead of poses.
    """
    call = "validate(found, measured)"
    require(call, "found", found, isinstance(found, Identified), "what identify(arm, measured) returns")
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
    nominal, identified = (
        fit(model, np.where(placement, start, x), measured, placement, found.prior).x
        for x in (found.nominal, found.solution.x)
    )
    return model, nominal, identified


def _over(model: Model, found: Identified, x: Array, measured: Measured) -> float:
    """Return the RMS of residuals over their predicted sigma: noise and the parameters' covariance."""
    weighted = with_joint_noise(model, x, measured, found.joint_sigma_rad)
    linear = linear_of(model, x, weighted, np.ones(len(x), bool), found.prior)
    by_fit = replace(found, model=model, solution=replace(found.solution, x=x)).pose_cov(measured)
    C = covariances(linear, variances_of(linear, found.solution.noise)) + by_fit
    squares = np.einsum("ni,nij,nj->", linear.e, np.linalg.inv(C), linear.e)
    return float(np.sqrt(squares / linear.e.size))


def identify_held_out(
    arm: Arm,
    measured: Measured | Read,
    *,
    other: Measured | Read | None = None,
    priors: Mapping[str, float] | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Identified:
    """Identify an arm from poses, as ``armsight identify`` does: fifths of them are left out, to know how good it is.

    Args:
        arm: the nominal arm; where base and tool are is found from the data.
        measured: joint angles, and where the tool was measured, as ``read_poses`` returns them.
        other: poses to validate with, instead of those left out.
        priors: sigma, m or rad, by name of a parameter ("a2") or a kind ("alpha"), where it is not 10 mm of a length, 2
            or 3 degrees of an angle; 0 keeps one at its nominal value.
        progress: called with the name of each step as it begins.

    Returns:
        Every number with its sigma, as large as the residuals of the poses left out show it to be (``held_out``; with
        6 or 7 poses, of which none can be left out, that is None, the sigmas are the fit's own, and ``notes`` say so):
        ``columns()`` is a table for pandas, ``validate`` says how far off it is on more poses, ``Corrected.of`` makes an
        arm of it that computes and is saved.

    Raises:
        InputError: fewer than 6 poses, or data that cannot be of this arm; the message says what would make them fit.
        CalibrationError: poses so alike that not even base and tool are observable.
    """
    call = "identify(arm, measured)"
    require(call, "arm", arm, isinstance(arm, Arm), 'open_arm("ur10")')
    notes, measured = measured.notes if isinstance(measured, Read) else (), measured_of(call, measured)
    if other is not None:
        other, said = check_other(arm, measured, measured_of(call, other, "other"), "other")
        notes = (*notes, *said)
    with noted(notes):
        found = identify(arm, measured, priors=priors, progress=progress)
    if other is None:
        try:
            held_out = _left_out(arm, measured.rows(found.solution.used), priors, progress)
        except (InputError, CalibrationError) as error:  # the whole was identified: its parts are too small
            why = f"no pose was left out, and the sigmas are the fit's own, not scaled: {error}"
            return with_change_allowed(
                replace(found, notes=(*found.notes, f"{why}, without a fifth of {len(measured)}")), measured
            )
        apart = f", {len(found.left_out)} taken for mistakes apart" if len(found.left_out) else ""
    else:
        found = replace(found, notes=(*found.notes, *said))
        held_out = LeftOut(validate(found, other), other.q, f"{len(other)} poses of another file")
        apart = ", base and tool fitted anew" if held_out.validation.placement_refitted else ""
    over, numbers = held_out.validation.residual_over_predicted, len(held_out.q) * measured.size
    scale = over if over**2 > chdtri(numbers, TOO_SMALL) / numbers else 1.0
    held_out = held_out._replace(how=held_out.how + apart, scale=scale)
    return with_change_allowed(replace(found, cov=scale**2 * found.cov, held_out=held_out), measured)


def with_change_allowed(found: Identified, measured: Measured) -> Identified:
    """Return an identified arm whose covariance allows for a change of state among its poses, which it names."""
    free = np.diag(found.cov_everything) > 0
    weighted = with_joint_noise(found.model, found.solution.x, measured, found.joint_sigma_rad)
    fit_to = found.model, found.solution.x, weighted, free, found.prior, found.solution.noise
    change, lacks = change_at(*fit_to), () if measured.length_m is not None else lacking(*fit_to)
    found = replace(found, lacks=lacks, notes=(*found.notes, *lacks)) if lacks else found
    if change is None or not matters(change, found.cov):
        return found
    note = changed_from(found.model, change, f"pose {change.row}")
    return replace(found, cov=found.cov + change.off.T @ change.off, change=change, notes=(*found.notes, note))


def check_other(arm: Arm, measured: Measured, other: Measured, name: str) -> tuple[Measured, tuple[str, ...]]:
    """Return poses to validate with, without those of ``measured``, and a note of these; ``name`` is their file.

    InputError: none is left, or they cannot be of the arm.
    """
    arm, where, given, notes = without_tool(arm), f"{name}: ", len(other), tuple[str, ...]()
    try:
        require_alike(other, measured.points, measured.R_rig_body is not None)
        if other.q.shape == (given, measured.q.shape[1]):
            of = [m.p_rig if m.length_m is None else m.length_m for m in (measured, other)]
            fitted, at = (
                np.column_stack([m.q, p.reshape(len(p), -1)]) for m, p in zip((measured, other), of, strict=True)
            )
            other = other.rows(np.flatnonzero(cKDTree(fitted).query(at)[0] > SAME))
        if not len(other):
            raise InputError("all poses are among those to identify from: give others, or leave out --validate")
        if len(other) < given:
            notes = (f"{where}{given - len(other)} of {given} poses are among those to identify from: left out",)
        if len(other) >= MIN_POSES:
            where += "the poses to validate with: "
            check_plausible(arm, other)
            return other, notes
        check_plausible(arm, measured)  # or its placement means nothing
    except InputError as error:
        raise InputError(f"{where}{error}") from None
    model, x = with_placement(Model.of(arm, measured, backlash=False).with_features(()), measured)
    off = float(np.median(errors(model, x, other).position_m))
    if off > FAR_M:
        raise InputError(
            f"{name}: the {len(other)} poses to validate with are {1e3 * off:.0f} mm from where the arm reaches at their "
            f"angles: other joints, or another set-up, for which {MIN_POSES} poses are needed"
        )
    return other, notes


def _left_out(
    arm: Arm, measured: Measured, priors: Mapping[str, float] | None, progress: Callable[[str], None]
) -> LeftOut:
    """Identify without a part of the poses, and validate on it; with few poses once for every part.

    InputError, CalibrationError: the other poses are too few or too alike.
    """
    which = visits(measured.q)
    shuffled = np.random.default_rng(0).permutation(int(which.max()) + 1)
    parts = [np.flatnonzero(np.isin(which, part)) for part in np.array_split(shuffled, min(FOLDS, len(shuffled)))]
    tried, done = parts if len(measured) <= MANY else parts[:1], []
    for i, part in enumerate(tried, 1):
        progress(f"error on poses left out, part {i} of {len(tried)}")
        others = measured.rows(np.setdiff1d(np.arange(len(which)), part))
        done.append(validate(identify(arm, others, priors=priors), measured.rows(part)))
    over = float(np.sqrt(np.mean([v.residual_over_predicted**2 for v in done])))
    nominal, identified = (
        HeldOut(*map(np.concatenate, zip(*each, strict=True)))
        for each in ([v.nominal for v in done], [v.identified for v in done])
    )
    rows, again = np.concatenate(tried), len(which) - len(shuffled)
    how = f"{len(rows)} poses left out" + (f" in {len(tried)} rounds" if len(tried) > 1 else " of the fit")
    how += f", {again} of them visits of another's pose, with which they are left out" if again else ""
    return LeftOut(Validation(nominal, identified, False, over), measured.q[rows], how)
