"""One reading into a Kalman filter whose references are considered, not estimated (Schmidt, 1966).

In: the state's covariance, the reading's residual and its derivatives. Out: the gain, the covariance, and how the state's
error hangs on each reference's: without that, many readings of one sensor would average its calibration's error away.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from armsight.data import Array

#: Name of a set of parameters -> (K, P) covariance of the state's error with theirs.
Considered = Mapping[str, Array]


class Shares(NamedTuple):
    """What parameters that are considered do to a reading: its derivative (m, P) by them, their covariance (P, P)."""

    by: Array
    cov: Array


class Gained(NamedTuple):
    """What a reading does to a filter.

    Attributes:
        gain: (K, m) what of its residual is added to the state.
        P, considered: (K, K) covariance, and what hangs on references, after it.
        square: squared Mahalanobis distance of the residual.
        S: (m, m) covariance of the residual.
    """

    gain: Array
    P: Array
    considered: dict[str, Array]
    square: float
    S: Array


def gained(
    P: Array, z: Array, H: Array, R: Array, shares: Mapping[str, Shares], before: Considered, fixed: list[int]
) -> Gained:
    """Return what a reading does.

    ``P``: (K, K) covariance of the state. ``z``: (m,) residual: measured minus predicted. ``H``: (m, K) derivative of
    the prediction by the state. ``R``: (m, m) covariance of what is the reading's own. ``shares``: the parameters that
    the reading depends on. ``before``: how the state's error hangs on parameters so far. ``fixed``: rows of the state
    that a reading does not change.
    """
    C = {name: before.get(name, np.zeros((len(P), len(one.cov)))) for name, one in shares.items()}
    HP = H @ P + sum(one.by @ C[name].T for name, one in shares.items())
    S = HP @ H.T + R + sum((H @ C[name] + one.by @ one.cov) @ one.by.T for name, one in shares.items())
    K = np.asarray(np.linalg.solve(S, HP).T, np.float64)
    K[fixed] = 0.0
    after = P - K @ HP
    after[fixed] = after[:, fixed].T  # a fixed row is as it was but for its part with the others
    after = (after + after.T) / 2
    considered = passed(before, K, H)
    for name, one in shares.items():
        considered[name] = C[name] - K @ (H @ C[name] + one.by @ one.cov)
    return Gained(K, after, considered, float(z @ np.linalg.solve(S, z)), S)


def passed(before: Considered, gain: Array, H: Array) -> dict[str, Array]:
    """Return how the state's error hangs on parameters after a measurement that does not depend on them."""
    return {name: C - gain @ (H @ C) for name, C in before.items()}
