"""Identify an arm by one draw-wire: from a fixed anchor, whose position nobody measured, to a point of the tool.

In: joint angles and lengths, and the tool's position as the controller computes it, where the file has it. Out: the
identified arm with anchor and tool point, and which rows are blunders, with what is wrong about them.

A controller prints joints to a tenth of a degree and computes its own position from unrounded ones. The position (its last
digit's rounding, uniform) says most of what the rounding took away; a row where it does not fit contradicts itself.

A wire hooks or slips and reads too long for many rows in a row, and a file loses the sign of a joint for a whole block: a
tenth of the rows and more, that agree with each other. Least squares fits them. So the search for blunders begins at the
least trimmed squares (Rousseeuw and Van Driessen, Data Mining and Knowledge Discovery 12, 2006) of the table of the arm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.estimate.chance import chi_square_limit
from armsight.loop.identify.fit import Mask, fit, prior_sigma
from armsight.loop.identify.identify import Identified, identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.misread import without_tool
from armsight.loop.identify.model import Model
from armsight.loop.identify.observable import observed
from armsight.loop.identify.placement import with_placement
from armsight.robot.kinematics.arm import Arm

SHARE = 0.75  # of the rows; the least trimmed squares fit these; half: fewer than are needed, double: blunders pull
#: Blocks of rows, and random halves of them that the search begins at: blunders come in runs; half: some are missed.
BLOCKS, STARTS = 12, 16
TRIMS = 30  # concentration steps at most; half: nothing
BEGIN_M = 1e-3  # m; noise of a wire to begin at; half, double: nothing
CHANCE = 1e-4  # of a good row beyond the limit; half, double: one row in ten thousand
AGREE = 1e-6  # chance of a joint's sign that is found by mistake; half, double: nothing
JOIN = 3  # rows; blunders so near each other are one run; half: more lines for the same slip


class Blunder(NamedTuple):
    """Rows that are left out."""

    rows: NDArray[np.int64]  #: from 0
    text: str  #: what is wrong about them


class WireIdentified(NamedTuple):
    """An arm identified by a wire."""

    identified: Identified  #: its base is in a frame with the base's axes and the anchor as origin
    measured: Measured  #: all rows, their joints without rounding where the controller's position says it
    used: Mask  #: (N,) the rows that were fitted
    blunders: tuple[Blunder, ...]  #: the others

    @property
    def anchor(self) -> Array:
        """The anchor (3,) in the base, m."""
        return -self.identified.solution.x[:3]


def unrounded(arm: Arm, q: Array, p_base: Array, sigma_rad: float, sigma_m: float) -> tuple[Array, Mask]:
    """Return joints (N, n) without rounding, rad, and which rows agree with the controller's position.

    ``arm``: as the controller has it: the nominal arm. ``q``: (N, n) rounded, rad. ``p_base``: (N, 3) the tool's origin
    as the controller computes it, m. ``sigma_rad``: of the joints' rounding: its step over the root of 12. ``sigma_m``:
    of the position's rounding.
    """
    model = Model(without_tool(arm), 1, False, ())
    measured = Measured(q, p_base[:, None])
    e, J = model.linearised(model.nominal(), measured, model.feature_values(q, None))
    B = sigma_rad * J[:, :, model.table_at : model.sources_at : 5] * model.arm.direction
    C = np.linalg.inv(B @ B.swapaxes(1, 2) + sigma_m**2 * np.eye(3))
    agree = np.einsum("ni,nij,nj->n", e, C, e) < chi_square_limit(3, CHANCE / len(q))
    off = -sigma_rad * np.einsum("nij,nik,nk->nj", B, C, e)
    return q + off * agree[:, None], np.asarray(agree)


def identify_wire(
    arm: Arm,
    q: Array,
    length_m: Array,
    p_base: Array | None = None,
    *,
    step_rad: float = np.deg2rad(0.1),
    step_m: float = 1e-4,
    progress: Callable[[str], None] = lambda line: None,
) -> WireIdentified:
    """Identify an arm, the anchor and the tool's point by the lengths of one wire.

    ``q``: (N, n) joints, rad. ``length_m``: (N,) of the wire, m. ``p_base``: (N, 3) the tool's origin as the controller
    computes it, m; None: not known. ``step_rad``: to what the joints are rounded. ``step_m``: to what the position is.

    Raises:
        InputError: so many rows contradict the rest that no arm of this kind explains them.
    """
    good, blunders = np.ones(len(q), np.bool_), []
    if p_base is not None:
        q, good = unrounded(arm, q, p_base, step_rad / np.sqrt(12), step_m / np.sqrt(12))
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
    off = model.residuals(x, measured, model.feature_values(q, None))[:, 0]
    for rows in _runs(far):
        mm = -1e3 * off[rows]
        side = "long" if mm.mean() > 0 else "short"
        blunders.append(Blunder(rows, f"the wire reads {np.abs(mm).min():.1f} to {np.abs(mm).max():.1f} mm too {side}"))
    used = good & ~far
    found = identify(arm, measured.rows(used), progress=progress)
    kept = np.flatnonzero(used)[found.solution.used]
    return WireIdentified(found, measured, np.isin(np.arange(len(q)), kept), tuple(blunders))


def _trimmed(arm: Arm, measured: Measured) -> tuple[Model, Array, float]:
    model, x = with_placement(Model(arm, 1, False, ()), measured)
    prior = prior_sigma(model, dict.fromkeys(("base_rx", "base_ry", "base_rz"), 0.0))
    noise = (BEGIN_M, 0.0)
    free, phi = observed(model, x, measured, prior, noise).free, model.feature_values(measured.q, None)

    def concentrated(x: Array, keep: Mask, steps: int) -> tuple[float, Array, Mask]:
        for _ in range(steps):
            x = fit(model, x, measured, free, prior, used=keep, noise=noise).x
            off = np.abs(model.residuals(x, measured, phi)[:, 0])
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
        off = np.abs(model.residuals(x, measured, phi)[:, 0])
        sigma = float(np.median(off)) / np.sqrt(chi_square_limit(1, 0.5))
        before, keep = keep, (off / sigma) ** 2 <= chi_square_limit(1, CHANCE)
        if (before == keep).all():
            break
        x = fit(model, x, measured, free, prior, used=keep, noise=noise).x
    return model, x, sigma


def _squares(model: Model, x: Array, measured: Measured, sigma: float) -> Array:
    off = model.residuals(x, measured, model.feature_values(measured.q, None))[:, 0]
    return np.asarray((off / sigma) ** 2)


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
