"""One identification: identify, and validate on poses that were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.errors import CalibrationError, noted
from armsight.loop.identify.identify import ALIKE, Identified, Validation
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.selection import changed_from
from armsight.loop.identify.validate import check_other, identify_held_out
from armsight.robot.kinematics.arm import Arm

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
    range_noise_m: float | None = None  #: of the range it was identified by, as its table says, m; None: by poses


def run_identify(
    arm: Arm,
    measured: Measured,
    lines: Array,
    other: Measured | None,
    *,
    other_name: str = "the poses to validate with",
    priors: Mapping[str, float] | None = None,
    notes: tuple[str, ...] = (),
    range_noise_m: float | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> Identification:
    """Identify an arm and validate it on poses left out.

    ``measured``: joint angles, and measured poses of the tool. ``lines``: (N,) lines of the file that they come from.
    ``other``: poses to validate with; None: parts of ``measured`` are left out, one after the other. ``other_name``:
    what an error calls these: their file. ``priors``: as in :func:`identify`. CalibrationError: no pose can be left out.
    """
    if other is not None:
        other, said = check_other(arm, measured, other, other_name)
        notes = (*notes, *said)
    with noted(notes):
        found = identify_held_out(arm, measured, other=other, priors=priors, progress=progress)
    if (held_out := found.held_out) is None:
        raise CalibrationError(f"too few poses to leave a fifth of them out: {len(measured)}; take 10 and more")
    shown = _notes(arm, found, measured, lines)
    if held_out.scale > 1:
        shown.insert(
            0,
            f"residuals of poses left out are {held_out.scale:.2f} times as large as predicted: the arm does something "
            f"that the model does not know; all sigmas are made {held_out.scale:.2f} times as large",
        )
    return Identification(arm, measured, found, *held_out[:3], lines, (*shown, *notes), range_noise_m)


def _notes(arm: Arm, found: Identified, measured: Measured, lines: Array) -> list[str]:
    notes = list(found.lacks)
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
    if (change := found.change) is not None:
        notes.append(
            f"{changed_from(found.model, change, f'line {lines[change.row]:.0f}')}: identify from one of both parts, and "
            "give the other by --validate"
        )
    numbers, parameters = len(measured) * measured.size, len(found.model.nominal())
    if numbers < 3 * parameters:
        notes.append(
            f"{len(measured)} poses are {numbers} numbers for {parameters} parameters: only {found.solution.free.sum()} "
            "that the poses determine, and that lower the held-out error, were fitted; armsight identify plan chooses more"
        )
    return notes
