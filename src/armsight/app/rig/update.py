"""``armsight rig update``: the relative pose of the cameras estimated again from what a run saw, and its page."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.check.run_folder import require_known
from armsight.app.show.page import writable_folder
from armsight.app.show.report import Report
from armsight.app.show.table import TextTable
from armsight.data import Missed
from armsight.errors import InputError
from armsight.files import read_json
from armsight.loop.health.rig import TEST_S
from armsight.loop.health.update import DEPTHS_M, LEAST_STAYS, RigUpdate, updated_rig
from armsight.vision.detections import SeenShot, detection_times, read_detections
from armsight.vision.markers.targets import open_body
from armsight.vision.rig import StereoRig

_FILES = {"rig": "rig.json", "body": "body.toml", "detections": "detections.csv"}


def update(run: Path, output: Path, since_s: float | None, report: Path | None) -> tuple[dict[str, Any], list[str]]:
    """Estimate the relative pose of a run's cameras again; write the rig, and a page where one is asked for.

    ``since_s``: only shots from this time on are used, board's clock, s; None: from when the run itself found that the
    cameras had moved, or all.
    """
    files = {name: run / file for name, file in _FILES.items()}
    for file in files.values():
        if not file.is_file():
            raise InputError(f"{file}: no such file; RUN is the folder of `armsight run` or `armsight demo`")
    require_known(run)
    rig, body = StereoRig.load(files["rig"]), open_body(str(files["body"]))
    folder = None if report is None else writable_folder(report, "no page")
    shots = read_detections(files["detections"], body)
    since_s = _found_since(run) if since_s is None else since_s
    used, before = shots, list[SeenShot]()
    if since_s is not None:
        times = detection_times(files["detections"])
        used = [shot for shot in shots if times.get(shot.name, -math.inf) >= since_s]
        before = [shot for shot in shots if times.get(shot.name, math.inf) < since_s - TEST_S]
    if not used:
        raise InputError(f"{files['detections']}: no shot from {since_s:g} s on; it has {len(shots)} shots")
    found = updated_rig(rig, body, used, before if len(before) >= LEAST_STAYS else ())
    if isinstance(found, Missed):
        raise InputError(f"{run}: the rig is not updated: {found.reason}")
    made = {"command": "rig update", "run": str(run), "since_s": since_s, "shots": found.shots}
    new = replace(found.rig, provenance=made | {"before": dict(rig.provenance)})
    new.save(output)
    answer = {"rig": str(output), "run": str(run), "since_s": since_s, **found.figures()}
    if folder is not None:
        answer["report"] = str(_page(rig, new, found, run, since_s).write(folder))
    return answer, [*found.lines(), f"written to {output}"]


def _found_since(run: Path) -> float | None:
    """Return since when a run found that its cameras had moved against each other, s; None where it did not."""
    file = run / "summary.json"
    try:
        health = read_json(file).get("health", [])
        since = [each["since_s"] for each in health if each["cause"] == "rig"]
    except (InputError, AttributeError, KeyError, TypeError):
        return None
    return float(since[0]) if since and isinstance(since[0], int | float) else None


def _page(old: StereoRig, new: StereoRig, found: RigUpdate, run: Path, since_s: float | None) -> Report:
    head = (
        ("right camera rotated by", f"{np.degrees(found.rotation_rad):.3f} ± {np.degrees(found.sigma_rad):.3f} deg"),
        ("shifted across the baseline by", f"{1e3 * found.shift_m:.3f} mm"),
        *(
            (
                f"depth error of the old rig at {depth:g} m",
                f"{1e3 * value:+.2f} mm" if math.isfinite(value) else "unknown",
            )
            for depth, value in zip(DEPTHS_M, found.depth_errors_m, strict=True)
        ),
        (
            "epipolar distance (Sampson), RMS",
            f"{found.epipolar_px[0]:.3f} px before, {found.epipolar_px[1]:.3f} px after",
        ),
        ("shots used; of these differing", f"{found.shots}; {found.stays}"),
        ("from", "all shots" if since_s is None else f"{since_s:.1f} s on"),
    )
    sigmas = (np.sqrt(np.maximum(np.diag(rig.cov), 0.0)) for rig in (old, new))
    values = (np.concatenate([*(c.parameters for c in rig.cameras), rig.T_left_right[:3, 3]]) for rig in (old, new))
    rows = [
        (name, f"{a:.6g}", f"{sa:.2g}", f"{b:.6g}", f"{sb:.2g}")
        for name, a, sa, b, sb in zip(
            new.parameter_names, *(column for pair in zip(values, sigmas, strict=True) for column in pair), strict=False
        )
    ]
    tables = TextTable("", ("", ""), head), TextTable("", ("", "old", "sigma", "new", "sigma"), tuple(rows))
    sections = {"figures": ("What changed", tables[:1]), "rigs": ("Old and new rig", tables[1:])}
    return Report("rig update", "Rig updated", str(run), "", sections)
