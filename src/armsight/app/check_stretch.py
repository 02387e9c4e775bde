"""A run's folder cut into its motions and rests: what was commanded in each, what vision saw, and how noisy that is.

The instrument's noise is half the mean square of the steps from one shot of a rest to the next: a slower motion of the arm
is not in it, a faster one is, so it is rather too large. What vision.csv claims beyond it is common to all shots.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.run_tracks import ToolTrack, read_track
from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text
from armsight.loop.iso9283.poses import LEAST

#: An arm that stands is judged by the end of its rest, s.
WINDOW_S = 0.3
_SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_z_m")


@dataclass(frozen=True)
class Stretch:
    """A motion, or the rest at its end.

    Attributes:
        name: of the motion.
        kind: joints, home, line, circle; rest.
        wanted: where the tool was to be.
        seen: where vision saw it.
        sigma: (N, 3) what vision claims, m.
    """

    name: str
    kind: str
    wanted: ToolTrack
    seen: ToolTrack
    sigma: Array


@dataclass(frozen=True)
class Noise:
    """The instrument.

    Attributes:
        own: (3, 3) covariance of one shot of an arm at rest, base's axes, m^2.
        common: (3, 3) that of the error that all shots share.
        claimed: (3,) variances that vision claims at rest, all in.
    """

    own: Array
    common: Array
    claimed: Array

    def moving(self, stretch: Stretch) -> Array:
        """Return the covariance (3, 3) of one shot in a motion: vision claims more there, as both eyes are not at one."""
        return self.own + np.diag(np.maximum((stretch.sigma**2).mean(axis=0) - self.claimed, 0.0))


def stretches_of(folder: Path, closed: bool) -> list[Stretch]:
    """Cut a run into its motions and rests of one pass, in their order."""
    for name in ("wanted.csv", "vision.csv", "motion.toml"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: is no run, {name} is missing: give a folder of armsight run or demo, or a CSV")
    wanted, _ = read_track(folder / "wanted.csv", ())
    seen, sigma = read_track(folder / "vision.csv", _SIGMAS)
    kinds = _kinds(folder / "motion.toml")
    named = np.char.add(np.char.add(wanted.phase, "/"), wanted.motion)
    ends = [0, *(np.flatnonzero(named[1:] != named[:-1]) + 1).tolist(), len(named)]
    found, now = [], "calibration"
    for first, last in pairwise(ends):
        phase, name = str(wanted.phase[first]), str(wanted.motion[first])
        now = now if phase == "rest" else phase
        if now != ("closed_loop" if closed else "open_loop"):
            continue
        part = wanted[np.arange(first, last)]
        rows = (seen.t_s > part.t_s[0]) & (seen.t_s <= part.t_s[-1])
        kind = "rest" if phase == "rest" else kinds.get(name, "joints")
        found.append(Stretch(name, kind, part, seen[rows], sigma[rows]))
    return found


def _kinds(file: Path) -> dict[str, str]:
    """Return the kind of every motion of a motion file by its name."""
    try:
        entries: Any = tomllib.loads(read_text(file)).get("motion", [])
        return {str(e.get("name", f"{e['kind']} {n}")): str(e["kind"]) for n, e in enumerate(entries, start=1)}
    except (tomllib.TOMLDecodeError, AttributeError, KeyError, TypeError):
        raise InputError(f"{file}: not a motion file (docs/run.md)") from None


def stood(stretch: Stretch) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) and sigmas (n, 3) of the shots at the end of a rest."""
    rows = stretch.seen.t_s > stretch.wanted.t_s[-1] - WINDOW_S
    return stretch.seen.Ts_base_tool[rows], stretch.sigma[rows]


def noise_of(stretches: list[Stretch]) -> Noise:
    """Return the instrument's noise as the rests show it."""
    steps, sigmas = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for stretch in stretches:
        if stretch.kind == "rest":
            Ts, sigma = stood(stretch)
            steps.append(np.diff(Ts[:, :3, 3], axis=0))
            sigmas.append(sigma)
    d, sigma = np.concatenate(steps), np.concatenate(sigmas)
    if len(d) < LEAST:
        raise InputError("the arm was hardly seen at rest: rests of half a second in view of both cameras are needed")
    own = d.T @ d / (2 * len(d))
    claimed = (sigma**2).mean(axis=0)
    return Noise(own, np.diag(np.maximum(claimed - np.diag(own), 0.0)), claimed)


def plain(name: str) -> str:
    """Return the name of a motion without its cycle."""
    return re.sub(r" cycle \d+$", "", name)
