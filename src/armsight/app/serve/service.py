"""The child process of a service: started, watched by what it publishes, replaced when it was lost; and its pages."""

from __future__ import annotations

import json
import logging
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

from armsight.app.interrupts import uninterrupted
from armsight.app.options import BOARD
from armsight.app.serve.config import ServeConfig
from armsight.app.show.http import Answer, Pages, metrics_text
from armsight.errors import InputError

#: s; a child without a shot for so long is started again; half: slow computers never begin, double: hangs last longer.
_BEGIN_S = 60.0
#: s; a child has so long to write its files; half: a slow disk loses a file, double: a hanging child delays the end.
_END_S = 10.0
#: s, between two looks at the child; half: nothing, double: a camera is back later.
_LOOK_S = 0.2
#: s; the first pause before the next try, doubled up to the file's retry_s; half: an attempt more, double: one less.
_PAUSE_S = 0.5
#: Lines of the child that are remembered; half, double: so much memory.
_LINES = 1000
#: What is started, before it is needed; a line of its input has the command and its options.
_ARMSIGHT = (sys.executable, "-P", "-m", "armsight.app.serve.child")
#: Lines of the child that only say that it goes on, and those that it also publishes.
_PROGRESS = re.compile(rf"[a-z ]+: \d+( of \d+)?$|{BOARD}")
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
    "board_up": ("gauge", "1 while the board is read"),
    "readings_total": ("counter", "joint readings of the board since the service began"),
    "board_losses_total": ("counter", "times that the board was lost"),
}


class Service:
    """Keeps `armsight measure` going."""

    def __init__(self, config: ServeConfig, report: Callable[[dict[str, Any]], None]) -> None:
        self._config, self._report = config, report
        self._log = _logger(config)
        self._child: subprocess.Popen[bytes] | None = None
        self._next: subprocess.Popen[bytes] | None = None  # imports, and waits
        self._lines, self._said = set[str](), set[str]()  # of this child, and of all during one loss
        self._last_line = ""
        self._began = self._newest = time.monotonic()
        self._lost_since: float | None = None
        self._why, self._tries = "starting", 0
        self._counts = {"shots_total": 0.0, "missed_total": 0.0, "losses_total": 0.0}
        self._values: dict[str, float] = {}
        self._board_lost: tuple[float, str] | None = None  # since when, and why
        if any(each.startswith("--board=") for each in config.arguments):
            self._counts |= {"readings_total": 0.0, "board_losses_total": 0.0}

    def run(self) -> int:
        """Keep the command going until it ends by itself; return its exit code, 0 or 3.

        Raises:
            InputError: something listens at the address of the pages, or the first start ended without a shot.
            KeyboardInterrupt: Ctrl-C or SIGTERM; the child has ended.
        """
        page = None if not self._config.http else state_pages(self._config.http, self.state, self.values)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
            heard.bind(("127.0.0.1", 0))
            heard.setblocking(False)
            try:
                if page is not None:
                    self._event("began", f"/healthz and /metrics on port {page.port}", port=page.port)
                pause = _PAUSE_S
                while True:
                    code = self._one(heard)
                    if code is not None and code in (0, 3):
                        self._event("ended", "armsight measure has ended", code=code)
                        return code
                    if code == 2 and not self._counts["shots_total"]:
                        raise InputError(self._last_line or "armsight measure ended without a shot")
                    pause = _PAUSE_S if self._lost_since is None else min(2 * pause, self._config.retry_s)
                    self._lost(self._last_line or f"armsight measure ended with {code}")
                    self._prepare()
                    time.sleep(pause)
            except KeyboardInterrupt:
                self._event("stopped", "stopped")
                raise
            finally:
                if self._next is not None:
                    self._next.kill()
                    self._next.communicate()
                if page is not None:
                    page.close()
                _close(self._log)

    def state(self) -> dict[str, Any]:
        """Return what /healthz shows."""
        now = time.monotonic()
        since, why = self._began if self._lost_since is None else self._lost_since, self._why
        if not why and self._board_lost is not None:
            since, why = self._board_lost
        return {
            "healthy": not why,
            "why": why or None,
            "for_s": round(now - since, 1),
            "shot_age_s": round(now - self._newest, 2) if self._counts["shots_total"] else None,
            "tries": self._tries,
        }

    def values(self) -> dict[str, float]:
        """Return what /metrics shows."""
        found = {"up": float(not self._why), **self._counts, **self._values}
        if self._counts["shots_total"]:
            found["shot_age_seconds"] = time.monotonic() - self._newest
        if "readings_total" in self._counts:
            found["board_up"] = float(self._board_lost is None)
        if (child := self._child) is not None:
            with suppress(OSError, IndexError):
                pages = int(Path(f"/proc/{child.pid}/statm").read_text().split()[1])
                found["process_resident_bytes"] = float(pages * os.sysconf("SC_PAGE_SIZE"))
        return found

    def _one(self, heard: socket.socket) -> int | None:
        """Start the child and listen to it until it ends or falls silent; return its exit code, None where it was ended."""
        arguments = ["measure", *self._config.started(), f"--stream=json+udp:127.0.0.1:{heard.getsockname()[1]}"]
        self._tries, self._last_line, self._lines = self._tries + 1, "", set()
        listener: threading.Thread | None = None
        try:
            if self._next is not None and self._next.poll() is not None:  # killed while it waited
                self._next.communicate()
                self._next = None
            self._prepare()
            self._child, self._next = self._next, None
            assert self._child is not None
            assert self._child.stdin is not None
            with suppress(BrokenPipeError), self._child.stdin as line:  # killed meanwhile: its code says so
                line.write(json.dumps(arguments).encode() + b"\n")
            listener = threading.Thread(target=self._listen, args=(self._child,), daemon=True)
            listener.start()
            code = self._heard(heard, self._child)
        finally:
            with uninterrupted():
                self._end()
            if listener is not None:
                listener.join()
        if code is None:
            self._last_line = f"no shot for {self._config.stale_s:.0f} s"
        return code

    def _heard(self, heard: socket.socket, child: subprocess.Popen[bytes]) -> int | None:
        """Take what the child publishes; return its exit code, None where it fell silent."""
        started, shots = time.monotonic(), self._counts["shots_total"]
        while (code := child.poll()) is None:
            select.select([heard], [], [], _LOOK_S)
            self._take_all(heard)
            began = self._counts["shots_total"] > shots
            limit_s, since = (self._config.stale_s, self._newest) if began else (_BEGIN_S, started)
            if time.monotonic() - since > limit_s:
                return None
            if began:
                self._prepare()
        self._take_all(heard)
        return code

    def _prepare(self) -> None:
        """Start the next child: it imports, and waits."""
        self._next = self._next or subprocess.Popen(
            _ARMSIGHT,
            cwd=self._config.folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # a terminal's Ctrl-C reaches it once, from here
        )

    def _take_all(self, heard: socket.socket) -> None:
        with suppress(BlockingIOError):
            while True:
                self._take(heard.recv(65536))

    def _take(self, datagram: bytes) -> None:
        """Take one published datum; what is none, from whoever sends to the port, is passed over."""
        try:
            datum = json.loads(datagram)
            if datum["kind"] == "joints":
                self._counts["readings_total"] += len(datum["t_s"])
            if datum["kind"] == "log" and datum["text"].startswith(BOARD):
                self._said_of_board(datum["text"], datum["level"])
            if datum["kind"] != "shot":
                return
            ok, age_s = datum["status"] == "ok", datum["age_s"]
            values = {} if age_s is None else {"latency_seconds": float(age_s)}
            if ok:
                values["sigma_metres"] = math.sqrt(sum(float(datum["covariance"][i][i]) for i in range(3)))
        except (ValueError, KeyError, TypeError, IndexError):
            return
        self._newest = time.monotonic()
        self._counts["shots_total"] += 1
        self._counts["missed_total"] += not ok
        self._values |= values
        if self._lost_since is not None:
            gone_s = self._newest - self._lost_since
            text = f"back after {gone_s:.1f} s (tries: {self._tries})"
            self._event("back", text, gone_s=round(gone_s, 2), tries=self._tries)
        elif self._why:
            self._event("measuring", "the first shot has arrived")
        if self._why:
            self._began, self._lost_since, self._why = self._newest, None, ""
            self._tries = 0

    def _said_of_board(self, text: str, level: str) -> None:
        """Log what the child says of its board; a loss once and where another reason shows, whichever child notices."""
        if level == "error":
            since, why = self._board_lost or (time.monotonic(), "")
            self._board_lost = since, text
            self._counts["board_losses_total"] += not why
            if text != why:
                self._event("board lost", text, why=text)
        elif level == "info" and self._board_lost is not None:
            gone_s = time.monotonic() - self._board_lost[0]
            self._board_lost = None
            self._event("board back", f"{BOARD}back after {gone_s:.1f} s", gone_s=round(gone_s, 2))
        elif level == "warning":
            self._log.info("%s", text)

    def _lost(self, why: str) -> None:
        """Say that the child was lost: once, and again where another reason shows."""
        if self._lost_since is None:
            self._lost_since, self._said = time.monotonic(), self._lines
            self._counts["losses_total"] += 1
        if why != self._why:
            self._why = why
            self._event("lost", f"lost: {why}; trying again", why=why)

    def _listen(self, child: subprocess.Popen[bytes]) -> None:
        """Log the lines of the child, each once during one loss; the last one says why it ended."""
        assert child.stderr is not None
        with child.stderr as lines:
            for data in lines:
                self._hear(data.decode(errors="replace").rstrip())

    def _hear(self, line: str) -> None:
        reason = line.removeprefix("armsight: error: ")
        self._last_line = reason or self._last_line
        if _PROGRESS.match(line) or (
            reason != line and not self._config.log
        ):  # the end or the loss is said on stderr, too
            return
        if self._lost_since is None or line not in self._said:
            self._log.info("measure: %s", line)
        for lines in (self._lines, self._said):
            if len(lines) > _LINES:
                lines.clear()
            lines.add(line)

    def _end(self) -> None:
        child = self._child
        if child is None or child.poll() is not None:
            return
        child.send_signal(signal.SIGTERM)
        try:
            child.wait(_END_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()

    def _event(self, event: str, text: str, **values: object) -> None:
        self._log.info("%s", text)
        self._report({"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values})


def _logger(config: ServeConfig) -> logging.Logger:
    """Return the log: a file that is begun anew when it is full, or stderr."""
    logger = logging.getLogger("armsight.serve")
    logging.raiseExceptions = False  # a full disk ends no service
    try:
        most = round(1e6 * config.log_mb)
        handler = (
            RotatingFileHandler(config.folder / config.log, maxBytes=most, backupCount=config.log_files)
            if config.log
            else logging.StreamHandler(sys.stderr)
        )
    except OSError as error:
        raise InputError(f"[serve] log {config.log}: cannot be written ({error.strerror})") from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%dT%H:%M:%S"))
    _close(logger)
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    return logger


def _close(logger: logging.Logger) -> None:
    for handler in logger.handlers[:]:
        logger.removeHandler(handler)
        with suppress(OSError):  # what a full disk did not take is lost
            handler.close()


def state_pages(address: str, state: Callable[[], dict[str, Any]], values: Callable[[], dict[str, float]]) -> Pages:
    """Serve both pages."""

    def healthz(_: dict[str, str]) -> Answer:
        now = state()
        return 200 if now["healthy"] else 503, "application/json", (json.dumps(now) + "\n").encode()

    def metrics(_: dict[str, str]) -> Answer:
        rows = {name: {"": value} for name, value in values().items()}
        return 200, "text/plain; version=0.0.4", metrics_text(METRICS, rows)

    return Pages(address, {"/healthz": healthz, "/metrics": metrics}, "[serve] http", open_to=True)
