"""Calibration and measurement beside OpenCV, on the same pairs, in one run.

    python benchmarks/calibration.py            all metrics
    python benchmarks/calibration.py 1 4        only these

Metrics: 1 held-out errors on real sets, 2 half-subsets, 3 uncertainty, 4 the Motoman arm and its laser tracker,
5 coverage of the pose's covariance, 6 time, 7 boards of discs, 8 free-running web cameras. Real recordings are looked for
at ARMSIGHT_DATA or ../shared/data.
"""

from __future__ import annotations

import sys

import cv2

import motoman
import real_discs
import real_sets
import real_shutters
import rendered

METRICS = {
    "1": real_sets.heldout_beside_opencv,
    "2": real_sets.half_subsets,
    "3": lambda: (rendered.point_sigma(), real_sets.normalised_residuals()),
    "4": motoman.tracker,
    "5": rendered.pose_coverage,
    "6": rendered.time_beside_opencv,
    "7": lambda: (real_discs.found_beside_opencv(), real_discs.heldout_beside_opencv(), real_discs.rendered_wide()),
    "8": real_shutters.skews,
}


def main() -> None:
    options = sys.argv[1:] or list(METRICS)
    print(f"OpenCV {cv2.__version__}")
    for name in options:
        METRICS[name]()


if __name__ == "__main__":
    main()
