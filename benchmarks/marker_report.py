"""What the sections of markers.py share: what is printed and kept, what armsight has so far, and cold frames to time on."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numba
import numpy as np

from armsight import open_target
from armsight.data import Body
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.marker import Target

HD = (1280, 720)


@dataclass
class Report:
    """What has been found, to print at once and to hand out as JSON at the end."""

    found: dict = field(default_factory=dict)

    def say(self, text: str) -> None:
        print(text, flush=True)

    def metric(
        self,
        name: str,
        value: float,
        required: str = "",
        *,
        form: str = ".3f",
        unit: str = "",
        good: bool | None = None,
    ) -> None:
        """Print a metric, what is required of it and whether it is so; keep it."""
        mark = "" if good is None else "  yes" if good else "  NO"
        beside = f"   (required {required}{mark})" if required else ""
        self.say(f"  {name:62s} {value:{form}}{' ' + unit if unit else ''}{beside}")
        self.found[name] = {
            "value": float(value),
            "unit": unit,
            "required": required,
            "good": None if good is None else bool(good),
        }


def disc_target(bright: bool = True, radius_m: float = 0.008, count: int = 3) -> DiscTarget:
    """Return a plate 110 mm wide and 85 mm high of three discs, P3 below, or of four."""
    points = np.array([[-0.055, 0.0, 0.0], [0.055, 0.0, 0.0], [0.0, 0.085, 0.0], [-0.035, 0.06, 0.0]])[:count]
    body = Body("plate", ("P1", "P2", "P3", "P4")[:count], points)
    return DiscTarget(body, np.full(count, radius_m), np.full(count, bright), np.tile([0.0, 0.0, -1.0], (count, 1)))


def opened(target: DiscTarget) -> Target:
    """Return what ``measure`` takes: the same plate by way of a body file, as a user opens it."""
    lines = [f'name = "{target.body.name}"']
    for name, p, r, bright, n in zip(
        target.body.point_names, target.body.points, target.radii_m, target.bright, target.normals, strict=True
    ):
        lines += [
            "[[markers]]",
            f'name = "{name}"',
            f"position_mm = {(1e3 * p).tolist()}",
            f"normal = {n.tolist()}",
            f"disc = {{ radius_mm = {1e3 * r}, bright = {str(bool(bright)).lower()} }}",
        ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plate.toml"
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return open_target(str(file))


def without_numbers(reason: str) -> str:
    """Return a reason with its numbers taken out, to count how often it is given."""
    return re.sub(r"[-+]?\d[\d.e+-]*", "#", reason)


def last_level_cache_bytes() -> int:
    """Return the size of the largest cache, 32 MB where the system does not say."""
    sizes = [32 << 20]
    for file in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        sizes.append(int(file.read_text().strip().rstrip("K")) << 10)
    return max(sizes)


def ring(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Copy images round and round until together they are 2.5 times the largest cache: each is cold when it comes again."""
    count = max(len(images), -(-5 * last_level_cache_bytes() // (2 * images[0].nbytes)))
    return [images[i % len(images)].copy() for i in range(count)]


def timed(
    function: Callable[[np.ndarray], object], frames: Sequence[np.ndarray], repeats: int = 0, limit_s: float = 10.0
) -> tuple[np.ndarray, list]:
    """Run a function on frames one after the other, once around at least unless that takes too long.

    Args:
        function: what to time; it is run three times first.
        frames: cold ones.
        repeats: at least so often.
        limit_s: no further run is begun after so long, but there are 20.

    Returns:
        Times, us, and what each run returned. Time is the processor's that this process used: on an idle computer the
        clock's, and on a busy one not that of others.
    """
    for frame in frames[-3:]:
        function(frame)
    times, results, begun = [], [], time.perf_counter()
    for i in range(max(repeats, len(frames))):
        frame = frames[i % len(frames)]
        start = time.process_time_ns()
        result = function(frame)
        times.append(time.process_time_ns() - start)
        results.append(result)
        if i >= 19 and time.perf_counter() - begun > limit_s:
            break
    return np.array(times) / 1e3, results


@numba.njit(error_model="numpy", fastmath=True)
def _sum(words: np.ndarray) -> int:
    """Sum words in four streams, so that many lines are under way at once."""
    n = words.size // 4
    a = b = c = d = np.uint64(0)
    for i in range(n):
        a += words[i]
        b += words[n + i]
        c += words[2 * n + i]
        d += words[3 * n + i]
    return a + b + c + d


@numba.njit(error_model="numpy", fastmath=True)
def _sum_in_order(words: np.ndarray) -> int:
    """Sum words from first to last."""
    total = np.uint64(0)
    for i in range(words.size):
        total += words[i]
    return total


def read_us(frames: Sequence[np.ndarray]) -> float:
    """Return the median time of reading an image once, us: the fastest of three ways to sum it as 64-bit words."""
    ways = (_sum, _sum_in_order, np.add.reduce)
    times = (timed(lambda f, way=way: way(f.reshape(-1).view(np.uint64)), frames)[0] for way in ways)
    return min(float(np.median(t)) for t in times)
