"""A rig that moved against the arm's base: found in the innovations of the estimator.

In: what the estimator did with each pose measurement. Out: the motion of the rig against the base, a jump or a drift, with
the time of its beginning. The generalised likelihood ratio test of Willsky and Jones ("A generalized likelihood ratio
approach to the detection and estimation of jumps in linear systems", 1976): a motion d of the arm's base in the rig
changes six numbers of the filter's state at a time s; what a filter that does not know of it leaves of that, F, and its
signature G in the innovations follow from the filter's own gains,

    G_k = H_k kept_k F_k-1,    F_k = kept_k F_k-1 - K_k G_k,    F_s = I in the rows of the base

so that z_k = G_k d + noise; a drift adds its speed to F in every step. For each s the sums C = sum G^T S^-1 G and
b = sum G^T S^-1 z give d = C^-1 b, and the chi-square b^T C^-1 b. Many beginnings are tried at once, the older the coarser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.geometry.pose import adjoint, inverse
from armsight.loop.estimators import Innovation, Outcome
from armsight.loop.health.record import HealthFinding, alarm_limit

#: A beginning is tried every so often, s; older than this many seconds their distances grow with their age.
EVERY_S, _FINE_S, _RATIO = 0.2, 1.0, 1.4
#: At most so many beginnings, and how often they are tested, Hz.
MOST, _TESTS_HZ = 20, 5.0
#: Errors of the arm's model last about so long, s: innovations closer than that count as one.
CORRELATED_S = 0.1
#: A prior so wide that it decides nothing: m, rad; for a drift, of that much in a second.
_WIDE = np.repeat([0.05, 0.1], 3)
#: A drift must explain so much more than a jump to be preferred.
_RARER = np.array([0.0, 10.0])
_LIMIT = alarm_limit(6, _TESTS_HZ, 2 * MOST)


@dataclass(frozen=True, eq=False)
class BaseMotion(Record):
    """A motion of the rig against the arm's base.

    Attributes:
        begin_s: when it began, s.
        drifts: whether it is a drift, else a jump.
        motion: (6,) what the motion does to the measured pose of the tool, right tangent [m; rad]; of a drift, so far.
        cov: (6, 6) its covariance.
        chi_square: of the motion against none.
    """

    begin_s: float
    drifts: bool
    motion: Array
    cov: Array
    chi_square: float

    @property
    def suspected(self) -> Array:
        """(6, 6) what the motion adds to the covariance of a measured pose of the tool."""
        return np.asarray(np.outer(self.motion, self.motion) + self.cov)


class FixedWatch:
    """Watches whether the rig stands still in the arm's base.

    Args:
        T_base_0: (4, 4) frame 0 of the arm's table in the base.
        state_size: length of the filter's state, whose first six numbers are the tangent of the arm's base.

    Attributes:
        moved: the motion of the test that found the clearest one; None where none was found.
        reopened: how many times the estimator dropped what it had learned, and when it first did, s.
    """

    def __init__(self, T_base_0: Array, state_size: int) -> None:
        self._T_base_0, self._size = T_base_0, state_size
        self._begins = np.zeros(0)
        self._F = np.zeros((state_size, 0, 2, 6))
        self._C, self._b = np.zeros((0, 2, 6, 6)), np.zeros((0, 2, 6))
        self._squares, self._weights = np.zeros(0), np.zeros(0)
        self._last_s = self._tested_s = -np.inf
        self._rejected: list[Innovation] = []
        self.moved: BaseMotion | None = None
        self.reopened: tuple[int, float] = (0, np.inf)

    def take(self, innovation: Innovation) -> None:
        """Take what the estimator did with a measurement, in order of time.

        Measurements that it rejected count only once so many agree that it accepted them: others are mistaken markers.
        """
        if innovation.outcome is Outcome.OUTLIER:
            self._rejected.append(innovation)
            return
        if innovation.outcome is Outcome.REOPENED:
            self.reopened = (self.reopened[0] + 1, min(self.reopened[1], innovation.t_s))
            if self._rejected:
                self._begin(self._rejected[0].t_s)
            for rejected in self._rejected:
                self._add(rejected)
        self._rejected = []
        self._add(innovation)

    def _add(self, innovation: Innovation) -> None:
        """Add an innovation to the sums of all beginnings."""
        t_s, z = innovation.t_s, innovation.z if innovation.clock is None else innovation.z - innovation.clock.in_z
        passed = t_s - self._last_s
        if not passed > 0.0:
            return
        if not len(self._begins) or t_s - self._begins[-1] >= EVERY_S:
            self._begin(t_s)
        if np.isfinite(passed):
            self._F[:6, :, 1] += passed * np.eye(6)[:, None]
        self._last_s = t_s
        weight = min(passed / CORRELATED_S, 1.0)
        F = innovation.kept[:, None] * self._F.reshape(self._size, -1)
        G = innovation.by_state @ F
        if innovation.gain.any():
            self._F = (F - innovation.gain @ G).reshape(self._F.shape)
        white = np.linalg.inv(innovation.cov)
        signature = G.reshape(6, -1, 2, 6)
        whitened = (white @ G).reshape(6, -1, 2, 6)
        self._C += weight * np.einsum("inak,inal->nakl", signature, whitened)
        self._b += weight * np.einsum("inak,i->nak", whitened, z)
        self._squares += weight * float(z @ white @ z)
        self._weights += weight
        if t_s - self._tested_s >= 1.0 / _TESTS_HZ:
            self._tested_s = t_s
            self._decide(t_s, innovation.T_base_tool)

    def _begin(self, t_s: float) -> None:
        """Try a new beginning, and drop the ones that the age makes needless."""
        ages = t_s - self._begins
        keep, last = np.zeros(len(ages), bool), np.inf
        for k, age in enumerate(ages):  # from the oldest on
            keep[k] = k == 0 or age <= _FINE_S or last >= _RATIO * age
            last = age if keep[k] else last
        rows = np.flatnonzero(keep)
        rows = rows if len(rows) < MOST else np.delete(rows, 1)
        new = np.zeros((self._size, 1, 2, 6))
        new[:6, 0, 0] = np.eye(6)
        self._begins = np.append(self._begins[rows], t_s)
        self._F = np.concatenate([self._F[:, rows], new], axis=1)
        self._C = np.concatenate([self._C[rows], np.zeros((1, 2, 6, 6))])
        self._b = np.concatenate([self._b[rows], np.zeros((1, 2, 6))])
        self._squares, self._weights = np.append(self._squares[rows], 0.0), np.append(self._weights[rows], 0.0)

    def _decide(self, t_s: float, T_base_tool: Array) -> None:
        """Test all beginnings; a motion is that of the tool at a pose (4, 4)."""
        C = self._C * np.outer(_WIDE, _WIDE) + np.eye(6)
        b = self._b * _WIDE
        d = np.linalg.solve(C, b[..., None])[..., 0]
        gained = np.einsum("nak,nak->na", b, d)
        excess = np.maximum((self._squares[:, None] - gained) / np.maximum(6.0 * self._weights, 1.0)[:, None], 1.0)
        chi_square = gained / excess
        n, kind = np.unravel_index(int(np.argmax(chi_square - _RARER)), chi_square.shape)
        found = float(chi_square[n, kind])
        if found <= max(_LIMIT, 0.0 if self.moved is None else self.moved.chi_square):
            return
        length = (t_s - self._begins[n]) if kind else 1.0
        to_tool = length * adjoint(inverse(T_base_tool) @ self._T_base_0) * _WIDE
        cov = excess[n, kind] * to_tool @ np.linalg.inv(C[n, kind]) @ to_tool.T
        self.moved = BaseMotion(float(self._begins[n]), bool(kind), to_tool @ d[n, kind], cov, found)

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        count, first_s = self.reopened
        if (moved := self.moved) is None:
            return () if not count else (_reopened_finding(count, first_s),)
        shift = moved.motion[:3]
        size = float(np.linalg.norm(shift))
        along = shift / size
        how = "drifts" if moved.drifts else "moved"
        return (
            HealthFinding(
                "fixed",
                f"the rig {how} against the base of the arm: the tool appears displaced by {1e3 * size:.2f} mm and "
                f"{np.degrees(np.linalg.norm(moved.motion[3:])):.3f} deg{' so far' if moved.drifts else ''}",
                moved.begin_s,
                1e3 * size,
                1e3 * float(np.sqrt(along @ moved.cov[:3, :3] @ along)),
                "mm",
                "fasten the rig and the base of the arm, and run again: that repeats the hand-eye calibration",
            ),
        )


def _reopened_finding(count: int, first_s: float) -> HealthFinding:
    """Return the finding of an estimator that dropped what it had learned, without another cause."""
    return HealthFinding(
        "estimator",
        f"measured poses contradicted what had been learned about the arm {count} time{'' if count == 1 else 's'}",
        first_s,
        float(count),
        0.0,
        "measurements",
        "check the body on the tool, the joints for slip, and for obstacles that the arm met",
    )
