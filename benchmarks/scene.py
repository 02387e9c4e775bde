"""A camera that rotated or moved, seen in the background alone.

    python benchmarks/scene.py [--moved SEEDS] [--clean RUNS] [--first SEED]

Rooms of tests/loop/health/rooms.py: walls of texture at depths, half of them cluttered; all runs have people who walk by, a
screen that changes, a lamp switched on in mid-run or a shadow that wanders, and JPEG of quality 85. 5 looks a second.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / part) for part in ("", "loop/health")]

from rooms import RATE_HZ, STILL, Room  # noqa: E402

from armsight.loop.health.scene import SceneWatch  # noqa: E402

DEG = np.radians(1.0)
AT, LOOKS = 25, 15  # looks before a camera moves, and after
MOTIONS = {
    "0.02 deg about x": [0, 0, 0, 0.02 * DEG, 0, 0],
    "0.02 deg about y": [0, 0, 0, 0, 0.02 * DEG, 0],
    "0.02 deg about z": [0, 0, 0, 0, 0, 0.02 * DEG],
    "0.5 mm along x": [5e-4, 0, 0, 0, 0, 0],
    "0.5 mm along y": [0, 5e-4, 0, 0, 0, 0],
    "0.5 mm along z": [0, 0, 5e-4, 0, 0, 0],
}


def watched(seed: int, motion: np.ndarray, looks: int) -> tuple[SceneWatch, float | None, float]:
    """Watch a room whose left (even seeds) or right camera moves; return when it was said, s after, and ms a look."""
    room, moves = Room(seed), ("left", "right")[seed % 2]
    watch, said_s, took = SceneWatch(room.rig), None, []
    for k in range(AT + looks):
        lamp, sun = (0.3 * (k > 22), None) if seed % 3 else (0.0, 0.2 + 0.01 * k)
        given = {moves: motion} if k >= AT else {}
        shot = room.shot(k, **given, lamp=lamp, sun=sun, people=True, quality=85)
        began = time.process_time()
        watch.take(shot, k / RATE_HZ)
        took.append(time.process_time() - began)
        if watch.findings() and said_s is None:
            said_s = (k - AT) / RATE_HZ
    return watch, said_s, 1e3 * float(np.median(took[AT:]))


def clean(runs: int, first: int) -> None:
    """Count findings of cameras that stand still, in runs of 90 s."""
    false = []
    for seed in range(first, first + runs):
        watch, _, _ = watched(seed, STILL, 450 - AT)
        false += [(seed, each.what) for each in watch.findings()]
    print(f"{runs} runs of 90 s, nothing moved: {len(false)} with a finding (0 asked) {false}", flush=True)


def moved(seeds: int, first: int) -> None:
    """Print how cameras that moved were named."""
    print(f"{'the camera moves by':20s} {'named':>7s} {'which':>7s} {'worst, s':>9s} {'size, sigmas':>13s}")
    for name, xi in MOTIONS.items():
        said, right, late, sigmas = 0, 0, [], []
        for seed in range(first, first + seeds):
            watch, said_s, _ = watched(seed, np.array(xi), LOOKS)
            if said_s is None:
                continue
            (found,) = watch.findings()
            true = 0.02 if "deg" in name else 0.5
            said, late = said + 1, [*late, said_s]
            right += f"the {('left', 'right')[seed % 2]} camera" in found.what and "did not" in found.what
            if found.unit == name.split()[1]:
                sigmas.append((found.size - true) / found.sigma)
        worst = f"{max(late):.1f}" if late else "-"
        spread = f"{min(sigmas):.1f} to {max(sigmas):.1f}" if sigmas else "-"
        print(f"{name:20s} {said:4d}/{seeds:<2d} {right:4d}/{seeds:<2d} {worst:>9s} {spread:>13s}", flush=True)


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clean", type=int, default=100)
    parser.add_argument("--moved", type=int, default=6)
    parser.add_argument("--first", type=int, default=500)
    given = parser.parse_args()
    moved(given.moved, given.first)
    clean(given.clean, given.first)
    print(f"{watched(given.first, STILL, LOOKS)[2]:.1f} ms a look at two images of 640x360")


if __name__ == "__main__":
    main()
