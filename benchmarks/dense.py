"""Dense stereo against OpenCV: errors, times, memory and the honesty of sigma, in one run on one thread.

    python benchmarks/dense.py             all metrics
    python benchmarks/dense.py 1 4         some of them
    python benchmarks/dense.py --json found.json

Metrics: 1 errors on tsukuba, teddy and cones (whole image, all pixels with a truth, filled), 2 times at 1280x720 with 128
disparities, 3 memory, 4 how often 1.96 sigma hold the error. Scenes are looked for in ``middlebury`` at
ARMSIGHT_DATA, or ../shared/data beside the project; another folder of scenes: --scenes DIR.

OpenCV's disparities are filled in rows from behind, as ours, and its images are widened to the left, or its first columns
stay empty; StereoBM and SGBM have OpenCV's own post-processing only.
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"  # before numpy is imported

import argparse  # noqa: E402
import json  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import cv2  # noqa: E402
import numpy as np  # noqa: E402

import dense_accuracy  # noqa: E402
import dense_speed  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
METRICS = {
    "1": ("Errors, all pixels with a truth, filled", dense_accuracy.errors),
    "2": ("Times, 1280x720, 128 disparities, one thread, CPU ms", dense_speed.times),
    "3": ("Memory of the whole command, everything loaded, 1280x720, 128 disparities", dense_speed.memory),
    "4": ("Errors inside 1.96 sigma, measured pixels that both cameras see", dense_accuracy.coverage),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("metrics", nargs="*", metavar="METRIC", help=f"of {' '.join(METRICS)}; all by default")
    parser.add_argument("--scenes", type=Path, help="folder of scenes")
    parser.add_argument("--json", type=Path, help="write the metrics to this file")
    options = parser.parse_args()
    for name in options.metrics:
        if name not in METRICS:
            parser.error(f"no metric {name!r}; there are {' '.join(METRICS)}")
    data = Path(os.environ.get("ARMSIGHT_DATA", ROOT.parent / "shared" / "data"))
    cv2.setNumThreads(1)
    print(f"OpenCV {cv2.__version__}, numpy {np.__version__}; load of the computer before {os.getloadavg()[0]:.2f}")
    found: dict[str, Any] = {}
    for name in options.metrics or METRICS:
        title, metric = METRICS[name]
        print(f"\n{name}. {title}", flush=True)
        found[name] = metric(options.scenes or data / "middlebury")
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
