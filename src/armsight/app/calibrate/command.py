"""``armsight calibrate``: two cameras, from images of a calibration target or from detections of a known body."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from armsight.errors import InputError
from armsight.files import check_folder, check_outputs
from armsight.vision.calibrate import FOLDS, MODELS

if TYPE_CHECKING:
    from armsight.vision.sources.pairs import StoredSource

_VIDEOS = (".avi", ".mkv", ".mov", ".mp4", ".webm")


@click.command("calibrate")
@click.option("--left", metavar="GLOB", help="Left images; quote the glob.")
@click.option("--right", metavar="GLOB", help="Right images, matched to the left ones by sorted name.")
@click.option("--source", metavar="SOURCE", help="Instead: a folder, as armsight record writes it, or side by side.")
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

    From images: --left, --right and --target, or --source and --target. From detections of a known body with known
    intrinsics: --detections, --cameras and --body.
    """
    images, points = (left, right, target) if source is None else (source, target), (detections, cameras, body)
    if (None in images) == (None in points) or any(images) == any(points) or (source and (left or right)):
        raise InputError("give --left, --right (or --source) and --target, or --detections, --cameras and --body")
    if refine_body is not None and detections is None:
        raise InputError("--refine-body goes with --detections; a target in images is estimated without it")
    if (left_intrinsics or right_intrinsics) and target is None:
        raise InputError("--left-intrinsics and --right-intrinsics go with --left, --right and --target")

    from armsight.app.calibrate.report import REPORT_FILES, write_report
    from armsight.app.calibrate.run import (
        calibrate_detections,
        calibrate_images,
        files_of,
        print_result,
        provenance,
        summary,
        with_radius,
    )
    from armsight.app.report.plotting import require_matplotlib
    from armsight.vision.markers.body_file import save_body_csv
    from armsight.vision.markers.calibrated_board import save_board_file

    pairs = _pairs(left, right, source)
    alone = (files_of(left_intrinsics), files_of(right_intrinsics))
    inputs = points if pairs is None else (*pairs.files, *alone[0], *alone[1])
    board_file = None if pairs is None else output.parent / f"{output.stem}.board.toml"
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
    if pairs is not None and target is not None and board_file is not None:
        models = MODELS if lens_model is None else (lens_model,)
        calibration = calibrate_images(pairs, alone, target, models, flat=flat_target, folds=folds)
        named = {"left": left, "right": right, "source": source, "target": target, "board": board_file.name}
        named |= {"left_intrinsics": left_intrinsics, "right_intrinsics": right_intrinsics}
        given = {name: text for name, text in named.items() if text is not None}
    elif detections is not None and cameras is not None and body is not None:
        calibration = calibrate_detections(detections, cameras, body, refine_body=refine_body is not None, folds=folds)
        given = {"detections": str(detections), "cameras": str(cameras), "body": str(body)}
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


def _pairs(left: str | None, right: str | None, spec: str | None) -> StoredSource | None:
    """Open the pairs of images; None where detections were given instead.

    Raises:
        InputError: not stored images, or none that pair up.
    """
    from armsight.vision.sources import SOURCES, FolderSource, PairsSource, check_source

    if spec is None and (left is None or right is None):
        return None
    moving = None
    if spec is None:
        pairs: StoredSource = PairsSource.open(str(left), str(right))
        video = next((file for file in pairs.files if file.suffix.lower() in _VIDEOS), None)
        moving = None if video is None else (f"{video}: is a video, and calibrate takes images", "video:LEFT,RIGHT")
    else:
        check_source(spec)
        kind, colon, rest = spec.partition(":")
        if colon and kind in SOURCES and kind != "folder":
            moving = f"{spec}: calibrate takes stored images", spec
        else:
            pairs = FolderSource.open(rest if colon and kind == "folder" else spec)
    if moving is not None:
        raise InputError(
            f"{moving[0]}: `armsight record {moving[1]} -o DIR` stores them. Use "
            "boards that stand still; `armsight measure --skew find --save-rig` then finds the skew of the cameras"
        )
    return pairs
