"""Identify an arm by one draw-wire: from a fixed anchor, whose position nobody measured, to a point of the tool.

In: joint angles and lengths, and the tool's position as the controller computes it, where the file has it. Out: the
identified arm with anchor and tool point, and which rows are blunders, with what is wrong about them.

A controller prints joints to a tenth of a degree and computes its own position from unrounded ones. The position says most
of what the rounding took away. How large that is, in whatever unit or encoder's steps, is estimated as one variance from
how far positions are from joints; a row that is further off contradicts itself.

A wire hooks or slips and reads too long for many rows in a row, and a file loses the sign of a joint for a whole block: a
tenth of the rows and more, that agree with each other. Least squares fits them. So the search for blunders begins at the
least trimmed squares (Rousseeuw and Van Driessen, Data Mining and Knowledge Discovery 12, 2006) of the table of the arm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.estimate.chance import chi_square_limit
from armsight.files import columns_unused
from armsight.loop.identify.fit import Mask, by_joints, fit, prior_sigma
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.misread import TRIMS, without_tool
from armsight.loop.identify.model import Model
from armsight.loop.identify.observable import observed
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.read import read_poses
from armsight.loop.references.distance import Distance
from armsight.loop.references.file import read_lengths, read_references
from armsight.robot.kinematics.arm import Arm
from armsight.tables.cells import Renames
from armsight.tables.lengths import REACH
from armsight.tables.poses import read_pose_table

SHARE = 0.75  # of the rows; the least trimmed squares fit these; half: fewer than are needed, double: blunders pull
#: Blocks of rows, and random halves of them that the search begins at: blunders come in runs; half: some are missed.
BLOCKS, STARTS = 12, 16
BEGIN_M = 1e-3  # m; noise of a wire to begin at; half, double: nothing
CHANCE = 1e-4  # of a good row beyond the limit; half, double: one row in ten thousand
AGREE = 1e-6  # chance of a joint's sign that is found by mistake; half, double: nothing
REST_S = 0.25  # s; so long about a row's time the arm rests; half: noise, double: arms that go on early pull
#: Of a range's noise; at a rest half of the ranges are nearer to their median; half: noise, double: slow motion.
MOVES = 3.0
#: What rounding hides at least, rad and m, as positions are computed in single precision; half, double: nothing.
LEAST_ROUNDED = 1e-7
#: Of a step: most parts of the smallest gap between readings, fewest gaps, and how far from its multiples these may be;
#: half and double: fewer coarse encoders are found, or chance finds a step in few readings.
PARTS, GAPS, OFF_STEP = 32, 12, 0.15
MOST_ROUNDED = 5.1e-3  # rad; sigma of whole degrees; half: these are taken for another arm's, double: nothing
#: Positions may be off by so much, m, in a way that a table of the arm explains, and by this share of the variance beside;
#: half, double: another table or a controller's tool is found where it hardly matters, or passes where it does.
SYSTEMATIC_M, RANDOM = 1e-4, 0.25
JOIN = 3  # rows; blunders so near each other are one run; half: more lines for the same slip


class Blunder(NamedTuple):
    """Rows that are left out."""

    rows: NDArray[np.int64]  #: from 0
    text: str  #: what is wrong about them


def unrounded(arm: Arm, q: Array, p_base: Array, sigma_m: float) -> tuple[Array, Mask]:
    """Return joints (N, n) without rounding, rad, and which rows agree with the controller's position.

    ``arm``: as the controller has it: the nominal arm. ``q``: (N, n) rounded, rad. ``p_base``: (N, 3) the tool's origin
    as the controller computes it, m. ``sigma_m``: of the position's rounding.

    Raises:
        InputError: the positions are those of another table of the arm, or of a tool.
    """
    model = Model(without_tool(arm), 1, False, ())
    measured = Measured(q, p_base[:, None])
    e, J = model.linearised(model.nominal(), measured)
    B = _by_readings(model, J)

    def weighed(sigma_rad: float) -> tuple[Array, Array]:
        C = np.linalg.inv(sigma_rad**2 * B @ B.swapaxes(1, 2) + sigma_m**2 * np.eye(3))
        return np.asarray(C), np.asarray(np.einsum("ni,nij,nj->n", e, C, e))

    low, sigma_rad = LEAST_ROUNDED, MOST_ROUNDED
    for _ in range(30):  # the median, which blunders hardly move, is that of chi square
        middle = float(np.sqrt(low * sigma_rad))
        if np.median(weighed(middle)[1]) > chi_square_limit(3, 0.5):
            low = middle
        else:
            sigma_rad = middle
    C, squares = weighed(sigma_rad)
    agree = np.asarray(squares < chi_square_limit(3, CHANCE / len(q)))
    W = np.linalg.cholesky(C[agree]).swapaxes(1, 2)
    left, S = (W @ e[agree][:, :, None]).ravel(), (W @ J[agree]).reshape(-1, J.shape[2])
    step, _, rank, _ = np.linalg.lstsq(S, left)
    off_m = float(np.sqrt(np.mean(e[agree] ** 2))) if len(left) > rank else 0.0
    if off_m > SYSTEMATIC_M and np.sum((left - S @ step) ** 2) / (len(left) - rank) < RANDOM * np.mean(left**2):
        raise InputError(
            f"{arm.name}: positions are off the joints by {1e3 * off_m:.2g} mm as another table of the arm or a tool "
            "explains: give the controller's own table and the flange's positions, or leave them out"
        )
    off = -(sigma_rad**2) * np.einsum("nij,nik,nk->nj", B, C, e)
    return q + off * agree[:, None], agree


class WireRead(NamedTuple):
    """Rests of an arm with a wire at its tool."""

    q: Array  #: (N, n) joints, rad
    length_m: Array  #: (N,) of the wire, m
    p_base: Array | None  #: (N, 3) the tool's origin as the controller computes it, m; None: not known
    lines: Array  #: (N,) of the file of joints
    notes: tuple[str, ...]  #: what was left out
    noise_m: float  #: of a range, as its table says


def read_wire(data: Path, arm: Arm, references: Path, columns: Renames | None = None) -> WireRead:
    """Read joints, with the controller's positions where the table has them, and the range that a references.toml names.

    The range at a rest is the median of its recording within ``REST_S`` of the row's time; without times in the recording
    each row has its own.

    Raises:
        InputError: either file, more than one range, or rows that do not fit.
    """
    ranges = [each for each in read_references(references) if isinstance(each.reference, Distance)]
    if len(ranges) != 1 or (source := ranges[0].source) is None:
        raise InputError(f"{references}: {len(ranges)} tables of kind range; expected one, with a source")
    table = read_pose_table(data, arm=arm, columns=columns, only_joints=True, keep_missed=True)
    assert table.q is not None  # only_joints
    p, good, notes = None, np.array([not why for why in table.missed]), table.without_missed().notes
    rows = np.flatnonzero(good)
    if table.located:
        read = read_poses(data, columns=columns, arm=arm)
        rows, notes = np.searchsorted(table.lines, read.lines), read.notes
        p, rows = read.measured.p_rig[good[rows], 0], rows[good[rows]]
        if (far := np.abs(p).max()) > REACH.most_m:
            raise InputError(f"{data}: positions of up to {far:.0f} m: name x_mm, y_mm, z_mm if they are in mm")
    elif table.unused:
        notes = (*notes, f"{data}: {columns_unused(table.unused)}")
    (t_s, z), lines, noise_m = read_lengths(source), table.lines[rows].astype(float), ranges[0].noise_m
    if t_s is None:
        if len(z) != len(table.q):
            raise InputError(
                f"{source}: {len(z)} ranges for {len(table.q)} rows of {data}; give one a row, or times t_s"
            )
        return _possible(WireRead(table.q[rows], z[rows], p, lines, notes, noise_m), arm)
    if table.t_s is None:
        raise InputError(f"{data}: line 1: a column t_s is needed, as {source} has times")
    found_m = _at_rests(t_s, z, table.t_s[rows] + ranges[0].reference.delay_s, noise_m)
    there = np.isfinite(found_m)
    if there.sum() < SHARE * len(rows):
        raise InputError(
            f"{source}: a range at rest within {REST_S:g} s of {there.sum()} of {len(rows)} rows of {data}: "
            "did the arm rest there? If it did: have both one clock, and is noise_m right?"
        )
    if not there.all():
        alone = ", ".join(f"{line:.0f}" for line in lines[~there][:8])
        notes = (
            *notes,
            f"{data}: line {alone}: {(~there).sum()} rows without a range at rest within {REST_S:g} s: left out",
        )
    p = None if p is None else p[there]
    return _possible(WireRead(table.q[rows][there], found_m[there], p, lines[there], notes, noise_m), arm)


def _at_rests(t_s: Array, z: Array, at_s: Array, noise_m: float) -> Array:
    """Return the median range within ``REST_S`` of each time; NaN where there is none, or most are of different lengths."""
    near = (z[np.abs(t_s - at) <= REST_S] for at in at_s)
    middles = [
        (np.median(each), np.median(np.abs(each - np.median(each)))) if len(each) else (0.0, np.inf) for each in near
    ]
    return np.array([middle if off < MOVES * noise_m else np.nan for middle, off in middles])


def _possible(read: WireRead, arm: Arm) -> WireRead:
    """Return it; InputError where most ranges vary more than the tool travels and the arm is long, as in a wrong unit."""
    travelled = np.linalg.norm(np.ptp(arm.forward(read.q)[:, :3, 3], axis=0))
    low, high = np.quantile(read.length_m, [0.1, 0.9])
    if high - low > travelled + arm.size_m:
        raise InputError(
            f"the ranges vary by {high - low:.3g} m while the tool travels {travelled:.3g} m: is their unit right, and the "
            "arm?"
        )
    return read


def steps_of(readings: Array) -> Array:
    """Return the step (n,) that each column of readings (N, n) is rounded to; 0 where none is found.

    It is the greatest common difference of the sorted readings, fitted anew with each gap from the smallest on, as printing
    rounds an encoder's steps again. Steps beyond ``MOST_ROUNDED`` are poses that somebody chose.
    """
    return np.array([_step(each) for each in readings.T])


def _step(values: Array) -> float:
    gaps = np.sort(np.diff(np.sort(values)))
    gaps = gaps[gaps > LEAST_ROUNDED]
    for part in range(1, PARTS + 1) if len(gaps) >= GAPS else ():
        step, total, count = gaps[0] / part, 0.0, 0.0
        for gap in gaps:
            total, count = total + gap, count + np.round(gap / step)
            step = total / count
        if np.abs(gaps / step - np.round(gaps / step)).max() < OFF_STEP:
            return float(step) if step < np.sqrt(12) * MOST_ROUNDED else 0.0
    return 0.0


def explained_m(found: Identified, measured: Measured, noise_m: float) -> float:
    """Return the residual, m, RMS, that a range's noise and the steps explain that joints are rounded to."""
    by_readings = _by_readings(found.model, found.model.linearised(found.solution.x, measured)[1])
    squares = np.sum((by_readings[:, 0] * steps_of(measured.q)) ** 2, axis=1) / 12
    return float(np.sqrt(noise_m**2 + np.mean(squares)))


def _by_readings(model: Model, J: Array) -> Array:
    """Return the derivative (N, M, n) by the joints' readings, from that by all parameters (N, M, P)."""
    return np.asarray((by_joints(model, J) * model.arm.direction) @ model.arm.coupling)


def without_blunders(
    arm: Arm, q: Array, length_m: Array, p_base: Array | None, progress: Callable[[str], None] = lambda line: None
) -> tuple[Measured, Mask, tuple[Blunder, ...]]:
    """Return rows as measured, which (N,) of them are good, and the others.

    ``q``: (N, n) joints, rad. ``length_m``: (N,) of the wire, m. ``p_base``: (N, 3) the tool's origin as the controller
    computes it, m; None: not known. What joints and positions are rounded by is found from them. InputError: so many rows
    contradict the rest that no arm of this kind explains them.
    """
    good, blunders = np.ones(len(q), np.bool_), []
    if p_base is not None:
        q, good = unrounded(arm, q, p_base, max(steps_of(p_base).max() / np.sqrt(12), LEAST_ROUNDED))
        if good.sum() < SHARE * len(q):
            raise InputError(
                f"{arm.name}: positions contradict the joints in {(~good).sum()} of {len(q)} rows: other arm?"
            )
        blunders = [Blunder(rows, "the position contradicts the joints") for rows in _runs(~good)]
    measured = Measured(q, np.zeros((len(q), 1, 3)), length_m=length_m)
    progress("blunders")
    model, x, sigma = _trimmed(without_tool(arm), measured.rows(good))
    limit = chi_square_limit(1, CHANCE)
    squares = _squares(model, x, measured, sigma)
    for joint in range(arm.joints):
        for rows in _signs_lost(model, x, measured, sigma, joint, limit):
            blunders.append(Blunder(rows, f"the sign of joint {joint + 1} is lost: negated it fits"))
            good[rows] = False
    far = good & (squares > limit)
    off = model.residuals(x, measured)[:, 0]
    for rows in _runs(far):
        mm = -1e3 * off[rows]
        side = "long" if mm.mean() > 0 else "short"
        blunders.append(Blunder(rows, f"the wire reads {np.abs(mm).min():.1f} to {np.abs(mm).max():.1f} mm too {side}"))
    return measured, good & ~far, tuple(blunders)


def _trimmed(arm: Arm, measured: Measured) -> tuple[Model, Array, float]:
    model, x = with_placement(Model(arm, 1, False, ()), measured)
    prior = prior_sigma(model, dict.fromkeys(("base_rx", "base_ry", "base_rz"), 0.0))
    noise = (BEGIN_M, 0.0)
    free = observed(model, x, measured, prior, noise).free

    def concentrated(x: Array, keep: Mask, steps: int) -> tuple[float, Array, Mask]:
        for _ in range(steps):
            x = fit(model, x, measured, free, prior, used=keep, noise=noise).x
            off = np.abs(model.residuals(x, measured)[:, 0])
            before, keep = keep, off <= np.quantile(off, SHARE)
            if (before == keep).all():
                break
        return float((off[keep] ** 2).sum()), x, keep

    rng, block = np.random.default_rng(0), np.arange(len(measured)) * BLOCKS // len(measured)
    begins = [np.isin(block, rng.permutation(BLOCKS)[: BLOCKS // 2]) for _ in range(STARTS)]
    tried = [concentrated(x, keep, 2) for keep in (np.ones(len(measured), np.bool_), *begins)]
    _, x, keep = min(tried, key=lambda each: each[0])
    _, x, keep = concentrated(x, keep, TRIMS)
    for _ in range(TRIMS):  # reweighted: the good rows that were trimmed come back
        off = np.abs(model.residuals(x, measured)[:, 0])
        sigma = float(np.median(off)) / np.sqrt(chi_square_limit(1, 0.5))
        before, keep = keep, (off / sigma) ** 2 <= chi_square_limit(1, CHANCE)
        if (before == keep).all():
            break
        x = fit(model, x, measured, free, prior, used=keep, noise=noise).x
    return model, x, sigma


def _squares(model: Model, x: Array, measured: Measured, sigma: float) -> Array:
    return np.asarray((model.residuals(x, measured)[:, 0] / sigma) ** 2)


def _signs_lost(
    model: Model, x: Array, measured: Measured, sigma: float, joint: int, limit: float
) -> list[NDArray[np.int64]]:
    """Return runs of rows of one sign of a joint that only its negative explains, by squares that no blunder exceeds."""
    q = measured.q.copy()
    q[:, joint] *= -1
    read = np.minimum(_squares(model, x, measured, sigma), limit)
    negated = np.minimum(_squares(model, x, replace(measured, q=q), sigma), limit)
    borders = np.flatnonzero(np.diff(np.sign(measured.q[:, joint]))) + 1
    runs = np.split(np.arange(len(q)), borders)
    return [rows for rows in runs if (read - negated)[rows].sum() > 2 * np.log(len(runs) * model.arm.joints / AGREE)]


def _runs(mask: Mask) -> list[NDArray[np.int64]]:
    """Return runs of rows that are marked, with gaps of fewer than JOIN rows between them."""
    rows = np.flatnonzero(mask)
    return np.split(rows, np.flatnonzero(np.diff(rows) > JOIN) + 1) if len(rows) else []
