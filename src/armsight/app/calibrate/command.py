"""``armsight calibrate``: two cameras, from images of a calibration target or from detections of a known body."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from pathlib import Path

import click

from armsight.app.show.messages import UNTRUSTED
from armsight.errors import InputError
from armsight.files import check_folder, check_outputs, check_writable
from armsight.vision.calibrate import FOLDS, MODELS

_FILE = click.Path(path_type=Path)


@dataclass(frozen=True)
class CalibrateOptions:
    """The options of ``armsight calibrate``, by their names; what each means is in its help."""

    left: str | None
    right: str | None
    source: str | None
    left_intrinsics: str | None
    right_intrinsics: str | None
    target: str | None
    lens_model: str | None
    flat_target: bool
    detections: Path | None
    cameras: Path | None
    body: Path | None
    refine_body: Path | None
    folds: int
    output: Path
    report: Path | None
    as_json: bool


@click.command("calibrate")
@click.option("--left", metavar="GLOB", help="Left images; quote the glob.")
@click.option("--right", metavar="GLOB", help="Right images, matched to the left ones by sorted name.")
@click.option(
    "--source",
    metavar="SOURCE",
    help="Instead: usb:0,1, recorded first, or a recording; finds the skew.",
)
@click.option("--left-intrinsics", metavar="GLOB", help="More images of the target, by the left camera alone.")
@click.option("--right-intrinsics", metavar="GLOB", help="The same by the right camera.")
@click.option("--target", metavar="SPEC", help="The target, such as chessboard:9x6:25mm (inner corners, square).")
@click.option(
    "--lens-model", type=click.Choice(MODELS), help="Distortion model; by default the held-out error chooses."
)
@click.option("--flat-target", is_flag=True, help="Do not estimate the target's deviation from its drawing.")
@click.option("--detections", metavar="D.csv", type=_FILE, help="Detections of a body, not images.")
@click.option("--cameras", metavar="CAMERAS.json", type=_FILE, help="Intrinsics of both cameras.")
@click.option("--body", metavar="BODY.csv", type=_FILE, help="The body's points.")
@click.option(
    "--refine-body", metavar="OUT.csv", type=_FILE, help="Estimate the body's points too, and write them here."
)
@click.option(
    "--folds", type=click.IntRange(min=2), default=FOLDS, show_default=True, help="Parts for the held-out errors."
)
@click.option("-o", "--output", required=True, metavar="RIG.json", type=_FILE, help="The rig to write.")
@click.option("--report", metavar="DIR", type=_FILE, help="Write an HTML report with figures.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
def command(**given: object) -> int:
    """Calibrate two cameras, and evaluate the calibration on pairs held out of the fit.

    From images: --left, --right and --target. From a recording of a board that moves before cameras that may not expose
    at one time: --source and --target. From detections of a known body with known intrinsics: --detections, --cameras
    and --body. Exit code 3: the images contradict each other, and the rig must not be used.
    """
    o = CalibrateOptions(**given)  # type: ignore[arg-type]
    globs, points = (o.left, o.right), (o.detections, o.cameras, o.body)
    images = (o.source, o.target) if o.source is not None else (*globs, o.target)
    if (None in images) == (None in points) or any((*globs, *images)) == any(points) or (o.source and any(globs)):
        raise InputError(
            "give --left, --right and --target, or --source and --target, or --detections, --cameras and --body"
        )
    if o.refine_body is not None and o.detections is None:
        raise InputError("--refine-body goes with --detections; a target in images is estimated without it")
    if (o.left_intrinsics or o.right_intrinsics) and o.target is None:
        raise InputError("--left-intrinsics and --right-intrinsics go with images of a --target")

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
    if o.target is not None:  # before a person shows it to cameras
        open_board(o.target)
        check_writable(o.output)
        check_report(o.output)
    with contextlib.closing(GivenImages(o) if o.target is not None else GivenDetections(o)) as opened:
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
