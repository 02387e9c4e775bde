"""What a shot's picture shows of the body's points: where the pose puts each, where it was seen, what was dropped and why.

A disc is shown by its image ellipse. Its detected centre, which a measurement frees of the perspective bias, gets that
bias back, so that detection and ellipse belong together; the residual is the same either way.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Body, Dropped, PoseEstimate, Record
from armsight.geometry.pose import inverse, transform
from armsight.vision.expected import expect
from armsight.vision.markers.disc.target import DiscTarget
from armsight.vision.rig import StereoRig


@dataclass(frozen=True, eq=False)
class Marks(Record):
    """The N points of a body in a measured shot; camera 0 is left, 1 right. NaN where there is none.

    Attributes:
        names: what the points are called.
        at: (N, 2, 2) where the located pose puts a point, or the centre of a disc's ellipse, raw px; NaN where that is
            not seen and looks away from the camera.
        shape: (N, 2, 3) S11, S12, S22 of the ellipse that a disc has at the located pose, px^2.
        found: (N, 2, 2) where a camera saw it, raw px; of a disc the centre of its ellipse.
        cov: (N, 2, 2, 2) covariance of that, px^2.
        dropped: (N, 2) whether a camera's sight of it was dropped.
        reasons: why; empty where neither was.
        others: what else was dropped, in words.
    """

    names: tuple[str, ...]
    at: Array
    shape: Array
    found: Array
    cov: Array
    dropped: NDArray[np.bool_]
    reasons: tuple[str, ...]
    others: tuple[str, ...]

    @property
    def residual(self) -> Array:
        """(N, 2, 2) detection less the pose's projection, px."""
        return np.asarray(self.found - self.at)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, 2) whether a camera saw a point."""
        return np.asarray(np.isfinite(self.found[..., 0]))

    def worst(self, most: int) -> list[int]:
        """Return the rows to show enlarged: all where that is at most ``most``, else the dropped and the worst."""
        if len(self.names) <= most:
            return list(range(len(self.names)))
        off = np.nan_to_num(np.linalg.norm(self.residual, axis=2)).max(axis=1)
        order: list[int] = np.lexsort([-off, ~self.dropped.any(axis=1)]).tolist()
        return order[:most]


def marks_of(rig: StereoRig, body: Body, discs: DiscTarget | None, estimate: PoseEstimate) -> Marks:
    """Say what there is to draw of a measured shot.

    Args:
        rig: the calibrated pair.
        body: all points; the discs' come last.
        discs: the body's plain discs, None where it has none.
        estimate: what was measured.
    """
    at, shape, bias, away = _expected(rig, body, discs, estimate.T_left_body)
    seen = estimate.points.seen
    found, cov = np.full_like(at, np.nan), np.zeros((len(at), 2, 2, 2))
    found[seen.ids] = seen.uv + np.nan_to_num(bias[seen.ids])
    cov[seen.ids] = seen.cov_uv + rig.sigma_px**2 * np.eye(2)
    hidden = away & ~np.isfinite(found[..., 0])
    at[hidden], shape[hidden] = np.nan, np.nan
    reasons, others = _reasons(body, estimate.dropped)
    rows = range(len(at))
    dropped = np.array([_sides(reasons.get(i, [])) for i in rows], bool)
    return Marks(
        body.point_names, at, shape, found, cov, dropped, tuple(_together(reasons.get(i, [])) for i in rows), others
    )


def _expected(
    rig: StereoRig, body: Body, discs: DiscTarget | None, T: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return where a pose puts all M points (M, 2, 2), their ellipses (M, 2, 3), biases (M, 2, 2), and what looks away."""
    p_left, count = transform(T, body.points), len(body.points)
    p_right = transform(inverse(rig.T_left_right), p_left)
    at = np.stack([camera.project(p) for camera, p in zip(rig.cameras, (p_left, p_right), strict=True)], axis=1)
    shape, bias, away = np.full((count, 2, 3), np.nan), np.zeros((count, 2, 2)), np.zeros((count, 2), bool)
    if discs is not None:
        first, expected = count - len(discs.radii_m), expect(rig, discs, T)
        at[first:] = np.where(np.isfinite(expected.uv), expected.uv, at[first:])
        shape[first:], bias[first:], away[first:] = expected.shape, expected.bias, expected.facing <= 0.0
    return at, shape, bias, away


def _reasons(body: Body, dropped: tuple[Dropped, ...]) -> tuple[dict[int, list[str]], tuple[str, ...]]:
    """Return why points were dropped by their row, and the words for what is no point of the body."""
    row = {name: i for i, name in enumerate(body.point_names)}
    said: dict[int, list[str]] = {}
    others = []
    for drop in dropped:
        if drop.point in row:
            said.setdefault(row[drop.point], []).append(drop.reason)
        else:
            others.append(f"{drop.point}: {drop.reason}")
    return {i: list(dict.fromkeys(reasons)) for i, reasons in said.items()}, tuple(others)


def _sides(reasons: list[str]) -> list[bool]:
    """Tell in which images a point was dropped: those its reasons speak of, both where they speak of none."""
    spoken = [[bool(re.search(rf"\b{side}\b", reason)) for side in SIDES] for reason in reasons]
    return [any(said[side] or not any(said) for said in spoken) for side in (0, 1)]


def _together(reasons: list[str]) -> str:
    """Join reasons; ``left: why; right: why`` becomes ``both: why``."""
    left, right = (f"{side}: " for side in SIDES)
    if len(reasons) == 2 and reasons[0].startswith(left) and reasons[1].startswith(right):
        first, second = reasons[0].removeprefix(left), reasons[1].removeprefix(right)
        if first == second:
            return f"both: {first}"
    return "; ".join(reasons)
