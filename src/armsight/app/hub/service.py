"""A running hub: router, store and pages together, and one thread that owns what is known of the cells."""

from __future__ import annotations

import importlib.resources
import json
import math
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from armsight.app.hub.cells import LOOK_S, REJECTED_S, CellView, look_for_drifts, number, ranked
from armsight.app.hub.keys import HUB, site_of
from armsight.app.hub.router import Heard, Link, Router, parsed
from armsight.app.hub.sparkplug import Node, check_address
from armsight.app.hub.store import FLUSH_S, Store
from armsight.app.show.http import Answer, Pages, metrics_text
from armsight.app.stream.cell_file import STATE_S

#: s that an answer of /state is served to all who ask; half: thirty tabs cost twice, double: a second of age.
_STATE_S = STATE_S / 2
#: messages that wait at most; half: a burst of 200 cells is dropped, double: more memory.
_WAITING = 10_000
#: Gauge of a cell -> what the page shows of it, and its help; the labels are site and cell.
_GAUGES = {
    "cell_up": ("up", "1 while the cell is connected and sends its state"),
    "cell_need": ("level", "how much to look: -1 ended, 0 well, 1 look, 2 drifting, 3 finding, 4 lost"),
    "cell_error_millimetres": ("error_mm", "distance of the points from the body, RMS"),
    "cell_sigma_millimetres": ("sigma_mm", "standard deviation of the position"),
    "cell_rate_hertz": ("rate_hz", "shots a second"),
    "cell_missed_ratio": ("missed", "share of shots without a measurement"),
    "cell_temperature_celsius": ("temperature_c", "of the hottest motor"),
    "cell_clock_seconds": ("clock_s", "the cell's clock less the hub's"),
}
_OF_HUB = {"hub_events": ("gauge", "events"), "hub_dropped_total": ("counter", "states dropped: too many waited")}
#: s after which a cell that did not say who it is is asked again; half: nothing, double: its limit is missing longer.
_ASK_AGAIN_S = 10.0
#: Texts that a cell says of itself.
_TEXTS = ("armsight", "host", "mode", "arm", "body", "rig_made_utc")


class Hub:
    """Listens to the cells of a site, keeps what they send in a folder, and shows it.

    ``listen`` is the zenoh endpoint of cells, ``keys`` the folder of the site's keys (None: on this computer alone), and
    ``say`` is given a line for what a person should know at once. An InputError says which address is in use or not
    safe, or that nothing can be written.
    """

    def __init__(
        self,
        folder: Path,
        listen: str,
        http: str,
        keys: Path | None,
        say: Callable[[str], None],
        mqtt: str | None = None,
    ) -> None:
        if mqtt is not None:
            check_address(mqtt)
        self._say, self._cells = say, dict[tuple[str, str], CellView]()
        self._mqtt, self._nodes = mqtt, dict[str, Node]()
        self._heard: queue.Queue[Heard] = queue.Queue()
        self._dropped, self._problem = 0, ""
        self._site = None if keys is None else site_of(keys)[0]
        self._rejected, self._rejected_s, self._failed = 0, -math.inf, dict[str, str]()
        self._misnamed: dict[Link, bool] = {}  # whether it has been said
        self._lock = threading.Lock()  # of the cells
        self._cached = dict[bool, tuple[float, bytes]]()  # whether with the errors of a day -> when made, the answer
        self._asking = ThreadPoolExecutor(4, "ask")
        self._ended = threading.Event()
        page = importlib.resources.files(__package__).joinpath("page.html").read_bytes()
        routes: dict[str, Callable[[dict[str, str]], Answer]] = {
            "/": lambda _: (200, "text/html; charset=utf-8", page),
            "/state": self._state,
            "/events": self._events,
            "/image": partial(self._asked, "image", "image/jpeg"),
            "/shots": partial(self._asked, "shots", "application/json"),
            "/metrics": self._metrics,
        }
        with ExitStack() as opened:
            self._store = Store(folder)
            opened.callback(self._store.close)
            self._cells.update({(cell.site, cell.name): cell for cell in self._store.known()})
            self._router = Router(listen, keys, self._hear, self._stored)
            opened.callback(self._router.close)
            self.pages = Pages(http, routes, "--http")
            opened.pop_all()
        self._thread = threading.Thread(target=self._run, name="hub", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening, and write what waits."""
        self._router.close()
        self.pages.close()
        self._ended.set()
        self._thread.join(10.0)
        for site, node in self._nodes.items():
            self._try(f"MQTT of {site}", node.close)
        self._asking.shutdown(wait=False, cancel_futures=True)
        self._store.close()

    def rejected(self, why: str) -> None:
        """Say and keep that a connection was rejected, and how many were since the last time."""
        self._rejected += 1
        if time.monotonic() - self._rejected_s > REJECTED_S:
            self._reject(f"{self._rejected} connections rejected: no valid key of this site (the last: {why})")
            self._rejected, self._rejected_s = 0, time.monotonic()

    def _reject(self, text: str) -> None:
        now = time.time()
        if self._site is not None:
            self._say(text)
            event = {"n": 1, "kind": "rejected", "level": "warning", "text": text, "t": now}
            self._store.add_events(self._site, HUB, {"outbox": str(now), "events": [event]}, now)

    def _hear(self, heard: Heard) -> None:
        if heard[2] == "state" and self._heard.qsize() > _WAITING:  # another follows in a second; of tokens none does
            self._dropped += 1
        else:
            self._heard.put(heard)

    def _stored(self, site: str, cell: str, message: Any) -> int:  # noqa: ANN401 - whatever JSON holds
        """Store events; called in a thread of the router."""
        if n := self._store.add_events(site, cell, message, time.time()):
            ends = [e for e in message["events"] if isinstance(e, dict) and e.get("kind") in ("began", "ended")]
            for each in ends[-1:]:
                self._hear((site, cell, "command", time.time(), each))  # one that began after another ended goes on
        return n

    def _run(self) -> None:
        tasks = [
            (LOOK_S, "drifts and names are not looked for", self._look),
            (FLUSH_S, "history is not written", self._store.flush),
            (STATE_S, "nothing is sent to MQTT", self._publish),
        ]
        done = [time.monotonic()] * len(tasks)
        while not (self._ended.is_set() and self._heard.empty()):
            with suppress(queue.Empty):
                heard = self._heard.get(timeout=0.2)
                self._try(f"a message of {heard[0]}/{heard[1]} was not taken", self._take, heard)
            for k, (every_s, failed, task) in enumerate(tasks):
                if time.monotonic() - done[k] > every_s:
                    done[k] = time.monotonic()
                    self._try(failed, task)
            before, self._problem = self._problem, self._store.problem
            if self._problem and self._problem != before:
                self._say(self._problem)

    def _try(self, what: str, do: Callable[..., None], *given: object) -> None:
        """Do what must not end the hub where it fails; the same failure is said once until it succeeds."""
        try:
            do(*given)
            self._failed.pop(what, None)
        except Exception as error:  # noqa: BLE001
            why = f"{what}: {type(error).__name__}: {error}"
            if self._failed.get(what) != why:
                self._failed[what] = why
                self._say(why)

    def _publish(self) -> None:
        """Publish the cells as devices of a node a site."""
        for cell in self.snapshot()["cells"] if self._mqtt else []:
            site = cell["site"]
            if site not in self._nodes:
                self._nodes[site] = Node(site, str(self._mqtt), self._say)
            self._try(f"MQTT is without {site}/{cell['name']}", self._nodes[site].update, [cell])

    def _look(self) -> None:
        """Look for drifts, and reject whoever has the key of a cell and for a minute another name."""
        links = set(self._router.links())
        with self._lock:
            look_for_drifts(self._cells, time.time())
            wrong = {each for each in links if each[1] not in self._cells.get(each[0], CellView("", "")).sessions}
        for each in sorted(link for link in wrong if self._misnamed.get(link) is False):
            self._reject(f"{each[2]} has the key of {each[0][1]} and sends under another name: correct its cell.toml")
        self._misnamed = {link: link in self._misnamed for link in wrong}

    def _take(self, heard: Heard) -> None:
        (site, name, what, at_s, content), ask = heard, False
        with self._lock:
            cell = self._cells.setdefault((site, name), CellView(site, name))
            if what == "alive":
                session, came = content
                cell.token(session, came, at_s)
                ask = came
            elif what == "command":
                goes_on = content["kind"] == "began" or len(cell.sessions) > 1
                cell.end("" if goes_on else str(content.get("text") or "ended"), content.get("level"))
            else:
                before_s = cell.state_s
                if (row := cell.take(content, at_s)) is not None and at_s - before_s > _STATE_S:
                    self._store.add_state(cell, row)
                ask = not cell.about and at_s - cell.asked_s > _ASK_AGAIN_S
            if ask:
                cell.asked_s = at_s
                self._store.keep_about(cell)  # it is known after a restart, whether it answers or not
                self._asking.submit(self._ask_about, cell)

    def _ask_about(self, cell: CellView) -> None:
        """Ask a cell who it is."""
        about = parsed(self._router.ask(cell.site, cell.name, "about"))
        if isinstance(about, dict) and about:
            texts = {key: about[key][:200] for key in _TEXTS if isinstance(about.get(key), str)}
            numbers = {key: number(about.get(key)) for key in ("rig_heldout_mm", "limit_mm")}
            cell.about = {**texts, **numbers, "holds": about.get("holds") is True}
            self._store.keep_about(cell)

    def snapshot(self) -> dict[str, Any]:
        """Return what the page shows."""
        now = time.time()
        with self._lock:
            cells = ranked(list(self._cells.values()), now)
        of_hub = {"events": self._store.count(), "dropped": self._dropped, "problem": self._store.problem}
        return {"t": now, "cells": cells, **of_hub}

    def _state(self, query: dict[str, str]) -> Answer:
        made, data = self._cached.get(day := "day" in query, (0.0, b""))
        if time.monotonic() - made > _STATE_S:
            found = self.snapshot()
            for cell in [] if day else found["cells"]:  # of 200 cells 1 MB, which changes slowly
                del cell["day"]
            data = json.dumps(found).encode()
            self._cached[day] = time.monotonic(), data
        return 200, "application/json", data

    def _events(self, query: dict[str, str]) -> Answer:
        found = self._store.events(*(query.get(key, "") for key in ("q", "site", "cell")))
        return 200, "application/json", json.dumps(found).encode()

    def _asked(self, what: str, kind: str, query: dict[str, str]) -> Answer:
        """Return what a cell answers."""
        key = query.get("site", ""), query.get("cell", "")
        data = self._router.ask(*key, what) if key in self._cells else b""
        return (200, kind, data) if data else (404, "text/plain", b"no such cell is there, or it has none\n")

    def _metrics(self, _: dict[str, str]) -> Answer:
        found = self.snapshot()
        cells = {
            f'{{site="{each["site"]}",cell="{each["name"]}"}}': {**each["state"], **each} for each in found["cells"]
        }
        rows = {
            name: {labels: float(of[key]) for labels, of in cells.items() if of.get(key) is not None}
            for name, (key, _) in _GAUGES.items()
        }
        rows |= {"hub_events": {"": float(found["events"])}, "hub_dropped_total": {"": float(found["dropped"])}}
        kinds = {gauge: ("gauge", text) for gauge, (_, text) in _GAUGES.items()} | _OF_HUB
        return 200, "text/plain; version=0.0.4", metrics_text(kinds, rows)
