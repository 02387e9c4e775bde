"""Noise of hand-eye residuals: structures of it, their restricted likelihood, and the likelihood of poses left out.

In: linearised residuals e + J x, and for each source of error the covariance that a unit variance of it causes. Out: the
variances of the greatest restricted likelihood (:func:`reml`), and how probable poses left out are (:func:`held_out`).

A structure names its sources (:data:`STRUCTURES`). Sources that are independent from pose to pose give blocks (N, 6, 6);
those that neighbours share (a drift) one block (1, 6N, 6N): the same functions treat both.

- ``flange_m``, ``flange_rad``: the flange by the joints, about the flange.
- ``lateral_m``, ``depth_m``: the measured body's middle across and along the optical axis; ``seen_m``: alike in all three.
- ``seen_rad``: the measured body's rotation about its middle.
- ``hardly_rad``: the same, of a sigma so large that rotations have hardly any weight: an arm's rotations and its positions
  may contradict each other by more than either scatters.
- ``image``: the covariance given, times this.
- ``time_s``: the time stamp, along the motion (streams).
- ``link_m``, ``link_rad``: a constant error of every link's frame, along and about its three axes, where the joints and a
  model are known: what an arm whose lengths and zeros are not its model's does in each of its poses.
- ``drift_m``, ``drift_rad``: an error of the flange that neighbouring poses share: a smooth function of the pose (an arm
  whose kinematics are not its model's) or of time (an arm that warms up), a Gaussian process (Rasmussen and Williams,
  "Gaussian Processes for Machine Learning", 2006, eq. 2.31); or a random walk over time (an arm that slips, settles or
  loses steps: what it has gained stays), a Wiener process.
- ``walk_m``, ``walk_rad``: steps of a random walk of the eye's own pose, from frame to frame (visual odometry).
- ``scale_walk``: the scale of one moving camera, which has none of its own, walks over time: the eye's way from the body's
  origin is too long by a share that is a Wiener process.

Restricted likelihood: Patterson and Thompson, Biometrika 58, 1971; its gradient: Harville, JASA 72, 1977. Links' sigmas,
which few poses hardly show, are kept from zero: Chung et al., Psychometrika 78, 2013.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from armsight.data import Array, Record
from armsight.geometry.pose import adjoint, inverse, small_adjoint
from armsight.geometry.rotation import skew
from armsight.loop.handeye.poses import HARDLY, LEVER_M, Poses

#: Name of a structure -> its sources. Those with a drift or a walk are tried where the poses allow it.
STRUCTURES: dict[str, tuple[str, ...]] = {
    "robot": ("flange_m", "flange_rad"),
    "camera": ("seen_m", "seen_rad"),
    "camera, depth apart": ("lateral_m", "depth_m", "seen_rad"),
    "robot and camera": ("flange_m", "flange_rad", "lateral_m", "depth_m", "seen_rad"),
    "robot and image": ("flange_m", "flange_rad", "image"),
    "robot, camera and time stamps": ("flange_m", "flange_rad", "lateral_m", "depth_m", "seen_rad", "time_s"),
    "robot's geometry off": ("flange_m", "flange_rad", "lateral_m", "depth_m", "seen_rad", "link_m", "link_rad"),
    "robot's geometry and time stamps off": (
        "flange_m",
        "flange_rad",
        "lateral_m",
        "depth_m",
        "seen_rad",
        "time_s",
        "link_m",
        "link_rad",
    ),
    "robot drifting over its poses": (
        "flange_m",
        "flange_rad",
        "lateral_m",
        "depth_m",
        "seen_rad",
        "drift_m",
        "drift_rad",
    ),
    "robot drifting over time": ("flange_m", "flange_rad", "seen_m", "seen_rad", "drift_m", "drift_rad"),
    "robot walking over time": ("flange_m", "flange_rad", "seen_m", "seen_rad", "drift_m", "drift_rad"),
    "camera walking": ("flange_m", "flange_rad", "walk_m", "walk_rad"),
    "camera's scale walking": ("flange_m", "flange_rad", "seen_m", "seen_rad", "scale_walk"),
    "camera and its scale walking": ("flange_m", "flange_rad", "walk_m", "walk_rad", "scale_walk"),
    "positions alone": ("seen_m", "hardly_rad"),
}
#: Structures whose errors are shared between poses, and are no unknowns.
SHARED = (
    "robot drifting over its poses",
    "robot drifting over time",
    "robot walking over time",
    "camera walking",
    "camera's scale walking",
    "camera and its scale walking",
)
#: Shared source -> the map that says what it does to a pose.
SHARED_MAPS = {"drift_m": "flange_m", "drift_rad": "flange_rad", "scale_walk": "scale"}
#: Sources that are the arm's.
OF_THE_ARM = ("flange_m", "flange_rad", "link_m", "link_rad", "drift_m", "drift_rad")
#: Where a drift over poses has forgotten itself: this rotation, rad, or this way, m; and over time, a share of the whole.
FORGETS_RAD, FORGETS_M, FORGETS_SHARE = 1.0, 0.4, 0.15
#: Errors of position and angle of one source are alike at LEVER_M, as far as poses do not say otherwise: the sigma of the
#: logarithm of their variances' ratio. Few poses, or links, say little about two variances: one may vanish by chance.
LIKE_EACH_OTHER = 1.5
#: Step of the logarithm of a variance for differences; the sigma of such a logarithm at most; and the least degrees of
#: freedom of one direction: below 2 there is no mean.
STEP_LOG, KNOWN_LOG, LEAST_FREEDOM = 0.1, 3.0, 3.0
#: Information about a direction that a block leaves when it is left out is taken for this share at least.
LEAST_LEFT = 0.02
#: Sigmas are looked for between these (m, rad, s), and the factor of the covariance that is given up to the last.
LOW, HIGH, HIGH_IMAGE = 1e-7, 0.3, 100.0
#: Errors of links beyond this are no small ones any more: the arm is to be identified first.
HIGH_LINK_M, HIGH_LINK_RAD = 0.01, 0.015


@dataclass(frozen=True, eq=False)
class Linear(Record):
    """Residuals near a solution.

    Attributes:
        e: (N, 6) residuals.
        J: (N, 6, P) their derivative by the unknowns.
        given: (N, 6, 6) the covariance that is given, zero where none.
        maps: source -> (N, 6, K) what K unit errors of a pose do to its residual.
        kernel: source -> (N, N) correlation of a shared source between poses.
        walk: source -> (N, 6, 6) covariance that a walk has gathered up to a pose, unit variance a frame.
        known: (P,) information that there is about each unknown beside the residuals, zero for most.
        at: (P,) where each unknown is, from where that information has it.
    """

    e: Array
    J: Array
    given: Array
    maps: dict[str, Array]
    kernel: dict[str, Array]
    walk: dict[str, Array]
    known: Array
    at: Array

    def rows(self, rows: NDArray[np.int64]) -> Linear:
        """Return a part of the poses."""
        return Linear(
            self.e[rows],
            self.J[rows],
            self.given[rows],
            {name: M[rows] for name, M in self.maps.items()},
            {name: K[np.ix_(rows, rows)] for name, K in self.kernel.items()},
            {name: W[rows] for name, W in self.walk.items()},
            self.known,
            self.at,
        )


def error_maps(
    poses: Poses, e: Array, carry: Array, speed: Array | None, links: Array | None = None
) -> dict[str, Array]:
    """Return what unit errors of each independent source do to the residuals.

    Args:
        poses: N poses.
        e: (N, 6) the residuals.
        carry: (N, 6, 6) adjoints that map an error of the flange to the residuals.
        speed: (N, 6) twist of the flange, right tangent, m/s and rad/s; None: no streams.
        links: (N, L, 4, 4) T_link_flange, m; None: no model.
    """
    n = len(poses.A)
    axes = np.zeros((n, 6, 3))
    axes[:, :3] = np.swapaxes(poses.B[:, :3, :3], 1, 2)  # the rig's axes in the body's
    about = np.zeros((n, 6, 3))
    about[:, :3], about[:, 3:] = skew(poses.centre), np.eye(3)
    maps = {
        "flange_m": carry[..., :3],
        "flange_rad": carry[..., 3:],
        "seen_m": axes,
        "lateral_m": axes[..., :2],
        "depth_m": axes[..., 2:],
        "seen_rad": about,
        "hardly_rad": about,
        "scale": np.concatenate([inverse(poses.B)[:, :3, 3:], np.zeros((n, 3, 1))], axis=1),
    }
    if speed is not None:
        maps["time_s"] = carry @ speed[..., None]
    if links is not None:
        # As the derivative by the mounting is: an error of the flange's frame and one of the mounting are the same.
        bent = (np.eye(6) + 0.5 * small_adjoint(e)) @ carry
        moved = np.swapaxes(bent[:, None] @ adjoint(inverse(links)), 1, 2)  # (N, 6, L, 6)
        maps["link_m"], maps["link_rad"] = (moved[..., part].reshape(n, 6, -1) for part in (slice(3), slice(3, 6)))
    return maps


def walk_gathered(poses: Poses) -> dict[str, Array]:
    """Return the covariance (N, 6, 6) that a random walk of the eye has gathered, for unit steps of each kind.

    The eye's pose in the body is off by steps exp(xi_j), each in the eye's own axes: in the body's they are
    Ad(T_body_rig) xi_j, and add up.
    """
    steps = adjoint(inverse(poses.B))
    return {
        name: np.cumsum(part @ np.swapaxes(part, 1, 2), axis=0)
        for name, part in (("walk_m", steps[..., :3]), ("walk_rad", steps[..., 3:]))
    }


def pose_kernel(A: Array) -> Array:
    """Return the correlation (N, N) of a smooth error between poses (N, 4, 4)."""
    way = np.sum((A[:, None, :3, 3] - A[None, :, :3, 3]) ** 2, axis=-1)
    # Chords, not angles: an exponential of squared angles is no covariance (Feragen et al., CVPR 2015).
    chords = 3 - np.einsum("iab,jab->ij", A[:, :3, :3], A[:, :3, :3])
    return np.asarray(np.exp(-0.5 * (way / FORGETS_M**2 + chords / FORGETS_RAD**2)))


def time_kernel(t_s: Array) -> Array:
    """Return the correlation (N, N) of a slow error between times (N,), s."""
    span = max(float(t_s.max() - t_s.min()), 1e-9) * FORGETS_SHARE
    return np.asarray(np.exp(-0.5 * ((t_s[:, None] - t_s[None]) / span) ** 2))


def wiener_kernel(t_s: Array) -> Array:
    """Return the covariance (N, N) of a random walk between times (N,), s, of variance 1 over the whole."""
    begun = t_s - t_s.min()
    return np.asarray(np.minimum(begun[:, None], begun[None]) / max(float(begun.max()), 1e-9))


@dataclass(frozen=True, eq=False)
class Blocks(Record):
    """The covariance's parts and the residuals, in blocks that are independent of each other.

    Attributes:
        e: (n, m) residuals.
        J: (n, m, P) their derivative.
        given: (n, m, m) what is given.
        parts: (K, n, m, m) what unit variances of the sources cause.
        sources: their K names.
        known: (P,) information about each unknown beside the residuals.
        at: (P,) where each is, from where that has it.
        links: (P,) of which source's variance an unknown is, an error of a link; -1 for the others.
    """

    e: Array
    J: Array
    given: Array
    parts: Array
    sources: tuple[str, ...]
    known: Array
    at: Array
    links: NDArray[np.int64]

    def covariance(self, variances: Array) -> Array:
        """Return the covariance (n, m, m)."""
        C = self.given + np.einsum("k,knij->nij", variances, self.parts)
        i = np.arange(C.shape[-1])
        C[:, i, i] = C[:, i, i] * (1 + 1e-8) + 1e-16  # positive definite in spite of rounding
        return np.asarray(C)


def blocks(linear: Linear, structure: str) -> Blocks:
    """Arrange residuals for a structure."""
    n = len(linear.e)
    sources = STRUCTURES[structure]
    given = np.zeros_like(linear.given) if "image" in sources else linear.given
    links = [name for name in sources if name.startswith("link")]
    own = {name: M @ np.swapaxes(M, 1, 2) for name, M in linear.maps.items() if name in sources and name not in links}
    if "image" in sources:
        own["image"] = linear.given
    none = np.full(linear.J.shape[2], -1)
    if structure not in SHARED:
        # An error that all poses share, of known variance, is an unknown with that information about it.
        J = np.concatenate([linear.J, *(linear.maps[name] for name in links)], axis=2)
        of = np.concatenate([none, *(np.full(linear.maps[name].shape[2], sources.index(name)) for name in links)])
        nothing = np.zeros(J.shape[2] - len(none))
        known, at = np.append(linear.known, nothing), np.append(linear.at, nothing)
        parts = np.array([own.get(name, np.zeros_like(given)) for name in sources])
        return Blocks(linear.e, J, given, parts, sources, known, at, of)
    shared = []
    for name in sources:
        if name in own:
            shared.append(_spread(own[name]))
        elif name in linear.walk:
            first = np.minimum(np.arange(n)[:, None], np.arange(n)[None])
            shared.append(_joined(linear.walk[name][first]))
        else:
            M = linear.maps[SHARED_MAPS[name]]
            K = linear.kernel[structure]
            if name != "scale_walk":  # what changes by so much from pose to pose has a constant part as large
                K = 1 + K
            shared.append(_joined(K[..., None, None] * np.einsum("iak,jbk->ijab", M, M)))
    return Blocks(
        linear.e.reshape(1, -1),
        linear.J.reshape(1, 6 * n, -1),
        _spread(given)[None],
        np.array(shared)[:, None],
        sources,
        linear.known,
        linear.at,
        none,
    )


def _joined(grid: Array) -> Array:
    """Return (N, N, 6, 6) as a matrix (6N, 6N)."""
    n = len(grid)
    return np.asarray(np.swapaxes(grid, 1, 2).reshape(6 * n, 6 * n))


def _spread(own: Array) -> Array:
    """Return blocks (N, 6, 6) as a matrix (6N, 6N)."""
    n = len(own)
    M = np.zeros((n, 6, n, 6))
    M[np.arange(n), :, np.arange(n)] = own
    return M.reshape(6 * n, 6 * n)


@dataclass(frozen=True, eq=False)
class Solved(Record):
    """The weighted least squares at given variances.

    Attributes:
        x: (P,) the step that minimises the squares of e + J x, the links' errors last.
        root: (P, P) root @ root.T is its covariance.
        inverse: (n, m, m) inverse covariance of the residuals.
        weighted: (n, m) inverse covariance times what is left.
        cost: minus the restricted log-likelihood.
    """

    x: Array
    root: Array
    inverse: Array
    weighted: Array
    cost: float

    @property
    def cov(self) -> Array:
        """(P, P) covariance of the step."""
        return np.asarray(self.root @ self.root.T)


def solve(b: Blocks, variances: Array) -> Solved:
    """Solve the weighted least squares."""
    C = b.covariance(variances)
    L = np.linalg.cholesky(C)
    Ci = np.asarray(np.linalg.inv(C) if len(C) > 1 else _inverse(L[0])[None])
    CiJ = Ci @ b.J
    is_link = b.links >= 0
    known = np.where(is_link, 1 / variances[b.links], b.known)
    H = np.einsum("nki,nkj->ij", b.J, CiJ) + np.diag(known)
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))  # m, rad and s side by side
    values, vectors = np.linalg.eigh(unit[:, None] * H * unit)
    values = np.maximum(values, 1e-14 * values[-1])
    root = unit[:, None] * vectors / np.sqrt(values)
    x = -root @ (root.T @ (np.einsum("nki,nk->i", CiJ, b.e) + known * b.at))
    left = b.e + b.J @ x
    weighted = (Ci @ left[..., None])[..., 0]
    logdet = 2 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
    logdet_H = float(np.log(values).sum() - 2 * np.log(unit).sum())
    squares = float((left * weighted).sum() + (known * (b.at + x) ** 2).sum())
    logdet_links = -float(np.log(known[is_link]).sum())
    return Solved(x, root, Ci, weighted, 0.5 * (logdet + logdet_H + logdet_links + squares))


def _inverse(L: Array) -> Array:
    """Return the inverse of L L^T."""
    half, _ = dpotri(L, lower=1)
    return np.asarray(np.tril(half) + np.tril(half, -1).T)


def own_squares(b: Blocks, variances: Array, x: Array) -> Array:
    """Return the squared Mahalanobis length (N,) of each pose's residual after a step (P,); independent poses only."""
    left = b.e + b.J @ x
    return np.asarray(np.einsum("ni,ni->n", left, np.linalg.solve(b.covariance(variances), left[..., None])[..., 0]))


def left_out_squares(b: Blocks, s: Solved) -> Array:
    """Return the squared Mahalanobis length (N,) of each pose's residual, predicted from all others; one block only."""
    CiJ = s.inverse[0] @ b.J[0] @ s.root
    n = b.e.size // 6
    out = np.empty(n)
    for k in range(n):
        rows = slice(6 * k, 6 * k + 6)
        own = s.inverse[0][rows, rows] - CiJ[rows] @ CiJ[rows].T
        out[k] = float(s.weighted[0][rows] @ np.linalg.lstsq(own, s.weighted[0][rows], rcond=1e-12)[0])
    return out


def _value_and_gradient(logs: Array, b: Blocks) -> tuple[float, Array]:
    """Return minus the restricted log-likelihood, with priors of pairs and links, and its gradient by the logarithms."""
    variances = np.exp(logs)
    s = solve(b, variances)
    n, m = b.e.shape
    flat = b.parts.reshape(len(b.sources), n * m * m)
    root = s.inverse @ b.J @ s.root  # the inverse covariance, projected: s.inverse - root root^T
    projected = s.inverse - root @ np.swapaxes(root, 1, 2)
    traces = flat @ (projected - s.weighted[:, :, None] * s.weighted[:, None, :]).reshape(-1)
    gradient = 0.5 * variances * traces
    for k in np.unique(b.links[b.links >= 0]):
        of = b.links == k
        gradient[k] += 0.5 * float(of.sum() - ((s.root[of] ** 2).sum() + (s.x[of] ** 2).sum()) / variances[k])
    cost = s.cost
    if "link_m" in b.sources or b.sources in (("flange_m", "flange_rad"), ("seen_m", "seen_rad")):
        m = len(b.sources) - 2
        rad = m + 1
        off = (logs[m] - logs[rad] - 2 * np.log(LEVER_M)) / LIKE_EACH_OTHER**2
        cost += 0.5 * LIKE_EACH_OTHER**2 * off**2
        gradient[m] += off
        gradient[rad] -= off
    # Gamma(2, 0) of each link's sigma, so that what no residual shows is not taken for zero.
    for k in np.unique(b.links[b.links >= 0]):
        cost -= 0.5 * float(logs[k])
        gradient[k] -= 0.5
    return cost, gradient


def reml(b: Blocks, start: Array, steps: int = 60) -> Array:
    """Return the variances (K,) of the greatest restricted likelihood.

    Args:
        b: residuals.
        start: (K,) variances to begin at.
        steps: iterations at most.
    """
    low = 2 * np.log(LOW)
    high = {"image": HIGH_IMAGE, "link_m": HIGH_LINK_M, "link_rad": HIGH_LINK_RAD}
    bounds = [(low, 2 * np.log(high.get(name, HIGH))) for name in b.sources]
    if "hardly_rad" in b.sources:
        bounds[b.sources.index("hardly_rad")] = (2 * np.log(HARDLY),) * 2
    found = minimize(
        _value_and_gradient,
        np.clip(np.log(start), *np.transpose(bounds)),
        args=(b,),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": steps, "ftol": 1e-7},
    )
    return np.asarray(np.exp(found.x))


def freedom(b: Blocks, variances: Array, cov: Callable[[Array], Array], count: int) -> float:
    """Return of how many degrees of freedom Student's ellipsoid of a covariance is, whose variances are estimates.

    Satterthwaite's: a variance v of the unknowns that is known with the variance w has 2 v^2 / w, where w follows from the
    curvature of the restricted likelihood; those of several directions are joined as Fai and Cornelius do (J. Statistical
    Computation and Simulation 54, 1996).

    Args:
        b: the residuals that the variances were estimated from.
        variances: (K,) the estimates.
        cov: variances -> (P, P) covariance of the unknowns.
        count: of the unknowns, the first so many.
    """
    logs = np.log(variances)
    steps = STEP_LOG * np.eye(len(logs))
    slopes = [
        (_value_and_gradient(logs + s, b)[1] - _value_and_gradient(logs - s, b)[1]) / (2 * STEP_LOG) for s in steps
    ]
    values, vectors = np.linalg.eigh(0.5 * (np.array(slopes) + np.transpose(slopes)))
    known = (vectors / (np.maximum(values, 0.0) + KNOWN_LOG**-2)) @ vectors.T
    unit = 1 / np.sqrt(np.diag(cov(variances))[:count])
    sizes, axes = np.linalg.eigh(unit[:, None] * cov(variances)[:count, :count] * unit)
    white = unit[:, None] * axes / np.sqrt(sizes)

    def along(at: Array) -> Array:
        return np.asarray(np.einsum("pk,pq,qk->k", white, cov(np.exp(at))[:count, :count], white))

    by = np.array([(along(logs + s) - along(logs - s)) / (2 * STEP_LOG) for s in steps])
    of_each = np.maximum(2 / np.maximum(np.einsum("ik,ij,jk->k", by, known, by), 1e-9), LEAST_FREEDOM)
    total = float(np.sum(of_each / (of_each - 2)))
    return 2 * total / max(total - count, 1e-9)


def jackknife(b: Blocks, s: Solved) -> Array:
    """Return the covariance (P, P) of the unknowns that leaving out one block after the other shows, at the same weights.

    It holds for errors that are not as the structure says, too (Wu, Annals of Statistics 14, 1986).
    """
    CiJ = s.inverse @ b.J
    H = np.einsum("nki,nkj->nij", b.J, CiJ)
    root = s.root  # whitens: the unit matrix is all information
    left = np.eye(root.shape[1]) - root.T @ H @ root
    pulls = np.einsum("nki,nk->ni", b.J, s.weighted) @ root
    values, vectors = np.linalg.eigh(left)
    values = np.maximum(values, LEAST_LEFT)
    moved = np.einsum("nij,nj,nkj,nk->ni", vectors, 1 / values, vectors, pulls) @ root.T
    return np.asarray(moved.T @ moved * (len(b.e) - 1) / len(b.e))


def held_out(
    linear: Linear, structure: str, variances: Array, parts: list[NDArray[np.int64]], steps: int = 8
) -> tuple[Array, Array, Array]:
    """Predict poses left out, part after part; the variances are estimated anew without them.

    Returns:
        (N,) logarithms of the probability density of each pose's residual; (N, 6) the residuals themselves under
        transforms fitted without them; and (N, 6) what is left of them where the others' shared errors are predicted too.
    """
    density, residual = np.full(len(linear.e), np.nan), np.full((len(linear.e), 6), np.nan)
    left = residual.copy()
    everything, own = np.arange(len(linear.e)), linear.J.shape[2]
    whole = blocks(linear, structure) if structure in SHARED else None
    for part in parts:
        others = np.setdiff1d(everything, part)
        rest = blocks(linear.rows(others), structure)
        again = reml(rest, variances, steps)
        fitted = solve(rest, again)
        residual[part] = linear.e[part] + linear.J[part] @ fitted.x[:own]
        if whole is None:
            b = blocks(linear.rows(part), structure)
            mean = b.e + b.J @ fitted.x
            S = b.covariance(again) + b.J @ fitted.cov @ np.swapaxes(b.J, 1, 2)
        else:
            C = whole.covariance(again)[0]
            of, frm = _lines(part), _lines(others)
            gain = C[np.ix_(of, frm)] @ fitted.inverse[0]
            JJ = linear.J[part].reshape(len(of), -1) - gain @ rest.J[0]
            full = C[np.ix_(of, of)] - gain @ C[np.ix_(frm, of)] + JJ @ fitted.cov @ JJ.T
            S = np.array([full[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(part))])
            mean = residual[part] - (C[np.ix_(of, frm)] @ fitted.weighted[0]).reshape(-1, 6)
        density[part], left[part] = _log_normal(mean, S), mean
    return density, residual, left


def _lines(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((6 * rows[:, None] + np.arange(6)).ravel())


def _log_normal(e: Array, S: Array) -> Array:
    """Return the logarithm of the normal density of residuals (N, 6) with covariances (N, 6, 6)."""
    squares = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[..., None])[..., 0])
    return np.asarray(-0.5 * (squares + np.linalg.slogdet(S)[1] + 6 * np.log(2 * np.pi)))
