"""run.mcap: its messages are Foxglove's, another library reads them, and a killed process loses at most a second."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap_protobuf")
pytest.importorskip("foxglove_schemas_protobuf")

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.mcap_file import LazyMcap, McapBeside, McapSink, arm_of, properties
from armsight.data import Body, Dropped, JointStates, Missed, Shot
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, quaternion_wxyz
from armsight.loop.running.data import EventDatum, JointsDatum, NoteDatum, ShotDatum, quaternion
from armsight.robot.arm_file import open_arm
from armsight.vision.detections import SeenShot
from armsight.vision.pose.measure import measure_seen
from strategies import ordinary_rig

RIG = ordinary_rig("brown5")
BODY = Body("plate", tuple(f"P{k}" for k in range(6)), np.random.default_rng(3).uniform(-0.1, 0.1, (6, 3)))


def measured():
    """A pose estimate of the body half a metre ahead."""
    T = pose(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.05, 0.0, 0.6]))
    p_left = BODY.points @ T[:3, :3].T + T[:3, 3]
    T_rl = np.linalg.inv(RIG.T_left_right)
    uv = [RIG.left.project(p_left), RIG.right.project(p_left @ T_rl[:3, :3].T + T_rl[:3, 3])]
    ids = np.arange(6)
    result = measure_seen(RIG, BODY, SeenShot("a", (ids, ids), (np.asarray(uv[0]), np.asarray(uv[1]))))
    assert not isinstance(result, Missed)
    return result


def published():
    arm = open_arm("six_r")
    return Published(RIG, BODY, arm, properties(RIG, "name = 'plate'", arm, command="test"))


def read(path):
    """Read an MCAP with the library: topic -> (schema, message) in order, and the metadata."""
    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        for schema, channel, message in reader.iter_messages():
            decoded = json.loads(message.data) if channel.message_encoding == "json" else None
            found.setdefault(channel.topic, []).append((schema, message, decoded))
    return found, metadata


def protobuf(path, topic):
    """The decoded messages of a topic."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [each.decoded_message for each in reader.iter_decoded_messages(topics=[topic])]


def write(path, data, kind=McapSink):
    sink = kind(path, published())
    sink.start()
    for datum in data:
        sink.put(datum)
    sink.close()
    assert sink.problem is None
    assert sink.dropped == 0
    return sink


def test_every_datum_is_in_the_file_with_the_names_of_the_page(tmp_path):
    result, image = measured(), np.zeros((4, 6), np.uint8)
    T_base_rig = pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    states = JointStates(np.array([1.0, 1.001]), np.arange(12.0).reshape(2, 6) * 0.01)
    jpeg = (b"\xff\xd8left\xff\xd9", b"\xff\xd8right\xff\xd9")
    write(
        tmp_path / "a.mcap",
        [
            EventDatum(0.5, {"event": "estimator"}),
            JointsDatum(states, T_base_rig, np.eye(6) * 1e-6, 0.02),
            ShotDatum(Shot("s0", image, image, 1.0, None, jpeg), result, 1.02, 1e-4, "used", T_base_rig, T_base_rig),
            ShotDatum(Shot("s1", image, image, 1.1), Missed("too dark"), 1.12),
            NoteDatum(1.2, "the rig has moved", "warning"),
        ],
    )
    path = tmp_path / "a.mcap"
    found, metadata = read(path)
    kinds = {topic: rows[0][0].name for topic, rows in found.items()}
    assert kinds == {
        "/armsight/event": "armsight.event",
        "/armsight/joints": "armsight.joints",
        "/armsight/shot": "armsight.shot",
        "/arm": "foxglove.SceneUpdate",
        "/joints": "foxglove.JointStates",
        "/left/annotations": "foxglove.ImageAnnotations",
        "/left/calibration": "foxglove.CameraCalibration",
        "/left/image": "foxglove.CompressedImage",
        "/log": "foxglove.Log",
        "/odometry": "foxglove.Odometry",
        "/pose": "foxglove.PoseInFrame",
        "/right/annotations": "foxglove.ImageAnnotations",
        "/right/calibration": "foxglove.CameraCalibration",
        "/right/image": "foxglove.CompressedImage",
        "/scene": "foxglove.SceneUpdate",
        "/tf": "foxglove.FrameTransforms",
        "/tool/odometry": "foxglove.Odometry",
    }
    assert metadata["armsight"]["rig.json"] == RIG.to_text()
    first, second = (decoded for _, _, decoded in found["/armsight/shot"])
    assert (first["status"], first["points"], first["t_s"], first["outcome"]) == ("ok", 6, 1.0, "used")
    assert first["age_s"] == pytest.approx(0.02)
    assert first["T_left_body"] == result.T_left_body.tolist()
    assert first["covariance_body"] == result.cov.tolist()
    total = np.array(first["covariance_precision"]) + np.array(first["covariance_calibration"])
    np.testing.assert_allclose(total, first["covariance"], atol=1e-20)
    assert (second["status"], second["reason"]) == ("missed", "too dark")
    assert found["/armsight/joints"][0][2]["q_rad"] == states.q.tolist()
    # what the libraries decode
    odometry = protobuf(path, "/odometry")[0]
    assert (odometry.frame_id, odometry.body_frame_id) == ("left", "body")
    assert odometry.pose.position.x == result.T_left_body[0, 3]
    np.testing.assert_array_equal(np.reshape(odometry.pose_covariance, (6, 6)), first["covariance"])
    frames = {(t.parent_frame_id, t.child_frame_id) for m in protobuf(path, "/tf") for t in m.transforms}
    assert frames == {("base", "rig"), ("rig", "left"), ("rig", "right"), ("left", "body"), ("base", "tool")}
    assert protobuf(path, "/right/image")[0].data == jpeg[1]
    assert len(protobuf(path, "/left/annotations")[0].points[0].points) == 6
    assert [m.message for m in protobuf(path, "/log")] == ["s1: missed: too dark", "the rig has moved"]
    calibration = protobuf(path, "/right/calibration")[0]
    assert calibration.P[3] / calibration.P[0] == pytest.approx(-RIG.baseline_m, rel=1e-6)
    stamps = [(m.log_time, m.publish_time) for _, m, _ in found["/armsight/shot"]]
    assert stamps == [(1_020_000_000, 1_000_000_000), (1_120_000_000, 1_100_000_000)]


def test_the_ellipsoid_and_the_dropped_points_are_shown(tmp_path):
    from dataclasses import replace

    cov = np.diag([4e-6, 1e-6, 9e-6, 1e-8, 1e-8, 1e-8])
    result = replace(measured(), T_left_body=np.eye(4), cov=cov, dropped=(Dropped("P2", "too far from the body"),))
    write(tmp_path / "a.mcap", [ShotDatum(Shot("s0", None, None, 1.0), result)])
    (scene,) = protobuf(tmp_path / "a.mcap", "/scene")
    size = scene.entities[0].spheres[0].size
    np.testing.assert_allclose(sorted((size.x, size.y, size.z)), [6e-3, 12e-3, 18e-3], rtol=1e-9)
    (shown,) = protobuf(tmp_path / "a.mcap", "/left/annotations")
    assert [text.text for text in shown.texts] == ["P2: too far from the body"]
    assert len(shown.points[0].points) == 5
    assert "P2: too far" in protobuf(tmp_path / "a.mcap", "/log")[0].message


def test_the_file_is_hardly_larger_than_its_images(tmp_path):
    jpeg = b"\xff\xd8" + np.random.default_rng(0).bytes(150_000) + b"\xff\xd9"
    result = measured()
    write(
        tmp_path / "a.mcap",
        [ShotDatum(Shot(f"{k}", None, None, 0.1 * k, None, (jpeg, jpeg)), result) for k in range(20)],
    )
    assert (tmp_path / "a.mcap").stat().st_size < 1.05 * 40 * len(jpeg)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, np.pi - 1e-6, np.pi])
def test_the_quaternion_is_that_of_scipy(angle):
    for axis in np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(1).normal(size=(20, 3))]):
        R = exp_so3(angle * axis / np.linalg.norm(axis))
        ours, theirs = np.array(quaternion(R)), quaternion_wxyz(R)
        assert ours[0] >= 0.0
        np.testing.assert_allclose(abs(ours @ theirs), 1.0, atol=1e-12)
        if angle < 3.0:
            np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_infinity_becomes_null():
    text = json_text({"a": [1.5, float("inf")], "b": {"c": float("nan")}})
    assert json.loads(text) == {"a": [1.5, None], "b": {"c": None}}


def test_the_arm_comes_back_with_all_digits():
    arm = open_arm("ur5")
    again = arm_of(properties(None, None, arm)["arm.json"])
    q = np.linspace(-1, 1, 6)
    np.testing.assert_array_equal(again.forward(q), arm.forward(q))
    assert again.joint_names == arm.joint_names


KILLED = """
import sys, time
from pathlib import Path
from test_run_mcap import published
from armsight.loop.running.data import NoteDatum
from armsight.app.stream.mcap_file import McapBeside, McapSink
sink = McapSink(Path(sys.argv[1]), published())
sink.start()
for k in range(10_000):
    sink.put(NoteDatum(time.time(), str(k)))
    print(time.time(), flush=True)
    time.sleep(0.01)
"""


def test_a_process_of_its_own_writes_the_same_file(tmp_path):
    result, image = measured(), np.zeros((4, 6), np.uint8)
    states = JointStates(np.array([1.0, 1.001]), np.arange(12.0).reshape(2, 6) * 0.01)
    data = [JointsDatum(states, np.eye(4), np.eye(6) * 1e-6, 0.02), NoteDatum(1.2, "the rig has moved", "warning")]
    data += [ShotDatum(Shot(f"s{k}", image, image, 1.0 + 0.3 * k), result, 1.02 + 0.3 * k) for k in range(6)]
    write(tmp_path / "a.mcap", data)
    write(tmp_path / "b.mcap", data, McapBeside)
    (one, its_metadata), (other, metadata) = (read(tmp_path / name) for name in ("a.mcap", "b.mcap"))
    assert metadata == its_metadata
    assert {topic: [(row[1].log_time, row[1].data) for row in rows] for topic, rows in other.items()} == {
        topic: [(row[1].log_time, row[1].data) for row in rows] for topic, rows in one.items()
    }
    assert len(one["/left/image"]) == 2  # one pair a second


@pytest.mark.real_time
def test_a_killed_process_leaves_all_but_the_last_second(tmp_path):
    path = tmp_path / "run.mcap"
    here = Path(__file__).parent
    paths = os.pathsep.join(map(str, [here, here.parents[1], here.parents[1] / "vision", *sys.path]))
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    last = 0.0
    began = None
    for line in process.stdout:
        last = float(line)
        began = began or last
        if last - began > 2.0:
            break
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    from armsight.vision.sources.bag import Bag

    bag = Bag(path)
    logged = [message.decode().timestamp for message in bag.messages(["/log"])]
    newest = logged[-1].seconds + 1e-9 * logged[-1].nanos
    assert last - newest < 1.0
    assert len(logged) > 10


def test_a_reader_that_is_slow_loses_the_oldest_and_it_is_counted():
    from armsight.app.stream.sink import Sink

    class Slow(Sink):
        def __init__(self):
            super().__init__(limit=5)
            self.got = []

        def write(self, datum):
            time.sleep(0.001)
            self.got.append(datum.text)

    sink = Slow()
    for k in range(12):  # before it starts nothing is taken away
        sink.put(NoteDatum(0.0, str(k)))
    assert sink.dropped == 7
    sink.start()
    sink.close()
    assert sink.got == ["7", "8", "9", "10", "11"]


def test_images_that_wait_are_bounded_by_their_memory_and_nothing_else_is_dropped(monkeypatch):
    from armsight.app.stream import sink

    monkeypatch.setattr(sink, "_IMAGES_MB", 1e-3)
    waiting, image = sink.Sink(), np.zeros((10, 20), np.uint8)
    for k in range(4):
        waiting.put(ShotDatum(Shot(str(k), image, image, 0.1 * k), Missed("")))
        waiting.put(ShotDatum(Shot(f"{k} jpeg", None, None, 0.1 * k, None, (b"x" * 40, b"x" * 60)), Missed("")))
        waiting.put(NoteDatum(0.0, str(k)))
    data = [each.datum for each in waiting._queue]
    kept = [each.shot.name for each in data if isinstance(each, ShotDatum) and sink._image_bytes(each)]
    assert kept == ["2", "2 jpeg", "3", "3 jpeg"]
    assert sum(map(sink._image_bytes, data)) == waiting._bytes == 1000
    assert (len(waiting._queue), waiting.taken, waiting.dropped) == (12, 12, 4)


@pytest.mark.parametrize("limit", [8, 400])
def test_beyond_the_memory_a_datum_costs_the_same_and_is_counted_once(monkeypatch, limit):
    from armsight.app.stream import sink

    image_bytes, looks = sink._image_bytes, []
    monkeypatch.setattr(sink, "_IMAGES_MB", 1e-3)
    monkeypatch.setattr(sink, "_image_bytes", lambda datum: looks.append(0) or image_bytes(datum))
    waiting, image = sink.Sink(limit), np.zeros((10, 20), np.uint8)
    for k in range(200):
        waiting.put(ShotDatum(Shot(str(k), image, image, 0.1 * k), Missed("")))
        waiting.put(NoteDatum(0.0, str(k)))
    kept = [bool(image_bytes(each.datum)) for each in waiting._queue if isinstance(each.datum, ShotDatum)]
    assert kept == [False] * (min(limit, 400) // 2 - 2) + [True, True]
    assert waiting._bytes == sum(image_bytes(each.datum) for each in waiting._queue) == 800
    assert waiting.taken - waiting.dropped == min(limit, 400) - kept.count(False)  # whole ones that wait
    assert len(looks) == 400  # one a datum


def test_while_a_command_is_due_no_datum_is_begun_unless_many_wait():
    from armsight.app.stream.sink import Sink

    class Asked(threading.Event):
        def __init__(self):
            super().__init__()
            self.asked = threading.Event()

        def wait(self, timeout=None):
            self.asked.set()
            return super().wait()

    class Listed(Sink):
        def __init__(self):
            super().__init__(limit=40)
            self.got, self._may_write, self.begun = [], Asked(), []

        def write(self, datum):
            self.begun.append(self._may_write.asked.is_set())
            self.got.append(datum.text)

    sink = Listed()
    sink.pause()
    for k in range(20):
        sink.put(NoteDatum(0.0, str(k)))
    sink.start()
    assert sink._may_write.asked.wait(10.0)
    assert sink.got == [str(k) for k in range(11)]  # nine wait: less than a quarter of what may
    sink.resume()
    sink.close()
    assert sink.got == [str(k) for k in range(20)]
    assert sink.begun == [False] * 11 + [True] * 9


def test_a_full_disk_ends_the_file_and_not_the_run(small_disk):
    said = []
    file = LazyMcap(small_disk("64k"), published(), said.append)
    data = np.random.default_rng(0).bytes(100_000)
    for k in range(10):
        file.put(ShotDatum(Shot(str(k), None, None, 0.1 * k, None, (data, data)), Missed("")))
    file.close()
    assert len(said) == 1
    assert "run.mcap: not complete: No space left" in said[0]


def test_without_the_package_nothing_is_written_and_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap_protobuf.schema", None)
    said = []
    file = LazyMcap(tmp_path, published(), said.append)
    file.put(NoteDatum(0.0, "a"))
    file.put(NoteDatum(0.0, "b"))
    file.close()
    assert list(tmp_path.iterdir()) == []
    (line,) = said
    assert 'pip install "armsight[record]"' in line
    with pytest.raises(InputError, match="armsight\\[record\\]"):
        McapSink(tmp_path / "a.mcap", published())
