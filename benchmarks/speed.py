"""What a user waits for: help, the first measurement, calibration with its report, identification, the demo.

    python benchmarks/speed.py            all but the demo
    python benchmarks/speed.py --demo     and the demo: --quick, then whole
    python benchmarks/speed.py start      one pair beside a script of OpenCV alone

Times of discs: ``markers.py 2``; from image to command: ``experiment.py``; of identification: ``identify.py --speed``.
Every command runs in a process of its own, as a user types it; the median of several. ``import cv2`` runs beside it: what a
program that uses OpenCV needs at least. Cold is the first run after the pages of the environment were given back to the
system (``posix_fadvise``), warm the median of those that follow. Byte code is there, as pip and the first import leave it,
also where PYTHONDONTWRITEBYTECODE is set. Real recordings are looked for at ARMSIGHT_DATA.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path

import numpy as np

from armsight.app.main import COMMANDS

DATA = Path(os.environ.get("ARMSIGHT_DATA", Path(__file__).resolve().parent.parent.parent / "shared" / "data"))
ARMSIGHT = str(Path(sys.executable).with_name("armsight"))
REPEATS = 5
#: With it set, each of the demo's processes compiles all that it imports: 5 s of a processor.
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
SOURCES = sysconfig.get_path("purelib"), str(Path(__file__).resolve().parent.parent / "src")


def forget_pages() -> None:
    """Give the environment's files in the page cache back to the system, as after a start of the computer."""
    os.sync()
    for root in SOURCES:
        for path in Path(root).rglob("*"):
            if path.is_file() and (path.suffix in (".py", ".pyc", ".so") or ".so." in path.name):
                handle = os.open(path, os.O_RDONLY)
                os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
                os.close(handle)


def seconds(*command: str) -> float:
    """Run a command and return how long it took, s."""
    began = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=ENVIRONMENT)
    return time.perf_counter() - began


def report(name: str, value: float, most: float | None, unit: str = "s") -> None:
    """Print a figure beside what is required."""
    asked = "" if most is None else f"  at most {most:g}: {'met' if value <= most else 'MISSED'}"
    print(f"{name:58s} {value:8.2f} {unit}{asked}", flush=True)


def helps() -> None:
    """Time the help of every command."""
    times = {name: float(np.median([seconds(ARMSIGHT, name, "-h") for _ in range(REPEATS)])) for name in COMMANDS}
    slowest = max(times, key=lambda name: times[name])
    report(f"-h of {len(times)} commands, the slowest ({slowest})", times[slowest], 0.15)


def first_measurement(folder: Path, *, alone: bool) -> None:
    """Time one pair of a board, cold and warm, beside importing OpenCV; ``alone``: beside OpenCV's script alone."""
    pairs = DATA / "stereo" / "opencv-480p"
    rig, target = str(folder / "rig.json"), ("--target", "chessboard:9x6:25mm")
    many = ("--source", f"pairs:{pairs}/left*.jpg,{pairs}/right*.jpg")
    images = f"{pairs}/left01.jpg", f"{pairs}/right01.jpg"
    seconds(ARMSIGHT, "calibrate", *many, *target, "-o", rig)
    measure = (ARMSIGHT, "measure", rig, *target, "--source", f"pairs:{','.join(images)}")
    opencv = (sys.executable, "-c", "import cv2")
    starts = () if alone else (("cold", forget_pages, 1), ("warm", lambda: None, REPEATS))
    for name, prepare, repeats in starts:
        times = []
        for command in (opencv, measure):
            prepare()
            times.append(float(np.median([seconds(*command) for _ in range(repeats)])))
        report(f"import cv2, {name}", times[0], None)
        report(f"measure one pair, beyond import cv2, {name}", times[1] - times[0], 2.0)
    beside_opencv(measure, images)


#: What a user of OpenCV writes for it: corners, triangulation without distortion, a rigid fit.
SCRIPT = """
import sys, cv2, numpy as np
images = [cv2.imread(name, 0) for name in sys.argv[1:]]
stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
rough = [cv2.findChessboardCorners(image, (9, 6))[1] for image in images]
uv = [cv2.cornerSubPix(*both, (7, 7), (-1, -1), stop).reshape(-1, 2).T for both in zip(images, rough)]
K = np.array([[535.0, 0, 320], [0, 535, 240], [0, 0, 1]])
X = cv2.triangulatePoints(K @ np.eye(3, 4), K @ np.eye(3, 4) - K @ [[0, 0, 0, 0.083], [0] * 4, [0] * 4], *uv)
p = (X[:3] / X[3]).T
board = np.array([[0.025 * x, 0.025 * y, 0] for y in range(6) for x in range(9)])
U, _, Vt = np.linalg.svd((board - board.mean(0)).T @ (p - p.mean(0)))
print(Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T, p.mean(0))
"""


def beside_opencv(measure: tuple[str, ...], images: tuple[str, ...]) -> None:
    """Compare processor time and memory of measuring one pair in a process of its own with a script of OpenCV."""
    least = np.full((2, 2), np.inf)
    for _ in range(REPEATS):
        for k, command in enumerate((measure, (sys.executable, "-c", SCRIPT, *images))):
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=ENVIRONMENT)
            _, status, used = os.wait4(process.pid, 0)
            if status:
                raise SystemExit(f"{' '.join(command)}: ended with {status}")
            least[k] = np.minimum(least[k], (used.ru_utime + used.ru_stime, used.ru_maxrss / 1024))
    report("measure one pair, processor time over OpenCV's script", least[0, 0] / least[1, 0], 2.2, "")
    report("the same, memory", least[0, 1] / least[1, 1], 1.5, "")


def calibration(folder: Path) -> None:
    """Time a calibration of 29 pairs of 640x360 with its report."""
    pairs = DATA / "stereo" / "webcams-360p"
    images = ("--source", f"pairs:{pairs}/left*.jpg,{pairs}/right*.jpg")
    outputs = ("-o", str(folder / "webcams.json"), "--report", str(folder / "report"))
    took_s = seconds(ARMSIGHT, "calibrate", *images, "--target", "chessboard:9x6:24.23mm", *outputs)
    report("calibrate, 29 pairs of 640x360, with report", took_s, 15.0)


def demo(folder: Path) -> None:
    """Time the demo, and its memory."""
    for name, options, most in (("demo --quick", ("--quick",), 30.0), ("demo", (), 120.0)):
        report(name, seconds(ARMSIGHT, "demo", *options, "-o", str(folder / name.replace(" ", ""))), most)
    report("memory of the demo", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6, 1.2, "GB")


def main() -> None:
    """Run and print."""
    subprocess.run(
        [sys.executable, "-m", "compileall", "-q", "-j", "0", *SOURCES], capture_output=True, env=ENVIRONMENT
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if "start" in sys.argv:
            first_measurement(folder, alone=True)
            return
        helps()
        if DATA.is_dir():
            first_measurement(folder, alone=False)
            calibration(folder)
        else:
            print(f"no real recordings at {DATA}: set ARMSIGHT_DATA to their folder")
        if "--demo" in sys.argv:
            demo(folder)


if __name__ == "__main__":
    main()
