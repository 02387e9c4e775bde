"""Metrics of dense.py about time and memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armsight.vision.dense.block import Block
from armsight.vision.dense.method import Search
from armsight.vision.dense.scanline import Scanline
from armsight.vision.dense.semiglobal import Semiglobal

WIDTH, HEIGHT, COUNT = 1280, 720, 128
ROUNDS = 7
LIMIT_MB = 300


def pair() -> tuple[np.ndarray, np.ndarray]:
    """A slanted, textured wall of disparities 20 to 100."""
    rng = np.random.default_rng(0)
    wall = np.zeros((HEIGHT, WIDTH + 200))
    for scale in (1, 3, 9, 27):
        small = rng.normal(size=(HEIGHT // scale + 2, (WIDTH + 200) // scale + 2))
        wall += scale**0.5 * cv2.resize(small, (WIDTH + 200, HEIGHT), interpolation=cv2.INTER_CUBIC)
    wall = np.clip(128 + 40 * wall / wall.std(), 0, 255).astype(np.float32)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    d = 20 + 80 * v / HEIGHT
    images = [cv2.remap(wall, u + shift, v, cv2.INTER_CUBIC) for shift in (0, d)]
    left, right = (np.clip(np.rint(i + rng.normal(size=i.shape)), 0, 255).astype(np.uint8) for i in images)
    return left, right


def times(folder: Path) -> dict[str, Any]:
    left, right = pair()
    search = Search(0, COUNT)
    sgbm = cv2.StereoSGBM.create(0, COUNT, 3, P1=72, P2=288, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    checked = cv2.StereoBM.create(COUNT, 15)  # with the checks that ours makes: both images agree, no speckles
    checked.setDisp12MaxDiff(1)
    checked.setSpeckleWindowSize(50)
    checked.setSpeckleRange(1)
    jobs: dict[str, Callable[[], object]] = {
        "StereoBM": lambda: cv2.StereoBM.create(COUNT, 15).compute(left, right),
        "StereoBM, checks": lambda: checked.compute(left, right),
        "SGBM-3WAY": lambda: sgbm.compute(left, right),
        "block": lambda: Block().match(left, right, search),
        "block, search alone": lambda: Block().search(left, right, search),
        "semiglobal 5": lambda: Semiglobal(5).match(left, right, search),
        "semiglobal 5, search alone": lambda: Semiglobal(5).search(left, right, search),
        "semiglobal 8": lambda: Semiglobal(8).match(left, right, search),
        "scanline": lambda: Scanline().match(left, right, search),
    }
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})  # one thread, as OpenCV has
    for job in jobs.values():
        job()  # compiled, and its memory touched
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(ROUNDS):  # side by side, so that what else runs on the computer meets all alike
        for name, job in jobs.items():
            begun = time.process_time()
            job()
            spent[name].append(time.process_time() - begun)
    os.sched_setaffinity(0, processors)
    found = {name: 1e3 * min(each) for name, each in spent.items()}
    cells = WIDTH * HEIGHT * COUNT
    for name, ms in found.items():
        print(
            f"  {name:<28}{ms:>8.1f} ms{cells / ms / 1e3:>8.0f} Mpx*d/s{1e6 * ms / cells:>8.2f} ns a px and disparity"
        )
    required = {
        "block over StereoBM": (found["block"] / found["StereoBM"], 1.2),
        "semiglobal 5 over SGBM-3WAY": (found["semiglobal 5"] / found["SGBM-3WAY"], 1.0),
        "scanline, ns a px and disparity": (1e6 * found["scanline"] / cells, 3.0),
    }
    for name, (value, limit) in required.items():
        print(f"  {name}: {value:.2f}, at most {limit}: {'held' if value <= limit else 'MISSED'}")
    return found


def peak_mb(arguments: list[str], settings: dict[str, str]) -> float:
    """The most that a command, or another process that it starts, holds in memory, 10^6 bytes."""
    code = "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL); "
    code += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    line = [sys.executable, "-c", code, *arguments]
    printed = subprocess.run(line, env={**os.environ, **settings}, capture_output=True, text=True, check=True).stdout
    return int(printed) * (1024 if sys.platform == "linux" else 1) / 1e6


def memory(folder: Path) -> dict[str, Any]:
    """Peak of the whole command on two threads: with an empty cache, so that it compiles, and from the cache."""
    if sys.platform == "win32":
        print("  not reported by this system")
        return {}
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as room:
        paths = [str(Path(room) / f"{side}.png") for side in ("left", "right")]
        for path, image in zip(paths, pair(), strict=True):
            cv2.imwrite(path, image)
        for name in ("block", "scanline", "semiglobal"):
            out = str(Path(room) / "out")
            begin = "from armsight.app.main import main; main()"
            line = [sys.executable, "-c", begin, "dense", "--method", name, "-o", out]
            line += ["--max-disparity", str(COUNT), *paths]
            peak = peak_mb(line, {})
            found[name] = {"peak_mb": peak}
            assessment = "held" if peak < LIMIT_MB else "MISSED"
            print(f"  {name:<12}{peak:>6.0f} MB; below {LIMIT_MB}: {assessment}", flush=True)
    return found
