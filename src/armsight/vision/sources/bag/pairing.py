"""Pairs the messages of two topics by their time stamps, and says what it left out.

In: the stamps of both topics in the order they were recorded. Out: pairs of message numbers, the unpaired ones, and notes
on stamps that cannot be right. Two messages are a pair where each is the other's nearest and they are no further apart
than half the period of the faster topic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armsight.data import Array
from armsight.errors import InputError

#: A stamp that moves by this much more or less than the recorder's clock has jumped, s.
_JUMP_S = 1.0
#: A pair is never further apart than this, s, however slow the topics are.
_APART_S = 0.5
_NS = 1e-9


@dataclass(frozen=True)
class Stamps:
    """The stamps of one topic.

    Attributes:
        topic: its name.
        t_ns: time stamps, ns, in the order of the messages: those of the headers, or the arrival where there are none.
        notes: what is wrong with them.
    """

    topic: str
    t_ns: tuple[int, ...]
    notes: tuple[str, ...] = ()

    @property
    def period_s(self) -> float:
        """Median interval, s; infinite where there are fewer than two."""
        return float(np.median(np.abs(np.diff(self.t_ns)))) * _NS if len(self.t_ns) > 1 else np.inf


def stamps_of(topic: str, header_ns: Sequence[int], arrival_ns: Sequence[int]) -> Stamps:
    """Return the stamps of a topic, checked.

    Args:
        topic: its name.
        header_ns: stamps of the headers, ns.
        arrival_ns: the recorder's times of arrival, ns.
    """
    stamps, arrivals, notes = list(header_ns), list(arrival_ns), []
    bad = [k for k, t in enumerate(stamps) if t <= 0]
    if bad:
        said = "all" if len(bad) == len(stamps) else str(len(bad))
        notes.append(
            f"{topic}: {said} of {len(stamps)} stamps are zero or negative, first at message {bad[0]}: the time of arrival "
            "is used for the whole topic"
        )
        return Stamps(topic, tuple(arrivals), tuple(notes))
    steps = np.diff(np.array(stamps, dtype=np.int64)) * _NS
    jumps = np.flatnonzero(np.abs(steps - np.diff(np.array(arrivals, dtype=np.int64)) * _NS) > _JUMP_S)
    if len(jumps):
        k = int(jumps[0])
        notes.append(
            f"{topic}: its clock jumps {len(jumps)} time{'' if len(jumps) == 1 else 's'}, first by {steps[k]:+.3f} s after "
            f"message {k}: shots are paired on either side of it"
        )
    return Stamps(topic, tuple(stamps), tuple(notes))


@dataclass(frozen=True)
class Pairing:
    """Which messages are one shot.

    Attributes:
        pairs: (left, right) message numbers in the order of the left ones.
        alone: (side, message number) of those without a partner: 0 left, 1 right.
        allowed_s: how far apart a pair may be, s.
        skew_s: median of right minus left over the pairs, s; 0 without any.
        notes: what was left out.
    """

    pairs: tuple[tuple[int, int], ...]
    alone: tuple[tuple[int, int], ...]
    allowed_s: float
    skew_s: float
    notes: tuple[str, ...]


def pair(left: Stamps, right: Stamps, allowed_s: float | None = None) -> Pairing:
    """Pair two topics.

    Args:
        left: of the left camera.
        right: of the right camera.
        allowed_s: how far apart a pair may be, s; by default half the period of the faster topic.

    Raises:
        InputError: no two messages are close enough.
    """
    if allowed_s is None:
        allowed_s = min(_APART_S, left.period_s / 2, right.period_s / 2)
    a, b = np.array(left.t_ns, dtype=np.int64), np.array(right.t_ns, dtype=np.int64)
    if len(a) == len(b) > 1 and not (a != a[0]).any() and not (b != b[0]).any():
        note = f"{left.topic} and {right.topic}: all stamps are the same: paired in the order of the recording"
        pairs_ = tuple((k, k) for k in range(len(a)))
        return Pairing(pairs_, (), allowed_s, 0.0, (*left.notes, *right.notes, note))
    there, back = _nearest(a, b), _nearest(b, a)
    pairs = [(k, int(n)) for k, n in enumerate(there) if back[n] == k and abs(int(b[n]) - int(a[k])) * _NS <= allowed_s]
    if not pairs:
        gap_s = float(np.min(np.abs(b[there] - a))) * _NS
        raise InputError(
            f"{left.topic} and {right.topic}: no two images within {1e3 * allowed_s:.1f} ms; the closest are "
            f"{gap_s:.3f} s apart: are their clocks the same?"
        )
    with_left, with_right = {k for k, _ in pairs}, {n for _, n in pairs}
    alone = [(0, k) for k in range(len(a)) if k not in with_left] + [
        (1, n) for n in range(len(b)) if n not in with_right
    ]
    notes = [*left.notes, *right.notes]
    if alone:
        counts = [sum(side == each for each, _ in alone) for side in (0, 1)]
        notes.append(
            f"{counts[0]} of {len(a)} messages of {left.topic} and {counts[1]} of {len(b)} of {right.topic} have no "
            f"partner within {1e3 * allowed_s:.1f} ms"
        )
    skews: Array = np.array([b[n] - a[k] for k, n in pairs]) * _NS
    return Pairing(tuple(pairs), tuple(alone), allowed_s, float(np.median(skews)), tuple(notes))


def _nearest(of: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return for each time (N,) the row of the nearest among (M,), which need not be sorted."""
    order = np.argsort(among, kind="stable")
    sorted_ = among[order]
    after = np.clip(np.searchsorted(sorted_, of), 1, max(len(sorted_) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(sorted_) - 1)
    nearer = np.where(np.abs(sorted_[after] - of) < np.abs(sorted_[before] - of), after, before)
    return np.asarray(order[nearer])
