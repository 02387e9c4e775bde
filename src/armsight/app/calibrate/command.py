"""``armsight calibrate``: two cameras, from images of a calibration target or from detections of a known body."""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.app.messages import UNTRUSTED
from armsight.errors import InputError
from armsight.files import check_folder, check_outputs
from armsight.vision.calibrate import FOLDS, MODELS

if TYPE_CHECKING:
    from armsight.vision.sources import Source

_VIDEOS = (".avi", ".mkv", ".mov", ".mp4", ".webm")


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
) -> None:
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

    from armsight.app.calibrate.report import REPORT_FILES, write_report
    from armsight.app.calibrate.run import (
        calibrate_detections,
        calibrate_images,
        files_of,
        open_stored,
        print_result,
        provenance,
        summary,
        with_radius,
    )
    from armsight.app.report.plotting import require_matplotlib
    from armsight.vision.calibrate.weak import contradicted, require_order
    from armsight.vision.markers.body_file import save_body_csv
    from armsight.vision.markers.calibrated_board import save_board_file
    from armsight.vision.sources import PairsSource
    from armsight.vision.sources.pairs import StoredSource

    opened: Source | None = None
    if left is not None and right is not None:
        opened = PairsSource.open(left, right)
        video = next((file for file in opened.files if file.suffix.lower() in _VIDEOS), None)
        if video is not None:
            raise InputError(f"{video}: is a video: give both as --source video:LEFT,RIGHT")
    elif source is not None:
        opened = open_stored(source)
    alone = (files_of(left_intrinsics), files_of(right_intrinsics))
    files = opened.files if isinstance(opened, StoredSource) else ()
    inputs = points if opened is None else (*files, *alone[0], *alone[1])
    board_file = None if opened is None else output.parent / f"{output.stem}.board.toml"
    check_outputs((output, refine_body, board_file), inputs)
    if report is not None:
        require_matplotlib()
        check_folder(
            report,
            holding=REPORT_FILES,
            apart_from=(output, refine_body, board_file, *inputs),
            problem="no report can be written here",
        )
    started = time.perf_counter()
    if opened is not None and target is not None and board_file is not None:
        models = MODELS if lens_model is None else (lens_model,)
        with contextlib.closing(opened):
            calibration = calibrate_images(opened, alone, target, models, flat=flat_target, folds=folds)
        given = {"source": source} if source is not None else {"left": str(left), "right": str(right)}
        given |= {"target": target, "board": board_file.name}
        more = {"left_intrinsics": left_intrinsics, "right_intrinsics": right_intrinsics}
        given |= {name: pattern for name, pattern in more.items() if pattern is not None}
    elif detections is not None and cameras is not None and body is not None:
        calibration = calibrate_detections(detections, cameras, body, refine_body=refine_body is not None, folds=folds)
        given = {"detections": str(detections), "cameras": str(cameras), "body": str(body)}
    require_order(calibration)
    calibration = replace(calibration, rig=replace(calibration.rig, provenance=provenance(given, calibration)))
    if refine_body is not None:
        save_body_csv(calibration.body, refine_body)
    calibration.rig.save(output)
    if board_file is not None and target is not None:
        save_board_file(board_file, with_radius(target, calibration.disc_radius_m), calibration.body.points)
    if report is not None:
        write_report(calibration, report)
    if as_json:
        click.echo(json.dumps(summary(calibration, output, board_file, report, time.perf_counter() - started)))
    else:
        print_result(calibration, output, board_file, report)
    if contradicted(calibration):
        click.get_current_context().exit(UNTRUSTED)
