"""What cameras do to markers, on images with truth: simulated cameras of ``armsight.sim.camera``, in one thread.

    python benchmarks/cameras.py                   all sections
    python benchmarks/cameras.py 0                 only these
    python benchmarks/cameras.py --seed 7          another seed
    python benchmarks/cameras.py --json found.json metrics as JSON, too
    python benchmarks/cameras.py 1 --shots 500 --rows rows.jsonl   so many shots, kept in a file to go on from
    python benchmarks/cameras.py --sheet sheet.png only this: the same body through every preset

Sections: 0 each stage of a camera alone, 1 bodies of discs through each preset, 2 skew and readout of two web cameras, 3
tags and chessboards through each preset.
``camera_scene.scene`` renders the scenes.
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"  # before numpy is imported

import argparse  # noqa: E402
import json  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import cv2  # noqa: E402

import camera_bodies  # noqa: E402
import camera_scene  # noqa: E402
import camera_shutters  # noqa: E402
import camera_stages  # noqa: E402
from marker_report import Report  # noqa: E402

#: Sections and the bodies that they send through each preset.
BODIES = {"1": ("nine", "four"), "3": ("tags", "chessboard")}
SECTIONS = {
    "0": ("Each stage of a camera alone", camera_stages.section),
    "1": ("Bodies of discs through each preset, thresholded contours beside", None),
    "2": ("Skew and readout of two web cameras, from a moving body", camera_shutters.section),
    "3": ("Tags and chessboards through each preset, OpenCV's detectors beside", None),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {' '.join(SECTIONS)}; all by default")
    parser.add_argument("--seed", type=int, default=3, help="of poses, scenes and noise; 3 by default")
    parser.add_argument("--json", type=Path, help="write the metrics to this file")
    parser.add_argument(
        "--shots", type=int, default=camera_bodies.SHOTS, help="of each body through each preset; 60 by default"
    )
    parser.add_argument(
        "--rows", type=Path, help="keep each shot of sections 1 and 3 in this file, and what it has already"
    )
    parser.add_argument("--sheet", type=Path, help="write an image of the same body through every preset, and no more")
    options = parser.parse_args()
    if options.sheet is not None:
        camera_scene.sheet(options.sheet)
        return
    for name in options.sections:
        if name not in SECTIONS:
            parser.error(f"no section {name!r}; there are {' '.join(SECTIONS)}")
    cv2.setNumThreads(1)
    report = Report()
    for name in options.sections or SECTIONS:
        title, section = SECTIONS[name]
        report.say(f"\n{name}. {title}")
        start = time.perf_counter()
        if section is None:
            camera_bodies.campaign(BODIES[name], options.seed, report, options.shots, options.rows)
        else:
            section(options.seed, report)
        report.say(f"  ({time.perf_counter() - start:.0f} s)")
    if options.json is not None:
        options.json.write_text(json.dumps(report.found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
