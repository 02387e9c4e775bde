"""The zenoh side of a hub: a router that cells connect to, what each of them may write, and what comes from them.

With the keys of a site a cell may write below its own name alone: zenoh's access control compares the name in its
certificate.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh

from armsight.app.hub.keys import HUB, sign_hold, site_of
from armsight.app.stream.cell_file import ANSWER_S, LONGEST, NAME, Cell, endpoint, require_here, zenoh_config
from armsight.errors import InputError
from armsight.files import as_input_error

#: The site's certificate, and the hub's own and its key.
_FILES = ("ca.pem", "hub.pem", "hub.key")
_ALLOWED = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
#: Of zenoh's log: its colours, and why a TLS handshake failed; it says no address.
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_REJECTED = re.compile(r"zenoh_link_tls::unicast: (.+?)(?:\. Hint|$)")
#: What came from a cell: its site, its name, of what kind, when (s), and the JSON, or session and whether it came.
Heard = tuple[str, str, str, float, Any]
#: A connection with a cell's key: site and cell of the key, its session, and its address.
Link = tuple[tuple[str, str], str, str]


class Router:
    """Listens for cells; without keys on this computer alone.

    In threads of the library ``heard`` is given whatever comes, and ``stored`` stores events of a cell and returns the
    number up to which they are; 0 where it failed. An InputError says that another computer could read what is sent,
    that the port is in use, or that a certificate has ended.
    """

    def __init__(
        self, listen: str, keys: Path | None, heard: Callable[[Heard], None], stored: Callable[[str, str, Any], int]
    ) -> None:
        self._heard, self._stored = heard, stored
        if keys is None:
            require_here(listen, "--listen")
            if listen.startswith("tls/"):
                raise InputError(f"--listen {listen} needs the keys of a site: --keys DIR (`armsight hub keys`)")
            config = zenoh_config("router", listen)
        elif listen.startswith("tls/"):
            access = _access(*site_of(keys))
            config = zenoh_config("router", listen, [keys / name for name in _FILES])
            config.insert_json5("access_control", json.dumps(access))
        else:
            raise InputError(f"--listen {listen}: with --keys it is tls/HOST:PORT")
        try:
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            why = str(error).split(" at /")[0]
            raise InputError(f"--listen {listen}: cannot listen there ({why}): is another hub running?") from None
        states = self._session.declare_subscriber("armsight/*/*/state", self._state)
        events = self._session.declare_queryable("armsight/*/*/events", self._events)
        tokens = self._session.liveliness().declare_subscriber("armsight/*/*/alive/*", self._token, history=True)
        self._declared = (states, events, tokens)

    def ask(self, site: str, cell: str, what: str, payload: bytes = b"") -> bytes:
        """Ask a cell for something, and return its answer; empty where it does not answer."""
        return _answer(self._session, f"armsight/{site}/{cell}/{what}", payload)

    def links(self) -> list[Link]:
        """Return the connections that have the key of a cell."""
        named = [(each, str(each.auth_identifier or "").partition(".")) for each in self._session.info.links()]
        return [((n[0], n[2]), str(each.zid), each.dst) for each, n in named if n[2] not in ("", HUB)]

    def close(self) -> None:
        """Stop listening."""
        self._session.close()

    def _state(self, sample: Any) -> None:  # noqa: ANN401 - of the library
        if cell := _cell_of(sample):
            self._heard((*cell, "state", time.time(), parsed(sample.payload.to_bytes())))

    def _token(self, sample: Any) -> None:  # noqa: ANN401 - of the library
        if cell := _cell_of(sample):
            session, came = str(sample.key_expr).rpartition("/")[2], "PUT" in str(sample.kind)
            self._heard((*cell, "alive", time.time(), (session, came)))

    def _events(self, query: Any) -> None:  # noqa: ANN401 - of the library
        message = parsed(query.payload.to_bytes() if query.payload else b"")
        if (cell := _cell_of(query)) and (n := self._stored(*cell, message)) > 0:
            query.reply(query.key_expr, str(n).encode())


def _cell_of(message: Any) -> tuple[str, str] | None:  # noqa: ANN401 - of the library
    """Return site and cell of a message; None where they are no names."""
    _, site, cell, *_ = str(message.key_expr).split("/")
    return (site, cell) if NAME.fullmatch(site) and NAME.fullmatch(cell) else None


def _answer(session: Any, key: str, payload: bytes) -> bytes:  # noqa: ANN401 - of the library
    with suppress(Exception):  # of the library: a cell that is gone
        for reply in session.get(key, payload=payload, timeout=ANSWER_S):
            if reply.ok is not None and len(reply.ok.payload) < LONGEST:
                return bytes(reply.ok.payload.to_bytes())
    return b""


def parsed(data: bytes) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return the JSON of a message, its texts those of UTF-8; a text that says why where it is none, or too long."""
    if len(data) > LONGEST:
        return f"a message of {len(data)} bytes: at most {LONGEST} are read"
    try:
        return json.loads(json.dumps(json.loads(data), ensure_ascii=False).encode(errors="replace"))
    except (ValueError, RecursionError):
        return "a message that is no JSON"


def _access(site: str, cells: Sequence[str]) -> dict[str, Any]:
    """Return zenoh's access control: a cell below its own name, the hub's key to ask for a hold, whoever else nothing."""
    below = [(name, f"{name}/**", _ALLOWED) for name in cells] + [(HUB, "*/hold", ("query", "reply"))]
    rules = [
        {"id": name, "permission": "allow", "messages": messages, "flows": ["ingress", "egress"],
         "key_exprs": [f"armsight/{site}/{keys}"]}
        for name, keys, messages in below
    ]  # fmt: skip
    subjects = [{"id": name, "cert_common_names": [f"{site}.{name}"]} for name, *_ in below]
    policies = [{"rules": [name], "subjects": [name]} for name, *_ in below]
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def hold(keys: Path, cell: str, reason: str, address: str) -> str:
    """Ask a cell to hold, for a reason; return its answer: ``held``, why not, or nothing where it did not answer.

    ``address`` is HOST:PORT at which cells connect to the hub. An InputError says that no keys, no such cell or no hub
    are there.
    """
    site, cells = site_of(keys)
    if cell not in cells:
        raise InputError(f"{cell!r} is no cell of site {site}; it has {', '.join(cells) or 'none'}")
    with as_input_error(f"--hub {address}: no hub with the keys of {keys} answers there", zenoh.ZError):
        session = zenoh.open(
            zenoh_config("client", endpoint(f"tls/{address}", "--hub"), [keys / name for name in _FILES])
        )
    with closing(session):
        return _answer(session, Cell(cell, site).topic("hold"), sign_hold(keys, cell, reason)).decode()


@contextmanager
def rejected(heard: Callable[[str], None]) -> Iterator[None]:
    """Hand on, in a thread, why connections are rejected within the block, in which nothing else may be printed.

    zenoh writes its log to the standard output of the process.
    """
    zenoh.init_log_from_env_or("error,zenoh_link_tls=warn")
    sys.stdout.flush()
    reading, writing = os.pipe()
    before = os.dup(1)
    os.dup2(writing, 1)
    os.close(writing)

    def read() -> None:
        """Hand on the reasons; other lines go to standard error."""
        with os.fdopen(reading) as log:
            for line in log:
                plain = _COLOUR.sub("", line)
                if (found := _REJECTED.search(plain.rstrip())) is not None:
                    heard(found[1])
                else:
                    sys.stderr.write(plain)

    thread = threading.Thread(target=read, name="rejected", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(before, 1)  # the pipe has no other writer: its reader ends
        os.close(before)
        thread.join()
