"""Bodies seen through the camera presets: shots measured, wrong poses, centres and corners, and whether sigmas are honest.

Scenes: the workcell's body of nine discs, a plate of four discs, a plate of four AprilTags and a chessboard, 0.5 to 1.2 m
away, before clutter, 1280x720. Seeds of the scenes begin where no scene of the development was. Each shot is a row; rows
that a file has already are not made again, so a long run can be interrupted, and goes on where it ended.

The peers: for discs thresholded contours (adaptive threshold, contours of an ellipse's shape: area within 10 % of that of
the fitted ellipse, centre of the fitted ellipse); for tags OpenCV's aruco with its sub-pixel and with its AprilTag
refinement, less half a pixel; for chessboards ``findChessboardCornersSB``, exhaustive and accurate.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.stats import chi2

from armsight.data import PoseEstimate, Shot
from armsight.geometry.pose import inverse, log_se3
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.marker import Target
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.measure import measure
from camera_scene import CHESSBOARD, Scene, scene, smallest_px
from marker_report import Report

PRESETS = ("industrial", "webcam-good-light", "webcam-poor-light", "cheap-webcam")
#: Largest centre RMS of discs, px.
MOST_RMS_PX = {"industrial": 0.02, "webcam-good-light": 0.05, "webcam-poor-light": None, "cheap-webcam": 0.10}
SHOTS, FIRST_SEED = 60, 700_000
WRONG_M, WRONG_DEG = 0.02, 5.0
#: A disc's smallest diameter, a tag's or square's smallest side, px: below, a miss is none.
LEAST_PX = {"nine": 10.0, "four": 10.0, "tags": 24.0, "chessboard": 10.0}
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


def aruco(image: np.ndarray, refinement: int) -> np.ndarray:
    """Return the corners (N, 2) of 36h11 tags that OpenCV's aruco finds, px."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(image)
    return np.array([c for c, i in zip(corners, [] if ids is None else ids, strict=False) if i < 4]).reshape(-1, 2)


def squares(image: np.ndarray) -> np.ndarray:
    """Return the corners (N, 2) that ``findChessboardCornersSB`` finds, px."""
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, CHESSBOARD[:2], flags=flags)
    return np.array(corners).reshape(-1, 2) if found else np.zeros((0, 2))


def peers(image: np.ndarray, kind: str) -> dict[str, np.ndarray]:
    """Return the points (N, 2) that each peer finds of a kind of body, px."""
    if kind == "tags":
        return {
            "aruco, sub-pixel": aruco(image, cv2.aruco.CORNER_REFINE_SUBPIX),
            # It puts the origin at the pixel's corner, as the AprilTag library does.
            "aruco, AprilTag": aruco(image, cv2.aruco.CORNER_REFINE_APRILTAG) - 0.5,
        }
    if kind == "chessboard":
        return {"findChessboardCornersSB": squares(image)}
    return {"contours": contours(image)}


def nearest(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the differences (M, 2) of the found points nearest to the true ones (M, 2), NaN where none is near, px."""
    out = np.full(true.shape, np.nan)
    for m, uv in enumerate(true):
        if len(found):
            gap = found - uv
            k = int(np.argmin((gap**2).sum(axis=1)))
            if np.hypot(*gap[k]) < NEAR_PX:
                out[m] = gap[k]
    return out


def row(preset: str, kind: str, seed: int) -> dict:
    """Return what was found in one shot."""
    view = scene(seed, preset, kind=kind)
    target: Target = Composite("body", (), view.target) if isinstance(view.target, DiscTarget) else view.target
    begun = time.process_time()
    result = measure(view.rig, target, Shot(str(seed), *view.images))
    out: dict = {"preset": preset, "kind": kind, "seed": seed, "cpu_ms": 1e3 * (time.process_time() - begun)}
    if isinstance(result, PoseEstimate):
        xi = log_se3(inverse(result.T_left_body) @ view.T_left_body)
        out["nees"] = float(xi @ np.linalg.solve(result.cov, xi)) / 6
        out["mm"], out["deg"] = 1e3 * float(np.linalg.norm(xi[:3])), float(np.degrees(np.linalg.norm(xi[3:])))
    else:
        out["missed"] = result.reason
    return out | _points(view, kind)


def _points(view: Scene, kind: str) -> dict:
    """Return the errors of points in both images, ours and the peers', px, and how many others are taken for such."""
    gaps, others, theirs, squared = [], [], {}, []
    for image, true in zip(view.images, view.uv, strict=True):
        if isinstance(view.target, DiscTarget):
            found = view.target.find(image)
            gaps.append(nearest(found.uv, true))
            others.append(len(found.uv) - len(true))
        else:
            seen = view.target.detect(image)
            gap = np.full(true.shape, np.nan)
            gap[seen.ids] = seen.uv - true[seen.ids]
            gaps.append(gap)
            g = gap[seen.ids]
            squared += list(np.einsum("ni,nij,nj->n", g, np.linalg.inv(seen.cov_uv), g) / 2)
        for name, uv in peers(image, kind).items():
            theirs.setdefault(name, []).append(nearest(uv, true))
    return {
        "gaps": np.vstack(gaps).tolist(),
        "others": others,
        "squared": [float(s) for s in squared],
        "peers": {name: np.vstack(each).tolist() for name, each in theirs.items()},
    }


def campaign(kinds: Sequence[str], seed: int, report: Report, shots: int, file: Path | None) -> None:
    """Make the rows that are missing, shot by shot through all presets, and say what they show."""
    rows = []
    if file is not None and file.exists():
        rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    known = {(r["preset"], r["kind"], r["seed"]) for r in rows}
    ks = dict.fromkeys(kinds, FIRST_SEED + 1000 * seed - 1)
    try:
        for _ in range(shots):
            for kind in kinds:
                ks[kind] += 1
                while smallest_px(ks[kind], kind) < LEAST_PX[kind]:
                    ks[kind] += 1
                for preset in PRESETS:
                    if (preset, kind, ks[kind]) in known:
                        continue
                    rows.append(row(preset, kind, ks[kind]))
                    if file is not None:
                        with file.open("a", encoding="utf-8") as out:
                            out.write(json.dumps(rows[-1]) + "\n")
    except KeyboardInterrupt:
        report.say("  interrupted; what was measured:")
    for preset in PRESETS:
        for kind in kinds:
            if here := [r for r in rows if (r["preset"], r["kind"]) == (preset, kind)]:
                summary(preset, kind, here, report)


def _rms(gaps: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(gaps**2))) if np.isfinite(gaps).any() else float("nan")


def summary(preset: str, kind: str, rows: list[dict], report: Report) -> None:
    """Say what the shots of one body through one preset show."""
    measured = [r for r in rows if "missed" not in r]
    name = f"{preset}, {kind}"
    report.say(f"  {name}: {len(rows)} shots, {np.mean([r['cpu_ms'] for r in rows]):.1f} ms of CPU a shot")
    recall = len(measured) / len(rows)
    report.metric(f"{name}: shots measured", recall, ">= 0.995", form=".3f", good=recall >= 0.995)
    wrong = [r for r in measured if r["mm"] > 1e3 * WRONG_M or r["deg"] > WRONG_DEG]
    report.metric(f"{name}: wrong poses", float(len(wrong)), "0", form=".0f", good=not wrong)
    gaps, limit = np.array([g for r in rows for g in r["gaps"]], float), MOST_RMS_PX[preset]
    report.metric(
        f"{name}: points RMS an axis ({int(np.isfinite(gaps[:, 0]).sum())} of {len(gaps)})", _rms(gaps),
        "" if limit is None else f"<= {limit}", form=".4f", unit="px", good=limit is None or _rms(gaps) <= limit,
    )  # fmt: skip
    if kind == "tags":
        report.metric(f"{name}: middles of tags RMS an axis", _rms(gaps.reshape(-1, 4, 2).mean(axis=1)), form=".4f")
    if kind in ("nine", "four"):
        report.say(f"    others an image: {np.mean([r['others'] for r in rows]):+.1f}")
    for peer in rows[0]["peers"]:
        theirs = np.array([g for r in rows for g in r["peers"][peer]], float)
        whole = np.mean([np.isfinite(np.array(r["peers"][peer], float)).all() for r in rows])
        report.say(
            f"    {peer}: {int(np.isfinite(theirs[:, 0]).sum())} of {len(theirs)}, all of both images in {whole:.3f} of "
            f"the shots, RMS {_rms(theirs):.4f} px"
        )
    if squared := [s for r in rows for s in r["squared"]]:
        report.metric(f"{name}: squared error of a point over its variance", float(np.mean(squared)), form=".2f")
    if nees := [r["nees"] for r in measured]:
        _honest(name, np.array(nees), report)


def _honest(name: str, nees: np.ndarray, report: Report) -> None:
    """Say how large squared errors of poses are in covariances; nees (N,) a degree of freedom."""
    mean, inside = float(nees.mean()), float((6 * nees < chi2.ppf(0.95, 6)).mean())
    report.metric(
        f"{name}: NEES a degree of freedom (+- {nees.std() / np.sqrt(len(nees)):.2f})", mean, "0.85 to 1.2",
        form=".2f", good=0.85 <= mean <= 1.2,
    )  # fmt: skip
    report.metric(f"{name}: inside 95 %", inside, "0.93 to 0.97", form=".3f", good=0.93 <= inside <= 0.97)
