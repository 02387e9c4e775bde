"""Streams: JSON lines over TCP and UDP, OpenIGTLink read by pyigtl, Foxglove's WebSocket."""

import json
import socket
import struct
import sys
import time
import weakref

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armsight.app.stream.datum import Published
from armsight.app.stream.igtl import crc64, message, position_body, status_body, transform_body
from armsight.app.stream.streams import open_stream, open_streams
from armsight.data import Missed, Shot
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.loop.running.data import NoteDatum, ShotDatum

pytestmark = pytest.mark.real_time  # readers have threads of their own, and zenoh gives a connection a second
SHOT = ShotDatum(Shot("s0", None, None, 2.5), Missed("too dark"), 2.52)


def publish_until(sink, condition, datum=SHOT):
    """Publish again and again until something has arrived; a minute and more, for a computer that is busy."""
    for _ in range(6000):
        sink.put(datum)
        if condition():
            return
        time.sleep(0.01)
    pytest.fail("nothing arrived")


def test_json_over_tcp_is_one_object_a_line():
    sink = open_stream("json+tcp:0", Published())
    sink.start()
    with socket.create_connection(("127.0.0.1", sink.port)) as connection:
        connection.settimeout(0.01)
        got = b""

        def arrived():
            nonlocal got
            try:
                got += connection.recv(65536)
            except TimeoutError:
                return False
            return got.count(b"\n") >= 2

        publish_until(sink, arrived)
    sink.close()
    first = json.loads(got.split(b"\n")[0])
    assert first == {
        "kind": "shot",
        "shot": "s0",
        "t_s": 2.5,
        "status": "missed",
        "reason": "too dark",
        "sigma_t_s": None,
        "arrival_s": 2.52,
        "age_s": pytest.approx(0.02),
    }


def test_a_tcp_reader_that_does_not_read_is_not_waited_for():
    sink = open_stream("json+tcp:0", Published())
    sink.start()
    with socket.create_connection(("127.0.0.1", sink.port)):
        big = NoteDatum(0.0, "x" * 200_000)
        publish_until(sink, lambda: sink.dropped > 0, big)
    sink.close()
    assert sink.problem is None


@pytest.mark.parametrize("kind", ["json+tcp", "igtl", "json+udp"])
def test_images_do_not_wait_for_a_stream_that_writes_none(kind):
    sink, kept = open_stream(f"{kind}:0", Published()), []  # not started: everything waits
    for _ in range(50):
        images = [np.zeros((36, 64), np.uint8) for _ in "lr"]
        kept += map(weakref.ref, images)
        sink.put(ShotDatum(Shot("s", *images, 1.0, encoded=(b"left", b"right")), Missed("too dark")))
    del images
    assert sink.taken == 50
    assert [each() for each in kept if each() is not None] == []
    sink.finish()


def test_json_over_udp_is_one_datagram_a_datum():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60.0)
        streams = open_streams([f"json+udp:127.0.0.1:{receiver.getsockname()[1]}"], Published(), pytest.fail)
        streams.put(NoteDatum(1.0, "hello"))
        assert json.loads(receiver.recv(65536)) == {"kind": "log", "t_s": 1.0, "level": "info", "text": "hello"}
        streams.close()


T = pose(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([0.1, -0.02, 0.85]))


def test_openigtlink_is_what_pyigtl_reads():
    pyigtl = pytest.importorskip("pyigtl")
    from pyigtl.messages import MessageBase

    def parsed(data):
        header = MessageBase.parse_header(data[: MessageBase.IGTL_HEADER_SIZE])
        found = MessageBase.create_message(header["message_type"])
        body = data[MessageBase.IGTL_HEADER_SIZE :]
        assert len(body) == header["body_size"]
        found.unpack(header, body)
        return found

    transform = parsed(message("TRANSFORM", "armsight_body", 1.5, transform_body(T)))
    assert isinstance(transform, pyigtl.TransformMessage)
    assert transform.device_name == "armsight_body"
    np.testing.assert_allclose(transform.matrix[:3, :3], T[:3, :3], atol=1e-6)
    np.testing.assert_allclose(transform.matrix[:3, 3], 1e3 * T[:3, 3], atol=1e-3)
    assert transform.timestamp == pytest.approx(1.5)


def test_a_position_is_that_of_the_specification():
    """Three float32 of position, mm, four of the quaternion x y z w; pyigtl reads its own form of POINT under this name."""
    x, y, z, *q = struct.unpack(">7f", position_body(T))
    np.testing.assert_allclose([x, y, z], 1e3 * T[:3, 3], rtol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), T[:3, :3], atol=1e-6)


def test_the_checksum_is_that_of_ecma_182():
    assert crc64(b"123456789") == 0x6C40DF5F0B497347  # the check value of the catalogue of CRC algorithms
    body = status_body(7, "missed", "too dark")
    assert struct.unpack(">H", body[:2]) == (7,)
    assert body.endswith(b"too dark\0")


def test_a_client_of_openigtlink_receives_the_pose():
    pyigtl = pytest.importorskip("pyigtl")
    from test_run_mcap import BODY, RIG, measured

    result = measured()
    sink = open_stream("igtl:0", Published(RIG, BODY))
    sink.start()
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", sink.port)
    got = []

    def arrived():
        got.extend(m for m in client.get_latest_messages() if isinstance(m, pyigtl.TransformMessage))
        return bool(got)

    try:
        publish_until(sink, arrived, ShotDatum(Shot("s", None, None, 1.0), result))
    finally:
        client.stop()
        sink.close()
    np.testing.assert_allclose(got[0].matrix[:3, 3], 1e3 * result.T_left_body[:3, 3], atol=1e-3)


def test_foxglove_s_server_listens_and_takes_everything():
    pytest.importorskip("foxglove")
    pytest.importorskip("mcap_protobuf")
    from test_run_mcap import BODY, RIG, measured

    sink = open_stream("foxglove:0", Published(RIG, BODY))
    sink.start()
    with socket.create_connection(("127.0.0.1", sink.port)) as connection:
        connection.settimeout(60.0)
        connection.sendall(
            b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        answer = connection.recv(4096)
        assert answer.startswith(b"HTTP/1.1 101")
        for _ in range(3):
            sink.put(ShotDatum(Shot("s", None, None, 1.0), measured()))
        got = answer
        while b"/armsight/shot" not in got:
            got += connection.recv(65536)
        assert b"foxglove.Odometry" in got
    sink.close()
    assert sink.problem is None


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("ros:1", "unknown kind 'ros'; known are foxglove, json\\+tcp, json\\+udp, igtl"),
        ("json+tcp:abc", "expected json\\+tcp:\\[HOST:\\]PORT"),
        ("igtl:99999", "expected igtl"),
    ],
)
def test_a_stream_that_is_none_is_one_line(spec, words):
    with pytest.raises(InputError, match=words):
        open_streams([spec], Published(), pytest.fail)


def test_a_port_in_use_is_named_and_nothing_stays_open():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"json\\+tcp:{port}: cannot listen there"):
            open_streams(["json+udp:5", f"json+tcp:{port}"], Published(), pytest.fail)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match="armsight\\[stream\\]"):
        open_streams(["foxglove:0"], Published(), pytest.fail)


def test_ros2_messages_over_zenoh_are_decoded_by_the_definitions_of_ros(monkeypatch):
    """Keys, tokens and attachments as rmw_zenoh has them; the hash is that of ROS's own std_msgs/String."""
    zenoh = pytest.importorskip("zenoh")
    from rosbags.typesys import Stores, get_typestore
    from test_run_mcap import BODY, measured, published

    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/127.0.0.1:{port}"]'),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    shot = ShotDatum(Shot("s0", None, None, 2.5, None, (b"\xff\xd8l\xff\xd9", b"\xff\xd8r\xff\xd9")), measured(), 2.52)
    with zenoh.open(config) as router:
        got, tokens = {}, []
        router.declare_subscriber("7/**", lambda s: got.setdefault(str(s.key_expr), s))
        router.liveliness().declare_subscriber("@ros2_lv/7/**", lambda s: tokens.append(str(s.key_expr)))
        sink = open_stream(f"ros2:{port}", published())
        sink.start()
        topics = {"armsight/shot", "odometry", "right/image_raw/compressed", "right/camera_info"}
        publish_until(sink, lambda: topics <= {"/".join(key.split("/")[1:-2]) for key in list(got)}, shot)
        sink.close()
        assert sink.problem is None
    store = get_typestore(Stores.ROS2_JAZZY)
    decoded = {}
    for key, sample in list(got.items()):  # more may still arrive
        _, *topic, mangled, hashed = key.split("/")
        kind = mangled.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
        assert hashed == store.hash_rihs01(kind)
        decoded["/".join(topic)] = store.deserialize_cdr(sample.payload.to_bytes(), kind)
        number, stamp_ns, length, _ = struct.unpack("<qqB16s", sample.attachment.to_bytes())
        assert (number, stamp_ns, length) == (1, 2_500_000_000, 16)
        token = f"/MP/%/%/armsight/{'%' + '%'.join(topic)}/{mangled}/{hashed}/::,10:,:,:,,"
        assert any(each.endswith(token) for each in tokens)
    string = next(key for key in got if key.startswith("7/armsight/shot/"))
    assert string.endswith(
        "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    )
    assert json.loads(decoded["armsight/shot"].data) == json.loads(json.dumps(shot.to_json(BODY)))
    assert decoded["odometry"].pose.pose.position.x == shot.result.T_left_body[0, 3]
    assert bytes(decoded["right/image_raw/compressed"].data) == shot.shot.encoded[1]
    assert decoded["right/camera_info"].header.stamp == decoded["right/image_raw/compressed"].header.stamp
    assert any("/NN/%/%/armsight" in each for each in tokens)
    with pytest.raises(InputError, match="no zenoh router answers there; start it: ros2 run"):
        open_stream(f"ros2:{port}", published())
