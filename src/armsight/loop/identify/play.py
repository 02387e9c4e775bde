"""How much play each joint has, put together from all that shows it, or why these poses do not show it.

Play shows where a joint comes to rest on both of its sides. Friction leaves a joint without weight on the side it came from
(``backlash``); weight lays a joint on the side it pulls to (``slack``), whichever way it came; a joint that neither holds lies
anywhere between its stops, and from how far apart it was found its play is read. A joint that weight holds on one side at all
poses shows none: its play is a part of its zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.loop.identify.identify import Identified
from armsight.loop.identify.joint_noise import joint_noise, with_joint_noise
from armsight.loop.identify.measured import Measured

#: A joint scatters by itself where its chance is more than this many times as large as what one pose tells of it.
LOOSE = 2.0
#: Of a pose's side: less than this part of the poses on one side are too few to show it.
BOTH_SIDES = 0.02


class Play(NamedTuple):
    """The play of a joint, stop to stop.

    Attributes:
        joint: 0 to 5.
        value_rad: how much; NaN where it cannot be told.
        sigma_rad: its sigma; NaN likewise.
        how: what showed it, or why it does not show.
    """

    joint: int
    value_rad: float
    sigma_rad: float
    how: str


def plays(found: Identified, measured: Measured) -> tuple[Play, ...]:
    """Return the play of every joint.

    Args:
        found: the identified arm.
        measured: the poses that it was identified from.
    """
    x, model = found.solution.x, found.model
    phi = model.feature_values(measured.q, measured.approach)
    off = None
    if found.joint_sigma_rad.any():
        weighed = with_joint_noise(model, x, measured, found.joint_sigma_rad)
        off = joint_noise(model, found.solution, weighed, measured)
    out = []
    for i in range(6):
        columns = [k for k, f in enumerate(model.features) if f.joint == i and f.kind in ("backlash", "slack")]
        if off is not None and found.joint_sigma_rad[i] > LOOSE * float(np.median(off.sigma_off_rad[:, i])):
            stood = off.off_rad[:, i] + phi[:, columns] @ x[[model.causes_at + k for k in columns]]
            out.append(_between_stops(i, stood, off.sigma_off_rad[:, i]))
        else:
            out.append(_fitted(found, i, columns, phi))
    return tuple(out)


def _between_stops(joint: int, stood: Array, sigma: Array) -> Play:
    """Read the play of a joint that lies anywhere, from how far apart it was found."""
    order = np.argsort(stood)
    ends = [order[[0, 1, 2]], order[[-1, -2, -3]]]
    extent = float(stood[ends[1][0]] - stood[ends[0][0]])
    # What the outermost three differ by is how well an end is known, and what one pose tells of it.
    spread = [float(np.ptp(stood[rows])) for rows in ends]
    told = float(np.sqrt(np.sum(np.square(spread)) / 4 + np.sum(sigma[[ends[0][0], ends[1][0]]] ** 2)))
    return Play(joint, extent, told, "nothing holds it on one side: from how far apart it was found")


def _fitted(found: Identified, joint: int, columns: list[int], phi: Array) -> Play:
    """Read the play from what was fitted, or say why it was not."""
    model, x = found.model, found.solution.x
    at = {model.features[k].kind: k for k in columns}
    fitted = {kind: k for kind, k in at.items() if found.solution.free[model.causes_at + k]}
    if fitted:
        rows = np.array([model.causes_at + k for k in fitted.values()])
        value = float(np.sum(x[rows]))
        how = " and ".join(
            {"backlash": "the side it came from", "slack": "the side weight pulls to"}[kind] for kind in fitted
        )
        return Play(joint, value, float(np.sqrt(found.cov[np.ix_(rows, rows)].sum())), how)
    side = phi[:, at["slack"]]
    if np.abs(side).max(initial=0.0) > 0 and min(np.mean(side > 0), np.mean(side < 0)) < BOTH_SIDES:
        how = "cannot be told: at all these poses weight holds it on one side, and its play is a part of its zero"
    elif "backlash" not in at and not side.any():
        how = "cannot be told: from which side it came is not known"
    else:
        how = found.reasons.get(f"slack{joint + 1}", found.reasons.get(f"backlash{joint + 1}", "does not show"))
    return Play(joint, float("nan"), float("nan"), how)
