"""What a joint's true angle may differ by from what its sensor reads: linear in the unknown coefficients.

gain: the sensor's scale. wave, ripple: linearity error of a sensor, sin and cos of its angle and of multiples of it.
backlash: half of it to either side, by the direction of approach: play that friction holds where the joint left it. slack:
the same for play that the weight beyond the joint closes, whichever way it came, save where the lever is so small that
friction is stronger. sag: a compliant gear under the links'
weight; the torque about joint i is the sum over links j >= i of (mass and lever, unknown) times z_i . (L_j x g), with L_j
link j's own vector.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.identify import chain
from armsight.loop.identify.measured import Measured
from armsight.robot.arm import Arm

#: Harmonics of one turn of a joint's sensor: the slow ones that its mounting makes, those of its track and gears, and the
#: fastest: the workcell's potentiometers swing up to nine times over their travel, which may be three quarters of a turn.
WAVES, RIPPLES, FAST = (1, 2), (3, 4, 5, 6, 7, 8), (9, 10, 11, 12)
#: Fewer numbers measured than this are not given ripples at all: their one prior would be told by chance.
ENOUGH = 100
#: With so many measured numbers to a parameter each harmonic and load stands for itself, whatever is known before. The
#: fastest are then left out: chosen one by one, no prior holds them where the arm was not looked at.
PLENTY = 10
#: A bearing's friction holds a link in its play against weight with up to about this lever, m: some per cent of what the
#: links of such arms have, as bearings' friction is of the load. Over half of it the play closes.
FRICTION_M = 2e-3


class Feature(NamedTuple):
    """A cause that moves one joint.

    Attributes:
        name: of the coefficient.
        kind: "gain", "wave", "ripple", "backlash", "slack" or "sag".
        joint: 0 to 5.
        unit: of the coefficient.
        detail: the harmonic with its phase (n, 0 sine or 1 cosine), or the link whose weight sags; (0, 0) elsewhere.
    """

    name: str
    kind: str
    joint: int
    unit: str
    detail: tuple[int, int] = (0, 0)


def all_features(backlash: bool, ripples: tuple[int, ...]) -> tuple[Feature, ...]:
    """Return every cause there is; ``backlash`` where directions of approach are known; the ripples' harmonics."""
    found = []
    for i in range(6):
        found.append(Feature(f"gain{i + 1}", "gain", i, "rad/rad"))
        for n in (*WAVES, *ripples):
            kind = "wave" if n in WAVES else "ripple"
            found += [Feature(f"{kind}{i + 1}_{w}{n}", kind, i, "rad", (n, k)) for k, w in enumerate(("sin", "cos"))]
        if backlash:
            found.append(Feature(f"backlash{i + 1}", "backlash", i, "rad"))
        found.append(Feature(f"slack{i + 1}", "slack", i, "rad"))
        found += [Feature(f"sag{i + 1}_{j + 1}", "sag", i, "rad/m", (j, 0)) for j in range(i, 6)]
    return tuple(found)


def values(arm: Arm, features: tuple[Feature, ...], q: Array, approach: Array | None, up_base: Array) -> Array:
    """Return what one unit of every coefficient adds to its joint's angle.

    Args:
        arm: the nominal arm, whose links the levers of sag are taken from.
        features: F of them.
        q: (N, 6) joint angles, rad.
        approach: (N, 6) directions of approach, or None.
        up_base: (3,) unit vector against gravity, base.

    Returns:
        (N, F).
    """
    out = np.zeros((len(q), len(features)))
    weighty = any(f.kind in ("sag", "slack") for f in features)
    levers = _levers(arm, q, up_base) if weighty else np.zeros((len(q), 6, 6))
    for k, f in enumerate(features):
        angle = q[:, f.joint]
        if f.kind == "gain":
            out[:, k] = angle
        elif f.kind in ("wave", "ripple"):
            n, phase = f.detail
            out[:, k] = np.cos(n * angle) if phase else np.sin(n * angle)
        elif f.kind == "backlash" and approach is not None:
            out[:, k] = -0.5 * approach[:, f.joint]
        elif f.kind == "slack":
            out[:, k] = 0.5 * _side(_weight_lever(arm, levers, f.joint), approach, f.joint)
        elif f.kind == "sag":
            out[:, k] = levers[:, f.joint, f.detail[0]]
    return out


def _weight_lever(arm: Arm, levers: Array, joint: int) -> Array:
    """Return the lever (N,), m, of the weight beyond a joint, if links are rods that are all equally heavy by the metre."""
    mass = np.hypot(arm.a, arm.d)[joint:] + 1e-9
    beyond = np.cumsum(mass[::-1])[::-1] - 0.5 * mass  # of a link's own vector: half of itself, and all that follows
    return np.asarray(levers[:, joint, joint:] @ beyond / mass.sum())


def _side(lever: Array, approach: Array | None, joint: int) -> Array:
    """Return on which side of its play a link lies (N,), -1 to 1: weight's, or where that is weaker that of friction.

    Near where one gives way to the other it is the mean of both sides, by how likely each is; where the side that it came
    from is not known, it is so from there to as far on the other side.
    """
    if np.abs(lever).max(initial=0.0) < FRICTION_M:
        return np.zeros(len(lever))  # it carries nothing: that is what ``backlash`` is for
    side = np.zeros(len(lever)) if approach is None else approach[:, joint]
    return np.asarray(np.tanh((lever - FRICTION_M * side) / (FRICTION_M * (1 - 0.5 * np.abs(side)))))


def _levers(arm: Arm, q: Array, up_base: Array) -> Array:
    """Return z_i . (L_j x g) (N, 6, 6) for unit gravity g: m of lever of link j about joint i, by the joint's direction."""
    T = arm.T_base_0
    modified = arm.convention == "modified"
    m = chain.motion(chain.nominal_table(arm), arm.direction * q, modified, T[:3, :3], T[:3, 3])
    z, at = m.axis[:, chain.OFFSET], np.concatenate([m.through[:, chain.OFFSET], m.o[None]])
    pull = np.cross(at[1:] - at[:-1], -up_base)  # link j goes from axis j to axis j + 1
    return np.asarray(np.einsum("i,inx,jnx->nij", arm.direction, z, pull))


def approaches(measured: Measured) -> bool:
    """Say whether directions of approach are known."""
    return measured.approach is not None and bool(np.any(measured.approach != 0))
