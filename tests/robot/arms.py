"""The arms that laws are held on: every model, and some odd ones; and slow, obvious kinematics to hold them against."""

from __future__ import annotations

import dataclasses

import numpy as np

from armsight.geometry.pose import exp_se3
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.table import BEND, KIND
from armsight.robot.models import MODELS


def odd(arm, name, seed):
    """The same links between a rotated base and a rotated tool, with joints of the other direction and offsets."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        arm,
        name=name,
        offset=rng.uniform(-1, 1, 6),
        direction=rng.choice([-1.0, 1.0], 6),
        T_base_0=exp_se3(rng.normal(0, 0.5, 6)),
        T_flange_tool=exp_se3(rng.normal(0, 0.2, 6)),
    )


def plain(name, a, d, alpha, **more):
    """An arm with wide limits."""
    return Arm(
        name,
        np.array(a),
        np.array(d),
        np.deg2rad(alpha),
        np.full(len(a), -2 * np.pi),
        np.full(len(a), 2 * np.pi),
        *np.full((3, len(a)), 1.0),
        **more,
    )


#: A spherical wrist by the modified convention, offsets in the table (an industrial arm of 2 m reach).
CRAIG = plain(
    "craig",
    [0, 0.085, 0.640, 0.205, 0, 0],
    [0.487, 0, 0, 0.720, 0, 0.075],
    [0, -90, 0, -90, 90, -90],
    offset=np.deg2rad([0, -90, 0, 0, 0, 180]),
    convention="modified",
)
#: Axes 2, 3 and 4 parallel, pointing to and fro.
TO_AND_FRO = plain(
    "to_and_fro", [0.05, 0.3, 0.25, 0.02, 0, 0.1], [0.2, 0.1, -0.04, 0.1, 0.09, 0.1], [90, 180, 180, -90, 90, 30]
)
#: No structure at all.
GENERAL = plain(
    "general", [0.1, 0.3, 0.1, 0.05, 0.04, 0.03], [0.3, 0.05, 0.1, 0.3, 0.06, 0.1], [80, 25, -70, 75, -65, 0]
)

_RNG = np.random.default_rng(5)
#: A UR5 and a PUMA 560 as an identification would leave them: parameters off by tenths of a millimetre and of a degree.
IDENTIFIED = [
    dataclasses.replace(
        arm,
        name=f"identified_{arm.name}",
        a=arm.a + _RNG.normal(0, 3e-4, 6),
        d=arm.d + _RNG.normal(0, 3e-4, 6),
        alpha=arm.alpha + _RNG.normal(0, 2e-3, 6),
    )
    for arm in (MODELS["ur5"], MODELS["puma560"])
]

#: Arms whose inverse is a closed form.
CLOSED = {name: arm for name, arm in MODELS.items() if arm.joints == 6 and arm.table[KIND]}
EXACT = [
    *CLOSED.values(),
    CRAIG,
    TO_AND_FRO,
    *(odd(MODELS[name], f"odd_{name}", i) for i, name in enumerate(("six_r", "ur10", "puma560"))),
]
ALL = [*EXACT, *IDENTIFIED, GENERAL]
#: Four joints: rotating base, two parallel axes, a wrist across them.
FOUR = plain("four", [0.02, 0.3, 0.25, 0.0], [0.2, 0.03, 0.0, 0.1], [90, 0, 90, 0])
#: A PUMA 560 whose third motor rotates its forearm against the ground: J3' = J3 + J2.
COUPLED = dataclasses.replace(
    MODELS["puma560"], name="coupled", coupling=np.eye(6) + np.eye(6)[2][:, None] * np.eye(6)[1]
)
#: Arms of other than six joints.
OTHERS = [arm for arm in MODELS.values() if arm.joints != 6]


def names(arms):
    return [arm.name for arm in arms]


def _rz(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def _rx(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def _shift(x, z):
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def frames(arm, q):
    """Frame 0, links 1 to n and the tool, as products of 4x4 matrices straight from the convention's definition."""
    out = [arm.T_base_0]
    for i in range(arm.joints):
        joint = _rz(arm.direction[i] * (arm.coupling @ q)[i] + arm.offset[i]) @ _shift(0, arm.d[i])
        side = _shift(arm.a[i], 0) @ _rx(arm.alpha[i])
        out.append(out[-1] @ (joint @ side if arm.convention == "standard" else side @ joint))
    return np.stack([*out, out[-1] @ arm.T_flange_tool])


def forward(arm, q):
    return frames(arm, q)[-1]


def off(T, T_expected):
    """Distance, m, and angle, rad, between poses (..., 4, 4)."""
    far = np.linalg.norm(T[..., :3, 3] - T_expected[..., :3, 3], axis=-1)
    chord = np.linalg.norm(T[..., :3, :3] - T_expected[..., :3, :3], axis=(-2, -1)) / np.sqrt(8)
    return far, 2 * np.arcsin(np.minimum(chord, 1.0))


def apart(q, p):
    """Largest joint difference, whole revolutions aside, of joint angles (..., 6)."""
    return np.abs((q - p + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)


def near_singular(arm, n, rng):
    """Joint angles near one or more of the wrist's, the elbow's and the shoulder's singularities, some exactly there."""
    theta_offset, way = arm._closed[4:36:6], arm._closed[5:36:6]
    theta = rng.uniform(-np.pi, np.pi, (n, 6))
    by = 10.0 ** rng.uniform(-14, -1, (n, 3)) * rng.choice([-1, 1], (n, 3))
    by[rng.random((n, 3)) < 0.1] = 0
    which = rng.integers(1, 8, n)
    half = rng.integers(0, 2, (n, 2)) * np.pi
    theta[:, 4] = np.where(which & 1, half[:, 0] + by[:, 0], theta[:, 4])
    theta[:, 2] = np.where(which & 2, half[:, 1] - arm._closed[BEND] + by[:, 1], theta[:, 2])
    q = (theta - theta_offset) * way
    for k in np.flatnonzero(which & 4):
        q[k, 1] = over_axis1(arm, q[k]) + by[k, 2]
    return (q + np.pi) % (2 * np.pi) - np.pi


def over_axis1(arm, q):
    """Joint 2 such that the wrist comes nearest to axis 1, or as it was where it never does."""

    def ahead(angle):
        L = arm.links(np.where(np.arange(6) == 1, angle, q))
        on_axis1 = L[1 if arm.convention == "modified" else 0]
        return np.cross(L[2][:3, 2], on_axis1[:3, 2]) @ (L[5][:3, 3] - on_axis1[:3, 3])

    # Axis 2 carries the wrist round a circle: c + a cos(q2) + b sin(q2).
    c, (x, y) = (ahead(0.0) + ahead(np.pi)) / 2, (ahead(0.0), ahead(np.pi / 2))
    a, b = x - c, y - c
    return q[1] if abs(c) > np.hypot(a, b) else np.arctan2(b, a) + np.arccos(-c / np.hypot(a, b))
