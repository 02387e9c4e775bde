"""A map of static tags from recorded corners, and how well it predicts a tag that is left out of a shot.

In: a folder of the TagSLAM examples (bag, cameras.yaml). The intrinsics are the authors'; the relative pose of the cameras
and the poses of the tags are fitted on the even shots, robustly. Evaluated on the odd ones: from all tags but one, the pose
(``measure_seen``) predicts where that one is; the residual to its triangulated corners is divided by its predicted sigma,
in which are the noise of pose and triangulation, and the map and the relative pose of the cameras with all their
covariances: prediction and triangulated corners both depend on them, so most of what is wrong with them cancels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from armsight.data import Array, Body, Missed
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.geometry.rotation import skew
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.markers.tag import CORNERS
from armsight.vision.match import gate
from armsight.vision.pose.assign import plain
from armsight.vision.pose.measure import measure_seen
from armsight.vision.pose.pnp import consensus_poses
from armsight.vision.rig import StereoRig
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.tags import TAGS, read_tags
from armsight.vision.triangulate import triangulate


@dataclass(frozen=True)
class FittedMap:
    """Poses of the tags (M, 4, 4), and the covariance (6 + 6 M, 6 + 6 M) of the cameras' relative pose and of them."""

    Ts: Array
    cov: Array


@dataclass(frozen=True)
class Evaluated:
    """How well a recording was measured: see the module."""

    shots: int
    measured: int
    missed: int
    left_out: int
    ratio: float
    text: str


def evaluated(folder: Path, side_m: float, topics: str) -> Evaluated:
    """Fit the map on even shots, evaluate on odd ones."""
    spec = f"bag:{folder / 'tag_detections.bag'}{topics}"
    cameras = _cameras(folder / "cameras.yaml")
    every = _numbers(folder / "tag_detections.bag")
    names = tuple(f"{n}.{k}" for n in every for k in range(4))
    corners = CORNERS * side_m / 2
    flat = Body("tags", names, np.tile(corners, (len(every), 1)) + np.repeat(np.arange(len(every)), 4)[:, None] * 10.0)
    shots, notes = read_tags(spec, flat)
    rich = [shot for shot in shots[::2] if all(len(_tags_of(shot, side)) > 1 for side in range(2))]
    fitted = rich[:: max(1, len(rich) // MOST)]
    rig, body, fitted_map, sigma_px = _fitted(fitted, cameras, corners, names)
    done = [measure_seen(rig, body, _of(body, flat, shot)) for shot in shots]
    missed = [each for each in done if isinstance(each, Missed)]
    squares = []
    for shot in shots[1::2]:
        squares += _left_out(rig, body, fitted_map, _of(body, flat, shot), corners)
    middle = float(np.median(squares)) if squares else np.nan
    ratio = float(np.sqrt(middle / CHI2_MEDIAN)) if squares else np.nan
    text = (
        f"{len(body.points) // 4} of {len(every)} tags in the map, sigma {sigma_px:.2f} px, baseline "
        f"{1e3 * rig.baseline_m:.2f} mm; RMS ratio {np.sqrt(np.mean(squares) / 3):.2f}; {'; '.join(notes[:2])}"
    )
    return Evaluated(len(shots), len(done) - len(missed), len(missed), len(squares), ratio, text)


#: Shots of the fit at most, evenly chosen among those in which both cameras see two tags: the fit is dense.
MOST = 120
#: Median of chi-squared with three degrees of freedom: a few wrong corners do not move it.
CHI2_MEDIAN = 2.366
#: Median of absolute deviations -> standard deviation of a normal distribution.
MAD = 1.4826


def _cameras(path: Path) -> tuple[Camera, Camera]:
    entries = yaml.safe_load(path.read_text())
    left, right = (
        Camera(tuple(e["resolution"]), "fisheye", np.array(e["intrinsics"]), np.array(e["distortion_coeffs"]))
        for e in (entries["cam0"], entries["cam1"])
    )
    return left, right


def _numbers(path: Path) -> list[int]:
    bag = Bag(path)
    topics = [topic.name for topic in bag.of_kind(*TAGS)]
    return sorted({int(tag.id) for message in bag.messages(topics) for tag in message.decode().apriltags})


def _of(body: Body, flat: Body, shot: SeenShot) -> SeenShot:
    """Return a shot with the rows of another body, which may have fewer tags."""
    row = {name: k for k, name in enumerate(body.point_names)}
    ids, uv = [], []
    for side in range(2):
        rows = np.array([row.get(flat.point_names[i], -1) for i in shot.ids[side]], np.int64)
        ids.append(rows[rows >= 0])
        uv.append(shot.uv[side][rows >= 0])
    return SeenShot(shot.name, (ids[0], ids[1]), (uv[0], uv[1]), shot.t_s, shot.problem)


def _tags_of(shot: SeenShot, side: int) -> dict[int, Array]:
    """Return tag (row / 4) -> its corners (4, 2)."""
    return {int(i) // 4: shot.uv[side][k : k + 4] for k, i in enumerate(shot.ids[side]) if i % 4 == 0}


def _fitted(
    shots: list[SeenShot], cameras: tuple[Camera, Camera], corners: Array, names: tuple[str, ...]
) -> tuple[StereoRig, Body, FittedMap, float]:
    """Fit relative pose, tags and shots; return rig, body, map, sigma of a pixel."""
    views = []  # shot, tag, side, uv, pose of the tag in that camera
    for k, shot in enumerate(shots):
        for side, camera in enumerate(cameras):
            for tag, uv in _tags_of(shot, side).items():
                found = consensus_poses(corners, camera, np.arange(4), uv)
                if found:
                    views.append((k, tag, side, uv, found[0].T_camera_body))
    both = {}
    for k, tag, side, _, T in views:
        both.setdefault((k, tag), {})[side] = T
    relative = np.array([each[0] @ inverse(each[1]) for each in both.values() if len(each) == 2])
    T_lr = relative[np.argmin([np.sum(np.abs(relative[:, :3, 3] - T[:3, 3])) for T in relative])]
    # the map grows from the tag that is seen most often; poses of both cameras in the left camera's frame
    seen: dict[int, dict[int, Array]] = {}
    for k, tag, side, _, T in views:
        if side == 0 or tag not in seen.get(k, {}):
            seen.setdefault(k, {})[tag] = T if side == 0 else T_lr @ T
    counts = np.bincount([tag for _, tag, *_ in views])
    tags, poses = {int(counts.argmax()): np.eye(4)}, {}
    for _ in range(60):
        for k, of_shot in seen.items():
            known = [tag for tag in of_shot if tag in tags]
            if k not in poses and known:
                poses[k] = of_shot[known[0]] @ inverse(tags[known[0]])
        new: dict[int, list[Array]] = {}
        for k, T in poses.items():
            for tag, T_left_tag in seen[k].items():
                if tag not in tags:
                    new.setdefault(tag, []).append(inverse(T) @ T_left_tag)
        if not new:
            break
        for tag, many in new.items():
            stack = np.array(many)
            tags[tag] = stack[np.argmin([np.sum(np.linalg.norm(stack[:, :3, 3] - T[:3, 3], axis=1)) for T in stack])]
    order = {tag: k for k, tag in enumerate(tags)}
    rows = {k: n for n, k in enumerate(poses)}
    used = [(rows[k], order[tag], side, uv) for k, tag, side, uv, _ in views if k in rows and tag in order]
    T_tags, T_shots = np.array([tags[t] for t in order]), np.array([poses[k] for k in rows])
    return _adjusted(cameras, corners, names, list(order), T_lr, T_tags, T_shots, used)


def _adjusted(cameras, corners, names, order, T_lr, T_tags, T_shots, used):
    n_tags, n_shots, scale = len(T_tags), len(T_shots), 1.0
    shot, tag, side = (np.array([each[i] for each in used]) for i in range(3))
    uv = np.array([each[3] for each in used])
    count = 6 + 6 * n_tags + 6 * n_shots
    keep = np.ones(len(used), bool)

    def residuals(x):
        lr = T_lr @ exp_se3(x[:6])
        Tt = T_tags @ exp_se3(x[6 : 6 + 6 * n_tags].reshape(-1, 6))
        Ts = T_shots @ exp_se3(x[6 + 6 * n_tags :].reshape(-1, 6))
        p = transform((Ts[shot] @ Tt[tag])[:, None], corners[None])
        p[side == 1] = transform(inverse(lr), p[side == 1])
        out = np.empty_like(uv)
        for s, camera in enumerate(cameras):
            out[side == s] = camera.project(np.ascontiguousarray(p[side == s].reshape(-1, 3))).reshape(-1, 4, 2)
        r = np.where(np.isfinite(out), out - uv, 100.0)
        prior = x[6:12] * 1e6  # the first tag is the body's frame
        return np.concatenate([(r[keep] / scale).ravel(), prior])

    def sparsity():
        found = lil_matrix((8 * int(keep.sum()) + 6, count))
        for n, k in enumerate(np.flatnonzero(keep)):
            at = slice(8 * n, 8 * n + 8)
            if side[k] == 1:
                found[at, 0:6] = 1
            found[at, 6 + 6 * tag[k] : 12 + 6 * tag[k]] = 1
            first = 6 + 6 * n_tags + 6 * shot[k]
            found[at, first : first + 6] = 1
        for i in range(6):
            found[8 * int(keep.sum()) + i, 6 + i] = 1
        return found

    x = np.zeros(count)
    for _ in range(3):
        fit = least_squares(residuals, x, jac_sparsity=sparsity(), loss="soft_l1", x_scale="jac", max_nfev=25)
        x = fit.x
        # what fits worse than five robust sigmas is a wrong corner
        keep_before, keep[:] = keep.copy(), True
        worst = np.abs(residuals(x)[:-6].reshape(-1, 8) * scale).max(axis=1)
        robust = 1.4826 * float(np.median(np.abs(residuals(x)[:-6]))) * scale
        keep[:] = worst < 5 * robust
        if (keep == keep_before).all():
            break
        scale = robust
    fit = least_squares(residuals, x, jac_sparsity=sparsity(), x_scale="jac", max_nfev=15)
    x = fit.x
    r = residuals(x)[:-6] * scale
    J = fit.jac.toarray() if hasattr(fit.jac, "toarray") else fit.jac
    unscaled = np.linalg.pinv(J.T @ J, hermitian=True)
    sigma_px = _sigma_px(r.reshape(-1, 4, 2), J[:-6].reshape(-1, 4, 2, count), unscaled)
    cov = unscaled * (sigma_px / scale) ** 2
    lr = T_lr @ exp_se3(x[:6])
    Tt = T_tags @ exp_se3(x[6 : 6 + 6 * n_tags].reshape(-1, 6))
    parameters = sum(c.parameters.size for c in cameras)
    rig_cov = np.zeros((parameters + 6, parameters + 6))
    rig_cov[parameters:, parameters:] = cov[:6, :6]
    rig = StereoRig(cameras[0], cameras[1], lr, (rig_cov + rig_cov.T) / 2, sigma_px)
    body = Body(
        "tags",
        tuple(names[4 * t + i] for t in order for i in range(4)),
        np.concatenate([transform(T, corners) for T in Tt]),
    )
    return rig, body, FittedMap(Tt, cov[: 6 + 6 * n_tags, : 6 + 6 * n_tags]), sigma_px


def _sigma_px(r: Array, J: Array, cov: Array) -> float:
    """Return the sigma of a pixel that four corners of a tag, taken as independent, need.

    What moves all four corners together (blur, lens, the time between the cameras) is not averaged out over them. So the
    residuals (N, 4, 2) of the fit are split into the mean of each tag and the deviations from it; each share is sized by
    its median, as a few wrong corners shall not count, and divided by what the fit leaves of it: trace of (I - H) over
    the share, with the hat matrix H = J cov J^T of the fit (N, 4, 2, parameters). The mean, times two, is as large as a
    deviation where the corners are independent; the larger one is taken.
    """
    means = r.mean(axis=1, keepdims=True)
    J_mean = 2.0 * J.mean(axis=1)  # of the normalised sum over four corners
    taken_all = np.einsum("ncap,pq,ncaq->", J, cov, J, optimize=True)
    taken_mean = np.einsum("nap,pq,naq->", J_mean, cov, J_mean, optimize=True)
    left_mean = 1.0 - taken_mean / (2 * len(r))
    left_deviation = 1.0 - (taken_all - taken_mean) / (6 * len(r))
    common = 2.0 * MAD * float(np.median(np.abs(means))) / np.sqrt(left_mean)
    # of four deviations from their mean three are free
    alone = MAD * float(np.median(np.abs(r - means))) * np.sqrt(4 / 3) / np.sqrt(left_deviation)
    print(f"    corners: {alone:.3f} px each, {common:.3f} px of what all four share; left by the fit {left_mean:.2f}, "
          f"{left_deviation:.2f}; RMS {np.sqrt(np.mean(r**2)):.3f} px")  # fmt: skip
    return max(common, alone)


def _left_out(rig: StereoRig, body: Body, fitted: FittedMap, shot: SeenShot, corners: Array) -> list[float]:
    """Return r^T C^-1 r of the centre of each tag that both cameras saw, predicted from the other tags."""
    both = sorted(set(_tags_of(shot, 0)) & set(_tags_of(shot, 1)))
    found = []
    for tag in both if len(both) > 1 else ():
        estimate = measure_seen(rig, body, _without(shot, tag))
        alone = plain(_only(shot, tag))
        if isinstance(estimate, Missed) or alone is None:
            continue
        points = triangulate(rig, body, gate(rig, body, alone))
        if len(points.ids) != 4 or not len(estimate.points.ids):
            continue
        T, R = estimate.T_left_body, estimate.T_left_body[:3, :3]
        p_body = body.points[4 * tag : 4 * tag + 4].mean(axis=0)
        r = points.p_left.mean(axis=0) - transform(T, p_body)
        J = R @ np.hstack([np.eye(3), -skew(p_body)])
        noise = points.cov.mean(axis=0) / 4 + J @ estimate.cov_noise @ J.T
        # What the relative pose of the cameras and the tags of the map move: the triangulated corners, and by them the pose
        # (the weighted fit of the body to its points), and where the map has the tag.
        seen = estimate.points
        A = np.array([R @ np.hstack([np.eye(3), -skew(body.points[i])]) for i in seen.ids])
        W = np.linalg.inv(seen.cov)
        K = np.linalg.solve(np.einsum("nia,nij,njb->ab", A, W, A), np.einsum("nia,nij->anj", A, W).reshape(6, -1))
        K = K.reshape(6, -1, 3)
        by = np.zeros((3, len(fitted.cov)))
        by[:, :6] = points.calibration[:, :, -6:].mean(axis=0) - J @ np.einsum(
            "anj,njp->ap", K, seen.calibration[:, :, -6:]
        )
        for row, i in enumerate(seen.ids):
            at = 6 + 6 * (i // 4)
            by[:, at : at + 6] += J @ K[:, row] @ R @ _by_tag(fitted.Ts[i // 4], corners[i % 4])
        by[:, 6 + 6 * tag : 12 + 6 * tag] -= R @ _by_tag(fitted.Ts[tag], np.zeros(3))
        found.append(float(r @ np.linalg.solve(noise + by @ fitted.cov @ by.T, r)))
    return found


def _by_tag(T: Array, corner: Array) -> Array:
    """Return the derivative (3, 6) of a corner in the map by the tag's pose."""
    return T[:3, :3] @ np.hstack([np.eye(3), -skew(corner)])


def _without(shot: SeenShot, tag: int) -> SeenShot:
    keep = [ids // 4 != tag for ids in shot.ids]
    return SeenShot(shot.name, (shot.ids[0][keep[0]], shot.ids[1][keep[1]]), (shot.uv[0][keep[0]], shot.uv[1][keep[1]]))


def _only(shot: SeenShot, tag: int) -> SeenShot:
    keep = [ids // 4 == tag for ids in shot.ids]
    return SeenShot(shot.name, (shot.ids[0][keep[0]], shot.ids[1][keep[1]]), (shot.uv[0][keep[0]], shot.uv[1][keep[1]]))
