"""What a person is told of a run: mm and degrees."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

_TRACKS = {
    "potentiometers": "potentiometers",
    "vision": "vision",
    "fused": "fused, smoothed",
    "live": "fused, live",
}
_DEG = float(np.degrees(1.0))


def tell(summary: Mapping[str, Any], out: Path) -> None:
    """Print a run's figures."""
    console = Console(highlight=False, soft_wrap=True)
    if "vision" in summary:
        console.print(_tracks(summary))
    if "closed_loop" in summary:
        console.print(_closed(summary["closed_loop"]))
    if "occlusion" in summary:
        hidden = summary["occlusion"]
        console.print(
            f"body hidden for {hidden['duration_s']:g} s in motion: the fused estimate was off by "
            f"{1e3 * hidden['fused_position_max_m']:.2f} mm at most"
        )
    if "latency_s" in summary:
        late = {name: 1e3 * value for name, value in summary["latency_s"].items()}
        console.print(
            f"image to command: p50 {late['p50']:.2f} ms, p99 {late['p99']:.2f} ms, longest {late['max']:.1f} ms"
        )
    shots = summary.get("shots")
    if shots:
        console.print(
            f"{shots['measured']} shots measured, {shots['missed']} missed, {shots['rejected']} not believed by the "
            "estimator; run.log says why"
        )
    console.print(f"{out / 'report.html'} shows the run; {summary.get('wall_s', float('nan')):.0f} s")


def _tracks(summary: Mapping[str, Any]) -> Table:
    """Return the table of the three tracks."""
    table = Table(title="The tool in motion, against the truth")
    for column in ("", "position RMS", "max", "at rest RMS", "turn RMS", "sigma claimed"):
        table.add_column(column, justify="right" if column else "left", no_wrap=not column)
    for name, shown in _TRACKS.items():
        t = summary[name]
        sigma = f"{1e3 * t['position_sigma_rms_m']:.3f} mm" if "position_sigma_rms_m" in t else "none"
        table.add_row(
            shown,
            f"{1e3 * t['position_rms_m']:.3f} mm",
            f"{1e3 * t['position_max_m']:.3f} mm",
            f"{1e3 * t['rest_position_rms_m']:.3f} mm",
            f"{_DEG * t['orientation_rms_rad']:.3f} deg",
            sigma,
        )
    return table


def _closed(c: Mapping[str, float]) -> Table:
    """Return the table of what closing the loop gained."""
    table = Table(title="How far the tool is from where it is to be")
    for column in ("", "potentiometers alone", "loop closed", "times smaller"):
        table.add_column(column, justify="right" if column else "left")
    for what, key in (("at rest, RMS", "rest"), ("from the path, RMS", "path")):
        if f"{key}_error_after_m" not in c:
            continue
        before, after = c[f"{key}_error_before_m"], c[f"{key}_error_after_m"]
        table.add_row(what, f"{1e3 * before:.3f} mm", f"{1e3 * after:.3f} mm", f"{before / after:.1f}")
    return table
