"""A request that a cell holds its arm: signed here, sent through the hub's router, answered by the cell."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from armsight.app.hub.keys import sign_hold, site_of
from armsight.app.stream.cell_file import Cell, endpoint, zenoh_config
from armsight.errors import InputError

#: s that the answer of a cell is waited for; half: a slow network has no answer, double: a person waits longer.
_ANSWER_S = 3.0


def hold(keys: Path, cell: str, reason: str, address: str) -> str:
    """Ask a cell to hold; return its answer: ``held``, why not, or nothing where it did not answer.

    Args:
        keys: folder of the site's keys.
        cell: its name.
        reason: kept in the events of both sides.
        address: ``HOST:PORT`` at which cells connect to the hub.

    Raises:
        InputError: no keys, no such cell, or no hub answers there.
    """
    import zenoh

    site, cells = site_of(keys)
    if cell not in cells:
        raise InputError(f"{cell!r} is no cell of site {site}; it has {', '.join(cells) or 'none'}")
    tls = {
        "root_ca_certificate": str(keys / "ca.pem"),
        "enable_mtls": True,
        "connect_certificate": str(keys / "hub.pem"),
        "connect_private_key": str(keys / "hub.key"),
    }
    try:
        session = zenoh.open(zenoh_config("client", connect=endpoint(f"tls/{address}", "--hub"), tls=tls))
    except zenoh.ZError:
        raise InputError(f"--hub {address}: no hub with the keys of {keys} answers there") from None
    with closing(session):
        topic = Cell(cell, site).topic("hold")
        for reply in session.get(topic, payload=sign_hold(keys, cell, reason), timeout=_ANSWER_S):
            if reply.ok is not None:
                return str(reply.ok.payload.to_string())
    return ""
