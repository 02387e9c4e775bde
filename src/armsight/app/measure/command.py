"""``armsight measure``: the pose of a target, shot by shot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from armsight.app.options import DETECTIONS, PATH, output, stream_option
from armsight.app.show.messages import UNTRUSTED


@dataclass(frozen=True)
class MeasureOptions:
    """The options of ``armsight measure``, by their names; what each means is in its help."""

    rig: Path
    target: str
    source: str
    fixed: Sequence[str]
    skew: str | None
    readout: str | None
    save_rig: Path | None
    output: Path | None
    stream: Sequence[str]
    board: str | None
    view_dir: Path | None
    as_json: bool

    @property
    def detections(self) -> str | None:
        """The file of detections, or bag:FILE; None where images are measured."""
        return self.source.removeprefix(DETECTIONS) if self.source.startswith(DETECTIONS) else None


@click.command("measure")
@click.argument("rig", metavar="RIG.json", type=PATH)
@click.option(
    "--target",
    required=True,
    metavar="SPEC|BODY",
    help="A board such as chessboard:9x6:25mm, a body file, or calibrate's .board.toml.",
)
@click.option(
    "--source",
    required=True,
    metavar="SOURCE",
    help="A folder, 'pairs:L*.png,R*.png', a video, stream or pair of cameras (see armsight record -h); or "
    "detections:D.csv, detections:bag:FILE for tags in a bag.",
)
@click.option(
    "--fixed",
    multiple=True,
    metavar="BODY",
    help="A body in view that does not move; may be repeated. It shows cameras that move.",
)
@click.option(
    "--skew", metavar="TIME", help="The right camera exposes later by this, such as 5ms, or find (recordings)."
)
@click.option(
    "--readout", metavar="TIME", help="Rolling shutters: from the first row to the last, such as 14ms, or find."
)
@click.option(
    "--save-rig",
    metavar="RIG2.json",
    type=PATH,
    help="Write the rig with the skew and readout found, and the noise of a moved body's discs.",
)
@output("POSES.csv", "Write the poses as CSV.")
@stream_option()
@click.option(
    "--board",
    metavar="BOARD",
    help="Publish this board's joint readings, too: serial:, feetech: or ar4:PORT, emulated:.",
)
@click.option("--view", "view_dir", metavar="DIR", type=PATH, help="Write annotated pictures.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per shot.")
def command(**given: object) -> None:
    """Measure the pose of a target in the left camera's frame, with its uncertainty.

    RIG.json may also be bag:FILE, a recording that holds the camera_info of a stereo pair. A shot that cannot be read or
    does not show the target gives a line with the reason, and the run continues. rz, ry, rx are the angles about z, y and
    x, in this order (euler_zyx_deg; in ROS they are yaw, pitch and roll). Exit code 3: the shots contradict the rig or the
    body file, and the poses must not be trusted.

    With --skew or --readout, or where the rig file has them, a moving body's detections are moved to the time of the shot
    by its own motion, which the recording's other shots show.
    """
    from armsight.app.measure.run import measure_shots

    if any(each.forbids for each in measure_shots(MeasureOptions(**given))):  # type: ignore[arg-type]
        click.get_current_context().exit(UNTRUSTED)
