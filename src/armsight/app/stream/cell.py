"""What a cell sends to the hub of its site: who it is, its state once a second, its events, an image on request.

The keys are ``armsight/SITE/CELL/...`` (docs/howto/cells.md): ``alive`` a liveliness token; ``about``, ``image``,
``shots`` and ``hold`` are answered; ``state`` is put; ``events`` are asked to be stored, until the hub answers up to
which number they are. The cell never waits for the hub; without one only the events are kept.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import click
import numpy as np

from armsight.app.show.encode import jpeg
from armsight.app.show.messages import say
from armsight.app.stream.cell_file import ANSWER_S, LONGEST, STATE_S, Cell, is_signed, read_cell, zenoh_config
from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.outbox import Outbox, state_folder
from armsight.app.stream.sink import CLOSE_S, Sink
from armsight.data import Array, PoseEstimate, Shot
from armsight.errors import InputError
from armsight.files import as_input_error
from armsight.loop.running.data import Datum, NoteDatum, ShotDatum
from armsight.vision.rig import StereoRig

#: s, between two looks whether events wait or a hub can be reached; half: nothing, double: events come later.
_POST_S = 0.25
#: s, between two shots whose geometry is looked at: 0.2 ms each; half: twice the time, double: a drift shows later.
_LOOK_S = 0.1
#: bytes of events sent at once; half: more round trips after a long loss, double: more than a hub reads.
_BATCH_BYTES = 3 * LONGEST // 4
#: s that a reached hub may store nothing before that is said; half: said while a hub begins, double: said later.
_UNHEARD_S = 10.0
#: s that the last events may take at the end; half: a slow network gets them later, double: a dead hub delays the end.
_END_S = 0.5
#: s, from a request to hold to its arrival; half: clocks must agree better, double: an old request counts longer.
_FRESH_S = 60.0
#: px, longer side of an image for the hub, and JPEG quality; half: a rough look, double: four times the bytes (15 kB).
_SIDE_PX, _JPEG = 480, 70
#: s between two shots that are kept for who asks, how many are (7 kB each), and for how many s after a question; half:
#: gaps where a page asks once a second, double: twice the work while somebody looks.
_SHOT_S, _SHOTS, _ASKED_S = 0.2, 5, 10.0
_FINDINGS = 5  # that a state names at most; half: less is seen at once, double: a state of 2 kB
#: Times the rig's held-out error that is a limit; half: good cells are yellow, double: bad ones are not.
_LIMIT = 3.0


@dataclass
class _Window:
    """What the shots between two states showed."""

    shots: int = 0
    missed: int = 0
    residual_m: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    tilt_rad: list[float] = field(default_factory=list)
    size: list[float] = field(default_factory=list)

    def state(self) -> dict[str, float | None]:
        """Return the numbers of a state; null where no shot showed one."""
        return {
            "missed": self.missed / self.shots if self.shots else None,
            "error_mm": _mean(np.square(self.residual_m), 1e3, root=True),
            "sigma_mm": _mean(np.square(self.sigma_m), 1e3, root=True),
            "tilt_mdeg": _mean(np.degrees(self.tilt_rad), 1e3),
            "size_ppm": _mean(np.array(self.size), 1e6),
        }


def _mean(values: Array, unit: float, *, root: bool = False) -> float | None:
    if not len(values):
        return None
    mean = float(np.mean(values))
    return float(f"{unit * (math.sqrt(mean) if root else mean):.6g}")


def tilt_and_size(rig: StereoRig, points: Array, pose: PoseEstimate) -> tuple[float, float]:
    """Return what one pose shows of its rig: a rotation of one camera changes one of the two.

    The mean signed angle of the left rays out of the plane of baseline and right ray, rad, and the size of the
    triangulated body over its drawing ``points`` (M, 3), m, less one.
    """
    seen = pose.points.seen
    uv = seen.uv[seen.paired]
    left, right = rig.left.unproject(uv[:, 0]), rig.right.unproject(uv[:, 1])
    normal = np.cross(rig.T_left_right[:3, 3], right @ rig.T_left_right[:3, :3].T)
    angles = (left * normal).sum(1) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(left, axis=1))
    found, drawn = pose.points.p_left, points[pose.points.ids]
    spread = [float(np.linalg.norm(each - each.mean(0))) for each in (found, drawn)]
    return float(angles.mean()), spread[0] / spread[1] - 1.0


class CellSink(Sink):
    """Sends what a command measures to the hub of its site."""

    def __init__(self, cell: Cell, published: Published, mode: str) -> None:
        super().__init__(wakes=256)
        self._config = zenoh_config("client", cell.router, (cell.ca, cell.certificate, cell.key))
        self._cell, self._published, self._mode = cell, published, mode
        self._outbox = Outbox(state_folder() / "cells" / cell.site / cell.name, cell.name)
        self._lock = threading.Lock()  # of the outbox: this thread adds, the other one sends
        self._window, self._shots, self._dropped, self._findings = _Window(), 0, 0, tuple[str, ...]()
        self._began = self._state_at = time.monotonic()
        self._looked = 0.0
        self._newest: Shot | None = None
        self._asked_s, self._kept = -math.inf, deque[tuple[float, bytes]](maxlen=_SHOTS)
        self._held, self._began_utc = set[float](), time.time()
        self._exit: tuple[int, str] | None = None
        self._exited = threading.Event()  # whether nothing more is to be heard of how the command ends
        self._exited.set()
        self._session: Any = None
        self._declared: list[Any] = []
        self._answering: list[threading.Thread] = []
        self._ending, self._end_at = threading.Event(), math.inf
        self._post = threading.Thread(target=self._posting, name="cell", daemon=True)

    def start(self) -> None:
        """Start the threads."""
        self._event("began", "info", f"armsight {self._mode} began")
        self._post.start()
        super().start()

    def stay(self) -> Callable[[int, str], None]:
        """Stay beyond :meth:`close`, until what is returned is called with the exit code, and what is wrong."""
        self._exited.clear()
        self._close_s = 0.0

        def end(code: int, wrong: str) -> None:
            self._exit, self._close_s = (code, wrong), CLOSE_S
            self._exited.set()
            self.close()

        return end

    def write(self, datum: Datum) -> None:
        """Count a shot, or keep an event."""
        if isinstance(datum, NoteDatum):
            if datum.findings is not None:
                self._findings = datum.findings
            if datum.level != "info" or datum.findings is not None:
                self._event("health", datum.level, datum.text)
        elif isinstance(datum, ShotDatum):
            self._shots += 1
            self._window.shots += 1
            self._newest, now = datum.shot, time.monotonic()
            if now - self._asked_s < _ASKED_S and not (self._kept and now - self._kept[-1][0] < _SHOT_S):
                self._kept.append((now, json_text(datum.to_json(self._published.body))))
            if isinstance(datum.result, PoseEstimate):
                self._measured(datum.result)
            elif datum.result is not None or datum.shot.problem is not None:
                self._window.missed += 1

    def _measured(self, pose: PoseEstimate) -> None:
        window, rig, now = self._window, self._published.rig, time.monotonic()
        window.residual_m.append(pose.residual_rms_m)
        window.sigma_m.append(math.sqrt(np.trace(pose.cov[:3, :3])))
        if rig is not None and now - self._looked > _LOOK_S and pose.points.seen.paired.sum() > 1:
            self._looked = now
            tilt, size = tilt_and_size(rig, self._published.body.points, pose)
            window.tilt_rad.append(tilt)
            window.size.append(size)

    def tick(self) -> None:
        """Put the state once a second."""
        if time.monotonic() - self._state_at >= STATE_S:
            self._put_state()

    def _put_state(self) -> None:
        now, window, motors = time.monotonic(), self._window, self._published.temperatures_c
        celsius = None if motors is None else motors()
        state: dict[str, Any] = {"t": round(time.time(), 3), "mode": self._mode, "shots": self._shots}
        state |= window.state()
        state["rate_hz"] = round(window.shots / max(now - self._state_at, 1e-3), 2)
        state["temperature_c"] = None if celsius is None else round(float(celsius.max()), 1)
        state["health"] = [each[:300] for each in self._findings[:_FINDINGS]]
        self._window, self._state_at = _Window(), now
        if self._session is not None:
            # No declared publisher: with access control it would drop all (zenoh 1.10; findings/zenoh_acl_subscriber.sh).
            with suppress(Exception):  # a session that is being lost; the next state comes in a second
                self._session.put(self._cell.topic("state"), json_text(state))

    def finish(self) -> None:
        """Say how the command ended, send what waits, and leave."""
        while not self._exited.wait(STATE_S):
            self._put_state()
        text, level = f"armsight {self._mode} ended after {self._shots} shots", "info"
        if self._exit is not None:
            code, wrong = self._exit
            text += f" with exit code {code}" + (f": {wrong}" if wrong else "")
            level = "info" if code in (0, 130) else "warning"
        self._event("ended", level, text)
        self._end_at = time.monotonic() + _END_S
        self._ending.set()
        self._post.join()  # it waits for zenoh a second or two; a thread in a library when Python ends aborts the process
        self._put_state()
        if self._session is not None:
            with suppress(Exception):
                self._session.close()
            for each in self._answering:
                each.join(_END_S)
        with self._lock:
            self._outbox.close()

    def _event(self, kind: str, level: str, text: str) -> None:
        with self._lock:
            event = {"t": round(time.time(), 3), "kind": kind, "level": level, "text": text[:2000]}
            self._outbox.thinned += self.dropped - self._dropped
            self._dropped = self.dropped
            self._outbox.add(event, thin=kind == "health")

    def about(self) -> dict[str, Any]:
        """Return who the cell is."""
        rig, arm = self._published.rig, self._published.arm
        heldout = None if rig is None else rig.provenance.get("heldout_rigid_rms_m")
        heldout_mm = 1e3 * heldout if isinstance(heldout, int | float) else None
        version = importlib.metadata.version("armsight")
        found: dict[str, Any] = {"armsight": version, "host": socket.gethostname(), "mode": self._mode}
        found |= {"arm": None if arm is None else arm.name, "body": self._published.body.name or None}
        found |= {"rig_made_utc": None if rig is None else rig.provenance.get("made_utc"), "holds": self._cell.holds}
        for name, times in (("rig_heldout_mm", 1.0), ("limit_mm", _LIMIT)):
            found[name] = None if heldout_mm is None else round(times * heldout_mm, 4)
        return {**found, "alive_s": round(time.monotonic() - self._began, 1)}

    def _posting(self) -> None:
        unheard_s, notes = math.inf, set[str]()

        def note(text: str) -> None:
            if text not in notes:
                notes.add(text)
                say(f"note: --stream cell:{self._cell.name}: {text}; its events are kept and sent later")

        while True:
            ending = self._ending.wait(_POST_S)
            if self._session is None and not (ending and notes):
                try:
                    self._open()
                except Exception:  # noqa: BLE001 - of the library: whatever it is, it is tried again
                    note(f"no hub answers at {self._cell.router}")
            if self._session is not None:
                heard = self._send_events() or not self._session.info.routers_zid()
                unheard_s = math.inf if heard else min(unheard_s, time.monotonic())
                if time.monotonic() - unheard_s > _UNHEARD_S:
                    why = "" if self._cell.ca is None else "its certificate is of another name, or "
                    note(f"the hub stores no events of it: {why}the hub is busy, or its disk full")
            if ending:
                return

    def _open(self) -> None:
        import zenoh

        session, before = zenoh.open(self._config), threading.enumerate()
        topic = self._cell.topic
        answers: dict[str, Callable[[Any], bytes]] = {"about": lambda _: json_text(self.about()), "hold": self._hold}
        answers |= {"image": lambda _: self._image(), "shots": lambda _: self._shots_kept()}
        declared = list[Any]()
        for name, answer in answers.items():
            reply = partial(lambda at, answer, query: query.reply(at, answer(query)), topic(name), answer)
            declared.append(session.declare_queryable(topic(name), reply))
        self._declared = [*declared, session.liveliness().declare_token(topic("alive", str(session.zid())))]
        # Threads that answer; they are daemons as this one is, so that Python does not wait for them by itself.
        self._answering = [each for each in threading.enumerate() if each not in before]
        self._session = session

    def _send_events(self) -> bool:
        """Have waiting events stored, oldest first, while there is time; False: the hub does not answer."""
        while True:
            with self._lock:
                events = self._outbox.waiting(_BATCH_BYTES)
            if not events:
                return True
            content = json_text({"outbox": self._outbox.name, "events": events})
            stored = 0
            with suppress(Exception):  # no hub, or none that answers: they are sent again
                for reply in self._session.get(
                    self._cell.topic("events"), payload=content, timeout=_END_S if self._ending.is_set() else ANSWER_S
                ):
                    stored = int(reply.ok.payload.to_string()) if reply.ok is not None else stored
            if not stored:
                return False
            with self._lock:
                self._outbox.confirm(stored)
            if time.monotonic() > self._end_at:
                return True

    def _image(self) -> bytes:
        shot = self._newest
        return b"" if shot is None or shot.left is None else jpeg(shot.left, _SIDE_PX, _JPEG)

    def _shots_kept(self) -> bytes:
        """Return the newest shots that a hub reads, as JSON, thinned; none are kept unless they are asked for."""
        self._asked_s = time.monotonic()
        shots = [shot for at_s, shot in list(self._kept) if self._asked_s - at_s < _ASKED_S]
        while sum(len(shot) + 1 for shot in shots) >= LONGEST - 1:
            del shots[0]
        return b"[" + b",".join(shots) + b"]"

    def _hold(self, query: Any) -> bytes:  # noqa: ANN401 - of the library
        try:
            text = self._checked_hold(query.payload.to_bytes() if query.payload is not None else b"")
            assert self._published.hold is not None
            self._published.hold(f"the hub asked to hold: {text}")
            self._event("hold", "warning", f"the hub asked to hold: {text}")
        except InputError as error:
            self._event("hold", "warning", f"a request to hold was rejected: {error}")
            return f"rejected: {error}".encode()
        return b"held"

    def _checked_hold(self, payload: bytes) -> str:
        """Return the text of a request to hold; an InputError says that it is not allowed, not signed or not new."""
        if not self._cell.holds or self._cell.ca is None:
            raise InputError("this cell does not allow it: holds = true and ca in its cell.toml would")
        if self._published.hold is None:
            raise InputError(f"armsight {self._mode} moves no arm")
        with as_input_error("it is no request to hold", ValueError, KeyError, TypeError):
            request = json.loads(payload)
            t, text, signature = float(request["t"]), str(request["text"]), bytes.fromhex(request["signature"])
        if not is_signed(self._cell, t, text, signature):
            raise InputError("it is not signed by the key of this site")
        if not abs(time.time() - t) < _FRESH_S or t < self._began_utc:
            raise InputError(f"it is of {t - time.time():+.0f} s by this cell's clock: it is old, or a clock is wrong")
        if t in self._held:
            raise InputError("it was done before")
        self._held.add(t)
        return text[:200]


def open_cell(rest: str, published: Published) -> CellSink:
    """Open ``NAME[@ROUTER]`` or a cell.toml; in a command of the command line it stays until the exit code is known."""
    sink = CellSink(read_cell(rest), published, published.properties.get("command", "python"))
    context = click.get_current_context(silent=True)
    if context is not None and isinstance(context.obj, list):
        context.obj.append(sink.stay())
    return sink
