"""Figures of dense.py about time and memory."""

from __future__ import annotations

import subprocess
import sys
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
    jobs: dict[str, Callable[[], object]] = {
        "StereoBM": lambda: cv2.StereoBM.create(COUNT, 15).compute(left, right),
        "SGBM-3WAY": lambda: sgbm.compute(left, right),
        "block": lambda: Block().match(left, right, search),
        "block, search alone": lambda: Block().search(left, right, search),
        "semiglobal 5": lambda: Semiglobal(5).match(left, right, search),
        "semiglobal 5, search alone": lambda: Semiglobal(5).search(left, right, search),
        "semiglobal 8": lambda: Semiglobal(8).match(left, right, search),
        "scanline": lambda: Scanline().match(left, right, search),
    }
    for job in jobs.values():
        job()  # compiled, and its memory touched
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(ROUNDS):  # side by side, so that what else runs on the machine meets all alike
        for name, job in jobs.items():
            begun = time.process_time()
            job()
            spent[name].append(time.process_time() - begun)
    found = {name: 1e3 * min(each) for name, each in spent.items()}
    cells = WIDTH * HEIGHT * COUNT
    for name, ms in found.items():
        print(
            f"  {name:<28}{ms:>8.1f} ms{cells / ms / 1e3:>8.0f} Mpx*d/s{1e6 * ms / cells:>8.2f} ns a px and disparity"
        )
    wanted = {
        "block over StereoBM": (found["block"] / found["StereoBM"], 1.0),
        "semiglobal 5 over SGBM-3WAY": (found["semiglobal 5"] / found["SGBM-3WAY"], 1.3),
        "scanline, ns a px and disparity": (1e6 * found["scanline"] / cells, 3.0),
    }
    for name, (value, limit) in wanted.items():
        print(f"  {name}: {value:.2f}, at most {limit}: {'held' if value <= limit else 'MISSED'}")
    return found


def memory(folder: Path) -> dict[str, Any]:
    """Peak of a process of its own while matching, less what it held before: what a match needs beyond the program.

    Linux's /proc tells; elsewhere the figure is left out.
    """
    if not Path("/proc/self/clear_refs").exists():
        print("  not told by this system")
        return {}
    found: dict[str, Any] = {}
    for name, make in (("block", "Block()"), ("scanline", "Scanline()"), ("semiglobal", "Semiglobal()")):
        code = (
            f"from armsight.vision.dense.{name} import *\n"
            "from armsight.vision.dense.method import Search\n"
            "from dense_speed import pair, COUNT\n"
            "left, right = pair()\n"
            f"m = {make}\n"
            "m.match(left[:64].copy(), right[:64].copy(), Search(0, 64))\n"
            "def mb(key):\n"
            "    lines = open('/proc/self/status').read().splitlines()\n"
            "    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(key))\n"
            "open('/proc/self/clear_refs', 'w').write('5')\n"
            "before = mb('VmRSS')\n"
            "m.match(left, right, Search(0, COUNT))\n"
            "print(before, mb('VmHWM'))\n"
        )
        here = Path(__file__).resolve().parent
        out = subprocess.run([sys.executable, "-c", code], cwd=here, capture_output=True, text=True, check=True).stdout
        before, after = (float(x) for x in out.split())
        found[name] = {"before_mb": before, "peak_mb": after}
        verdict = "held" if after - before < LIMIT_MB else "MISSED"
        print(
            f"  {name:<12}{after - before:>7.0f} MB (process {before:.0f} -> {after:.0f}); below {LIMIT_MB}: {verdict}"
        )
    return found
