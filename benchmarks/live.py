"""The live page: how soon it stops, what it costs, whether its memory is flat, and what the guide saves.

python live.py stop 100      stops by the page's button in a headless browser, while the workcell's views run at 15 Hz
python live.py moving 40     the same while the simulated loop moves the arm, searches images, and fits calibrations
python live.py loop 4        image to command in one run, alternately without and with a page that looks on; the ratio
python live.py attacked 200  image to command while a page names devices, pipes, huge files, odd JSON, and many sockets come
python live.py first 3       from the first page to a written calibration by a person who follows the page: shots and error
python live.py cost          processor's share of two 1280x720 views, first picture, memory over ten thousand frames
python live.py guided 10     guided against random shots, ten seeds: projected points, hands that miss the outline
"""

import contextlib
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np

from armsight.app.live import records
from armsight.app.live.capture import CameraCapture
from armsight.app.live.server import LiveServer
from armsight.app.live.session import LiveSession, SessionOptions
from armsight.data import Detections, Shot
from armsight.geometry.pose import exp_se3, inverse, transform
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.scene import chessboard
from armsight.sim.workcell.workcell import Workcell
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.guide import CalibrationAim, Guide, Knowledge, working_points
from armsight.vision.calibrate.heldout import pair_errors
from armsight.vision.markers.board import open_board
from armsight.vision.match import join
from armsight.vision.pose.bundle import Observations
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import optimal_points


def browser(address):
    """Open the page in a headless browser."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    driver.get(address)
    return driver


def until(true, patience_s=120.0):
    """Wait for something."""
    end = time.monotonic() + patience_s
    while not true():
        if time.monotonic() > end:
            raise SystemExit("did not happen in time")
        time.sleep(0.02)


def shown(driver):
    """Return how many images the page has shown of the slower side."""
    return driver.execute_script("return window.armsight ? Math.min(...armsight.frames) : 0")


def at_the_page(cameras, seed=0):
    """Return a session of the workcell with its true cameras as the rig, a server, and a browser that shows the page."""
    folder = Path(tempfile.mkdtemp())
    with Workcell.open(arm="worn", cameras=cameras, seed=seed) as workcell:
        workcell.truth.rig.save(folder / "rig.json")
    session = LiveSession(SessionOptions(folder / "live", f"sim:{cameras}", rig=folder / "rig.json", seed=seed))
    session.start()
    server = LiveServer(session, port=0)
    server.start()
    driver = browser(server.address)
    until(lambda: shown(driver) > 2)
    session.execute(records.OpenArm())
    until(lambda: session.arm.state.q_deg)
    return session, server, driver


def stop(count: int, *, moving: bool) -> None:
    """Measure stops in the browser, from the key to the state of the board."""
    session, server, driver = at_the_page("1280x720@15")
    frames, began, rng, phases = shown(driver), time.monotonic(), np.random.default_rng(0), {}
    for n in range(count):
        if moving:
            session.execute(records.GuideHandEye() if n % 2 else records.RunMotions())
            until(lambda: session.arm._board.status.drives_on)
            time.sleep(rng.uniform(0.2, 6.0))
            phase = session.arm.state.running or "between"
            phases[phase.split(":")[0]] = phases.get(phase.split(":")[0], 0) + 1
        driver.execute_script("stop()")
        until(lambda n=n: driver.execute_script("return armsight.stopMs.length") > n)
        answer = driver.execute_script("return armsight.stopAnswer")
        if not answer["stopped"]:
            raise SystemExit(f"not stopped: {answer}")
        until(lambda: not session.sections()["overview"].moving)
        session.execute(records.ClearStop())
        until(lambda: not session.arm.state.stopped)
        if session.arm.state.away:
            session.execute(records.GoToStart())
            until(lambda: not session.arm.state.away and not session.sections()["overview"].moving, 300.0)
    rate = (shown(driver) - frames) / (time.monotonic() - began)
    took = np.array(driver.execute_script("return armsight.stopMs"))
    p50, p99 = np.percentile(took, (50, 99))
    how = "the loop moves the arm" if moving else "the arm at rest"
    print(f"stop, {how}, key to board, {count} stops: p50 {p50:.1f} ms, p99 {p99:.1f} ms, most {took.max():.1f} ms")
    print(f"views shown meanwhile: {rate:.1f} a second of each side; stopped while: {phases}")
    driver.quit()
    server.close()
    session.close()


#: Looks on as a page does: takes every image and state, says that it showed them.
_PAGE = """
import json, sys
from websockets.sync.client import connect
at = sys.argv[1]
with connect(f"ws://{at}/live", origin=f"http://{at}", max_size=2**24) as page:
    while True:
        message = page.recv()
        if isinstance(message, bytes):
            page.send(json.dumps({"shown": [message[0], int.from_bytes(message[1:5], "little")]}))
        page.send("alive")
"""


def loop(blocks: int) -> None:
    """Compare the control loop's times without and with a page, alternately by 60 shots: the load is alike."""
    session, server, driver = at_the_page("1280x720@30")
    driver.quit()
    session.execute(records.GuideHandEye())
    until(lambda: session.arm.state.handeye.good and not session.sections()["overview"].moving, 900.0)
    times = {False: [], True: []}
    while min(len(each) for each in times.values()) < 60 * blocks:
        with_page = len(times[True]) < len(times[False])
        page = None
        if with_page:
            page = subprocess.Popen([sys.executable, "-c", _PAGE, f"127.0.0.1:{server.port}"])
            until(lambda: server._clients)
        while (running := session.arm._loop) is None or not len(running.log.latency_s):
            if not session.arm.busy:
                session.execute(records.GoToStart() if session.arm.state.away else records.RunMotions())
            time.sleep(0.2)
        log, seen = running.log, len(running.log.latency_s)
        until(lambda log=log, seen=seen: len(log.latency_s) >= seen + 60 or session.arm._loop is None, 300.0)
        times[with_page] += list(log.latency_s.array(1)[seen:, 0])
        if page is not None:
            page.terminate()
            page.wait()
            until(lambda: not server._clients)
    for with_page, label in ((False, "without a page"), (True, "with a page")):
        p50, p99 = 1e3 * np.percentile(times[with_page], (50, 99))
        print(f"image to command {label}: p50 {p50:.2f} ms, p99 {p99:.2f} ms, {len(times[with_page])} shots")
    ratio = [np.percentile(times[True], q) / np.percentile(times[False], q) for q in (50, 99)]
    print(f"with over without: p50 {ratio[0]:.2f}, p99 {ratio[1]:.2f}")
    server.close()
    session.close()


def attacks(count, folder, rng):
    """Return attacks, each a text that is sent to /live, bytes to the port, or a number of sockets to be opened."""
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to(folder / "loop")
    with (folder / "huge").open("wb") as file:
        file.truncate(6_000_000_000)
    names = ("/dev/zero", "/dev/random", "/dev/stdin", "/proc/self/mem", "/proc/kmsg", folder / "pipe", folder / "huge",
             folder, folder / "loop", "../../../../etc/shadow", "a\0b", "x" * 3000, "", "~root")  # fmt: skip
    fields = (("UseBoard", "spec"), ("UseBody", "target"), ("UseSecondBody", "target"), ("UseArm", "arm"),
              ("UseMotion", "path"), ("DrawBoard", "paper"), ("DropShot", "name"), ("GoTo", "step"))  # fmt: skip
    kinds = ("", "bag:", "video:", "folder:", "chessboard:", "charuco:")
    odd = ('{"command": "GoTo", "step": NaN}', "[" * 4000, '{"command": {"command": 1}}', "{}", "null", "\ud83d", '"',
           "1e999",
           '{"command": "SetAim", "error_mm": 1e308, "distance_m": -1e308}', '{"command": "__class__"}', "9" * 4000,
           '{"command": "UseBoard", "spec": "chessboard:99999x99999:1mm"}', "x" * 5_000_000)  # fmt: skip
    raw = (b"GET /" + b"../" * 40 + b"etc/passwd HTTP/1.1\r\nHost: HOST\r\n\r\n", b"\0" * 100_000,
           b"GET / HTTP/1.1\r\n",
           b"GET /board.pdf HTTP/1.1\r\nHost: elsewhere\r\n\r\n", b"A: " + b"b" * 200_000,
           b"GET /live HTTP/1.1\r\nHost: HOST\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: x\r\n"
           b"Sec-WebSocket-Version: 13\r\n\r\n")  # fmt: skip
    for _ in range(count):
        kind = rng.random()
        if kind < 0.6:
            command, field = fields[rng.integers(len(fields))]
            yield json.dumps({"command": command, field: f"{rng.choice(kinds)}{names[rng.integers(len(names))]}"})
        elif kind < 0.8:
            yield odd[rng.integers(len(odd))]
        else:
            yield raw[rng.integers(len(raw))] if kind < 0.95 else 50


def attack(port, seed, count):
    """Attack a page, two a second; print how many attacks were made and what was answered to the last."""
    from websockets.sync.client import connect

    rng, host, held, made = np.random.default_rng(seed), f"127.0.0.1:{port}", [], 0
    for one in attacks(count, Path(tempfile.mkdtemp()), rng):
        with contextlib.suppress(Exception):  # a rejected or closed connection is an answer
            if isinstance(one, str):
                with connect(f"ws://{host}/live", origin=f"http://{host}", max_size=2**24, open_timeout=5) as page:
                    page.send(one)
                    time.sleep(0.3)
            elif isinstance(one, bytes):
                with socket.create_connection(("127.0.0.1", port), 5) as given:
                    given.sendall(one.replace(b"HOST", host.encode()))
            else:
                held = [socket.create_connection(("127.0.0.1", port), 5) for _ in range(one)]
        made += 1
        time.sleep(0.2)
    for one in held:
        one.close()
    print(f"{made} attacks made", flush=True)


def attacked(count: int) -> None:
    """Compare the control loop's times unattacked and attacked, in turn by 40 shots, until the attacks are over."""
    folder = Path(tempfile.mkdtemp())
    with Workcell.open(arm="worn", cameras="640x480@15", seed=0) as workcell:
        workcell.truth.rig.save(folder / "rig.json")
    session = LiveSession(SessionOptions(folder / "live", "sim:640x480@15", rig=folder / "rig.json", seed=0))
    session.start()
    server = LiveServer(session, port=0)
    server.start()
    session.execute(records.OpenArm())
    until(lambda: session.arm.state.q_deg)
    session.execute(records.GuideHandEye())
    until(lambda: session.arm.state.handeye.good and not session.sections()["overview"].moving, 1500.0)
    times = {False: [], True: []}
    before_mb, most_mb, made, block = resident_mb(), 0.0, 0, max(count // 5, 1)
    while made < count:
        for under in (False, True):
            script = f"import live; live.attack({server.port}, {made}, {block})"
            here = Path(__file__).parent
            attacker = subprocess.Popen([sys.executable, "-c", script], cwd=here) if under else None
            while attacker is None or attacker.poll() is None:
                while (running := session.arm._loop) is None or not len(running.log.latency_s):
                    if not session.arm.busy:
                        session.execute(records.GoToStart() if session.arm.state.away else records.RunMotions())
                    time.sleep(0.2)
                log, seen = running.log, len(running.log.latency_s)
                until(lambda log=log, seen=seen: len(log.latency_s) >= seen + 40 or session.arm._loop is None, 300.0)
                times[under] += list(log.latency_s.array(1)[seen:, 0])
                most_mb = max(most_mb, resident_mb())
                if attacker is None and len(times[False]) >= len(times[True]):
                    break
            made += block if under else 0
    for under, label in ((False, "unattacked"), (True, "attacked")):
        p50, p99 = 1e3 * np.percentile(times[under], (50, 99))
        print(f"image to command {label}: p50 {p50:.2f} ms, p99 {p99:.2f} ms, {len(times[under])} shots")
    with urllib.request.urlopen(server.address, timeout=10) as answer:
        print(
            f"{made} attacks; the page answers {answer.status}; memory {before_mb:.0f} MB before, at most {most_mb:.0f} MB"
        )
    server.close()
    session.close()


def first(seeds: int) -> None:
    """Go from the first page to a written calibration as a person does who does what the page says, by its buttons."""
    for seed in range(seeds):
        folder = Path(tempfile.mkdtemp())
        session = LiveSession(SessionOptions(folder / "live", "sim:1280x720@15", seed=seed))
        session.start()
        server = LiveServer(session, port=0)
        server.start()
        driver = browser(server.address)
        until(lambda d=driver: shown(d) > 2)
        began = time.monotonic()

        def press(name, driver=driver):
            there = f"const e = document.getElementById('{name}'); return e && !e.disabled && !e.hidden"
            until(lambda: driver.execute_script(there))
            driver.execute_script(f"document.getElementById('{name}').click()")

        for name in ("next-step", "next-step", "k-run"):
            press(name)
            time.sleep(1.0)
        until(lambda s=session: s.calibration.state.good, 900.0)
        press("k-finish")
        until(lambda s=session: s.calibration.state.rig, 300.0)
        shots, minutes = len(session.calibration.state.shots), (time.monotonic() - began) / 60
        true, rig = session.shared.simulated.workcell.truth.rig, StereoRig.load(session.folder / "rig.json")
        points = working_points(true, 0.8)
        p_right = transform(inverse(true.T_left_right), points)
        uv = np.stack([true.left.project(points), true.right.project(p_right)], axis=1)
        found, _, _ = optimal_points(rig, uv, np.tile(np.eye(2), (len(uv), 2, 1, 1)))
        error_mm = 1e3 * float(np.sqrt(((found - points) ** 2).sum(axis=1).mean()))
        last = session.calibration.state.progress[-1]
        print(
            f"seed {seed}: {shots} shots, {minutes:.1f} minutes; predicted {last.predicted_mm:.3f} mm, true error in the "
            f"volume {error_mm:.3f} mm, held out {last.heldout_mm:.3f} mm",
            flush=True,
        )
        driver.quit()
        server.close()
        session.close()


class Pictures:
    """A source of two pictures with something that moves, at a rate."""

    count = None

    def __init__(self, rate_hz: float) -> None:
        self.period_s, self.due_s, self.number = 1.0 / rate_hz, time.monotonic(), 0
        rng = np.random.default_rng(0)
        small = rng.integers(0, 255, (45, 80), dtype=np.uint8)
        self.image = np.kron(small, np.ones((16, 16), np.uint8))

    def read(self):
        """Return the next shot when it is due."""
        self.due_s += self.period_s
        time.sleep(max(0.0, self.due_s - time.monotonic()))
        self.number += 1
        left = np.roll(self.image, 7 * self.number, axis=1)
        return Shot(f"{self.number}", left, np.roll(left, 40, axis=1), time.monotonic())

    def close(self):
        """Do nothing."""


def resident_mb() -> float:
    """Return the memory of this process that is resident, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def cost() -> None:
    """Measure the processor's share, the first picture, and memory."""
    session = LiveSession(SessionOptions(Path(tempfile.mkdtemp()) / "live", "folder:none"))
    session.shared.capture = CameraCapture(lambda: Pictures(15.0))
    session.start()
    server = LiveServer(session, port=0)
    server.start()
    until(lambda: session.capture.newest is not None)

    def share(seconds: float) -> float:
        before, began = time.process_time(), time.monotonic()
        time.sleep(seconds)
        return (time.process_time() - before) / (time.monotonic() - began)

    alone = share(10.0)
    driver = browser(server.address)
    until(lambda: shown(driver) > 10)
    print(f"first picture {driver.execute_script('return armsight.firstMs'):.0f} ms after the page's script began")
    frames, began = shown(driver), time.monotonic()
    both = share(10.0)
    rate = (shown(driver) - frames) / (time.monotonic() - began)
    print(
        f"two 1280x720 views: {rate:.1f} a second of each side shown; the processor's share {100 * both:.1f}% of a core, "
        f"{100 * alone:.1f}% without a page"
    )
    session.capture.close()
    session.shared.capture = CameraCapture(lambda: Pictures(150.0))
    session.capture.start()
    until(lambda: session.capture.newest is not None and session.capture.newest.number > 500)
    first, begun = session.capture.newest.number, resident_mb()
    until(lambda: session.capture.newest.number - first >= 10_000, 600.0)
    print(f"{session.capture.newest.number - first} frames: memory {begun:.0f} -> {resident_mb():.0f} MB")
    driver.quit()
    server.close()
    session.close()


BOARD, SIGMA_PX, HAND = open_board("chessboard:9x6:30mm"), 0.05, np.repeat((0.012, np.radians(3.0)), 3)


def seen(rig, T, name, rng, noise_px=SIGMA_PX):
    """Return what both cameras detect of the board at a pose, with noise."""
    p, count = transform(T, BOARD.body.points), len(BOARD.body.points)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (count, 1, 1))
    views = rig.left.project(p), rig.right.project(transform(inverse(rig.T_left_right), p))
    return Pair(
        name, *(Detections(np.arange(count), uv + noise_px * rng.standard_normal(uv.shape), cov) for uv in views)
    )


def errors_mm(true, rig, tests):
    """Return the RMS error of points of the working volume, and the rigid RMS of exact boards nobody fitted, mm."""
    points = working_points(true, 0.8)
    uv = np.stack(
        [true.left.project(points), true.right.project(transform(inverse(true.T_left_right), points))], axis=1
    )
    found, _, _ = optimal_points(rig, uv, np.tile(np.eye(2), (len(uv), 2, 1, 1)))
    heldout = pair_errors(rig, BOARD.body.points, tests)
    return 1e3 * float(np.sqrt(((found - points) ** 2).sum(axis=1).mean())), 1e3 * float(
        np.sqrt((heldout.rigid_m**2).mean())
    )


def guided(seeds: int) -> None:
    """Compare guided shots, by a hand that misses the outline, with random ones."""
    counts, rows = (10, 25), []
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 22])
        true = example_rig((1280, 720), float(rng.uniform(850, 1000)), convergence_deg=float(rng.uniform(0, 12)))
        pattern = chessboard(9, 6, 0.030)
        tests = board_poses(rng, true, pattern, 30)
        flat = Observations.from_shots([join(p.left, p.right) for p in (seen(true, T, "", rng, 0.0) for T in tests)])
        random = [seen(true, T, f"r{n}", rng) for n, T in enumerate(board_poses(rng, true, pattern, 40))]
        sizes = (true.left.image_size_px, true.right.image_size_px)

        def fit(pairs, sizes=sizes):
            return calibrate_boards(BOARD, pairs, sizes, models=("brown5",), folds=4)

        guide, aim, result, knowledge = Guide(BOARD, seed), CalibrationAim(), None, None
        row = [errors_mm(true, fit(random[:n]).rig, flat) for n in (*counts, 40)]
        pairs = random[:4]
        for n in range(5, counts[-1] + 1):
            if result is None or n in (8, 13, 19):
                result = fit(pairs)
                knowledge = Knowledge.of(result, BOARD, aim)
            T = guide.best(knowledge, result.rig).T_left_board
            for share in (1.0, 0.5, 0.25, 0.0):
                shown_at = T @ exp_se3(share * rng.normal(0, 1, 6) * HAND)
                if guide.in_view(true, shown_at[None])[0]:
                    break
            pairs = [*pairs, seen(true, shown_at, f"g{n}", rng)]
            knowledge = knowledge.after(shown_at)
            if n in counts:
                row.append(errors_mm(true, fit(pairs).rig, flat))
        rows.append(row)
        print(seed, " ".join(f"{volume:.3f}/{held:.4f}" for volume, held in row), flush=True)
    median = np.median(np.array(rows), axis=0)
    names = [*(f"random {n}" for n in (*counts, 40)), *(f"guided {n}" for n in counts)]
    print("median over the seeds: error of points in the volume, mm; rigid RMS of exact boards nobody fitted, mm")
    for name, (volume, held) in zip(names, median, strict=True):
        print(f"{name:10s} {volume:.4f} {held:.4f}")
    worse = sum(row[-1][0] > row[len(counts)][0] for row in rows)
    print(f"guided {counts[-1]} worse in the volume than random 40: {worse} of {len(rows)} seeds")


if __name__ == "__main__":
    what, number = [*sys.argv[1:], "cost", "10"][:2] if len(sys.argv) == 1 else [*sys.argv[1:], "10"][:2]
    {
        "stop": lambda: stop(int(number), moving=False),
        "moving": lambda: stop(int(number), moving=True),
        "loop": lambda: loop(int(number)),
        "attacked": lambda: attacked(int(number)),
        "first": lambda: first(int(number)),
        "cost": cost,
        "guided": lambda: guided(int(number)),
    }[what]()
