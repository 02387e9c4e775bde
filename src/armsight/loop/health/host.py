"""The computer: images that it delivers twice, and stalls of the control loop.

Images that repeat the one before to the last digit (noise differs), and periods that began so late that commands were
missed.
"""

from __future__ import annotations

import numpy as np

from armsight.data import PoseEstimate
from armsight.loop.finding import HealthFinding, make_finding

#: So many repeated shots, and this share of all, are reported.
_LEAST, _SHARE = 3, 0.01
#: A period that begins so late, s, is a stall; so many are reported at this share of all, or one of so long, s.
_STALL_S, _STALLS, _STALLED_SHARE, _LONG_S = 0.02, 5, 0.01, 0.1


class HostWatch:
    """Watches for repeated images and stalls."""

    def __init__(self) -> None:
        self._last: tuple[bytes, bytes] | None = None  # of the detections of the shot before
        self._shots = self._repeated = 0
        self._first_s: float | None = None
        self._stalls = self._periods = 0
        self._longest_s, self._stalled_s = 0.0, 0.0

    def began(self, t_s: float, late_s: float) -> None:
        """Take by how much, s, a period of the control loop began late, at a time, s."""
        self._periods += 1
        if late_s > _STALL_S:
            self._stalled_s = self._stalled_s if self._stalls else t_s
            self._stalls += 1
            self._longest_s = max(self._longest_s, late_s)

    def take(self, estimate: PoseEstimate, t_s: float) -> None:
        """Take a measured pose with the time of its shot, s, in order of time."""
        seen = estimate.points.seen
        now, last = (seen.ids.tobytes(), seen.uv.tobytes()), self._last
        self._last = now
        self._shots += 1
        if now != last:
            return
        self._repeated += 1
        self._first_s = t_s if self._first_s is None else self._first_s

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        found = list[HealthFinding]()
        if self._repeated >= max(_LEAST, _SHARE * self._shots):
            share, counts = self._repeated / self._shots, {"count": self._repeated, "shots": self._shots}
            sigma = float(np.sqrt(share * (1.0 - share) / self._shots))
            found.append(make_finding("repeated", (share, sigma), self._first_s, words=counts))
        if self._stalls >= max(_STALLS, _STALLED_SHARE * self._periods) or self._longest_s >= _LONG_S:
            times = "once" if self._stalls == 1 else f"{self._stalls} times"
            found.append(make_finding("stalled", (self._longest_s, 0.0), self._stalled_s, words={"times": times}))
        return tuple(found)
