"""The budget of a measured pose: what each cause costs, before or after a rig is built.

In: cameras, the points of a body in a volume, and what is not known (:class:`Conditions`). Out: a :class:`Budget`, the
pose's error by cause at every point of the volume. One computation for all causes: the derivatives of the pose that two
cameras measure (:class:`~armsight.vision.pose.predict.PoseDerivatives`) times what each cause does to pixels, rig or body.
What several causes share (the velocity that skew and readout multiply) adds before it is squared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from armsight.data import Array, Detections, Discs, Ids, PoseEstimate, Record
from armsight.errors import InputError
from armsight.geometry.pose import pose, transform
from armsight.geometry.rotation import exp_so3, skew
from armsight.vision.calibrate.boards import printed_board, rigid_board
from armsight.vision.discs.bias import expect
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.bundle import BundleModel, BundleState, Observations, minimise
from armsight.vision.pose.measure import locate_composite, measure_detections
from armsight.vision.pose.predict import PoseDerivatives, PredictedView, pose_derivatives, view, view_at
from armsight.vision.rig import StereoRig

#: Share of errors that a figure "at 95 %" covers.
LEVEL = 0.95
_THIRD = 2 * np.pi / 3  # rad; between the pairs of three cameras
#: A gate is found by so many halvings of what so many standard deviations of the motion reach; half: known to half a
#: sigma, double: twice the time. Half of the sigmas: 5 % lost are none, double: half as fine.
_HALVED, _SURELY = 6, 4.0
#: Two gates that are found at this share of both at once do not add (0.71 would be on the circle, 1 in the corner); and
#: points of the normal distribution that they cut, along each side; half: 2 % off, double: four times the time.
_CORNER, _GRID = 0.85, 65


@dataclass(frozen=True)
class CauseKind:
    """What kind of cause it is."""

    moving: bool = False  #: it costs nothing at rest.
    common: bool = False  #: it is the same in all shots (trueness); else it differs from shot to shot (precision).
    loop: bool = False  #: it is no error of what the cameras measure, but of where a closed loop brings the arm.
    camera: bool = False  #: each camera, or each pair of them, has one of its own.


#: Cause -> its kind, in the order of tables.
CAUSES: dict[str, CauseKind] = {
    "pixel noise": CauseKind(camera=True),
    "defocus": CauseKind(camera=True),
    "exposure blur": CauseKind(moving=True, camera=True),
    "skew": CauseKind(moving=True, camera=True),
    "start of exposures": CauseKind(moving=True, camera=True),
    "readout": CauseKind(moving=True),
    "time stamps": CauseKind(moving=True),
    "calibration": CauseKind(common=True, camera=True),
    "print of the board": CauseKind(common=True),
    "print of the body": CauseKind(common=True),
    "warming of the mount": CauseKind(common=True, camera=True),
    "warming of the lenses": CauseKind(common=True, camera=True),
    "autofocus": CauseKind(common=True, camera=True),
    "hand-eye": CauseKind(common=True, loop=True),
    "steps and backlash of the arm": CauseKind(loop=True),
}


class Gates(NamedTuple):
    """How far a body may move between the two exposures until ``measure`` finds none."""

    across_rad: float = np.inf  #: across the epipolar planes, over the distance.
    along_m: float = np.inf  #: along the baseline.
    together: bool = True  #: whether their squares add, as in a chi-square, or each is a limit of its own.


@dataclass(frozen=True, eq=False)
class Conditions(Record):
    """What is not known when a body is measured; zero where nothing is given."""

    #: cause -> standard deviation that it adds to a marker's position, px: pixel noise, defocus, exposure blur.
    noise_px: Mapping[str, float] = field(default_factory=dict)
    #: (P, P) covariance of the rig's parameters by its calibration, or (0, 0).
    cov_calibration: Array = field(default_factory=lambda: np.zeros((0, 0)))
    board_scale: float = 0.0  #: standard deviation of the board's size, as a share.
    #: (M,) the marker that each point of the body is of, whose points move together; empty: each its own.
    marker: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    #: of each marker of the body from its file, along its face and out of it, m.
    body_sigma_m: tuple[float, float] = (0.0, 0.0)
    body_scale: float = 0.0  #: of the body's size, as a share.
    mount_m: float = 0.0  #: of the right camera's position along each axis since the calibration, m.
    lens_share: float = 0.0  #: of each focal length since the calibration, as a share.
    refocus_share: float = 0.0  #: the same, by an autofocus.
    skew_s: float = 0.0  #: by how much the right exposures are later, uncorrected, s.
    start_s: float = 0.0  #: standard deviation of what differs from shot to shot, s.
    readout_s: float = 0.0  #: from the first row to the last, uncorrected, s.
    stamp_s: float = 0.0  #: standard deviation of a time stamp, s.
    speed_m_s: float = 0.0  #: of the body, in any direction.
    rotation_rad_s: float = 0.0  #: its rate of rotation, about any axis.
    gate: Gates = field(default_factory=Gates)  #: shots that move further between the exposures are lost.
    #: standard deviations of position along each axis, m, and of rotation about each, rad.
    handeye: tuple[float, float] = (0.0, 0.0)
    arm: tuple[float, float] = (0.0, 0.0)  #: the same of how near the arm comes to where it is sent.


@dataclass(frozen=True, eq=False)
class Budget(Record):
    """The error of a body's pose, [translation m; rotation rad] along the left camera's axes, at G points of a volume."""

    p_left: Array  #: (G, 3) the points, m, left camera's frame.
    forward: Array  #: (3,) direction of depth.
    factors: Mapping[str, Array]  #: cause -> (G, 6, K) what its K sources of variance one do to the pose.
    lost: Array  #: (G,) share of the shots in motion that are lost; the errors are those of the others.
    #: causes that multiply the same sources, which add before they are squared.
    shared: tuple[str, ...] = ("skew", "readout")

    def cov(self, *, moving: bool = True, loop: bool = False, of: str = "", scaled: str = "", by: float = 1.0) -> Array:
        """Return covariances (G, 6, 6): ``moving``, with what motion costs; ``loop``, with hand-eye and arm.

        ``of``: one cause alone, or "precision" or "trueness"; ``scaled``: a cause whose sigma is multiplied ``by`` so much.
        """
        total, together = np.zeros((len(self.p_left), 6, 6)), np.zeros((len(self.p_left), 6, 6))
        for name, F in self.factors.items():
            kind = CAUSES[name]
            requested = of in ("", name, "trueness" if kind.common else "precision")
            if requested and (moving or not kind.moving) and (loop or not kind.loop):
                F = F * by if name == scaled else F
                if name in self.shared:
                    together = together + F
                else:
                    total = total + F @ F.transpose(0, 2, 1)
        return np.asarray(total + together @ together.transpose(0, 2, 1))

    def rms(self, cov: Array) -> tuple[float, float]:
        """Return the RMS error over the volume: m, in space, and rad."""
        traces = np.trace(cov[:, :3, :3], axis1=1, axis2=2), np.trace(cov[:, 3:, 3:], axis1=1, axis2=2)
        return float(np.sqrt(traces[0].mean())), float(np.sqrt(traces[1].mean()))

    def along(self, cov: Array) -> tuple[float, float]:
        """Return the RMS over the volume of one lateral axis, and of depth, m."""
        depth = np.einsum("i,gij,j->g", self.forward, cov[:, :3, :3], self.forward)
        lateral = (np.trace(cov[:, :3, :3], axis1=1, axis2=2) - depth) / 2
        return float(np.sqrt(lateral.mean())), float(np.sqrt(depth.mean()))

    def at_level(self, cov: Array) -> tuple[Array, Array]:
        """Return what 95 % of the errors are within at each point: (G,) m and (G,) rad."""
        return radius(cov[:, :3, :3]), radius(cov[:, 3:, 3:])


def radius(cov: Array) -> Array:
    """Return (G,) the radius that holds 95 % of errors of covariances (G, 3, 3).

    The squared length is taken as a scaled chi-square of the same mean and variance (Satterthwaite 1946): within 2 %.
    """
    mean, square = np.trace(cov, axis1=1, axis2=2), np.einsum("gij,gji->g", cov, cov)
    safe = np.maximum(mean, 1e-300)
    scale = np.maximum(square, 1e-300) / safe
    level = np.sqrt(scale * 2 * gammaincinv(np.clip(safe / scale, 1.0, 3.0) / 2, LEVEL))
    return np.asarray(np.where(mean > 0, level, 0.0))


def volume_views(
    rig: StereoRig, points: Array, normals: Array, distance_m: float, size_m: Array, of_three: int | None = None
) -> list[PredictedView]:
    """Return a body at 27 positions of a volume: width, height, depth (3,), m, its middle at a distance.

    ``of_three``: 0, 1 or 2, for a pair of three cameras at the corners of an equilateral triangle: volume and body as that
    pair has them, which looks past the triangle's middle. What it sees is not cut: a real camera would not be rolled.
    """
    positions = np.array(list(product((-0.5, 0.0, 0.5), repeat=3)))[:, ::-1] * size_m

    def views(roll: float, below: float) -> list[PredictedView]:
        """Return the body rolled about the direction of view, and so far below: its pose is linear in its position."""
        first, *others = (
            view(rig, points, normals, distance_m + z, (0.0, 0.0), (x, y + below), roll)
            for x, y, z in np.vstack([np.zeros(3), np.eye(3)])
        )
        along = np.array([other.T_left_body[:3, 3] - first.T_left_body[:3, 3] for other in others])
        Ts = np.tile(first.T_left_body, (len(positions), 1, 1))
        Ts[:, :3, 3] += positions @ exp_so3(np.array([0.0, 0.0, roll])).T @ along
        return [view_at(rig, points, normals, T, first.forward) for T in Ts]

    plain = views(0.0, 0.0)
    if of_three is None:
        return plain
    rolled = views(of_three * _THIRD, rig.baseline_m / (2 * np.sqrt(3.0)))
    return [replace(one, seen=seen.seen) for one, seen in zip(rolled, plain, strict=True)]


def pose_budget(rig: StereoRig, points: Array, normals: Array, views: list[PredictedView], given: Conditions) -> Budget:
    """Return what each cause costs a body's pose.

    ``rig``: the cameras; their own covariance is not used, ``given.cov_calibration`` is. ``points``: (M, 3) points of the
    body, m. ``normals``: (M, 3) out of their faces; NaN where unknown. ``views``: where the body is. ``given``: what is not
    known. Raises InputError: at none of the positions do both cameras see enough of the body.
    """
    found: list[dict[str, Array]] = []
    at, lost, forward = [], list[float](), np.zeros(3)
    by_rig = {
        "calibration": covariance_root(given.cov_calibration),
        "print of the board": given.board_scale * scaled_rig(rig),
        "warming of the mount": given.mount_m * np.eye(rig.parameter_count)[:, -6:-3],
        "warming of the lenses": _lenses(rig, given.lens_share),
        "autofocus": _lenses(rig, given.refocus_share),
    }
    velocity = np.repeat(np.array([given.speed_m_s, given.rotation_rad_s]) / np.sqrt(3.0), 3)
    out = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0)
    flat, away = given.body_sigma_m
    together = (given.marker if len(given.marker) else np.arange(len(points))) == np.arange(len(points))[:, None]
    # Along a face and out of it; alike in all directions where the face is unknown.
    spread = flat * (np.eye(3) - out[:, :, None] * out[:, None]) + away * out[:, :, None] * out[:, None]
    for seen in views:
        d = pose_derivatives(rig, points, seen)
        if d is None:
            continue
        # As many sources as the pose has parts: what is seen differs from position to position.
        root = np.linalg.cholesky(d.noise(1.0))
        F = {name: root * sigma for name, sigma in given.noise_px.items()}
        F |= {name: d.by_rig @ root for name, root in by_rig.items() if root.size}
        each = np.einsum("gm,kmi,mij->kgj", together, d.by_point, spread).reshape(6, -1)
        larger = given.body_scale * np.einsum("kmi,mi->k", d.by_point, points)
        F["print of the body"] = np.column_stack([each, larger])
        heights = np.array([camera.image_size_px[1] for camera in rig.cameras])[d.side]
        late: Array = given.readout_s * (d.uv[:, 1] / (heights - 1) - 0.5)
        right = d.side.astype(np.float64)
        share, kept = _gated(rig, points, seen, d, given, late + given.skew_s * right, velocity)
        F["readout"] = d.moved(late) @ kept
        F["skew"], F["start of exposures"] = (d.moved(s * right) @ kept for s in (given.skew_s, given.start_s))
        F["time stamps"] = given.stamp_s * np.diag(velocity)
        for name, (m, rad) in {"hand-eye": given.handeye, "steps and backlash of the arm": given.arm}.items():
            F[name] = np.diag(np.repeat([m, rad], 3))
        R = np.kron(np.eye(2), seen.T_left_body[:3, :3])
        found.append({name: R @ each for name, each in F.items()})
        at.append(seen.T_left_body[:3, 3])
        lost.append(share)
        forward = forward + seen.forward
    if not found:
        raise InputError("both cameras together see three markers of the body nowhere in the volume")
    every = {name: np.array([one[name] for one in found]) for name in CAUSES if name in found[0]}
    factors = {name: each for name, each in every.items() if each.any()}
    return Budget(np.array(at), forward / np.linalg.norm(forward), factors, np.array(lost))


def gates(rig: StereoRig, target: Composite, seen: PredictedView, noise_px: float, sigma_m: float) -> Gates:
    """Ask ``measure``, by bisection, with what both cameras would detect; ``sigma_m``: of the motion along each axis."""
    limits, most_m = [np.inf, np.inf], _SURELY * sigma_m
    if not sigma_m or len(seen.paired) < 3:
        return Gates()
    p = transform(seen.T_left_body, target.body.points[seen.paired]).mean(axis=0)
    axes = _between_exposures(rig, p)
    limited = [k for k in (0, 1) if not _found(rig, target, seen, noise_px, most_m * axes[k])]
    if not limited or not _found(rig, target, seen, noise_px, np.zeros(3)):
        return Gates()
    for k in limited:
        low, high = 0.0, most_m
        for _ in range(_HALVED):
            middle = (low + high) / 2
            low, high = (middle, high) if _found(rig, target, seen, noise_px, middle * axes[k]) else (low, middle)
        limits[k] = (low + high) / 2
    both = np.isfinite(limits).all() and _found(rig, target, seen, noise_px, _CORNER * np.array(limits) @ axes)
    return Gates(limits[0] / float(np.linalg.norm(p)), limits[1], together=not both)


def _between_exposures(rig: StereoRig, p_left: Array) -> Array:
    """Return (2, 3) across the epipolar plane of a point (3,), and in it across the right camera's ray, left frame."""
    along, ray = rig.T_left_right[:3, 3], p_left - rig.T_left_right[:3, 3]
    across = np.cross(along, p_left)
    both = np.stack([across, np.cross(across, ray)])
    return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True))


def _found(rig: StereoRig, target: Composite, seen: PredictedView, noise_px: float, moved_m: Array) -> bool:
    """Whether ``measure`` finds a body that moved by (3,), m, left frame, before the right camera saw it."""
    points, first, coded, discs = target.body.points, len(target.body.points) - target.disc_count, [], []
    for side, T in enumerate((seen.T_left_body, pose(np.eye(3), moved_m) @ seen.T_left_body)):
        covs, there = np.tile(noise_px**2 * np.eye(2), (len(points), 1, 1)), seen.seen[:, side]
        ids, uv = np.flatnonzero(there[:first]), rig.project(transform(T, points))[side]
        coded.append(Detections(ids, uv[ids], covs[ids]))
        if target.discs is not None:
            at, k = expect(rig, target.discs, T), np.flatnonzero(there[first:])
            discs.append(Discs(at.uv[k, side], covs[k], at.shape[k, side], target.discs.bright[k]))
    if target.discs is None:
        return isinstance(measure_detections(rig, target.body, *coded), PoseEstimate)
    both = (coded[0], coded[1]), (discs[0], discs[1])
    return isinstance(locate_composite(rig, target.body, target.discs, *both), PoseEstimate)


def _gated(
    rig: StereoRig, points: Array, seen: PredictedView, d: PoseDerivatives, given: Conditions, late: Array, velocity: Array
) -> tuple[float, Array]:  # fmt: skip
    """Return the share of shots that move beyond the gates between the exposures, and V (6, 6) of the others' velocities.

    Of a velocity of independent parts (6,), the two that the gates limit have the second moments of the normal
    distribution within them; all else of it is as it was. ``late`` (N,), s.
    """
    pairs, (across_rad, along_m, together) = seen.paired, given.gate
    if not np.isfinite((across_rad, along_m)).any() or not (late.any() or given.start_s) or seen.seen.shape[1] == 1:
        return 0.0, np.diag(velocity)
    left, right = (late[(d.side == side) & np.isin(d.point, pairs)] for side in (0, 1))
    R, p = seen.T_left_body[:3, :3], transform(seen.T_left_body, points[pairs]).mean(axis=0)
    apart_s = math.hypot(float((right - left).mean()), given.start_s)
    moved = apart_s * _between_exposures(rig, p) @ np.hstack([R, -R @ skew(points[pairs].mean(axis=0))]) * velocity
    Q, L = np.linalg.qr((moved / np.array([[across_rad * np.linalg.norm(p)], [along_m]])).T)
    z = np.linspace(-_SURELY, _SURELY, _GRID)
    grid = np.stack(np.meshgrid(z, z), axis=-1).reshape(-1, 2)
    used = np.abs(grid @ L)
    inside = np.exp(-(grid**2).sum(axis=1) / 2)
    total = inside.sum()
    inside[(np.linalg.norm(used, axis=1) if together else used.max(axis=1)) > 1] = 0.0
    root = np.linalg.cholesky((grid.T * inside) @ grid / max(inside.sum(), 1e-300) + 1e-9 * np.eye(2))
    return float(1 - inside.sum() / total), np.diag(velocity) @ (np.eye(6) + Q @ (root - np.eye(2)) @ Q.T)


def of_three(pairs: Sequence[Budget], rig: StereoRig, board_scale: float = 0.0) -> Budget:
    """Return the budget of the mean of the poses that three cameras measure, each two of them as a pair.

    Each camera is in two pairs: what is its own is independent, and counts twice for that; all else is the same in all.

    ``pairs`` are those of :func:`volume_views`, 0, 1 and 2; axes are those of the first one's left camera.
    ``board_scale``: of the board's size, as a share: the distances of all three cameras grow with it.
    """
    first, factors = pairs[0], dict[str, Array]()
    # A larger board moves each pair's own left camera away from the triangle's middle.
    down = np.cross(first.forward, aside := rig.T_left_right[:3, 3])
    middle = np.append(aside / 2 + down / (2 * np.sqrt(3.0)), np.zeros(3))
    back = [np.kron(np.eye(2), exp_so3(-_THIRD * k * first.forward)) / 3 for k in range(3)]
    for name in first.factors:
        larger = board_scale * middle[:, None] if name == "print of the board" else 0.0
        parts = [R @ (each.factors[name] - larger) for R, each in zip(back, pairs, strict=True)]
        own = CAUSES[name].camera
        factors[name] = np.sqrt(2.0) * np.concatenate(parts, axis=2) if own else np.sum(parts, axis=0) + larger
    return replace(first, factors=factors, shared=())


def covariance_root(cov: Array) -> Array:
    """Return L (P, P) of a covariance L L^T, also where it is singular."""
    size = np.sqrt(np.maximum(np.diag(cov), 1e-300))
    values, vectors = np.linalg.eigh(cov / np.outer(size, size)) if len(cov) else (np.zeros(0), cov)
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def scaled_rig(rig: StereoRig) -> Array:
    """Return (P, 1) how the rig's parameters change with the size of the board: only the baseline grows with it."""
    by = np.zeros((rig.parameter_count, 1))
    by[-6:-3, 0] = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3]
    return by


def _lenses(rig: StereoRig, share: float) -> Array:
    """Return (P, 2) what the two lenses do: both focal lengths of a camera together."""
    by = np.zeros((rig.parameter_count, 2))
    for k, (first, camera) in enumerate(zip((0, rig.left.parameters.size), rig.cameras, strict=True)):
        by[first : first + 2, k] = share * camera.intrinsics[:2]
    return by


@lru_cache(maxsize=4)
def _printed(board: bytes) -> BundleModel:
    """Return the model of a board's corners (M, 3), m, as bytes; its shape takes a tenth of a second."""
    return printed_board(np.frombuffer(board).reshape(-1, 3))


def calibration_covariance(
    rig: StereoRig, board: Array, Ts_left_board: Array, sigma_px: float, bent_m: float = 0.0
) -> Array:
    """Return the covariance (P, P) of a calibration before it is made: the bundle's own, of noisy corners at the truth.

    Without noise its loss would discount nothing, and the covariance would be too small by a sixth.

    ``board``: (M, 3) corners of the board, m. ``Ts_left_board``: (S, 4, 4) where it is to be shown, all of it in both
    images. ``sigma_px``: standard deviation of a corner, px. ``bent_m``: of a corner of the board from its drawing along
    each axis, m, smoothly; it is estimated, too.
    """
    model, (S, M) = rigid_board(board), (len(Ts_left_board), len(board))
    if bent_m > 0:
        model = _printed(np.asarray(board, np.float64).tobytes())
        model = replace(model, shape_sigma_m=bent_m * np.sqrt(3.0 / len(model.modes)))
    state = BundleState(rig.cameras, rig.T_left_right, Ts_left_board, np.zeros(len(model.modes)))
    shot, side = np.repeat(np.arange(S), 2 * M), np.tile(np.repeat([0, 1], M), S)
    p = np.einsum("sij,mj->smi", Ts_left_board[:, :3, :3], board) + Ts_left_board[:, None, :3, 3]
    uv = np.stack([each.reshape(S, M, 2) for each in rig.project(p.reshape(-1, 3))], axis=1).reshape(-1, 2)
    uv = uv + sigma_px * np.random.default_rng(42).standard_normal(uv.shape)
    seen = Observations(shot, side, np.tile(np.arange(M), 2 * S), uv, np.zeros((len(uv), 2, 2)), S)
    found = minimise(model, state, seen, sigma_px, max_steps=0)
    return np.asarray(found.cov_shared[: rig.parameter_count, : rig.parameter_count])
