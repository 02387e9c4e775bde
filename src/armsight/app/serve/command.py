"""``armsight serve``: keep measuring for days."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from armsight.app.options import argument, declared, option
from armsight.app.show.messages import print_answer


@click.command("serve")
@declared
def command(
    config: Path = argument("CONFIG.toml"), as_json: bool = option("Print each event as one JSON object.", "--json")
) -> None:
    """Keep `armsight measure` going for days.

    CONFIG.toml has the options of `armsight measure` by their long names, and how it is served (docs/howto/serve.md). A
    camera that is lost is tried again until it is back; each loss is said once. /healthz and /metrics show the state.
    """
    from armsight.app.serve.config import read_config
    from armsight.app.serve.service import Service

    click.get_current_context().exit(Service(read_config(config), partial(print_answer, as_json)).run())
