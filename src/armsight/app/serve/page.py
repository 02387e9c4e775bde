"""``/healthz`` and ``/metrics`` of a service, over HTTP."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from armsight.errors import InputError

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


def metrics_text(values: dict[str, float]) -> str:
    """Return values by name in Prometheus' text format; those that are not known are left out."""
    lines = []
    for name, (kind, text) in METRICS.items():
        if (value := values.get(name)) is not None:
            lines += [
                f"# HELP armsight_{name} {text}",
                f"# TYPE armsight_{name} {kind}",
                f"armsight_{name} {value:.9g}",
            ]
    return "\n".join(lines) + "\n"


class StatePage:
    """Serves both pages in threads of its own.

    Args:
        address: ``host:port``; port 0 is any that is free.
        state: returns the state; ``healthy`` is in it.
        values: returns the metrics.

    Raises:
        InputError: it is no address, or something listens there already.
    """

    def __init__(
        self, address: str, state: Callable[[], dict[str, Any]], values: Callable[[], dict[str, float]]
    ) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise InputError(f"[serve] http is {address!r}: expected HOST:PORT, such as 127.0.0.1:9110")

        class Handler(BaseHTTPRequestHandler):
            timeout = 5

            def do_GET(self) -> None:
                if self.path == "/healthz":
                    now = state()
                    self._answer(200 if now["healthy"] else 503, "application/json", json.dumps(now) + "\n")
                elif self.path == "/metrics":
                    self._answer(200, "text/plain; version=0.0.4", metrics_text(values()))
                else:
                    self._answer(404, "text/plain", "/healthz and /metrics are here\n")

            def _answer(self, code: int, kind: str, text: str) -> None:
                data = text.encode()
                self.send_response(code)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, format: str, *arguments: object) -> None:
                """Log no request."""

        try:
            self._server = ThreadingHTTPServer((host, int(port)), Handler)
        except OSError as error:
            raise InputError(
                f"[serve] http {address}: cannot listen there ({error.strerror}): does another service run?"
            ) from None
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
