"""Hand-eye calibration of two streams of poses whose clocks differ by an unknown amount.

In: times and poses of the flange, times and poses of the measured body. Out: :class:`StreamHandEye` with the offset and its
sigma. The offset is found first from the two angular speeds, which no mounting changes (correlation over all offsets that
leave an overlap), then fitted together with both transforms. Poses of a stream are not independent: the covariance is that
of blocks longer than the residuals' correlation (jackknife), not of single poses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.handeye.handeye import Eye, HandEye, Poses, calibrate_handeye, covariances, residuals
from armsight.loop.handeye.noise import STRUCTURES
from armsight.loop.handeye.structured import StructuredHandEye, calibrate_structured

#: Poses used at most for the fit, spread evenly: a stream's neighbours say the same.
MAX_POSES = 600
#: A gap in the flange's stream longer than this, s, is not interpolated over.
GAP_S = 0.25
#: Rotation slower than this, rad/s, does not determine the time offset.
MIN_SPEED_RAD_S = 0.02
#: Rounds of offset and transforms, and the change of the offset, s, below which it has settled.
ROUNDS, SETTLED_S = 12, 1e-6
#: Over this time the speed of the flange is measured, s.
SPEED_S = 0.02
#: Steps between poses over which angular speeds are taken, and how much faster than the slower stream is a blunder.
OVER, FASTER = (4, 12, 36), 1.3
#: Blocks at least: fewer do not determine a variance.
MIN_BLOCKS = 8
#: Less than this part of a direction's information without one block counts as none: its sigma is a thousand times as
#: large.
MIN_LEFT = 1e-6


@dataclass(frozen=True, eq=False)
class PoseStream(Record):
    """Poses over time.

    Attributes:
        t_s: (N,) strictly increasing times, s, on the stream's own clock.
        Ts: (N, 4, 4) poses.
    """

    t_s: Array
    Ts: Array

    @staticmethod
    def of(t_s: ArrayLike, Ts: ArrayLike, name: str) -> PoseStream:
        """Return a stream in the order of time; of poses at one time the first is kept.

        Raises:
            InputError: shapes, NaN, or fewer than 20 poses.
        """
        times = checked(t_s, (None,), f"{name}: t_s")
        poses = checked(Ts, (len(times), 4, 4), f"{name}: Ts")
        times, rows = np.unique(times, return_index=True)
        if len(times) < 20:
            raise InputError(f"{name}: {len(times)} poses at different times; 20 and more are needed")
        return PoseStream(times, poses[rows])

    def at(self, t_s: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return poses (M, 4, 4) at times, interpolated, and whether a time is within the stream and in no gap."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        good = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & (self.t_s[after] - self.t_s[after - 1] <= GAP_S)
        inside = np.clip(t_s, self.t_s[0], self.t_s[-1])
        T = np.zeros((len(t_s), 4, 4))
        T[:, :3, :3] = Slerp(self.t_s.copy(), Rotation.from_matrix(self.Ts[:, :3, :3].copy()))(inside).as_matrix()
        for k in range(3):
            T[:, k, 3] = np.interp(inside, self.t_s, self.Ts[:, k, 3])
        T[:, 3, 3] = 1.0
        return T, good

    def angular_speed(self, t_s: Array, over_s: float) -> tuple[Array, NDArray[np.bool_]]:
        """Return angular speeds (M,), rad/s, about times, and whether the stream covers them."""
        (early, first), (late, last) = self.at(t_s - over_s / 2), self.at(t_s + over_s / 2)
        rotation = Rotation.from_matrix(early[:, :3, :3]).inv() * Rotation.from_matrix(late[:, :3, :3])
        return np.asarray(rotation.magnitude() / over_s), first & last


@dataclass(frozen=True, eq=False)
class StreamHandEye(Record):
    """A hand-eye calibration of two streams.

    Attributes:
        handeye: the calibration; its covariance allows for the correlation within the streams.
        offset_s: to be added to the eye's times to give the hand's.
        sigma_offset_s: its sigma.
        poses: how many poses of the eye were used.
    """

    handeye: HandEye
    offset_s: float
    sigma_offset_s: float
    poses: int


def calibrate_streams(
    hand: PoseStream,
    eye_stream: PoseStream,
    *,
    eye: Eye = "to_hand",
    progress: Callable[[str], None] = lambda line: None,
) -> StreamHandEye:
    """Find the mounting and the time offset of two streams.

    Args:
        hand: T_base_flange over time.
        eye_stream: T_rig_body over time, on another clock.
        eye: as in :func:`calibrate_handeye`.
        progress: called with the name of each step as it begins.

    Raises:
        CalibrationError: the streams do not overlap, nothing rotates, or the motions leave a direction undetermined.
    """
    progress("time offset")
    offset = coarse_offset(hand, eye_stream)
    rows = np.linspace(0, len(eye_stream.t_s) - 1, min(MAX_POSES, len(eye_stream.t_s))).astype(int)
    t_eye, B = eye_stream.t_s[rows], eye_stream.Ts[rows]
    h = _calibrated(hand, t_eye, B, offset, eye)
    for _ in range(ROUNDS):
        progress(f"mounting and time offset {1e3 * offset:.2f} ms")
        step, X, Z = _joint_step(hand, t_eye, B, offset, h)
        offset += float(np.clip(step, -0.05, 0.05))
        h = replace(h, T_flange_held=X, T_base_still=Z)
        if abs(step) < SETTLED_S:
            break
    h = _calibrated(hand, t_eye, B, offset, eye)
    step, _, _ = _joint_step(hand, t_eye, B, offset, h)
    offset += step
    h = _calibrated(hand, t_eye, B, offset, eye)
    cov = _block_covariance(hand, t_eye, B, offset, h)
    held = replace(h, cov=cov[:12, :12])
    return StreamHandEye(held, offset, float(np.sqrt(cov[12, 12])), int(h.used.sum()))


@dataclass(frozen=True, eq=False)
class StructuredStreams(Record):
    """A hand-eye calibration of two streams whose noise has a structure.

    Attributes:
        handeye: the calibration; its rows are those of the eye's poses that were used, in the order of time.
        offset_s: to be added to the eye's times to give the hand's; sigma_offset_s its sigma.
        t_s: (M,) the eye's times of these rows, s, on the eye's clock.
        A: (M, 4, 4) the flange at these times.
        B: (M, 4, 4) the body as seen.
    """

    handeye: StructuredHandEye
    offset_s: float
    sigma_offset_s: float
    t_s: Array
    A: Array
    B: Array


def calibrate_structured_streams(
    hand: PoseStream,
    eye_stream: PoseStream,
    *,
    eye: Eye = "to_hand",
    centre: ArrayLike = (0.0, 0.0, 0.0),
    scale: bool = False,
    links_at: Callable[[Array], Array] | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> StructuredStreams:
    """Find the mounting, the time offset and the structure of the noise of two streams.

    Args:
        hand: T_base_flange over time.
        eye_stream: T_rig_body over time, on another clock.
        eye: as in :func:`~armsight.loop.handeye.handeye.calibrate_handeye`.
        centre: (3,) the middle of the body's points, body frame, m.
        scale: whether the size of the target may be wrong.
        links_at: times (N,), s, on the hand's clock -> T_link_flange (N, L, 4, 4) of every link, where the joints and a
            model are known.
        progress: called with the name of each step as it begins.

    Raises:
        CalibrationError: the streams do not overlap, nothing rotates, or the motions leave a direction open.
    """
    progress("time offset")
    offset = coarse_offset(hand, eye_stream)
    rows = np.linspace(0, len(eye_stream.t_s) - 1, min(MAX_POSES, len(eye_stream.t_s))).astype(int)
    for structures in (("robot and camera",), ("robot and camera",), tuple(STRUCTURES)):
        t_eye, B = eye_stream.t_s[rows], eye_stream.Ts[rows]
        A, good = hand.at(t_eye + offset)
        early, first = hand.at(t_eye + offset - SPEED_S / 2)
        late, last = hand.at(t_eye + offset + SPEED_S / 2)
        good &= first & last
        if good.sum() < 20:
            raise CalibrationError(f"the streams overlap in {int(good.sum())} poses only; 20 and more are needed")
        poses = Poses(
            A[good], B[good], np.zeros((int(good.sum()), 6, 6)), eye == "in_hand", np.asarray(centre, dtype=float)
        )
        speed = log_se3(inverse(early[good]) @ late[good]) / SPEED_S
        found = calibrate_structured(
            poses,
            t_s=t_eye[good],
            speed=speed,
            links=None if links_at is None else links_at(t_eye[good] + offset),
            scale=scale,
            structures=structures,
            progress=progress,
        )
        offset += found.step_s
    return StructuredStreams(found, offset, found.sigma_step_s, t_eye[good], poses.A, poses.B)


def coarse_offset(hand: PoseStream, eye: PoseStream) -> float:
    """Return the offset, s, at which the two angular speeds agree best: to be added to the eye's times.

    Speeds are taken over intervals of several lengths, short ones for quick motions and long ones against noise; the length
    counts under which agreement stands out most. Faster than the slower stream ever rotates is a blunder of the other.

    Raises:
        CalibrationError: nothing rotates.
    """
    step = float(np.clip(np.median(np.diff(eye.t_s)), 0.005, 0.05))
    if max(float(np.quantile(_speeds(stream, step, OVER[0])[1], 0.9)) for stream in (hand, eye)) < MIN_SPEED_RAD_S:
        raise CalibrationError(
            "nothing rotates in these streams: rotate the flange, about two axes, at 10 deg/s and more"
        )
    shorter = min(np.ptp(stream.t_s) for stream in (hand, eye))
    lengths = [over for over in OVER if over == OVER[0] or 10 * over * step < shorter]
    return min(_agreement(hand, eye, step, over) for over in lengths)[1]


def _speeds(stream: PoseStream, step: float, over: int) -> tuple[float, Array, Array]:
    """Return the first time, angular speeds over so many steps, rad/s, and 1.0 where the stream covers them."""
    grid = np.arange(stream.t_s[0] + over * step, stream.t_s[-1] - over * step, step)
    speed, good = stream.angular_speed(grid, over * step)
    return float(grid[0]), np.where(good, speed, 0.0), good.astype(float)


def _agreement(hand: PoseStream, eye: PoseStream, step: float, over: int) -> tuple[float, float]:
    """Return how much the speeds differ at best, as a share of what they differ by at other offsets, and the offset, s."""
    (t_hand, a, in_a), (t_eye, b, in_b) = (_speeds(stream, step, over) for stream in (hand, eye))
    most = FASTER * min(float(np.quantile(speed, 0.99)) for speed in (a, b))
    a, in_a, b, in_b = np.where(a > most, 0.0, a), in_a * (a <= most), np.where(b > most, 0.0, b), in_b * (b <= most)
    both = _correlation(in_a, in_b)
    enough = both > 0.3 * both.max()
    # The mean square difference of the speeds, against what they are themselves where they overlap.
    size = _correlation(a**2 * in_a, in_b) + _correlation(in_a, b**2 * in_b)
    squares = size - 2 * _correlation(a, b)
    cost = np.where(enough & (size > 1e-9), squares / np.maximum(size, 1e-12), np.inf)
    lag = int(np.argmin(cost)) - (len(b) - 1)
    return float(cost.min() / np.median(cost[np.isfinite(cost)])), float(t_hand + lag * step - t_eye)


def _correlation(a: Array, b: Array) -> Array:
    """Return sum over k of a[k + lag] b[k] for all lags from 1 - len(b)."""
    n = len(a) + len(b) - 1
    size = 1 << (n - 1).bit_length()
    product = np.fft.irfft(np.fft.rfft(a, size) * np.fft.rfft(b[::-1], size), size)
    return np.asarray(product[:n])


def _calibrated(hand: PoseStream, t_eye: Array, B: Array, offset: float, eye: Eye) -> HandEye:
    A, good = hand.at(t_eye + offset)
    if good.sum() < 20:
        raise CalibrationError(f"the streams overlap in {int(good.sum())} poses only; 20 and more are needed")
    return calibrate_handeye(A[good], B[good], eye=eye, folds=4, shares=("flange",))


def _linear(hand: PoseStream, t_eye: Array, B: Array, offset: float, h: HandEye) -> tuple[Array, Array, Array, Array]:
    """Return residuals (N, 6), derivative (N, 6, 13) by both transforms and the offset, covariances, and times."""
    A, good = hand.at(t_eye + offset)
    early, first = hand.at(t_eye + offset - SPEED_S / 2)
    late, last = hand.at(t_eye + offset + SPEED_S / 2)
    good &= first & last
    poses = Poses(A[good], B[good], np.zeros((int(good.sum()), 6, 6)), h.eye == "in_hand", np.zeros(3))
    e, J, carry = residuals(poses, h.T_base_still, h.T_flange_held)
    speed = log_se3(inverse(early[good]) @ late[good]) / SPEED_S
    by_time = (carry @ speed[..., None])[..., 0]
    C = covariances(poses, carry, (h.sigma_flange_m, h.sigma_flange_rad, h.sigma_seen_m, h.sigma_seen_rad))
    sane = np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e) < 60.0  # gross errors: chance 1e-10
    return e[sane], np.concatenate([J, by_time[..., None]], axis=2)[sane], C[sane], t_eye[good][sane]


def _joint_step(hand: PoseStream, t_eye: Array, B: Array, offset: float, h: HandEye) -> tuple[float, Array, Array]:
    """Return the Gauss-Newton step of the offset, and the transforms after it."""
    e, J, C, _ = _linear(hand, t_eye, B, offset, h)
    WJ = np.linalg.solve(C, J)
    step = -np.linalg.lstsq(np.einsum("nki,nkj->ij", J, WJ), np.einsum("nki,nk->i", WJ, e), rcond=1e-14)[0]
    return float(step[12]), h.T_flange_held @ exp_se3(step[6:12]), h.T_base_still @ exp_se3(step[:6])


def _block_covariance(hand: PoseStream, t_eye: Array, B: Array, offset: float, h: HandEye) -> Array:
    """Return the covariance (13, 13) that leaving out blocks of time, one after the other, shows.

    The delete-a-group jackknife: unlike the plain sandwich it allows for what each block pulls the fit its own way, which
    counts where blocks are as few as the unknowns (Bell and McCaffrey, Survey Methodology 28, 2002).

    Raises:
        CalibrationError: without one block a direction is undetermined, and nothing says how well it is known.
    """
    e, J, C, t = _linear(hand, t_eye, B, offset, h)
    WJ = np.linalg.solve(C, J)
    H = np.einsum("nki,nkj->nij", J, WJ)
    whole = H.sum(axis=0)
    pulls = np.einsum("nki,nk->ni", WJ, e)
    whitened = (np.linalg.inv(np.linalg.cholesky(C)) @ e[..., None])[..., 0]
    length = int(np.clip(2 * _correlation_length(whitened), 1, max(len(e) // MIN_BLOCKS, 1)))
    blocks = np.array_split(np.arange(len(e)), max(len(e) // length, 2))
    rests = whole - np.array([H[block].sum(axis=0) for block in blocks])
    _require_two_blocks(whole, rests, [(t[block[0]], t[block[-1]]) for block in blocks])
    moved = np.linalg.solve(rests, np.array([pulls[block].sum(axis=0) for block in blocks])[..., None])[..., 0]
    robust = moved.T @ moved * (len(blocks) - 1) / len(blocks)
    # Few blocks can scatter less than single poses would by chance: never claim more than independent poses allow.
    plain = np.linalg.inv(whole)
    grow = np.sqrt(np.maximum(np.diag(plain) / np.diag(robust), 1.0))
    return np.asarray(robust * np.outer(grow, grow))


def _require_two_blocks(whole: Array, rests: Array, spans: list[tuple[float, float]]) -> None:
    """Reject streams of which one block alone determines a direction.

    Args:
        whole: (13, 13) information of all blocks.
        rests: (B, 13, 13) that without each.
        spans: first and last time of each block, s.
    """
    advice = "rotate about two axes, at changing speed, several times over the recording"
    unit = 1 / np.sqrt(np.maximum(np.diag(whole), 1e-300))  # m, rad and s side by side
    values, vectors = np.linalg.eigh(unit[:, None] * whole * unit)
    if values[0] < np.finfo(float).eps * len(values) * values[-1]:
        raise CalibrationError(f"these motions do not distinguish the time offset from the mounting: {advice}")
    white = unit[:, None] * vectors / np.sqrt(values)  # makes the whole the unit matrix
    left = np.linalg.eigvalsh(white.T @ rests @ white)[:, 0]
    if left.min() < MIN_LEFT:
        first, last = spans[int(np.argmin(left))]
        raise CalibrationError(
            f"only the poses from {first:.2f} s to {last:.2f} s (eye's clock) determine one direction of the mounting, "
            f"and nothing says how well: {advice}"
        )


def _correlation_length(e: Array) -> float:
    """Return over how many poses residuals (N, M) hang together: one and twice the sum of their autocorrelation."""
    centred = e - e.mean(axis=0)
    power = float((centred**2).mean())
    total = 1.0
    for lag in range(1, len(e) // 4):
        r = float((centred[lag:] * centred[:-lag]).mean()) / max(power, 1e-300)
        if r < 0.05:
            break
        total += 2 * r
    return total
