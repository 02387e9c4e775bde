"""``armsight calibrate``: two cameras from pictures of a board, or from detections of a known body."""

from __future__ import annotations

import importlib.metadata
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import cv2
from rich.console import Console
from rich.table import Table

from armsight.app.calibrate.report import report_folder, write_report
from armsight.app.progress import bar, steps
from armsight.data import SIDES, Detections
from armsight.errors import InputError
from armsight.files import check_writable
from armsight.vision.calibrate.boards import FOLDS, MODELS, Pair, calibrate_boards
from armsight.vision.calibrate.bodies import calibrate_bodies
from armsight.vision.calibrate.result import Calibration
from armsight.vision.camera_file import read_cameras
from armsight.vision.detections import read_detections
from armsight.vision.image import grey
from armsight.vision.markers.board import Board, open_board
from armsight.vision.markers.body_file import load_body_csv, save_body_csv
from armsight.vision.sources import PairsSource

Sizes = tuple[tuple[int, int], tuple[int, int]]


@click.command("calibrate")
@click.option("--left", metavar="GLOB", help="Left images; quote the glob.")
@click.option("--right", metavar="GLOB", help="Right images, matched to the left ones by sorted name.")
@click.option("--board", metavar="SPEC", help="The board, such as chessboard:9x6:25mm (inner corners, square).")
@click.option("--model", type=click.Choice(MODELS), help="Distortion model; by default the held-out error chooses.")
@click.option(
    "--flat-board", is_flag=True, help="Trust the print: do not estimate how the board differs from its drawing."
)
@click.option(
    "--detections", metavar="D.csv", type=click.Path(path_type=Path), help="Detections of a body, not images."
)
@click.option("--cameras", metavar="CAMERAS.json", type=click.Path(path_type=Path), help="Intrinsics of both cameras.")
@click.option("--body", metavar="BODY.csv", type=click.Path(path_type=Path), help="The body's points.")
@click.option(
    "--refine-body", metavar="OUT.csv", type=click.Path(path_type=Path), help="Improve the body; write it here."
)
@click.option(
    "--folds", type=click.IntRange(min=2), default=FOLDS, show_default=True, help="Parts for the held-out errors."
)
@click.option(
    "-o", "--out", required=True, metavar="RIG.json", type=click.Path(path_type=Path), help="The rig to write."
)
@click.option("--report", metavar="DIR", type=click.Path(path_type=Path), help="Write an HTML report with figures.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as one JSON object.")
def command(
    left: str | None,
    right: str | None,
    board: str | None,
    model: str | None,
    flat_board: bool,
    detections: Path | None,
    cameras: Path | None,
    body: Path | None,
    refine_body: Path | None,
    folds: int,
    out: Path,
    report: Path | None,
    as_json: bool,
) -> None:
    """Calibrate two cameras, and say on pairs left out of the fit how well they measure.

    From images: --left, --right and --board. From detections of a known body with known intrinsics: --detections,
    --cameras and --body.
    """
    images, points = (left, right, board), (detections, cameras, body)
    if (None in images) == (None in points) or any(images) == any(points):
        raise InputError("give --left, --right and --board, or --detections, --cameras and --body")
    if refine_body is not None and detections is None:
        raise InputError("--refine-body goes with --detections; a board in images is estimated by itself")
    check_writable(out, apart_from=(refine_body, *points))
    if refine_body is not None:
        check_writable(refine_body, apart_from=points)
    if report is not None:
        report_folder(report)
    started = time.perf_counter()
    if left is not None and right is not None and board is not None:
        models = MODELS if model is None else (model,)
        calibration = _from_images(left, right, open_board(board), models, flat_board, folds)
        said: dict[str, Any] = {"left": left, "right": right, "board": board}
    elif detections is not None and cameras is not None and body is not None:
        known, pair = load_body_csv(body), read_cameras(cameras)
        with steps() as progress:
            shots = read_detections(detections, known)
            calibration = calibrate_bodies(
                known, shots, pair, refine_body=refine_body is not None, folds=folds, progress=progress
            )
        said = {"detections": str(detections), "cameras": str(cameras), "body": str(body)}
    calibration = replace(calibration, rig=replace(calibration.rig, provenance=_provenance(said, calibration)))
    if refine_body is not None:
        save_body_csv(calibration.body, refine_body)
    calibration.rig.save(out)
    if report is not None:
        write_report(calibration, report)
    if as_json:
        click.echo(json.dumps(_summary(calibration, out, report, time.perf_counter() - started)))
    else:
        _tell(calibration, out, report)


def _from_images(left: str, right: str, board: Board, models: tuple[str, ...], flat: bool, folds: int) -> Calibration:
    """Detect the board in every pair of images and calibrate."""
    source = PairsSource(left, right)
    pairs: list[Pair] = []
    sizes: Sizes | None = None
    with bar("looking for the board", len(source.pairs)) as advance:
        for stored in source.pairs:
            shot = stored.load()
            if shot.left is None or shot.right is None:
                nothing = Detections.none(shot.problem or "no image")
                pairs.append(Pair(shot.name, nothing, Detections(nothing.ids, nothing.uv, nothing.cov_uv)))
            else:
                now = tuple((image.shape[1], image.shape[0]) for image in (shot.left, shot.right))
                sizes = _same(sizes, (now[0], now[1]), stored.left, stored.right)
                pairs.append(Pair(shot.name, board.detect(grey(shot.left)), board.detect(grey(shot.right))))
            advance()
    if sizes is None:
        raise InputError(f"none of {len(pairs)} pairs can be read; {pairs[0].name}: {pairs[0].left.problem}")
    with steps() as progress:
        return calibrate_boards(board, pairs, sizes, models=models, flat=flat, folds=folds, progress=progress)


def _same(sizes: Sizes | None, now: Sizes, left: Path | None, right: Path | None) -> Sizes:
    """Hold every image to the size of the first one."""
    for side, path in enumerate((left, right)):
        if sizes is not None and sizes[side] != now[side]:
            (w, h), (w0, h0) = now[side], sizes[side]
            raise InputError(
                f"{path}: is {w}x{h}, the {SIDES[side]} images before it are {w0}x{h0}: a calibration needs one size"
            )
    return now


def _provenance(said: dict[str, Any], calibration: Calibration) -> dict[str, Any]:
    """Say where the rig comes from."""
    h = calibration.heldout
    return {
        "made_by": f"armsight {importlib.metadata.version('armsight')} calibrate, OpenCV {cv2.__version__}",
        **said,
        "pairs_used": len(calibration.pairs),
        "heldout_epipolar_rms_px": h.epipolar_rms_px,
        "heldout_rigid_rms_m": h.rigid_rms_m,
        "heldout_scale_error": h.scale_error,
    }


def _summary(calibration: Calibration, out: Path, report: Path | None, seconds: float) -> dict[str, Any]:
    """Return the object that ``--json`` prints."""
    c = calibration
    return {
        "pairs_found": c.pairs_found,
        "pairs_used": len(c.pairs),
        "rejected": [{"pair": r.pair, "reason": r.reason} for r in c.rejected],
        "notes": list(c.notes),
        "weaknesses": list(c.weaknesses),
        "fit": {"epipolar_rms_px": c.epipolar_rms_px, "reprojection_rms_px": c.reprojection_rms_px},
        "heldout": vars(c.heldout),
        "models": {name: vars(heldout) for name, heldout in c.models.items()},
        "baseline_m": c.rig.baseline_m,
        "convergence_deg": c.rig.convergence_deg,
        "distortion_model": c.rig.left.model,
        "sigma_px": c.rig.sigma_px,
        "body_deviation_rms_m": c.deviation_m,
        "rig": str(out),
        "report": str(report / "index.html") if report is not None else None,
        "seconds": seconds,
    }


def _tell(calibration: Calibration, out: Path, report: Path | None) -> None:
    """Print the held-out table first, then the fit, then what is weak."""
    c, h = calibration, calibration.heldout
    console = Console(highlight=False, soft_wrap=True)
    table = Table(title=f"Held-out errors: {h.folds} folds, fitted on the rest, measured on what was left out")
    for column in ("epipolar RMS", "board against a perfect one, RMS", "scale error", "residual over its sigma"):
        table.add_column(column, justify="right")
    table.add_row(
        f"{h.epipolar_rms_px:.3f} px",
        f"{1e3 * h.rigid_rms_m:.3f} mm",
        f"{100 * h.scale_error:+.3f} %",
        f"{h.normalised_rms:.2f}",
    )
    console.print(table)
    console.print(
        f"fit: epipolar {c.epipolar_rms_px:.3f} px, reprojection {c.reprojection_rms_px:.3f} px RMS; {len(c.pairs)} of "
        f"{c.pairs_found} pairs; distortion {c.rig.left.model}; corner noise {c.rig.sigma_px:.3f} px"
    )
    console.print(
        f"baseline {1e3 * c.rig.baseline_m:.2f} mm, convergence {c.rig.convergence_deg:.2f} deg; the body differs from its "
        f"drawing by {1e3 * c.deviation_m:.3f} mm RMS"
    )
    for rejected in c.rejected:
        console.print(f"rejected {rejected.pair}: {rejected.reason}", markup=False)
    for note in c.notes:
        console.print(f"note: {note}", markup=False)
    for weakness in c.weaknesses:
        console.print(f"weak: {weakness}", markup=False)
    console.print(f"rig written to {out}" + (f", report to {report / 'index.html'}" if report is not None else ""))
