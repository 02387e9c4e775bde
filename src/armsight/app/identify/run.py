"""One identification: identify, and validate on poses that were not fitted to.

In: the nominal arm and measured poses. Out: an :class:`Identification`, whose Report is ``report``'s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.loop.identify.identify import ALIKE, Identified, identify
from armsight.loop.identify.measured import Measured, visits
from armsight.loop.identify.misread import check_plausible, find_step, without_tool
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.validate import MIN_POSES, Errors, Validation, errors, require_alike, validate
from armsight.robot.kinematics.arm import Arm

#: Parts of the poses that are left out one after the other without others to validate with; with more than MANY, one.
FOLDS, MANY = 5, 500
#: Residuals of poses left out that chance makes so large with this probability only show that the sigmas are too small.
TOO_SMALL = 1e-3
#: Few poses to validate with that are further from the nominal arm than this, m, are not of it: no arm is so inaccurate.
FAR_M = 0.1
#: What is written.
FILES = ("corrected.toml", "corrected.urdf", "zeros.toml", "parameters.csv", "identify.json", "report.html")


@dataclass(frozen=True, eq=False)
class Identification(Record):
    """The result of an identification."""

    arm: Arm  #: the nominal arm
    measured: Measured  #: what it was identified from
    found: Identified  #: the identified arm
    held_out: Validation  #: nominal and identified arm on poses that were not fitted to
    held_out_poses: Array  #: (H, n) joint angles of those, rad
    how: str  #: which poses those are, as text
    lines: Array  #: (N,) lines of the file that the poses come from
    notes: tuple[str, ...]  #: what a person should know


def run_identify(
    arm: Arm,
    measured: Measured,
    lines: Array,
    other: Measured | None,
    *,
    other_name: str = "the poses to validate with",
    priors: Mapping[str, float] | None = None,
    notes: tuple[str, ...] = (),
    progress: Callable[[str], None] = lambda line: None,
) -> Identification:
    """Identify an arm and validate it on poses left out.

    ``measured``: joint angles, and measured poses of the tool. ``lines``: (N,) lines of the file that they come from.
    ``other``: poses to validate with; None: parts of ``measured`` are left out, one after the other. ``other_name``:
    what an error calls these: their file. ``priors``: as in :func:`identify`.
    """
    if other is not None:
        try:
            _check_other(arm, measured, other)
        except InputError as error:
            raise InputError(f"{other_name}: {error}") from None
    found = identify(arm, measured, priors=priors, progress=progress)
    if other is not None:
        held_out, poses = validate(found, other), other.q
        how = f"{len(other)} poses of another file"
        how += ", base and tool fitted anew" if held_out.placement_refitted else ""
    else:
        held_out, poses, how = _left_out(arm, measured.rows(found.solution.used), priors, progress)
        how += f", {len(found.left_out)} taken for mistakes apart" if len(found.left_out) else ""
    said = _notes(arm, found, measured, lines)
    over, numbers = held_out.residual_over_predicted, len(poses) * measured.size
    if over**2 > chdtri(numbers, TOO_SMALL) / numbers:
        found = replace(found, cov=over**2 * found.cov)
        said.insert(
            0,
            f"residuals of poses left out are {over:.2f} times as large as predicted: the arm does something that the "
            f"model does not know; all sigmas are made {over:.2f} times as large",
        )
    return Identification(arm, measured, found, held_out, poses, how, lines, (*said, *notes))


def _check_other(arm: Arm, measured: Measured, other: Measured) -> None:
    """Reject poses to validate with that cannot be of the arm, before anything is fitted.

    Fewer than MIN_POSES are evaluated in the set-up of ``measured``.
    """
    require_alike(other, measured.points, measured.R_rig_body is not None)
    if len(other) >= MIN_POSES:
        try:
            check_plausible(without_tool(arm), other)
        except InputError as error:
            raise InputError(f"the poses to validate with: {error}") from None
        return
    check_plausible(without_tool(arm), measured)  # or its placement means nothing
    model, x = with_placement(Model.of(without_tool(arm), measured, backlash=False).with_features(()), measured)
    off = float(np.median(errors(model, x, other).position_m))
    if off > FAR_M:
        raise InputError(
            f"the {len(other)} poses to validate with are {1e3 * off:.0f} mm from where the arm reaches at their angles: "
            f"other joints, or another set-up, for which {MIN_POSES} poses are needed"
        )


def _left_out(
    arm: Arm, measured: Measured, priors: Mapping[str, float] | None, progress: Callable[[str], None]
) -> tuple[Validation, Array, str]:
    """Identify without a part of the poses, and validate on it; with few poses once for every part."""
    which = visits(measured.q)
    shuffled = np.random.default_rng(0).permutation(int(which.max()) + 1)
    parts = [np.flatnonzero(np.isin(which, part)) for part in np.array_split(shuffled, min(FOLDS, len(shuffled)))]
    tried, done = parts if len(measured) <= MANY else parts[:1], []
    for i, part in enumerate(tried, 1):
        progress(f"error on poses left out, part {i} of {len(tried)}")
        try:
            others = measured.rows(np.setdiff1d(np.arange(len(which)), part))
            done.append(validate(identify(arm, others, priors=priors), measured.rows(part)))
        except (InputError, CalibrationError) as error:
            raise CalibrationError(f"too few poses to leave a fifth of them out: {error}") from None
    over = float(np.sqrt(np.mean([v.residual_over_predicted**2 for v in done])))
    nominal, identified = (
        Errors(*map(np.concatenate, zip(*each, strict=True)))
        for each in ([v.nominal for v in done], [v.identified for v in done])
    )
    rows, again = np.concatenate(tried), len(which) - len(shuffled)
    how = f"{len(rows)} poses left out" + (" in five rounds" if len(tried) > 1 else " of the fit")
    how += f", {again} of them visits of another's pose, with which they are left out" if again else ""
    return Validation(nominal, identified, False, over), measured.q[rows], how


def _notes(arm: Arm, found: Identified, measured: Measured, lines: Array) -> list[str]:
    """Return what a person should know about the data."""
    notes = []
    still = [str(i + 1) for i in np.flatnonzero(np.ptp(measured.q, axis=0) < ALIKE)]
    lost = [p.name for p, k in zip(found.model.parameters, found.solution.free, strict=True) if p.joint < 0 and not k]
    if still:
        notes.append(
            f"joint{'s' * (len(still) > 1)} {', '.join(still)} hardly moved: what is off there is not observable, and is "
            "kept at its nominal value; held-out errors hold for poses with the same angles there"
        )
    if lost:
        notes.append(f"not observable by these motions, and kept: {', '.join(lost)} (base and tool)")
    if len(found.left_out):
        shown = ", ".join(f"{lines[k]:.0f}" for k in found.left_out[:8]) + (", .." if len(found.left_out) > 8 else "")
        poses = f"{len(found.left_out)} pose{'s' if len(found.left_out) > 1 else ''}"
        notes.append(f"{poses} taken for mistakes and left out: line {shown}")
    if (step := find_step(without_tool(arm), measured)) is not None:
        notes.append(
            f"from line {lines[step.row]:.0f} on the poses seem to be of another state: {step.text} (off by "
            f"{1e3 * step.before:.1f} mm together, {1e3 * step.left:.1f} mm so); identify from one of both parts"
        )
    numbers, parameters = len(measured) * measured.size, len(found.model.nominal())
    if numbers < 3 * parameters:
        notes.append(
            f"{len(measured)} poses are {numbers} numbers for {parameters} parameters: only {found.solution.free.sum()} "
            "that the poses determine, and that lower the held-out error, were fitted; armsight identify plan chooses more"
        )
    return notes
