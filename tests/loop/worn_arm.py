"""A worn arm whose truth is known, and what a stereo rig would see of it: an oracle apart from the code it tests.

Its kinematics are the Arm's own forward kinematics with a true table; joints read by potentiometers that are off by a zero,
a scale and a wave, and that see neither the gears' backlash nor their compliance under point masses at the links' ends.
"""

from dataclasses import dataclass, replace

import numpy as np

from armsight.geometry.pose import exp_se3
from armsight.loop.identify.measured import Measured
from armsight.robot.arm_file import open_arm
from armsight.robot.kinematics.arm import Arm

MASS_KG, GRAVITY = np.array([1.0, 0.6, 0.4, 0.3, 0.2, 0.3, 0.2]), 9.81


@dataclass(frozen=True)
class Worn:
    """The truth: a true table, and what the joints do beside it."""

    nominal: Arm
    true: Arm
    backlash: np.ndarray
    compliance: np.ndarray
    gain: np.ndarray
    waves: np.ndarray
    T_rig_base: np.ndarray
    T_flange_body: np.ndarray

    def joints(self, q, approach):
        """Where the joints really are at readings q (N, 6)."""
        said = q + self.gain * q
        for n in range(self.waves.shape[1]):
            said = said + self.waves[:, n, 0] * np.sin((n + 1) * q) + self.waves[:, n, 1] * np.cos((n + 1) * q)
        return said - 0.5 * self.backlash * approach + self.compliance * self.torque(said)

    def torque(self, q):
        """Gravity torque about every joint, N m, in the sense of its angle."""
        out = np.zeros_like(q)
        for n, angles in enumerate(q):
            T = self.nominal.links(angles)[: len(angles) + 1]
            z, at = T[:-1, :3, 2], T[:, :3, 3]
            lever = at[None, 1:] - at[:-1, None]  # from joint i to the end of link j
            each = GRAVITY * (z[:, None, 1] * lever[..., 0] - z[:, None, 0] * lever[..., 1])  # z . (lever x (0, 0, -g))
            out[n] = np.triu(MASS_KG[: len(angles)] * each).sum(axis=1)
        return out

    def T_rig_body(self, q, approach):
        return self.T_rig_base @ self.true.forward(self.joints(q, approach)) @ self.T_flange_body

    def seen(self, q, approach, rng, sigma_m=5e-5, sigma_rad=3e-4):
        """What the rig sees: poses with covariance, depth three times as uncertain as the sides."""
        T = self.T_rig_body(q, approach)
        R = T[:, :3, :3]
        C = np.zeros((len(q), 6, 6))
        C[:, :3, :3] = R.swapaxes(1, 2) @ np.diag(sigma_m**2 * np.array([1, 1, 9.0])) @ R
        C[:, 3:, 3:] = np.eye(3) * sigma_rad**2
        noise = (np.linalg.cholesky(C) @ rng.normal(size=(len(q), 6, 1)))[..., 0]
        B = T @ exp_se3(noise)
        return Measured(q, B[:, None, :3, 3], B[:, :3, :3], C, approach)


def worn(seed, nominal=None, *, waves=2, backlash=True, compliance=True):
    """Lengths off by about 1 mm, angles by 0.3 deg, zeros by 0.5 deg, backlash 0.1 to 0.3 deg, as the workcell's worn arm.

    Base and tool frames are what the nominal table means: nothing is wrong in d1, joint 1's zero and the last row.
    """
    rng = np.random.default_rng(seed)
    nominal = nominal or open_arm("six_r")
    n = nominal.joints
    free = np.append(np.ones(n - 1), 0.0)
    inner = free * np.append(0.0, np.ones(n - 1))
    true = replace(
        nominal,
        a=nominal.a + rng.normal(0, 1e-3, n) * free,
        d=nominal.d + rng.normal(0, 1e-3, n) * inner,
        alpha=nominal.alpha + rng.normal(0, np.deg2rad(0.3), n) * free,
        offset=nominal.offset + rng.normal(0, np.deg2rad(0.5), n) * inner,
    )
    harmonic = np.arange(1, waves + 1)
    size = np.deg2rad(0.05) / harmonic[None, :, None]
    T_rig_base = exp_se3(np.array([0.1, 0.4, 0.9, 0, 0, 0])) @ exp_se3(np.array([0, 0, 0, *rng.normal(0, 1, 3)]))
    return Worn(
        nominal,
        true,
        rng.uniform(*np.deg2rad([0.1, 0.3]), n) * backlash,
        rng.uniform(0.5, 1.5, n) * np.deg2rad(0.1) / 3.0 * compliance,
        rng.normal(0, 5e-4, n),
        rng.normal(0, 1, (n, waves, 2)) * size if waves else np.zeros((n, 0, 2)),
        T_rig_base,
        exp_se3(np.array([0.02, -0.01, 0.05, 0.1, 0.2, -0.3])),
    )


def poses(arm, n, rng, half=0.9):
    """Readings about home, and directions of approach."""
    q = arm.home + rng.uniform(-half, half, (n, arm.joints))
    return np.clip(q, arm.q_min, arm.q_max), rng.choice([-1.0, 1.0], q.shape)


def distance_m(model, x, truth, q, approach):
    """How far off the model says the body is, in the rig."""
    return np.linalg.norm((model.T_rig_base(x) @ model.tool_in_base(x, q, approach) - truth)[:, :3, 3], axis=1)


def truth_of(w):
    """The true value of each parameter that a worn arm has, by its name."""
    each = {"a": w.true.a, "d": w.true.d, "alpha": w.true.alpha, "offset": w.true.offset}
    each |= {"backlash": w.backlash, "gain": w.gain}
    return {f"{kind}{i + 1}": values[i] for i in range(6) for kind, values in each.items()}
