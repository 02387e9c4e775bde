"""Distances between a point of the tool and fixed anchors: draw-wire, bar, laser, ultrasonic or ultra-wideband range.

A channel is an anchor: z = scale |p - a| + offset, m. Parameters: the tool's point, then each anchor's position, offset and
scale. Anchors nearly in one plane leave their mirror image open.

Path of a point by ranges to anchors, as ultra-wideband gives them: biased for seconds, now and then far too long.

In: ranges, each at its own time. Out: the point's path with covariance. A range reads too long or short by a bias of each
anchor and one of all, which fade within seconds (Gauss and Markov), is noisy, and has tails, longer ones to the far side,
where a wall or a body stands between. How large these are is given, as the greatest likelihood takes slow biases for
motion. An iterated extended Kalman smoother (Bell, SIAM J. Optimization 4, 1994), with weights of Student's distribution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.rotation import skew
from armsight.loop.references.reference import ExpectedReading, Reading, Reference, ToolMotion

EACH = ("x_m", "y_m", "z_m", "offset_m", "scale")  # parameters of an anchor
#: One sigma before a calibration: the tool's point, an anchor and its offset, m; scale. Half, double: nothing.
_POINT_M, _ANCHOR_M, _OFFSET_M, _SCALE = 0.2, 3.0, 1.0, 0.02
#: Positions whose extents, least over greatest, are below this are in a plane; half: 10 mm of a sweep pass for a space.
_SPANS = 0.02
#: A value is frozen that should change by so much, m; half: a coarse step is one, double: short ones are blunders.
STILL_M = 0.2
#: Singular values below this share of the greatest are noise; half, double: nothing.
_LEAST = 1e-4
#: No range is longer, m; half, double: wires of 50 or 200 mm, given in mm, are found by a sweep alone.
MOST_M = 100.0
#: Readings change by so many times the tool's travel where their unit is wrong; half: tools with long levers are, too.
_TRAVELS = 5.0
#: The closed form is fitted so often to readings off by at most so many times the median; half: blunders stay, double:
#: nothing. It leaves still values out where so many others are; half: 18 unknowns are open, double: nothing.
_ROUNDS, _BLUNDER, _ENOUGH = 5, 6.0, 40


@dataclass(frozen=True, eq=False, kw_only=True)
class Distance(Reference):
    """A ranging sensor with its anchors."""

    anchors: Array  #: (A, 3) their positions in the base, m
    p_tool: Array  #: (3,) the point that is measured, tool, m
    offset: Array  #: (A,) what each range reads beyond the scaled distance, m
    scale: Array  #: (A,) of each range, 1 where it is right
    names: tuple[str, ...] = ()

    @staticmethod
    def of(name: str) -> Distance:
        """Return one with one anchor, of which nothing is known."""
        cov = np.diag(np.repeat([_POINT_M, _ANCHOR_M, _OFFSET_M, _SCALE], [3, 3, 1, 1]) ** 2)
        zeros = np.zeros((3, 3))
        where = Distance(name=name, cov=cov, anchors=zeros[:1], p_tool=zeros[0], offset=zeros[0, :1], scale=np.ones(1))
        return replace(where, names=("range",), sigma_delay_s=0.02)

    def begun(self, readings: Sequence[Reading], motion: Callable[[float], ToolMotion]) -> Self:
        """Return one of one anchor with that near the truth, in closed form, for ``calibrate``.

        With an offset b and the tool's point c squares z^2 - |p|^2 = 2 b z - 2 a p + 2 c R^T p - 2 a R c + const are linear
        in a, b, c, the products of a and c, and the rest; the sigmas of a, b and c before a calibration bound them.

        Raises:
            InputError: positions in a plane; a range that is in another unit, stands still or falls as it grows.
        """
        t_s, z = np.array([each.t_s for each in readings]), np.array([each.z[0] for each in readings])
        T = np.array([motion(t - self.delay_s).T_base_tool for t in t_s])
        R, p = T[:, :3, :3], T[:, :3, 3]
        low, high = np.quantile(z, [0.05, 0.95])
        if high - low > _TRAVELS * (travel := float(np.linalg.norm(np.ptp(p, axis=0)))) + 2 * _POINT_M:
            said = f"its readings change by {high - low:.3g} while the tool moves by {travel:.2g} m"
            raise InputError(f"{self.name}: {said}: give m, not mm")
        spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
        if spread[-1] < _SPANS * spread[0]:
            raise InputError(
                f"{self.name}: the tool moves in a plane, whose mirror image fits as well: move it across, too"
            )
        spells = np.split(np.arange(len(z)), np.flatnonzero(np.abs(np.diff(z)) > 1e-9) + 1)
        spells = [rows for rows in spells if np.linalg.norm(np.ptp(p[rows], axis=0)) > STILL_M]
        use = np.abs(z - np.median(z)) < travel + 4 * _POINT_M  # no point of the tool moves by more
        few = use.copy()
        few[np.concatenate([*spells, np.empty(0, int)])] = False
        use = few if few.sum() > _ENOUGH else use
        for _ in range(_ROUNDS):
            c, a = _closed_form(R[use], p[use], z[use])
            x = p + R @ c
            far, across = (np.linalg.norm(x - each, axis=1) for each in (a, 2 * x[use].mean(axis=0) - a))
            # Far away, where spheres are nearly planes, what falls from an anchor rises from its mirror image.
            rises, mirrored, falls = (each - np.median(each[use]) for each in (z - far, z - across, z + far))
            off = min(rises, mirrored, falls, key=lambda each: float(np.median(np.abs(each[use]))))
            use = np.abs(off) <= _BLUNDER * np.median(np.abs(off[use]))
        wrong, right, other = (np.median(np.abs(each[use])) for each in (falls, rises, mirrored))
        if wrong < min(right, other) / 2:
            raise InputError(f"{self.name}: its readings fall as the tool moves away: give their negative")
        if other < right:
            a, far = 2 * x[use].mean(axis=0) - a, across
        for rows in spells:
            if np.ptp(far[rows]) > STILL_M:
                still = f"its value stands still from {t_s[rows[0]]:.2f} to {t_s[rows[-1]]:.2f} s, while the range"
                moves = f"changes by {np.ptp(far[rows]):.2g} m: is the sensor alive, the wire fast?"
                raise InputError(f"{self.name}: {still} {moves}")
        return replace(self, anchors=a[None], p_tool=c, offset=np.array([np.median((z - far)[use])]))

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the anchors."""
        return self.names or tuple(str(k + 1) for k in range(len(self.anchors)))

    @property
    def parameters(self) -> dict[str, float]:
        """Tool point, then each anchor's position, offset and scale."""
        out = {f"tool_{axis}_m": float(v) for axis, v in zip("xyz", self.p_tool, strict=True)}
        for name, a, b, s in zip(self.channels, self.anchors, self.offset, self.scale, strict=True):
            out |= {f"{name}_{key}": float(v) for key, v in zip(EACH, (*a, b, s), strict=True)}
        return out

    def expected(self, motion: ToolMotion, channel: int) -> ExpectedReading:
        """Return the range to an anchor."""
        T = motion.T_base_tool
        apart = T[:3, 3] + T[:3, :3] @ self.p_tool - self.anchors[channel]
        far = float(np.linalg.norm(apart))
        u, scale = apart / far, self.scale[channel]
        in_tool = scale * u @ T[:3, :3]
        by, first = np.zeros(len(self.cov)), 3 + len(EACH) * channel
        by[:3], by[first : first + len(EACH)] = in_tool, [*(-scale * u), 1.0, far]
        by_tool = np.concatenate([in_tool, -in_tool @ skew(self.p_tool)])
        return ExpectedReading(np.array([scale * far + self.offset[channel]]), by_tool[None], by[None])

    def moved(self, step: Array) -> Self:
        """Return it with its parameters moved."""
        p, (x, y, z, b, s) = self.p_tool + step[:3], step[3:].reshape(-1, len(EACH)).T
        anchors = self.anchors + np.column_stack([x, y, z])
        return replace(self, p_tool=p, anchors=anchors, offset=self.offset + b, scale=self.scale + s)


def _closed_form(R: Array, p: Array, z: Array) -> tuple[Array, Array]:
    """Return the tool's point (3,) and the anchor (3,) of ranges (N,), whatever their sign, m."""
    by = [-2.0 * p, 2.0 * np.einsum("nij,ni->nj", R, p), 2.0 * z[:, None], -2.0 * R.reshape(-1, 9)]
    linear = np.column_stack([*by, np.ones(len(z))])
    size = np.repeat([_ANCHOR_M, _POINT_M, _OFFSET_M, _ANCHOR_M * _POINT_M, _ANCHOR_M**2], [3, 3, 1, 9, 1])
    found = size * np.linalg.lstsq(linear * size, z**2 - (p**2).sum(axis=1), rcond=_LEAST)[0]
    return found[3:6], found[:3]


#: Sigmas beyond which a range loses weight, too long and too short; half: good ranges lose theirs.
LONG, SHORT = 2.0, 4.0
PASSES = 3  # of the smoother; half: the first linearisation stays
START_M, START_M_S = 5.0, 1.0  # sigma of the first position and velocity; half, double: nothing after some seconds


class RangeNoise(NamedTuple):
    """How ranges and the body are off."""

    range_m: float = 0.1  #: white noise of a range, m
    bias_m: float = 0.1  #: of a bias of each anchor, m
    fade_s: float = 20.0  #: in which a bias fades, s
    acceleration: float = 0.7  #: density of the body's acceleration, m/s2 per root of Hz
    upright: float = 0.1  #: acceleration along z over that in the plane; 1 for what flies
    common_m: float = 0.1  #: of a bias that all share, m


class RangePath(NamedTuple):
    """A path: at the time of each range, position (N, 3), m, and its covariance (N, 3, 3)."""

    p: Array
    cov: Array


def follow_ranges(
    anchors: Distance, t_s: Array, channel: NDArray[np.int64], z: Array, start: Array, noise: RangeNoise | None = None
) -> RangePath:
    """Follow a point by ranges.

    Args:
        anchors: where they are, with offset and scale.
        t_s: (N,) times, s, rising.
        channel: (N,) the anchor of each range.
        z: (N,) ranges, m.
        start: (3,) about where it begins, m.
        noise: of the sensor and the body; None: ultra-wideband on something that drives.
    """
    noise, n = noise or RangeNoise(), 7 + len(anchors.anchors)
    steps = [_transition(float(dt), n, noise) for dt in np.diff(t_s, prepend=t_s[0])]
    sigma = np.repeat([START_M, START_M_S, noise.bias_m, noise.common_m], [3, 3, n - 7, 1])
    path = np.zeros((0, n))
    for _ in range(PASSES):
        now, ahead, found = (np.append(start, np.zeros(n - 3)), np.diag(sigma**2)), [], []
        for k, ((F, Q), c, read) in enumerate(zip(steps, channel, z, strict=True)):
            x, P = F @ now[0], F @ now[1] @ F.T + Q
            ahead.append((x, P))
            at = path[k] if len(path) else x  # linearised where the pass before found it
            apart = at[:3] - anchors.anchors[c]
            far, H = float(np.linalg.norm(apart)), np.zeros(n)
            H[:3], H[[6 + c, -1]] = anchors.scale[c] * apart / far, 1.0
            left = read - anchors.scale[c] * far - anchors.offset[c] - at[6 + c] - at[-1]
            e, known = left - H @ (x - at), float(H @ P @ H)
            size = noise.range_m if len(path) else np.sqrt(known + noise.range_m**2)
            R = noise.range_m**2 * (1.0 + (left / ((LONG if left > 0.0 else SHORT) * size)) ** 2)
            gain = P @ H / (known + R)
            now = x + gain * e, P - np.outer(gain, H @ P)
            found.append(now)
        for k in range(len(found) - 2, -1, -1):  # all ranges (Rauch, Tung and Striebel, AIAA J. 3, 1965)
            (x, P), (x_ahead, P_ahead), (x_after, P_after) = found[k], ahead[k + 1], found[k + 1]
            gain = np.linalg.solve(P_ahead, steps[k + 1][0] @ P).T
            found[k] = x + gain @ (x_after - x_ahead), P + gain @ (P_after - P_ahead) @ gain.T
        path = np.array([x for x, _ in found])
    return RangePath(path[:, :3], np.array([P[:3, :3] for _, P in found]))


def _transition(dt: float, n: int, noise: RangeNoise) -> tuple[Array, Array]:
    """Return what a time, s, keeps of position, velocity and biases, and what it adds to their covariance (n, n)."""
    F, Q, i, b = np.eye(n), np.zeros((n, n)), np.arange(3), np.arange(6, n)
    q = noise.acceleration**2 * np.array([1.0, 1.0, noise.upright**2])
    F[i, i + 3], F[b, b] = dt, np.exp(-dt / noise.fade_s)
    Q[i, i], Q[i, i + 3], Q[i + 3, i], Q[i + 3, i + 3] = q * dt**3 / 3, q * dt**2 / 2, q * dt**2 / 2, q * dt
    Q[b, b] = np.append(np.full(n - 7, noise.bias_m), noise.common_m) ** 2 * (1 - F[b, b] ** 2)
    return F, Q
