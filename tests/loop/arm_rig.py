"""A test rig for the loop: an arm with known errors, its potentiometers, and cameras that see it late.

Nothing here computes with the code under test: the true arm is a product of 4x4 matrices by the convention's definition,
small motions are scipy's matrix exponential, backlash is its operator stepped at 1 kHz, measured poses are built from
true ones and carried to the tool with adjoints written out here. Of the package it takes records (Mounting, Track, ...),
the numbers of the arm's table and those of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from armsight.data import JointStates, PoseEstimate
from armsight.loop.estimators import Mounting, PoseMeasurement, Prior, Track
from armsight.robot.models import MODELS

ARM = MODELS["six_r"]
TICK_S = 1e-3
#: The middle of the test rig's workspace: the arm bent forwards, no singularity near.
MIDDLE = np.radians([10, -100, 100, -20, -70, 5])
#: What one shot's noise and a rig's calibration are at 0.8 m: m and rad.
SHOT = np.repeat([1e-4, np.radians(0.04)], 3)
MOUNT = np.repeat([4e-5, np.radians(0.003)], 3)


def small(xi):
    """The motion of a tangent [translation; rotation], by the matrix exponential."""
    x, y, z, a, b, c = xi
    return expm(np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0.0]]))


def link_motions(theta):
    """The six rows of the table, (6, N, 4, 4), at angles (N, 6)."""
    c, s = np.cos(theta).T, np.sin(theta).T
    a, d, ca, sa = (each[:, None] for each in (ARM.a, ARM.d, np.cos(ARM.alpha), np.sin(ARM.alpha)))
    T = np.zeros((*c.shape, 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2], T[..., 0, 3] = c, -s * ca, s * sa, a * c
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2], T[..., 1, 3] = s, c * ca, -c * sa, a * s
    T[..., 2, 1], T[..., 2, 2], T[..., 2, 3], T[..., 3, 3] = sa, ca, d, 1.0
    return T


def product(q, smalls):
    """The tool's poses (N, 4, 4) at true joint angles (N, 6), with a small motion of each of seven frames."""
    T = np.broadcast_to(smalls[0], (len(q), 4, 4))
    for moved, fixed in zip(link_motions(ARM.direction * q + ARM.offset), smalls[1:], strict=True):
        T = T @ moved @ fixed
    return T


def loads(q):
    """Gravity torques (N, 6) of unit loads: the mean of the frames beyond each joint, seen from it."""
    frames = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
    for moved in link_motions(q):
        frames.append(frames[-1] @ moved)
    at = np.array([T[:, :3, 3] for T in frames])
    out = np.empty((len(q), 6))
    for i in range(6):
        (x, y, _), axis = (at[i + 1 :].mean(axis=0) - at[i]).T, frames[i][:, :3, 2]
        out[:, i] = axis[:, 1] * x - axis[:, 0] * y  # axis . (lever x (0, 0, -1))
    return out


@dataclass
class TrueArm:
    """An arm that differs from its table, and remembers on which side of its gears it stands."""

    smalls: list = field(default_factory=lambda: [np.eye(4)] * 7)
    linearity: object = lambda q: 0.0 * q
    backlash: np.ndarray = field(default_factory=lambda: np.zeros(6))
    compliance: np.ndarray = field(default_factory=lambda: np.zeros(6))
    rest: object = lambda travel: 0.0 * travel
    loose: object = lambda travel: np.zeros((len(travel), 6))
    held: np.ndarray | None = None
    travelled: np.ndarray = field(default_factory=lambda: np.zeros(6))
    last: np.ndarray | None = None

    def tool(self, shaft):
        """The true poses (N, 4, 4) of the tool as the potentiometers' shafts move over (N, 6), one after the other."""
        half = self.backlash / 2
        if self.held is None:
            self.held, self.last = shaft[0].copy(), shaft[0]
        beyond = np.empty_like(shaft)
        for n, q in enumerate(shaft):
            self.held = np.minimum(np.maximum(self.held, q - half), q + half)
            beyond[n] = self.held - q
        travel = self.travelled + np.cumsum(np.abs(np.diff(shaft, axis=0, prepend=self.last[None])), axis=0)
        self.travelled, self.last = travel[-1], shaft[-1]
        q = shaft + self.linearity(shaft) + beyond + self.compliance * loads(shaft) + self.rest(travel)
        loose = self.loose(travel.sum(axis=1))
        moved = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        moved[:, :3, :3] = Rotation.from_rotvec(loose[:, 3:]).as_matrix()
        moved[:, :3, 3] = loose[:, :3]
        return product(q, self.smalls) @ moved


class Wander:
    """An Ornstein-Uhlenbeck path over travel, sampled on a fine grid beforehand."""

    def __init__(self, rng, sigma, length, width, step=2e-3, most=80.0):
        n = int(most / step)
        keep = np.exp(-step / length)
        samples = rng.normal(size=(n, width))
        samples[1:] *= np.sqrt(1 - keep**2)
        self._grid, self._paths = np.arange(n) * step, lfilter([1.0], [1.0, -keep], samples, axis=0) * sigma

    def joints(self, travel):
        return np.stack(
            [np.interp(travel[:, i], self._grid, self._paths[:, i]) for i in range(travel.shape[1])], axis=1
        )

    def pose(self, travel):
        return np.stack([np.interp(travel, self._grid, path) for path in self._paths.T], axis=1)


def sampled(rng, prior=None):
    """An arm whose errors are sampled from a prior, in its own model."""
    p = prior or Prior()
    stand, link = np.repeat([p.stand_m, p.stand_rad], 3), np.repeat([p.link_m, p.link_rad], 3)
    smalls = []
    for i in range(7):
        xi = rng.normal(size=6) * link
        if i in (0, 6):
            xi += rng.normal(size=6) * stand
        if i < 6:
            xi[5] += rng.normal() * p.zero_rad
        smalls.append(small(xi))
    gain = rng.normal(size=6) * p.gain
    s, c = (rng.normal(size=(3, 6)) * p.harmonic_rad for _ in "sc")
    harmonic = np.arange(1, 4)[:, None, None]

    def linearity(q):
        waves = s[:, None] * np.sin(harmonic * q) + c[:, None] * np.cos(harmonic * q)
        return gain * q + (waves / harmonic**1.5).sum(axis=0)

    rest = Wander(rng, p.rest_rad, p.rest_travel_rad, 6)
    loose = Wander(rng, np.repeat([p.pose_m, p.pose_rad], 3), p.pose_travel_rad, 6)
    return TrueArm(
        smalls,
        linearity,
        np.abs(rng.normal(size=6) * p.backlash_rad),
        rng.normal(size=6) * p.compliance,
        rest.joints,
        loose.pose,
    )


def worn(rng):
    """An arm as the issue of the workcell describes it, its potentiometers bowed, in another model than the prior's."""
    smalls = [small(np.repeat([1e-3, np.radians(0.3)], 3) * rng.uniform(-1, 1, 6)) for _ in range(7)]
    zeros = np.radians(0.5) * rng.choice([-1, 1], 6) * rng.uniform(0.5, 1, 6)
    bow, phase = np.radians(0.25) * rng.uniform(0.5, 1, 6), rng.uniform(-np.pi, np.pi, 6)

    def linearity(q):
        return zeros + bow * np.tanh(1.5 * np.sin(1.1 * q + phase))

    width = np.radians(rng.uniform(0.1, 0.3, 6))
    return TrueArm(smalls, linearity, width, rng.uniform(0, 1, 6) * [0, 8e-3, 8e-3, 4e-3, 4e-3, 0])


def legs(rng, seconds, speed_m_s=0.5, spread_deg=25.0, pause_s=0.25):
    """Shaft angles (N, 6) at 1 kHz: from rest to rest between poses around the middle, tool at most so fast."""
    out, at = [np.repeat(MIDDLE[None], 300, axis=0)], MIDDLE
    while sum(map(len, out)) < seconds / TICK_S:
        to = MIDDLE + np.radians(spread_deg) * rng.uniform(-1, 1, 6)
        ends = product(np.linspace(at, to, 21), [np.eye(4)] * 7)[:, :3, 3]
        way = max(np.linalg.norm(np.diff(ends, axis=0), axis=1).max() * 20, 0.05)
        u = np.linspace(0, 1, int(1.875 * way / speed_m_s / TICK_S) + 2)[1:, None]
        out += [at + (to - at) * (10 * u**3 - 15 * u**4 + 6 * u**5), np.repeat(to[None], int(pause_s / TICK_S), axis=0)]
        at = to
    return np.concatenate(out)[: int(seconds / TICK_S)]


def mounts(rng, sigma=MOUNT):
    """Cameras beside the arm and a body on its tool: what is true, and what a hand-eye calibration says with covariance."""
    true = (
        small(np.array([1.1, -0.2, 0.5, 0.0, 0, 0])) @ small(np.array([0, 0, 0, -1.2, 1.2, -1.2])),
        small(np.array([0.01, 0.02, 0.05, 0.3, -0.2, 0.1])),
    )
    cov = np.diag(np.tile(sigma, 2) ** 2)
    said = [T @ small(rng.normal(size=6) * sigma) for T in true]
    return true, Mounting(said[0], said[1], cov)


def seen(rng, T_base_tool, true, sigma=SHOT):
    """What vision says of a true pose of the tool: a PoseEstimate with noise, nothing of the rig's calibration."""
    T = np.linalg.inv(true[0]) @ T_base_tool @ true[1] @ small(rng.normal(size=6) * sigma)
    cov = np.diag(sigma**2)
    return PoseEstimate(T, cov, cov, 0.0, 0.0, 1.0, None)


def adjoint_of(T):
    """The matrix (6, 6) of T exp(xi) T^-1 = exp(Ad xi), for tangents [translation; rotation]."""
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    return np.block([[R, np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R], [np.zeros((3, 3)), R]])


def measured(mounting, pose, t_s):
    """What a mounting makes of a measured body: the tool's pose, and covariances to first order.

    With Z exp(z) X exp(b) (B exp(x))^-1 = Z X B^-1 exp(Ad(B) (Ad(X^-1) z + b - x)).
    """
    Z, B, X = mounting.T_base_rig, mounting.T_tool_body, pose.T_left_body
    A, D = adjoint_of(B), np.hstack([adjoint_of(np.linalg.inv(X)), -np.eye(6)])
    common = pose.cov - pose.cov_noise + D @ mounting.cov @ D.T
    return PoseMeasurement(t_s, Z @ X @ np.linalg.inv(B), A @ pose.cov_noise @ A.T, A @ common @ A.T)


def states(t, q):
    return JointStates(np.asarray(t), np.asarray(q))


def off(T, T_true):
    """Right tangents (..., 6) from estimates to the truth, to first order."""
    D = np.linalg.inv(T) @ T_true
    rotation = Rotation.from_matrix(D[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*D.shape[:-2], 3)
    return np.concatenate([D[..., :3, 3], rotation], axis=-1)


def distance_mm(T, T_true):
    """Distances (...,) between the origins of poses, mm."""
    return 1e3 * np.linalg.norm(T[..., :3, 3] - T_true[..., :3, 3], axis=-1)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def run(rng, estimator, arm, shaft, *, rate_hz=60.0, late_s=0.0, jitter_s=0.0, blind=(), mount=None, arrives_s=0.04):
    """Give a motion to an estimator as it would come in time; return its track at 1 kHz and the true poses (N, 4, 4).

    Args:
        late_s: by how much the camera's stamps are late.
        blind: pairs of times between which vision sees nothing, s.
        arrives_s: how long after its exposure a measurement comes.
    """
    t = np.arange(len(shaft)) * TICK_S
    Ts = arm.tool(shaft)
    q = shaft + rng.normal(size=shaft.shape) * Prior().reading_rad
    true, mounting = mounts(rng) if mount is None else mount
    shots = np.arange(0.02, t[-1] - 0.001, 1 / rate_hz) + rng.uniform(0, 1e-3)
    shots = [s for s in shots if not any(a <= s <= b for a, b in blind)]
    events = []
    for s in shots:
        real = s + rng.normal() * jitter_s
        k = min(int(real / TICK_S), len(t) - 2)
        u = real / TICK_S - k
        step = np.linalg.inv(Ts[k]) @ Ts[k + 1]
        between = Ts[k] @ small(u * off(np.eye(4), step))
        events.append((s + arrives_s, measured(mounting, seen(rng, between, true), s + late_s)))
    tracks, done = [], 0
    chunk = 16
    for begin in range(0, len(t), chunk):
        estimator.joints(states(t[begin : begin + chunk], q[begin : begin + chunk]))
        now = t[min(begin + chunk, len(t)) - 1]
        while done < len(events) and events[done][0] <= now:
            estimator.vision(events[done][1])
            done += 1
        tracks.append(estimator.track(t[begin : begin + chunk]))
    parts = [
        [getattr(track, name) for track in tracks] for name in ("t_s", "Ts_base_tool", "covs", "covs_own", "q", "qd")
    ]
    ages = np.concatenate([track.vision_age_s for track in tracks])
    return Track(*(np.concatenate(part) for part in parts), ages), Ts


class Workcell:
    """A closed loop: joints that lag behind their commands, potentiometers, cameras; time goes on in steps of 1 ms."""

    def __init__(self, rng, arm, estimator, *, rate_hz=60.0, delay_s=0.045, response_s=0.05, q=MIDDLE, mount=None):
        self.rng, self.arm, self.estimator = rng, arm, estimator
        self.true, self.mounting = mounts(rng) if mount is None else mount
        self.rate_hz, self.delay_s, self.response_s = rate_hz, delay_s, response_s
        self.shaft = np.array(q, float)
        self.tick, self.next_shot_s, self.blind = 0, 0.01, False
        self.coming, self.reference = [], self.shaft

    @property
    def t_s(self):
        return self.tick * TICK_S

    def advance(self, command, ticks):
        """Let the joints follow a command; returns the true poses (ticks, 4, 4)."""
        start = self.reference
        shafts = np.empty((ticks, 6))
        for n in range(ticks):
            share = (n + 1) / ticks
            reference = self.shaft if command is None else start + share * (command.q_ref - start)
            speed = 0.0 if command is None else (command.q_ref - start) / (ticks * TICK_S)
            self.shaft = self.shaft + TICK_S * (speed + (reference - self.shaft) / self.response_s)
            shafts[n] = self.shaft
        self.reference = self.shaft if command is None else command.q_ref
        Ts = self.arm.tool(shafts)
        for n in range(ticks):
            self.tick += 1
            if self.t_s >= self.next_shot_s:
                self.next_shot_s += 1 / self.rate_hz
                if not self.blind:
                    pose = seen(self.rng, Ts[n], self.true)
                    self.coming.append((self.t_s + self.delay_s, measured(self.mounting, pose, self.t_s)))
        t = (self.tick - ticks + 1 + np.arange(ticks)) * TICK_S
        self.estimator.joints(states(t, shafts + self.rng.normal(size=shafts.shape) * Prior().reading_rad))
        while self.coming and self.coming[0][0] <= self.t_s:
            self.estimator.vision(self.coming.pop(0)[1])
        return Ts
