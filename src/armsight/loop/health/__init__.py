"""Health of a measurement: whether what was calibrated still holds.

In: every measured pose, and what the estimator made of it. Out: :class:`HealthFinding` records, none while all is well:
what moved, since when, by how much and with which sigma, and what to do. The tests and their false-alarm rates:
docs/concepts/health.md.
"""

from armsight.loop.finding import HealthFinding, Trust, health_lines, unseen_lines
from armsight.loop.health.monitor import HealthMonitor

__all__ = ["HealthFinding", "HealthMonitor", "Trust", "health_lines", "unseen_lines"]
