"""Figures of recordings: containers, cost of run.mcap, the real bags of tags, kill -9, batches by 1, 2 and 4 processes,
recordings out of order.

    python benchmarks/record.py containers|cost|beside|paused|bags|killed|batch|disorder|read ... [--data DIR]

Each figure prints what it measured against its target; the exit code is 1 where one is missed. The map of tags of figure
``bags`` is fitted on even shots and evaluated on odd ones.
"""

from __future__ import annotations

import gc
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from armsight.app.replay.tables import compare
from armsight.app.stream.datum import Published
from armsight.app.stream.mcap_file import McapSink, properties
from armsight.data import Body, JointStates, PoseEstimate, Shot
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.loop.running.data import JointsDatum, ShotDatum
from armsight.robot.arm_file import open_arm
from armsight.vision.camera import Camera
from armsight.vision.detections import SeenShot
from armsight.vision.pose.measure import measure_seen
from armsight.vision.rig import StereoRig
from armsight.vision.sources import PairsSource, open_source

DATA = Path(os.environ.get("ARMSIGHT_DATA", Path(__file__).parents[2] / "shared" / "data"))
_missed: list[str] = []
IMAGE = "sensor_msgs/msg/Image"


def report(name: str, value: str, good: bool) -> None:
    """Print a figure, and remember one that is missed."""
    print(f"{'ok    ' if good else 'MISSED'}  {name}: {value}", flush=True)
    if not good:
        _missed.append(name)


def armsight(*arguments) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "armsight", *map(str, arguments)], capture_output=True, text=True, check=False
    )


def containers() -> None:
    """1. Real webcam images through four containers and back: pixels and poses the same."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the writers of bags are those of the tests
    from bag_files import CONTAINERS, EPOCH_NS, Pixels, Sent, write_bag

    folder = DATA / "stereo" / "webcams-360p"
    spec = "chessboard:9x6:25mm"
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        lefts, rights = f"{folder}/left*", f"{folder}/right*"
        done = armsight("calibrate", "--source", f"pairs:{lefts},{rights}", "--target", spec, "-o", here / "rig.json",
                        "--lens-model", "brown5", "--folds", 2)  # fmt: skip
        assert done.returncode == 0, done.stderr
        source = PairsSource.open(lefts, rights)
        shots = list(iter(source.read, None))
        sent = [
            Sent(f"/stereo/{side}/image_raw", EPOCH_NS + 33_000_000 * k, Pixels(shot.image(side)))
            for k, shot in enumerate(shots)
            for side in ("left", "right")
        ]
        outputs = {}
        for container in CONTAINERS:
            path = write_bag(here / container, container, sent)
            again = list(iter(open_source(f"bag:{path}").read, None))
            same = len(again) == len(shots) and all(
                np.array_equal(a.left, b.left) and np.array_equal(a.right, b.right) and a.problem is None
                for a, b in zip(again, shots, strict=True)
            )
            report(f"{container}: pixels", f"{len(again)} shots of {len(shots)}, same: {same}", same)
            outputs[container] = here / f"out_{container}"
            done = armsight("replay", path, "--rig", here / "rig.json", "--target", spec, "-o", outputs[container])
            assert done.returncode == 0, done.stderr
        for container in CONTAINERS[1:]:
            (poses,) = compare(outputs[CONTAINERS[0]], outputs[container])
            report(f"{container}: poses", f"{poses.rows} rows, same to the last digit: {poses.same}", poses.same)
        direct = armsight("measure", here / "rig.json", "--target", spec, "--source", f"pairs:{lefts},{rights}",
                          "-o", here / "direct.csv")  # fmt: skip
        assert direct.returncode in (0, 3), direct.stderr
        rows = [line.split(",")[4:] for line in (here / "direct.csv").read_text().splitlines()]
        bags = [line.split(",")[4:] for line in (outputs["ros1"] / "poses.csv").read_text().splitlines()]
        report("poses of the files", f"same to the last digit: {rows == bags}", rows == bags)


def cost() -> None:
    """2. CPU of run.mcap a shot, all threads, and its size: JPEG images of 1280x720, joints at 250 Hz."""
    rng = np.random.default_rng(0)
    cameras = [Camera((1280, 720), "none", np.array([900.0, 900.0, 640.0, 360.0]), np.zeros(0)) for _ in range(2)]
    rig = StereoRig(*cameras, pose(np.eye(3), np.array([0.2, 0.0, 0.0])), np.eye(14) * 1e-12, 0.1)
    body = Body("plate", tuple(f"P{k}" for k in range(12)), rng.uniform(-0.1, 0.1, (12, 3)))
    T = pose(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.0, 0.8]))
    p = transform(T, body.points)
    ids = np.arange(12)
    uv = (cameras[0].project(p), cameras[1].project(transform(inverse(rig.T_left_right), p)))
    result = measure_seen(rig, body, SeenShot("a", (ids, ids), uv))
    assert isinstance(result, PoseEstimate)
    blurred = [cv2.GaussianBlur(rng.integers(0, 255, (720, 1280), np.uint8), (0, 0), 2) for _ in range(2)]
    jpeg = tuple(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes() for image in blurred)
    arm, count = open_arm("six_r"), 600
    for name, encoded in (("with JPEG images", jpeg), ("without images", None)):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.mcap"
            sink = McapSink(path, Published(rig, body, arm, properties(rig, None, arm)))
            sink.start()
            began = time.thread_time()
            for k in range(count):
                shot = Shot(f"{k:06d}", None, None, k / 60, None, encoded)
                for j in range(4):
                    t_s = k / 60 + 0.004 * j + 0.001 * np.arange(1, 5)
                    states = JointStates(t_s, rng.normal(size=(4, 6)))
                    sink.put(JointsDatum(states, T, result.cov, 0.01))
                sink.put(ShotDatum(shot, result, k / 60 + 0.02, 1e-4, "used", T, T))
                while sink._queue:  # the loop has 17 ms; here the thread is waited for, and that is not counted
                    time.sleep(1e-4)
            mine = time.thread_time() - began
            sink.close()
            assert sink.dropped == 0, sink.dropped
            ms = 1e3 * sink.cpu_s / count
            report(
                f"CPU of the writer a shot, {name}",
                f"{ms:.2f} ms (target 2); caller {1e3 * mine / count:.2f} ms",
                ms <= 2.0,
            )
            if encoded is not None:
                share = path.stat().st_size / (count * sum(map(len, encoded))) - 1
                report(
                    "size beyond the images",
                    f"{100 * share:.1f} % (target 5), joints at 250 Hz included",
                    share <= 0.05,
                )
            else:
                print(f"        without images {path.stat().st_size / count / 1e3:.1f} kB a shot")


def beside(blocks: int = 40, shots: int = 60) -> None:
    """3. A loop at 60 Hz in real time, recorded in every other second: image to command, side by side in one run."""
    from armsight.loop.estimators import Delay, KalmanEstimator
    from armsight.loop.running.loop import SWITCH_S
    from armsight.vision.follow.follower import Follower
    from disc_images import exposed
    from marker_follow import path
    from marker_plate import LENS, light_of, parallel_rig, views
    from marker_report import disc_target, opened

    rng, rig, target = np.random.default_rng(3), parallel_rig(LENS, 3.0), disc_target()
    way = path(shots)
    way = way[::2] + way[::-2]  # there and back
    pairs, files = [], []
    for T in way:
        lights = (light_of(c, target, at) for c, at in zip(rig.cameras, views(rig, T), strict=True))
        pairs.append(tuple(exposed(light, 2.0, 0.0, rng) for light in lights))
        files.append(tuple(cv2.imencode(".jpg", image)[1].tobytes() for image in pairs[-1]))
    arm, follower = open_arm("six_r"), Follower(rig, opened(target))
    estimator = KalmanEstimator(arm, delay=Delay(0.02, 0.01))
    latency: dict[bool, list[float]] = {False: [], True: []}
    period_s, interval = 1 / 60, sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.disable()
    with tempfile.TemporaryDirectory() as folder:
        sink = McapSink(Path(folder) / "run.mcap", Published(rig, opened(target).body, arm, properties(rig, None, arm)))
        sink.start()
        began = time.monotonic()
        for k in range(-len(pairs), blocks * len(pairs)):  # the first round warms up
            recorded = (k // len(pairs)) % 2 == 0
            due_s = began + (k + len(pairs)) * period_s
            for batch in range(4):  # joint readings arrive in between, as from a board
                time.sleep(max(0.0, due_s + (batch - 4) * 0.004 - time.monotonic()))
                t_s = due_s + (batch - 4) * 0.004 + 0.001 * np.arange(4)
                states = JointStates(t_s, 0.1 + 1e-4 * rng.normal(size=(4, 6)))
                estimator.joints(states)
                estimate = estimator.estimate()
                if recorded:
                    sink.put(JointsDatum(states, estimate.T_base_tool, estimate.cov, estimate.vision_age_s))
            time.sleep(max(0.0, due_s - time.monotonic()))
            begun = time.perf_counter()
            shot = Shot(f"{k:06d}", *pairs[k % len(pairs)], due_s, None, files[k % len(pairs)])
            result = follower.measure(shot)
            if k >= 0:
                latency[recorded].append(time.perf_counter() - begun)
            if recorded:
                sink.put(ShotDatum(shot, result, time.monotonic(), 1e-4, "used"))
        sink.close()
    gc.enable()
    sys.setswitchinterval(interval)
    off, on = (1e3 * np.percentile(latency[each], (50, 99)) for each in (False, True))
    print(f"        without: p50 {off[0]:.3f}, p99 {off[1]:.3f} ms; beside the recording: {on[0]:.3f}, {on[1]:.3f} ms; "
          f"{len(latency[True])} shots each, {sink.dropped} dropped")  # fmt: skip
    # p99 of a subset scatters: the same ratio between the halves of the shots without recording shows by how much
    halves = [float(np.percentile(latency[False][half::2], 99)) for half in range(2)]
    change = on[1] / off[1] - 1
    report("p99 from image to command", f"{100 * change:+.1f} % (target 5; two halves without it differ by "
           f"{100 * abs(halves[0] / halves[1] - 1):.1f} %)", abs(change) <= 0.05)  # fmt: skip


def paused(blocks: int = 6, shots: int = 150) -> None:
    """4. Computing time that run.mcap's thread takes from a loop between image and command: as it comes, and paused."""
    from marker_plate import LENS, parallel_rig
    from marker_report import disc_target, opened

    rng, rig, arm = np.random.default_rng(4), parallel_rig(LENS, 3.0), open_arm("six_r")
    states = JointStates(0.001 * np.arange(4), 0.1 + 1e-4 * rng.normal(size=(4, 6)))
    joints = JointsDatum(states, arm.forward(arm.home), np.eye(6), 0.0)
    published = Published(rig, opened(disc_target()).body, arm, properties(rig, None, arm))

    def work() -> None:  # about a millisecond of short calls, as a shot is
        for _ in range(150):
            np.linalg.solve(np.eye(6), np.eye(6))

    taken: dict[bool, list[float]] = {False: [], True: []}
    for block in range(blocks):
        with tempfile.TemporaryDirectory() as folder:
            sink = McapSink(Path(folder) / "run.mcap", published)
            sink.start()
            for _ in range(shots):
                for _ in range(4):
                    sink.put(joints)
                if block % 2:
                    sink.pause()
                both, own = time.process_time(), time.thread_time()
                work()
                taken[bool(block % 2)].append(time.process_time() - both - (time.thread_time() - own))
                sink.resume()
                work()
                time.sleep(5e-4)  # the board
            sink.close()
    off, on = (1e3 * np.array(taken[each]) for each in (False, True))
    text = [f"{each.mean():.2f}; {np.percentile(each, 99):.2f} ms" for each in (on, off)]
    report("taken between image and command, mean; 99th percentile",
           f"{text[0]} (not paused {text[1]}; target a third of that)", bool(on.mean() <= off.mean() / 3))  # fmt: skip


#: Recordings: calibration by their author, side of the tags, m, pairs of topics.
BAGS = {
    "tagslam_2": (0.16, ""),
    "tagslam_11": (0.15, ""),
    "tagslam_21": (0.16, ",left=/t265/fisheye1/tags,right=/t265/fisheye2/tags"),
}


def bags() -> None:
    """4. The real bags: every shot measured or missed with a reason; one tag predicted from the others."""
    from tag_map import evaluated  # beside this file

    for name, (side_m, topics) in BAGS.items():
        found = evaluated(DATA / "bags" / name, side_m, topics)
        print(f"  {name}: {found.text}")
        counts = f"{found.measured} measured, {found.missed} missed of {found.shots}"
        report(f"{name}: every shot has a pose or a reason", counts, found.measured + found.missed == found.shots)
        ratio = found.ratio
        report(f"{name}: left-out tag, residual over sigma", f"{ratio:.2f} (target 0.8 to 1.25), {found.left_out} tags",
               0.8 <= ratio <= 1.25)  # fmt: skip


KILLED = """
import sys, time
import numpy as np
from pathlib import Path
from armsight.app.stream.datum import Published
from armsight.loop.running.data import NoteDatum
from armsight.app.stream.mcap_file import McapSink
sink = McapSink(Path(sys.argv[1]), Published())
sink.start()
for k in range(100_000):
    sink.put(NoteDatum(time.time(), str(k)))
    print(time.time(), flush=True)
    time.sleep(0.005)
"""


def killed() -> None:
    """5. Kill -9 in the midst, ten times at different moments: what was written opens, and how much is missing."""
    from armsight.vision.sources.bag import Bag

    missing = []
    for k in range(10):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.mcap"
            process = subprocess.Popen([sys.executable, "-c", KILLED, path], stdout=subprocess.PIPE, text=True)
            first = last = None
            for line in process.stdout:
                last = float(line)
                first = first or last
                if last - first > 1.0 + 0.13 * k:
                    break
            process.send_signal(signal.SIGKILL)
            process.wait()
            stamps = [m.decode().timestamp for m in Bag(path).messages(["/log"])]
            missing.append(last - (stamps[-1].seconds + 1e-9 * stamps[-1].nanos))
    report("kill -9, newest missing", f"at most {max(missing):.2f} s of ten (target 1)", max(missing) <= 1.0)


def batch(count: int = 100) -> None:
    """6. Recordings by 1, 2 and 4 worker processes: the same tables, and how much faster two are."""
    from pyarrow import parquet

    from armsight.app.batch.run import Batch, run_batch
    from armsight.app.batch.work import BatchOptions

    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        folder = DATA / "stereo" / "opencv-480p"
        spec = "chessboard:9x6:25mm"
        done = armsight("calibrate", "--source", f"pairs:{folder}/left*,{folder}/right*", "--target", spec,
                        "-o", here / "rig.json", "--lens-model", "brown5", "--folds", 2)  # fmt: skip
        assert done.returncode == 0, done.stderr
        lefts = sorted(folder.glob("left*"))
        for k in range(count):
            take = here / "archive" / f"take{k:03d}"
            take.mkdir(parents=True)
            for left in itertools.islice(itertools.cycle(lefts), k % len(lefts), k % len(lefts) + 4):
                for file in (left, folder / left.name.replace("left", "right")):
                    os.symlink(file, take / file.name)
        options = BatchOptions("measure", str(here / "rig.json"), spec)
        seconds, tables = {}, {}
        for workers in (1, 2, 4):
            out = here / f"out{workers}"
            began = time.monotonic()
            run_batch(Batch([str(here / "archive" / "take*")], out, options, str(workers)), lambda line: None)
            seconds[workers] = time.monotonic() - began
            tables[workers] = [parquet.read_table(out / n) for n in ("recordings.parquet", "shots.parquet")]
            print(
                f"        {workers} workers: {seconds[workers]:.1f} s, {tables[workers][1].num_rows} shots", flush=True
            )
        same = all(a.equals(b) for w in (2, 4) for a, b in zip(tables[1], tables[w], strict=True))
        shots = tables[1][1].num_rows
        report("tables of 1, 2 and 4 workers", f"{shots} shots, same to the last digit: {same}", same and shots > 0)
        faster = seconds[1] / seconds[2]
        report("two processes against one", f"{faster:.2f} times (target 1.8; wants two idle cores)", faster >= 1.8)


def disorder() -> None:
    """7. 200 recordings out of order, in 2 to 15 files, four containers: every whole pair in order, every other named."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from bag_files import CONTAINERS, disordered, pairs_found

    whole = measured = named = others = 0
    wrong = []
    for seed in range(200):
        with tempfile.TemporaryDirectory() as folder:
            bag = disordered(Path(folder), CONTAINERS[seed % 4], 5000 + seed)
            found, problems = pairs_found(bag.spec)
        whole, measured = whole + len(bag.pairs), measured + len(found)
        others, named = others + bag.others, named + len(problems)
        if found != bag.pairs or len(problems) != bag.others:
            wrong.append(f"{seed} ({CONTAINERS[seed % 4]})")
    counted = f"{measured} of {whole} pairs, {named} of {others} others named; not: {', '.join(wrong) or 'none'}"
    report("recordings out of order", f"{200 - len(wrong)} of 200 whole and in order, {counted}", not wrong)


def read(count: int = 150, rounds: int = 5) -> None:
    """8. Raw 1280x720 pairs of a ROS 1 bag beside rosbags' own loop, which reuses its memory, or keeps its images, too."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind, header, stamp = (store.types[name] for name in (IMAGE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
    pixels = np.random.default_rng(1).integers(0, 255, 1280 * 720, np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pairs.bag"
        with Writer(path) as writer:
            topics = [writer.add_connection(f"/{side}/image_raw", IMAGE, typestore=store) for side in ("left", "right")]
            for k, topic in itertools.product(range(count), topics):
                about = header(k, stamp(1000 + k // 30, k % 30 * 33_000_000), "camera")
                message = kind(about, 720, 1280, "mono8", 0, 1280, np.roll(pixels, k))
                writer.write(topic, 10**12 + k * 33_000_000, store.serialize_ros1(message, IMAGE))

        def plain(kept: list | None = None) -> None:
            with AnyReader([path]) as reader:
                for connection, _, data in reader.messages():
                    image = reader.deserialize(data, connection.msgtype).data.reshape(720, 1280)
                    if kept is not None:
                        kept.append(image)

        def dropped() -> None:
            source = open_source(f"bag:{path}")
            while (shot := source.read()) is not None:
                del shot

        def looped(kept: list | None = None) -> None:
            for shot in iter(open_source(f"bag:{path}").read, None):
                if kept is not None:
                    kept.append(shot)

        jobs = {"dropped at once": (dropped, plain), "in a loop": (looped, plain)}
        jobs["kept by both"] = lambda: looped([]), lambda: plain([])
        spent: dict[str, list[list[float]]] = {name: [] for name in jobs}
        for _, (name, both) in itertools.product(range(rounds), jobs.items()):
            spent[name].append([])
            for job in both:
                began = time.process_time()
                job()
                spent[name][-1].append(time.process_time() - began)
    for name, each in spent.items():
        over = np.min(each, axis=0)[0] / np.min(each, axis=0)[1]
        report(f"pairs of a ROS 1 bag, {name}, over rosbags", f"{over:.2f} (target 2)", over <= 2)


FIGURES = {"containers": containers, "cost": cost, "beside": beside, "paused": paused}
FIGURES |= {"bags": bags, "killed": killed, "batch": batch, "disorder": disorder, "read": read}

if __name__ == "__main__":
    for figure in sys.argv[1:] or FIGURES:
        print(f"{figure}: {FIGURES[figure].__doc__}")
        FIGURES[figure]()
    sys.exit(1 if _missed else 0)
