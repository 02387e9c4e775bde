"""An arm's table that is grossly wrong: found in the poses of a hand-eye calibration before a loop is closed on it.

In: the arm, joint angles and measured poses of the body. Out: nothing, or a CalibrationError that says how far the poses
are off and which single mistake of the table explains them: a twist or a direction of the wrong sign, a zero off by a right
angle, two lengths exchanged. Each is tried with the closed form of the hand-eye calibration, which needs no start.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from armsight.data import Array
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.handeye.poses import LEVER_M, kronecker, starts
from armsight.robot.arm import Arm

#: Errors of a cheap arm: a single mistake of the table is looked for beyond them. m and rad, RMS;
#: half: ordinary arms are searched, double: a joint that is off by a few degrees is not.
_USUAL = 0.015, float(np.radians(2.0))
#: Nothing moves by a table that is off by more, whatever the mistake; m and rad. Half: an SO-101 whose zeros are off by
#: three degrees is rejected; double: a wrist with a wrong sign passes.
_GROSS = 0.04, float(np.radians(8.0))
#: A single mistake must fit so many times better; half: errors of a cheap arm imitate one, double: a good explanation of
#: an arm that has ordinary errors besides is not named.
_BETTER = 4.0
#: Mistakes that fit within this factor of the best are named, too; half: exact ties alone, double: weak ones as well.
_ALIKE = 1.25
#: Lengths that differ by less are not exchanged, m.
_LEAST_M = 0.002


def require_fitting(arm: Arm, q: Array, Ts_rig_body: Array) -> None:
    """Reject a table with which no loop may be closed.

    Args:
        arm: as its table says it is.
        q: (N, n) joint angles of the poses, rad.
        Ts_rig_body: (N, 4, 4) measured poses of the body, m.

    Raises:
        CalibrationError: the poses contradict the table by far more than a cheap arm's errors.
    """
    Ts = arm.forward(q)
    X, Z = starts(Ts, Ts_rig_body)[0]
    off = _errors(Ts, Ts_rig_body, Z, X)
    if all(size <= usual for size, usual in zip(off, _USUAL, strict=True)):
        return
    given = _size(off)
    sizes = {name: _size(_misfit(other, q, Ts_rig_body)) for name, other in _mistakes(arm)}
    best = min(sizes.values())
    explained = given > _BETTER * best
    if not explained and all(size <= gross for size, gross in zip(off, _GROSS, strict=True)):
        return
    names = " or ".join(name for name, size in sorted(sizes.items(), key=lambda each: each[1]) if size < _ALIKE * best)
    advice = (
        f"they fit within {1e3 * best:.1f} mm if {names}: correct the table"
        if explained
        else "no single sign, zero or pair of lengths explains it: check the table and the joint angles of several poses "
        "(armsight identify)"
    )
    raise CalibrationError(
        f"the table of {arm.name} contradicts the measured poses by {1e3 * off[0]:.0f} mm and {np.degrees(off[1]):.1f} deg "
        f"RMS, with which no loop is closed: {advice}"
    )


def _errors(Ts_base_tool: Array, Ts_rig_body: Array, Z: Array, X: Array) -> tuple[float, float]:
    """Return by how much poses are off, position, m, and rotation, rad: RMS of those within three medians."""
    e = log_se3(inverse(Z @ Ts_rig_body) @ Ts_base_tool @ X)
    parts = (np.linalg.norm(part, axis=1) for part in (e[:, :3], e[:, 3:]))
    shift, angle = (float(np.sqrt(np.mean(each[each <= 3.0 * np.median(each)] ** 2))) for each in parts)
    return shift, angle


def _misfit(arm: Arm, q: Array, Ts_rig_body: Array) -> tuple[float, float]:
    """Return the same of the best hand-eye calibration of an arm."""
    Ts = arm.forward(q)
    X, Z = kronecker(Ts, Ts_rig_body)
    return _errors(Ts, Ts_rig_body, Z, X)


def _size(off: tuple[float, float]) -> float:
    return float(np.hypot(off[0], LEVER_M * off[1]))


def _mistakes(arm: Arm) -> Iterator[tuple[str, Arm]]:
    """Yield tables that differ by a single mistake, and what that is."""
    for i, name in enumerate(arm.joint_names):
        at = np.arange(arm.joints) == i
        if abs(np.sin(arm.alpha[i])) > 0.1:
            yield f"alpha of {name} has the other sign", replace(arm, alpha=np.where(at, -arm.alpha, arm.alpha))
        for key in ("a", "d"):
            length = getattr(arm, key)
            if abs(length[i]) > _LEAST_M:
                yield f"{key} of {name} has the other sign", replace(arm, **{key: np.where(at, -length, length)})
        yield f"{name} turns the other way", replace(arm, direction=np.where(at, -arm.direction, arm.direction))
        for deg in (90, -90, 180):
            yield f"the zero of {name} is off by {deg} deg", replace(arm, offset=arm.offset + np.radians(deg) * at)
    lengths = np.concatenate([arm.a, arm.d])
    names = [f"{key} of {name}" for key in ("a", "d") for name in arm.joint_names]
    for i, k in itertools.combinations(range(len(lengths)), 2):
        if abs(lengths[i] - lengths[k]) > _LEAST_M:
            other = lengths.copy()
            other[[i, k]] = lengths[[k, i]]
            a, d = np.split(other, 2)
            yield f"{names[i]} and {names[k]} are exchanged", replace(arm, a=a, d=d)
