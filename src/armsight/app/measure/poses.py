"""Measured poses as people and programs read them: a JSON line per shot, and a CSV.

Everything is in the left camera's frame; ``covariance`` is that of [translation m; rotation rad] along the axes of the
left camera (the true pose is the estimate turned by the rotation vector about the body's origin, and shifted), and
``covariance_body`` the same along the body's axes, as docs/concepts/conventions.md has it (perturbation on the right).
"""

from __future__ import annotations

import csv
import io
import math
from typing import Any

import numpy as np

from armsight.data import Body, Missed, PoseEstimate
from armsight.geometry.rotation import euler_zyx, quaternion_wxyz

#: Elements of a 6x6 covariance that are written.
UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
CSV_COLUMNS = (
    "shot",
    "status",
    "reason",
    "t_s",
    *(f"{axis}_m" for axis in "xyz"),
    *(f"q{axis}" for axis in "wxyz"),
    *(f"{angle}_deg" for angle in ("roll", "pitch", "yaw")),
    *(f"sigma_{axis}_m" for axis in "xyz"),
    *(f"sigma_r{axis}_rad" for axis in "xyz"),
    "residual_rms_m",
    "reprojection_rms_px",
    "misfit",
    "points",
    "dropped",
    *(f"cov_{i}{j}" for i, j in UPPER),
)


def pose_record(name: str, t_s: float | None, body: Body, result: PoseEstimate | Missed) -> dict[str, Any]:
    """Turn one shot's result into the object that ``measure --json`` prints."""
    head: dict[str, Any] = {"shot": name, "t_s": t_s}
    if isinstance(result, Missed):
        return {**head, "status": "missed", "reason": result.reason}
    T = result.T_left_body
    angles, singular = euler_zyx(T[:3, :3])
    names = body.point_names
    return {
        **head,
        "status": "ok",
        "reason": None,
        "position_m": T[:3, 3].tolist(),
        "quaternion_wxyz": quaternion_wxyz(T[:3, :3]).tolist(),
        "roll_pitch_yaw_deg": np.degrees(angles).tolist(),
        "pitch_singular": singular,
        "covariance": left_axes(T, result.cov).tolist(),
        "covariance_body": result.cov.tolist(),
        "residual_rms_m": _finite(result.residual_rms_m),
        "reprojection_rms_px": result.reprojection_rms_px,
        "misfit": result.misfit,
        "points_m": {names[i]: p.tolist() for i, p in zip(result.points.ids, result.points.p_left, strict=True)},
        "dropped": [{"point": d.point, "reason": d.reason} for d in result.dropped],
    }


def left_axes(T_left_body: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Turn a covariance of the right tangent into one along the left camera's axes."""
    R = T_left_body[:3, :3]
    blocks = cov.reshape(2, 3, 2, 3).swapaxes(1, 2)
    return np.asarray((R @ blocks @ R.T).swapaxes(1, 2).reshape(6, 6))


def _finite(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


def csv_text(records: list[dict[str, Any]]) -> str:
    """Return the CSV of many shots' records; ``cov_ij`` is the upper triangle of ``covariance``."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for r in records:
        row: list[Any] = [r["shot"], r["status"], r["reason"], r["t_s"]]
        if r["status"] == "ok":
            cov = np.array(r["covariance"])
            row += [*r["position_m"], *r["quaternion_wxyz"], *r["roll_pitch_yaw_deg"], *np.sqrt(np.diag(cov))]
            row += [r["residual_rms_m"], r["reprojection_rms_px"], r["misfit"], len(r["points_m"]), len(r["dropped"])]
            row += [cov[i, j] for i, j in UPPER]
        writer.writerow(["" if cell is None else cell for cell in row] + [""] * (len(CSV_COLUMNS) - len(row)))
    return out.getvalue()
