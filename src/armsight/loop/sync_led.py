"""When cameras exposed, on the board's clock, from the brightness of an LED that blinks a code of that clock.

In: the brightness of the LED in the images of one camera, with the images' stamps. Out: the time of each exposure's middle,
the length of the exposures, and the camera's period, with covariance; of two cameras: delay of the stamps, skew and rate.

The LED's code is a maximum-length sequence of 511 bits (Golomb, "Shift Register Sequences", 1967), each ``bit_s`` long: its
edges are at ticks of the board. An exposure of length T about time t gathers the share

    x = (C(t + T/2) - C(t - T/2)) / T,   dC/dt = 1 while the LED is on, else 0,

of the LED's light, and dx/dt = +-1/T wherever an edge of the code is within it. So the brightness of single images, with a
noise of 1% of the LED's, gives t to 1% of T; the sequence of many gives which bits they were. Exposures of a camera follow
each other by its period: t = t0 + n period, with a jitter. The response of the camera to light is a cubic (tone curves);
the light of the image before (temporal filters of webcams) and what is around the LED (lamps) are regressors. Search over
delay and exposure by correlation; then Gauss-Newton with the response projected out (Golub and Pereyra, "The
differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate", 1973), weights by a noise
of the brightness and a jitter of the exposures that are estimated from the residuals, and Tukey's weights against what
hides the LED.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from armsight.data import Array, Missed, Record, Shot
from armsight.errors import InputError
from armsight.loop.estimators import Delay
from armsight.loop.finding import HealthFinding, make_finding
from armsight.vision.blinking import Spot, block_means, candidates, spot, window
from armsight.vision.rig import Shutters

#: Bits of the code, and the feedback of the register that makes it: ``firmware/core/sync_led.h``.
BITS, _FEEDBACK = 511, 4
#: Delays of the stamps that are tried, s, as in :mod:`armsight.loop.delay`; exposures that are tried, s.
_LAGS_S, _EXPOSURES_S = (-0.1, 0.6), (2e-4, 0.05)
_EXPOSURE_STEPS = 12
#: Fewest images for an estimate, and for finding the code; share of brightness it must explain (chance: 1e-9).
LEAST, LEAST_FOUND, _EXPLAINED = 24, 40, 0.6
#: Powers of the share of light in the response, passes with new weights, steps, beginnings that are followed.
_POWERS, _PASSES, _STEPS, _STARTS = 3, 4, 12, 3
#: Tukey's weights are zero beyond so many sigma; with more than this share of images there, the LED was hidden.
_TUKEY, _HIDDEN = 6.0, 0.3
#: Fewest images with an edge of the code: the others say nothing of the time.
_EDGES = 16
#: So short an exposure, over a bit of the code, that the edges within exposures are few.
_SHORT = 0.25
#: How well the LED's edges are at the board's ticks: interrupts that come before, s.
_EDGE_S = 1e-5
#: Stamps that scatter by more than this share of the period do not count images.
_COUNTABLE = 0.2
#: A batch of stamps, as many in a window: their means are independent where single stamps are smoothed.
_BATCHES = 6


def code() -> Array:
    """Return the LED's code, (511,) of 0 and 1, bit 0 begins at tick 0 of the board."""
    bits = [1] * 9
    while len(bits) < BITS:
        bits.append(bits[-9] ^ bits[-9 + _FEEDBACK])
    return np.array(bits, dtype=float)


_CODE = code()
_SUM = np.concatenate([[0.0], np.cumsum(_CODE)])


def _on(t_bits: Array) -> Array:
    """Return whether the LED is on at times in bits since tick 0."""
    return np.asarray(_CODE[np.floor(t_bits).astype(np.int64) % BITS])


def _on_time(t_bits: Array) -> Array:
    """Return how long the LED was on since tick 0 until times in bits."""
    whole = np.floor(t_bits).astype(np.int64)
    rounds, bit = np.divmod(whole, BITS)
    return np.asarray(_SUM[BITS] * rounds + _SUM[bit] + _CODE[bit] * (t_bits - whole))


def light(t_s: Array, exposure_s: float | Array, bit_s: float) -> Array:
    """Return the share of the LED's light that exposures about times t_s gather, 0 to 1.

    Args:
        t_s: middle of each exposure, board's clock, s.
        exposure_s: how long they are, s.
        bit_s: how long each bit of the code lasts, s.
    """
    half = np.asarray(exposure_s) / 2
    return np.asarray((_on_time((t_s + half) / bit_s) - _on_time((t_s - half) / bit_s)) * bit_s / (2 * half))


@dataclass(frozen=True, eq=False)
class Brightness(Record):
    """An LED in the images of one camera."""

    stamp_s: Array  #: (N,) stamps of the images, board's clock, s, rising
    led: Array  #: (N,) brightness of the LED, grey levels
    around: Array  #: (N,) brightness around it

    def __post_init__(self) -> None:
        """Check that the stamps rise."""
        super().__post_init__()
        if (np.diff(self.stamp_s) <= 0).any():
            raise InputError("the stamps of images must rise")


@dataclass(frozen=True, eq=False)
class Exposures(Record):
    """When one camera exposed the row in which the LED is."""

    n: Array  #: (N,) numbers of the images, counted by the period, 0 in the middle
    t_s: float  #: middle of exposure 0, board's clock, s
    period_s: float  #: from one exposure to the next, s
    exposure_s: float
    cov: Array  #: (3, 3) covariance of the three, s^2
    jitter_s: float  #: standard deviation of the exposures about their period, s
    contrast: float  #: sigma of the brightness that the code does not explain, over the LED's
    hidden: float  #: share of the images in which the LED was hidden


class _CodeFit(NamedTuple):
    """A fit: parameters (t, period, exposure), s; residuals (N,), the model's slope by time (N,), weights, cost."""

    theta: Array
    residual: Array
    slope: Array
    jacobian: Array
    amplitude: float
    cost: float


def numbered(stamp_s: Array) -> tuple[Array, float, float] | Missed:
    """Count images by their stamps: numbers (N,), 0 in the middle, the time of number 0 and the period by the stamps, s."""
    if len(stamp_s) < LEAST:
        return Missed(f"the LED was seen in {len(stamp_s)} images, {LEAST} at least are needed")
    apart = np.diff(stamp_s)
    period = float(np.median(apart))
    for _ in range(2):
        n = np.concatenate([[0.0], np.cumsum(np.maximum(np.round(apart / period), 1.0))])
        period, t0 = (float(value) for value in np.polyfit(n, stamp_s, 1))
    scatter = float(np.std(stamp_s - t0 - n * period))
    if scatter > _COUNTABLE * period:
        return Missed(
            f"the stamps scatter by {1e3 * scatter:.1f} ms about the camera's period: it has no constant rate"
        )
    middle = np.round(n.mean())
    return n - middle, t0 + middle * period, period


def find_exposures(seen: Brightness, bit_s: float, *, near: tuple[float, float] | None = None) -> Exposures | Missed:
    """Find when a camera exposed.

    Args:
        seen: the LED in its images.
        bit_s: how long each bit of the code lasts, s.
        near: delay of the stamps and exposure of an earlier estimate, s; without, all are tried.

    Returns:
        The exposures; or why they cannot be found: too few images, no code, the LED hidden.
    """
    counted = numbered(seen.stamp_s)
    if isinstance(counted, Missed):
        return counted
    n, stamp_s, period_s = counted
    if near is None:
        started = _search(seen, n, stamp_s, period_s, bit_s)
        if isinstance(started, Missed):
            return started
        near = started
    starts = [
        np.array([stamp_s - near[0] + off * bit_s, period_s, near[1] * factor])
        for off in (-0.2, 0.0, 0.2)
        for factor in (0.85, 1.0, 1.18)
    ]
    flat = np.ones(len(n))
    starts.sort(key=lambda start: _evaluated(seen, n, start, bit_s, flat).cost)
    fits = [_fitted(seen, n, start, bit_s, flat) for start in starts[:_STARTS]]
    fit = min(fits, key=lambda each: each.cost)
    noise, jitter, sigma, tukey = 0.0, 0.0, flat, flat
    for _ in range(_PASSES):
        noise, jitter = _noises(fit.residual, fit.slope)
        sigma = np.sqrt(noise**2 + (fit.slope * jitter) ** 2)
        tukey = np.clip(1.0 - (fit.residual / (_TUKEY * sigma)) ** 2, 0.0, None)
        fit = _fitted(seen, n, fit.theta, bit_s, tukey / sigma)
    hidden = float(np.mean(np.abs(fit.residual) > _TUKEY * sigma))
    if hidden > _HIDDEN or noise > (1.0 - _EXPLAINED) * abs(fit.amplitude):
        return Missed(f"what is seen where the LED was does not blink its code in {100 * hidden:.0f} % of the images")
    J = fit.jacobian
    H, weighted = J.T @ J, fit.residual * tukey / sigma
    edges = int(np.sum((fit.slope != 0) & (tukey > 0)))
    if (
        edges < _EDGES
        or fit.theta[2] < _SHORT * bit_s
        or np.linalg.cond(H / np.sqrt(np.outer(np.diag(H), np.diag(H)))) > 1e10
    ):
        return Missed(
            f"edges of the LED's code fall into {edges} of {len(n)} exposures, {_EDGES} at least are needed: set"
            f" sync_led_ticks to about the exposure, {1e3 * fit.theta[2]:.1f} ms"
        )
    freedom = max(len(n) * (1.0 - hidden) - len(fit.theta) - _POWERS - 3, 1.0)
    birge = max(float(weighted @ weighted) / freedom, 1.0)
    return Exposures(
        n,
        float(fit.theta[0]),
        float(fit.theta[1]),
        float(fit.theta[2]),
        np.asarray(birge * np.linalg.inv(H), dtype=np.float64),
        jitter,
        noise / abs(fit.amplitude),
        hidden,
    )


def _search(seen: Brightness, n: Array, stamp_s: float, period_s: float, bit_s: float) -> tuple[float, float] | Missed:
    if len(n) < LEAST_FOUND:
        return Missed(f"the LED was seen in {len(n)} images, {LEAST_FOUND} at least are needed to find its code")
    known = np.column_stack([np.ones(len(n)), seen.around - seen.around.mean()])
    basis = np.linalg.qr(known)[0][:, : 1 + (np.ptp(seen.around) > 0)]
    led = seen.led - basis @ (basis.T @ seen.led)
    lags = np.arange(*_LAGS_S, bit_s / 3)
    exposures = np.geomspace(_EXPOSURES_S[0], min(_EXPOSURES_S[1], 1.1 * period_s), _EXPOSURE_STEPS)
    best = (-1.0, 0.0, 0.0)
    for exposure in exposures:
        x = light(stamp_s + n * period_s - lags[:, None], exposure, bit_s)
        x -= (x @ basis) @ basis.T
        r = (x @ led) / np.sqrt(np.maximum((x * x).sum(axis=1) * float(led @ led), 1e-300))
        k = int(np.argmax(r))
        best = max(best, (float(r[k]), float(lags[k]), float(exposure)))
    if best[0] <= 0 or best[0] ** 2 < _EXPLAINED:
        return Missed(f"the LED's code explains {100 * max(best[0], 0.0) ** 2:.0f} % of the blinking")
    return best[1], best[2]


def _fitted(seen: Brightness, n: Array, theta: Array, bit_s: float, weights: Array) -> _CodeFit:
    """Return a weighted fit by Gauss-Newton with a damped step, from theta (3,)."""
    found, damping = _evaluated(seen, n, theta, bit_s, weights), 1e-3
    for _ in range(_STEPS):
        H, score = found.jacobian.T @ found.jacobian, found.jacobian.T @ (found.residual * weights)
        step = np.linalg.lstsq(H + damping * np.diag(np.diag(H)), score, rcond=None)[0]
        step[0] = np.clip(step[0], -0.3 * bit_s, 0.3 * bit_s)
        step[2] = np.clip(step[2], -0.3 * found.theta[2], 0.3 * found.theta[2])
        tried = _evaluated(seen, n, found.theta + step, bit_s, weights)
        if tried.cost < found.cost:
            gain = found.cost - tried.cost
            found, damping = tried, max(damping / 5, 1e-9)
            if gain < 1e-9 * found.cost:
                break
        else:
            damping = 10 * damping
            if damping > 1e4:
                break
    return found


def _evaluated(seen: Brightness, n: Array, theta: Array, bit_s: float, weights: Array) -> _CodeFit:
    """Return the model at theta, its response to light the best by least squares."""
    t, exposure = theta[0] + n * theta[1], theta[2]
    x = light(t, exposure, bit_s)
    after, before = _on((t + exposure / 2) / bit_s), _on((t - exposure / 2) / bit_s)
    by_t, by_exposure = (after - before) / exposure, ((after + before) / 2 - x) / exposure
    columns = [np.ones(len(x)), *(x**k for k in range(1, _POWERS + 1))]
    columns.append(light(t - theta[1], exposure, bit_s))
    if np.ptp(seen.around) > 0:
        columns.append(seen.around - seen.around.mean())
    X = np.column_stack(columns)
    U, s, Vt = np.linalg.svd(X * weights[:, None], full_matrices=False)
    held = s > 1e-9 * s[0]
    U = U[:, held]
    c = Vt[held].T @ ((U.T @ (seen.led * weights)) / s[held])
    residual = seen.led - X @ c
    rise = sum((k * c[k] * x ** (k - 1) for k in range(1, _POWERS + 1)), np.zeros(len(x)))
    slope = rise * by_t
    J = np.column_stack([slope, slope * n, rise * by_exposure]) * weights[:, None]
    J = J - U @ (U.T @ J)
    cost = float(np.square(residual * weights).sum())
    return _CodeFit(np.asarray(theta), residual, slope, J, float(c[1 : _POWERS + 1].sum()), cost)


def _noises(residual: Array, slope: Array) -> tuple[float, float]:
    """Return the noise of the brightness and the jitter of the exposures, s, by likelihood over a grid of their ratio."""
    scale = np.median(np.abs(residual)) / 0.6745 + 1e-12
    r = np.clip(residual, -4 * scale - np.abs(slope) * 1e-3, 4 * scale + np.abs(slope) * 1e-3)
    jitters = np.concatenate([[0.0], np.geomspace(2e-6, 2e-3, 31)])
    noises = scale * np.geomspace(0.05, 3.0, 25)
    v = noises[:, None] ** 2 + (slope * jitters[:, None])[:, None] ** 2
    cost = (r * r / v + np.log(v)).sum(axis=2)
    jitter, noise = np.unravel_index(np.argmin(cost), cost.shape)
    return float(noises[noise]), float(jitters[jitter])


@dataclass(frozen=True, eq=False)
class SyncEstimate(Record):
    """What the LED says of two cameras."""

    t_s: float  #: middle of the images it is of, board's clock, s
    delay_s: float  #: by how much stamps are later than the left exposure's middle, in the LED's row, s
    sigma_delay_s: float  #: its standard deviation
    skew_s: float  #: by how much the right camera exposes its LED's row later than the left one its own, s
    sigma_skew_s: float  #: its standard deviation
    jitter_s: float  #: standard deviation of the skew from shot to shot, s
    left: Exposures
    right: Exposures


def estimate_sync(
    left: Brightness, right: Brightness, bit_s: float, *, near: SyncEstimate | None = None
) -> SyncEstimate | Missed:
    """Estimate delay and skew from the LED's brightness in the same shots of two cameras.

    Args:
        left: in the left images.
        right: in the right ones, with the same stamps.
        bit_s: how long each bit of the code lasts, s.
        near: an earlier estimate.

    Returns:
        The estimate, or why there is none; the text begins with the camera.
    """
    if not np.array_equal(left.stamp_s, right.stamp_s):
        raise InputError("both cameras' brightness must be of the same shots")
    found = []
    for side, seen in (("left", left), ("right", right)):
        start = None
        if near is not None:
            start = (near.delay_s - (near.skew_s if side == "right" else 0.0), getattr(near, side).exposure_s)
        exposures = find_exposures(seen, bit_s, near=start)
        if isinstance(exposures, Missed):
            return Missed(f"{side} camera: {exposures.reason}")
        found.append(exposures)
    ours, theirs = found
    late = left.stamp_s - ours.t_s - ours.n * ours.period_s
    means = np.array([part.mean() for part in np.array_split(late, _BATCHES)])
    scatter = float(np.var(means - np.polyval(np.polyfit(range(_BATCHES), means, 1), range(_BATCHES)), ddof=2))
    return SyncEstimate(
        float(left.stamp_s.mean() - late.mean()),
        float(late.mean()),
        math.sqrt(float(ours.cov[0, 0]) + max(scatter / _BATCHES, float(np.var(late)) / len(late))),
        theirs.t_s - ours.t_s,
        math.sqrt(float(ours.cov[0, 0] + theirs.cov[0, 0])),
        math.hypot(ours.jitter_s, theirs.jitter_s),
        ours,
        theirs,
    )


#: Shots in which what blinks is looked for, then looked at; seconds and fewest shots of an estimate.
_SEARCH_SHOTS, _LOOK_SHOTS, _WINDOW_S, _WINDOW_SHOTS = 48, 72, 2.0, 48
#: Windows without the LED after which it is looked for anew: the cameras may have moved.
_LOST = 4
#: Estimates so recent, s, are pooled: clocks drift by a few ppm.
_POOLED_S = 30.0
#: Sigmas and seconds beyond which delay and skew changed; and by which a sweep, blind to 1 ms of friction, contradicts.
_CHANGED, _CHANGED_S, _APART_S = 5.0, 3e-4, 1.5e-3

_SIDES = ("left", "right")
#: A smaller skew is none, s.
_SIMULTANEOUS_S = 5e-5
#: The stamps of shots, and of each what was kept of both images.
_Batch: TypeAlias = list[tuple[float, tuple[Any, Any]]]


class SyncLedWatch:
    """Finds the LED in the images of two cameras, and follows the cameras' clock by it.

    Args:
        bit_s: how long each bit of the LED's code lasts, s.

    Attributes:
        tried: how many windows and searches there were.
        reading: by how much a reading of a joint is older than its stamp, and its sigma, s.
    """

    def __init__(self, bit_s: float, reading: tuple[float, float] = (0.0, 0.0)) -> None:
        self._bit_s, self.reading = bit_s, reading
        #: the delay that a sweep of the arm found less that of the LED, its sigma, and when it was found, s; None
        #: before
        self.apart: tuple[float, float, float] | None = None
        self.estimates: list[SyncEstimate] = []  #: what it said, window by window
        #: why there is no estimate of the newest window; None where there is one, or nothing was tried yet
        self.reason: str | None = None
        self.tried = self._lost = 0
        #: (2,) the LED's row in both images, -1/2 at the top to 1/2 at the bottom; None before it was found
        self.row_shares: Array | None = None
        self._height = 1
        self._busy = False
        self._corners: tuple[list[tuple[int, int]], ...] = ()
        self._spots: tuple[Spot, ...] = ()
        self._gathered: list[tuple[float, tuple[Any, Any]]] = []

    def take(self, shot: Shot) -> Callable[[], None] | None:
        """Look at the LED in a shot; return what is to be computed now and then, for a thread: nothing waits for it."""
        if self._busy or shot.t_s is None or shot.left is None or shot.right is None:
            return None
        if self._gathered and shot.t_s <= self._gathered[-1][0]:
            return None
        images = shot.left, shot.right
        self._height = shot.left.shape[0]
        seen: tuple[Any, ...]
        if self._spots:
            seen = tuple(spot.brightness(image) for spot, image in zip(self._spots, images, strict=True))
        elif self._corners:
            seen = tuple(
                np.array([window(image, corner) for corner in corners])
                for image, corners in zip(images, self._corners, strict=True)
            )
        else:
            seen = tuple(block_means(image) for image in images)
        self._gathered.append((shot.t_s, (seen[0], seen[1])))
        over = len(self._gathered) >= (_LOOK_SHOTS if self._corners else _SEARCH_SHOTS)
        if self._spots:
            over = len(self._gathered) >= _WINDOW_SHOTS and shot.t_s - self._gathered[0][0] >= _WINDOW_S
        if not over:
            return None
        batch, self._gathered, self._busy = self._gathered, [], True
        work = self._follow if self._spots else self._identify if self._corners else self._search
        return lambda: self._done(work, batch)

    def _done(self, work: Callable[[_Batch], str | None], batch: _Batch) -> None:
        try:
            self.reason = work(batch)
        finally:
            self.tried += 1
            self._busy = False

    def _search(self, batch: _Batch) -> str | None:
        corners = tuple(candidates(np.array([seen[side] for _, seen in batch])) for side in range(2))
        for side, found in zip(_SIDES, corners, strict=True):
            if not found:
                return f"{side} camera: nothing blinks in its images"
        self._corners = corners
        return None

    def _identify(self, batch: _Batch) -> str | None:
        stamp_s, chosen = np.array([t for t, _ in batch]), list[tuple[Spot, Brightness]]()
        corners, self._corners = self._corners, ()
        for side, name in enumerate(_SIDES):
            best: tuple[float, Spot, Brightness] | None = None
            reasons = []
            for k, corner in enumerate(corners[side]):
                pixels = np.array([seen[side][k] for _, seen in batch])
                looked = spot(pixels, corner)
                if isinstance(looked, Missed):
                    reasons.append(looked.reason)
                    continue
                led, around = (np.tensordot(pixels, w, ((1, 2), (0, 1))) for w in (looked.weights, looked.around))
                brightness = Brightness(stamp_s, led, around)
                exposures = find_exposures(brightness, self._bit_s)
                if isinstance(exposures, Missed):
                    reasons.append(f"what blinks at {looked.uv[0]:.0f}, {looked.uv[1]:.0f} px: {exposures.reason}")
                    reasons[-1] += _lamp(brightness)
                elif best is None or exposures.contrast < best[0]:
                    best = exposures.contrast, looked, brightness
            if best is None:
                return f"{name} camera: {next((r for r in reasons if 'saturated' in r), reasons[0])}"
            chosen.append(best[1:])
        found = estimate_sync(chosen[0][1], chosen[1][1], self._bit_s)
        if isinstance(found, Missed):
            return found.reason
        self._spots = tuple(each for each, _ in chosen)
        self.row_shares = np.array([(each.uv[1] + 0.5) / self._height - 0.5 for each in self._spots])
        self.estimates.append(found)
        return None

    def _follow(self, batch: _Batch) -> str | None:
        stamp_s = np.array([t for t, _ in batch])
        left, right = (Brightness(stamp_s, *np.array([seen[side] for _, seen in batch]).T) for side in range(2))
        found = estimate_sync(left, right, self._bit_s, near=self.estimates[-1])
        if isinstance(found, Missed):  # the clock may have jumped
            found = estimate_sync(left, right, self._bit_s)
        self._lost = self._lost + 1 if isinstance(found, Missed) else 0
        if isinstance(found, Missed):
            if self._lost >= _LOST:
                self._spots, self._lost = (), 0
            return found.reason
        self.estimates.append(found)
        return None

    def pooled(self) -> SyncEstimate | None:
        """Return the mean of the estimates of late, as of the newest's time; None before there is one."""
        if not self.estimates:
            return None
        newest = self.estimates[-1]
        late = [each for each in self.estimates if newest.t_s - each.t_s <= _POOLED_S]
        delay, sigma_delay = _mean([(each.delay_s, each.sigma_delay_s) for each in late])
        skew, sigma_skew = _mean([(each.skew_s, each.sigma_skew_s) for each in late])
        jitter = math.sqrt(sum(each.jitter_s**2 for each in late) / len(late))
        return replace(
            newest,
            delay_s=delay,
            sigma_delay_s=math.hypot(sigma_delay, _EDGE_S),
            skew_s=skew,
            sigma_skew_s=sigma_skew,
            jitter_s=jitter,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the object of summary.json: the estimate of late, the rate, how many windows there were."""
        rate, newest = self.rate(), self.pooled()
        found: dict[str, Any] = {"windows": len(self.estimates), "missed": self.reason}
        if newest is not None:
            found |= {
                "delay_s": {"value": newest.delay_s, "sigma": newest.sigma_delay_s},
                "skew_s": {"value": newest.skew_s, "sigma": newest.sigma_skew_s},
                "jitter_s": newest.jitter_s,
                "exposure_s": [newest.left.exposure_s, newest.right.exposure_s],
            }
        if rate is not None:
            found["rate"] = {"value": rate[0], "sigma": rate[1]}
        return found

    def __str__(self) -> str:
        """Return what the LED says as a line for people."""
        rate, newest = self.rate(), self.pooled()
        if newest is None:
            return f"sync LED: not seen: {self.reason}"
        gains = "" if rate is None else f", the stamps gain {1e6 * rate[0]:.1f} ± {1e6 * rate[1]:.1f} ppm"
        return (
            f"sync LED, in its row: delay {1e3 * newest.delay_s:.3f} ± {1e3 * newest.sigma_delay_s:.3f} ms, skew"
            f" {1e3 * newest.skew_s:.3f} ± {1e3 * newest.sigma_skew_s:.3f} ms, exposures"
            f" {1e3 * newest.left.exposure_s:.2f} and {1e3 * newest.right.exposure_s:.2f} ms{gains};"
            f" {len(self.estimates)} windows" + ("" if self.reason is None else f"; at the end: {self.reason}")
        )

    def rate(self) -> tuple[float, float] | None:
        """Return how fast the stamps gain on the board's clock, s/s, and its sigma; None with fewer than three windows."""
        if len(self.estimates) < 3:
            return None
        t = np.array([each.t_s for each in self.estimates])
        y = np.array([each.delay_s for each in self.estimates])
        w = 1.0 / np.array([each.sigma_delay_s for each in self.estimates])
        X = np.column_stack([np.ones(len(t)), t - t.mean()]) * w[:, None]
        theta = np.linalg.lstsq(X, y * w, rcond=None)[0]
        left = y * w - X @ theta
        birge = max(float(left @ left) / (len(t) - 2), 1.0)
        return float(theta[1]), math.sqrt(birge * float(np.linalg.inv(X.T @ X)[1, 1]))


def _mean(values: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the weighted mean of values with sigmas, and its sigma: larger where they scatter more (Birge)."""
    x, sigma = np.array(values).T
    w = 1.0 / sigma**2
    mean = float(w @ x / w.sum())
    birge = max(float(w @ (x - mean) ** 2) / max(len(x) - 1, 1), 1.0)
    return mean, math.sqrt(birge / float(w.sum()))


def _lamp(seen: Brightness) -> str:
    """Return words for a brightness that is a sine of time: a lamp on the mains, a display; nothing where it is none."""
    t, led = seen.stamp_s - seen.stamp_s[0], seen.led - seen.led.mean()
    hz = np.arange(0.25, 0.5 / float(np.median(np.diff(t))), 0.25 / float(t[-1]))
    waves = np.exp(2j * math.pi * hz[:, None] * t) / math.sqrt(len(t) / 2)
    share = np.abs(waves @ led) ** 2 / max(float(led @ led), 1e-12)
    best = int(np.argmax(share))
    return (
        f"; it flickers by itself at {hz[best]:.1f} Hz, as images show it: a lamp?" if share[best] > _EXPLAINED else ""
    )


def with_led(
    delay: Delay,
    shutters: Shutters | None,
    found: SyncEstimate,
    row_shares: Array,
    reading: tuple[float, float] = (0.0, 0.0),
) -> tuple[Delay, Shutters | None]:
    """Combine what a sweep of the arm found with what the LED says.

    Args:
        delay: of the stamps, by the sweep; its jitter is kept.
        shutters: by the sweep, or of the rig; None where the cameras seemed to expose at one time.
        found: by the LED, in its rows.
        row_shares: (2,) these rows, -1/2 at the top to 1/2 at the bottom.
        reading: by how much a reading of a joint is older than its stamp, and its sigma, s.

    Returns:
        The delay of the middle row of the left camera against the readings of the joints, and the shutters: None where the
        LED sees no skew either.
    """
    left, right = row_shares
    late_s, sigma_late_s = found.delay_s - reading[0], math.hypot(found.sigma_delay_s, reading[1])
    if shutters is None:
        cov = np.diag([found.sigma_skew_s**2, 0.0])
        apart = max(_CHANGED * found.sigma_skew_s, _SIMULTANEOUS_S)
        both = None if abs(found.skew_s) < apart else Shutters(found.skew_s, 0.0, cov, found.jitter_s)
        return Delay(late_s, sigma_late_s, delay.jitter_s), both
    x, P, H = np.array([shutters.skew_s, shutters.readout_s]), shutters.cov, np.array([1.0, right - left])
    gain = P @ H / float(H @ P @ H + found.sigma_skew_s**2)
    x, P = x + gain * (found.skew_s - float(H @ x)), P - np.outer(gain, H @ P)
    both = Shutters(float(x[0]), max(float(x[1]), 0.0), (P + P.T) / 2, found.jitter_s)
    sigma_s = math.hypot(sigma_late_s, float(left) * math.sqrt(float(P[1, 1])))
    return Delay(late_s + float(left) * both.readout_s, sigma_s, delay.jitter_s), both


def led_findings(watch: SyncLedWatch) -> tuple[HealthFinding, ...]:
    """Return by how much delay or skew have changed since the LED was found, or differ from the sweep's; else nothing."""
    found = list[HealthFinding]()
    if watch.apart is not None and abs(watch.apart[0]) > max(_CHANGED * watch.apart[1], _APART_S):
        apart_s, sigma_s, t_s = watch.apart
        found.append(make_finding("swept apart", (apart_s, sigma_s), t_s))
    if len(watch.estimates) < 2:
        return tuple(found)
    first = watch.estimates[0]
    for what, value, sigma in (
        ("the images come", "delay_s", "sigma_delay_s"),
        ("the right camera exposes", "skew_s", "sigma_skew_s"),
    ):
        changes = [
            (
                each.t_s,
                getattr(each, value) - getattr(first, value),
                math.hypot(getattr(each, sigma), getattr(first, sigma)),
            )
            for each in watch.estimates[1:]
        ]
        changed = [each for each in changes if abs(each[1]) > max(_CHANGED * each[2], _CHANGED_S)]
        if not changed:
            continue
        since_s, (_, size, sigma_s) = changed[0][0], changes[-1]
        found.append(make_finding("led", (size, sigma_s), since_s, words={"what": what}))
    return tuple(found)
