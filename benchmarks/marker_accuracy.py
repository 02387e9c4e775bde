"""Metric 1: centres against the Cramer-Rao bound, on textures, and what clutter passes for a disc."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from armsight.data import Discs, Missed
from armsight.vision.discs.identify import identify
from armsight.vision.markers.discs import DiscTarget
from disc_bound import picture_bound
from disc_images import WIDTH, Picture, disc_picture, exposed
from disc_surround import ITEMS, TEXTURES, clutter, one_kind
from marker_plate import parallel_rig
from marker_report import Report, disc_target, without_numbers

BINS = {
    "radius px": (4, 6, 9, 14, 20),
    "contrast": (40, 70, 110, 200),
    "blur px": (0.5, 0.8, 1.15, 1.5),
    "noise": (1, 2, 3, 4),
    "tilt deg": (0, 20, 40, 60),
}


@dataclass
class Errors:
    """Centres of true discs that were found.

    Attributes:
        e: (N, 2) found minus true, px.
        bound: (N, 2, 2) Cramer-Rao.
        cov: (N, 2, 2) as reported.
        cases: name of BINS -> (N,).
        uv: (N, 2) truth.
        slope: (N, 2) of the surround.
        bright: (N,) whether a disc is.
        count: how many true discs there were.
        found_false: discs found where none is.
        reasons: why true ones were thrown out.
    """

    e: np.ndarray
    bound: np.ndarray
    cov: np.ndarray
    cases: dict[str, np.ndarray]
    uv: np.ndarray
    slope: np.ndarray
    bright: np.ndarray
    count: int
    found_false: int
    reasons: Counter


def pair_up(picture: Picture, discs: Discs) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of true discs and of the found ones that lie within half the shorter axis and 2 px of them."""
    if not len(discs.uv):
        return np.zeros(0, int), np.zeros(0, int)
    distance = np.linalg.norm(picture.uv[:, None] - discs.uv[None], axis=2)
    near = distance.argmin(axis=1)
    good = distance[np.arange(len(near)), near] < np.minimum(2.0, picture.axes[:, 1] / 2)
    return np.flatnonzero(good), near[good]


def why_not(picture: Picture, discs: Discs, found: np.ndarray) -> Counter:
    """Count the reasons given for true discs that were not found."""
    reasons: Counter = Counter()
    positions = np.array([r.uv for r in discs.rejected]).reshape(-1, 2)
    for i in np.setdiff1d(np.arange(len(picture.uv)), found):
        distance = np.linalg.norm(positions - picture.uv[i], axis=1)
        near = distance.argmin() if len(distance) else -1
        seen = near >= 0 and distance[near] < picture.axes[i, 0]
        reasons[without_numbers(discs.rejected[near].reason) if seen else "not seen by the search"] += 1
    return reasons


def run(pictures, targets: dict[bool, DiscTarget]) -> Errors:
    """Find the discs of pictures and compare."""
    parts, count, false, reasons = [], 0, 0, Counter()
    for picture in pictures:
        bright = bool(picture.inside[0] > picture.outside[0])
        discs = targets[bright].find(picture.image)
        i, j = pair_up(picture, discs)
        count, false = count + len(picture.uv), false + len(discs.uv) - len(j)
        reasons += why_not(picture, discs, i)
        a, b = picture.axes[i].T
        n = np.ones(len(i))
        parts.append(
            (
                discs.uv[j] - picture.uv[i],
                picture_bound(picture)[i],
                discs.cov_uv[j],
                np.stack(
                    [
                        a,
                        abs(picture.inside - picture.outside)[i],
                        picture.blur * n,
                        picture.noise * n,
                        np.degrees(np.arccos(b / a)),
                    ]
                ),
                picture.uv[i],
                picture.slope * n[:, None],
                np.full(len(i), bright),
            )
        )
    e, bound, cov, cases, uv, slope, is_bright = (
        np.concatenate(p, axis=1 if k == 3 else 0) for k, p in enumerate(zip(*parts, strict=True))
    )
    return Errors(e, bound, cov, dict(zip(BINS, cases, strict=True)), uv, slope, is_bright, count, false, reasons)


def over_bound(e: np.ndarray, bound: np.ndarray) -> float:
    """Return the RMS of errors in units of their own bound: 1 is the limit."""
    return float(np.sqrt(np.einsum("ni,nij,nj->n", e, np.linalg.inv(bound), e).mean() / 2))


def bias(errors: Errors, direction: np.ndarray, size: np.ndarray | float = 1.0) -> tuple[float, float]:
    """Return how much of ``size`` (N,) the errors hold along unit directions (N, 2), px, and its standard error.

    Least squares with the bound's weights; for a size of one, the weighted mean.
    """
    variance = np.einsum("ni,nij,nj->n", direction, errors.bound, direction)
    along = np.einsum("ni,ni->n", errors.e, direction)
    weight = size / variance
    total = (weight * size).sum()
    mean = (weight * along).sum() / total
    return float(mean), float(np.sqrt((weight**2 * (along - mean * size) ** 2).sum()) / total)


def biases(errors: Errors, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Return the bias along every direction in which a finder may pull."""
    n = len(errors.e)
    angle = rng.uniform(0, 2 * np.pi, n)
    u, v = np.tile([1.0, 0.0], (n, 1)), np.tile([0.0, 1.0], (n, 1))
    out = {
        "along u": bias(errors, u),
        "along v": bias(errors, v),
        "along random directions": bias(errors, np.stack([np.cos(angle), np.sin(angle)], axis=1)),
        "with the position in the pixel, u": bias(errors, u, np.sin(2 * np.pi * errors.uv[:, 0])),
        "with the position in the pixel, v": bias(errors, v, np.sin(2 * np.pi * errors.uv[:, 1])),
    }
    if np.abs(errors.slope).max() > 0:
        way = errors.slope / np.linalg.norm(errors.slope, axis=1, keepdims=True)
        for name, which in (("bright", errors.bright), ("dark", ~errors.bright)):
            out[f"along the gradient, {name} discs"] = bias(errors, way, which.astype(float))
    return out


def plain(seed: int, report: Report, images: int = 60, count: int = 65) -> None:
    """Compare with the bound on plain surrounds, on even gradients, under uneven light and with shot noise."""
    targets = {bright: disc_target(bright) for bright in (True, False)}
    rng = np.random.default_rng(seed)
    for label, options, number in (
        ("plain", {"kind": "plain"}, images),
        ("plain, shot noise", {"kind": "plain", "noise": 1.0, "shot": 0.05}, images // 3),
        ("gradient of the surround", {"kind": "gradient"}, images // 3),
        ("uneven light", {"kind": "light"}, images // 3),
    ):
        errors = run((disc_picture(rng, count=count, **options) for _ in range(number)), targets)
        report.say(f" {label}: {len(errors.e)} of {errors.count} discs found, {errors.found_false} found where none is")
        if errors.reasons:
            report.say(f"  not found: {dict(errors.reasons.most_common(6))}")
        if not len(errors.e):
            continue
        ratio = over_bound(errors.e, errors.bound)
        report.metric(f"{label}: RMS of the centre over its bound", ratio, "<= 1.3", good=ratio <= 1.3)
        rms, limit = (
            np.sqrt((errors.e**2).sum(axis=1).mean() / 2),
            np.sqrt(np.trace(errors.bound, axis1=1, axis2=2).mean() / 2),
        )
        report.say(
            f"  {'the same in px, an axis':62s} {rms:.4f} px, bound {limit:.4f} px; largest {np.abs(errors.e).max():.3f} px"
        )
        nees = np.einsum("ni,nij,nj->n", errors.e, np.linalg.inv(errors.cov), errors.e)
        report.metric(f"{label}: NEES of cov_uv (2 is honest)", nees.mean(), form=".2f")
        report.metric(f"{label}: 95% ellipse holds", 100 * (nees <= chi2.ppf(0.95, 2)).mean(), form=".1f", unit="%")
        for name, (mean, sigma) in biases(errors, rng).items():
            report.metric(
                f"{label}: bias {name}",
                mean,
                "under 0.003",
                form="+.4f",
                unit=f"+- {sigma:.4f} px",
                good=abs(mean) < 0.003,
            )
        for name, edges in BINS.items():
            which = np.clip(np.digitize(errors.cases[name], edges) - 1, 0, len(edges) - 2)
            parts = [
                f"{low:g}-{high:g}: {over_bound(errors.e[which == k], errors.bound[which == k]):.2f} ({(which == k).sum()})"
                for k, (low, high) in enumerate(pairwise(edges))
                if (which == k).any()
            ]
            report.say(f"    by {name:10s} {'  '.join(parts)}")


def textured(seed: int, report: Report, images: int = 12, count: int = 80) -> None:
    """Errors on textured surrounds: spread of the texture 3 to 8 grey levels, contrast 40 to 190."""
    targets = {bright: disc_target(bright) for bright in (True, False)}
    rng = np.random.default_rng(seed + 1)
    size, number = [], 0
    for kind in TEXTURES:
        errors = run((disc_picture(rng, count=count, kind=kind) for _ in range(images)), targets)
        e = np.linalg.norm(errors.e, axis=1)
        size, number = [*size, e], number + errors.count
        if not len(e):
            report.say(f" {kind}: none found: {dict(errors.reasons.most_common(4))}")
            continue
        report.say(
            f" {kind}: median {np.median(e):.4f} px, RMS {np.sqrt((e**2).mean()):.4f}, 99% {np.quantile(e, 0.99):.3f}, "
            f"largest {e.max():.3f}; kept {len(e)} of {errors.count}; {errors.found_false} found where none is; plain "
            f"bound {np.sqrt(np.trace(errors.bound, axis1=1, axis2=2).mean()):.4f} RMS"
        )
        if errors.reasons:
            report.say(f"   not found: {dict(errors.reasons.most_common(5))}")
    e = np.concatenate(size)
    if len(e):
        median, rms, kept = np.median(e), np.sqrt((e**2).mean()), 100 * len(e) / number
        report.metric("textured: median error", median, "<= 0.03", form=".4f", unit="px", good=median <= 0.03)
        report.metric(
            "textured: RMS error after the residual test", rms, "<= 0.05", form=".4f", unit="px", good=rms <= 0.05
        )
        report.metric("textured: kept", kept, ">= 90", form=".1f", unit="%", good=kept >= 90)


def by_kind(seed: int, report: Report, images: int = 6) -> None:
    """Say which kinds of clutter pass for discs, each thing alone on a plain ground."""
    rng, targets = np.random.default_rng(seed + 3), (disc_target(), disc_target(False))
    shares = {}
    for kind, item in enumerate(ITEMS):
        accepted = count = 0
        for _ in range(images):
            light, things = one_kind(kind, rng)
            image = exposed(light, 2.0, 0.0, rng)
            accepted, count = accepted + sum(len(t.find(image).uv) for t in targets), count + things
        shares[item.__name__.strip("_").replace("_", " ")] = accepted / count
    listed = ", ".join(f"{name} {share:.2f}" for name, share in sorted(shares.items(), key=lambda pair: -pair[1]))
    report.say(f"  discs accepted for one thing alone, by its kind: {listed}")


def cluttered(seed: int, report: Report, pairs: int = 500) -> None:
    """Clutter on a wall before a stereo rig, so that all of it keeps the epipolar line; no disc and no plate is there."""
    rig, target = parallel_rig(), disc_target()
    targets = (target, disc_target(False))
    for label, number, loose in (("", pairs, 0), (", 12 loose discs of the plate's size in each", pairs // 5, 12)):
        rng, discs, poses = np.random.default_rng(seed + 2 + loose), 0, 0
        for _ in range(number):
            depth = rng.uniform(0.6, 1.2)
            disparity = round(rig.left.intrinsics[0] * rig.baseline_m / depth)
            radius = rig.left.intrinsics[0] * target.radii_m[0] / depth
            light = clutter(rng, WIDTH + disparity, discs=loose, radius=radius)
            views = [exposed(light[:, start : start + WIDTH], rng.uniform(1, 4), 0.0, rng) for start in (0, disparity)]
            for which in targets:
                found = [which.find(view) for view in views]
                discs += sum(len(f.uv) for f in found)
                poses += not isinstance(identify(rig, which, *found), Missed)
        said = f"{2 * number} cluttered images{label}"
        report.say(f"  {said}: {discs / (2 * number):.1f} accepted as discs an image")
        report.metric(f"{said}: poses", poses, "0", form="d", good=poses == 0)


def metric(seed: int, report: Report) -> None:
    plain(seed, report)
    textured(seed, report)
    by_kind(seed, report)
    cluttered(seed, report)
