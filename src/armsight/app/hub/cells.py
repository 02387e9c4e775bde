"""What a hub knows of its cells: a record a cell, what is wrong with it, and the order in which somebody should look.

In: what a router heard. Out: JSON for the page, numbers for metrics, rows for the store.

Whether a number drifts: the slope of its recent means is compared with slopes of windows that do not overlap, of its own
past and of its siblings. The scatter about one line does not say how steep lines are by chance: air, lamps and a warm
board move means for minutes. The median size of those slopes is the scale; the chance is Student's with their number.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from armsight.app.stream.cell_file import STATE_S
from armsight.estimate.chance import chance_among
from armsight.files import natural_key

#: s without a state until a connected cell is frozen or cut off; half: a busy computer is red, double: shown later.
_SILENT_S = 3 * STATE_S
#: s of a bar of the sparkline, and bars of a day; half: finer, double: coarser.
_BAR_S = 300.0
_BARS = round(86400 / _BAR_S)
#: sigmas of a slope that rank like an error at its limit, of cells that are well; half: slopes first, double: errors.
_STEEP = 4.0
#: s after which a cell that is gone is not shown; half: a cell of a holiday is missing, double: dismantled ones stay.
_FORGOTTEN_S = 14 * 86400.0
#: s for which a message that cannot be read is worth a look; half: missed by who looks away, double: long past.
REJECTED_S = 60.0
#: s that a cell's clock may be off the hub's; half: a slow network is called a clock, double: times are wrong.
_CLOCK_S = 2.0
#: share of missed shots that is worth a look; half: a body that leaves the view now and then, double: a lamp is off.
_MISSED = 0.5
#: Numbers of a state that are stored, with what is shown of them.
NUMBERS = ("rate_hz", "shots", "missed", "error_mm", "sigma_mm", "tilt_mdeg", "size_ppm", "temperature_c")
#: What drifts -> its unit and what a person calls it.
DRIFTS = {
    "tilt_mdeg": ("mdeg", "one camera rotates against the other"),
    "size_ppm": ("ppm", "the body seems to change its size"),
}
#: What the slopes of a cell's clock are kept as.
_CLOCK = "clock_s"
#: s of a block of means, and how many blocks a slope is taken over; half: noisier, double: later named.
BLOCK_S, BLOCKS = 10.0, 60
#: blocks that a slope needs; half: two minutes are enough and noisy, double: nothing is ranked in the first five.
_LEAST = BLOCKS // 4
#: s between two looks for drifts; half: chance is checked twice as often, double: named a minute later.
LOOK_S = 60.0
#: Chance of a look at one of two numbers: a false alarm a cell and week. Half: drifts are named later, double: two alarms.
CHANCE = LOOK_S / (2 * 7 * 86400)
#: slopes that a scale needs; half: a scale that is a third off, double: a single cell says nothing for four hours.
_SLOPES = 8
#: How much somebody should look.
ENDED, WELL, LOOK, DRIFTING, FINDING, LOST = range(-1, 5)


def number(value: object) -> float | None:
    """Return a number of JSON; None where it is none, or not finite."""
    is_none = isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300
    return None if is_none else float(value)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Drift:
    """A slope against what slopes are by chance."""

    per_h: float  #: the slope an hour, in the number's unit
    sigma_per_h: float  #: one sigma of slopes by chance; NaN while that is unknown
    chance: float  #: how probable a slope as steep is where nothing drifts; 1 while that is unknown


@dataclass
class Slopes:
    """The recent means of one number, and the slopes of earlier windows."""

    blocks: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=BLOCKS))
    past: deque[float] = field(default_factory=lambda: deque(maxlen=144))  # of a day, of windows that do not overlap
    _number: int = 0

    def add(self, t_s: float, mean: float) -> None:
        """Take the mean of a block at its time, s."""
        self._number = self._number + 1 if self.blocks else 1
        self.blocks.append((t_s, mean))
        if self._number % BLOCKS == 0 and (slope := self.per_h(t_s, BLOCKS)) is not None:
            self.past.append(slope)

    def count(self, now_s: float) -> int:
        """Return how many blocks of the last window there are."""
        # The newest is half a block old when it is complete, and the next one is being filled.
        return sum(now_s - t < (BLOCKS + 2) * BLOCK_S for t, _ in self.blocks)

    def per_h(self, now_s: float, count: int) -> float | None:
        """Return the slope of a line through the newest ``count`` blocks, an hour; None where they are too few."""
        if count < _LEAST or self.count(now_s) < count:
            return None
        t, mean = np.array(self.blocks)[-count:].T
        t = (t - t.mean()) / 3600.0
        return float(t @ mean / (t @ t))


def drifts(cells: Mapping[str, Slopes], now_s: float) -> dict[str, Drift]:
    """Compare the slopes of one number of all cells, each with those of as many blocks; too few are left out."""
    slope = functools.cache(lambda name, count: cells[name].per_h(now_s, count))
    found: dict[str, Drift] = {}
    for name, each in cells.items():
        count = each.count(now_s)
        if (own := slope(name, count)) is not None:
            siblings = [s for other in cells if other != name and (s := slope(other, count)) is not None]
            known = [siblings, each.past] if count == BLOCKS else [siblings]
            against = (chance_among(own, np.array(slopes)) for slopes in known if len(slopes) >= _SLOPES)
            found[name] = Drift(own, *max(against, default=(math.nan, 1.0)))  # those that are steeper by chance
    return found


@dataclass
class CellView:
    """One cell as the hub knows it."""

    site: str
    name: str
    about: dict[str, Any] = field(default_factory=dict)
    sessions: set[str] = field(default_factory=set)
    state: dict[str, Any] = field(default_factory=dict)
    state_s: float = 0.0  # arrival of the newest state, by the hub's clock
    alive_s: float = 0.0  # since when it is connected
    lost_s: float | None = None  # since when it is not; None while it is
    asked_s: float = -math.inf  # when it was asked who it is
    ended: str = "ended"  # what its command said when it ended; empty while it did not
    failed: bool = False  # whether that was a warning
    offset_s: float = math.nan  # its clock less the hub's
    rejected_s: float = -math.inf  # when the newest message that could not be read came
    why_rejected: str = ""
    slopes: dict[str, Slopes] = field(default_factory=lambda: {key: Slopes() for key in (*DRIFTS, _CLOCK)})
    drifts: dict[str, Drift] = field(default_factory=dict)
    day: dict[int, float] = field(default_factory=dict)  # number of the bar -> largest error, mm
    _block: tuple[int, dict[str, list[float]]] = field(default_factory=lambda: (0, {}))

    def end(self, text: str, level: object) -> None:
        """Take what its command said when it ended, and how serious that is; no text: it goes on."""
        self.ended, self.failed = text[:300], level == "warning"

    def token(self, session: str, came: bool, at_s: float) -> None:
        """Take that a process of this cell connected, or is gone."""
        if came:
            if not self.sessions:  # another command, perhaps another rig: not to be compared with what was before
                self.alive_s, self.drifts = at_s, {}
                for each in self.slopes.values():
                    each.blocks.clear()
            self.sessions.add(session)
            self.lost_s, self.ended, self.state_s = None, "", max(self.state_s, at_s)
        else:
            self.sessions.discard(session)
            self.lost_s = self.lost_s if self.sessions else at_s

    def take(self, state: Any, at_s: float) -> dict[str, Any] | None:  # noqa: ANN401 - whatever JSON holds
        """Take a state; return the row to be stored, None where it is none."""
        if not isinstance(state, dict) or (t := number(state.get("t"))) is None:
            self.rejected_s = at_s
            self.why_rejected = state if isinstance(state, str) else "a state without a time t"
            return None
        row: dict[str, Any] = {"t": t, "arrived": at_s, "mode": str(state.get("mode", ""))[:20]}
        row |= {key: number(state.get(key)) for key in NUMBERS}
        health = state.get("health")
        row["health"] = [str(each)[:300] for each in health[:5]] if isinstance(health, list) else []
        self.state, self.state_s, self.offset_s = row, at_s, t - at_s
        if row["error_mm"] is not None:
            bar = int(at_s // _BAR_S)
            self.day[bar] = max(self.day.get(bar, 0.0), row["error_mm"])
            while len(self.day) > _BARS:
                del self.day[min(self.day)]
        self._add(row, at_s)
        return row

    def _add(self, row: dict[str, Any], at_s: float) -> None:
        """Add a state to the newest block; the mean of a complete one is kept."""
        number, sums = self._block
        if number != (now := int(at_s // BLOCK_S)):
            for key, values in sums.items():
                self.slopes[key].add((number + 0.5) * BLOCK_S, float(np.mean(values)))
            self._block = now, (sums := {})
        for key, value in [(_CLOCK, self.offset_s), *((key, row[key]) for key in DRIFTS)]:
            if value is not None:
                sums.setdefault(key, []).append(value)

    def need(self, now_s: float) -> tuple[int, float, str]:
        """Return how much somebody should look, how far beyond it is within that, and why in words."""
        if not self.sessions:
            if self.ended:
                return LOOK if self.failed else ENDED, 0.0, self.ended
            why = "lost: the connection closed, and its command did not say that it ends"
            return LOST, now_s - (self.lost_s or now_s), why
        if (silent := abs(now_s - self.state_s)) > _SILENT_S:  # where the hub's clock was set, until the next state
            return LOST, silent, f"silent for {silent:.0f} s although connected: frozen, or the network is cut"
        state = self.state
        if state.get("health"):
            return FINDING, float(len(state["health"])), state["health"][-1]
        if significant := [(each.chance, key, each) for key, each in self.drifts.items() if each.chance < CHANCE]:
            chance, key, found = min(significant)
            unit, text = DRIFTS[key]
            per_h, sigma = float(f"{found.per_h:.3g}"), float(f"{found.sigma_per_h:.2g}")
            return DRIFTING, -math.log(chance), f"{text}: {per_h:+g} ± {sigma:g} {unit}/h"
        odd, limit = self._odd(now_s), self.about.get("limit_mm") or math.inf
        sigmas = [abs(each.per_h) / each.sigma_per_h for each in self.drifts.values() if each.sigma_per_h > 0.0]
        size = max(max(sigmas, default=0.0) / _STEEP, (state.get("error_mm") or 0.0) / limit)
        return LOOK if odd else WELL, size, odd

    def _odd(self, now_s: float) -> str:
        """Return what is worth a look and forbids nothing."""
        limit, error, missed = self.about.get("limit_mm"), self.state.get("error_mm"), self.state.get("missed")
        if len(self.sessions) > 1:
            return f"{len(self.sessions)} processes have this name: give each cell its own"
        if abs(self.offset_s) > _CLOCK_S:
            return f"its clock is {self.offset_s:+.0f} s off the hub's"
        if error is not None and isinstance(limit, int | float) and error > limit:
            return f"error {error:.2f} mm, more than its limit of {limit:.2f}"
        if missed is not None and missed > _MISSED:
            return f"{100 * missed:.0f} % of the shots miss the body"
        if now_s - self.rejected_s < REJECTED_S:
            return f"a message could not be read: {self.why_rejected}"
        return ""

    def to_json(self, now_s: float) -> dict[str, Any]:
        """Return what the page shows."""
        (level, size, why), first = self.need(now_s), int(now_s // _BAR_S) - _BARS + 1
        who = {"site": self.site, "name": self.name, "level": level, "size": round(size, 3), "why": why}
        return who | {
            "up": bool(self.sessions) and level < LOST,
            "about": self.about,
            "state": {key: value for key, value in self.state.items() if key != "health"},
            "health": self.state.get("health", []),
            "drifts": {key: asdict(each) for key, each in self.drifts.items() if each.sigma_per_h > 0.0},
            "alive_s": round(now_s - self.alive_s) if self.sessions else None,
            "clock_s": None if math.isnan(self.offset_s) else round(self.offset_s, 3),
            "clock_s_per_h": self.slopes[_CLOCK].per_h(now_s, self.slopes[_CLOCK].count(now_s)),
            "day": [[bar - first, round(error, 4)] for bar, error in sorted(self.day.items()) if bar >= first],
        }


def look_for_drifts(cells: Mapping[tuple[str, str], CellView], now_s: float) -> None:
    """Compare the slopes of cells that are connected; to be called once a minute."""
    alive = {f"{each.site}/{each.name}": each for each in cells.values() if each.sessions}
    found = {key: drifts({name: each.slopes[key] for name, each in alive.items()}, now_s) for key in DRIFTS}
    for name, each in alive.items():
        each.drifts = {key: of[name] for key, of in found.items() if name in of}


def ranked(cells: list[CellView], now_s: float) -> list[dict[str, Any]]:
    """Return the cells as the page shows them, first the one that somebody should look at first."""
    shown = [each.to_json(now_s) for each in cells if each.lost_s is None or now_s - each.lost_s < _FORGOTTEN_S]
    return sorted(shown, key=lambda cell: (-cell["level"], -cell["size"], cell["site"], natural_key(cell["name"])))
