"""Who a cell is: ``NAME[@ROUTER]`` or a cell.toml in, a :class:`Cell` out; and what zenoh sessions have in common.

A cell is one rig with what it measures; a site is where one hub is. Keys are ``armsight/SITE/CELL/...``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armsight.app.show.messages import require
from armsight.errors import InputError
from armsight.files import as_input_error, read_bytes, read_toml

if TYPE_CHECKING:
    from cryptography import x509

#: The router of a hub on this computer.
ROUTER = "tcp/127.0.0.1:7447"
#: s, between two states of a cell; half: twice the network, double: a loss shows a second later.
STATE_S = 1.0
#: s that hub and cell wait for an answer; half: a slow network or a busy disk gives none, double: a click waits longer.
ANSWER_S = 2.0
#: bytes of a state, or of events, that are read at most; half: long findings are rejected, double: a wrong cell costs
#: more memory.
LONGEST = 65536
#: Names of sites and cells: they are parts of keys, folders and certificates.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,30}")
_ENDPOINT = re.compile(r"(?:(tcp|tls)/)?(\[[0-9a-fA-F:]+\]|[\w.-]+):(\d{1,5})")
_HERE = ("127.0.0.1", "localhost", "[::1]")
_FILES = ("ca", "certificate", "key")
_NEW = "new folder: `armsight hub keys SITE CELL ... -o FOLDER`"


@dataclass(frozen=True)
class Cell:
    """Who a cell is."""

    name: str  #: of the cell
    site: str = "site"  #: of the site
    router: str = ROUTER  #: zenoh endpoint of the hub, ``tls/HOST:PORT``
    ca: Path | None = None  #: certificate of the site, PEM; None without TLS
    certificate: Path | None = None  #: of the cell, PEM
    key: Path | None = None  #: its private key, PEM
    holds: bool = False  #: whether the hub may ask it to hold its arm

    def topic(self, *parts: str) -> str:
        """Return a key of the cell."""
        return "/".join(["armsight", self.site, self.name, *parts])


def read_cell(spec: str) -> Cell:
    """Read ``NAME[@ROUTER]`` or the path of a cell.toml; an InputError says what is wrong with it."""
    if spec.endswith(".toml"):
        return _from_file(Path(spec).expanduser())
    name, _, router = spec.partition("@")
    where = f"--stream cell:{spec}"
    return _checked(Cell(name, router=endpoint(router, where) if router else ROUTER), where)


def _from_file(path: Path) -> Cell:
    given = read_toml(path)
    texts = {"name", "site", "router", *_FILES}
    if unknown := sorted(given.keys() - texts - {"holds"}):
        raise InputError(f"{path}: unknown key {unknown[0]!r}; known are {', '.join(sorted({*texts, 'holds'}))}")
    for key, kind in [*((key, str) for key in sorted(texts)), ("holds", bool)]:
        if key in given and not isinstance(given[key], kind):
            expected = "true or false" if kind is bool else "a text"
            raise InputError(f"{path}: {key} is {given[key]!r}: expected {expected}")
    if "name" not in given:
        raise InputError(f"{path}: the key name is missing: what is this cell called?")
    for key in _FILES:
        if key in given:
            given[key] = path.parent / given[key]
            if not given[key].is_file():
                raise InputError(f"{path}: {key}: {given[key]} is not there; `armsight hub keys` makes it")
    if "router" in given:
        given["router"] = endpoint(given["router"], str(path))
    return _checked(Cell(**given), str(path))


def _checked(cell: Cell, where: str) -> Cell:
    for what, name in (("cell", cell.name), ("site", cell.site)):
        check_name(name, f"{where}: the {what}'s name")
    if cell.router.startswith("tls/"):
        if cell.ca is None or cell.certificate is None or cell.key is None:
            needed = "ca, certificate and key in a cell.toml; `armsight hub keys` makes it"
            raise InputError(f"{where}: {cell.router} needs {needed}")
        for path in (cell.ca, cell.certificate):
            certificate(path)
    require_here(cell.router, where)
    return cell


def check_name(name: str, what: str) -> None:
    """Raise an InputError where a name of a site or a cell cannot be part of a key."""
    if not NAME.fullmatch(name):
        raise InputError(f"{what} is {name!r}: expected up to 31 letters, digits, - and _, such as table-3")


def endpoint(text: str, where: str) -> str:
    """Return ``[tcp/|tls/]HOST:PORT`` as zenoh writes it, or raise an InputError."""
    match = _ENDPOINT.fullmatch(text)
    if match is None or not 0 < int(match[3]) <= 65535:
        raise InputError(f"{where}: {text!r} is no address of a hub: expected HOST:PORT or tls/HOST:PORT")
    return f"{match[1] or 'tcp'}/{match[2]}:{match[3]}"


def require_here(router: str, where: str) -> None:
    """Raise an InputError where data would leave this computer without TLS."""
    if router.startswith("tcp/") and router.removeprefix("tcp/").rpartition(":")[0] not in _HERE:
        readable = "tcp is readable by all between: use tls/ (armsight hub keys)"
        raise InputError(f"{where}: {router} is another computer, and {readable}")


def certificate(path: Path, *, ended: bool = False) -> x509.Certificate:
    """Return the certificate in a PEM file; an InputError: there is none, or it is not valid; ``ended``: has ended."""
    require("a cell with keys", "cells", "cryptography")
    from cryptography import x509

    with as_input_error(f"{path}: no certificate is in it: make the keys in a {_NEW}", ValueError):
        found = x509.load_pem_x509_certificate(read_bytes(path))
    begin, end, now = found.not_valid_before_utc, found.not_valid_after_utc, datetime.now(UTC)
    if not (ended or begin <= now <= end):
        again = f"make the keys in a {_NEW}" if found.issuer == found.subject else "run `armsight hub keys` again"
        days = f"valid from {begin.date()} to {end.date()}, and this computer's date is {now.date()}"
        raise InputError(f"{path}: {days}: correct the date, or {again}")
    return found


def is_signed(cell: Cell, t: float, text: str, signature: bytes) -> bool:
    """Whether the key of the site's certificate signed a request to hold."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    assert cell.ca is not None
    public = certificate(cell.ca, ended=True).public_key()
    try:
        assert isinstance(public, ec.EllipticCurvePublicKey)
        public.verify(signature, hold_bytes(cell.site, cell.name, t, text), ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        return False
    return True


def hold_bytes(site: str, cell: str, t: float, text: str) -> bytes:
    """Return what is signed in a request to hold."""
    return json.dumps(["armsight hold", site, cell, t, text]).encode()


def zenoh_config(mode: str, end: str, keys: Sequence[Path | None] = (None,)) -> Any:  # noqa: ANN401 - of the library
    """Return the configuration of a zenoh client, which connects within a second, or router; it seeks nobody by itself.

    ``keys``: files of the site's certificate, the own one and its key; without TLS the first is None.
    """
    require("a cell", "cells", "zenoh")
    import zenoh

    config, way = zenoh.Config(), {"client": "connect", "router": "listen"}[mode]
    settings: dict[str, Any] = {f"scouting/{kind}/enabled": False for kind in ("multicast", "gossip")}
    settings |= {"mode": mode, "connect/timeout_ms": 1000, "listen/endpoints": [], f"{way}/endpoints": [end]}
    if keys[0] is not None:
        files = zip(("root_ca_certificate", f"{way}_certificate", f"{way}_private_key"), map(str, keys), strict=True)
        settings["transport/link/tls"] = {"enable_mtls": True, **dict(files)}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
