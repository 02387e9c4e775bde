"""The poses to take next: those that lower what is not known most, of those that can be reached and seen.

In: a hand-eye calibration and its poses, or a nominal arm with what was measured of it and the cameras. Out:
:class:`MountingPlan`, poses of the flange; or :class:`Plan`, joint angles with the predicted error after each.

A pose adds the information J^T C^-1 J, with the covariance C of what is measured there. The criterion is I-optimality: the
mean variance of what is requested, to first order. :func:`greedy` chooses among candidates; for joints its choice is
improved by coordinate exchange (:func:`exchanged`; Meyer and Nachtsheim, Technometrics 37, 1995): every joint of every pose
goes to the best of some levels, as long as that lowers the criterion.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.estimate.solve import whitened
from armsight.geometry.pose import inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.loop.handeye.handeye import HandEye
from armsight.loop.handeye.poses import LEVER_M, Poses
from armsight.loop.identify.fit import SIGMA, Mask, by_joints, linear_of, prior_sigma, variances_of
from armsight.loop.identify.identify import begun
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import FAST, RIPPLES, Model, all_features
from armsight.loop.identify.observable import observed
from armsight.loop.identify.selection import SCALED
from armsight.robot.kinematics.arm import Arm
from armsight.vision.rig import StereoRig

#: Returns the whitened Jacobians (N, M, F) of poses q (N, J) approached from sides (N, J), and which of them are allowed.
Information = Callable[[Array, Array], tuple[Array, Mask]]
_BATCH = 250  # candidates compared at once: bounds the memory
#: Levels that a joint is tried at, from both sides; most sweeps over all poses; least relative gain of a sweep to go on.
LEVELS, SWEEPS, MIN_GAIN = 7, 3, 0.01


def greedy(J: Array, P: Array, requested: Array, n: int, *, in_order: bool = False) -> tuple[Array, Array]:
    """Return rows chosen one by one, and the predicted RMS error before and after each.

    ``J``: (N, M, F) whitened Jacobians of the candidates. ``P``: (F, F) covariance before. ``requested``: (3 K, F)
    derivative of K positions, whose error is to be low. ``n``: how many to choose. ``in_order``: take them as they come
    instead.
    """
    left, chosen = np.ones(len(J), bool), list[int]()
    W = requested.T @ requested
    sigma = [_rms(P, W, len(requested))]
    for k in range(n):
        rows = np.flatnonzero(left)
        best = k if in_order else int(rows[np.argmax(_gains(J[rows], P, W))])
        G = P @ J[best].T
        P = P - G @ np.linalg.solve(np.eye(J.shape[1]) + J[best] @ G, G.T)
        P = (P + P.T) / 2
        left[best] = False
        chosen.append(best)
        sigma.append(_rms(P, W, len(requested)))
    return np.array(chosen), np.array(sigma)


def _rms(P: Array, W: Array, numbers: int) -> float:
    """Return the RMS length of the error of positions whose derivatives' squares sum to W, three numbers each."""
    return float(np.sqrt(3 * np.einsum("ij,ji->", W, P) / numbers))


def _gains(J: Array, P: Array, W: Array) -> Array:
    """Return by how much each pose lowers trace(W P): trace(S^-1 J P W P J^T)."""
    PWP, out = P @ W @ P, np.empty(len(J))
    for at in range(0, len(J), _BATCH):
        part = J[at : at + _BATCH]
        S = np.eye(J.shape[1]) + part @ P @ part.swapaxes(1, 2)
        out[at : at + _BATCH] = np.einsum("nii->n", np.linalg.solve(S, part @ PWP @ part.swapaxes(1, 2)))
    return out


def exchanged(
    q: Array,
    approach: Array,
    information: Information,
    P: Array,
    requested: Array,
    limits: tuple[Array, Array],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return poses (n, J) and sides (n, J) that together lower the error more than those given.

    ``q``: (n, J) joint angles to start from, rad. ``P`` and ``requested``: as for :func:`greedy`. ``limits``: (J,) and
    (J,) least and greatest angles, rad. ``rng`` sets the levels, and the order of the joints.
    """
    q, approach, W = q.copy(), approach.copy(), requested.T @ requested
    J, _ = information(q, approach)
    low, high = limits

    def best(q: Array, approach: Array, P: Array) -> tuple[Array, Array, Array]:
        """Return the best pose that changes of one joint after the other lead to, its sides, and its Jacobian."""
        for joint in rng.permutation(len(q)):
            step = (high[joint] - low[joint]) / (LEVELS - 1)
            levels = np.clip(low[joint] + step * (np.arange(LEVELS) + rng.uniform(-0.5, 0.5)), low[joint], high[joint])
            tried, sides = np.tile(q, (2 * LEVELS + 1, 1)), np.tile(approach, (2 * LEVELS + 1, 1))
            tried[1:, joint] = np.tile(levels, 2)
            sides[1 + LEVELS :, joint] *= -1
            J, allowed = information(tried, sides)
            allowed[0] = True  # the pose as it was: it stays where nothing is better
            row = int(np.argmax(np.where(allowed, _gains(J, P, W), -np.inf)))
            q, approach, kept = tried[row], sides[row], J[row]
        return q, approach, kept

    H = np.linalg.inv(P) + np.einsum("nki,nkj->ij", J, J)
    reached = _rms(np.linalg.inv(H), W, len(requested))
    for _ in range(SWEEPS):
        for k in range(len(q)):
            others = H - J[k].T @ J[k]
            q[k], approach[k], J[k] = best(q[k], approach[k], np.linalg.inv(others))
            H = others + J[k].T @ J[k]
        before, reached = reached, _rms(np.linalg.inv(H), W, len(requested))
        if reached > (1 - MIN_GAIN) * before:
            break
    return q, approach


CANDIDATES, PROBES = 800, 200  # candidates sampled, and positions of the workspace at which the error is predicted
SAMPLING_ROUNDS = 40  # most rounds of sampling four times as many, of which those allowed become candidates
#: Links must stay this far above the base's plane, m, and parts of the arm that are not neighbours this far apart.
FLOOR_M, APART_M = 0.02, 0.06
UNKNOWN = 0.1  # prior sigma of base and tool, m and rad, which have none in a fit
ROOM_RAD = 0.03  # poses keep this far from the joints' limits, rad: a joint must have room to come from either side
#: A prior sigma of an error source says how large it may be (a data sheet's limit); it mostly is this part of it.
TYPICAL_SHARE = 1 / 3
#: Joints scatter by so much from pose to pose, rad (0.1 mm at 1 m): else 0.03 mm would teach everything.
CHANCE_RAD = 1e-4
#: Assumed of an unknown instrument, and beyond the cameras' covariance: sigma of a position, m, and of a rotation, rad.
NOISE, BESIDES = (1e-4, 5e-4), (1e-6, 1e-6)
#: A body in the cameras: RMS distance of its markers from their middle, m, their count, and the sigma of each, px.
SPREAD_M, MARKERS, SIGMA_PX = 0.04, 6, 0.1
MARGIN_PX = 60.0  # a pose is seen where its body is this far from the images' edges, px
#: A body is taken to be visible up to the rotation at which it was seen already, and this much more, rad.
MORE_RAD = np.radians(10.0)


@dataclass(frozen=True, eq=False)
class Plan(Record):
    """The poses to measure next, best first."""

    q: Array  #: (n, J) joint angles, rad
    approach: Array  #: (n, J) from which side to come to each
    sigma_m: Array  #: (n + 1,) predicted RMS position error over the workspace, m, before and after each pose
    random_sigma_m: Array  #: (n + 1,) the same for random poses

    def random_for(self, n: int) -> int | None:
        """Return how many random poses reach the error of the first ``n`` planned ones; None: more than were sampled."""
        reached = np.flatnonzero(self.random_sigma_m <= self.sigma_m[n])
        return int(reached[0]) if len(reached) else None


def plan_joints(
    arm: Arm,
    done: Measured | None,
    rig: StereoRig | None,
    n: int,
    seed: int,
    *,
    noise: tuple[float, float] = NOISE,
    floor_m: float = FLOOR_M,
) -> Plan:
    """Choose the poses that lower the position error of an identification most.

    ``done``: what was measured already, which locates base and tool; None: all that can be reached counts as seen.
    ``noise``: sigmas of position, m, and rotation, rad, of the instrument where there is no rig. ``floor_m``: how far
    above the base's plane the links must stay, m.

    Raises:
        InputError: ``done`` is too few poses, or not of this arm; or fewer than ``n`` poses can be reached and seen.
        CalibrationError: the poses of ``done`` are so alike that they do not determine where the arm is.
    """
    rng = np.random.default_rng(seed)
    if done is None:
        T = arm.forward(arm.home[None])
        model = Model.of(arm, Measured(arm.home[None], T[:, None, :3, 3], T[:, :3, :3]), backlash=True)
        x, prior = model.nominal(), prior_sigma(model)
    else:
        model, x, prior = begun(arm, done)
    model, x, prior = _with_curves(model, x, prior)
    scene = _Scene.of(model, x, noise, floor_m, None if done is None else rig, done)
    q, approach, seen = scene.candidates(rng)
    if len(q) < n:
        raise InputError(f"only {len(q)} poses that can be reached and seen were found; {n} were asked for")
    prior = np.where([p.kind in SCALED for p in model.parameters], TYPICAL_SHARE * prior, prior)
    free = observed(model, x, seen, prior, scene.noise).possible
    P = np.diag(np.where(np.isfinite(prior), prior, UNKNOWN)[free] ** 2)
    if done is not None:
        Jd = scene.whitened(done)[:, :, free].reshape(-1, int(free.sum()))
        P = np.linalg.inv(np.linalg.inv(P) + Jd.T @ Jd)
    J = scene.whitened(seen)[:, :, free]
    part = seen.rows(rng.choice(len(seen), min(PROBES, len(seen)), replace=False))
    by = model.linearised(x, part)[1]
    requested = by[:, :3, free].reshape(-1, int(free.sum()))

    def information(q: Array, approach: Array) -> tuple[Array, Mask]:
        # Poses that are not allowed have zeros: behind a camera there is no covariance. The first is the pose as it was.
        allowed = scene.allowed(q, approach)
        rows = np.flatnonzero(allowed | (np.arange(len(q)) == 0))
        part = scene.whitened(scene.seen(q[rows], approach[rows]))[:, :, free]
        out = np.zeros((len(q), *part.shape[1:]))
        out[rows] = part
        return out, allowed

    chosen, _ = greedy(J, P, requested, n)
    better, sides = exchanged(q[chosen], approach[chosen], information, P, requested, scene.limits, rng)
    order, sigma = greedy(information(better, sides)[0], P, requested, n)
    _, random_sigma = greedy(J[rng.permutation(len(J))[: 4 * n]], P, requested, min(4 * n, len(J)), in_order=True)
    return Plan(better[order], sides[order], sigma, random_sigma)


def _with_curves(model: Model, x: Array, prior: Array) -> tuple[Model, Array, Array]:
    """Return a model, its vector and its priors with every harmonic of the sensors' curves."""
    backlash = any(f.kind == "backlash" for f in model.features)
    whole = model.with_features(all_features(model.arm.joints, backlash, (*RIPPLES, *FAST)))
    known = dict(zip(model.names, zip(x, prior, strict=True), strict=True))
    both = np.array([known.get(p.name, (0.0, SIGMA[p.kind])) for p in whole.parameters])
    return whole, both[:, 0], both[:, 1]


@dataclass(frozen=True, eq=False)
class _Scene(Record):
    """The measurements that poses would give, and which poses are allowed."""

    model: Model  #: the arm with every parameter
    x: Array  #: (P,) the vector
    noise: tuple[float, float]  #: sigmas of position, m, and rotation, rad, beyond what the rig's geometry gives
    floor_m: float  #: how far above the base's plane the links must stay, m
    rig: StereoRig | None  #: the cameras; None: everything is seen
    #: (2, 3) unit vectors, body's axes, from which each camera saw it, and (2,) the largest rotation from them, rad, or
    #: None
    sides: tuple[Array, Array] | None = None

    @staticmethod
    def of(
        model: Model,
        x: Array,
        noise: tuple[float, float],
        floor_m: float,
        rig: StereoRig | None,
        done: Measured | None,
    ) -> _Scene:
        """Return the scene; ``done`` shows from which sides the body is seen."""
        if rig is None:
            return _Scene(model, x, noise, floor_m, None)
        if done is None or done.R_rig_body is None:
            return _Scene(model, x, BESIDES, floor_m, rig)
        Ts = pose(done.R_rig_body, done.p_rig[:, 0])
        axes = _to_cameras(rig, Ts).mean(axis=0)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return _Scene(model, x, BESIDES, floor_m, rig, (axes, _rotated(rig, Ts, axes).max(axis=0)))

    @property
    def limits(self) -> tuple[Array, Array]:
        """Return least and greatest joint angles (J,), rad, of a plan."""
        arm = self.model.arm
        return np.maximum(arm.q_min + ROOM_RAD, -np.pi), np.minimum(arm.q_max - ROOM_RAD, np.pi)

    def T_rig_body(self, q: Array, approach: Array) -> Array:
        """Return the body (N, 4, 4) in the rig."""
        return np.asarray(self.model.T_rig_base(self.x) @ self.model.tool_in_base(self.x, q, approach))

    def allowed(self, q: Array, approach: Array) -> Mask:
        """Return which poses (N,) are visible and free of collision."""
        out, Ts = np.ones(len(q), bool), self.T_rig_body(q, approach)
        if self.rig is not None:
            for camera, p in zip(self.rig.cameras, _in_cameras(self.rig, Ts), strict=True):
                with np.errstate(invalid="ignore"):
                    inside = np.abs(camera.project(p) - np.array(camera.image_size_px) / 2)
                    room = np.array(camera.image_size_px) / 2 - MARGIN_PX
                    out &= (p[:, 2] > 0) & (inside < room).all(axis=1)
            if self.sides is not None:
                out &= (_rotated(self.rig, Ts, self.sides[0]) <= self.sides[1] + MORE_RAD).all(axis=1)
        out[out] = free_of_collision(self.model, q[out], self.floor_m)
        return out

    def seen(self, q: Array, approach: Array) -> Measured:
        """Return the measurements of poses without noise."""
        model, T = self.model, self.T_rig_body(q, approach)
        m = model.motion(self.x, q, model.feature_values(q, approach))
        p = m.o[:, None] + (m.R @ model.tool_points(self.x).T).swapaxes(1, 2)
        return Measured(q, p, T[:, :3, :3] if model.full else None, self._cov(T), approach)

    def _cov(self, Ts: Array) -> Array | None:
        """Return the covariance of bodies: of their middle from all markers, of their rotation from their spread."""
        if self.rig is None:
            return None
        H, points = np.zeros((len(Ts), 3, 3)), self.model.points
        rotations = (np.eye(3), inverse(self.rig.T_left_right)[:3, :3])
        for camera, p, R in zip(self.rig.cameras, _in_cameras(self.rig, Ts), rotations, strict=True):
            J = camera.project_jacobians(p)[1] @ R
            H += J.swapaxes(1, 2) @ J / SIGMA_PX**2
        C = np.linalg.inv(H) / MARKERS
        if not self.model.full:
            return np.asarray(np.kron(np.eye(points), min(points, MARKERS) * C))
        out = np.zeros((len(Ts), 6, 6))
        out[:, :3, :3] = Ts[:, :3, :3].swapaxes(1, 2) @ C @ Ts[:, :3, :3]
        # A rotation about one axis shows as displacement along the two others, so their mean stands for it.
        out[:, 3:, 3:] = np.eye(3) * (np.einsum("nii->n", C) / 3 / SPREAD_M**2)[:, None, None]
        return out

    def whitened(self, measured: Measured) -> Array:
        """Return the whitened Jacobians (N, M, P)."""
        linear = linear_of(self.model, self.x, measured, np.ones(len(self.x), bool), np.full(len(self.x), np.inf))
        variances = np.append(variances_of(linear, self.noise), CHANCE_RAD**2)
        return whitened(replace(linear, own=linear.own | {"joints": by_joints(self.model, linear.J)}), variances)[1]

    def candidates(self, rng: np.random.Generator) -> tuple[Array, Array, Measured]:
        """Return joint angles, directions of approach and measurements of poses that are reachable, free and visible."""
        angles, sides, found = [], [], 0
        for _ in range(SAMPLING_ROUNDS):
            q = rng.uniform(*self.limits, (4 * CANDIDATES, len(self.limits[0])))
            approach = rng.choice([-1.0, 1.0], q.shape)
            rows = np.flatnonzero(self.allowed(q, approach))[: CANDIDATES - found]
            angles.append(q[rows])
            sides.append(approach[rows])
            found += len(rows)
            if found == CANDIDATES:
                break
        q, approach = np.concatenate(angles), np.concatenate(sides)
        return q, approach, self.seen(q, approach)


def _in_cameras(rig: StereoRig, Ts: Array) -> tuple[Array, Array]:
    """Return the bodies' origins (N, 3) in either camera."""
    return Ts[:, :3, 3], transform(inverse(rig.T_left_right), Ts[:, :3, 3])


def _to_cameras(rig: StereoRig, Ts: Array) -> Array:
    """Return the unit vectors (N, 2, 3) from the body to both cameras, in its own axes."""
    cameras = np.stack([np.zeros(3), rig.T_left_right[:3, 3]])
    rays = (cameras - Ts[:, None, :3, 3]) @ Ts[:, :3, :3]
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def _rotated(rig: StereoRig, Ts: Array, axes: Array) -> Array:
    """Return the rotations (N, 2) of bodies from the sides ``axes`` (2, 3), rad."""
    return np.asarray(np.arccos(np.clip(np.einsum("nci,ci->nc", _to_cameras(rig, Ts), axes), -1, 1)))


def free_of_collision(model: Model, q: Array, floor_m: float = FLOOR_M) -> Mask:
    """Return which joint angles (N, J) keep the arm above the base's plane and apart from itself."""
    if not len(q):
        return np.zeros(0, bool)
    o = np.stack([model.arm.links(angles)[:, :3, 3] for angles in q])
    out = np.asarray((((o - model.arm.T_base_0[:3, 3]) @ model.up_base)[:, 2:] > floor_m).all(axis=1))
    steps = np.linspace(0, 1, 9)[:, None]

    def line(i: int, points: Array) -> Array:
        return np.asarray(o[out, i, None] + points * (o[out, i + 1] - o[out, i])[:, None])

    apart = np.ones(int(out.sum()), bool)
    for other in (line(0, steps), line(1, steps[:5])):  # the base's column, and the links from the elbow on
        for i in range(3, o.shape[1] - 1):
            between = line(i, steps)[:, :, None] - other[:, None]
            apart &= (np.einsum("nabk,nabk->nab", between, between) > APART_M**2).all(axis=(1, 2))
    out[out] = apart
    return out


#: Candidates for a mounting: largest rotation from a pose it had, rad, its larger space, its image's margin, a tangent.
POSES, NEAR_RAD, WIDER, BESIDE = 1500, np.radians(25), 0.2, 0.02


@dataclass(frozen=True, eq=False)
class MountingPlan(Record):
    """Poses of the flange to take."""

    Ts_base_flange: Array  #: (K, 4, 4) the poses
    sigma_m: Array  #: (K,) sigma of the mounting's translation along its worst axis after each, m
    sigma_rad: Array  #: (K,) the same of its rotation, rad
    before: tuple[float, float]  #: the two sigmas now
    nearest: NDArray[np.int64]  #: (K,) the pose, of those given, from which the flange rotates least
    rotated_rad: Array  #: (K,) by how much, rad
    moved_m: Array  #: (K,) the distance from it, m
    reasons: tuple[str, ...]  #: what each pose lowers most


def plan_mounting(found: HandEye, poses: Poses, count: int) -> MountingPlan:
    """Choose the poses that lower the sigma of the mounting most (a radian counting as 0.3 m).

    Candidates lie near poses that the arm has taken: each rotates one of them about the target's middle, the flange stays
    within its space, a fifth more, and the target within the part of the image and the distances in which it was seen.
    """
    A, B = _near(found, poses.rows(found.used), np.random.default_rng(0))
    J = found.whitened(Poses(A, B, np.tile(poses.cov.mean(axis=0), (len(A), 1, 1)), poses.in_hand, poses.centre))[1]
    chosen, _ = greedy(J, found.cov, np.diag(np.concatenate([np.zeros(6), np.repeat([1.0, LEVER_M], 3)])), count)
    informations = np.cumsum(J[chosen].swapaxes(1, 2) @ J[chosen], axis=0)
    covs = [found.cov, *np.linalg.inv(np.linalg.inv(found.cov) + informations)]
    sigma = np.array([worst_sigmas(cov) for cov in covs[1:]])
    R = found.T_flange_held[:3, :3]
    reasons = tuple(_lowered(one[6:, 6:], after[6:, 6:], R) for one, after in itertools.pairwise(covs))
    angle = np.linalg.norm(log_se3(inverse(poses.A)[None] @ A[chosen][:, None])[..., 3:], axis=2)
    nearest = np.argmin(angle, axis=1)
    moved = np.linalg.norm(A[chosen][:, :3, 3] - poses.A[nearest, :3, 3], axis=1)
    now, rotated = worst_sigmas(found.cov), angle[np.arange(count), nearest]
    return MountingPlan(A[chosen], sigma[:, 0], sigma[:, 1], now, nearest, rotated, moved, reasons)


def _lowered(before: Array, after: Array, R: Array) -> str:
    """Say which sigma of the mounting falls most from one covariance (6, 6) to another; R gives the flange's axes."""
    falls = []
    for part, unit, times, size in ((slice(0, 3), "mm", 1e3, 1.0), (slice(3, 6), "deg", np.degrees(1.0), LEVER_M)):
        values, vectors = np.linalg.eigh(before[part, part] - after[part, part])
        axis = vectors[:, -1]
        named = R @ axis * np.sign((R @ axis)[np.argmax(np.abs(R @ axis))])
        sigmas = [times * float(np.sqrt(axis @ C[part, part] @ axis)) for C in (before, after)]
        along = "along" if unit == "mm" else "about"
        said = f"{along} [{' '.join(f'{v:.1f}' for v in named)}] {sigmas[0]:.3g} to {sigmas[1]:.3g} {unit}"
        falls.append((size**2 * float(values[-1]), said))
    return max(falls)[1]


def worst_sigmas(cov: Array) -> tuple[float, float]:
    """Return the sigmas of the mounting along its worst axes, m and rad, of a covariance (12, 12)."""
    return (float(np.sqrt(np.linalg.eigvalsh(cov[6:9, 6:9])[-1])), float(np.sqrt(np.linalg.eigvalsh(cov[9:, 9:])[-1])))


def _near(found: HandEye, poses: Poses, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return candidates: poses of the flange, and of the body as it would be seen there."""
    p = transform(poses.B, poses.centre)
    distance = np.linalg.norm(p, axis=1)
    k, other = rng.integers(0, len(p), (2, POSES))
    axis = rng.standard_normal((POSES, 3))
    angle = NEAR_RAD * rng.uniform(0, 1, POSES) ** (1 / 3)
    R = exp_so3(axis * (angle / np.linalg.norm(axis, axis=1))[:, None]) @ poses.B[k, :3, :3]
    middle = p[other] * (rng.uniform(distance.min(), distance.max(), POSES) / distance[other])[:, None]
    B = pose(R, middle - R @ poses.centre)
    Z, X = found.T_base_still, found.T_flange_held
    A = Z @ inverse(X @ B) if poses.in_hand else Z @ B @ inverse(X)
    seen, was = middle[:, :2] / middle[:, 2:], p[:, :2] / p[:, 2:]
    low, high = poses.A[:, :3, 3].min(axis=0), poses.A[:, :3, 3].max(axis=0)
    margin = WIDER * (high - low) + 0.02
    facing = np.einsum("ni,ni->n", B[:, :3, 2], middle) / np.linalg.norm(middle, axis=1)
    faced = np.einsum("ni,ni->n", poses.B[:, :3, 2], p) / distance
    good = (
        (seen >= was.min(axis=0) - BESIDE).all(axis=1)
        & (seen <= was.max(axis=0) + BESIDE).all(axis=1)
        & (A[:, :3, 3] >= low - margin).all(axis=1)
        & (A[:, :3, 3] <= high + margin).all(axis=1)
        & (facing * np.sign(np.median(faced)) > min(0.6, float(np.abs(faced).min())))
    )
    return (A[good], B[good]) if good.any() else (poses.A, poses.B)
