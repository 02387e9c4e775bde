"""``armsight setup``: the page of an arm, walked through in the terminal."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Any

import click

from armsight.app.options import JSON, SIM, argument, declared, option
from armsight.app.show.messages import UNANSWERED, print_answer, say
from armsight.errors import InputError


@click.command("setup")
@declared
def command(
    arm: str = argument(),
    source: str | None = option(
        "The cameras, such as usb:0,1, without looking for them; sim: for a try.", metavar="SOURCE"
    ),
    board: str | None = option("The arm's port, such as /dev/ttyACM0; emulated: with sim:.", metavar="PORT"),
    begin: int | None = option("Do it again from this step on.", "--from", min=1, metavar="N"),
    as_json: bool = JSON,
) -> None:
    """Walk through ARM's page, from the cameras to the corrected arm; setup.json remembers how far it came.

    Each command is shown before it runs; they are those of docs/arms/. The port is found by unplugging, the cameras by
    covering them. Ctrl-C keeps what was done: the same command goes on there.
    """
    from armsight.app.setup.steps import ARMS
    from armsight.app.setup.walk import INTERRUPTED, SetupWalk, simulated, words_of

    if arm not in ARMS:
        raise InputError(
            f"{arm}: no arm with a page; there are {', '.join(ARMS)}. Another arm: docs/arms/another_arm.md"
        )
    simulate = (source or "").startswith(SIM)
    if simulate != ((board or "").startswith("emulated:")):
        raise InputError("--source sim: and --board emulated: go together: both are simulated")
    steps = ARMS[arm]
    if begin is not None and begin > len(steps):
        raise InputError(f"--from {begin}: {arm} has {len(steps)} steps")
    if simulate and not any(step.command.startswith("run ") for step in steps):
        raise InputError(f"{arm}: its own controller moves it, which is not simulated; so101, ar4 and six_r are")
    walk = SetupWalk.open(arm, begin, simulate)
    if not simulate:
        walk.words |= words_of(source, board)
    else:
        click.echo("simulated: what a person does in a step is done by a program", err=True)
    result: dict[str, Any] = {"arm": arm, "folder": str(Path.cwd()), "steps": []}
    code = INTERRUPTED
    stdout = contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()  # what commands print
    with stdout, simulated(walk, source or "") if simulate else contextlib.nullcontext():
        try:
            code = walk.go(say, result)
        except (KeyboardInterrupt, click.Abort) as error:
            if isinstance(error.__context__, EOFError):
                raise InputError(UNANSWERED) from None
            click.echo(f"\nwhat is done is kept: armsight setup {arm} goes on there", err=True)
    print_answer(as_json, result)
    click.get_current_context().exit(code)
