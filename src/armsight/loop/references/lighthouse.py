"""Angles of Lighthouse 2 beacons: two slanted planes of light on a rotor, seen by photodiodes of the tool.

A sweep's angle is the rotor's, rad, when the plane meets a receiver, zero straight ahead; the beacon looks along +x with z
up. The planes are slanted by +-30 degrees. Seven numbers a plane, which the beacon sends, say how far it is from that:
phase, tilt, curve, gibbous magnitude and phase, ogee magnitude and phase (the model of the maker's software, as libsurvive
has it: github.com/collabora/libsurvive). Each sweep is a reading of its own at its own time.

Path of a free body by readings, each at its own time, together with the parameters of the reference (a bundle).

In: sweeps of beacons, and a pose every now and then to begin with. Out: poses at even times with covariance, and the
reference with parameters and covariance. Between knots the body moves evenly; its acceleration is white noise of the
most probable density. Readings are weighed by Cauchy's function, whose scale falls from round to round: reflections lose
their weight and far starts arrive.
The knots are a band, which is eliminated (Triggs et al., "Bundle adjustment: a modern synthesis", 2000).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.spatial.transform import Rotation, Slerp

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.pose import exp_se3
from armsight.geometry.rotation import exp_so3, log_so3, nearest_rotation, skew
from armsight.loop.references.reference import ExpectedReading, Reference, ToolMotion

SWEEP = ("phase", "tilt", "curve", "gibbous", "gibbous_phase", "ogee", "ogee_phase")  # calibration of a plane
POSE = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")  # a beacon's position, rotation vector
SLANT = np.deg2rad(30.0)  # rad; of the first plane, the second has its negative
#: Series of the curve by the elevation on the plane, highest power first: constants of the maker's model.
_SERIES = (-8.0108022e-06, 0.0028679863, 5.3685255e-06, 0.00760697980, 0.0, 0.0)
STEP = 1e-6  # of differences, m and of the calibration; half, double: nothing
FEWEST = 9  # angles a closed form needs: a position and two directions
PASSES = 4  # of a closed form, each with the calibration at the position before; half: 0.3 mm off, double: nothing
OPEN = 1e-5  # least over largest singular value below which a position is open; half, double: nothing


class Sweeps(NamedTuple):
    """Sweeps that receivers have seen."""

    t_s: Array  #: (N,) when each was seen, s
    receiver: NDArray[np.int64]  #: (N,) from 0
    beacon: NDArray[np.int64]  #: (N,) from 0
    plane: NDArray[np.int64]  #: (N,) 0 or 1
    angle: Array  #: (N,) rad

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sweeps:
        """Return a part of the sweeps."""
        return Sweeps(self.t_s[rows], self.receiver[rows], self.beacon[rows], self.plane[rows], self.angle[rows])


def sweep_angle(p: Array, plane: NDArray[np.int64], calibration: Array) -> Array:
    """Return the angle (N,), rad, at which a plane meets points.

    Args:
        p: (N, 3) points in the beacon, m.
        plane: (N,) 0 or 1.
        calibration: (N, 7) by SWEEP.
    """
    x, y, z = p.T
    phase, tilt, curve, gibbous, gibbous_phase, ogee, ogee_phase = calibration.T
    slant = tilt + np.where(plane == 0, SLANT, -SLANT)
    azimuth, flat = np.arctan2(y, x), np.hypot(x, y)
    behind = np.clip(np.tan(slant) * z / flat, -1.0, 1.0)
    curved = curve + ogee * np.cos(azimuth - np.arcsin(behind) + ogee_phase)
    along = np.arcsin(np.clip(z / np.hypot(flat, z) / np.cos(slant), -1.0, 1.0))
    value, slope = np.full_like(x, _SERIES[0]), np.zeros_like(x)
    for factor in _SERIES[1:]:  # Horner's scheme of the series and its derivative
        slope = slope * along + value
        value = value * along + factor
    bent = behind + value * curved / (np.cos(slant) - slope * curved * np.sin(slant))
    angle = azimuth - np.arcsin(np.clip(bent, -1.0, 1.0))
    return np.asarray(angle + gibbous * np.cos(angle + gibbous_phase) - phase)


@dataclass(frozen=True, eq=False, kw_only=True)
class Lighthouse(Reference):
    """Beacons and the tool's receivers."""

    Ts_base_beacon: Array  #: (B, 4, 4) poses of the beacons, m
    calibration: Array  #: (B, 2, 7) of each plane, by SWEEP
    receivers: Array  #: (S, 3) their positions on the tool, m

    @property
    def channels(self) -> tuple[str, ...]:
        """Beacon, plane and receiver, in this order."""
        B, S = len(self.calibration), len(self.receivers)
        return tuple(f"beacon{b + 1}_plane{k + 1}_receiver{s + 1}" for b in range(B) for k in (0, 1) for s in range(S))

    @property
    def parameters(self) -> dict[str, float]:
        """Pose of each beacon, then calibration of each plane."""
        out: dict[str, float] = {}
        for b, (T, planes) in enumerate(zip(self.Ts_base_beacon, self.calibration, strict=True)):
            out |= {
                f"beacon{b + 1}_{key}": float(v) for key, v in zip(POSE, (*T[:3, 3], *log_so3(T[:3, :3])), strict=True)
            }
            for k, values in enumerate(planes):
                out |= {f"beacon{b + 1}_plane{k + 1}_{key}": float(v) for key, v in zip(SWEEP, values, strict=True)}
        return out

    def expected(self, motion: ToolMotion, channel: int) -> ExpectedReading:
        """Return the angle of a sweep."""
        S = len(self.receivers)
        receiver, beacon, plane = (np.array([k]) for k in (channel % S, channel // (2 * S), channel // S % 2))
        R = motion.T_base_tool[None, :3, :3]
        z, by_p, by_R, by = self.along(
            Sweeps(np.zeros(1), receiver, beacon, plane, np.zeros(1)), motion.T_base_tool[None, :3, 3], R
        )
        return ExpectedReading(z, np.concatenate([by_p @ R[0], by_R], axis=1), by)

    def along(self, sweeps: Sweeps, p: Array, R: Array) -> tuple[Array, Array, Array, Array]:
        """Return what each sweep of a moving tool would read, and its derivatives.

        Args:
            sweeps: which were seen; their angles do not matter.
            p: (N, 3) the tool at each, base, m.
            R: (N, 3, 3) its rotation.

        Returns:
            (N,) angles, rad, and derivatives (N, 3) by the position in the base, (N, 3) by the rotation's right tangent and
            (N, P) by the parameters.
        """
        b, k = sweeps.beacon, sweeps.plane
        r, T = self.receivers[sweeps.receiver], self.Ts_base_beacon[b]
        in_beacon = np.einsum("nji,nj->ni", T[:, :3, :3], p + np.einsum("nij,nj->ni", R, r) - T[:, :3, 3])
        calibration = self.calibration[b, k]
        z = sweep_angle(in_beacon, k, calibration)
        by_point = np.stack([self._slope(in_beacon, k, calibration, STEP * e, 0.0) for e in np.eye(3)], axis=1)
        by_own = np.stack([self._slope(in_beacon, k, calibration, 0.0, STEP * e) for e in np.eye(7)], axis=1)
        by_p = np.einsum("ni,nji->nj", by_point, T[:, :3, :3])
        by_R = -np.einsum("ni,nij->nj", np.einsum("ni,nij->nj", by_p, R), skew(r))
        by = np.zeros((len(z), len(self.calibration), 20))
        rows = np.arange(len(z))
        by[rows, b, :3], by[rows, b, 3:6] = -by_point, np.cross(by_point, in_beacon)
        for c in range(7):
            by[rows, b, 6 + 7 * k + c] = by_own[:, c]
        return z, by_p, by_R, by.reshape(len(z), -1)

    def _slope(self, p: Array, plane: NDArray[np.int64], c: Array, dp: Array | float, dc: Array | float) -> Array:
        ahead, back = sweep_angle(p + dp, plane, c + dc), sweep_angle(p - dp, plane, c - dc)
        return np.asarray((ahead - back) / (2 * STEP))

    def moved(self, step: Array) -> Self:
        """Return it with its parameters moved."""
        each = step.reshape(len(self.calibration), 20)
        Ts = np.stack([T @ exp_se3(v[:6].copy()) for T, v in zip(self.Ts_base_beacon, each, strict=True)])
        return replace(self, Ts_base_beacon=Ts, calibration=self.calibration + each[:, 6:].reshape(-1, 2, 7))

    def pose_of(self, sweeps: Sweeps) -> tuple[Array, Array, float]:
        """Return position (3,) and rotation (3, 3) of a tool with flat receivers, from sweeps while it is nearly at rest.

        Every angle is a plane that the receiver lies in, and planes are linear in the position and two columns of the
        rotation. Also the RMS distance of receivers from their planes, m: large after a motion or a reflection.

        Raises:
            CalibrationError: too few sweeps, or all of one beacon.
        """
        if len(sweeps.angle) < FEWEST or len(np.unique(sweeps.beacon)) < 2:
            raise CalibrationError("a pose in closed form needs nine sweeps of two beacons")
        angle, T = sweeps.angle, self.Ts_base_beacon[sweeps.beacon]
        r = self.receivers[sweeps.receiver]
        M, ideal = np.zeros((3, 3)), np.zeros_like(self.calibration[0, 0])
        for _ in range(PASSES):  # the calibration is that of where it was found before
            slant = np.where(sweeps.plane == 0, SLANT, -SLANT)
            n = np.stack([-np.sin(angle), np.cos(angle), -np.tan(slant)], axis=1)
            n = np.einsum("nij,nj->ni", T[:, :3, :3], n / np.linalg.norm(n, axis=1)[:, None])
            A = np.concatenate([n, n * r[:, :1], n * r[:, 1:2]], axis=1)
            right = np.einsum("ni,ni->n", n, T[:, :3, 3])
            size = np.linalg.norm(A, axis=0)
            s = np.linalg.lstsq(A / size, right, rcond=OPEN)[0] / size
            M = np.column_stack([s[3:6], s[6:], np.cross(s[3:6], s[6:])])
            M = M / np.maximum(np.linalg.norm(M, axis=0), 1e-9)
            p = np.einsum("nji,nj->ni", T[:, :3, :3], s[:3] + r[:, :2] @ s[3:].reshape(2, 3) - T[:, :3, 3])
            angle = sweeps.angle - sweep_angle(p, sweeps.plane, self.calibration[sweeps.beacon, sweeps.plane])
            angle += sweep_angle(p, sweeps.plane, np.broadcast_to(ideal, (len(p), 7)))
        off = A @ s - right
        return s[:3], nearest_rotation(M), float(np.sqrt(np.mean(off**2)))


def triangulated(bearings: Array, Ts: Array, cov: Array) -> tuple[Array, Array]:
    """Return a position (3,) and its covariance (3, 3) from bearings of two and more beacons of known pose, in closed form.

    Args:
        bearings: (B, 3) unit vectors to the point, each in its beacon.
        Ts: (B, 4, 4) poses of the beacons, m.
        cov: (B,) variance of each bearing about either axis across it, rad^2.

    Raises:
        CalibrationError: all bearings are along one line.
    """
    u = np.einsum("bij,bj->bi", Ts[:, :3, :3], bearings)
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    weight = np.ones(len(u))
    for _ in range(2):  # the second time with the distances of the first
        H = (weight[:, None, None] * across).sum(axis=0)
        if np.linalg.cond(H) > 1 / OPEN:
            raise CalibrationError("the beacons and the point are on one line: the distance is open")
        p = np.linalg.solve(H, np.einsum("b,bij,bj->i", weight, across, Ts[:, :3, 3]))
        weight = 1 / (cov * ((p - Ts[:, :3, 3]) ** 2).sum(axis=1))
    return p, np.linalg.inv((weight[:, None, None] * across).sum(axis=0))


SCALES = (0.1, 0.02, 3e-3, 1e-3, 3e-4, 1e-4, 6e-5)  # rad; of Cauchy's function, by rounds; half the count: starts stick
TAILS = 3.0  # sigmas; where a reading begins to lose weight; half: noise is thrown away, double: reflections pull
STEPS = 12  # Levenberg-Marquardt steps of a round; half: slow rounds stop early
SMALL = 1e-4  # relative fall of the cost that ends a round; half, double: nothing
TRUST_M, TRUST_RAD = 0.02, 0.05  # damping of a knot's step at factor 1; half, double: nothing
BEGIN = (10.0, 50.0)  # m/s2, rad/s2; a knot's acceleration before it is found; half, double: nothing
MATCHED = 8  # rounds that find it; half: rests wander, double: slow
PROBES = 16  # random vectors of a trace; half: densities differ by a few percent, double: slow
LEAST_SEEN = 1e-4  # share of the bends that is seen at least; half, double: nothing
REST = 1e-4  # share of BEGIN; no acceleration found is less; half, double: rests of seconds wander less, more
KNOTS = 6  # numbers of a knot
WINDOW_S = 0.02  # s; a revolution: sweeps taken for simultaneous to begin with; half: too few, double: the body moves
MOST_OPEN, FAR_M = 12, 0.02  # sweeps of a window at least, and m that receivers are off their planes at most


@dataclass(frozen=True, eq=False)
class BodyPath(Record):
    """A path."""

    t_s: Array  #: (K,) even times, s
    p: Array  #: (K, 3) positions in the base, m
    R: Array  #: (K, 3, 3) rotations
    reference: Lighthouse  #: with its parameters and their covariance
    sigma_rad: float  #: of a reading
    used: NDArray[np.bool_]  #: (N,) readings that keep half their weight and more
    band: Array  #: lower Cholesky factor of the knots' information, (12 + 6, 6 K)
    border: Array  #: (6 K, P) what the parameters move of the knots

    def covariance(self, knots: NDArray[np.int64]) -> Array:
        """Return the covariance (M, 6, 6) of knots: position in the base, m, and right tangent of the rotation, rad."""
        columns = (KNOTS * knots[:, None] + np.arange(KNOTS)).ravel()
        unit = np.zeros((KNOTS * len(self.t_s), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        inverse = cho_solve_banded((self.band, True), unit)
        shape = (len(knots), KNOTS, len(knots), KNOTS)
        own = inverse[columns].reshape(shape).transpose(0, 2, 1, 3)
        own = own[np.arange(len(knots)), np.arange(len(knots))]
        B = self.border[columns].reshape(len(knots), KNOTS, -1)
        return np.asarray(own + B @ self.reference.cov @ B.swapaxes(1, 2))


def follow(reference: Lighthouse, sweeps: Sweeps, t_s: Array, p: Array, R: Array) -> BodyPath:
    """Fit the path of a body and the parameters of its reference.

    Args:
        reference: where to begin; its ``cov`` says how far its parameters may be off, zero: known.
        sweeps: what was seen.
        t_s: (K,) even times of the knots, all sweeps between the first and the last.
        p: (K, 3) positions to begin at, base, m.
        R: (K, 3, 3) rotations to begin at.

    Raises:
        InputError: fewer than three knots.
    """
    if len(t_s) < 3:
        raise InputError(f"{reference.name}: {len(t_s)} knots were given; a path needs three at least")
    bundle = _Bundle(reference, sweeps, t_s)
    state = (reference, p, R, np.zeros(len(reference.cov)))
    for scale in SCALES:
        state = bundle.rounded(state, scale)
    for _ in range(MATCHED):
        sigma = float(np.median(np.abs(bundle.linear(state)[0])) / 0.6745)
        bundle.match(state, sigma)
        state = bundle.rounded(state, sigma)
    linear = bundle.linear(state)
    band, X, _, H = bundle.eliminated(linear, state[3], sigma)
    cov = np.zeros_like(reference.cov)
    cov[np.ix_(bundle.free, bundle.free)] = np.linalg.inv(H)
    border = np.zeros((len(X), len(cov)))
    border[:, bundle.free] = -X[:, 1:]
    used = np.abs(linear[0]) < TAILS * sigma
    return BodyPath(t_s, state[1], state[2], replace(state[0], cov=cov), sigma, used, band, border)


def beginning(reference: Lighthouse, sweeps: Sweeps, rate_hz: float = 40.0) -> tuple[Array, Array, Array]:
    """Return even times (K,), positions (K, 3) and rotations (K, 3, 3) to begin at, from windows with enough sweeps.

    Between knots the body moves evenly, off by a / (8 rate_hz^2) at an acceleration a, which no region holds: at up to 4, 7
    and 15 m/s2 NEES per number is 4, 9 and 35 at 40 Hz, 0.9, 1.0 and 1.8 at 80 Hz.

    Raises:
        CalibrationError: two beacons are never seen at once.
    """
    order = np.argsort(sweeps.t_s, kind="stable")
    s = sweeps.rows(order)
    windows = np.split(np.arange(len(order)), np.flatnonzero(np.diff(np.floor((s.t_s - s.t_s[0]) / WINDOW_S))) + 1)
    found = []
    for rows in windows:
        part = s.rows(rows)
        if len(rows) >= MOST_OPEN and len(np.unique(2 * part.beacon + part.plane)) >= 4:
            p, R, off = reference.pose_of(part)
            if off < FAR_M:
                found.append((float(part.t_s.mean()), p, R))
    if len(found) < 2:
        raise CalibrationError("two beacons are hardly ever seen at once: rotate the receivers to face both")
    at, p, R = (np.array(each) for each in zip(*found, strict=True))
    t_s = np.arange(s.t_s[0] - 1 / rate_hz, s.t_s[-1] + 2 / rate_hz, 1 / rate_hz)
    rotated = Slerp(at, Rotation.from_matrix(R))(np.clip(t_s, at[0], at[-1])).as_matrix()
    return t_s, np.stack([np.interp(t_s, at, each) for each in p.T], axis=1), rotated


_State = tuple[Lighthouse, Array, Array, Array]
_Linear = tuple[Array, Array, Array, Array]


class _Bundle:
    """Normal equations of a path."""

    def __init__(self, reference: Lighthouse, sweeps: Sweeps, t_s: Array) -> None:
        order = np.argsort(sweeps.t_s, kind="stable")
        self._order = np.argsort(order)
        self._sweeps, self._K, dt = sweeps.rows(order), len(t_s), float(t_s[1] - t_s[0])
        at = (self._sweeps.t_s - t_s[0]) / dt
        self._k = np.clip(at.astype(int), 0, self._K - 2)
        self._a = (at - self._k)[:, None]
        variance = np.diag(reference.cov)
        self.free = np.flatnonzero(variance > 0)
        self._known = 1 / variance[self.free]
        self._smooth = np.repeat(1 / (np.square(BEGIN) * dt**4), 3)
        self._stillest = self._smooth / REST**2

    def linear(self, state: _State) -> _Linear:
        """Return residuals (N,), their derivative (N, 12) by two knots and (N, P) by parameters, and bends (K - 2, 6)."""
        reference, p, R, _ = state
        k, a = self._k, self._a
        rotation = log_so3(R[:-1].swapaxes(1, 2) @ R[1:])
        z, by_p, by_R, by = reference.along(
            self._sweeps, p[k] * (1 - a) + p[k + 1] * a, R[k] @ exp_so3(a * rotation[k])
        )
        J = np.concatenate([by_p * (1 - a), by_R * (1 - a), by_p * a, by_R * a], axis=1)
        bend = np.concatenate([p[:-2] - 2 * p[1:-1] + p[2:], rotation[1:] - rotation[:-1]], axis=1)
        return z - self._sweeps.angle, J, by[:, self.free], bend

    def cost(self, linear: _Linear, at: Array, scale: float) -> float:
        """Return Cauchy's cost of readings, bends and parameters."""
        e, _, _, bend = linear
        lost = TAILS**2 * np.log1p((e / (TAILS * scale)) ** 2)
        return float(lost.sum() + (self._smooth * bend**2).sum() + (self._known * at[self.free] ** 2).sum())

    def rounded(self, state: _State, scale: float) -> _State:
        """Return the best state for one scale."""
        linear, damping = self.linear(state), 1.0
        cost = self.cost(linear, state[3], scale)
        for _ in range(STEPS):
            knots, own = self.step(linear, state[3], scale, damping)
            full = np.zeros(len(state[3]))
            full[self.free] = own
            p, R = state[1] + knots[:, :3], state[2] @ exp_so3(knots[:, 3:].copy())
            near = state[0].moved(full), p, R, state[3] + full
            tried = self.linear(near)
            now = self.cost(tried, near[3], scale)
            if now >= cost:
                damping *= 6
                continue
            gained, state, linear, cost = cost - now, near, tried, now
            damping /= 8
            if gained < SMALL * cost:
                break
        return state

    def _normal(self, linear: _Linear, scale: float) -> tuple[Array, Array, Array]:
        """Return band (18, 6 K), right-hand side (6 K,) and border (6 K, P) of the knots."""
        e, J, own, bend = linear
        weight = np.sqrt(1 / (1 + (e / (TAILS * scale)) ** 2)) / scale
        A = np.concatenate([J, own, e[:, None]], axis=1) * weight[:, None]
        filled, first = np.unique(self._k, return_index=True)
        H = np.zeros((self._K - 1, 12, A.shape[1]))
        H[filled] = np.add.reduceat(A[:, :12, None] * A[:, None, :], first, axis=0)
        n = KNOTS * self._K
        band, right, border = np.zeros((18, n)), np.zeros(n), np.zeros((n, own.shape[1]))
        at = KNOTS * np.arange(self._K - 1)
        for i in range(12):
            right[at + i] += H[:, i, -1]
            border[at + i] += H[:, i, 12:-1]
            for j in range(i + 1):
                band[i - j, at + j] += H[:, i, j]
        at, second = at[:-1], (1.0, -2.0, 1.0)
        for c, smooth in enumerate(self._smooth):
            for u in range(3):
                right[at + KNOTS * u + c] += smooth * second[u] * bend[:, c]
                for v in range(u + 1):
                    band[KNOTS * (u - v), at + KNOTS * v + c] += smooth * second[u] * second[v]
        return band, right, border

    def match(self, state: _State, scale: float) -> None:
        """Set the densities of acceleration to the most probable ones (MacKay, Neural Computation 4, 1992)."""
        linear = self.linear(state)
        factor = self.eliminated(linear, state[3], scale)[0]
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (*linear[3].shape, PROBES))
        for kind in (slice(0, 3), slice(3, 6)):
            right = np.zeros((self._K, KNOTS, PROBES))
            for u, second in enumerate((1.0, -2.0, 1.0)):
                right[u : self._K - 2 + u, kind] += second * signs[:, kind]
            flat = right.reshape(-1, PROBES)
            bends, trace = linear[3][:, kind], np.vdot(flat, cho_solve_banded((factor, True), flat)) / PROBES
            seen = 1.0 - self._smooth[kind][0] * trace / bends.size
            found = np.clip(seen, LEAST_SEEN, 1.0) * bends.size / (bends**2).sum()
            self._smooth[kind] = np.minimum(found, self._stillest[kind])  # a rest's most probable one has no end

    def eliminated(self, linear: _Linear, at: Array, scale: float, damping: float = 0.0) -> tuple[Array, ...]:
        """Return the band's factor, what moves the knots (6 K, 1 + P), and of the parameters gradient and information."""
        e, _, own, _ = linear
        band, right, border = self._normal(linear, scale)
        band[0] += damping * np.tile(np.repeat([TRUST_M**-2.0, TRUST_RAD**-2.0], 3), self._K)
        factor = cholesky_banded(band, lower=True)
        X = cho_solve_banded((factor, True), np.column_stack([right, border]))
        weight = 1 / (1 + (e / (TAILS * scale)) ** 2) / scale**2
        g = own.T @ (weight * e) + self._known * at[self.free] - border.T @ X[:, 0]
        return factor, X, g, (own.T * weight) @ own + np.diag((1 + damping) * self._known) - border.T @ X[:, 1:]

    def step(self, linear: _Linear, at: Array, scale: float, damping: float) -> tuple[Array, Array]:
        """Return the step (K, 6) of the knots and (P,) of the free parameters."""
        _, X, g, H = self.eliminated(linear, at, scale, damping)
        x = -np.linalg.solve(H, g) if len(self.free) else g
        return -(X[:, 0] + X[:, 1:] @ x).reshape(-1, KNOTS), np.asarray(x)
