"""``/healthz`` and ``/metrics`` of a service, over HTTP."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from armsight.app.show.http import Answer, Pages, metrics_text

#: Metric -> its kind and what it is, as Prometheus shows it.
METRICS = {
    "up": ("gauge", "1 while shots arrive"),
    "shots_total": ("counter", "shots since the service began"),
    "missed_total": ("counter", "shots in which the target was not measured"),
    "losses_total": ("counter", "times that the cameras or the process were lost"),
    "shot_age_seconds": ("gauge", "time since the newest shot"),
    "latency_seconds": ("gauge", "time from the newest exposure to its pose"),
    "sigma_metres": ("gauge", "standard deviation of the newest position, root sum of squares of its axes"),
    "process_resident_bytes": ("gauge", "memory of the process that measures"),
}


def state_pages(address: str, state: Callable[[], dict[str, Any]], values: Callable[[], dict[str, float]]) -> Pages:
    """Serve both pages."""

    def healthz(_: dict[str, str]) -> Answer:
        now = state()
        return 200 if now["healthy"] else 503, "application/json", (json.dumps(now) + "\n").encode()

    def metrics(_: dict[str, str]) -> Answer:
        rows = {name: {"": value} for name, value in values().items()}
        return 200, "text/plain; version=0.0.4", metrics_text(METRICS, rows)

    return Pages(address, {"/healthz": healthz, "/metrics": metrics}, "[serve] http", open_to=True)
