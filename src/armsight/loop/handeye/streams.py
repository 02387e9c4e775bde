"""Hand-eye calibration of two streams of poses whose clocks differ by an unknown amount.

In: times and poses of the flange, times and poses of the measured body. Out: :class:`HandEyeStreams` with the offset
and its sigma. The offset is found first from the two angular speeds, which no mounting changes (correlation over all
offsets that leave an overlap), then fitted together with both transforms. Poses of a stream are not independent: errors
that neighbours share are weighed, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, log_se3
from armsight.geometry.rotation import log_so3
from armsight.loop.handeye.handeye import HandEye, calibrate_poses
from armsight.loop.handeye.poses import Eye, Poses, is_in_hand
from armsight.vision.sources.bag.states import PoseTrack

MAX_POSES = 600  # poses used at most for the fit, spread evenly: a stream's neighbours say the same
GAP_S = 0.25  # a gap in the flange's stream longer than this, s, is not interpolated over
MIN_SPEED_RAD_S = 0.02  # rotation slower than this, rad/s, does not determine the time offset
SPEED_S = 0.02  # over this time the speed of the flange is measured, s
#: Steps between poses over which angular speeds are taken, and how much faster than the slower stream is a blunder.
OVER, FASTER = (4, 12, 36), 1.3


@dataclass(frozen=True, eq=False)
class PoseStream(Record):
    """Poses over time."""

    t_s: Array  #: (N,) strictly increasing times, s, on the stream's own clock
    Ts: Array  #: (N, 4, 4) poses

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
        return PoseTrack(self.t_s, self.Ts).at(t_s), good

    def angular_speed(self, t_s: Array, over_s: float) -> tuple[Array, NDArray[np.bool_]]:
        """Return angular speeds (M,), rad/s, about times, and whether the stream covers them."""
        (early, first), (late, last) = self.at(t_s - over_s / 2), self.at(t_s + over_s / 2)
        rotated = log_so3(np.swapaxes(early[:, :3, :3], 1, 2) @ late[:, :3, :3])
        return np.asarray(np.linalg.norm(rotated, axis=1) / over_s), first & last


@dataclass(frozen=True, eq=False)
class HandEyeStreams(Record):
    """A hand-eye calibration of two streams."""

    handeye: HandEye  #: the calibration; its rows are those of the eye's poses that were used, in the order of time
    offset_s: float  #: to be added to the eye's times to give the hand's; sigma_offset_s its sigma
    sigma_offset_s: float
    t_s: Array  #: (M,) the eye's times of these rows, s, on the eye's clock
    A: Array  #: (M, 4, 4) the flange at these times
    B: Array  #: (M, 4, 4) the body as seen


def calibrate_streams(
    hand: PoseStream,
    eye_stream: PoseStream,
    *,
    eye: Eye = "to_hand",
    centre: ArrayLike = (0.0, 0.0, 0.0),
    scale: bool = False,
    links_at: Callable[[Array], Array] | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> HandEyeStreams:
    """Find the mounting and the time offset of two streams.

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
    for quick in (True, True, False):
        t_eye, B = eye_stream.t_s[rows], eye_stream.Ts[rows]
        A, good = hand.at(t_eye + offset)
        early, first = hand.at(t_eye + offset - SPEED_S / 2)
        late, last = hand.at(t_eye + offset + SPEED_S / 2)
        good &= first & last
        if good.sum() < 20:
            raise CalibrationError(f"the streams overlap in {int(good.sum())} poses only; 20 and more are needed")
        covs, middle = np.zeros((int(good.sum()), 6, 6)), np.asarray(centre, dtype=float)
        poses = Poses(A[good], B[good], covs, is_in_hand(eye), middle)
        speed = log_se3(inverse(early[good]) @ late[good]) / SPEED_S
        links, t_s = None if links_at is None else links_at(t_eye[good] + offset), t_eye[good]
        found = calibrate_poses(poses, t_s=t_s, speed=speed, links=links, scale=scale, quick=quick, progress=progress)
        offset += found.step_s
    return HandEyeStreams(found, offset, found.sigma_step_s, t_eye[good], poses.A, poses.B)


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
    from scipy.signal import correlate  # takes 25 MB, which the live page does not need

    (t_hand, a, in_a), (t_eye, b, in_b) = (_speeds(stream, step, over) for stream in (hand, eye))
    most = FASTER * min(float(np.quantile(speed, 0.99)) for speed in (a, b))
    a, in_a, b, in_b = np.where(a > most, 0.0, a), in_a * (a <= most), np.where(b > most, 0.0, b), in_b * (b <= most)
    both = correlate(in_a, in_b, method="fft")  # over all lags from 1 - len(b)
    enough = both > 0.3 * both.max()
    # The mean square difference of the speeds, against what they are themselves where they overlap.
    size = correlate(a**2 * in_a, in_b, method="fft") + correlate(in_a, b**2 * in_b, method="fft")
    squares = size - 2 * correlate(a, b, method="fft")
    cost = np.where(enough & (size > 1e-9), squares / np.maximum(size, 1e-12), np.inf)
    lag = int(np.argmin(cost)) - (len(b) - 1)
    return float(cost.min() / np.median(cost[np.isfinite(cost)])), float(t_hand + lag * step - t_eye)
