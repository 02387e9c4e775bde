"""Arrow-shaped normal equations: parameters that all shots share, and a few of every shot's own.

Every shot's own parameters are eliminated (Schur complement; Triggs et al., "Bundle adjustment: a modern synthesis",
2000), so the cost grows linearly with the shots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Ids, Record


@dataclass(frozen=True, eq=False)
class Arrow(Record):
    """Normal equations of Q shared parameters and K own ones of each of S shots.

    Attributes:
        H_shared: (Q, Q) information of the shared parameters.
        H_cross: (S, K, Q) what couples them with every shot's own.
        H_shots: (S, K, K) information of every shot's own parameters.
        g_shared: (Q,) downhill gradient.
        g_shots: (S, K) downhill gradient.
        cost: what is minimised.
    """

    H_shared: Array
    H_cross: Array
    H_shots: Array
    g_shared: Array
    g_shots: Array
    cost: float

    @staticmethod
    def impossible() -> Arrow:
        """Return equations of infinite cost: a state that no detection allows."""
        nothing = np.zeros(0)
        return Arrow(nothing, nothing, nothing, nothing, nothing, np.inf)

    @staticmethod
    def of(A: Array, B: Array, r: Array, shot: Ids, shot_count: int, cost: float) -> Arrow:
        """Assemble from whitened residuals r (N, 2), their derivatives A (N, 2, Q), B (N, 2, K) and shots (N,), sorted."""
        q, k = A.shape[2], B.shape[2]
        H_cross, H_shots, g_shots = (
            np.zeros((shot_count, k, q)),
            np.zeros((shot_count, k, k)),
            np.zeros((shot_count, k)),
        )
        bounds = np.searchsorted(shot, np.arange(shot_count + 1))
        for j in range(shot_count):
            rows = slice(bounds[j], bounds[j + 1])
            m = 2 * (bounds[j + 1] - bounds[j])
            a, b, e = A[rows].reshape(m, q), B[rows].reshape(m, k), r[rows].reshape(m)
            H_cross[j], H_shots[j], g_shots[j] = b.T @ a, b.T @ b, b.T @ e
        flat = A.reshape(2 * len(A), q)
        return Arrow(flat.T @ flat, H_cross, H_shots, flat.T @ r.reshape(-1), g_shots, cost)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Solve for the shared step (Q,) and the shots' steps (S, K) with Marquardt's damping."""
        H = self.H_shared + np.diag(damping * np.diag(self.H_shared))
        Hs = self.H_shots + damping * self.H_shots * np.eye(self.H_shots.shape[1])
        gain = np.linalg.solve(Hs, self.H_cross)
        S = H - np.tensordot(self.H_cross, gain, axes=((0, 1), (0, 1)))
        g = self.g_shared - np.tensordot(gain, self.g_shots, axes=((0, 1), (0, 1)))
        shared = solve_scaled(S, g)
        shots = np.linalg.solve(Hs, (self.g_shots - self.H_cross @ shared)[..., None])[..., 0]
        return shared, np.asarray(shots, np.float64)

    def schur(self) -> Array:
        """(Q, Q) information of the shared parameters with the shots' own marginalised."""
        gain = np.linalg.solve(self.H_shots, self.H_cross)
        return np.asarray(self.H_shared - np.tensordot(self.H_cross, gain, axes=((0, 1), (0, 1))))

    def cov_shots(self, cov_shared: Array) -> Array:
        """(S, K, K) covariance of the shots' own parameters, given that of the shared ones (Q, Q)."""
        gain = np.linalg.solve(self.H_shots, self.H_cross)
        return np.asarray(np.linalg.inv(self.H_shots) + gain @ cov_shared @ gain.transpose(0, 2, 1))


def solve_scaled(H: Array, g: Array) -> Array:
    """Solve a positive semi-definite system after scaling it to a unit diagonal; least norm where it is singular."""
    if not len(g):
        return g
    d = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.asarray(d * np.linalg.lstsq(d[:, None] * H * d, d * g, rcond=1e-14)[0])
