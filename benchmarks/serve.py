"""``armsight serve`` in days: cameras, a board and a child that are lost, a full disk, a clock that is set.

    python benchmarks/serve.py [LOSSES] [--boards LOSSES] [--seed N] [--steady S] [--rate HZ]

Two cameras are MJPEG streams of this process, the board an emulated SO-101 whose drives are on, at a pseudo-terminal that
is pulled and plugged in again. Days of losses are compressed: each loss follows the return from the last by a second or
two. Printed: time from the return of what was lost to its first shot or reading, lines for each loss, memory of the service
over the losses and of its child over the shots of an undisturbed minute, and where the arm is after SIGTERM. The clock is
set by a library that is loaded before (LD_PRELOAD), the full disk is /dev/full.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from armsight.robot.boards.feetech.bus import BAUD
from armsight.robot.boards.feetech.registers import TORQUE
from armsight.sim.boards.device import PtyPort
from armsight.sim.boards.so101 import So101Bus
from armsight.sim.example_rig import demo_recording
from armsight.vision.sources import open_source

CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <time.h>
#include <stdio.h>
#include <stdlib.h>
int clock_gettime(clockid_t id, struct timespec *t) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
  int code = real(id, t);
  FILE *f = id == CLOCK_REALTIME ? fopen(getenv("CLOCK_STEP"), "r") : 0;
  if (f) { long s = 0; if (fscanf(f, "%ld", &s) == 1) t->tv_sec += s; fclose(f); }
  return code;
}
"""


class Cameras:
    """Two MJPEG streams that go, freeze and come back."""

    def __init__(self, images: list[tuple[bytes, bytes]], rate_hz: float) -> None:
        self.gone, self.frozen = threading.Event(), threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                side = int(self.path == "/right")
                if outer.gone.is_set():
                    self.close_connection = True
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=f")
                self.end_headers()
                try:
                    while not outer.gone.is_set():
                        k = int(time.monotonic() * rate_hz)
                        if not outer.frozen.is_set():
                            data = images[k % len(images)][side]
                            head = f"--f\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                            self.wfile.write(head.encode() + data + b"\r\n")
                        time.sleep(max((k + 1) / rate_hz - time.monotonic(), 0.001))
                except OSError:
                    pass
                self.close_connection = True

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.port = self.server.server_address[1]


class Cable:
    """An emulated SO-101 that holds its pose, behind a cable that is pulled and plugged in; ``name`` stays the same."""

    def __init__(self, folder: Path) -> None:
        self.bus, self.name = So101Bus.made(), folder / "port"
        for servo in range(6):
            self.bus.servos.switch(servo, True)
            self.bus.tables[servo][TORQUE.address] = 1
        self.plug()

    def plug(self) -> None:
        """Plug it in."""
        self.port = PtyPort(self.bus, BAUD)
        self.name.symlink_to(self.port.name)

    def pull(self) -> None:
        """Pull it: the port is gone."""
        self.name.unlink()
        self.port.pull()

    @property
    def holds(self) -> bool:
        """Whether the drives are on and the joints where they were."""
        return bool(self.bus.servos.on.all() and np.abs(self.bus.servos.shaft - self.began).max() < np.radians(0.1))


def used_s(pid: int | None) -> float:
    """Return the processor time that a process has used, s; NaN where it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def rss_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Serving:
    """The service, and its events with the time on this process' clock."""

    def __init__(self, folder: Path, cameras: Cameras, arm: Cable, log: str) -> None:
        step = folder / "step"
        step.write_text("0")
        self.step, text = step, CLOCK
        (folder / "clock.c").write_text(text)
        library = folder / "clock.so"
        subprocess.run(["cc", "-shared", "-fPIC", "-o", library, folder / "clock.c", "-ldl"], check=True)
        ctypes.CDLL(str(library))
        (folder / "serve.toml").write_text(
            f'[measure]\nrig = "rig.json"\ntarget = "plate.toml"\n'
            f'source = "url:http://127.0.0.1:{cameras.port}/left,http://127.0.0.1:{cameras.port}/right"\n'
            f'stream = ["json+tcp:0"]\n[board]\nport = "feetech:{arm.name}"\n'
            f'[serve]\nhttp = "127.0.0.1:0"\nlog = "{log}"\nstale_s = 3.0\n'
        )
        environment = os.environ | {"LD_PRELOAD": str(library), "CLOCK_STEP": str(step)}
        arguments = [sys.executable, "-m", "armsight", "serve", str(folder / "serve.toml"), "--json"]
        self.process = subprocess.Popen(
            arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=folder
        )
        self.events: list[tuple[float, dict[str, object]]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.events.append((time.monotonic(), json.loads(line)))

    def wait(self, event: str, after: int, limit_s: float = 90.0) -> tuple[float, dict[str, object]] | None:
        """Return the first event of a kind from a position on; None where it does not come."""
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            for found in self.events[after:]:
                if found[1]["event"] == event:
                    return found
            time.sleep(0.02)
        return None

    def child(self) -> int | None:
        """Return the process that measures: the older one, the other waits."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return int(children[0]) if children else None

    def metrics(self) -> dict[str, float]:
        """Return /metrics."""
        port = next(event["port"] for _, event in self.events if event["event"] == "began")
        text = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5).read().decode()
        rows = (line.split() for line in text.splitlines() if not line.startswith("#"))
        return {name: float(value) for name, value in rows}


def main() -> None:
    """Lose and bring back, and print what came of it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("losses", type=int, nargs="?", default=60)
    parser.add_argument("--seed", type=int, default=9)
    parser.add_argument("--boards", type=int, default=20)
    parser.add_argument("--steady", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=10.0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = demo_recording(folder, seed=given.seed, image_size_px=(640, 360), boards=1, shots=8)
        truth[1].rig.save(folder / "rig.json")
        import cv2

        images = [
            tuple(cv2.imencode(".jpg", image)[1].tobytes() for image in (shot.left, shot.right))
            for shot in open_source(folder / "arm")
        ]
        cameras, arm = Cameras(images, given.rate), Cable(folder)
        for log, share in (("serve.log", 1.0), ("/dev/full", 0.1)):
            kinds = ["cameras"] * max(round(share * given.losses), 2) + ["board"] * max(round(share * given.boards), 2)
            rng.shuffle(kinds)
            campaign(Serving(folder, cameras, arm, log), cameras, arm, rng, kinds, log, given.steady)


def campaign(
    served: Serving, cameras: Cameras, arm: Cable, rng: random.Random, kinds: list[str], log: str, steady_s: float
) -> None:
    """Print one row for a log."""
    if served.wait("measuring", 0) is None:
        raise SystemExit(f"never began: {served.process.stderr.read()}")
    shots, memory = [], []
    end = time.monotonic() + steady_s
    while time.monotonic() < end:  # undisturbed: the child's memory over its shots
        time.sleep(min(2.0, steady_s / 4))
        found = served.metrics()
        shots.append(found["armsight_shots_total"])
        memory.append(found["armsight_process_resident_bytes"] / 1e6)
    slope = np.polyfit(shots[len(shots) // 3 :], memory[len(memory) // 3 :], 1)[0]
    ways = ("gone", "frozen", "killed")
    back: dict[str, list[float]] = {kind: [] for kind in (*ways, "board")}
    lines, own, used, never = [], [], [], 0
    arm.began = arm.bus.servos.shaft.copy()
    for k, lost in enumerate(kinds):
        kind, at = rng.choice(ways) if lost == "cameras" else lost, len(served.events)
        event = "board " if kind == "board" else ""
        if kind == "board":
            arm.pull()
            served.wait("board lost", at, 30.0)
            time.sleep(rng.uniform(0.2, 4.0))
            arm.plug()
        elif kind == "killed":
            if (child := served.child()) is not None:
                os.kill(child, signal.SIGKILL)
        else:
            flag = getattr(cameras, kind)
            flag.set()
            served.wait("lost", at, 30.0)
            time.sleep(rng.uniform(0.2, 4.0))
            flag.clear()
        if k % 7 == 3:
            served.step.write_text(str(rng.choice([-86400, -3600, 3600, 86400])))  # the clock is set meanwhile
        restored = time.monotonic()
        found = served.wait(f"{event}back", at)
        never += found is None
        if found is not None:
            back[kind].append(found[0] - restored)
            used += [used_s(served.child())] if kind != "board" else []
        lines.append([event["why"] for _, event in served.events[at:] if event["event"].endswith("lost")])
        own.append(rss_mb(served.process.pid))
        time.sleep(rng.uniform(0.5, 2.0))
    healthy = served.metrics()
    served.process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    code = served.process.wait(30)
    ended_s = time.monotonic() - began
    time.sleep(0.5)
    repeated = sum(len(each) != len(set(each)) for each in lines)
    print(
        f"log {log}: {len(kinds)} losses, {never} without return, {repeated} that said a reason twice, lines a loss "
        f"{np.mean([len(each) for each in lines]):.2f} (most {max(map(len, lines))})"
    )
    for kind, each in back.items():
        if each:
            print(f"  {kind}: {len(each)}, back after {np.median(each):.1f} s (median), {max(each):.1f} at most")
    print(
        f"  processor time of a new child until its first shot {np.nanmedian(used):.1f} s, {np.nanmax(used):.1f} at most"
    )
    print(f"  service {own[0]:.1f} MB after the first loss, {own[-1]:.1f} after the last, {max(own):.1f} at most")
    print(f"  child {memory[0]:.1f} to {memory[-1]:.1f} MB over {shots[-1]:.0f} shots: {1e3 * slope:.2f} kB a shot")
    print(f"  up {healthy['armsight_up']:.0f}, board {healthy['armsight_board_up']:.0f}, ", end="")
    print(
        f"{healthy['armsight_readings_total']:.0f} readings, {healthy['armsight_board_losses_total']:.0f} board losses"
    )
    print(f"  SIGTERM: ended with {code} after {ended_s:.1f} s, the arm {'held' if arm.holds else 'NOT held'}")


if __name__ == "__main__":
    main()
