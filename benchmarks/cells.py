"""Many cells and one hub, on this computer: latency, cost, losses, drifts, false alarms.

    python cells.py 50 --seconds 60    latency and cost of states; then kill -9 of half, a frozen cell, a cut
                                       cable, a killed hub
    python cells.py 200 --rate 1       latency and cost alone, with a shot a second of each cell
    python cells.py 50 --drift 5       three of them drift: where they stand in the list after 5 minutes
    python cells.py --alarms 7         false alarms of healthy cells in so many days, without any process
    python cells.py 50 --beside 600    image to command of a workcell beside hub and cells, alternately without them
    python cells.py 200 --page         how often Chromium draws the page, and its memory; the hub is fed in one process

Cells are processes of their own with the sink that commands have; they are fed with measured poses of a simulated rig
at 10 Hz, or --rate. The hub runs in a process of its own, and is looked at through its pages.

With --beside the workcell has a core of its own, as it has a computer of its own; hub, cells and the other workcells
share the rest. There, the scheduler gives the cells what the hub leaves (nice 19, SCHED_IDLE). Fifty processes on one
core delay another core of a virtual machine: while hub and cells rest, as many processes do the same, but send nothing.
"""

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import numpy as np

#: Noise of detections, px; slow motion of the cameras' mounts that no model has: sigma, rad, and correlation time, s.
NOISE_PX, BREATH_RAD, BREATH_S = 0.05, 3e-6, 40.0
DRIFT_DEG_H = 0.05
#: From a block's middle to the hub's look at it, s: the next block is being filled.
LATE_S = 12.0
#: Poses that a cell measures before it replays them.
RECORDED = 50
#: s that the cells go on and are stopped alternately, less than a zenoh session lasts without a sign of life; s of each
#: that do not count.
BLOCK_S, BEGIN_S = 2.5, 0.3
CORES = sorted(os.sched_getaffinity(0))
#: Runs the simulated workcell again and again, and writes when each shot's command was sent, and how long it took.
BESIDE = """
import gc, sys, time
from armsight.app.main import run
from armsight.loop.running import log

class Timed(log.Rows):
    def append(self, *columns):
        super().append(*columns)
        print(time.monotonic(), float(columns[0]), file=file, flush=True)

before, file = log.Log.__init__, open(sys.argv[1], "w")
def timed(self, *arguments, **named):
    before(self, *arguments, **named)
    self.latency_s = Timed()
log.Log.__init__ = timed
gc.set_threshold(100_000)
for k in range(1000):  # every other run is a cell of the hub
    print(time.monotonic(), -1.0 - k % 2, file=file, flush=True)
    assert run([*sys.argv[3:], "-o", f"beside{k}", *(("--stream", sys.argv[2]) if k % 2 else ())]) == 0
"""


def measured(rig, true, rng):
    """Return a pose that the rig measures while the cameras stand as in ``true``."""
    from armsight.data import Body, Correspondences
    from armsight.vision.pose.locate import locate
    from armsight.vision.triangulate import triangulate

    grid = [(x, y, 0.01 * (x > 0) * (y > 0)) for x in (-0.04, 0.0, 0.04) for y in (-0.04, 0.04)]
    points = np.array(grid)
    T = np.eye(4)
    T[:3, 3] = rng.uniform([-0.15, -0.1, 0.75], [0.15, 0.1, 0.95])
    uv = np.stack(true.project(points + T[:3, 3]), axis=1)
    uv += NOISE_PX * rng.standard_normal(uv.shape)
    body = Body("body", tuple("ABCDEF"), points)
    seen = Correspondences(np.arange(6), uv, np.tile(NOISE_PX**2 * np.eye(2), (6, 2, 1, 1)))
    return body, locate(rig, body, triangulate(rig, body, seen))


def cell(number, spec, seed, drifts):
    """Be a cell until the process is ended."""
    from armsight.app.stream.cell import open_cell
    from armsight.app.stream.datum import Published
    from armsight.data import Shot
    from armsight.loop.running.data import NoteDatum, ShotDatum
    from armsight.sim.example_rig import example_rig

    if ARGUMENTS.beside:
        idle()
    rng = np.random.default_rng([seed, number])
    rig, breath, began = example_rig(), np.zeros(3), time.monotonic()
    body, _ = measured(rig, rig, rng)
    axis = rng.integers(0, 2)
    if spec:
        sink = open_cell(spec, Published(rig, body, properties={"command": "measure"}))
        sink.start()
    else:
        sink = SimpleNamespace(put=lambda datum: None, close=lambda: None, cpu_s=0.0)
    known, ended = [], []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
    image, count, keep = np.zeros((480, 640), np.uint8), 0, np.exp(-1.0 / (ARGUMENTS.rate * BREATH_S))
    while not ended:
        now = time.monotonic() - began
        breath = keep * breath + BREATH_RAD * np.sqrt(1 - keep**2) * rng.standard_normal(3)
        tangent = np.zeros(rig.parameter_count)
        tangent[-3:] = breath
        if drifts:
            tangent[-3 + axis] += np.radians(DRIFT_DEG_H) * now / 3600.0
        if ARGUMENTS.drift or len(known) < RECORDED:  # where nothing drifts they are replayed
            known.append(measured(rig, rig.perturbed(tangent), rng)[1])
        pose = known[-1] if ARGUMENTS.drift else known[rng.integers(len(known))]
        sink.put(ShotDatum(Shot(f"{now:.1f}", image, image, now), pose))
        if not drifts and now > 5.0 * (count + 1) and not ARGUMENTS.drift:
            count += 1
            sink.put(NoteDatum(now, f"{number}-{count}", "warning"))
        time.sleep(1.0 / ARGUMENTS.rate)
    sink.close()
    used = time.process_time()
    print(json.dumps({"cell": number, "sink_cpu_s": sink.cpu_s, "process_cpu_s": used, "seconds": now}), flush=True)


def idle():
    """Have this process, and those it starts, take only what others leave of the processor."""
    os.nice(19)
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def hub(folder, port, http):
    """Start a hub, and return its process."""
    ends = ["--listen", f"tcp/127.0.0.1:{port}", "--http", f"127.0.0.1:{http}", "-o", str(folder), "--json"]
    process = subprocess.Popen([sys.executable, "-m", "armsight", "hub", *ends], stdout=subprocess.PIPE, text=True)
    process.stdout.readline()
    return process


def page(http, path="state"):
    """Return what a page of the hub says; nothing where there is none."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{http}/{path}", timeout=5) as answer:
            return json.loads(answer.read())
    except OSError:
        return None


def cpu_s(pid):
    """Return the processor time of a process, and its memory, MB."""
    stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    tick = os.sysconf("SC_CLK_TCK")
    return (int(stat[11]) + int(stat[12])) / tick, int(stat[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def until(holds, most_s):
    """Return after how many seconds something holds; NaN where it does not."""
    began = time.monotonic()
    while time.monotonic() - began < most_s:
        if holds():
            return time.monotonic() - began
        time.sleep(0.02)
    return float("nan")


def free_port():
    """Return a port that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


class Cable:
    """A connection that can be cut: nothing is closed, and nothing comes through."""

    def __init__(self, port, to):
        self.whole, self._to = threading.Event(), to
        self.whole.set()
        self._listening = socket.create_server(("127.0.0.1", port))
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            near = self._listening.accept()[0]
            try:
                ends = near, socket.create_connection(("127.0.0.1", self._to))
            except OSError:  # the hub is gone
                near.close()
                continue
            for one, other in (ends, ends[::-1]):
                threading.Thread(target=self._carry, args=(one, other), daemon=True).start()

    def _carry(self, one, other):
        try:
            while data := one.recv(1 << 16):
                self.whole.wait()
                other.sendall(data)
        except OSError:
            pass
        one.close()
        other.close()


def started(count, port, seed, drifting, cable):
    """Start cells, a few at a time; the last one behind a cable."""
    context = multiprocessing.get_context("fork")
    cells = []
    for number in range(count):
        spec = f"c{number:03d}@127.0.0.1:{port if number < count - 1 else cable}" if port else ""
        cells.append(context.Process(target=cell, args=(number, spec, seed, number in drifting), daemon=True))
        cells[-1].start()
        time.sleep(0.1)
    return cells


def levels(http):
    """Return the level of each cell by name."""
    return {each["name"]: each["level"] for each in (page(http) or {"cells": []})["cells"]}


def latencies(http, seconds):
    """Return the age of states at their arrival, s, looked at twice a second."""
    found, seen, end = [], set(), time.monotonic() + seconds
    while time.monotonic() < end:
        for each in page(http)["cells"]:
            state = each["state"]
            if state and (each["name"], state["t"]) not in seen:
                seen.add((each["name"], state["t"]))
                found.append(state["arrived"] - state["t"])
        time.sleep(0.5)
    return np.array(found)


def losses(cells, http, folder, port, process, cable):
    """Kill half of the cells, freeze one, cut a cable, kill the hub three times; print what followed."""
    names = [f"c{number:03d}" for number in range(len(cells))]
    half = len(cells) // 2
    for each in cells[:half]:
        os.kill(each.pid, signal.SIGKILL)
    took = until(lambda: all(levels(http).get(name) == 4 for name in names[:half]), 20)
    print(f"kill -9 of {half}: all red after {took:.2f} s (1 asked)")
    os.kill(cells[half].pid, signal.SIGSTOP)
    took = until(lambda: levels(http).get(names[half]) == 4, 20)
    os.kill(cells[half].pid, signal.SIGCONT)
    print(f"frozen: red after {took:.2f} s (5 asked)")
    cable.whole.clear()
    took = until(lambda: levels(http).get(names[-1]) == 4, 20)
    time.sleep(10.0)
    cable.whole.set()
    back = until(lambda: 0 <= levels(http).get(names[-1], 4) < 4, 30)
    print(f"cut cable: red after {took:.2f} s (5 asked), back {back:.2f} s after it was mended")
    alive = names[half:]
    for _ in range(3):
        process.kill()
        process.wait()
        time.sleep(2.0)
        process = hub(folder, port, http)
        took = until(lambda: all(0 <= levels(http).get(name, 4) < 4 for name in alive), 30)
        print(f"hub killed and started again: all {len(alive)} back after {took:.2f} s (10 asked)")
    return process


def workcell(folder):
    """Return the command of a run in a simulated workcell, with what a demo calibrated."""
    subprocess.run(
        [sys.executable, "-m", "armsight", "demo", "--quick"], cwd=folder, check=True, stdout=subprocess.DEVNULL
    )
    files = ("--rig", "demo/rig.json", "--target", "demo/body.toml", "--motion", "demo/motion.toml")
    return ["run", "--source", "sim:", "--board", "emulated:", *files]


def beside(seconds, run, hub_pid, cells, silent, folder, port, http):
    """Print how long a workcell takes from image to command, alternately with and without hub, cells and its stream."""
    for pid in silent:
        os.kill(pid, signal.SIGSTOP)
    taken = folder / "taken"
    quiet = {"cwd": folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    watched = [sys.executable, "-c", BESIDE, taken, f"cell:beside@127.0.0.1:{port}", *run]
    alone = subprocess.Popen(watched, preexec_fn=lambda: os.sched_setaffinity(0, CORES[:1]), **quiet)
    until(lambda: alone.poll() is not None or (taken.exists() and taken.read_text().count("\n") > 1), 600)
    if alone.poll() is not None:
        raise SystemExit("the workcell beside has ended")
    other, number, ends, used = None, 0, [], [cpu_s(hub_pid)[0]]
    before, end = sum(each["state"].get("shots") or 0 for each in page(http)["cells"]), time.monotonic() + seconds
    while time.monotonic() < end:
        if other is None or other.poll() is not None:
            name, number = f"w{number % 4}", number + 1
            command = [sys.executable, "-m", "armsight", *run, "-o", name, "--stream", f"cell:{name}@127.0.0.1:{port}"]
            other = subprocess.Popen(command, preexec_fn=idle, **quiet)
        time.sleep(BLOCK_S)
        page(http)
        ends.append(time.monotonic())
        for what in (signal.SIGSTOP, signal.SIGCONT):
            for pid in (hub_pid, *cells):
                os.kill(pid, what)
            for pid in silent:
                os.kill(pid, signal.SIGCONT if what == signal.SIGSTOP else signal.SIGSTOP)
            if what == signal.SIGSTOP:
                time.sleep(BLOCK_S)
                ends.append(time.monotonic())
    used.append(cpu_s(hub_pid)[0])
    time.sleep(2.0)
    shots = sum(each["state"].get("shots") or 0 for each in page(http)["cells"] if each["name"][0] == "c") - before
    for each in (alone, other):
        os.killpg(each.pid, signal.SIGKILL)
    for pid in silent:
        os.kill(pid, signal.SIGKILL)
    at, took = np.loadtxt(taken).T
    first = np.maximum.accumulate(np.where(took < 0, np.arange(len(took)), 0))  # the line with which the run began
    streams = took[first] == -2.0
    block = np.searchsorted(ends, at)
    inside = (took >= 0) & (block > 0) & (block < len(ends))
    inside &= at - np.array(ends)[np.maximum(block, 1) - 1] > BEGIN_S
    heard, share = np.array([shots, 100 * (used[1] - used[0])]) / (BLOCK_S * len(ends) / 2)
    print(f"{number} workcells in turn; {heard:.0f} shots a second of cells heard; the hub: {share:.1f} % of a core")
    found, drawn, rng, on = {}, {}, np.random.default_rng(ARGUMENTS.seed), block % 2 == 0
    kinds = {"without": ~on & ~streams, "with hub and cells": on & ~streams, "with its stream, too": on & streams}
    kinds |= {"with its stream alone": ~on & streams, "half of without": ~on & ~streams & (block % 4 == 1)}
    for label, kind in kinds.items():
        mine = took[inside & kind]
        found[label] = np.percentile(1e3 * mine, [50, 99]) if len(mine) else np.full(2, np.nan)
        change = 100 * (found[label] / found["without"] - 1)
        # Delays come in bursts: blocks are drawn anew, not shots.
        parts = [1e3 * took[inside & kind & (block == each)] for each in np.unique(block[inside & kind])]
        drawn[label] = [
            np.percentile(np.concatenate([parts[k] for k in rng.integers(len(parts), size=len(parts))]), 99)
            for _ in range(500 if parts else 0)
        ]
        low, high = (
            100 * (np.percentile(np.divide(drawn[label], drawn["without"]), [5, 95]) - 1) if parts else (np.nan, np.nan)
        )
        print(
            f"image to command {label}: {len(mine)} shots, p50 {found[label][0]:.3f}, p99 {found[label][1]:.3f} ms: "
            f"{change[0]:+.1f} %, {change[1]:+.1f} % (5 asked; 90 % of blocks drawn anew {low:+.0f} to {high:+.0f})"
        )


def renderers():
    """Return the processes in which a Chromium draws pages."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if b"--type=renderer" in path.read_bytes():
                found.add(path.parent.name)
        except OSError:
            continue
    return found


def fed(count, folder, port):
    """Return the page's address of a hub in this process that hears so many cells once a second, with a day's errors."""
    from armsight.app.hub.service import Hub

    site = Hub(folder, f"tcp/127.0.0.1:{port}", "127.0.0.1:0", None, print)
    rng, names = np.random.default_rng(ARGUMENTS.seed), [f"c{number:03d}" for number in range(count)]
    for name in names:
        site._hear(("site", name, "alive", time.time(), (name, True)))

    def states():
        while True:
            for name in names:
                now = time.time()
                values = {"rate_hz": 30.0, "missed": 0.01, "error_mm": rng.uniform(0.03, 0.06), "sigma_mm": 0.03}
                site._hear(("site", name, "state", now, {"t": now, "mode": "run", "shots": 9, "health": [], **values}))
            time.sleep(1.0)

    threading.Thread(target=states, daemon=True).start()
    until(lambda: len(site._cells) == count, 20)
    for cell in site._cells.values():
        cell.about = {"limit_mm": 0.1, "arm": "six_r", "body": "body", "rig_heldout_mm": 0.03}
        cell.day = {int(time.time() // 300) - n: rng.uniform(0.03, 0.06) for n in range(288)}
    return site.pages.address


def page_drawn(address):
    """Print how often Chromium draws the hub's page in 30 s while it is scrolled, and what its processes take."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for each in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1500,1000"):
        options.add_argument(each)
    before = renderers()
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    driver.get(address)
    time.sleep(5.0)
    driver.execute_script(
        "window.took = []; let before = performance.now(), down = 1; const draw = now => { took.push(now - before);"
        "before = now; scrollBy(0, 6 * down); if (scrollY <= 0) down = 1;"
        "if (scrollY + innerHeight >= document.body.scrollHeight - 1) down = -1; requestAnimationFrame(draw); };"
        "requestAnimationFrame(draw);"
    )
    time.sleep(30.0)
    took = np.array(driver.execute_script("return took.slice(1)"))
    cards = driver.execute_script("return document.querySelectorAll('.card').length")
    script = driver.execute_script("return performance.memory.usedJSHeapSize") / 1e6
    memory = [
        int(Path(f"/proc/{pid}/smaps_rollup").read_text().partition("Pss:")[2].split()[0]) / 1e3
        for pid in renderers() - before
    ]
    driver.quit()
    print(
        f"page of {cards} cells in Chromium, scrolled: {len(took) / (took.sum() / 1e3):.0f} images a second (30 asked), "
        f"longest {took.max():.0f} ms, p99 {np.percentile(took, 99):.0f} ms; JavaScript {script:.0f} MB, "
        f"its process {max(memory):.0f} MB (150 asked)"
    )


def counted(folder):
    """Print how many events are missing or twice in the database of a hub that has ended."""
    import sqlite3

    rows = sqlite3.connect(folder / "events.sqlite").execute("SELECT cell, n FROM events").fetchall()
    by = {}
    for name, n in rows:
        by.setdefault(name, []).append(n)
    lost = sum(max(each) - len(set(each)) for each in by.values())
    print(f"events: {len(rows)} stored, {lost} missing, {len(rows) - len(set(rows))} twice")


def alarms(days, seed):
    """Print false alarms of 20 healthy cells: white means, and slow motion beside, in some cells three times as much."""
    from armsight.app.hub.cells import CHANCE, Slopes, drifts

    kinds = (("white", 0.0, 1.0), ("moving, 40 s", 2.0, 40.0), ("moving, 5 min", 2.0, 300.0), ("1 h", 2.0, 3600.0))
    for kind, breath, tau_s in kinds:
        rng, keep, count = np.random.default_rng([seed, int(tau_s)]), np.exp(-10.0 / tau_s), 20
        state, size = np.zeros(count), breath * np.exp(rng.uniform(-0.55, 0.55, count))
        cells, alarmed, named = {str(n): Slopes() for n in range(count)}, set(), 0
        for block in range(8640 * days):
            state = keep * state + np.sqrt(1 - keep**2) * rng.standard_normal(count)
            for n, mean in enumerate(rng.standard_normal(count) + size * state):
                cells[str(n)].add(10.0 * block, mean)
            if block % 6 == 0:
                now = {name for name, found in drifts(cells, 10.0 * block + LATE_S).items() if found.chance < CHANCE}
                named, alarmed = named + len(now - alarmed), now
        print(
            f"{kind}: {named} false alarms in {count * days} cell-days, {7 * named / (count * days):.2f} a cell and week"
        )


def main():
    """Run what is asked for."""
    if ARGUMENTS.alarms:
        alarms(ARGUMENTS.alarms, ARGUMENTS.seed)
        return
    folder = Path(tempfile.mkdtemp())
    os.environ["XDG_STATE_HOME"] = str(folder / "state")
    port, http, count = free_port(), free_port(), ARGUMENTS.cells
    if ARGUMENTS.beside:
        run = workcell(folder)
        os.sched_setaffinity(0, CORES[1:])  # of all that is started, but of the workcell that is watched
    drifting = set(np.random.default_rng(ARGUMENTS.seed).choice(count, 3, replace=False)) if ARGUMENTS.drift else set()
    if ARGUMENTS.page:
        page_drawn(fed(count, folder, port))
        return
    process = hub(folder / "hub", port, http)
    cut = free_port()
    cells = started(count, port, ARGUMENTS.seed, drifting, cut)
    cable = Cable(cut, port)  # after the processes: a fork copies no threads
    took = until(lambda: len([n for n in levels(http).values() if n >= 0]) == count, 120)
    print(f"{count} cells on the page {took:.1f} s after the last was started")
    if ARGUMENTS.drift:
        for minute in range(ARGUMENTS.drift + 2):
            time.sleep(60)
            shown = page(http)["cells"]
            first = [(each["name"], each["why"] or each["drifts"]) for each in shown[:5]]
            print(
                f"minute {minute + 1}: drifting are {sorted(f'c{n:03d}' for n in drifting)}; first on the page {first}",
                flush=True,
            )
    elif ARGUMENTS.beside:
        silent = started(count, None, ARGUMENTS.seed, drifting, cut)
        beside(
            ARGUMENTS.beside, run, process.pid, *([p.pid for p in each] for each in (cells, silent)), folder, port, http
        )
    else:
        before = cpu_s(process.pid)
        began = time.monotonic()
        age = 1e3 * latencies(http, ARGUMENTS.seconds)
        used, memory = np.subtract(cpu_s(process.pid), before)[0] / (time.monotonic() - began), cpu_s(process.pid)[1]
        p50, p99 = np.percentile(age, [50, 99])
        print(f"states: {len(age)}, age at the hub p50 {p50:.1f}, p99 {p99:.1f}, most {age.max():.1f} ms (100 asked)")
        print(
            f"hub with a page that asks twice a second: {100 * used:.1f} % of a core, {memory:.0f} MB (25 %, 300 MB asked)"
        )
        if count <= 60:
            process = losses(cells, http, folder / "hub", port, process, cable)
            time.sleep(8.0)
    for each in cells:
        each.terminate()
    for each in cells:
        each.join(10)
    time.sleep(1.0)
    process.terminate()  # SIGINT is ignored by what a script starts in the background
    process.wait()
    counted(folder / "hub")


if __name__ == "__main__":
    PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    PARSER.add_argument("cells", type=int, nargs="?", default=50)
    PARSER.add_argument("--seconds", type=float, default=60.0)
    PARSER.add_argument("--rate", type=float, default=10.0, help="shots a second of a cell")
    PARSER.add_argument("--drift", type=int, default=0)
    PARSER.add_argument("--alarms", type=int, default=0)
    PARSER.add_argument("--beside", type=float, default=0.0, help="s that a workcell runs beside the cells")
    PARSER.add_argument("--page", action="store_true")
    PARSER.add_argument("--seed", type=int, default=4301)
    ARGUMENTS = PARSER.parse_args()
    main()
