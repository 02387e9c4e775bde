"""``armsight calibrate``: two cameras, from images of a calibration target or from detections of a known body."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click

from armsight.app.options import DETECTIONS, IS_RIG, JSON, declared, option, out
from armsight.app.show.messages import UNTRUSTED
from armsight.errors import InputError
from armsight.files import check_folder, check_outputs, check_writable
from armsight.vision.calibrate import FOLDS, MODELS


@dataclass(frozen=True)
class CalibrateOptions:
    """The options of ``armsight calibrate``, by their names; what each means is in its help."""

    source: str = option(
        "Images: 'pairs:L*.png,R*.png', quoted; usb:0,1, recorded first, or a recording, which shows the skew; or "
        "detections:D.csv of a body.",
        metavar="SOURCE",
    )
    alone: str | None = option("Globs of more images by one camera alone, or empty.", metavar="LEFT,RIGHT")
    target: str = option(
        "The target, such as chessboard:9x6:25mm (inner corners, square); of detections the body's points.",
        metavar="SPEC|BODY.csv",
    )
    lens_model: str | None = option("Distortion model; by default the held-out error chooses.", choices=MODELS)
    flat_target: bool = option("Do not estimate the target's deviation from its drawing.")
    cameras: Path | None = option("Intrinsics of both cameras, with detections.", metavar="CAMERAS.json")
    refine_body: Path | None = out(
        "OUT.csv", "Estimate the body's points too, and write them here.", "--refine-body", kind="^marker,"
    )
    folds: int = option("Parts for the held-out errors.", min=2, default=FOLDS)
    output: Path = out("RIG.json", "The rig to write.", kind=IS_RIG)
    report: Path | None = out("DIR", "Write a report with figures; needs armsight[report].", "--report", report=True)
    as_json: bool = JSON


@click.command("calibrate")
@declared
def command(o: CalibrateOptions) -> int:
    """Calibrate two cameras, and evaluate the calibration on pairs held out of the fit.

    From images of a board; from a recording of one that moves before cameras that may not expose at one time; or from
    detections of a known body with known intrinsics. Exit code 3: the images contradict each other, or the grade is poor:
    the rig must not be used.
    """
    images = not o.source.startswith(DETECTIONS)
    if images == (o.cameras is not None):
        needed = "detections need --cameras CAMERAS.json, the intrinsics"
        raise InputError("--cameras goes with detections; images show the intrinsics" if images else needed)
    if o.refine_body is not None and images:
        raise InputError("--refine-body goes with detections; a target in images is estimated without it")
    for name, chosen in (("--alone", o.alone), ("--lens-model", o.lens_model), ("--flat-target", o.flat_target)):
        if chosen and not images:
            raise InputError(f"{name} goes with images of a board; with detections, --cameras has the lenses")

    from armsight.app.calibrate.report import REPORT_FILES, calibration_report
    from armsight.app.calibrate.run import GivenDetections, GivenImages, provenance
    from armsight.app.show.plotting import require_matplotlib
    from armsight.vision.calibrate.weak import contradicted, require_order
    from armsight.vision.markers.board import open_board

    def check_report(outputs: Sequence[Path | None], inputs: Sequence[Path] = ()) -> None:
        if o.report is not None:
            problem = "no report can be written here"
            check_folder(o.report, holding=REPORT_FILES, apart_from=inputs, outputs=outputs, problem=problem)

    if o.report is not None:
        require_matplotlib()
    if images:  # before a person shows it to cameras
        open_board(o.target)
        check_writable(o.output)
        check_report([o.output])
    given = contextlib.closing(GivenImages(o)) if images else contextlib.nullcontext(GivenDetections(o))
    with given as opened:
        outputs = (o.output, o.refine_body, opened.board_file)
        check_outputs(outputs, opened.files)
        check_report(outputs, opened.files)
        started = time.perf_counter()
        calibration = opened.calibrated()
    require_order(calibration)
    rig = replace(calibration.rig, provenance=provenance(opened.named, calibration))
    calibration = replace(calibration, rig=rig, notes=(*opened.notes, *calibration.notes))
    calibration.rig.save(o.output)
    opened.save(calibration)
    found = calibration_report(calibration, o.output, opened.board_file, o.report, time.perf_counter() - started)
    if o.report is not None:
        found.write(o.report)
    found.echo(as_json=o.as_json)
    poor = contradicted(calibration) or found.values["grade"] == "poor"
    return UNTRUSTED if poor else 130 if opened.notes else 0
