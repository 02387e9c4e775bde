"""Reject what would spoil a calibration: gross corner errors and bad pairs.

A robust adjustment comes first; the noise is estimated from its residuals, so no threshold is in pixels. Everything
rejected is named with its reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import NAMED
from armsight.vision.calibrate.result import RejectedPair
from armsight.vision.pose.bundle import DAMPING, NEAR, BundleModel, BundleSolution, BundleState, Observations, minimise

#: A corner this many standard deviations off the robust fit is gross: one in 10^7 for clean noise.
CORNER_SIGMAS = 6.0
#: A pair whose typical corner is this many times the usual error is bad as a whole.
PAIR_RATIO = 3.0
#: While errors are looked for, a board may move between the exposures this many times as far as is usual at no great
#: cost; twice as far again, RMS over the six freedoms, and it is no board in a hand.
MOTION_EASE, _FAR = 5.0, 2.0
#: A pair that loses more than this share of its corners is not trusted for the rest.
LOST_SHARE = 0.25
#: Fewest corners, seen by both cameras, that make a pair useful.
LEAST_CORNERS = 6
_ROUNDS = 6
#: A step that lowers the cost by less than this share is a round's last; half and double: no detection changes sides.
_ROUGHLY = 1e-4
#: As many pairs of which corners were dropped have a line of their own.
_DROPPED = "dropped as gross errors"
_MEDIAN_CHI2_2 = 1.3863  # median of the chi-square distribution of two degrees of freedom


@dataclass(frozen=True, eq=False)
class Screened(Record):
    """The detections that remain after screening, shots renumbered, and the robust adjustment of them.

    ``unscreened``: all detections of the same pairs: what a measurement would meet; ``kept`` (S,): their rows;
    ``rejected``: pairs, and why; ``notes``: pairs of which corners were dropped, and how many.
    """

    observations: Observations
    unscreened: Observations
    kept: NDArray[np.int64]
    solution: BundleSolution
    rejected: tuple[RejectedPair, ...]
    notes: tuple[str, ...]


def noise_px(solution: BundleSolution, observations: Observations, free_count: float) -> float:
    """Estimate a detection's standard deviation beyond its image covariance from the residuals, px, 1e-3 at least.

    Under it the whitened residuals have the expected sum of squares, ``free_count`` shared parameters being estimated.
    """
    d2 = (solution.residuals_px**2).sum(axis=1)
    per_axis = d2.sum() / max(2 * len(d2) - 6 * observations.shot_count - free_count, 1)
    image = float(np.trace(observations.cov_uv, axis1=1, axis2=2).mean() / 2)
    return float(np.sqrt(max(per_axis - image, 1e-6)))


def robust_sigma(solution: BundleSolution) -> float:
    """Standard deviation of a detection by the median of the residuals' distances, px."""
    return float(np.sqrt(np.median((solution.residuals_px**2).sum(axis=1)) / _MEDIAN_CHI2_2))


def screen(
    model: BundleModel,
    start: BundleState,
    observations: Observations,
    names: tuple[str, ...],
    *,
    sigma_px: float = 1.0,
    known: Mapping[int, str] | None = None,
) -> Screened:
    """Adjust robustly and reject gross corners and bad pairs until no more are found.

    ``start``: a start for all pairs; ``observations``: all detections; ``names``: (S,) names of the pairs; ``sigma_px``:
    standard deviation of a detection to begin with, px; ``known``: pairs that are known to be bad, and why. Returns the
    detections that remain.
    """
    rejected = [RejectedPair(names[j], reason) for j, reason in (known or {}).items()]
    kept = np.setdiff1d(np.arange(observations.shot_count), list(known or ()))
    good = np.ones(len(observations.shot), bool)
    state, sigma = replace(start, Ts_left_body=start.Ts_left_body[kept]), sigma_px
    for k in range(_ROUNDS):
        rows = good & np.isin(observations.shot, kept)
        now = observations.select(good).shots(kept)
        damping = NEAR if k else DAMPING
        solution = minimise(
            _of_shots(model, kept), state, now, sigma, damping=damping, least_decrease=_ROUGHLY, covariance=False
        )
        new_sigma = robust_sigma(solution)
        distance = np.full(len(good), np.nan)
        distance[rows] = _whitened(solution, now)
        good &= ~(distance > CORNER_SIGMAS)
        bad = _bad_pairs(observations, kept, distance, good) | _far_moved(model, kept, solution)
        rejected += [RejectedPair(names[j], reason) for j, reason in bad.items()]
        left = np.array([j for j in kept if j not in bad], dtype=np.int64)
        still = np.isin(kept, left)
        state = replace(
            solution.state,
            Ts_left_body=solution.state.Ts_left_body[still],
            motions=solution.state.motions[still] if len(solution.state.motions) else solution.state.motions,
        )
        done = not bad and abs(new_sigma - sigma) < 0.02 * sigma and (good[rows]).all()
        kept, sigma = left, new_sigma
        if done:
            break
    final = observations.select(good).shots(kept)
    notes = []
    for j in kept:
        mine = observations.shot == j
        if lost := int((mine & ~good).sum()):
            which = " of both images" if len(set(observations.camera[mine])) > 1 else ""
            notes.append(f"{names[j]}: {lost} of {mine.sum()} points{which} {_DROPPED}")
    solution = minimise(_of_shots(model, kept), state, final, sigma, damping=NEAR, least_decrease=_ROUGHLY)
    return Screened(final, observations.shots(kept), kept, solution, tuple(rejected), tuple(notes))


def merged_notes(notes: Sequence[str]) -> list[str]:
    """Return a calibration's notes with one for all pairs of which corners were dropped, where those are many."""
    dropped = {note: int(note.rpartition(": ")[2].split()[0]) for note in notes if note.endswith(_DROPPED)}
    if len(dropped) <= NAMED:
        return list(notes)
    worst = sorted(dropped, key=lambda note: -dropped[note])[:NAMED]
    most = ", ".join(f"{note.rpartition(': ')[0]} ({dropped[note]})" for note in worst)
    line = f"{sum(dropped.values())} points in {len(dropped)} pairs {_DROPPED}; most in {most}; all: --json, --report"
    return [*(note for note in notes if note not in dropped), line]


def _of_shots(model: BundleModel, kept: NDArray[np.int64]) -> BundleModel:
    return replace(model, motion_sigmas=model.motion_sigmas[kept]) if len(model.motion_sigmas) else model


def _far_moved(model: BundleModel, kept: NDArray[np.int64], solution: BundleSolution) -> dict[int, str]:
    """Return the pairs whose board is at another position in each image, further than a hand moves it, with the reason."""
    bad: dict[int, str] = {}
    for j, motion in zip(kept, solution.state.motions, strict=False):
        ratio = float(np.sqrt(np.mean((motion / model.motion_sigmas[j]) ** 2)))
        if ratio > _FAR:
            bad[int(j)] = (
                f"the images show the board {1e3 * np.linalg.norm(motion[:3]):.1f} mm and "
                f"{np.degrees(np.linalg.norm(motion[3:])):.1f} degrees apart, {MOTION_EASE * ratio:.0f} times as far as "
                "usual: wrong corners, or a board that moved between the two images"
            )
    return bad


def _whitened(solution: BundleSolution, observations: Observations) -> Array:
    """(N,) distance of every detection in standard deviations of its own camera, one of which may be the noisier."""
    distance = np.linalg.norm(solution.residuals_px, axis=1)
    sigma = [np.sqrt(np.median(distance[observations.camera == side] ** 2) / _MEDIAN_CHI2_2) for side in (0, 1)]
    return np.asarray(distance / np.maximum(np.array(sigma)[observations.camera], 1e-9))


def _bad_pairs(
    observations: Observations, kept: NDArray[np.int64], distance: Array, good: NDArray[np.bool_]
) -> dict[int, str]:
    """Return the pairs to reject now, with reasons; the worst ones first, so that they cannot spoil the others."""
    level = {j: float(np.nanmedian(distance[observations.shot == j])) for j in kept}
    usual = float(np.median(list(level.values())))
    bad: dict[int, str] = {}
    for j in kept:
        mine = observations.shot == j
        lost = 1 - good[mine].mean()
        common = np.intersect1d(
            observations.point[mine & good & (observations.camera == 0)],
            observations.point[mine & good & (observations.camera == 1)],
        )
        if level[j] > PAIR_RATIO * usual:
            bad[int(j)] = (
                f"its corners are {level[j] / usual:.1f} times as far off as the other pairs': wrong corners, another "
                "board, one that moved between the two images, or motion blur"
            )
        elif lost > LOST_SHARE:
            bad[int(j)] = f"{100 * lost:.0f}% of its corners are gross errors"
        elif len(common) < LEAST_CORNERS and np.ptp(observations.camera[mine]) > 0:
            bad[int(j)] = f"only {len(common)} corners are good in both images, {LEAST_CORNERS} are needed"
    worst = max(level.values(), default=0.0)
    empty = set(kept) - set(observations.shot[good].tolist())
    return {j: why for j, why in bad.items() if j in empty or level[j] > worst / 3 or level[j] <= PAIR_RATIO * usual}
