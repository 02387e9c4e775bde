"""The option, or argument, that names an arm, and ``--tool-link`` beside it, the same for every command that opens one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])
#: Where the context of a command keeps the value of --tool-link.
_LINK = "armsight.tool_link"


class _Arm(click.types.StringParamType):
    """An arm's name or file; with --tool-link FILE#LINK, as :func:`armsight.robot.arm_file.open_arm` takes it."""

    name = "arm"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the name, with the link where one is given."""
        link = None if ctx is None else ctx.meta.get(_LINK)
        return str(value) if link is None or str(value).endswith(f"#{link}") else f"{value}#{link}"


def _keep(ctx: click.Context, _: click.Parameter, link: str | None) -> None:
    ctx.meta[_LINK] = link


def arm_option(*names: str, **attributes: Any) -> Callable[[_Command], _Command]:  # noqa: ANN401 - click's own
    """Give a command an option for an arm, or an argument where the name has no dashes, and --tool-link."""
    given = click.option if names[0].startswith("-") else click.argument
    link = click.option(
        "--tool-link",
        metavar="LINK",
        is_eager=True,
        expose_value=False,
        callback=_keep,
        help="The tool's link in a .urdf file where several end the chain.",
    )
    return lambda command: given(*names, type=_Arm(), **attributes)(link(command))
