"""Measure a recording of a moving body with cameras that do not expose at one time: two passes.

The first detects and measures as if all were simultaneous, with a wide gate; from it the skew and the readout time are
found where they are not given; the second moves every detection to its shot's time.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armsight.data import Body, Missed, PoseEstimate
from armsight.errors import InputError
from armsight.loop.finding import HealthFinding, make_finding
from armsight.vision.pose.shutter import TimedShot, estimate_shutters, measure_moving
from armsight.vision.rig import Shutters, StereoRig

_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
#: A skew beyond so many sigmas, and so many seconds, is said; from the first so many shots.
_NOTED_SIGMAS, _NOTED_S, NOTED_SHOTS = 5.0, 1e-4, 200


@dataclass(frozen=True)
class Requested:
    """What a user requests of the shutters; None is to be found."""

    skew_s: float | None
    readout_s: float | None


def requested_shutters(skew: str | None, readout: str | None) -> Requested | None:
    """Read ``--skew`` and ``--readout``; None where neither is given. Where only one is, the skew is found, no readout."""
    if skew is None and readout is None:
        return None
    found = Requested(_seconds("--skew", skew or "find"), _seconds("--readout", readout or "0ms"))
    if found.readout_s is not None and found.readout_s < 0:
        raise InputError(f"--readout {readout}: must not be below zero")
    if found.readout_s is None and found.skew_s is not None:
        raise InputError("--readout find needs --skew find: both are found together")
    return found


def _seconds(option: str, text: str) -> float | None:
    if text.strip() == "find":
        return None
    match = re.fullmatch(r"([+-]?\d*\.?\d+)\s*(s|ms|us)", text.strip())
    if match is None:
        raise InputError(f"{option} {text!r}: expected a time with its unit, such as 5ms, or find")
    return float(match[1]) * _UNITS[match[2]]


def moved_results(
    rig: StereoRig,
    body: Body,
    first: Sequence[tuple[float | None, PoseEstimate | Missed]],
    requested: Requested | Shutters,
) -> tuple[list[tuple[PoseEstimate | Missed, bool]], Shutters]:
    """Return the result of every shot with its detections moved to its time, and whether they were; and the shutters.

    ``first``: time, s, and result of every shot as measured; ``requested``: shutters, or which are to be found.
    """
    if any(t_s is None and isinstance(result, PoseEstimate) for t_s, result in first):
        why = "these shots have no times, so nothing is known of the body's motion between two exposures"
        raise InputError(f"{why}: record them with `armsight record`, or give a video")
    shots = _timed(first)
    shutters = requested if isinstance(requested, Shutters) else _shutters(rig, body, shots, requested)
    moved = iter(measure_moving(rig, body, shots, shutters))
    return [next(moved) if isinstance(result, PoseEstimate) else (result, False) for _, result in first], shutters


def _timed(first: Sequence[tuple[float | None, PoseEstimate | Missed]]) -> list[TimedShot]:
    measured = [(t_s, r) for t_s, r in first if t_s is not None and isinstance(r, PoseEstimate)]
    return [TimedShot(t_s, r.points.seen, r.T_left_body) for t_s, r in measured]


def _shutters(rig: StereoRig, body: Body, shots: Sequence[TimedShot], requested: Requested) -> Shutters:
    """Return the shutters that a user requests, found where they are not given."""
    given = Shutters(requested.skew_s or 0.0, requested.readout_s or 0.0, np.zeros((2, 2)))
    if requested.skew_s is not None:
        return given
    found = estimate_shutters(rig, body, shots, known=given, readout=requested.readout_s is None)
    if isinstance(found, Missed):
        raise InputError(f"the skew of the cameras cannot be found: {found.reason}; or give it: --skew 5ms")
    return found


def skew_finding(
    rig: StereoRig, body: Body, first: Sequence[tuple[float | None, PoseEstimate | Missed]]
) -> HealthFinding | None:
    """Return what is wrong where shots that were measured as simultaneous show that they are not, or None."""
    shots = _timed(first)
    if any(b.t_s <= a.t_s for a, b in itertools.pairwise(shots)):
        return None
    found = estimate_shutters(rig, body, shots) if shots else Missed("")
    if not isinstance(found, Shutters) or abs(found.skew_s) <= max(_NOTED_SIGMAS * found.sigmas[0], _NOTED_S):
        return None
    evidence = found.skew_s, float(found.sigmas[0])
    return make_finding("shutters", evidence, shots[0].t_s, words={"shutters": str(found)})
