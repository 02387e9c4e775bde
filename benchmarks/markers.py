"""Disc markers against the bound, the clock and other finders, on images with truth, in one run and one thread.

    python benchmarks/markers.py                   all metrics, a fresh seed (printed) and then the fixed one
    python benchmarks/markers.py 1 3               only these
    python benchmarks/markers.py --fixed-only      the fixed seed only
    python benchmarks/markers.py --seed 7          this seed only
    python benchmarks/markers.py --json found.json metrics as JSON, too

Metrics: 1 centres against the Cramer-Rao bound, textures and clutter, 2 times, 3 other finders, 4 the pose of the
three-disc plate, 5 following a path with occlusions, 6 perspective bias. pyapriltags is compared with where it is installed
(``pip install armsight[bench]``).
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"  # before numpy is imported

import argparse  # noqa: E402
import json  # noqa: E402
import secrets  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import cv2  # noqa: E402
import numpy as np  # noqa: E402

import disc_images  # noqa: E402
import marker_accuracy  # noqa: E402
import marker_follow  # noqa: E402
import marker_peers  # noqa: E402
import marker_pose  # noqa: E402
import marker_times  # noqa: E402
from marker_report import Report  # noqa: E402

FIXED_SEED = 3
METRICS = {
    "1": ("Centres against the Cramer-Rao bound", marker_accuracy.metric),
    "2": ("Times, HD, one thread, cold frames", marker_times.metric),
    "3": ("Other finders on the same images", marker_peers.metric),
    "4": ("Pose of the three-disc plate", marker_pose.metric),
    "5": ("Following 0.5 m/s at 60 Hz with random occlusions", marker_follow.metric),
    "6": ("Perspective bias", marker_pose.perspective),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metrics", nargs="*", metavar="METRIC", help=f"of {' '.join(METRICS)}; all by default")
    parser.add_argument("--fixed-only", action="store_true", help="only the fixed seed")
    parser.add_argument("--seed", type=int, help="only this seed")
    parser.add_argument("--json", type=Path, help="write the metrics to this file")
    options = parser.parse_args()
    for name in options.metrics:
        if name not in METRICS:
            parser.error(f"no metric {name!r}; there are {' '.join(METRICS)}")
    cv2.setNumThreads(1)
    report = Report()
    report.say(
        f"OpenCV {cv2.__version__}, numpy {np.__version__}; load of the computer before {os.getloadavg()[0]:.2f}"
    )
    shift, difference = disc_images.check(2)
    report.say(f"Test images against 64 x 64 samples a pixel: {shift:.1e} px, {difference:.1e} of the contrast")
    fresh = secrets.randbelow(10**6)
    seeds = [options.seed] if options.seed is not None else [FIXED_SEED] if options.fixed_only else [fresh, FIXED_SEED]
    runs = {}
    for seed in seeds:
        report.say(f"\nSeed {seed}{' (the fixed one)' if seed == FIXED_SEED else ''}")
        report.found = runs[str(seed)] = {}
        for name in options.metrics or METRICS:
            title, metric = METRICS[name]
            report.say(f"\n{name}. {title}")
            start = time.perf_counter()
            metric(seed, report)
            report.say(f"  ({time.perf_counter() - start:.0f} s)")
    if options.json is not None:
        options.json.write_text(json.dumps(runs, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
