"""``armsight record``: store the shots of a source in a folder, which is then a source itself."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.options import JSON, SECONDS, STREAM, argument, declared, option, out
from armsight.app.show.messages import note, print_answer
from armsight.errors import ArmsightError

if TYPE_CHECKING:
    from armsight.data import Shot


@click.command("record")
@click.pass_context
@declared
def command(
    ctx: click.Context,
    source: str = argument(),
    output: Path = out("DIR", "New or empty folder."),
    shots: int | None = option("Stop after so many shots.", min=1),
    seconds: float | None = SECONDS,
    stream: tuple[str, ...] = STREAM,
    as_json: bool = JSON,
) -> None:
    """Store the shots of SOURCE in a folder, with their time stamps; the folder is then a source itself.

    \b
    SOURCE is one of
      usb:LEFT,RIGHT[@WIDTHxHEIGHT][@FPS][,exposure=5ms|auto][,gain=20][,format=MJPG]
      url:URL_LEFT,URL_RIGHT              MJPEG over HTTP, or RTSP
      video:LEFT.mp4,RIGHT.mp4            or one side-by-side file
      folder:DIR                          or just DIR
      bag:FILE[,left=TOPIC,right=TOPIC]   a ROS or Foxglove recording
      lerobot:DIR[,left=KEY,right=KEY]    a LeRobot dataset

    Beside the images the folder has run.mcap, which Foxglove, Lichtblick and rerun open. Ctrl-C stops the recording; what
    was stored until then is complete and readable.
    """  # noqa: D301 - click reads the backspace character
    from armsight.app.progress import bar
    from armsight.app.record.recording import record, unused_folder
    from armsight.app.stream.datum import Published
    from armsight.app.stream.mcap_file import LazyMcap, properties
    from armsight.app.stream.streams import open_streams
    from armsight.loop.running.data import ShotDatum
    from armsight.vision.sources import notes_of, open_source

    unused_folder(output)
    with contextlib.ExitStack() as stack:
        opened = stack.enter_context(contextlib.closing(open_source(source)))
        said = notes_of(opened)
        note(*said)
        published = Published(properties=properties(None, None, command="record", source=source))
        say = partial(click.echo, err=True)
        file = stack.enter_context(contextlib.closing(LazyMcap(output.expanduser(), published, say)))
        streams = stack.enter_context(contextlib.closing(open_streams(stream, published, say)))
        advance = stack.enter_context(bar("recording shots", shots))

        def stored_one(shot: Shot) -> None:
            file.put_shot(shot)
            streams.put(ShotDatum(shot, None))
            advance()

        result = record(opened, output, shots=shots, seconds=seconds, on_shot=stored_one)
        note(*notes_of(opened)[len(said) :])
    keys = {"directory": str(result.directory), "shots": result.shots, "problems": result.problems}
    print_answer(as_json, {**keys, "stopped": result.stopped})
    stored = f"{result.shots} shots are stored in {result.directory}"
    if result.problems:
        stored += f", {result.problems} of them without images: shots.csv has the reasons"
    if result.interrupted:
        click.echo(f"armsight: interrupted; {stored}", err=True)
        ctx.exit(130)
    if result.stopped:
        raise ArmsightError(f"{result.stopped}; {stored}" if result.shots else result.stopped)
    if not result.shots:
        raise ArmsightError(f"{source}: ended without a single shot")
    if not as_json:
        click.echo(stored)
