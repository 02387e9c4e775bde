"""``armsight serve``: keep measuring for days."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from armsight.app.options import PATH


@click.command("serve")
@click.argument("config", metavar="CONFIG.toml", type=PATH)
@click.option("--json", "as_json", is_flag=True, help="Print each event as one JSON object.")
def command(config: Path, as_json: bool) -> None:
    """Keep `armsight measure` going for days.

    CONFIG.toml has the options of `armsight measure` by their long names, and how it is served (docs/howto/serve.md). A
    camera that is lost is tried again until it is back; each loss is said once. /healthz and /metrics show the state.
    """
    from armsight.app.serve.config import read_config
    from armsight.app.serve.service import Service

    def report(event: dict[str, Any]) -> None:
        if as_json:
            click.echo(json.dumps(event))

    click.get_current_context().exit(Service(read_config(config), report).run())
