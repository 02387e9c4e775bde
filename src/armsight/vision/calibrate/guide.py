"""The next pose of a calibration board: the one that lowers the predicted error over the working volume most.

In: what the shots taken so far determine (:class:`Knowledge`). Out: a :class:`NextPose`. Every candidate is a pose in full
view of both cameras. Its information about the shared parameters (cameras, relative pose, shape of the board) follows from
the derivatives of bundle adjustment with the board's own pose eliminated; the predicted error is the RMS over the working
volume of the distance by which the calibration's covariance moves a triangulated point (A-optimal design, as in Rojtberg
and Kuijper, "Efficient pose selection for interactive camera calibration", ISMAR 2018, but in mm and for a pair).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from armsight.data import Array, Record
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.calibrate.boards import printed_board, rigid_board
from armsight.vision.calibrate.budget import covariance_root
from armsight.vision.calibrate.result import Calibration, corner_variance_px2
from armsight.vision.calibrate.start import pinhole
from armsight.vision.camera import Camera
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.pose.bundle import BundleModel, BundleState, Observations, predict
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points

#: Candidates of one choice, and how they are sampled: share of the image's height that the board takes, tilt, roll.
CANDIDATES = 80
_FILL, _TILT_RAD, _ROLL_RAD = (0.35, 1.05), np.radians(42.0), np.radians(20.0)
#: A board is read up to this angle between its normal and the line of sight, and this far from the image's border, px.
_SLANT_COS, _MARGIN_PX = np.cos(np.radians(60.0)), 6.0
#: Rows and columns of the left image, and shares of the distance, at which the working volume is sampled.
_GRID, _DEPTHS = (6, 4), (0.75, 1.0, 1.25)
#: Focal length over the image's width before anything is known: a webcam's.
GUESSED_FOCAL = 0.85
#: Poses before the first calibration, as rotation vectors about the board's axes, degrees; straight ahead.
FIRST_DEG = ((0.0, 0.0, 0.0), (28.0, 6.0, 4.0), (-26.0, 12.0, -6.0), (8.0, -28.0, 8.0), (-8.0, 26.0, 0.0))
_SHOTS_AHEAD = 12


@dataclass(frozen=True)
class CalibrationAim:
    """What a calibration is to be good for."""

    error_m: float = (
        0.0  # predicted error that it may leave in a point, RMS over the working volume; 0: the point's noise
    )
    distance_m: float = 0.8  # of the volume's middle; it reaches a quarter nearer and farther


@dataclass(frozen=True, eq=False)
class NextPose(Record):
    """The pose to show next, left camera's frame, and the predicted error after a shot of it (NaN before the first fit)."""

    T_left_board: Array
    then_m: float


def working_points(rig: StereoRig, distance_m: float) -> Array:
    """Return points (N, 3) of the working volume that both cameras see, m, left camera's frame."""
    width, height = rig.left.image_size_px
    u, v = (np.linspace(0.06, 0.94, count) * size for count, size in zip(_GRID, (width, height), strict=True))
    rays = rig.left.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    rays = rays[np.isfinite(rays).all(axis=1)]
    points = np.concatenate([share * distance_m * rays for share in _DEPTHS])
    uv, size = rig.project(points)[1], np.array(rig.right.image_size_px)
    with np.errstate(invalid="ignore"):
        return np.asarray(points[((uv > 0) & (uv < size - 1)).all(axis=1)])


def error_weights(rig: StereoRig, points: Array) -> Array:
    """Return W (P, P): the mean squared error of points (N, 3) under a covariance C of the rig's parameters is tr(W C)."""
    uv = np.stack(rig.project(points), axis=1)
    _, _, by_rig = optimal_points(rig, uv, np.tile(np.eye(2), (len(uv), 2, 1, 1)))
    by_rig = by_rig[np.isfinite(by_rig).all(axis=(1, 2))]
    flat = by_rig.reshape(-1, by_rig.shape[2])
    return np.asarray(flat.T @ flat / max(len(by_rig), 1))


def noise_m(rig: StereoRig, points: Array, variance_px2: Array) -> float:
    """Return the RMS error of points (N, 3) by the noise of one detection in each view alone, m.

    A calibration that leaves less changes a measurement little; ``variance_px2`` (2,) is that of a detection, px^2.
    """
    cov_uv = np.broadcast_to(variance_px2[:, None, None] * np.eye(2), (len(points), 2, 2, 2))
    cov = optimal_points(rig, np.stack(rig.project(points), axis=1), cov_uv)[1]
    return float(np.sqrt(np.nanmean(np.trace(cov, axis1=1, axis2=2))))


@dataclass(frozen=True, eq=False)
class Knowledge(Record):
    """What the shots so far determine about the Q shared parameters of bundle adjustment."""

    model: BundleModel
    state: BundleState  # cameras, relative pose, shape; no shots
    root: Array  # (Q, Q) L of the covariance L L^T
    sigma_px: float  # of a detection
    weights: Array  # (P, P) as error_weights
    goal_m: float  # the predicted error that is good enough

    @staticmethod
    def of(calibration: Calibration, board: CalibrationBoard, aim: CalibrationAim) -> Knowledge:
        """Return what a calibration determines."""
        state, points = calibration.solution.state, board.body.points
        model = printed_board(points) if len(state.shape) else rigid_board(points)
        model = replace(model, disc_radius_m=calibration.disc_radius_m or 0.0)
        root = covariance_root(calibration.solution.cov_shared * calibration.held_out.normalised_rms**2)
        variance, points = corner_variance_px2(calibration), working_points(calibration.rig, aim.distance_m)
        goal_m = aim.error_m or noise_m(calibration.rig, points, variance)
        bare = replace(state, Ts_left_body=np.zeros((0, 4, 4)), motions=np.zeros((0, 6)))
        weights = error_weights(calibration.rig, points)
        return Knowledge(model, bare, root, float(np.sqrt(variance.mean())), weights, goal_m)

    @property
    def error_m(self) -> float:
        """Predicted RMS error of a point of the working volume, m."""
        return float(np.sqrt(np.trace(self._target())))

    def _target(self) -> Array:
        """Return L^T W L (Q, Q)."""
        part = self.root[: len(self.weights)]
        return np.asarray(part.T @ self.weights @ part)

    def _gains(self, Ts_left_board: Array) -> Array:
        """Return I + L^T H L (C, Q, Q), H the information that a shot of each pose adds, its own pose eliminated."""
        count, points = len(Ts_left_board), len(self.model.points)
        rows = 2 * points
        observations = Observations(
            np.repeat(np.arange(count), rows),
            np.tile(np.repeat([0, 1], points), count),
            np.tile(np.arange(points), 2 * count),
            np.zeros((count * rows, 2)),
            np.zeros((count * rows, 2, 2)),
            count,
        )
        _, J_shared, J_shot = predict(self.model, replace(self.state, Ts_left_body=Ts_left_board), observations)
        A, B = (J.reshape(count, 2 * rows, -1) / self.sigma_px for J in (J_shared, J_shot))
        A = A @ self.root
        cross = B.transpose(0, 2, 1) @ A
        own = np.linalg.solve(B.transpose(0, 2, 1) @ B, cross)
        return np.asarray(np.eye(A.shape[2]) + A.transpose(0, 2, 1) @ A - cross.transpose(0, 2, 1) @ own)

    def errors_after_m(self, Ts_left_board: Array) -> Array:
        """Return (C,) the predicted error after one more shot, of each of the poses (C, 4, 4), m."""
        target = np.broadcast_to(self._target(), (len(Ts_left_board), *self.root.shape))
        return np.asarray(np.sqrt(np.trace(np.linalg.solve(self._gains(Ts_left_board), target), axis1=1, axis2=2)))

    def after(self, T_left_board: Array) -> Knowledge:
        """Return what is known after a shot of a pose (4, 4)."""
        R = np.linalg.cholesky(self._gains(T_left_board[None])[0])
        return replace(self, root=solve_triangular(R, self.root.T, lower=True).T)


class Guide:
    """Chooses poses of a board; ``outline`` is its sheet: (4, 3) corners, m, board frame."""

    def __init__(self, board: CalibrationBoard, seed: int = 0) -> None:
        self._rng = np.random.default_rng([seed, 22])
        points = board.body.points
        border = np.linalg.norm(points[1] - points[0]) * np.array([1.0, 1.0, 0.0])
        low, high = points.min(axis=0) - border, points.max(axis=0) + border
        self._middle, self._diagonal_m = (low + high) / 2, float(np.linalg.norm(high - low))
        edges = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        self.outline = np.array([(x, y, 0.0) for x, y in edges])
        self._flip = np.diag([1.0, -1.0, -1.0]) if board.y_up else np.eye(3)

    def facing(self, p_left: Array, rotation: Array) -> Array:
        """Return the pose (4, 4) with the board's middle at a point (3,), rotated (rotation vector, rad) from facing."""
        R = exp_so3(rotation) @ self._flip
        return pose(R, p_left - R @ self._middle)

    def in_view(self, rig: StereoRig, Ts_left_board: Array) -> Array:
        """Return (C,) whether the whole board is well in view of both cameras, for poses (C, 4, 4)."""
        good = np.ones(len(Ts_left_board), bool)
        for camera, T in ((rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right))):
            Ts = T @ Ts_left_board
            p = transform(Ts[:, None], self.outline)
            uv, away = camera.project(p.reshape(-1, 3)), p / np.linalg.norm(p, axis=-1, keepdims=True)
            with np.errstate(invalid="ignore"):
                back = camera.unproject(uv)  # where a distortion folds back, a point far outside seems to be inside
                same = (np.abs(back.reshape(p.shape) - away) < 1e-5).all(axis=(1, 2))
                low, high = _MARGIN_PX, np.array(camera.image_size_px) - 1 - _MARGIN_PX
                inside = ((uv > low) & (uv < high)).all(axis=1).reshape(-1, 4).all(axis=1)
            slant = np.abs(np.einsum("cni,ci->cn", away, Ts[:, :3, 2])).min(axis=1) > _SLANT_COS
            good &= inside & same & slant & (p[..., 2] > 0.02).all(axis=1)
        return good

    def candidates(self, rig: StereoRig, count: int = CANDIDATES) -> Array:
        """Return up to ``count`` poses (C, 4, 4) in full view of both cameras, all over the images, near and far."""
        found: list[Array] = []
        width, height = rig.left.image_size_px
        for _ in range(8):
            if sum(map(len, found)) >= count:
                break
            n = 2 * count
            uv = self._rng.uniform(0.05, 0.95, (n, 2)) * (width, height)
            fill = self._rng.uniform(*_FILL, n)
            distance = rig.left.intrinsics[0] * self._diagonal_m / (fill * height)
            about, tilt = self._rng.uniform(0, 2 * np.pi, n), _TILT_RAD * np.sqrt(self._rng.uniform(0, 1, n))
            roll = self._rng.uniform(-_ROLL_RAD, _ROLL_RAD, n)
            rotation = np.stack([tilt * np.cos(about), tilt * np.sin(about), roll], axis=1)
            p = distance[:, None] * rig.left.unproject(uv)
            p = np.where(np.isfinite(p), p, 0.0)
            Ts = np.array([self.facing(*each) for each in zip(p, rotation, strict=True)])
            found.append(Ts[self.in_view(rig, Ts)])
        return np.concatenate(found)[:count]

    def best(self, knowledge: Knowledge, rig: StereoRig) -> NextPose | None:
        """Return the candidate after which the predicted error is least; None where no pose is in view of both cameras."""
        Ts = self.candidates(rig)
        if not len(Ts):
            return None
        errors = knowledge.errors_after_m(Ts)
        k = int(np.nanargmin(errors))
        return NextPose(Ts[k], float(errors[k]))

    def shots_missing(self, knowledge: Knowledge, rig: StereoRig) -> int | None:
        """Return how many more guided shots are predicted to reach the goal; None where more than a dozen."""
        Ts = self.candidates(rig, CANDIDATES // 4)
        for count in range(_SHOTS_AHEAD + 1):
            if knowledge.error_m <= knowledge.goal_m:
                return count
            if not len(Ts):
                break
            knowledge = knowledge.after(Ts[int(np.nanargmin(knowledge.errors_after_m(Ts)))])
        return None

    def first(self, number: int, rig: StereoRig) -> NextPose | None:
        """Return one of the poses before the first calibration, in view of the guessed cameras; None where none is."""
        rotation = np.radians(FIRST_DEG[number % len(FIRST_DEG)])
        near = rig.left.intrinsics[0] * self._diagonal_m / (0.75 * rig.left.image_size_px[1])
        for share in np.linspace(1.0, 2.5, 7):
            ahead = np.array([0.0, 0.0, share * near])
            T = self.facing((ahead + transform(rig.T_left_right, ahead)) / 2, rotation)
            if self.in_view(rig, T[None])[0]:
                return NextPose(T, float("nan"))
        return None


def guessed_rig(sizes: tuple[tuple[int, int], tuple[int, int]], T_left_right: Array) -> StereoRig:
    """Return a rig before the first calibration: ordinary lenses without distortion, at a relative pose (4, 4)."""
    left, right = (guessed_camera(size) for size in sizes)
    return StereoRig(left, right, T_left_right, np.zeros((14, 14)), 0.0)


def guessed_camera(size: tuple[int, int]) -> Camera:
    """Return a camera before anything is known of it."""
    return pinhole(size, GUESSED_FOCAL * size[0], "none")
