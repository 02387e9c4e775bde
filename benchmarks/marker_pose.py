"""Metrics 4 and 6: the pose of the plate against what the bound predicts, and the bias of perspective."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from scipy.stats import chi2

from armsight import measure
from armsight.data import Missed, Shot
from armsight.geometry.pose import inverse, log_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.render.optics import Optics, Sensor
from armsight.sim.render.render import render_pair
from armsight.sim.render.scene import PosedBody, plate
from armsight.vision.discs.bias import project_discs
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.rig import StereoRig
from disc_images import add_region, closed_border, exposed
from marker_plate import (
    BACKGROUND,
    BLUR,
    DISC,
    LENS,
    MARGIN_M,
    PLATE,
    parallel_rig,
    pose_bound,
    poses,
    project,
    rim,
    shot,
)
from marker_report import Report, disc_target, opened, without_numbers

NOISE = 2.0
#: With fewer shots chance alone takes the share of a 95% ellipsoid out of 93 to 97%.
ENOUGH = 300
Images = tuple[np.ndarray, np.ndarray]


def rendered(rig: StereoRig, target: DiscTarget, T: np.ndarray, rng: np.random.Generator) -> Images:
    """Return both images as armsight's own renderer paints them."""
    low, high = target.body.points.min(axis=0) - MARGIN_M, target.body.points.max(axis=0) + MARGIN_M
    middle = (low + high) / 2
    discs = [(*(p - middle)[:2], r, DISC / 255) for p, r in zip(target.body.points, target.radii_m, strict=True)]
    pattern = plate(high[0] - low[0], high[1] - low[1], PLATE / 255, discs).on_body(pose(np.eye(3), middle))
    return render_pair(
        rig.cameras,
        rig.T_left_right,
        [PosedBody((pattern,), T)],
        (BACKGROUND / 255, BACKGROUND / 255),
        optics=Optics(psf_sigma_px=BLUR),
        sensor=Sensor(read_noise=NOISE),
        rng=rng,
    )


def evaluate(
    label: str, rig: StereoRig, target: DiscTarget, shots: Iterator[tuple[np.ndarray, Images]], report: Report
) -> None:
    """Measure shots and print errors over the bound, NEES and coverage."""
    xi, bound, nees, missed, whole = [], [], [], [], opened(target)
    for T, images in shots:
        result = measure(rig, whole, Shot("", *images))
        if isinstance(result, Missed):
            missed.append(result.reason)
            continue
        xi.append(log_se3(inverse(result.T_left_body) @ T))
        bound.append(pose_bound(rig, target, T, NOISE))
        nees.append(xi[-1] @ np.linalg.solve(result.cov, xi[-1]))
    n = len(xi)
    report.say(f" {label}: {n} of {n + len(missed)} shots measured")
    for reason, times in Counter(map(without_numbers, missed)).most_common(4):
        report.say(f"    missed {times} times: {reason}")
    if not n:
        return
    e, b, d2 = np.array(xi), np.array(bound), np.array(nees)
    wrong = (np.linalg.norm(e[:, 3:], axis=1) > np.radians(5)).sum()
    report.metric(f"{label}: poses rotated by more than 5 degrees", wrong, "0", form="d", good=wrong == 0)
    for name, part, unit, scale in (
        ("position", slice(0, 3), "mm", 1e3),
        ("orientation", slice(3, 6), "deg", np.degrees(1)),
    ):
        rms = np.sqrt((e[:, part] ** 2).sum(axis=1).mean())
        said = np.sqrt(np.trace(b[:, part, part], axis1=1, axis2=2).mean())
        report.say(f"  {f'{name} RMS':62s} {scale * rms:.4f} {unit}, the bound {scale * said:.4f}")
        report.metric(f"{label}: {name} RMS over the bound's", rms / said, "<= 1.2", form=".3f", good=rms <= 1.2 * said)
    low, high = chi2.ppf((0.025, 0.975), 6 * n) / n
    inside = 100 * (d2 <= chi2.ppf(0.95, 6)).mean()
    report.metric(
        f"{label}: mean NEES", d2.mean(), f"{low:.2f} to {high:.2f}", form=".2f", good=low <= d2.mean() <= high
    )
    required, good = ("93 to 97", 93 <= inside <= 97) if n >= ENOUGH else ("", None)
    report.metric(f"{label}: 95% ellipsoid holds", inside, required, form=".1f", unit="%", good=good)


def metric(seed: int, report: Report, count: int = 1000) -> None:
    target = disc_target()
    for label, lens, number, by_renderer in (
        ("pinhole", None, count, False),
        ("lens with distortion", LENS, count // 3, False),
        ("lens, armsight's renderer", LENS, count // 16, True),
    ):
        rng = np.random.default_rng(seed + number)
        rig = parallel_rig(lens, 3.0)
        Ts = poses(rig, target, number, rng)
        paint = rendered if by_renderer else lambda rig, target, T, rng: shot(rig, target, T, NOISE, rng)
        evaluate(label, rig, target, ((T, paint(rig, target, T, rng)) for T in Ts), report)


def perspective(seed: int, report: Report, count: int = 300) -> None:
    """A disc of R = 15 mm at 0.5 m, 45 degrees: the found centre against the disc's own and against the ellipse's."""
    for label, lens in (("pinhole", None), ("lens with distortion", LENS)):
        rng = np.random.default_rng(seed)
        camera, target = parallel_rig(lens).left, disc_target()
        without, rest, foreseen = [], [], []
        for _ in range(count):
            around = rng.uniform(0, 2 * np.pi)
            where = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.08, 0.08), 0.5])
            sight = where / np.linalg.norm(where)
            x = np.cross([0.0, 1.0, 0.0], sight)
            x /= np.linalg.norm(x)
            side = np.cos(around) * x + np.sin(around) * np.cross(sight, x)
            normal = np.sqrt(0.5) * (side - sight)
            light = np.full((720, 1280), PLATE)
            border = closed_border(rim(camera, np.eye(4), where, normal, 0.015, BLUR))
            add_region(light, border, BLUR, DISC - PLATE)
            plain = project(camera, where[None])[0]
            corrected = project_discs(camera, where[None], normal[None], np.array([0.015]))[0][0]
            foreseen.append(corrected - plain)
            found = target.find(exposed(light, 1.0, 0.0, rng)).uv
            if len(found) == 1:
                # Along and across the direction in which perspective moves the centre.
                along = (corrected - plain) / np.linalg.norm(corrected - plain)
                axes = np.array([along, [-along[1], along[0]]])
                without.append(axes @ (found[0] - plain))
                rest.append(axes @ (found[0] - corrected))
        size = np.linalg.norm(foreseen, axis=1)
        report.say(
            f"  {f'{label}: foreseen, smallest, mean, largest':62s} {size.min():.3f} {size.mean():.3f} {size.max():.3f} px"
        )
        before, after = np.array(without), np.array(rest)
        report.say(f"  {label}: found in {len(after)} of {count} images")
        if len(after):
            mean, sigma = after.mean(axis=0), after.std(axis=0) / np.sqrt(len(after))
            report.metric(f"{label}: bias without correction", before[:, 0].mean(), "about 0.3", unit="px")
            report.metric(
                f"{label}: bias with correction, along",
                mean[0],
                "under 0.005",
                form="+.4f",
                unit=f"+- {sigma[0]:.4f} px",
                good=abs(mean[0]) < 0.005,
            )
            report.metric(
                f"{label}: bias with correction, across",
                mean[1],
                "under 0.005",
                form="+.4f",
                unit=f"+- {sigma[1]:.4f} px",
                good=abs(mean[1]) < 0.005,
            )
    plate_at_half_a_metre(seed, report)


def plate_at_half_a_metre(seed: int, report: Report, count: int = 200) -> None:
    """The same through ``measure``: three discs of 15 mm on a plate at 0.5 m, 45 degrees; mean error in position."""
    rng, rig, target = np.random.default_rng(seed + 9), parallel_rig(None, 8.0), disc_target(radius_m=0.015)
    errors, whole = [], opened(target)
    for k in range(count):
        around = 2 * np.pi * k / count
        R = exp_so3(np.pi / 4 * np.array([np.cos(around), np.sin(around), 0.0]))
        T = pose(R, np.array([0.11, 0.0, 0.5]) - R @ target.body.points.mean(axis=0))
        result = measure(rig, whole, Shot("", *shot(rig, target, T, 1.0, rng)))
        if not isinstance(result, Missed):
            # Perspective moves centres along the tilt: the error in the frame of the cameras, rotated to it.
            e = R @ log_se3(inverse(result.T_left_body) @ T)[:3]
            bound = R @ pose_bound(rig, target, T, 1.0)[:3, :3] @ R.T
            along = np.array([-np.sin(around), np.cos(around), 0.0])
            errors.append((along @ e, e[2], np.sqrt(along @ bound @ along), np.sqrt(bound[2, 2])))
    if not errors:
        report.say("  no pose found of a plate of such discs")
        return
    e = np.array(errors)
    sigma = e[:, :2].std(axis=0) / np.sqrt(len(e))
    report.say(f"  plate of such discs: {len(e)} of {count} measured")
    for i, name in enumerate(("along the tilt", "in depth")):
        report.metric(
            f"mean error of its position {name}", 1e3 * e[:, i].mean(), form="+.4f", unit=f"+- {1e3 * sigma[i]:.4f} mm"
        )
        rms, bound = (1e3 * np.sqrt((e[:, k] ** 2).mean()) for k in (i, 2 + i))
        report.say(f"  {'a single shot: RMS, the bound':62s} {rms:.4f} {bound:.4f} mm")
