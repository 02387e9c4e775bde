"""What a run's folder says about a test: where vision saw the tool at each commanded pose and along each path.

In: wanted.csv (where the tool was to be), vision.csv, motion.toml. Out: rows for the judging. A rest belongs to the pose
that was commanded there, wherever else in the motion that pose comes again; a line or circle to those over the same ground.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from armsight.app.check_paths import path_rows, turns_of
from armsight.app.check.rows import (SAME_M, Attained, Row, natural)
from armsight.app.check_stretch import Noise, Stretch, noise_of, plain, stood, stretches_of
from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import mean_pose
from armsight.loop.iso9283.poses import LEAST

#: A rest is judged that was seen in so many shots.
_SHOTS = 3


def attained_in(folder: Path, *, closed: bool) -> Attained:
    """Return what a run attained.

    Args:
        folder: of the run.
        closed: take the motions with the loop closed on vision instead of those with potentiometers alone.

    Raises:
        InputError: no run, or none of its motions comes again.
    """
    stretches = stretches_of(folder, closed)
    if not stretches:
        which = "with the loop closed" if closed else "with potentiometers alone"
        raise InputError(f"{folder}: the run has no motions {which}; run.log says how far it came")
    noise = noise_of(stretches)
    paths, run, circle, notes = path_rows(stretches, noise)
    rows, more = _rests([s for s in stretches if s.kind == "rest"], run, noise)
    return Attained(rows + paths, more + notes, turns_of(folder, circle))


def _rests(stretches: list[Stretch], run: set[str], noise: Noise) -> tuple[list[Row], list[str]]:
    """Return a row for every rest at a pose, but those at the ends of paths that are judged, and what was left out."""
    names: list[tuple[Array, str]] = []
    visits: dict[tuple[str, str], list[Row]] = {}
    times: Counter[str] = Counter()
    before, unseen = "the start", 0
    for stretch in stretches:
        T = stretch.wanted.Ts_base_tool[-1]
        name = next((n for at, n in names if np.abs(at - T).max() < SAME_M), None)
        if stretch.name in run:
            before = name or plain(stretch.name)
            continue
        if name is None:
            short = plain(stretch.name).removeprefix("to ")
            name = short if all(short != n for _, n in names) else stretch.name
            names.append((T, name))
        way = (name, before)
        times[name] += 1
        Ts, _ = stood(stretch)
        if len(Ts) >= _SHOTS:
            t_s = float(stretch.wanted.t_s[-1])
            seen = Row("pose", name, str(times[name]), before, t_s, mean_pose(Ts), T, noise.own / len(Ts), noise.common)
            visits.setdefault(way, []).append(seen)
        unseen += len(Ts) < _SHOTS
        before = name
    notes = [f"{unseen} rests were not seen, and are left out"] if unseen else []
    often = any(len(came) >= LEAST for came in visits.values())
    attained: Counter[str] = Counter()
    for (name, _), came in visits.items():
        attained[name] += len(came)
    rows = []
    for (name, before), came in visits.items():
        if often and len(came) < LEAST <= attained[name]:
            notes.append(f"left out: {name} come to from {before}, too seldom ({len(came)})")
        else:
            rows += came
    return sorted(rows, key=lambda row: (natural(row.pose), row.t_s)), notes
