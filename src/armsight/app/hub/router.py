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
from typing import Any, TextIO

from armsight.app.hub.keys import HUB, sign_hold, site_of
from armsight.app.stream.cell_file import ANSWER_S, LONGEST, Cell, endpoint, require_here, zenoh_config
from armsight.errors import InputError

_ALLOWED = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
#: Of zenoh's log: its colours, and why a TLS handshake failed; it says no address.
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_REJECTED = re.compile(r"zenoh_link_tls::unicast: (.+?)(?:\. Hint|$)")
#: What came from a cell: its site, its name, which of its keys, when (s), and the JSON; None of JSON: the token is
#: gone.
Heard = tuple[str, str, str, float, Any]
#: A connection with a cell's key: site and cell of the key, its session, and its address.
Link = tuple[tuple[str, str], str, str]


class Router:
    """Listens for cells.

    Args:
        listen: zenoh endpoint.
        keys: folder of the site's keys; None: on this computer alone, without TLS.
        heard: is given whatever comes, in threads of the library.
        stored: stores events of a cell and returns the number up to which they are; 0 where it failed.

    Raises:
        InputError: another computer could read it, the port is in use, or a certificate has ended.
    """

    def __init__(
        self,
        listen: str,
        keys: Path | None,
        heard: Callable[[Heard], None],
        stored: Callable[[str, str, Any], int],
    ) -> None:
        import zenoh

        self._heard, self._stored = heard, stored
        if keys is None:
            require_here(listen, "--listen")
            if listen.startswith("tls/"):
                raise InputError(f"--listen {listen} needs the keys of a site: --keys DIR (`armsight hub keys`)")
        elif not listen.startswith("tls/"):
            raise InputError(f"--listen {listen}: with --keys it is tls/HOST:PORT")
        config = zenoh_config("router", listen=listen, tls=None if keys is None else _tls(keys, "listen"))
        if keys is not None:
            config.insert_json5("access_control", json.dumps(_access(*site_of(keys))))
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
        with suppress(Exception):  # of the library: a cell that is gone
            for reply in self._session.get(f"armsight/{site}/{cell}/{what}", payload=payload, timeout=ANSWER_S):
                if reply.ok is not None and len(reply.ok.payload) < LONGEST:
                    return bytes(reply.ok.payload.to_bytes())
        return b""

    def links(self) -> list[Link]:
        """Return the connections that have the key of a cell."""
        named = [(each, str(each.auth_identifier or "").partition(".")) for each in self._session.info.links()]
        return [((n[0], n[2]), str(each.zid), each.dst) for each, n in named if n[2] not in ("", HUB)]

    def close(self) -> None:
        """Stop listening."""
        self._session.close()

    def _state(self, sample: Any) -> None:  # noqa: ANN401 - of the library
        _, site, cell, _ = str(sample.key_expr).split("/")
        self._heard((site, cell, "state", time.time(), parsed(sample.payload.to_bytes())))

    def _token(self, sample: Any) -> None:  # noqa: ANN401 - of the library
        _, site, cell, _, session = str(sample.key_expr).split("/")
        came = "PUT" in str(sample.kind)
        self._heard((site, cell, "alive", time.time(), (session, came)))

    def _events(self, query: Any) -> None:  # noqa: ANN401 - of the library
        _, site, cell, _ = str(query.key_expr).split("/")
        if (n := self._stored(site, cell, parsed(query.payload.to_bytes() if query.payload else b""))) > 0:
            query.reply(query.key_expr, str(n).encode())


def parsed(data: bytes) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return the JSON of a message, its texts those of UTF-8; a text that says why where it is none, or too long."""
    if len(data) > LONGEST:
        return f"a message of {len(data)} bytes: at most {LONGEST} are read"
    try:
        return json.loads(json.dumps(json.loads(data), ensure_ascii=False).encode(errors="replace"))
    except (ValueError, RecursionError):
        return "a message that is no JSON"


def _tls(keys: Path, way: str) -> dict[str, Any]:
    """Return zenoh's settings for the hub's own certificate; ``way``: listen or connect."""
    files = {"root_ca_certificate": "ca.pem", f"{way}_certificate": "hub.pem", f"{way}_private_key": "hub.key"}
    return {"enable_mtls": True, **{key: str(keys / name) for key, name in files.items()}}


def _access(site: str, cells: Sequence[str]) -> dict[str, Any]:
    """Return zenoh's access control: a cell below its own name, the hub's key to ask for a hold, whoever else nothing."""
    below: dict[str, tuple[str, tuple[str, ...]]] = {name: (f"armsight/{site}/{name}/**", _ALLOWED) for name in cells}
    below |= {"hub": (f"armsight/{site}/*/hold", ("query", "reply"))}
    both = ["ingress", "egress"]
    rules = [
        {"id": name, "permission": "allow", "messages": list(messages), "flows": both, "key_exprs": [key]}
        for name, (key, messages) in below.items()
    ]
    subjects = [{"id": name, "cert_common_names": [f"{site}.{name}"]} for name in below]
    policies = [{"rules": [name], "subjects": [name]} for name in below]
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def hold(keys: Path, cell: str, reason: str, address: str) -> str:
    """Ask a cell to hold; return its answer: ``held``, why not, or nothing where it did not answer.

    Args:
        keys: folder of the site's keys.
        cell: its name.
        reason: kept in the events of the cell.
        address: ``HOST:PORT`` at which cells connect to the hub.

    Raises:
        InputError: no keys, no such cell, or no hub answers there.
    """
    import zenoh

    site, cells = site_of(keys)
    if cell not in cells:
        raise InputError(f"{cell!r} is no cell of site {site}; it has {', '.join(cells) or 'none'}")
    try:
        session = zenoh.open(zenoh_config("client", endpoint(f"tls/{address}", "--hub"), tls=_tls(keys, "connect")))
    except zenoh.ZError:
        raise InputError(f"--hub {address}: no hub with the keys of {keys} answers there") from None
    with closing(session):
        topic = Cell(cell, site).topic("hold")
        for reply in session.get(topic, payload=sign_hold(keys, cell, reason), timeout=ANSWER_S):
            if reply.ok is not None:
                return str(reply.ok.payload.to_string())
    return ""


@contextmanager
def rejected(heard: Callable[[str], None]) -> Iterator[None]:
    """Hand on why connections are rejected within the block, in which nothing else may be printed.

    zenoh writes its log to the standard output of the process.

    Args:
        heard: is given the reason, in a thread of its own.
    """
    import zenoh

    zenoh.init_log_from_env_or("error,zenoh_link_tls=warn")
    sys.stdout.flush()
    reading, writing = os.pipe()
    before = os.dup(1)
    os.dup2(writing, 1)
    os.close(writing)
    thread = threading.Thread(target=_read, args=(os.fdopen(reading), heard), name="rejected", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(before, 1)  # the pipe has no other writer: its reader ends
        os.close(before)
        thread.join()


def _read(log: TextIO, heard: Callable[[str], None]) -> None:
    """Hand on the reasons; other lines go to standard error."""
    with log:
        for line in log:
            plain = _COLOUR.sub("", line)
            if (found := _REJECTED.search(plain.rstrip())) is not None:
                heard(found[1])
            else:
                sys.stderr.write(plain)
