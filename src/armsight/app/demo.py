"""The main job on a rendered recording with truth: calibrate, measure, and hold every figure against the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.stats import chi2

from armsight.app.poses import csv_text, pose_record
from armsight.data import Array, Image, Missed, PoseEstimate, Record
from armsight.errors import ArmsightError
from armsight.files import replacing, write_text
from armsight.geometry.pose import inverse, log_se3
from armsight.sim.bench import BOARD, demo_recording
from armsight.sim.recording import Truth
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.result import Calibration
from armsight.vision.image import grey
from armsight.vision.markers.board import open_board
from armsight.vision.markers.targets import open_target
from armsight.vision.measure import measure
from armsight.vision.rig import StereoRig
from armsight.vision.sources import FolderSource

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class DemoResult(Record):
    """What the demo measured, against the truth.

    Attributes:
        calibration: of the rendered board.
        truth: of the measured shots.
        estimates: one per shot: the pose, or why there is none.
        errors: (N, 6) tangents from the estimate to the truth, [m; rad], body axes; NaN where a shot was missed.
        sigmas: (N, 6) predicted standard deviations of the same.
        inside: (N,) squared error in standard deviations (6 degrees of freedom).
        picture: the first measured image with the pose drawn in.
    """

    calibration: Calibration
    truth: Truth
    estimates: tuple[PoseEstimate | Missed, ...]
    errors: Array
    sigmas: Array
    inside: Array
    picture: Image

    def summary(self) -> dict[str, Any]:
        """Return the figures, SI units in the keys."""
        good = np.isfinite(self.inside)
        position, turned = (np.linalg.norm(self.errors[good][:, part], axis=1) for part in (slice(3), slice(3, 6)))
        held, rig, true = self.calibration.heldout, self.calibration.rig, self.truth.rig
        return {
            "shots": len(good),
            "measured": int(good.sum()),
            "position_rms_m": _rms(position),
            "position_max_m": float(position.max()),
            "position_sigma_rms_m": _rms(np.linalg.norm(self.sigmas[good][:, :3], axis=1)),
            "orientation_rms_rad": _rms(turned),
            "orientation_max_rad": float(turned.max()),
            "orientation_sigma_rms_rad": _rms(np.linalg.norm(self.sigmas[good][:, 3:], axis=1)),
            "inside_95_share": float((self.inside[good] <= chi2.ppf(0.95, 6)).mean()),
            "heldout_epipolar_rms_px": held.epipolar_rms_px,
            "heldout_rigid_rms_m": held.rigid_rms_m,
            "baseline_error_m": rig.baseline_m - true.baseline_m,
            "focal_error_px": float(rig.left.intrinsics[0] - true.left.intrinsics[0]),
        }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def run_demo(folder: Path, *, seed: int = 0, progress: Progress = lambda message: None) -> DemoResult:
    """Render a recording, calibrate on its board, measure its end-effector, compare with the truth.

    Args:
        folder: receives the recording, ``rig.json``, ``poses.csv`` and ``pose.png``.
        seed: of poses, background and noise.
        progress: called with a line about what is being done.

    Raises:
        ArmsightError: a file cannot be written, or nothing was measured.
    """
    progress("rendering a recording with truth")
    of_board, of_arm = demo_recording(folder, seed=seed)
    progress("looking for the board")
    board = open_board(BOARD)
    pairs = []
    source = FolderSource(str(folder / "board"))
    while (shot := source.read()) is not None:
        assert shot.left is not None
        assert shot.right is not None
        pairs.append(Pair(shot.name, board.detect(grey(shot.left)), board.detect(grey(shot.right))))
    sizes = (of_board.rig.left.image_size_px, of_board.rig.right.image_size_px)
    calibration = calibrate_boards(board, pairs, sizes, progress=progress)
    calibration.rig.save(folder / "rig.json")
    progress("measuring the end-effector")
    target = open_target(str(folder / "plate.toml"))
    estimates, records, picture = [], [], None
    source = FolderSource(str(folder / "arm"))
    while (shot := source.read()) is not None:
        estimate = measure(calibration.rig, target, shot)
        estimates.append(estimate)
        records.append(pose_record(shot.name, shot.t_s, target.body, estimate))
        if picture is None and isinstance(estimate, PoseEstimate) and shot.left is not None:
            picture = drawn(calibration.rig, grey(shot.left), estimate)
    write_text(folder / "poses.csv", csv_text(records))
    if picture is None:
        raise ArmsightError(f"none of the {len(estimates)} rendered shots could be measured")
    with replacing(folder / "pose.png", "wb") as file:
        file.write(cv2.imencode(".png", picture)[1].tobytes())
    return _compared(calibration, of_arm, estimates, picture)


def _compared(
    calibration: Calibration, truth: Truth, estimates: list[PoseEstimate | Missed], picture: Image
) -> DemoResult:
    """Hold every estimate against the truth."""
    errors, sigmas = np.full((len(estimates), 6), np.nan), np.full((len(estimates), 6), np.nan)
    inside = np.full(len(estimates), np.nan)
    for n, estimate in enumerate(estimates):
        if isinstance(estimate, PoseEstimate):
            errors[n] = log_se3(inverse(estimate.T_left_body) @ truth.Ts_left_body[n])
            sigmas[n] = np.sqrt(np.diag(estimate.cov))
            inside[n] = errors[n] @ np.linalg.solve(estimate.cov, errors[n])
    return DemoResult(calibration, truth, tuple(estimates), errors, sigmas, inside, picture)


def drawn(rig: StereoRig, image: Image, estimate: PoseEstimate, axis_m: float = 0.05) -> Image:
    """Draw a measured pose into the left image: the points as dots, the body's axes red, green, blue (x, y, z).

    Args:
        rig: the calibrated pair.
        image: (H, W) grey.
        estimate: the measured pose.
        axis_m: length of the axes.

    Returns:
        (H, W, 3) BGR image.
    """
    out = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    T, shift = estimate.T_left_body, 4
    ends = np.concatenate([T[:3, 3][None], T[:3, 3] + axis_m * T[:3, :3].T, estimate.points.p_left])
    uv = np.round(rig.left.project(ends) * 2**shift).astype(int)
    for i, colour in enumerate(((60, 60, 230), (80, 200, 80), (230, 120, 40)), start=1):
        cv2.arrowedLine(out, tuple(uv[0].tolist()), tuple(uv[i].tolist()), colour, 2, cv2.LINE_AA, shift, 0.12)
    for p in uv[4:]:
        cv2.circle(out, tuple(p.tolist()), 3 << shift, (0, 220, 255), 1, cv2.LINE_AA, shift)
    return out
