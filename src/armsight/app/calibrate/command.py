"""``armsight calibrate``: two cameras, from images of a calibration target or from detections of a known body."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from pathlib import Path

import click

from armsight.app.options import DETECTIONS, PATH, output
from armsight.app.show.messages import UNTRUSTED
from armsight.errors import InputError
from armsight.files import check_folder, check_outputs, check_writable
from armsight.vision.calibrate import FOLDS, MODELS


@dataclass(frozen=True)
class CalibrateOptions:
    """The options of ``armsight calibrate``, by their names; what each means is in its help."""

    source: str
    alone: str | None
    target: str
    lens_model: str | None
    flat_target: bool
    cameras: Path | None
    refine_body: Path | None
    folds: int
    output: Path
    report: Path | None
    as_json: bool


@click.command("calibrate")
@click.option(
    "--source",
    required=True,
    metavar="SOURCE",
    help="Images: 'pairs:L*.png,R*.png', quoted; usb:0,1, recorded first, or a recording, which shows the skew; or "
    "detections:D.csv of a body.",
)
@click.option("--alone", metavar="LEFT,RIGHT", help="Globs of more images of the target by one camera alone, or empty.")
@click.option(
    "--target",
    required=True,
    metavar="SPEC|BODY.csv",
    help="The target, such as chessboard:9x6:25mm (inner corners, square); of detections the body's points.",
)
@click.option(
    "--lens-model", type=click.Choice(MODELS), help="Distortion model; by default the held-out error chooses."
)
@click.option("--flat-target", is_flag=True, help="Do not estimate the target's deviation from its drawing.")
@click.option("--cameras", metavar="CAMERAS.json", type=PATH, help="Intrinsics of both cameras, with detections.")
@click.option(
    "--refine-body", metavar="OUT.csv", type=PATH, help="Estimate the body's points too, and write them here."
)
@click.option(
    "--folds", type=click.IntRange(min=2), default=FOLDS, show_default=True, help="Parts for the held-out errors."
)
@output("RIG.json", "The rig to write.", required=True)
@click.option("--report", metavar="DIR", type=PATH, help="Write an HTML report with figures; needs armsight[report].")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
def command(**given: object) -> int:
    """Calibrate two cameras, and evaluate the calibration on pairs held out of the fit.

    From images of a board; from a recording of one that moves before cameras that may not expose at one time; or from
    detections of a known body with known intrinsics. Exit code 3: the images contradict each other, and the rig must not
    be used.
    """
    o = CalibrateOptions(**given)  # type: ignore[arg-type]
    images = not o.source.startswith(DETECTIONS)
    if images == (o.cameras is not None):
        raise InputError(
            "--cameras and --source detections:D.csv belong together; images show the intrinsics themselves"
        )
    if o.refine_body is not None and images:
        raise InputError("--refine-body goes with detections; a target in images is estimated without it")
    if o.alone is not None and not images:
        raise InputError("--alone goes with images of a board")

    from armsight.app.calibrate.report import REPORT_FILES, calibration_report
    from armsight.app.calibrate.run import GivenDetections, GivenImages, provenance
    from armsight.app.show.plotting import require_matplotlib
    from armsight.vision.calibrate.weak import contradicted, require_order
    from armsight.vision.markers.board import open_board

    def check_report(*apart: Path | None) -> None:
        if o.report is not None:
            check_folder(o.report, holding=REPORT_FILES, apart_from=apart, problem="no report can be written here")

    if o.report is not None:
        require_matplotlib()
    if images:  # before a person shows it to cameras
        open_board(o.target)
        check_writable(o.output)
        check_report(o.output)
    with contextlib.closing(GivenImages(o) if images else GivenDetections(o)) as opened:
        outputs = (o.output, o.refine_body, opened.board_file)
        check_outputs(outputs, opened.files)
        check_report(*outputs, *opened.files)
        started = time.perf_counter()
        calibration = opened.calibrated()
    require_order(calibration)
    calibration = replace(calibration, rig=replace(calibration.rig, provenance=provenance(opened.named, calibration)))
    calibration.rig.save(o.output)
    opened.save(calibration)
    found = calibration_report(calibration, o.output, opened.board_file, o.report, time.perf_counter() - started)
    if o.report is not None:
        found.write(o.report)
    found.echo(as_json=o.as_json)
    return UNTRUSTED if contradicted(calibration) else 0
