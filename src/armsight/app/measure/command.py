"""``armsight measure``: where a target is and how it is turned, shot by shot."""

from __future__ import annotations

import contextlib
import json
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from armsight.app.measure.poses import csv_text, pose_record
from armsight.app.measure.view import CHART, View, view_folder
from armsight.app.progress import bar
from armsight.data import SIDES, Body, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError, InputError
from armsight.files import check_writable, write_text
from armsight.vision.detections import read_detections
from armsight.vision.follow.follower import Follower, follows
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import Composite, open_body, open_target
from armsight.vision.measure import measure, measure_seen, size_problem
from armsight.vision.rig import StereoRig
from armsight.vision.sources import PairsSource, Source, open_source

#: Shot, result, and where a body is followed how it was found and what is odd about that.
Result = tuple[Shot, PoseEstimate | Missed, dict[str, Any]]


@click.command("measure")
@click.argument("rig", metavar="RIG.json", type=click.Path(path_type=Path))
@click.option(
    "--target", required=True, metavar="SPEC|BODY", help="A board such as chessboard:9x6:25mm, or a body file."
)
@click.option("--left", metavar="GLOB", help="Left images; quote the glob.")
@click.option("--right", metavar="GLOB", help="Right images.")
@click.option("--source", metavar="SOURCE", help="A folder, video, stream or pair of cameras (see armsight record -h).")
@click.option("--detections", metavar="D.csv", type=click.Path(path_type=Path), help="Detections instead of images.")
@click.option("-o", "--out", metavar="POSES.csv", type=click.Path(path_type=Path), help="Write the poses as CSV.")
@click.option("--view", "view_dir", metavar="DIR", type=click.Path(path_type=Path), help="Write annotated pictures.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per shot.")
def command(
    rig: Path,
    target: str,
    left: str | None,
    right: str | None,
    source: str | None,
    detections: Path | None,
    out: Path | None,
    view_dir: Path | None,
    as_json: bool,
) -> None:
    """Say where a target is and how it is turned, in the left camera's frame, with its uncertainty.

    Give the images as --left and --right, as --source, or what was detected in them as --detections. A shot that cannot
    be read or does not show the target is a line that says why, and the run goes on.
    """
    given = [left is not None or right is not None, source is not None, detections is not None]
    if sum(given) != 1 or (left is None) != (right is None):
        raise InputError("give the shots one way: --left and --right, or --source, or --detections")
    stereo = StereoRig.load(rig)
    folder = None if view_dir is None else view_folder(view_dir)
    if out is not None:
        check_writable(out, apart_from=(rig, target, detections, folder and folder / CHART))
    if not stereo.cov.any():
        click.echo(f"note: {rig} does not say how well it is known: every ± is the pixel noise's share alone", err=True)
    records: list[dict[str, Any]] = []
    started = time.perf_counter()
    results: Iterator[Result]
    total: int | None
    discs: DiscTarget | None = None
    with contextlib.ExitStack() as stack:
        if detections is not None:
            body = open_body(target)
            shots = read_detections(detections, body)
            results = ((Shot(s.name, None, None), measure_seen(stereo, body, s), {}) for s in shots)
            total = len(shots)
        else:
            found = open_target(target)
            body, discs = found.body, found.discs if isinstance(found, Composite) else None
            opened = PairsSource(left, right) if left is not None and right is not None else open_source(str(source))
            stack.enter_context(contextlib.closing(opened))
            results = _measured(stereo, found, _shots(opened, stereo, rig))
            total = len(getattr(opened, "pairs", ())) or None
        view = None if folder is None else View(folder, stereo, body, discs, total)
        # What was measured is written whatever ends the run, and the one where the other cannot be.
        if view is not None:
            stack.callback(view.finish, records)
        if out is not None:
            stack.callback(_write, out, records)
        try:
            _run(results, total, body, records, as_json, view)
        except KeyboardInterrupt:
            kept = f", kept in {out}" if out is not None and records else ""
            click.echo(f"armsight: stopped after {len(records)} shots{kept}", err=True)
            raise
    _close(records, time.perf_counter() - started, out, view)


def _shots(source: Source, rig: StereoRig, path: Path) -> Iterator[Shot]:
    """Yield a source's shots; the first image that can be read must have the rig's size."""
    checked = False
    while (shot := source.read()) is not None:
        if not checked and shot.left is not None and shot.right is not None:
            checked = True
            for side, camera, image in zip(SIDES, rig.cameras, (shot.left, shot.right), strict=True):
                if (problem := size_problem(camera.image_size_px, image, side)) is not None:
                    raise InputError(f"{path}: shot {shot.name}: {problem}")
        yield shot


def _measured(rig: StereoRig, target: Target, shots: Iterator[Shot]) -> Iterator[Result]:
    """Measure shot after shot; a body of discs is followed from one to the next."""
    if not follows(target):
        yield from ((shot, measure(rig, target, shot), {}) for shot in shots)
        return
    click.echo("getting ready to follow (compiles for a minute or two the first time on a machine)", err=True)
    follower = Follower(rig, target)
    for shot in shots:
        begun = time.perf_counter()
        result = follower.measure(shot)
        way = {"way": follower.way, "jump": follower.jump, "took_ms": 1e3 * (time.perf_counter() - begun)}
        yield shot, result, way


def _run(
    results: Iterator[Result],
    total: int | None,
    body: Body,
    records: list[dict[str, Any]],
    as_json: bool,
    view: View | None,
) -> None:
    """Measure every shot, print its line, keep its record and draw it."""
    with bar("measuring", total) as advance:
        for shot, result, way in results:
            records.append({**pose_record(shot.name, shot.t_s, body, result), **way})
            click.echo(json.dumps(records[-1]) if as_json else _line(records[-1]))
            if view is not None:
                view.add(shot, result, records[-1])
            advance()


def _write(out: Path, records: list[dict[str, Any]]) -> None:
    """Write the poses, where there are any."""
    if records:
        write_text(out, csv_text(records))


def _line(record: dict[str, Any]) -> str:
    """Format one shot for people: mm and degrees, one sigma."""
    if record["status"] == "missed":
        return f"{record['shot']}: missed: {record['reason']}"
    sigma = np.sqrt(np.diag(record["covariance"]))
    position = " ".join(
        f"{axis} {1e3 * value:.3f} ± {1e3 * s:.3f}"
        for axis, value, s in zip("xyz", record["position_m"], sigma[:3], strict=True)
    )
    angles = " ".join(
        f"{n} {value:.3f}" for n, value in zip(("roll", "pitch", "yaw"), record["roll_pitch_yaw_deg"], strict=True)
    )
    turned = np.degrees(np.linalg.norm(sigma[3:]))
    dropped = len(record["dropped"])
    note = f", {dropped} point{'' if dropped == 1 else 's'} dropped" if dropped else ""
    note += f", misfit {record['misfit']:.1f}" if record["misfit"] > 1 else ""
    note += f", {record['jump']}" if record.get("jump") else ""
    singular = " (pitch singular: only roll and yaw together are determined)" if record["pitch_singular"] else ""
    return f"{record['shot']}: {position} mm, {angles} deg ± {turned:.3f}{singular}, {len(record['points_m'])} points{note}"


def _close(records: list[dict[str, Any]], seconds: float, out: Path | None, view: View | None) -> None:
    """Say on stderr what was measured and missed; raise where nothing was."""
    good = [r for r in records if r["status"] == "ok"]
    missed = [r for r in records if r["status"] == "missed"]
    if not records:
        raise ArmsightError("the source ended without a single shot")
    if not good:
        raise ArmsightError(
            f"none of {len(records)} shots could be measured; {missed[0]['shot']}: {missed[0]['reason']}"
        )
    summary = f"measured {len(good)} of {len(records)} shots in {seconds:.1f} s"
    summary += f", {len(missed)} missed (their lines say why)" if missed else ""
    ways = Counter(r["way"] for r in records if "way" in r)
    if ways:
        took = {way: np.median([r["took_ms"] for r in records if r["way"] == way]) for way in ways}
        summary += "; " + ", ".join(f"{count} {way} ({took[way]:.1f} ms each)" for way, count in ways.most_common())
    if jumps := [r["shot"] for r in records if r.get("jump")]:
        summary += f"; jumped in {', '.join(jumps[:5])}" + (f" and {len(jumps) - 5} more" if len(jumps) > 5 else "")
    if odd := sum(r["misfit"] > 1 for r in good):
        summary += f"; {odd} fit the body worse than the noise allows (misfit in their lines; their sigma holds it)"
    summary += f"; {view.summary()}" if view is not None else ""
    click.echo(summary + (f"; written to {out}" if out is not None else ""), err=True)
