"""``armsight hub``: many cells on one page."""

from __future__ import annotations

import threading
from dataclasses import asdict
from pathlib import Path

import click

from armsight.app.options import JSON, argument, declared, option, out
from armsight.app.progress import steps
from armsight.app.show.http import host_and_port
from armsight.app.show.messages import note, print_answer, require
from armsight.app.stream.cell_file import endpoint, read_cell
from armsight.errors import ArmsightError
from armsight.files import check_folder

_HUB = option(
    "Where cells find the hub; port 7447 where none is given.", "--hub", default="127.0.0.1:7447", metavar="HOST[:PORT]"
)


@click.group("hub", invoke_without_command=True)
@click.pass_context
@declared
def command(
    ctx: click.Context,
    listen: str = option(
        "Where cells connect: tls/0.0.0.0:7447, with --keys, for other computers.",
        default="tcp/127.0.0.1:7447",
        metavar="ADDRESS",
    ),
    http: str = option("Where the page is.", default="127.0.0.1:8730", metavar="HOST:PORT"),
    keys: Path | None = option("Folder of the site's keys (armsight hub keys).", metavar="DIR"),
    mqtt: str | None = option("Publish Sparkplug B to a broker: mqtt[s]://[USER@]HOST[:PORT].", metavar="ADDRESS"),
    output: Path = out("DIR", "Folder of events and history.", default="hub"),
    as_json: bool = JSON,
) -> None:
    """Show many cells on one page, first the one that needs a look; keep their events and history.

    A cell is a command with --stream cell:NAME: measure, run, live, record, replay. It sends who it is, its state once a
    second and its events; without a hub it keeps its events and sends them later. Ctrl-C ends the hub, and no cell.

    The hub is for this computer alone until it has the keys of a site. It stops no arm: the emergency stop is at the
    cell.
    """
    if ctx.invoked_subcommand is not None:
        return
    require("a hub", "cells", "zenoh", "pyarrow", "cryptography")
    from armsight.app.hub.router import rejected
    from armsight.app.hub.service import Hub

    check_folder(output, problem="no hub can be kept here")
    host_and_port(http, "--http")
    at = endpoint(listen, "--listen")
    hub = Hub(output, at, http, keys, note, mqtt)
    try:
        answer = {"address": hub.pages.address, "listen": listen, "directory": str(output)}
        line = f"open {hub.pages.address} in a browser; cells connect to {listen}; Ctrl-C ends the hub"
        print_answer(as_json, answer, line)
        with rejected(hub.rejected):
            threading.Event().wait()
    finally:
        hub.close()


@command.command("keys")
@declared
def keys_command(
    site: str = argument(),
    cells: tuple[str, ...] = argument("CELL..."),
    output: Path = out("DIR", "Folder of the keys.", default="site-keys"),
    address: str = _HUB,
    as_json: bool = JSON,
) -> None:
    """Make the keys of SITE: for the hub, and a folder a CELL with the cell.toml that goes to its computer.

    Typed again it adds cells and renews what ends within 30 days. Start the hub again after it. DIR/ca.key must stay
    secret: who has it can make cells, and ask cells to hold.
    """
    require("keys", "cells", "cryptography")
    from armsight.app.hub.keys import make_keys

    host, port = host_and_port(address if ":" in address.rpartition("]")[2] else f"{address}:7447", "--hub", least=1)
    made = make_keys(check_folder(output, problem="no keys can be made here"), site, cells, host, port)
    there = "copy this folder to the cell's computer; there: --stream cell:"
    lines = [f"{each.parent}: {there}{each.parent.name}/cell.toml" for each in made]
    lines.append(f"{output}: start the hub with armsight hub --listen tls/0.0.0.0:{port} --keys {output}")
    print_answer(as_json, {"directory": str(output), "cells": list(map(str, made))}, *lines)


@command.command("hold")
@declared
def hold_command(
    cell: str = argument(),
    reason: str = argument(),
    keys: Path = option("Folder of the site's keys.", default="site-keys", metavar="DIR"),
    address: str = _HUB,
    as_json: bool = JSON,
) -> None:
    """Ask CELL to bring its arm to rest and hold it. This is no emergency stop, which is at the cell.

    A cell does so only where its cell.toml says holds = true, and the request is signed by the site's key. The
    cell keeps an event of it. Exit code 2: it did not.
    """
    require("a request to hold", "cells", "zenoh", "cryptography")
    from armsight.app.hub.router import hold

    answer = hold(keys, cell, reason, address)
    print_answer(as_json, {"cell": cell, "answer": answer})
    if answer != "held":
        raise ArmsightError(f"{cell} does not hold: {answer or 'it does not answer; stop it there'}")
    if not as_json:
        click.echo(f"{cell} holds")


@command.command("clocks")
@declared
def clocks_command(first: Path = argument("POSES"), second: Path = argument("OTHERS"), as_json: bool = JSON) -> None:
    """Say how far two rigs' clocks are apart, by a motion of one body that both measured.

    POSES and OTHERS are tables of poses with times, such as measure -o FILE writes.
    """
    from armsight.loop.delay import time_between
    from armsight.tables.poses import read_pose_table

    found = time_between(*(read_pose_table(each, side="seen") for each in (first, second)))
    off, sigma = 1e3 * found.delay_s, 1e3 * found.sigma_s
    said = f"times of {second} less those of {first}: {off:+.3f} ± {sigma:.3f} ms"
    print_answer(as_json, {"delay_s": found.delay_s, "sigma_s": found.sigma_s}, said)


@command.command("push")
@declared
def push_command(
    runs: Path = argument(),
    store: str = argument(),
    spec: str = option("Whose runs they are.", "--cell", metavar="NAME|cell.toml"),
    rate: float = option("MB/s at most.", min=0.01, max=1e4, default=10.0),
    as_json: bool = JSON,
) -> None:
    """Copy the run folders in RUNS to STORE, such as s3://bucket or a folder; started again it goes on where it was.

    Each goes to STORE/SITE/DAY/CELL/RUN, with a manifest of sizes and SHA-256 written last. It begins only while no
    command of the cell runs.
    """
    require("pushing", "cells", "fsspec")
    from armsight.app.hub.push import push

    cell = read_cell(spec)
    with steps() as say:
        done = push(cell, runs, store, rate, lambda sent: say(f"pushing: {sent / 1e6:.1f} MB"))
    sent = f"{done.files} files, {done.sent_bytes / 1e6:.1f} MB"
    said = f"{done.runs} runs are in {store} now ({sent}); {done.complete_before} were before"
    print_answer(as_json, asdict(done), said)
