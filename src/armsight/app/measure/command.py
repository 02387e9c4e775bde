"""``armsight measure``: the pose of a target, shot by shot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from armsight.app.options import DETECTIONS, FIXED, IS_RIG, STREAM, argument, declared, option, out
from armsight.app.show.messages import UNTRUSTED


@dataclass(frozen=True)
class MeasureOptions:
    """The options of ``armsight measure``, by their names; what each means is in its help."""

    rig: Path = argument("RIG.json")
    target: str = option("A board such as chessboard:9x6:25mm, a body file, or a .board.toml.", metavar="SPEC|BODY")
    source: str = option(
        "A folder, 'pairs:L*.png,R*.png', a video, stream or pair of cameras (see armsight record -h); or "
        "detections:D.csv, detections:bag:FILE for tags in a bag.",
        metavar="SOURCE",
    )
    fixed: tuple[str, ...] = FIXED
    skew: str | None = option("How much later the right camera exposes: 5ms, or find (recordings).", metavar="TIME")
    readout: str | None = option("Rolling shutters: from first row to last, such as 14ms, or find.", metavar="TIME")
    save_rig: Path | None = out(
        "RIG2.json", "Write the rig with skew, readout and noise of a moved body's discs.", "--save-rig", kind=IS_RIG
    )
    output: Path | None = out("POSES.csv", "Write the poses as CSV.", kind="^shot,status,")
    stream: tuple[str, ...] = STREAM
    board: str | None = option("Publish a board's joints too: serial:, feetech:, ar4:PORT, emulated:.", metavar="BOARD")
    view_dir: Path | None = out("DIR", "Write annotated pictures.", "--view")
    as_json: bool = option("Print one JSON object per shot.", "--json")

    @property
    def detections(self) -> str | None:
        """The file of detections, or bag:FILE; None where images are measured."""
        return self.source.removeprefix(DETECTIONS) if self.source.startswith(DETECTIONS) else None


@click.command("measure")
@declared
def command(options: MeasureOptions) -> None:
    """Measure the pose of a target in the left camera's frame, with its uncertainty.

    RIG.json may also be bag:FILE, a recording that holds the camera_info of a stereo pair. A shot that cannot be read or
    does not show the target gives a line with the reason, and the run continues. rz, ry, rx are the angles about z, y and
    x, in this order (euler_zyx_deg; in ROS they are yaw, pitch and roll). Exit code 3: the shots contradict the rig or the
    body file, and the poses must not be trusted.

    With --skew or --readout, or where the rig file has them, a moving body's detections are moved to the time of the shot
    by its own motion, which the recording's other shots show.
    """
    from armsight.app.measure.run import measure_shots

    if any(each.forbids for each in measure_shots(options)):
        click.get_current_context().exit(UNTRUSTED)
