"""Match the detections of the left and the right camera: by identity, then by the epipolar gate.

Coded points (board corners, tags, named markers) carry their identity; the epipolar gate rejects, by name, pairs that
contradict the rig. Distances are measured in undistorted pixels of each camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armsight.data import Array, Body, Correspondences, Detections, Dropped, Ids
from armsight.kernels import kernel
from armsight.vision.rig import StereoRig

#: Standard deviations; what is off by more is a mistake and no noise: a pair off its epipolar line, a disc off its pose, a
#: size of a disc or a body; half: noise is, double: half of the mistakes of a few px pass.
SIGMAS = 6.0
#: The least that the epipolar gate may be, px. A wrong identity is many pixels off; a pair that is only noisier than
#: expected stays and is tested against the body in locate.
GATE_PX = 2.0
#: Epipolar distance beyond which a pair does not support an order of a board's names, px.
FLIP_PX = 20.0


def join(left: Detections, right: Detections) -> Correspondences:
    """Put the detections of both cameras side by side by identity, without any geometry."""
    there = np.zeros(1 + max(left.ids.max(initial=-1), right.ids.max(initial=-1)), bool)
    there[left.ids] = there[right.ids] = True
    ids = np.flatnonzero(there)
    uv, cov = np.full((len(ids), 2, 2), np.nan), np.zeros((len(ids), 2, 2, 2))
    for side, found in enumerate((left, right)):
        rows = np.searchsorted(ids, found.ids)
        uv[rows, side], cov[rows, side] = found.uv, found.cov_uv
    return Correspondences(ids, uv, cov, common=np.array((left.common, right.common)))


def epipolar_distances(rig: StereoRig, uv_left: Array, uv_right: Array) -> Array:
    """Measure the distance of each point from the epipolar line of its partner.

    ``uv_left``: (N, 2) raw pixels; ``uv_right``: (N, 2) raw pixels of the same points. Returns (N, 2) distance in the left
    and in the right image, undistorted px; NaN where a pixel has no ray.
    """
    out = np.empty((len(uv_left), 2))
    focal = np.array([camera.intrinsics[:2] for camera in rig.cameras])
    _gaps(rig.left.unproject(uv_left), rig.right.unproject(uv_right), np.array(rig.T_left_right), focal, out)
    return out


@kernel("f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]")
def _gaps(rays_left: Array, rays_right: Array, T_left_right: Array, focal: Array, out: Array) -> None:
    """Fill what :func:`epipolar_distances` returns from rays (N, 3) and focal lengths (2, 2), px."""
    t, E, line = T_left_right[:3, 3], np.empty((3, 3)), np.empty((2, 2))  # x_left^T E x_right = 0
    for j in range(3):
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            E[i, j] = t[a] * T_left_right[b, j] - t[b] * T_left_right[a, j]
    for n in range(len(out)):
        a, b, gap = rays_left[n], rays_right[n], 0.0
        line[:] = 0.0
        for i in range(3):
            for j in range(3):
                gap += a[i] * E[i, j] * b[j]
                if i < 2:
                    line[0, i] += E[i, j] * b[j] / focal[0, i]
                if j < 2:
                    line[1, j] += a[i] * E[i, j] / focal[1, j]
        out[n, 0] = abs(gap / a[2]) / np.hypot(line[0, 0], line[0, 1])
        out[n, 1] = abs(gap / b[2]) / np.hypot(line[1, 0], line[1, 1])


def gate(rig: StereoRig, body: Body, seen: Correspondences) -> Correspondences:
    """Drop, in both cameras, the pairs that the rig's epipolar geometry contradicts, each by name with its distance."""
    rows = np.flatnonzero(seen.paired)
    uv, cov = seen.uv[rows], seen.cov_uv[rows]
    distance = epipolar_distances(rig, uv[:, 0], uv[:, 1]).max(axis=1)
    variance = (cov[:, :, 0, 0] + cov[:, :, 1, 1]).max(axis=1) / 2 + rig.sigma_px**2
    limit = np.maximum(GATE_PX, SIGMAS * np.sqrt(2 * variance))
    bad = ~(distance <= limit)
    if not bad.any():
        return seen
    keep = np.ones(len(seen.ids), bool)
    keep[rows[bad]] = False
    dropped = tuple(
        Dropped(body.point_names[i], f"{d:.1f} px off its epipolar line (gate {g:.1f} px)", contradicts=True)
        for i, d, g in zip(seen.ids[rows[bad]], distance[bad], limit[bad], strict=True)
    )
    return Correspondences(seen.ids[keep], seen.uv[keep], seen.cov_uv[keep], seen.dropped + dropped, seen.common)


def match(
    rig: StereoRig, body: Body, left: Detections, right: Detections, *, symmetries: tuple[Ids, ...] = ()
) -> Correspondences:
    """Match one shot's detections: identity, then the epipolar gate.

    ``body``: the body of both detections. ``left``: detections of the left camera. ``right``: detections of the right
    camera. ``symmetries``: permutations (M,) under which the body looks the same, so that its points may have been named by
    any of them; the one with which most pairs agree with the rig is applied to the right camera. Returns the
    correspondences; points seen by one camera only are kept, for they constrain the pose too.
    """
    best = join(left, right)
    if symmetries and best.paired.any():
        candidates = [best, *(join(left, renamed(right, permutation)) for permutation in symmetries)]
        best = max(candidates, key=lambda candidate: _agreement(rig, candidate))
    return gate(rig, body, best)


def _agreement(rig: StereoRig, seen: Correspondences) -> float:
    """Return how well names agree with the rig: the sum, over pairs, of FLIP_PX less the epipolar distance.

    Not the mean: the middle of a board keeps its name when the board is rotated, and may be the only pair left then.
    """
    pair = seen.uv[seen.paired]
    distance = epipolar_distances(rig, pair[:, 0], pair[:, 1]).max(axis=1)
    return float(np.maximum(FLIP_PX - distance[np.isfinite(distance)], 0.0).sum())


def renamed(detections: Detections, permutation: Ids) -> Detections:
    """Return detections whose point ``i`` is called ``permutation[i]``."""
    ids = permutation[detections.ids]
    order = np.argsort(ids)
    return replace(detections, ids=ids[order], uv=detections.uv[order], cov_uv=detections.cov_uv[order])
