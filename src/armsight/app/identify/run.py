"""One identification: identify, validate on poses that were not fitted to, write the files, print the result.

In: the nominal arm and measured poses. Out: an :class:`Identification`; the corrected arm as TOML and URDF, zeros,
parameters and JSON; text in mm and degrees, the held-out errors first.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from armsight.app.handeye.recording import matched_rows
from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.files import check_writable
from armsight.loop.identify.diagnose import check_plausible, find_step, without_tool
from armsight.loop.identify.identify import ALIKE, Identified, identify
from armsight.loop.identify.measured import Measured, visits
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.read import COLUMNS, Read, poses_in, read_poses
from armsight.loop.identify.validate import MIN_POSES, Errors, Validation, errors, require_alike, validate
from armsight.robot.kinematics.arm import Arm
from armsight.tables.cells import Cells, read_cells, read_columns
from armsight.tables.columns import NAMES
from armsight.tables.number import number
from armsight.tables.poses import PoseTable, read_pose_table

#: Parts of the poses that are left out, one after the other, where nothing is given to validate with.
FOLDS = 5
#: With more poses than this, one part is enough.
MANY = 500
#: Residuals of poses left out that chance makes so large with this probability only show that the sigmas are too small.
TOO_SMALL = 1e-3
#: Few poses to validate with that are further from the nominal arm than this, m, are not of it: no arm is so inaccurate.
FAR_M = 0.1
#: Joined by time, a shot counts where no joint reads further from its angle than this, rad, so long before and after, s: an
#: offset of the clocks would be taken for an error of a moving arm.
REST_RAD, REST_S = 3e-3, 0.2
#: What is written beside the report.
FILES = ("corrected.toml", "corrected.urdf", "zeros.toml", "parameters.csv", "identify.json")


@dataclass(frozen=True, eq=False)
class Identification(Record):
    """The result of an identification.

    Attributes:
        arm: the nominal arm.
        measured: what it was identified from.
        found: the identified arm.
        held_out: nominal and identified arm on poses that were not fitted to.
        held_out_poses: (H, n) joint angles of those, rad.
        how: which poses those are, as text.
        lines: (N,) lines of the file that the poses come from.
        notes: what a person should know.
    """

    arm: Arm
    measured: Measured
    found: Identified
    held_out: Validation
    held_out_poses: Array
    how: str
    lines: Array
    notes: tuple[str, ...]


def read_measured(
    data: Path, arm: Arm, joints: Path | None = None, *, rotation: str | None = None, columns: str | None = None
) -> Read:
    """Read measured poses with their joint angles, of one file or of two.

    Args:
        data: the poses; with their joint angles if ``joints`` is None.
        arm: whose joints they are.
        joints: a table of joint angles, joined to the poses by the names of their rows (``image``, ``name``, ``shot``), by
            order where there are none, or by time (``t_s``) where the tables have other numbers of rows.
        rotation: as in :func:`read_poses`.
        columns: as in :func:`read_poses`; joints, times and names may be those of ``joints``.

    Raises:
        InputError: either file, or they do not fit together.
    """
    if joints is None:
        return read_poses(data, rotation=rotation, columns=columns, arm=arm)
    parts = [] if columns is None else columns.split(",")
    theirs = [part for part in parts if re.match(r"\s*(?:q\d+_|image|name|shot)", part)]
    table = read_pose_table(joints, columns=",".join(theirs) or None, arm=arm, only_joints=True)
    ours = ",".join(part for part in parts if part not in theirs) or None
    cells, notes = _with_joints(data, read_cells(data, read_columns(ours, COLUMNS), "seen"), table)
    read = poses_in(data, cells, rotation=rotation)
    return read._replace(notes=(*table.notes, *notes, *read.notes))


def _with_joints(data: Path, read: Cells, table: PoseTable) -> tuple[Cells, list[str]]:
    """Return a table's cells with the joint angles of each row, without those that have none or no pose, and notes."""
    assert table.q is not None
    head, rows = read.head, [(line, row) for line, row in read.rows if any(row)]
    if own := next((name for name in head if re.fullmatch(r"q\d+_(rad|deg)", name)), None):
        raise InputError(f"{data}: line 1: has joint angles of its own ({own}): leave them out, or --joints")
    angles, notes = _angles(data, head, rows, table)
    missed = {line for line, row in rows if "status" in head and row[head.index("status")] == "missed"}
    if missed:
        notes.append(f"{len(missed)} of {len(rows)} shots were missed, and are left out")
    joined = [
        (line, [*row, *map(repr, angles[line].tolist())]) for line, row in rows if line in angles and line not in missed
    ]
    return read._replace(head=[*head, *(f"q{k}_rad" for k in range(1, table.q.shape[1] + 1))], rows=joined), notes


def _angles(
    data: Path, head: list[str], rows: list[tuple[int, list[str]]], table: PoseTable
) -> tuple[dict[int, Array], list[str]]:
    """Return the joint angles of a table by the lines of the data, paired by time, name or order; and notes."""
    assert table.q is not None
    lines = [line for line, _ in rows]
    if table.names is None and len(table.q) != len(rows) and table.t_s is not None and "t_s" in head:
        return _at_rest(data, [row[head.index("t_s")] for _, row in rows], lines, table)
    key = next((name for name in NAMES if name in head), None)
    if table.names is not None and key is None:
        raise InputError(
            f"{data}: line 1: no column {', '.join(NAMES)}, by which {table.path} names its rows; there are "
            f"{', '.join(head)}"
        )
    names = [f"line {line}" if key is None else row[head.index(key)] for line, row in rows]
    at, among = matched_rows(table, names)
    angles = {lines[i]: table.q[row] for row, i in zip(at, among, strict=True)}
    alone = len(rows) - len(angles)
    return angles, [f"{alone} of {len(rows)} poses have no row in {table.path}, and are left out"] if alone else []


def _at_rest(data: Path, times: list[str], lines: list[int], table: PoseTable) -> tuple[dict[int, Array], list[str]]:
    """Return the joint angles (J,), rad, at the middle shot of each rest, by its line, and notes."""
    assert table.t_s is not None
    assert table.q is not None
    order = np.argsort(table.t_s, kind="stable")
    t_s, q = table.t_s[order], table.q[order]
    rests: list[list[tuple[int, Array]]] = []
    inside = 0
    for line, cell in zip(lines, times, strict=True):
        at = number(cell)
        if at is None:
            raise InputError(f"{data}: line {line}: t_s is {cell!r}, must be a number, s")
        if not t_s[0] <= at <= t_s[-1]:
            continue
        inside += 1
        near = q[max(np.searchsorted(t_s, at - REST_S) - 1, 0) : np.searchsorted(t_s, at + REST_S, side="right") + 1]
        here = np.array([np.interp(at, t_s, column) for column in q.T])
        if np.abs(near - here).max() > REST_RAD:
            continue
        if rests and np.abs(rests[-1][0][1] - here).max() <= REST_RAD:
            rests[-1].append((line, here))
        else:
            rests.append([(line, here)])
    if not inside:
        raise InputError(
            f"{data}: no time t_s is within those of {table.path}, {t_s[0]:.1f} to {t_s[-1]:.1f} s: other clocks? name the "
            f"rows of both tables instead ({', '.join(NAMES)})"
        )
    if not rests:
        raise InputError(
            f"{data}: the arm never rests at a shot, by {table.path}: let it rest {2 * REST_S:g} s and more at each pose"
        )
    notes = [f"{len(rests)} rests of the arm, by {table.path}; of each the middle shot counts, of {len(times)} shots"]
    return dict(rest[len(rest) // 2] for rest in rests), notes


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

    Args:
        arm: the nominal arm.
        measured: joint angles, and measured poses of the tool.
        lines: (N,) lines of the file that they come from.
        other: poses to validate with; None: parts of ``measured`` are left out, one after the other.
        other_name: what an error calls these: their file.
        priors: as in :func:`identify`.
        notes: of the reading.
        progress: called with each step as text.

    Raises:
        InputError: either file's poses cannot be of this arm, or are too few.
        CalibrationError: the poses are too alike.
    """
    if other is not None:
        try:
            check_other(arm, measured, other)
        except InputError as error:
            raise InputError(f"{other_name}: {error}") from None
    found = identify(arm, measured, priors=priors, progress=progress)
    if other is not None:
        held_out = validate(found, other)
        how = f"{len(other)} poses of another file" + (
            ", base and tool fitted anew" if held_out.placement_refitted else ""
        )
        poses = other.q
    else:
        held_out, poses, how = _left_out(arm, measured.rows(found.solution.used), priors, progress)
        how += f", {len(found.left_out)} taken for mistakes apart" if len(found.left_out) else ""
    said = _notes(arm, found, measured, lines)
    over, numbers = held_out.residual_over_predicted, len(poses) * measured.size
    if over**2 > chdtri(numbers, TOO_SMALL) / numbers:
        found = replace(found, cov=over**2 * found.cov)
        said = (
            f"residuals of poses left out are {over:.2f} times as large as predicted: the arm does something that the "
            f"model does not know; all sigmas are made {over:.2f} times as large",
            *said,
        )
    return Identification(arm, measured, found, held_out, poses, how, lines, (*said, *notes))


def check_other(arm: Arm, measured: Measured, other: Measured) -> None:
    """Reject poses to validate with that cannot be of the arm, before anything is fitted.

    Args:
        arm: the nominal arm.
        measured: what it will be identified from.
        other: the poses to validate with. Fewer than MIN_POSES are evaluated in the set-up of ``measured``.

    Raises:
        InputError: other points, or joint angles that do not fit; the message says what would make them fit.
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
    tried = parts if len(measured) <= MANY else parts[:1]
    done, rows = [], []
    for i, part in enumerate(tried):
        progress(f"error on poses left out, part {i + 1} of {len(tried)}")
        try:
            others = measured.rows(np.setdiff1d(np.arange(len(which)), part))
            done.append(validate(identify(arm, others, priors=priors), measured.rows(part)))
        except (InputError, CalibrationError) as error:
            raise CalibrationError(f"too few poses to leave a fifth of them out: {error}") from None
        rows.append(part)
    over = float(np.sqrt(np.mean([v.residual_over_predicted**2 for v in done])))
    joined = Validation(_joined([v.nominal for v in done]), _joined([v.identified for v in done]), False, over)
    how = f"{sum(map(len, rows))} poses left out" + (" in five rounds" if len(tried) > 1 else " of the fit")
    again = len(which) - len(shuffled)
    how += f", {again} of them visits of another's pose, with which they are left out" if again else ""
    return joined, measured.q[np.concatenate(rows)], how


def _joined(errors: list[Errors]) -> Errors:
    return Errors(*(np.concatenate(parts) for parts in zip(*errors, strict=True)))


def _notes(arm: Arm, found: Identified, measured: Measured, lines: Array) -> tuple[str, ...]:
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
    step = find_step(without_tool(arm), measured)
    if step is not None:
        notes.append(
            f"from line {lines[step.row]:.0f} on the poses seem to be of another state: {step.text} (off by "
            f"{1e3 * step.before:.1f} mm together, {1e3 * step.left:.1f} mm so); identify from one of both parts"
        )
    numbers = len(measured) * measured.size
    free = int(found.solution.free.sum())
    if numbers < 3 * len(found.model.nominal()):
        notes.append(
            f"{len(measured)} poses are {numbers} numbers for {len(found.model.nominal())} parameters: only {free} that "
            "the poses determine, and that lower the held-out error, were fitted; `armsight identify plan` chooses more"
        )
    return tuple(notes)


@contextmanager
def results_in(out: Path, apart_from: tuple[Path | None, ...]) -> Iterator[None]:
    """Make the folder of the results before long work; where that fails, no folder made for it stays behind.

    Raises:
        InputError: it cannot be made or written to, or a result would replace what is read.
    """
    made: list[Path] = []
    try:
        _make(out, made)
        for name in (*FILES, "report.html"):
            check_writable(out / name, apart_from=apart_from)
        yield
    except BaseException:  # an interrupt, too, must not leave an empty folder
        for folder in reversed(made):
            with suppress(OSError):  # one that holds something stays
                folder.rmdir()
        raise


def _make(out: Path, made: list[Path]) -> None:
    """Make a folder from the top down, and note each as it is made, so that those before one that fails are known."""
    try:
        for folder in (*reversed(out.parents), out):
            if not folder.is_dir():
                folder.mkdir(exist_ok=True)
                made.append(folder)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from None
