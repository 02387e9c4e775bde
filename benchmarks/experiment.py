"""The experiment's metrics over seeds: every one of them, none hidden.

python experiment.py            ten seeds, worn arm, the ARM binary under Unicorn: about half an hour idle
python experiment.py 3          three of them
python experiment.py 3 quick    the quick demo of them
python experiment.py 3 busy     beside two processes that take a core each
python experiment.py 1 quick processor    times from image to command of the processor: other programs do not count
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from armsight.app.demo.demo import Demo, run_demo
from armsight.loop.running import loop

#: Metric -> where it stands in the summary, its factor and unit, and what it must be at most (None: reported only).
METRICS = {
    "vision, moving, RMS": ("vision", "position_rms_m", 1e3, "mm", 0.20),
    "vision, rotation RMS": ("vision", "orientation_rms_rad", float(np.degrees(1)), "deg", 0.15),
    "vision, at rest, RMS": ("vision", "rest_position_rms_m", 1e3, "mm", None),
    "potentiometers, moving, RMS": ("potentiometers", "position_rms_m", 1e3, "mm", None),
    "fused (0.6 s later), moving, RMS": ("fused", "position_rms_m", 1e3, "mm", 0.25),
    "fused, at rest, RMS": ("fused", "rest_position_rms_m", 1e3, "mm", None),
    "fused, NEES (6 is honest)": ("fused", "nees_mean", 1.0, "", None),
    "fused at once, moving, RMS": ("live", "position_rms_m", 1e3, "mm", None),
    "hidden for 0.5 s, fused, RMS": ("occlusion", "fused_position_rms_m", 1e3, "mm", None),
    "hidden for 0.5 s, fused, max": ("occlusion", "fused_position_max_m", 1e3, "mm", 0.5),
    "hidden for 0.5 s, at once, max": ("occlusion", "live_position_max_m", 1e3, "mm", None),
    "loop open, rest error RMS": ("closed_loop", "rest_error_before_m", 1e3, "mm", None),
    "loop closed, rest error RMS": ("closed_loop", "rest_error_after_m", 1e3, "mm", 0.15),
    "loop open, path error RMS": ("closed_loop", "path_error_before_m", 1e3, "mm", None),
    "loop closed, path error RMS": ("closed_loop", "path_error_after_m", 1e3, "mm", None),
    "image to command, p50": ("latency_s", "p50", 1e3, "ms", 1.2),
    "image to command, p99": ("latency_s", "p99", 1e3, "ms", 2.0),
    "image to command, p99.9": ("latency_s", "p999", 1e3, "ms", 5.0),
    "image to command, longest": ("latency_s", "max", 1e3, "ms", 10.0),
    "search of the body, longest": ("search_s", "max", 1e3, "ms", None),
}


#: What the 99th percentile must be at most beside two other busy processes, ms.
BUSY_P99_MS = 4.0


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep so many cores busy within the block."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for each in others:
            each.kill()
            each.wait()


def run(seed: int, quick: bool, found: dict[str, list[float]]) -> None:
    """Run a seed and add its metrics."""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        s = run_demo(Demo(Path(folder), seed=seed, quick=quick)).json()
    for name, (part, key, factor, _, _) in METRICS.items():
        found[name].append(factor * s[part][key])
    c = s["closed_loop"]
    found["vision, RMS over sigma"].append(s["vision"]["position_rms_m"] / s["vision"]["position_sigma_rms_m"])
    found["rest, times smaller"].append(c["rest_error_before_m"] / c["rest_error_after_m"])
    found["path, times smaller"].append(c["path_error_before_m"] / c["path_error_after_m"])
    print(f"seed {seed}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)


def reading_ms() -> float:
    """Return what reading two HD images takes of the processor, ms."""
    images, times = np.random.default_rng(0).integers(0, 255, (2, 720, 1280), np.uint8), []
    for _ in range(200):
        began = time.thread_time()
        for image in images:
            cv2.sumElems(image)
        times.append(time.thread_time() - began)
    return 1e3 * min(times)


def main(seeds: int, quick: bool, others: int, processor: bool) -> None:
    """Run and print."""
    if processor:  # a simulation computes everything in one thread
        loop.time = SimpleNamespace(perf_counter=time.thread_time, monotonic=time.monotonic)
    found: dict[str, list[float]] = {
        name: [] for name in (*METRICS, "vision, RMS over sigma", "rest, times smaller", "path, times smaller")
    }
    metrics = dict(METRICS)
    if others:
        metrics["image to command, p99"] = (*METRICS["image to command, p99"][:4], BUSY_P99_MS)
    with busy(others), suppress(KeyboardInterrupt):  # what was measured until then is printed
        for seed in range(seeds):
            run(seed, quick, found)
    print(f"{'':34s} {'median':>8s} {'least':>8s} {'most':>8s}  required at most")
    for name, values in found.items():
        unit, most = metrics[name][3:] if name in metrics else ("", None)
        bar = "" if most is None else f"{most:g} {unit}: {sum(v <= most for v in values)} of {len(values)}"
        print(f"{name:34s} {np.median(values):8.3f} {min(values):8.3f} {max(values):8.3f}  {bar}")
    if processor:
        ratio = float(np.median(found["image to command, p50"])) / reading_ms()
        print(f"image to command, p50, over reading both images: {ratio:.1f}")


if __name__ == "__main__":
    others = 2 if "busy" in sys.argv else 0
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10, "quick" in sys.argv, others, "processor" in sys.argv)
