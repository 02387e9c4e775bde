"""The tables of a calibration's report as HTML; whatever comes from outside is escaped."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from armsight.app.report.plotting import plain
from armsight.app.calibrate.assessment import judged, target
from armsight.app.report_volume import SHARES, board_points, corner_variance_px2, predicted_sigmas
from armsight.data import Array
from armsight.geometry.pose import exp_se3
from armsight.geometry.rotation import log_so3
from armsight.vision.calibrate.result import Calibration, HeldOut
from armsight.vision.rig import StereoRig

_STEP_RAD = 1e-6
_ROUNDING = 1e-12


def text(value: object) -> str:
    """Return a value as text that is safe anywhere in the page."""
    return html.escape(plain(str(value), most=2000))


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return a table of cells that are HTML already; the first cell of a row names it."""
    top = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>' + "".join(f"<td>{cell}</td>" for cell in rest) + "</tr>\n"
        for first, *rest in rows
    )
    return f'<table class="{kind}"><thead><tr>{top}</tr></thead>\n<tbody>\n{body}</tbody></table>\n'


def bullets(lines: Iterable[str]) -> str:
    """Return a list of plain lines, escaped."""
    return "<ul>" + "".join(f"<li>{text(line)}</li>\n" for line in lines) + "</ul>\n"


def headline_table(calibration: Calibration) -> str:
    """Return the held-out figures beside those of the fit, each with what it means and how good it is."""
    rows = [
        (
            text(row.name),
            f"<b>{text(row.heldout)}</b>",
            text(row.fit),
            f'<span class="grade {row.grade}">{row.grade}</span>' if row.grade else "your call",
            text(row.meaning),
        )
        for row in judged(calibration)
    ]
    fit = f"{calibration.reprojection_rms_px:.3g} px"
    meaning = "How well the fitted model reproduces the points it was fitted to. It says nothing about millimetres."
    rows.append(("reprojection RMS", "–", fit, "", meaning))
    head = ("", f"held out, {calibration.heldout.folds} folds", "fit", "", "what it tells")
    return table(head, rows, "headline")


def models_table(calibration: Calibration) -> str:
    """Return the distortion models that were tried, with their held-out errors."""

    def row(name: str, h: HeldOut) -> tuple[str, ...]:
        chosen = "<b>chosen</b>" if name == calibration.rig.left.model else ""
        figures = (f"{h.epipolar_rms_px:.4f}", f"{1e3 * h.rigid_rms_m:.4f}", f"{100 * h.scale_error:+.3f}")
        return (text(name), *figures, f"{h.normalised_rms:.2f}", chosen)

    head = ("model", "epipolar RMS, px", "rigid RMS, mm", "scale error, %", "residual / sigma", "")
    return table(head, [row(name, h) for name, h in calibration.models.items()], "numbers")


def _with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """Return a value to the digits its sigma allows, with the sigma; "given" where it was not estimated."""
    if not sigma > _ROUNDING * max(abs(value), 1.0):
        return f"{value:.6g}{unit} <i>given</i>"
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}{unit}"


def cameras_table(rig: StereoRig) -> str:
    """Return intrinsics and distortion of both cameras with their sigmas."""
    sigma, n_left = np.sqrt(np.diag(rig.cov)), rig.left.parameters.size
    cells: dict[str, list[str]] = {}
    for k, (name, value) in enumerate(
        zip(rig.parameter_names, np.r_[rig.left.parameters, rig.right.parameters], strict=False)
    ):
        label = name.split(".", 1)[1].replace("_px", ", px")
        cells.setdefault(label, ["–", "–"])[k >= n_left] = _with_sigma(float(value), float(sigma[k]))
    rows = [("image, px", *("{} x {}".format(*camera.image_size_px) for camera in rig.cameras))]
    rows.append(("distortion model", *(text(camera.model) for camera in rig.cameras)))
    return table(("", "left", "right"), [*rows, *((name, *both) for name, both in cells.items())], "numbers")


def pose_table(rig: StereoRig) -> str:
    """Return where the right camera stands in the left one's frame, mm and degrees, with sigmas."""
    cov, T = rig.cov[-6:, -6:], rig.T_left_right
    rotation, J = log_so3(T[:3, :3]), np.empty((3, 6))
    for k, axis in enumerate(np.eye(6)):
        ends = [log_so3((T @ exp_se3(h * axis))[:3, :3]) for h in (_STEP_RAD, -_STEP_RAD)]
        J[:, k] = (ends[0] - ends[1]) / (2 * _STEP_RAD)
    cov_t = T[:3, :3] @ cov[:3, :3] @ T[:3, :3].T  # the tangent's translation is along the right camera's axes
    sigma_mm, sigma_deg = 1e3 * np.sqrt(np.diag(cov_t)), np.degrees(np.sqrt(np.diag(J @ cov @ J.T)))
    toward = T[:3, 3] / max(rig.baseline_m, 1e-12)
    rows = [("baseline, mm", _with_sigma(1e3 * rig.baseline_m, 1e3 * float(np.sqrt(toward @ cov_t @ toward))))]
    rows += [
        (f"{axis}, mm", _with_sigma(1e3 * value, s)) for axis, value, s in zip("XYZ", T[:3, 3], sigma_mm, strict=True)
    ]
    rows.append(("angle between the optical axes, degrees", f"{rig.convergence_deg:.3f}"))
    rows += [
        (f"rotation vector {axis}, degrees", _with_sigma(float(np.degrees(value)), s))
        for axis, value, s in zip("XYZ", rotation, sigma_deg, strict=True)
    ]
    return table(("T_left_right", "value ± one sigma"), rows, "numbers")


def sigma_table(calibration: Calibration) -> str:
    """Return the predicted sigmas at the nearest, the middle and the farthest board."""
    middle = board_points(calibration).mean(axis=1)
    order = np.argsort(middle[:, 2])
    chosen: Array = middle[order[[0, len(order) // 2, -1]]]
    depth, lateral = predicted_sigmas(calibration.rig, chosen, corner_variance_px2(calibration))
    rows, what = [], target(calibration)
    for k, name in enumerate(("nearest", "middle", "farthest")):
        figures = [f"{1e3 * s[k]:.2g}" if np.isfinite(s[k]) else "not seen by both" for s in (*depth, *lateral)]
        rows.append((f"{name} {what}, Z {1e3 * chosen[k, 2]:.0f} mm", *figures))
    head = ("sigma, mm", *(f"{kind}: {share}" for kind in ("depth", "lateral") for share in SHARES))
    return table(head, rows, "numbers")


def provenance_table(provenance: Mapping[str, Any]) -> str:
    """Return where a rig comes from, as its file will say."""
    rows = [
        (text(key), text(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)))
        for key, value in provenance.items()
    ]
    return table(("", ""), rows, "provenance") if rows else "<p>Nothing is recorded.</p>"
