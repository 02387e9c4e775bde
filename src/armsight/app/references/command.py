"""``armsight references``: check the recordings of sensors beside vision, and calibrate them against the tool's poses."""

from __future__ import annotations

from pathlib import Path

import click

from armsight.app.options import JSON, argument, declared, option, out
from armsight.files import check_writable, write_text


@click.group("references")
def command() -> None:
    """Check and calibrate inertial units, magnetometers and ranges, named in a file references.toml."""


@command.command()
@declared
def check(path: Path = argument("REFERENCES.toml"), as_json: bool = JSON) -> None:
    """Say what the recordings of references are like: rate, gaps, clock, noise at rest beside that of their class."""
    from armsight.app.references.report import checked
    from armsight.loop.references.file import read_references

    raise SystemExit(checked(read_references(path)).echo(as_json=as_json))


@command.command()
@declared
def calibrate(
    path: Path = argument("REFERENCES.toml"),
    poses: str = option("Poses of the tool in the base, with times t_s.", metavar="POSES.csv"),
    output: Path | None = out("OUT.toml", "Where to write the result.", kind="^(delay_s|live|source) *="),
    as_json: bool = JSON,
) -> None:
    """Find mounting, biases, scales, iron, anchor and delay from one sweep with poses by vision or by the arm."""
    from armsight.app.references.report import calibrated
    from armsight.loop.references.file import read_references, written

    if output is not None:
        check_writable(output, apart_from=(path, poses))
    entries = read_references(path)
    if output is not None:
        check_writable(output, apart_from=[entry.source for entry in entries])
    report, entries = calibrated(entries, Path(poses))
    if output is not None:
        write_text(output, "\n".join(written(entry, output.parent) for entry in entries))
    raise SystemExit(report.echo(as_json=as_json, written=None if output is None else str(output)))


@command.command()
@declared
def gravity(
    path: Path = argument("REFERENCES.toml"),
    model: str = option("The arm: a name of armsight arm list, or a file.", metavar="ARM"),
    joints: str = option("Joint angles of 8 rests or more, with times t_s.", metavar="JOINTS.csv"),
    as_json: bool = JSON,
) -> None:
    """Find the base's tilt and the joint zeros that gravity shows at rests; the others are named as open."""
    from armsight.app.references.report import gravity_report
    from armsight.loop.references.file import read_references

    raise SystemExit(gravity_report(read_references(path)[0], model, Path(joints)).echo(as_json=as_json))
