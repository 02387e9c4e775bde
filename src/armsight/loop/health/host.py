"""Shots that repeat the one before: a camera driver or a computer that delivers an old image as a new one.

In: measured poses with their detections. Out: a finding once so many shots repeat the one before to the last digit. The
noise of a camera differs from image to image, so two images never have the same detections by chance.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array, Ids, PoseEstimate
from armsight.loop.health.record import HealthFinding

#: So many repeated shots, and this share of all, are reported.
_LEAST, _SHARE = 3, 0.01


class HostWatch:
    """Watches for repeated images."""

    def __init__(self) -> None:
        self._last: tuple[Ids, Array] | None = None
        self._shots = self._repeated = 0
        self._first_s: float | None = None

    def take(self, estimate: PoseEstimate, t_s: float) -> None:
        """Take a measured pose with the time of its shot, s, in order of time."""
        seen = estimate.points.seen
        now, last = (seen.ids, seen.uv), self._last
        self._last = now
        self._shots += 1
        if last is None or not np.array_equal(now[0], last[0]) or not np.array_equal(now[1], last[1], equal_nan=True):
            return
        self._repeated += 1
        self._first_s = t_s if self._first_s is None else self._first_s

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        if self._repeated < max(_LEAST, _SHARE * self._shots):
            return ()
        share = self._repeated / self._shots
        return (
            HealthFinding(
                "host",
                f"{self._repeated} of {self._shots} shots repeat the one before: their images are older than their times",
                self._first_s,
                100.0 * share,
                100.0 * float(np.sqrt(share * (1.0 - share) / self._shots)),
                "%",
                "lower the rate of the cameras, or give each its own USB controller",
            ),
        )
