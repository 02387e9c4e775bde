"""``armsight cameras``: list the attached cameras and their modes (:mod:`armsight.vision.sources.v4l2`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

from armsight.app.options import JSON, declared
from armsight.app.show.messages import print_answer

if TYPE_CHECKING:
    from armsight.vision.sources.v4l2 import VideoDevice


@click.command("cameras")
@declared
def command(as_json: bool = JSON) -> None:
    """List the attached cameras and their modes.

    Two cameras of one model may share a by-id name; by-path, the USB port, distinguishes them.
    """
    from armsight.vision.sources.v4l2 import find_cameras

    cameras = find_cameras()
    lines = [line for camera in cameras for line in _lines(camera)]
    if not cameras:
        lines.append(
            "no camera is attached\n"
            "  check the cable and the port: lsusb lists what the computer sees\n"
            "  check the driver: sudo dmesg | tail, right after plugging in, should name a /dev/video...\n"
            "  in a container or a VM: /dev/video* must be passed to it\n"
            "  your user must be in the group video: sudo usermod -aG video $USER, then log in again"
        )
    print_answer(as_json, {"cameras": [dataclasses.asdict(camera) for camera in cameras]}, *lines)


def _lines(camera: VideoDevice) -> Iterator[str]:
    yield f"{camera.device}  {camera.name}" + (f"  ({camera.driver}, {camera.bus})" if camera.driver else "")
    for path in camera.stable:
        yield f"  {path}"
    if camera.problem:
        yield f"  {camera.problem}"
    for form in camera.formats:
        yield f"  {form.fourcc}  {form.description}"
        for size in form.sizes:
            rates = " ".join(f"{fps:g}" for fps in size.fps) or "?"
            smallest = f"{size.from_px[0]}x{size.from_px[1]} to " if size.from_px else ""
            yield f"    {smallest}{size.width_px}x{size.height_px}  {rates} frames per second"
