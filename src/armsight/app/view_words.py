"""What is written above a shot's picture, and the sigmas of roll, pitch and yaw that it and the chart show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from armsight.data import Array
from armsight.geometry.rotation import exp_so3


def header(record: Mapping[str, Any]) -> list[str]:
    """Return the lines above a shot's picture, mm and degrees, one sigma behind each +-.

    Args:
        record: the shot as ``measure --json`` prints it.
    """
    first = [f"shot {record['shot']}"]
    if record["t_s"] is not None:
        first.append(f"t {record['t_s']:.3f} s")
    if "way" in record:
        first.append(f"{record['way']}, {record['took_ms']:.1f} ms")
    if record.get("jump"):
        first.append(str(record["jump"]))
    if record["status"] != "ok":
        return [", ".join(first)]
    sigma = 1e3 * np.sqrt(np.diag(record["covariance"])[:3])
    place = _pairs(("x", "y", "z"), 1e3 * np.array(record["position_m"]), sigma)
    turn = _pairs(("roll", "pitch", "yaw"), np.array(record["roll_pitch_yaw_deg"]), angle_sigmas_deg(record))
    singular = " (pitch singular: only roll and yaw together are determined)" if record["pitch_singular"] else ""
    count, dropped = len(record["points_m"]), len(record["dropped"])
    fit = f"reprojection {record['reprojection_rms_px']:.3f} px RMS, misfit {record['misfit']:.1f}, {count} points"
    return [", ".join(first), f"{place} mm; {turn} deg{singular}", fit + (f", {dropped} dropped" if dropped else "")]


def _pairs(names: tuple[str, ...], values: Array, sigmas: Array) -> str:
    """Format values with their sigmas; one that is not determined has none."""
    return ", ".join(
        f"{name} {value:.3f}" + (f" +- {sigma:.3f}" if np.isfinite(sigma) else "")
        for name, value, sigma in zip(names, values, sigmas, strict=True)
    )


def angle_sigmas_deg(record: Mapping[str, Any]) -> Array:
    """Return (3,) one sigma of roll, pitch and yaw of a measured shot, degrees; NaN where the pitch is singular.

    A turn of the body by the rotation vector w along the left camera's axes changes the angles by J^-1 w; the columns of
    J are the axes that roll, pitch and yaw turn about, R = R_z(roll) R_y(pitch) R_x(yaw).
    """
    if record["pitch_singular"]:
        return np.full(3, np.nan)
    roll, pitch, _ = np.radians(record["roll_pitch_yaw_deg"])
    of_roll, of_pitch = exp_so3(np.array([0.0, 0.0, roll])), exp_so3(np.array([0.0, pitch, 0.0]))
    J = np.column_stack([[0.0, 0.0, 1.0], of_roll[:, 1], (of_roll @ of_pitch)[:, 0]])
    back = np.linalg.inv(J)
    return np.asarray(np.degrees(np.sqrt(np.diag(back @ np.array(record["covariance"])[3:, 3:] @ back.T))))
