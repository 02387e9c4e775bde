"""Delay and skew by the sync LED: errors and their share of the claimed sigma, on drawn brightness of two cameras.

    python benchmarks/sync_led.py [--seed 9201] [--count 60]

Each estimate is of 3 s at the camera's rate; 3% of the shots are lost, periods are off by 30 ppm. Delays and skews are
drawn.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from armsight.data import Missed
from armsight.loop.sync_led import Brightness, SyncEstimate, estimate_sync, light

BIT_S, AMPLITUDE, SECONDS = 0.003, 150.0, 3.0


@dataclass(frozen=True)
class Case:
    """Two cameras: rate, exposure, jitter of the stamps and of the right exposure, s; noise, grey levels; tone; lamp."""

    name: str
    rate_hz: float
    exposure_s: float
    jitter_s: float
    sync_s: float
    noise: float = 0.6
    gamma: float = 1.0
    lamp: float = 0.0


CASES = (
    Case("60 Hz, 2 ms", 60, 0.002, 5e-5, 1e-4),
    Case("30 Hz, 8 ms, stamps ± 1 ms, pairs ± 0.5 ms", 30, 0.008, 1e-3, 5e-4),
    Case("30 Hz, 30 ms, likewise", 30, 0.030, 1e-3, 5e-4),
    Case("50 Hz, 5 ms, gamma 0.5", 50, 0.005, 3e-4, 1e-4, gamma=0.5),
    Case("30 Hz, 15 ms, lamp of 100 Hz", 30, 0.015, 1e-3, 0.0, lamp=0.03),
    Case("60 Hz, 1 ms", 60, 0.001, 5e-5, 1e-4),
)


def estimated(case: Case, rng: np.random.Generator) -> tuple[SyncEstimate | Missed, float, float]:
    """Return an estimate, the true delay and the true skew, s."""
    count = round(SECONDS * case.rate_hz)
    delay_s, skew_s = rng.uniform(0.005, 0.1), rng.uniform(-0.02, 0.02)
    left = rng.uniform(0.0, 100.0) + np.arange(count) / case.rate_hz * (1 + rng.normal(0, 3e-5))
    right = left + skew_s + rng.uniform(-case.sync_s, case.sync_s, count)
    stamp_s, kept = left + delay_s + rng.normal(0, case.jitter_s, count), rng.random(count) > 0.03
    seen = []
    for t_s in (left, right):
        shine = case.lamp * np.sin(2 * np.pi * 100 * t_s)
        led = 20 + AMPLITUDE * (light(t_s, case.exposure_s, BIT_S) ** case.gamma + shine)
        led, around = led + rng.normal(0, case.noise, count), 40 * (1 + shine) + rng.normal(0, 0.1, count)
        seen.append(Brightness(stamp_s[kept], led[kept], around[kept]))
    return estimate_sync(seen[0], seen[1], BIT_S), delay_s, skew_s


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=9201)
    parser.add_argument("--count", type=int, default=60)
    given = parser.parse_args()
    print("| cameras | delay, RMS; at most; sigma | skew, RMS; at most; sigma | none |\n|---|---|---|---|")
    for n, case in enumerate(CASES):
        found = [estimated(case, np.random.default_rng([given.seed, n, k])) for k in range(given.count)]
        good = [(e, d, s) for e, d, s in found if isinstance(e, SyncEstimate)]
        cells = []
        for error, sigma in (
            ([e.delay_s - d for e, d, _ in good], [e.sigma_delay_s for e, _, _ in good]),
            ([e.skew_s - s for e, _, s in good], [e.sigma_skew_s for e, _, s in good]),
        ):
            off = 1e3 * np.array(error)
            share = np.sqrt(np.mean((off / 1e3 / np.array(sigma)) ** 2))
            cells.append(f"{np.sqrt(np.mean(off**2)):.3f}; {np.abs(off).max():.3f} ms; {share:.2f}" if len(off) else "")
        print(f"| {case.name} | {cells[0]} | {cells[1]} | {len(found) - len(good)} of {len(found)} |", flush=True)


if __name__ == "__main__":
    main()
