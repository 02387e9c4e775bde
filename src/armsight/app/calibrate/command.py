"""``armsight calibrate``: two cameras, from images of a calibration target or from detections of a known body."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.show.messages import UNTRUSTED
from armsight.errors import InputError
from armsight.files import check_folder, check_outputs
from armsight.vision.calibrate import FOLDS, MODELS

if TYPE_CHECKING:
    from armsight.app.calibrate.run import GivenDetections, GivenImages


@click.command("calibrate")
@click.option("--left", metavar="GLOB", help="Left images; quote the glob.")
@click.option("--right", metavar="GLOB", help="Right images, matched to the left ones by sorted name.")
@click.option(
    "--source", metavar="SOURCE", help="Instead: a folder or a recording; with times, the skew of the cameras is found."
)
@click.option("--left-intrinsics", metavar="GLOB", help="More images of the target, by the left camera alone.")
@click.option("--right-intrinsics", metavar="GLOB", help="The same by the right camera.")
@click.option("--target", metavar="SPEC", help="The target, such as chessboard:9x6:25mm (inner corners, square).")
@click.option(
    "--lens-model", type=click.Choice(MODELS), help="Distortion model; by default the held-out error chooses."
)
@click.option("--flat-target", is_flag=True, help="Do not estimate the target's deviation from its drawing.")
@click.option(
    "--detections", metavar="D.csv", type=click.Path(path_type=Path), help="Detections of a body, not images."
)
@click.option("--cameras", metavar="CAMERAS.json", type=click.Path(path_type=Path), help="Intrinsics of both cameras.")
@click.option("--body", metavar="BODY.csv", type=click.Path(path_type=Path), help="The body's points.")
@click.option(
    "--refine-body",
    metavar="OUT.csv",
    type=click.Path(path_type=Path),
    help="Estimate the body's points too, and write them here.",
)
@click.option(
    "--folds", type=click.IntRange(min=2), default=FOLDS, show_default=True, help="Parts for the held-out errors."
)
@click.option(
    "-o", "--output", required=True, metavar="RIG.json", type=click.Path(path_type=Path), help="The rig to write."
)
@click.option("--report", metavar="DIR", type=click.Path(path_type=Path), help="Write an HTML report with figures.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
def command(
    left: str | None,
    right: str | None,
    source: str | None,
    left_intrinsics: str | None,
    right_intrinsics: str | None,
    target: str | None,
    lens_model: str | None,
    flat_target: bool,
    detections: Path | None,
    cameras: Path | None,
    body: Path | None,
    refine_body: Path | None,
    folds: int,
    output: Path,
    report: Path | None,
    as_json: bool,
) -> int:
    """Calibrate two cameras, and evaluate the calibration on pairs held out of the fit.

    From images: --left, --right and --target. From a recording of a board that moves before cameras that may not expose
    at one time: --source and --target. From detections of a known body with known intrinsics: --detections, --cameras
    and --body. Exit code 3: the images contradict each other, and the rig must not be used.
    """
    globs, points = (left, right), (detections, cameras, body)
    images = (source, target) if source is not None else (*globs, target)
    if (None in images) == (None in points) or any((*globs, *images)) == any(points) or (source and any(globs)):
        raise InputError(
            "give --left, --right and --target, or --source and --target, or --detections, --cameras and --body"
        )
    if refine_body is not None and detections is None:
        raise InputError("--refine-body goes with --detections; a target in images is estimated without it")
    if (left_intrinsics or right_intrinsics) and target is None:
        raise InputError("--left-intrinsics and --right-intrinsics go with images of a --target")

    from armsight.app.calibrate.report import REPORT_FILES, calibration_report
    from armsight.app.calibrate.run import GivenDetections, GivenImages, provenance
    from armsight.app.show.plotting import require_matplotlib
    from armsight.vision.calibrate.weak import contradicted, require_order

    given: GivenDetections | GivenImages
    if detections is not None and cameras is not None and body is not None:
        given = GivenDetections(detections, cameras, body, refine_body)
    elif target is not None:
        models = MODELS if lens_model is None else (lens_model,)
        board_file = output.parent / f"{output.stem}.board.toml"
        given = GivenImages(
            source or (str(left), str(right)),
            (left_intrinsics, right_intrinsics),
            target,
            models,
            flat_target,
            board_file,
        )
    with contextlib.closing(given):
        check_outputs((output, refine_body, given.board_file), given.files)
        if report is not None:
            require_matplotlib()
            check_folder(
                report,
                holding=REPORT_FILES,
                apart_from=(output, refine_body, given.board_file, *given.files),
                problem="no report can be written here",
            )
        started = time.perf_counter()
        calibration = given.calibrated(folds)
    require_order(calibration)
    calibration = replace(calibration, rig=replace(calibration.rig, provenance=provenance(given.named, calibration)))
    calibration.rig.save(output)
    given.save(calibration)
    found = calibration_report(calibration, output, given.board_file, report, time.perf_counter() - started)
    if report is not None:
        found.write(report)
    found.echo(as_json=as_json)
    return UNTRUSTED if contradicted(calibration) else 0
