"""Walk along a path of the tool before it is travelled: the joints all along it, and the first thing in the way.

The joints follow by inverse kinematics in the configuration of the start. Their derivatives by the share of the way are
exact: with the tool's twist c and its derivative b, q' = J^-1 c and q'' = J^-1 (b - J'(q, q') q').
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from armsight.data import Array
from armsight.errors import InputError
from armsight.kernels import kernel
from armsight.robot.trajectories.limits import outside
from armsight.robot.trajectories.path import ROTATION_M, Path, PathPoints

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

#: The smallest singular value of the Jacobian, its linear rows divided by the arm's size, below which a pose counts as
#: singular: joints would rotate 200 times as fast as the tool. A wrist is there within about 0.4 degrees.
SINGULAR = 5e-3
#: The same where a motion begins to be slow because of it.
SLOW = 10 * SINGULAR
#: The walk's steps, m, with rotations counted as in :data:`ROTATION_M`, and the bounds of how many there are.
STEP_M, STEPS = 1e-3, (100, 5000)
#: How far a joint may rotate from one point of the walk to the next, rad; by more only beside a singularity.
FAR_RAD = 0.2
#: In how many steps a bend is walked at least.
BEND_STEPS = 50
#: Halvings of a step that find where a reason begins, and of a duration that find when a share is reached: to 1e-12.
HALVINGS = 40
#: Newton steps from a point of the walk to one beside it, and what they may leave, m and rad.
NEWTON, REFINED = 3, 1e-10


class Walk(NamedTuple):
    """The joints along a path, as far as it can be travelled."""

    share: Array  #: (K,) shares of the way, rising from 0
    q: Array  #: (K, n) joint angles, rad
    q1: Array  #: (K, 6) their derivative by the share, and ``q2`` the second
    q2: Array  #: see ``q1``

    def near(self, share: Array) -> Array:
        """Return joint angles (N, n) near shares (N,), to choose the right solution by."""
        if self.q.shape[1] == 6 or len(self.share) < 2:
            return columns(share, self.share, self.q)
        return np.asarray(CubicHermiteSpline(self.share, self.q, self.q1)(share))


class Obstacle(NamedTuple):
    """The first thing in the way."""

    share: float  #: where on the way
    reason: str  #: what it is
    clear: int = 1  #: how many points of the walk are not yet slowed down by a singularity before it, at least 1


def columns(x: Array, at: Array, values: Array) -> Array:
    """Interpolate each column of ``values`` (K, 6) linearly from ``at`` (K,) to ``x`` (N,)."""
    return np.stack([np.interp(x, at, column) for column in values.T], axis=1)


def refined(arm: Arm, T_base_tool: Array, q_near: Array) -> Array:
    """Return joint angles (N, n) of poses (N, 4, 4) from ones close by, by Newton's method; InputError if not close."""
    q = q_near
    off = behind(T_base_tool, arm.forward(q))
    for _ in range(NEWTON):
        step = _joints_by(arm.jacobian(q), off)
        if np.abs(step).max() > FAR_RAD:
            break
        q = q + step
        off = behind(T_base_tool, arm.forward(q))
    if np.abs(off).max() > REFINED:
        raise InputError("the joint angles on the path could not be found: it comes too near to a singularity")
    return q


def behind(T_goal: Array, T: Array) -> Array:
    """Return how far poses (..., 4, 4) are behind others, (..., 6): [m; rad], base axes, for small rotations."""
    off = np.empty((T.size // 16, 6))
    goals, Ts = np.ascontiguousarray(T_goal, np.float64), np.ascontiguousarray(T, np.float64)
    _behind(goals.reshape(-1, 4, 4), Ts.reshape(-1, 4, 4), off)
    return off.reshape((*T.shape[:-2], 6))


@kernel("const f8[:, :, ::1], const f8[:, :, ::1], f8[:, ::1]")
def _behind(goals: Array, Ts: Array, off: Array) -> None:
    """Write how far poses (N, 4, 4) are behind others to off (N, 6)."""
    for n in range(len(Ts)):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            off[n, i], off[n, 3 + i] = goals[n, i, 3] - Ts[n, i, 3], 0.0
            for m in range(3):
                off[n, 3 + i] += 0.5 * (goals[n, k, m] * Ts[n, j, m] - goals[n, j, m] * Ts[n, k, m])


def derivatives(arm: Arm, q: Array, points: PathPoints) -> tuple[Array, Array]:
    """Return q', q'' (N, n) by the share of the way at joint angles (N, n)."""
    J = arm.jacobian(q)
    q1 = _joints_by(J, points.twist)
    rates = [arm.jacobian_rate(a, b) for a, b in zip(q, q1, strict=True)]
    rate = np.array([Jd @ b for Jd, b in zip(rates, q1, strict=True)])
    q2 = _joints_by(J, points.bend - rate)
    if arm.joints > 6:
        # The least speeds that follow the path change along the free motion, too: (I - J+ J) J'^T (J J^T)^-1 twist.
        y = np.swapaxes(np.array(rates), 1, 2) @ np.linalg.solve(J @ np.swapaxes(J, 1, 2), points.twist[..., None])
        q2 = q2 + (y - np.linalg.pinv(J) @ (J @ y))[..., 0]
    return q1, q2


def _joints_by(J: Array, V: Array) -> Array:
    """Return the least joint motion (N, n) that moves the tool by V (N, n), for Jacobians (N, 6, n)."""
    if J.shape[-1] == 6:
        return np.asarray(np.linalg.solve(J, V[..., None])[..., 0], np.float64)
    return np.asarray((np.linalg.pinv(J) @ V[..., None])[..., 0], np.float64)


def singular_values(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Return the smallest singular value (N,) and the sign of the determinant (N,) at joint angles (N, n)."""
    # The linear rows are divided by the arm's size, m, so that they compare with the angular ones.
    J: Array = arm.jacobian(q) / np.array([arm.size_m] * 3 + [1, 1, 1])[:, None]
    smallest = np.asarray(np.linalg.svd(J, compute_uv=False)[:, -1])
    return smallest, np.asarray(np.sign(np.linalg.det(J))) if arm.joints == 6 else np.ones(len(q))


def walk(arm: Arm, path: Path, q_start: Array, bends: Array) -> tuple[Walk, Obstacle | None]:
    """Walk along a path as far as it can be travelled.

    ``q_start``: (n,) joint angles at its start, rad; ``bends``: (C, 2) shares between which steps are to be smaller.
    Returns the walk up to the first obstacle, and that; None where there is none.
    """
    if arm.joints < 6:
        raise InputError(
            f"{arm.name} has {arm.joints} joints: it cannot move its tool along a path with its orientation held; use a "
            "motion from joint angles to joint angles, or a tracked path"
        )
    share = _steps(path, bends)
    points = path.at(share)
    q, reason = _chain(arm, points, q_start) if arm.joints == 6 else _redundant_chain(arm, path, share, q_start)
    smallest, sign = singular_values(arm, q)
    bad = (smallest < SINGULAR) | (sign != sign[0]) | np.array([outside(arm, row) is not None for row in q])
    bad[1:] |= (np.abs(np.diff(q, axis=0)) > FAR_RAD).any(axis=1)
    good = int(np.argmax(bad)) if bad.any() else len(q)
    obstacle = None
    if good < len(share):
        # An arm that extends fully becomes singular just before it cannot reach: then the reach is what is in the way.
        extended = reason is not None and bool((smallest[good:] < 4 * SINGULAR).all())
        last = max((len(q) if extended else good) - 1, 0)
        low, high = share[last], share[min(last + 1, len(share) - 1)]
        obstacle = _obstacle(arm, path, (low, high), q[last], None if extended else sign[0])
        if good == 0:
            obstacle = Obstacle(0.0, _problem(arm, q[0], sign[0]) or obstacle.reason)
        slow = smallest[:good] < SLOW
        obstacle = obstacle._replace(clear=max(1, int(np.argmax(slow)) if slow.any() else good))
    if good == 0:
        return Walk(share[:0], q[:0], q[:0], q[:0]), obstacle
    kept = PathPoints(*(part[:good] for part in points))
    q1, q2 = derivatives(arm, q[:good], kept)
    return Walk(share[:good], q[:good], q1, q2), obstacle


def _steps(path: Path, bends: Array) -> Array:
    """Return (K,) shares in steps of about :data:`STEP_M`, each bend in :data:`BEND_STEPS` at least."""
    coarse = path.at(np.linspace(0, 1, 65)).twist
    length = np.maximum(
        np.linalg.norm(coarse[:, :3], axis=1), ROTATION_M * np.linalg.norm(coarse[:, 3:], axis=1)
    ).mean()
    even = np.linspace(0, 1, int(np.clip(length / STEP_M, *STEPS)) + 1)
    return np.unique(
        np.concatenate([even, *(np.linspace(begin, end, BEND_STEPS + 1) for begin, end in bends.tolist())])
    )


def _chain(arm: Arm, points: PathPoints, q_start: Array) -> tuple[Array, str | None]:
    """Return joint angles (K, n) from point to point, and why they end where the reach does; they end at a limit too."""
    chain = [q_start]
    for T in points.T_base_tool[1:]:
        q = _solve(arm, T, chain[-1])
        if isinstance(q, str):
            return np.array(chain), q
        chain.append(q)
        if outside(arm, q) is not None:
            break
    return np.array(chain), None


def _redundant_chain(arm: Arm, path: Path, share: Array, q_start: Array) -> tuple[Array, str | None]:
    """Return joint angles (K, n) at shares (K,), by the least speeds that follow the path, as :func:`_chain` does.

    The midpoint rule, and Newton's method for what it leaves.
    """
    chain, middles, ends = [q_start], path.at((share[1:] + share[:-1]) / 2), path.at(share)
    for k, step in enumerate(np.diff(share)):
        q = chain[-1]
        half = q + step / 2 * _joints_by(arm.jacobian(q), ends.twist[k])
        ahead = q + step * _joints_by(arm.jacobian(half), middles.twist[k])
        try:
            chain.append(refined(arm, ends.T_base_tool[k + 1 : k + 2], ahead[None])[0])
        except InputError:
            return np.array(chain), "the path leaves the reach of the arm, or comes too near to a singularity"
        if outside(arm, chain[-1]) is not None:
            break
    return np.array(chain), None


def _solve(arm: Arm, T_base_tool: Array, q_near: Array) -> Array | str:
    """Return the joint angles (n,) of a pose nearest to others, inside the limits or not; or why there are none."""
    found = arm.inverse(T_base_tool, near=q_near)
    if not len(found):
        return f"the path leaves the reach of the arm ({found.reason})"
    # Those outside the limits come last, though one of them may be the way the arm goes on.
    q = found.q + 2 * np.pi * np.round((q_near - found.q) / (2 * np.pi))
    return np.asarray(q[np.argmin(np.abs(q - q_near).max(axis=1))])


def _problem(arm: Arm, q: Array, sign: float) -> str | None:
    """Return what is wrong with joint angles (n,), in words; None where nothing is."""
    if (reason := outside(arm, q)) is not None:
        return reason
    smallest, now = singular_values(arm, q[None])
    if smallest[0] >= SINGULAR and now[0] == sign:
        return None
    idle = np.abs(np.linalg.svd(arm.jacobian(q))[2][-1])
    joints = [str(i + 1) for i in np.nonzero(idle > 0.1 * idle.max())[0]]
    named = " and ".join([", ".join(joints[:-1]), joints[-1]] if len(joints) > 1 else joints)
    return f"a singularity: joints {named} can rotate with hardly any motion of the tool"


def _obstacle(arm: Arm, path: Path, between: tuple[float, float], q_good: Array, sign: float | None) -> Obstacle:
    """Find where between two shares, of which the first is good, a reason begins; without a sign only the reach is one."""
    low, high = between
    reason = f"close to a singularity: a joint would rotate by {np.degrees(FAR_RAD):.0f} deg within a step of the path"
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        q = _solve(arm, path.at(np.array([middle])).T_base_tool[0], q_good)
        problem = q if isinstance(q, str) else None if sign is None else _problem(arm, q, sign)
        if problem is None:
            low, q_good = middle, np.asarray(q)
        else:
            high, reason = middle, problem
    return Obstacle(high, reason)
