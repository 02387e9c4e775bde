"""Bodies of discs seen through the camera presets: shots measured, wrong poses, centres, and whether sigmas are honest.

Scenes: the workcell's body of nine discs and a plate of four, 0.5 to 1.2 m away, before clutter, 1280x720. Seeds of the
scenes begin where no scene of the development was. The peer finds discs as thresholded contours: adaptive threshold,
contours of an ellipse's shape (area within 10 % of that of the fitted ellipse), centre of the fitted ellipse.
"""

from __future__ import annotations

import time

import cv2
import numpy as np
from scipy.stats import chi2

from armsight.data import PoseEstimate, Shot
from armsight.geometry.pose import inverse, log_se3
from armsight.vision.markers.targets import Composite
from armsight.vision.measure import measure
from camera_scene import scene, smallest_px
from marker_report import Report

PRESETS = ("industrial", "webcam-good-light", "webcam-poor-light", "cheap-webcam")
#: Largest centre RMS, px.
MOST_RMS_PX = {"industrial": 0.02, "webcam-good-light": 0.05, "webcam-poor-light": None, "cheap-webcam": 0.10}
SHOTS, FIRST_SEED = 60, 700_000
LEAST_PX, WRONG_M, WRONG_DEG = 10.0, 0.02, 5.0
NEAR_PX = 1.0


def contours(image: np.ndarray) -> np.ndarray:
    """Return the centres (N, 2) of bright ellipses that thresholded contours find, px."""
    binary = cv2.adaptiveThreshold(image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 51, -10)
    found = []
    for contour in cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        if len(contour) < 16:
            continue
        (u, v), axes, _ = cv2.fitEllipse(contour)
        area, ellipse = cv2.contourArea(contour), np.pi / 4 * axes[0] * axes[1]
        if min(axes) > 4 and max(axes) < 90 and abs(area / max(ellipse, 1.0) - 1) < 0.1:
            found.append((u, v))
    return np.array(found).reshape(-1, 2)


def nearest(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the differences (M, 2) of the found centres nearest to the true ones (M, 2), NaN where none is near, px."""
    out = np.full(true.shape, np.nan)
    for m, uv in enumerate(true):
        if len(found):
            gap = found - uv
            k = int(np.argmin((gap**2).sum(axis=1)))
            if np.hypot(*gap[k]) < NEAR_PX:
                out[m] = gap[k]
    return out


def section(seed: int, report: Report) -> None:
    for preset in PRESETS:
        for kind in ("nine", "four"):
            one(preset, kind, FIRST_SEED + 1000 * seed, report)


def one(preset: str, kind: str, first: int, report: Report) -> None:
    nees, ours, peers, extra, peer_extra, spent = [], [], [], [], [], 0.0
    missed, wrong, shots, k = 0, 0, 0, -1
    while shots < SHOTS:
        k += 1
        if smallest_px(first + k, kind) < LEAST_PX:
            continue
        view = scene(first + k, preset, kind=kind)
        shots += 1
        target = Composite("body", (), view.target)
        begun = time.process_time()
        result = measure(view.rig, target, Shot(str(k), *view.images))
        spent += time.process_time() - begun
        if isinstance(result, PoseEstimate):
            xi = log_se3(inverse(result.T_left_body) @ view.T_left_body)
            wrong += bool(np.linalg.norm(xi[:3]) > WRONG_M or np.degrees(np.linalg.norm(xi[3:])) > WRONG_DEG)
            nees.append(float(xi @ np.linalg.solve(result.cov, xi)) / 6)
        else:
            missed += 1
        for image, true in zip(view.images, view.uv, strict=True):
            discs, blobs = view.target.find(image).uv, contours(image)
            ours.append(nearest(discs, true))
            peers.append(nearest(blobs, true))
            extra.append(len(discs) - len(true))
            peer_extra.append(len(blobs) - len(true))
    mine, theirs = np.vstack(ours), np.vstack(peers)

    def rms(gaps: np.ndarray) -> float:
        return float(np.sqrt(np.nanmean(gaps**2)))

    def share(gaps: np.ndarray) -> str:
        return f"{int(np.isfinite(gaps[:, 0]).sum())} of {len(gaps)} discs"

    inside = float((np.array(nees) * 6 < chi2.ppf(0.95, 6)).mean())
    report.say(f"  {preset}, {kind} discs, {shots} shots, {1e3 * spent / shots:.1f} ms of CPU a shot")
    report.metric(f"{preset}, {kind}: shots measured", (shots - missed) / shots, ">= 0.995", form=".3f")
    report.metric(f"{preset}, {kind}: wrong poses", float(wrong), "0", form=".0f", good=wrong == 0)
    limit = MOST_RMS_PX[preset]
    report.metric(
        f"{preset}, {kind}: centres RMS an axis ({share(mine)}, {np.mean(extra):+.1f} others an image)", rms(mine),
        "" if limit is None else f"<= {limit}", form=".4f", unit="px", good=limit is None or rms(mine) <= limit,
    )  # fmt: skip
    report.say(
        f"    contours: {share(theirs)}, {np.mean(peer_extra):+.1f} others an image, centres {rms(theirs):.4f} px RMS"
    )
    mean = float(np.mean(nees))
    report.metric(
        f"{preset}, {kind}: NEES a degree of freedom", mean, "0.85 to 1.2", form=".2f", good=0.85 <= mean <= 1.2
    )
    report.metric(f"{preset}, {kind}: inside 95 %", inside, "0.93 to 0.97", form=".2f", good=0.93 <= inside <= 0.97)
