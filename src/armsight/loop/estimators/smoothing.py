"""Smoothed poses of the tool: those at a time in the past, with the measurements after it used, too.

In: states of the filter right after measurements, the readings. Out: poses with covariances. Between two measurements the
model after each is propagated to the time in between; the two are blended by how far the joints had moved. Many intervals
between measurements are computed at once: that costs little more than one.
"""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.estimators.errormodel import (
    ErrorModel,
    ErrorState,
    Propagation,
    StateStep,
    bridged,
    shared,
    smoothed_anew,
)
from armsight.loop.estimators.estimator import Track
from armsight.loop.estimators.readings import Readings, Smoothed

#: Joints that moved no further than this between two measurements stood still, rad.
STILL_RAD = 1e-5


class Interval(NamedTuple):
    """Times between two measurements."""

    t_s: Array  #: (N,) the times, rising, s
    #: the filter after the measurement before them; its newest state where there is none after them, or none before
    before: ErrorState
    after: ErrorState | None  #: the filter after the measurement after them; None where there is none, or none before


def intervals(states: list[ErrorState], t_s: Array) -> list[Interval]:
    """Return times (N,), rising, grouped by the measurements around them.

    ``states``: the filter's, oldest first. ``t_s``: the times, s.
    """
    ends = [state for state in states if state.pose_measurement is not None]
    at, found = np.searchsorted([state.t_s for state in ends], t_s), list[Interval]()
    for k in np.unique(at).tolist():
        inner = 0 < k < len(ends)
        found.append(Interval(t_s[at == k], ends[k - 1] if inner else states[-1], ends[k] if inner else None))
    return found


def smoothed_back(states: list[ErrorState]) -> list[ErrorState]:
    """Return states with the measurements after them used, as far as their steps are known (Bierman, 1973: by adjoints)."""
    found = list[ErrorState]()
    adjoint, information, steps = np.zeros(0), np.zeros((0, 0)), tuple[StateStep, ...]()
    for state in reversed(states):
        for step in reversed(steps):
            K = len(step.kept)
            adjoint, information = _before(step, K, adjoint), _before(step, K, _before(step, K, information).T)
            weighed = np.linalg.solve(step.S, np.column_stack([step.z, step.by]))
            adjoint, information = adjoint + step.by.T @ weighed[:, 0], information + step.by.T @ weighed[:, 1:]
        if state.beside is None:
            found.append(state)
            steps = ()
            continue
        if not steps:
            size = len(state.x) + len(state.beside.y)
            adjoint, information = np.zeros(size), np.zeros((size, size))
        known = np.hstack([state.P, state.beside.C])
        found.append(state._replace(x=state.x + known @ adjoint, P=state.P - known @ information @ known.T))
        steps = state.steps
    return found[::-1]


def _before(step: StateStep, K: int, a: Array) -> Array:
    """Return the product of the transposed transition of a step and an adjoint (K + B, ...)."""
    out, felt = a.copy(), step.by.T @ (step.gain.T @ a)
    out[:K] = (a[:K].T * step.kept).T
    if step.velocity is not None:
        out[K : K + 3] = 0.0
        out += step.velocity.T @ a[K : K + 3]
    return np.asarray(out - felt)


def blended(model: ErrorModel, readings: Readings, parts: list[Interval]) -> Track:
    """Return the poses of the tool at the times of intervals, in their order."""
    tracks: list[Track] = []
    for inner, some in groupby(_merged(parts), lambda part: part.after is not None):
        if inner:
            tracks.append(_between(model, readings, list(some)))
        else:
            tracks += [_alone(model, readings, part) for part in some]
    if len(tracks) == 1:
        return tracks[0]
    return Track(*map(np.concatenate, zip(*(vars(track).values() for track in tracks), strict=True)))


def _merged(parts: list[Interval]) -> list[Interval]:
    """Return intervals that follow each other between the same measurements as one."""
    merged: list[Interval] = []
    for _, some in groupby(parts, lambda part: (id(part.before), id(part.after))):
        same = list(some)
        merged.append(same[0]._replace(t_s=np.concatenate([part.t_s for part in same])))
    return merged


def anew(readings: Readings, states: list[ErrorState]) -> list[ErrorState]:
    """Return states updated by the readings that have come since, as far as those about their times are kept."""
    oldest, _ = readings.span_s
    kept = [state.t_s >= oldest for state in states]
    if not any(kept):
        return states
    then = readings.at(np.array([state.t_s for state, there in zip(states, kept, strict=True) if there]))
    rows = iter([then.rows(k, k + 1) for k in range(len(then.q))])
    return [smoothed_anew(state, next(rows)) if there else state for state, there in zip(states, kept, strict=True)]


def by_state(model: ErrorModel, state: ErrorState, t_s: Array, joints: Smoothed, step: Propagation) -> Track:
    """Return the poses of the tool at times (N,), s, by one state, propagated."""
    return Track(t_s, *model.tracked(state, step, joints), joints.q, joints.qd, t_s - state.seen_s)


def _alone(model: ErrorModel, readings: Readings, part: Interval) -> Track:
    joints, (before,) = readings.at(part.t_s), anew(readings, [part.before])
    return by_state(model, before, part.t_s, joints, model.moved(before, joints, part.t_s))


def _between(model: ErrorModel, readings: Readings, parts: list[Interval]) -> Track:
    """Return the poses of the tool in intervals with a measurement before and after each."""
    t_s = np.concatenate([part.t_s for part in parts])
    rows = np.repeat(np.arange(len(parts)), [len(part.t_s) for part in parts])
    joints = readings.at(t_s)
    before = _ends(anew(readings, [part.before for part in parts]))
    after = _ends(anew(readings, [part.after for part in parts if part.after]))
    ahead = model.carried(t_s - before.t_s[rows], *_come(before, joints, rows), before.variance[rows], joints)
    travel, flips = _come(after, joints, rows)
    back = model.carried(t_s - after.t_s[rows], -travel, -flips, after.variance[rows], joints)
    x, x_after = before.x[rows] * ahead.kept, after.x[rows] * back.kept
    at = model.layout.noise
    noise, bridge = bridged(at, before.x[rows], after.x[rows], ahead, back)
    x[:, at] = x_after[:, at] = noise
    Ts, Hs = model.poses(x, joints.q, joints.unseen)
    Ts_after, _ = model.poses(x_after, joints.q, joints.unseen)
    share = _share(t_s, joints, before, after, rows)
    Ts = Ts @ exp_se3(share[:, None] * log_se3(inverse(Ts) @ Ts_after))
    own, common, transposed = np.empty((len(t_s), 6, 6)), np.empty((len(t_s), 6, 6)), np.swapaxes(Hs, 1, 2)
    edges = np.searchsorted(rows, np.arange(len(parts) + 1)).tolist()
    for k, part in enumerate(parts):
        some = slice(edges[k], edges[k + 1])
        H = Hs[some].reshape(-1, Hs.shape[2])
        first, last = ((H @ P).reshape(-1, 6, Hs.shape[2]) for P in (before.P[k], after.P[k]))
        own[some] = (first + share[some, None, None] * (last - first)) @ transposed[some]
        common[some] = shared(None if part.after is None else part.after.pose_measurement, Ts[some])
    own += (Hs * bridge[:, None, :]) @ transposed
    seen_s = np.array([part.before.seen_s for part in parts])[rows]
    return Track(t_s, Ts, own + common, own, joints.q, joints.qd, t_s - seen_s)


class _Ends(NamedTuple):
    """The ends of K intervals: times (K,), states (K, size), covariances, travel, flips (K, 2, n), variances (K, n)."""

    t_s: Array
    x: Array
    P: list[Array]
    travel: Array
    flips: Array
    variance: Array


def _ends(states: list[ErrorState]) -> _Ends:
    return _Ends(
        np.array([state.t_s for state in states]),
        np.array([state.x for state in states]),
        [state.P for state in states],
        *(
            np.concatenate([getattr(state.joints, part) for state in states])
            for part in ("travel", "flips", "variance")
        ),
    )


def _come(ends: _Ends, joints: Smoothed, rows: Ids) -> tuple[Array, Array]:
    """Return how far joints (N, n) and sides (N, 2, n) had come since the ends of their rows (N,)."""
    return joints.travel - ends.travel[rows], joints.flips - ends.flips[rows]


def _share(t_s: Array, joints: Smoothed, before: _Ends, after: _Ends, rows: Ids) -> Array:
    """Return the share (N,) of their travel between two measurements that joints had moved; of time where they stood."""
    come = np.abs(joints.travel - before.travel[rows]).sum(axis=1)
    whole = np.abs(after.travel - before.travel).sum(axis=1)[rows]
    times = (t_s - before.t_s[rows]) / np.maximum(after.t_s - before.t_s, 1e-9)[rows]
    moving = whole > STILL_RAD
    return np.asarray(np.clip(np.where(moving, come / np.where(moving, whole, 1.0), times), 0.0, 1.0))
