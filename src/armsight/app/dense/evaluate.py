"""The evaluation of dense methods: one line a scene and method, averages, table, CSV and error maps."""

from __future__ import annotations

import csv
import io
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armsight.app.dense.files import paint_disparity, paint_errors, write_png
from armsight.app.show.encode import json_of
from armsight.files import made_folder, write_text
from armsight.vision.dense import open_method
from armsight.vision.dense.evaluate import DisparityErrors, evaluate_disparity
from armsight.vision.dense.middlebury import MiddleburyScene
from armsight.vision.dense.rectified import plain_grey


@dataclass(frozen=True)
class SceneResult:
    """The errors and the speed of a method on a scene."""

    scene: str
    method: str
    weight: float
    all_pixels: DisparityErrors  #: errors over all pixels with a truth
    nonocc: DisparityErrors  #: over those that both cameras see
    measured: DisparityErrors  #: over those that the method measured, of the ones both cameras see
    density_percent: float  #: share of the pixels with a truth that was measured, not filled
    within_percent: float  #: share of the measured ones both cameras see whose error is below 1.96 sigma.
    seconds: float
    rate: float  #: millions of pixels times disparities a second

    def to_json(self) -> dict[str, Any]:
        """Return the line by names."""
        sets = {"all": self.all_pixels, "nonocc": self.nonocc, "measured_nonocc": self.measured}
        return {
            "scene": self.scene,
            "method": self.method,
            "weight": self.weight,
            **{name: errors.to_json() for name, errors in sets.items()},
            "density_percent": self.density_percent,
            "within_95_percent": self.within_percent,
            "seconds": self.seconds,
            "mpx_disparities_per_s": self.rate,
        }


def evaluate_scene(scene: MiddleburyScene, name: str, out: Path | None) -> SceneResult:
    """Match a scene by a method and evaluate the result; with a folder, write its error map there."""
    method, truth = open_method(name), scene.truth
    left, right = plain_grey(scene.left, "left"), plain_grey(scene.right, "right")
    method.match(left, right, scene.search)  # once before the clock runs: what is compiled, is compiled now
    begun = time.perf_counter()
    result = method.match(left, right, scene.search)
    seconds = time.perf_counter() - begun
    if out is not None:
        made_folder(out)
        write_png(out / f"{scene.name}_{name}_errors.png", paint_errors(result.disparity, truth))
        write_png(out / f"{scene.name}_{name}.png", paint_disparity(result))
    sure = result.measured & truth.seen & truth.known
    off = np.abs(result.disparity - truth.disparity)[sure]
    within = 100 * float(np.mean(off <= 1.96 * result.sigma_px[sure])) if off.size else float("nan")
    return SceneResult(
        scene.name,
        name,
        scene.weight,
        evaluate_disparity(result.disparity, truth, truth.known),
        evaluate_disparity(result.disparity, truth, truth.seen),
        evaluate_disparity(result.disparity, truth, sure),
        100 * float(result.measured[truth.known].mean()),
        within,
        seconds,
        left.size * scene.search.count / seconds / 1e6,
    )


def averages(lines: list[SceneResult]) -> dict[str, dict[str, float]]:
    """Return each method's bad shares (%) over all pixels and both-seen ones, averaged over scenes with their weights."""
    found: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(line.method for line in lines):
        mine = [line for line in lines if line.method == name]
        weights = [line.weight for line in mine]
        found[name] = {
            f"{kind}_{key}": float(np.average([line.to_json()[kind][key] for line in mine], weights=weights))
            for kind in ("all", "nonocc")
            for key in mine[0].all_pixels.to_json()
            if key != "pixels"
        }
    return found


def evaluation_json(lines: list[SceneResult]) -> dict[str, Any]:
    """Return an evaluation as one object; numbers that are not there are null."""
    found: dict[str, Any] = {"scenes": [line.to_json() for line in lines], "weighted_average": averages(lines)}
    return {key: json_of(value) for key, value in found.items()}


def table_text(lines: list[SceneResult]) -> str:
    """Return a table for people: shares in %, errors in px, over all pixels / those both cameras see."""
    titles = ("bad-0.5", "bad-1", "bad-2", "bad-4", "mean", "RMS", "A50", "A90", "A95", "A99")
    head = f"{'scene':<12}{'method':<12}" + "".join(f"{t:>14}" for t in titles)
    text = [head + f"{'density':>9}{'within':>8}{'s':>8}{'Mpx*d/s':>9}"]
    for line in lines:
        a, b = (_numbers(errors) for errors in (line.all_pixels, line.nonocc))
        columns = "".join(f"{x:>7.2f}/{y:<6.2f}" for x, y in zip(a, b, strict=True))
        text.append(
            f"{line.scene:<12}{line.method:<12}{columns}{line.density_percent:>8.1f}%{line.within_percent:>7.1f}%"
            f"{line.seconds:>8.3f}{line.rate:>9.0f}"
        )
    for name, means in averages(lines).items():
        keys = [key.removeprefix("all_") for key in means if key.startswith("all_")]
        columns = "".join(f"{means['all_' + k]:>7.2f}/{means['nonocc_' + k]:<6.2f}" for k in keys)
        text.append(f"{'(average)':<12}{name:<12}{columns}")
    text.append(
        "all pixels with a truth / those both cameras see, gaps filled; within: measured ones inside 1.96 sigma"
    )
    return "\n".join(text)


def _numbers(errors: DisparityErrors) -> list[float]:
    return [*errors.bad_percent, errors.average_px, errors.rms_px, *errors.quantiles_px]


def write_evaluation(out: Path, lines: list[SceneResult]) -> None:
    """Write table.csv: one row a scene and method."""
    text = io.StringIO()
    rows = []
    for line in lines:
        flat = dict(line.to_json())
        for kind in ("all", "nonocc", "measured_nonocc"):
            flat.update({f"{kind}_{key}": value for key, value in flat.pop(kind).items()})
        rows.append(flat)
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(out / "table.csv", text.getvalue())
