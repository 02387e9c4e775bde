"""The clock of the cameras against that of the joints: what the estimator had to correct, as a finding."""

from __future__ import annotations

from armsight.loop.estimators.clock import ClockFollower
from armsight.loop.health.record import HealthFinding

#: A rate is said beyond so many sigmas.
_RATE_SIGMAS = 4.0


def clock_findings(clock: ClockFollower, t_s: float) -> tuple[HealthFinding, ...]:
    """Return what is wrong with the cameras' clock at a time, s; nothing while the delay is as it was measured."""
    if clock.since_s is None:
        return ()
    offset_s, (rate, sigma) = clock.offset_s(t_s), clock.rate
    drifts = f", and drift by {1e6 * rate:.0f} +- {1e6 * sigma:.0f} ppm" if abs(rate) > _RATE_SIGMAS * sigma else ""
    return (
        HealthFinding(
            "time",
            f"the images come {abs(1e3 * offset_s):.2f} ms {'later' if offset_s > 0 else 'earlier'} than at the beginning, "
            f"against the readings of the joints{drifts}; it was followed",
            clock.since_s,
            1e3 * offset_s,
            1e3 * clock.sigma_s,
            "ms",
            "stamp images and readings by one clock, with the cameras' own stamps instead of times of arrival",
        ),
    )
