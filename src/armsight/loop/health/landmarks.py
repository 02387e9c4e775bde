"""Fixed marker bodies in view: whether the cameras still stand where they stood, or a body is not fixed.

In: measured poses of bodies that do not move, any number. Out: findings. The mean of the first poses of each body is its
reference. A later mean differs from it by a tangent xi; if the cameras moved, their motion m in the left one's frame is the
same for all bodies,

    m = -Ad(T_left_body) xi

A body that stands where it stood proves that the cameras do, if it is measured well enough to contradict m; then those that
moved are not fixed. Bodies that all moved agree on m (chi-square of their differences), or they do not. With a single body
the two look alike. Only the bodies seen since the last test count: a large motion may take one out of view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armsight.data import Array, PoseEstimate
from armsight.estimate.chance import chi_square_limit, squares_of
from armsight.geometry.pose import adjoint, inverse, log_se3
from armsight.loop.finding import HealthFinding, alarm_limit, make_finding, sized

#: Poses of a mean.
_SHOTS = 5
#: Of a pose's noise this share of the variance stays in each mean, and of the calibration's covariance this share
#: differs.
_STAYS, _DIFFERS = 0.1, 2.5e-3
#: Chi-square (5) below which a motion may be one along the optical axis alone, but for one in a hundred.
_ALONG = chi_square_limit(5, 0.01)
#: A body that moved by less, m, is not reported.
_LEAST_M = 1e-4


@dataclass
class _Landmark:
    """A fixed body."""

    name: str
    T_left_body: Array | None = None
    reference: Array | None = None  #: (6,) mean tangent of the first poses from that; None before there are enough
    #: those of the mean that is being made, and when the first of them was seen, s
    tangents: list[Array] = field(default_factory=list)
    begin_s: float | None = None
    #: (6,) tangent of the newest mean from the reference, its covariance (6, 6), and since when it is, s
    newest: tuple[Array, Array, float | None] | None = None

    def motion(self) -> tuple[Array, Array]:
        """Return the motion (6,) of the cameras that explains the newest mean, and the inverse of its covariance."""
        assert self.newest is not None
        assert self.T_left_body is not None
        to_left = adjoint(self.T_left_body)
        return -to_left @ self.newest[0], np.asarray(np.linalg.inv(to_left @ self.newest[1] @ to_left.T), dtype=float)

    @property
    def shift_m(self) -> float:
        """How far the body is from its reference, m."""
        return 0.0 if self.newest is None else float(np.linalg.norm(self.newest[0][:3]))

    @property
    def moved(self) -> bool:
        if self.newest is None:
            return False
        xi, cov, _ = self.newest
        return self.shift_m > _LEAST_M and bool(squares_of(xi, cov) > _limit(6))


def _limit(freedom: int) -> float:
    return alarm_limit(freedom, 30.0 / _SHOTS)  # a mean of so many shots at 30 Hz


#: So many means of all bodies together for each of them are waited for those of a body that is not seen any more.
_PATIENCE = 4


class LandmarkWatch:
    """Watches the poses of fixed bodies."""

    def __init__(self, names: Sequence[str]) -> None:
        self._landmarks = [_Landmark(name) for name in names]
        self.not_fixed: tuple[HealthFinding, ...] = ()  #: bodies that are not fixed, as others prove
        self._fresh: set[int] = set()  # bodies with a new mean since the last test
        self._waited = 0
        self.cameras_moved = False  #: whether the cameras were found to have moved
        self.of_cameras: HealthFinding | None = None  #: what says so, or that they may have; None where nothing does
        #: (6,) motion of the cameras, right tangent in the left one's frame, with covariance (6, 6), once two tests in
        #: a row agree on it: the mean of a test may hold poses from before
        self.motion: tuple[Array, Array] | None = None
        self._common: tuple[Array, Array] | None = None

    @property
    def never_seen(self) -> tuple[str, ...]:
        """Names of the bodies that were not seen often enough to be watched."""
        return tuple(each.name for each in self._landmarks if each.newest is None)

    def take(self, row: int, estimate: PoseEstimate, t_s: float | None) -> None:
        """Take a measured pose of the body of a row, in order of time, s (None: the shots have no times)."""
        mark = self._landmarks[row]
        if mark.T_left_body is None:
            mark.T_left_body = estimate.T_left_body
        if not mark.tangents:
            mark.begin_s = t_s
        mark.tangents.append(log_se3(inverse(mark.T_left_body) @ estimate.T_left_body))
        if len(mark.tangents) < _SHOTS:
            return
        mean, mark.tangents = np.mean(mark.tangents, axis=0), []
        if mark.reference is None:
            mark.reference = mean
        cov = (2.0 / _SHOTS + _STAYS) * estimate.cov_noise + _DIFFERS * (estimate.cov - estimate.cov_noise)
        since_s = mark.newest[2] if mark.newest is not None and mark.moved else mark.begin_s
        mark.newest = mean - mark.reference, cov, since_s
        self._fresh.add(row)
        self._waited += 1
        known = {k for k, each in enumerate(self._landmarks) if each.newest is not None}
        if self._fresh == known or self._waited >= _PATIENCE * len(known):  # else a body is not seen any more
            last, self._common = self._common, None
            of_cameras, not_fixed = self._decided()
            self.motion = _agreed(last, self._common)
            if of_cameras is not None or not_fixed:
                self.of_cameras, self.not_fixed = of_cameras, not_fixed
            self._fresh.clear()
            self._waited = 0

    def findings(self) -> tuple[HealthFinding, ...]:
        """Return what was found so far; nothing while all is well."""
        return self.not_fixed if self.of_cameras is None else (self.of_cameras, *self.not_fixed)

    def _decided(self) -> tuple[HealthFinding | None, tuple[HealthFinding, ...]]:
        """Return what the newest means of the bodies in view say of the cameras, and of bodies that are not fixed."""
        known = [self._landmarks[k] for k in sorted(self._fresh)]
        moved = [each for each in known if each.moved]
        if not moved:
            return None, ()
        most, names = max(moved, key=lambda each: each.shift_m), ", ".join(each.name for each in moved)
        some = f"fixed bod{'y' if len(moved) == 1 else 'ies'} {names}"
        if len(moved) < len(known):  # one that stands proves that the cameras do, if their motion would show in it
            if _common(known) is None:
                return None, tuple(_not_fixed(each) for each in moved)
            coarse = "the others are measured too coarsely to distinguish the two"
            return _finding(most, f"the cameras moved, or the {some}: {coarse}"), ()
        if len(known) == 1:
            return _finding(most, f"the cameras moved, or the {some}: with one alone the two look alike"), ()
        return self._all_moved(known, most, some)

    def _all_moved(
        self, known: list[_Landmark], most: _Landmark, some: str
    ) -> tuple[HealthFinding | None, tuple[HealthFinding, ...]]:
        """Return what it means that every body in view moved: the cameras did, or all but one of the bodies say so."""
        together = _common(known)
        if together is not None:
            self.cameras_moved, self._common = True, together
            return _cameras(together, known), ()
        without = [(each, _common([other for other in known if other is not each])) for each in known]
        agreed = [(each, common) for each, common in without if len(known) > 2 and common is not None]
        if len(agreed) == 1:
            self.cameras_moved = True
            odd, common = agreed[0]
            self._common = common
            return _cameras(common, [each for each in known if each is not odd]), (_not_fixed(odd),)
        what = (
            f"the {some} all moved, each by another motion: which are not fixed, or whether the cameras moved as well"
        )
        return _finding(most, f"{what}, cannot be distinguished"), ()


def _common(marks: Sequence[_Landmark]) -> tuple[Array, Array] | None:
    """Return the motion (6,) of the cameras that explains all bodies, and its covariance; None where none does."""
    motions, whites = zip(*(each.motion() for each in marks), strict=True)
    cov = np.linalg.inv(np.sum(whites, axis=0))
    m = cov @ np.sum([white @ motion for motion, white in zip(motions, whites, strict=True)], axis=0)
    chi_square = sum(float((each - m) @ white @ (each - m)) for each, white in zip(motions, whites, strict=True))
    return (m, cov) if len(marks) == 1 or chi_square < _limit(6 * (len(marks) - 1)) else None


def _agreed(last: tuple[Array, Array] | None, now: tuple[Array, Array] | None) -> tuple[Array, Array] | None:
    """Return the newer of two motions (6,) with covariance (6, 6) if they agree."""
    if last is None or now is None:
        return None
    return now if squares_of(now[0] - last[0], now[1] + last[1]) < _limit(6) else None


def _cameras(common: tuple[Array, Array], marks: Sequence[_Landmark]) -> HealthFinding:
    m, cov = common
    # At one depth both focal lengths that are longer by the same share look like a motion along the optical axis alone.
    across = np.array([0, 1, 3, 4, 5])
    along = squares_of(m[across], cov[np.ix_(across, across)]) < _ALONG and m[2] ** 2 > 4.0 * cov[2, 2]
    more = "; both focal lengths that changed alike look the same to the pair" if along else ""
    begins = [each.newest[2] for each in marks if each.newest is not None and each.newest[2] is not None]
    return make_finding(
        "together",
        sized(m[:3], cov[:3, :3]),
        min(begins) if begins else None,
        also=("lens",) if along else (),
        words={"angle_deg": np.degrees(np.linalg.norm(m[3:])), "count": len(marks), "more": more},
    )


def _not_fixed(mark: _Landmark) -> HealthFinding:
    what = f"the fixed body {mark.name} is not fixed: it moved by {1e3 * mark.shift_m:.2f} mm, others did not"
    return _finding(mark, what)


def _finding(mark: _Landmark, what: str) -> HealthFinding:
    """Return a finding that is sized by the motion of a body in view."""
    assert mark.newest is not None
    xi, cov, since_s = mark.newest
    return make_finding("not fixed", sized(xi[:3], cov[:3, :3]), since_s, words={"what": what})
