"""Pairs the messages of two topics by their time stamps, and says what it left out.

In: the stamps of both topics, in any order. Out: pairs of message numbers, the unpaired ones, and notes on stamps that
cannot be right. Two messages are a pair where each is the other's nearest and they are no further apart than half the
period of the faster topic. Several with one stamp are paired in the order of the recording; one that was recorded twice
counts once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.vision.sources.bag.reader import S_NS

_Times = NDArray[np.int64]
#: A clock that moves by so much more or less than the recorder's has jumped, s, and as many periods; half: messages that
#: come late are taken for a jump; double: a clock that steps by a second is not seen.
_JUMP_S, _JUMP_PERIODS = 1.0, 4.0
#: So many messages are looked at together: half of them that come late are no jump; half, double: shorter, longer bursts.
_TOGETHER = 5
#: A pair is never further apart than this, s, however slow the topics are; half, double: the same for all above 1 Hz.
_APART_S = 0.5


@dataclass(frozen=True)
class Stamps:
    """The stamps of one topic, t_ns, in the order of the messages: of the headers, or of the arrival without any.

    ``notes``: what is wrong with them; ``repeats``: messages recorded before, with the same stamp and content;
    ``unknown``: those whose time of arrival does not say when they were sent; ``jumps_ns``: after how much time of
    arrival the clock jumped, and by how much; ``arrival_ns``: by the recorder.
    """

    topic: str
    t_ns: tuple[int, ...]
    notes: tuple[str, ...] = ()
    repeats: frozenset[int] = frozenset()
    unknown: frozenset[int] = frozenset()
    jumps_ns: tuple[tuple[int, int], ...] = ()
    arrival_ns: tuple[int, ...] = ()

    @property
    def period_s(self) -> float:
        """Median interval, s; infinite where there are fewer than two times."""
        return _period_ns(np.array(self.t_ns, np.int64)) / S_NS


def _period_ns(t: _Times) -> float:
    steps = np.diff(np.unique(t))
    return float(np.median(steps)) if len(steps) else np.inf


def stamps_of(
    topic: str, header_ns: Sequence[int], arrival_ns: Sequence[int], contents: Sequence[int] | None = None
) -> Stamps:
    """Return the stamps of a topic, checked: of the headers and of the recorder's arrival, ns.

    ``contents`` are hashes of the messages, by which one that was recorded twice is found.
    """
    t, arrival, notes = np.array(header_ns, np.int64), np.array(arrival_ns, np.int64), []
    seen: set[tuple[int, int]] = set()
    repeats, unknown = set(), set[int]()
    for k, key in enumerate(zip(header_ns, contents or (), strict=False)):
        if key in seen and key[0] > 0:
            repeats.add(k)
        seen.add(key)
    bad = t <= 0
    good = np.flatnonzero(~bad & ~np.isin(np.arange(len(t)), [*repeats]))
    jumps = _jumps(t[good], arrival[good])
    if bad.any():
        said = "all" if bad.all() else str(int(bad.sum()))
        notes.append(
            f"{topic}: {said} of {len(t)} stamps are zero or negative, first at message {int(np.argmax(bad))}: taken from "
            "the time of arrival"
        )
        late, period = arrival[good] - _continuous(t[good], arrival[good], jumps), _period_ns(t[good])
        t[bad] = arrival[bad]
        for k in np.flatnonzero(bad).tolist() if len(good) else ():
            near = late[np.argsort(np.abs(arrival[good] - arrival[k]), kind="stable")[:_TOGETHER]]
            took = np.median(near)
            jumped = sum(by for at, by in jumps if arrival[k] >= at)
            t[k] = arrival[k] - int(took) + jumped
            unlike = np.sum(np.abs(near - took) < period / 4) <= len(near) / 2
            if unlike or np.abs(t[good] - t[k]).min() < period / 2:  # or it is where another was
                unknown.add(k)
    if jumps:
        times, by_s = f"{len(jumps)} time{'' if len(jumps) == 1 else 's'}", jumps[0][1] / S_NS
        notes.append(f"{topic}: its clock jumps {times}, first by {by_s:+.3f} s: shots are paired on either side of it")
    if repeats:
        notes.append(f"{topic}: {len(repeats)} of {len(t)} messages were recorded twice: each counts once")
    return Stamps(
        topic, tuple(t.tolist()), tuple(notes), frozenset(repeats), frozenset(unknown), jumps, tuple(arrival.tolist())
    )


def _continuous(t: _Times, arrival: _Times, jumps_ns: Sequence[tuple[int, int]]) -> _Times:
    """Return stamps (N,) as if the clock had not jumped."""
    for at, by in jumps_ns:
        t = np.where(arrival >= at, t - by, t)
    return t


def _jumps(t: _Times, arrival: _Times) -> tuple[tuple[int, int], ...]:
    """Return when, by the time of arrival, the clock of stamps (N,) jumped, and by how much; all in ns.

    A single message that comes late is none, nor a burst of them: their stamps fill the gap that they left.
    """
    from scipy.ndimage import median_filter

    if len(t) <= _TOGETHER:
        return ()
    order = np.lexsort((t, arrival))
    early, came = t[order], arrival[order]
    period = _period_ns(t)
    least = max(_JUMP_S * S_NS, _JUMP_PERIODS * period)
    step, took = (np.diff(median_filter(each, _TOGETHER, mode="nearest")).astype(float) for each in (early, came))
    at = np.flatnonzero((step < -least) | (step - took > least)) + 1
    spacing = np.diff(np.sort(t)).astype(float)
    filled = spacing.max() <= least and np.sum(spacing < period / 2) < _TOGETHER
    if (
        not len(at) or filled or np.diff([0, *at, len(t)]).min() < (_TOGETHER + 1) // 2
    ):  # no clock jumps at each message
        return ()
    offsets = [int(np.median(part)) for part in np.split(early - came, at)]
    return tuple((int(came[k]), after - before) for k, before, after in zip(at, offsets, offsets[1:], strict=False))


@dataclass(frozen=True)
class Pairing:
    """Which messages are one shot."""

    pairs: tuple[tuple[int, int], ...]  #: (left, right) message numbers in the order of time
    alone: dict[tuple[int, int], str]  #: (side, message number) of those without a partner, 0 left, 1 right -> why
    allowed_s: float  #: how far apart a pair may be, s
    skew_s: float  #: median of right minus left over the pairs, s; 0 without any
    notes: tuple[str, ...]  #: what was left out
    due_ns: dict[tuple[int, int], int]  #: (side, message number) -> its time as if no clock had jumped, ns


def pair(left: Stamps, right: Stamps, allowed_s: float | None = None) -> Pairing:
    """Pair two topics.

    ``allowed_s``: how far apart a pair may be, s; by default half the period of the faster topic. Raises InputError: no two
    messages are close enough.
    """
    if allowed_s is None:
        allowed_s = min(_APART_S, left.period_s / 2, right.period_s / 2)
    notes = [*left.notes, *right.notes]
    if len(left.t_ns) > 1 and len({*left.t_ns}) == len({*right.t_ns}) == 1:
        notes.append(f"{left.topic} and {right.topic}: all stamps are the same: paired in the order of the recording")
    # A clock jumped if messages find their partners so; what came late does not.
    choices = [_mutual(left, right, jumps, allowed_s) for jumps in ((left.jumps_ns, _shared(left, right)), ((), ()))]
    (a, b), pairs, gap_s = max(choices, key=lambda choice: len(choice[1]))
    if not pairs:
        raise InputError(
            f"{left.topic} and {right.topic}: no two images within {1e3 * allowed_s:.1f} ms; the closest are "
            f"{gap_s:.3f} s apart: are their clocks the same?"
        )
    with_left, with_right = {k for k, _ in pairs}, {n for _, n in pairs}
    alone: dict[tuple[int, int], str] = {}
    for side, (of, other, paired) in enumerate(((left, right, with_left), (right, left, with_right))):
        for n in set(range(len(of.t_ns))) - paired:
            why = f"{other.topic} none within {1e3 * allowed_s:.1f} ms"
            why = "recorded twice: it counts once" if n in of.repeats else why
            why = "of arrival, no stamp, and others near it came late" if n in of.unknown else why
            alone[side, n] = f"{of.topic} has a message at {of.t_ns[n] / S_NS:.3f} s, {why}"
    counts = [
        sum(side == each for each, _ in alone) - len(of.repeats | of.unknown) for side, of in enumerate((left, right))
    ]
    if any(counts):
        notes.append(
            f"{counts[0]} of {len(a)} messages of {left.topic} and {counts[1]} of {len(b)} of {right.topic} have no "
            f"partner within {1e3 * allowed_s:.1f} ms"
        )
    skews: Array = np.array([b[n] - a[k] for k, n in pairs]) / S_NS
    due = {(0, k): int(t) for k, t in enumerate(a)} | {(1, n): int(t) for n, t in enumerate(b)}
    pairs.sort(key=lambda pair_: due[0, pair_[0]])
    return Pairing(tuple(pairs), alone, allowed_s, float(np.median(skews)), tuple(notes), due)


def _mutual(
    left: Stamps, right: Stamps, jumps: tuple[Sequence[tuple[int, int]], ...], allowed_s: float
) -> tuple[list[_Times], list[tuple[int, int]], float]:
    """Return the times of both as if their clocks had not jumped, ns, who is whose nearest, and the least distance, s."""
    both, groups = [], []
    for of, jumps_ns in zip((left, right), jumps, strict=True):
        t = _continuous(np.array(of.t_ns, np.int64), np.array(of.arrival_ns, np.int64), jumps_ns)
        rows: dict[int, list[int]] = {}  # those of one time, in the order of the recording
        for k in np.argsort(t, kind="stable").tolist():
            if k not in of.repeats and k not in of.unknown:
                rows.setdefault(int(t[k]), []).append(k)
        both.append(t)
        groups.append(rows)
    (one, other), (ours, theirs) = ([list(rows.values()) for rows in groups], [np.array([*rows]) for rows in groups])
    there, back = _nearest(ours, theirs), _nearest(theirs, ours)
    apart_s = np.abs(theirs[there] - ours) / S_NS
    found = [(one[k], other[n]) for k, n in enumerate(there) if back[n] == k and apart_s[k] <= allowed_s]
    return both, [pair_ for mates in found for pair_ in zip(*mates, strict=False)], float(apart_s.min())


def _shared(left: Stamps, right: Stamps) -> Sequence[tuple[int, int]]:
    """Return the jumps of the right clock, by as much as the left one where both are one: pairs stay as they are."""
    if len(left.jumps_ns) != len(right.jumps_ns):
        return right.jumps_ns
    return [
        (at, by if abs(by - ours) < _JUMP_S / 2 * S_NS else ours)
        for (_, by), (at, ours) in zip(left.jumps_ns, right.jumps_ns, strict=True)
    ]


@dataclass(frozen=True)
class PlannedShot:
    """A shot to be: the message numbers of its left and right image, None where one has no partner; its time, s."""

    messages: tuple[int | None, int | None]
    t_s: float
    problem: str | None


def planned_shots(pairing: Pairing, stamps: tuple[Stamps, Stamps]) -> list[PlannedShot]:
    """Return the shots in the order of time, messages without a partner included."""
    rows = [(pairing.due_ns[0, k], PlannedShot((k, n), stamps[0].t_ns[k] / S_NS, None)) for k, n in pairing.pairs]
    for (side, n), problem in pairing.alone.items():
        messages = (n, None) if side == 0 else (None, n)
        rows.append((pairing.due_ns[side, n], PlannedShot(messages, stamps[side].t_ns[n] / S_NS, problem)))
    return [planned for _, planned in sorted(rows, key=lambda row: row[0])]


def _nearest(of: _Times, among: _Times) -> NDArray[np.int64]:
    """Return for each time (N,) the row of the nearest among rising ones (M,)."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(among) - 1)
    return np.where(np.abs(among[after] - of) < np.abs(among[before] - of), after, before)
