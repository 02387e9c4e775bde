"""The ``armsight`` command: the group, and how errors reach a person.

Every command takes ``--json`` (machine-readable on stdout); progress and warnings go to stderr. A mistake in the input
is one line on stderr and exit code 2; an interrupt is exit code 130.
"""

from __future__ import annotations

import importlib
import os
import sys

import click

from armsight.errors import ArmsightError

#: The commands; each has a folder of its name, whose ``command.py`` holds a click command called ``command``.
COMMANDS = (
    "arm",
    "board",
    "body",
    "calibrate",
    "cameras",
    "check",
    "demo",
    "dense",
    "identify",
    "measure",
    "record",
    "rig",
    "run",
)


class _Lazy(click.Group):
    """A group that imports a command's module only when that command is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"armsight.app.{cmd_name}.command")
        command: click.Command = module.command
        return command

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; an interrupt leaves as Abort, before click prints an empty line for it."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise click.exceptions.Abort from None


@click.group(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="armsight")
def group() -> None:
    """Say where a robot arm's end-effector is, from two USB cameras, in millimetres and with an honest sigma."""


def main() -> None:
    """Run the command line and exit: 0 done, 2 a mistake in the input (one line on stderr), 130 interrupted."""
    try:
        code = group.main(standalone_mode=False)
        if sys.stdout is not None:
            sys.stdout.flush()
        sys.exit(code if isinstance(code, int) else 0)
    except click.exceptions.Abort:
        click.echo("armsight: interrupted", err=True)
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        if "extra argument" in error.format_message() and {"--left", "--right"} & set(sys.argv):
            click.echo(
                "A glob must be quoted: --left 'DIR/left*.png', or the shell puts every file name there.", err=True
            )
        sys.exit(2)
    except ArmsightError as error:
        click.echo(f"armsight: error: {error}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        click.echo("armsight: interrupted", err=True)
        sys.exit(130)
    except BrokenPipeError:
        _silence_stdout()
        sys.exit(0)
    except OSError as error:  # every file and device names itself in an ArmsightError: what is left is the output
        _silence_stdout()
        click.echo(f"armsight: error: the output cannot be written: {error.strerror}", err=True)
        sys.exit(2)


def _silence_stdout() -> None:
    """Let what is still buffered go nowhere, so that the interpreter does not stumble over it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
