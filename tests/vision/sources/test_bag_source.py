"""Recordings of ROS and Foxglove, written by rosbags and mcap, read back as shots, rig, tags, joints and poses."""

import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap_protobuf")
pytest.importorskip("foxglove_schemas_protobuf")

from armsight.data import Body
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.rigfiles.rigfile import rectification
from armsight.vision.sources import notes_of, open_rig, open_source
from armsight.vision.sources.bag import Bag
from armsight.vision.sources.bag.camera_info import bag_rig
from armsight.vision.sources.bag.images import decoded_image
from armsight.vision.sources.bag.pairing import pair, stamps_of
from armsight.vision.sources.bag.states import read_joints, read_track
from armsight.vision.sources.bag.tags import read_tags
from asserts import one_line
from bag_files import (
    CONTAINERS,
    EPOCH_NS,
    Info,
    Joints,
    Pixels,
    Sent,
    Tags,
    Transforms,
    disordered,
    pairs_found,
    write_bag,
)
from strategies import ordinary_rig

LEFT, RIGHT = "/stereo/left/image_raw", "/stereo/right/image_raw"
STEP_NS = 33_000_000


def images(count=4, late_ns=1_000_000, shape=(12, 16)):
    """Two topics of random images, the right ones a little later."""
    rng = np.random.default_rng(5)
    return [
        Sent(topic, EPOCH_NS + k * STEP_NS + dt, Pixels(rng.integers(0, 255, shape, np.uint8)))
        for k in range(count)
        for topic, dt in ((LEFT, 0), (RIGHT, late_ns))
    ]


def both(image, **options):
    """One image on both topics, two times."""
    content = image if isinstance(image, Pixels) else Pixels(image)
    return [Sent(t, EPOCH_NS + k, content, options=options) for k in (0, STEP_NS) for t in (LEFT, RIGHT)]


def shots(spec):
    source, found = open_source(spec), []
    while (shot := source.read()) is not None:
        found.append(shot)
    assert len(found) == source.count
    source.close()
    assert source.read() is None
    return found, notes_of(source)


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("shape", [(12, 16), (12, 16, 3)])
def test_pixels_and_times_are_the_same_through_every_container(tmp_path, container, shape):
    sent = images(shape=shape)
    found, notes = shots(f"bag:{write_bag(tmp_path / 'a', container, sent)}")
    assert notes == ()
    assert [shot.t_s for shot in found] == [each.stamp_ns / 1e9 for each in sent[::2]]
    for shot, left, right in zip(found, sent[::2], sent[1::2], strict=True):
        assert shot.problem is None
        np.testing.assert_array_equal(shot.left, left.content.image)
        np.testing.assert_array_equal(shot.right, right.content.image)


@pytest.mark.parametrize(
    ("container", "compression"),
    [("ros1", "lz4"), ("ros1", "bz2"), ("mcap", "zstd"), ("sqlite3", None), ("foxglove", None)],
)
def test_compressed_images_come_with_the_bytes_of_the_camera(tmp_path, container, compression):
    sent = images()
    for each in sent:
        each.topic += "/compressed"
        each.content.format = "png"
    found, _ = shots(f"bag:{write_bag(tmp_path / 'a', container, sent, compression)}")
    assert found[2].encoded == (sent[4].content.encoded(), sent[5].content.encoded())
    np.testing.assert_array_equal(found[2].right, sent[5].content.image)


def test_ros_encodings_become_grey_or_bgr(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    deep = np.arange(24, dtype=np.uint16).reshape(4, 6) * 900
    found, _ = shots(f"bag:{write_bag(tmp_path / 'a', 'ros1', both(rgb, encoding='rgb8'))}")
    np.testing.assert_array_equal(found[0].left, rgb[..., ::-1])
    found, _ = shots(f"bag:{write_bag(tmp_path / 'b', 'mcap', both(deep))}")
    np.testing.assert_array_equal(found[1].right, deep)
    dark_first = both(deep // 300)[:2] + both(deep // 6)[2:]  # 12 bits; by themselves the first would be 10
    found, notes = shots(f"bag:{write_bag(tmp_path / 'd', 'ros1', dark_first)}")
    np.testing.assert_array_equal(found[0].right, deep // 300 << 4)
    assert "its 16-bit images are read as 12 bits, which hold their pixels" in notes
    found, _ = shots(f"bag:{write_bag(tmp_path / 'c', 'mcap', both(rgb, encoding='nv24'))}")
    assert "encoding 'nv24' is not read" in found[0].problem


@pytest.mark.parametrize("container", ["ros1", "mcap", "sqlite3"])
def test_a_recording_that_begins_in_the_dark_has_one_depth(tmp_path, container):
    """Nine shots of 10 bits, then bright ones of 12: all of the recording is looked at before the first is scaled."""
    dark, bright = (np.full((4, 6), most, np.uint16) for most in (900, 4000))
    sent = [
        Sent(t, EPOCH_NS + k * STEP_NS, Pixels(dark if k < 9 else bright)) for k in range(24) for t in (LEFT, RIGHT)
    ]
    found, notes = shots(f"bag:{write_bag(tmp_path / 'a', container, sent)}")
    assert {shot.bits for shot in found} == {12}
    assert (found[0].left == 900 << 4).all()
    assert notes == ("its 16-bit images are read as 12 bits, which hold their pixels",)


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_luminance_with_half_the_colours_behind_it_is_read(tmp_path, encoding):
    red = np.full((8, 16, 3), (40, 80, 220), np.uint8)
    planes = cv2.cvtColor(red, cv2.COLOR_BGR2YUV_I420)
    u, v = planes[8:10].reshape(4, 8), planes[10:12].reshape(4, 8)
    colours = np.dstack([u, v] if encoding == "nv12" else [v, u]).reshape(4, 16)
    path = write_bag(tmp_path / "a", "mcap", both(np.vstack([planes[:8], colours]), encoding=encoding))
    for message in Bag(path).messages([LEFT]):
        decoded = message.decode()
        decoded.height, decoded.step = 8, 16  # as drivers say it: the rows of the luminance
        np.testing.assert_allclose(decoded_image(message.kind, decoded)[0], red, atol=4)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_of_16_bits_are_those_of_8(tmp_path, pattern):
    raw = np.random.default_rng(1).integers(0, 255, (12, 16), np.uint8)
    eight, _ = shots(f"bag:{write_bag(tmp_path / '8', 'ros1', both(raw, encoding=f'bayer_{pattern}8'))}")
    deep = both(raw * np.uint16(257), encoding=f"bayer_{pattern}16")
    sixteen, _ = shots(f"bag:{write_bag(tmp_path / '16', 'ros1', deep)}")
    np.testing.assert_allclose(sixteen[0].left / 257, eight[0].left, atol=1)


@pytest.mark.parametrize(("pattern", "bits"), [("rggb", 8), ("gbrg", 16)])
def test_a_compressed_mosaic_is_the_image_of_the_raw_one(tmp_path, pattern, bits):
    """compressed_image_transport gives imencode a mosaic, and "bayer_rggb8; png compressed " as the format."""
    dtype = np.dtype(f"u{bits // 8}")
    raw = np.random.default_rng(2).integers(0, np.iinfo(dtype).max, (12, 16), dtype)
    plain, _ = shots(f"bag:{write_bag(tmp_path / 'raw', 'mcap', both(raw, encoding=f'bayer_{pattern}{bits}'))}")
    packed = Pixels(raw, f"bayer_{pattern}{bits}; png compressed ", cv2.imencode(".png", raw)[1].tobytes())
    found, _ = shots(f"bag:{write_bag(tmp_path / 'packed', 'mcap', both(packed))}")
    np.testing.assert_array_equal(found[0].left, plain[0].left)
    assert found[0].left.shape == (12, 16, 3)
    assert found[0].encoded is None  # the file would be taken for a grey image


def test_distances_are_said_to_be_no_picture(tmp_path):
    found, _ = shots(
        f"bag:{write_bag(tmp_path / 'a', 'sqlite3', both(np.zeros((8, 8), np.float32), encoding='32FC1'))}"
    )
    assert found[0].problem.startswith("left image: its 32FC1 holds distances of a depth camera")
    sent = images(3)
    for each in [*sent]:
        depth = Pixels(each.content.image, "png")
        sent.append(Sent(each.topic.replace("image_raw", "depth/compressedDepth"), each.stamp_ns, depth))
    path = write_bag(tmp_path / "b", "mcap", sent)
    assert open_source(f"bag:{path}").topics == (LEFT, RIGHT)
    with pytest.raises(InputError, match="16UC1; compressedDepth png holds distances of a depth camera"):
        decoded_image(
            "sensor_msgs/CompressedImage", SimpleNamespace(format="16UC1; compressedDepth png", data=b"\0" * 20)
        )


def test_an_image_without_a_partner_is_a_shot_that_says_so(tmp_path):
    sent = images(6)
    del sent[5]  # the right image of the third shot
    found, notes = shots(f"bag:{write_bag(tmp_path / 'a', 'mcap', sent)}")
    assert [shot.problem is None for shot in found] == [True, True, False, True, True, True]
    assert f"{LEFT} has a message at" in found[2].problem
    assert f"{RIGHT} none within" in found[2].problem
    (note,) = notes
    assert note.startswith(f"1 of 6 messages of {LEFT} and 0 of 5 of {RIGHT} have no partner")


def test_stamps_of_zero_give_the_time_of_arrival_and_a_note(tmp_path):
    sent = images()
    for k, each in enumerate(sent):
        each.arrival_ns, each.stamp_ns = each.stamp_ns, 0 if k else each.stamp_ns
    found, notes = shots(f"bag:{write_bag(tmp_path / 'a', 'ros1', sent)}")
    assert [shot.t_s for shot in found] == [each.arrival_ns / 1e9 for each in sent[::2]]
    assert sum("zero or negative" in note for note in notes) == 2


def test_a_clock_that_jumps_is_said_and_the_shots_stay_paired():
    header = [10**9 * k for k in (100, 101, 102, 50, 51, 52)]
    arrival = [10**9 * k for k in (100, 101, 102, 103, 104, 105)]
    left = stamps_of("/l", header, arrival)
    right = stamps_of("/r", [t + 1000 for t in header], arrival)
    assert "jumps 1 time, first by -53.000 s" in left.notes[0]
    found = pair(left, right)
    assert found.pairs == tuple((k, k) for k in range(6))
    assert any("jumps" in note for note in found.notes)


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("seed", range(3))
def test_every_whole_pair_of_a_disordered_recording_is_read_in_order(tmp_path, container, seed):
    bag = disordered(tmp_path, container, seed)
    found, problems = pairs_found(bag.spec)
    assert found == bag.pairs
    assert len(problems) == bag.others
    assert all("none within" in each or "recorded twice" in each for each in problems)


def test_a_recording_far_out_of_order_is_read_again_within_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("armsight.vision.sources.bag.images._HELD_MB", 2e-3)  # some images of 192 bytes
    bag = disordered(tmp_path, "mcap", 1)
    found, problems = pairs_found(bag.spec)
    assert found == bag.pairs
    assert len(problems) == bag.others


def test_a_missing_file_of_a_split_recording_is_said_and_the_rest_read(tmp_path):
    for container in ("sqlite3", "mcap"):
        (tmp_path / container).mkdir()
        bag = disordered(tmp_path / container, container, 4)
        folder = Path(bag.spec.removeprefix("bag:"))
        lost = min(folder.glob("bag_1.*"))
        lost.unlink()
        found, _ = pairs_found(bag.spec)
        assert 0 < len(found) < len(bag.pairs)
        assert found == sorted(found)
        (note,) = [each for each in notes_of(open_source(bag.spec)) if "is missing" in each]
        assert note == f"{folder / 'metadata.yaml'} names {lost.name}, which is missing: the rest is read"
        lost.write_bytes(b"damaged")
        if container == "sqlite3":
            assert pairs_found(bag.spec)[0] == found


def test_a_message_without_a_stamp_among_late_ones_is_named_and_never_guessed():
    rng = np.random.default_rng(5)
    true = EPOCH_NS + np.arange(80) * STEP_NS
    late = np.where(rng.random(80) < 0.5, 10**6, 2 * 10**9)  # which of both is unknown
    stamps = np.where(rng.random(80) < 0.1, 0, true)
    right = np.delete(true, np.flatnonzero(rng.random(80) < 0.3))
    found = pair(
        stamps_of("/l", stamps.tolist(), (true + late).tolist()), stamps_of("/r", right.tolist(), right.tolist())
    )
    assert all(true[k] == right[n] for k, n in found.pairs)
    assert {k for k, _ in found.pairs} >= set(np.flatnonzero(np.isin(stamps, right)))


@pytest.mark.parametrize("jumping", ["both", "left"])
@pytest.mark.parametrize("by_s", [-1.5, -40.0, 1.7, 60.0])
def test_shots_stay_paired_and_in_order_over_a_jump_of_both_clocks_or_of_one(jumping, by_s):
    rng = np.random.default_rng(3)
    true = EPOCH_NS + np.arange(60) * STEP_NS + rng.normal(0, 1e6, 60).astype(np.int64)
    jumped = true + (np.arange(60) > 31) * int(by_s * 1e9)
    arrival = (true + rng.uniform(5e6, 9e6, 60).astype(np.int64)).tolist()
    left = stamps_of("/l", jumped.tolist(), arrival)
    right = stamps_of("/r", (jumped if jumping == "both" else true).tolist(), arrival)
    assert f"jumps 1 time, first by {by_s:+.2f}" in left.notes[0]
    assert pair(left, right).pairs == tuple((k, k) for k in range(60))


def test_pairing_is_that_of_an_exhaustive_search():
    rng = np.random.default_rng(1)
    for _ in range(20):
        left = np.sort(rng.choice(10_000, 30, replace=False)) * 10**6
        right = np.sort(rng.choice(10_000, 25, replace=False)) * 10**6
        found = pair(
            stamps_of("/l", left.tolist(), left.tolist()), stamps_of("/r", right.tolist(), right.tolist()), 0.1
        )
        apart = np.abs(left[:, None] - right[None, :])
        mutual = [
            (i, int(apart[i].argmin()))
            for i in range(30)
            if apart[:, apart[i].argmin()].argmin() == i and apart[i].min() <= 10**8
        ]
        assert found.pairs == tuple(mutual)


def renamed(sent, left, right):
    return [Sent(s.topic.replace("left", left).replace("right", right), s.stamp_ns, s.content) for s in sent]


def other(topic):
    return Sent(topic, EPOCH_NS, Pixels(np.zeros((4, 4), np.uint8)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda sent: [s for s in sent if s.topic == LEFT], ["images of one camera only", LEFT]),
        (lambda sent: [Sent("/joint_states", EPOCH_NS, Joints(["a"], [0.0]))], ["holds no images", "/joint_states"]),
        (lambda sent: sent + [other("/third/image_raw")] * 2 + [other("/fourth/image_raw")], None),
        (
            lambda sent: [*renamed(sent, left="x", right="y"), other("/z/image_raw")],
            ["which images are left and right"],
        ),
    ],
)
def test_topics_that_are_no_stereo_pair_are_named(tmp_path, change, words):
    path = write_bag(tmp_path / "a", "mcap", change(images()))
    if words is None:  # the pair is known by its names
        assert open_source(f"bag:{path}").topics == (LEFT, RIGHT)
        return
    with one_line(*words):
        open_source(f"bag:{path}")


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_recording_without_joints_has_none(tmp_path, container):
    bag = Bag(write_bag(tmp_path / "a", container, images()))
    assert read_joints(bag) is None
    assert list(bag.messages([])) == []


def test_the_user_names_the_topics(tmp_path):
    path = write_bag(tmp_path / "a", "mcap", renamed(images(), left="b", right="a"))
    named = open_source(f"bag:{path},left=/stereo/b/image_raw,right=/stereo/a/image_raw")
    assert named.topics[0] == "/stereo/b/image_raw"
    for text, word in (
        ("left=/x,right=/stereo/a/image_raw", "/x is no topic"),
        ("left=/a", "name both"),
        ("up=/a", "up=/a"),
    ):
        with pytest.raises(InputError, match=word):
            open_source(f"bag:{path},{text}")


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_file_that_was_cut_short_is_one_line_or_is_read_as_far_as_it_goes(tmp_path, container):
    path = write_bag(tmp_path / "a", container, images(40, shape=(120, 160)))
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    file.write_bytes(data[: int(0.6 * len(data))])
    if container != "foxglove":  # rosbags writes MCAP as one chunk
        with one_line(str(path), match=r"index|damaged|cut short"):
            shots(f"bag:{path}")
        return
    found, notes = shots(f"bag:{path}")
    assert 10 < sum(shot.problem is None for shot in found) < 30
    assert any("cut short or damaged" in note for note in notes)


def test_chunks_of_an_unknown_compression_are_named(tmp_path):
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("a", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        writer.add_message(channel, 1, b"{}" * 100, 1)
        writer.finish()
    # a chunk's compression is a text with its length before it: of an empty one make "xz"
    with path.open("rb") as file:
        chunk = next(r for r in StreamReader(file, emit_chunks=True).records if isinstance(r, Chunk))
    head = struct.pack(
        "<QQQI", chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size, chunk.uncompressed_crc
    )
    data = path.read_bytes()
    at = data.index(head) + len(head)
    length_at = data.index(head) - 8
    (length,) = struct.unpack_from("<Q", data, length_at)
    changed = data[:length_at] + struct.pack("<Q", length + 2) + head + struct.pack("<I", 2) + b"xz" + data[at + 4 :]
    path.write_bytes(changed)
    with pytest.raises(InputError, match="compressed with 'xz'; lz4 and zstd are read"):
        Bag(path)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [("none.bag", None, "no such recording"), ("a.bag", b"#ROSBAG V2.0\n", "index|damaged"), ("a.db3", b"junk", "damaged"),
     ("a.mcap", b"", "damaged|not a ROS"), ("a.mcap", b"\x89MCAP0\r\n", "holds no images")],
)  # fmt: skip
def test_what_is_no_recording_is_one_line(tmp_path, name, content, word):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with one_line(match=word):
        open_source(f"bag:{path}")


@pytest.mark.parametrize(("name", "module"), [("a.bag", "rosbags.highlevel"), ("a.mcap", "mcap.stream_reader")])
def test_a_missing_package_is_one_line(tmp_path, monkeypatch, name, module):
    (tmp_path / name).write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install \"armsight\[ros\]\""):
        Bag(tmp_path / name)


def infos(rig):
    """The camera info of both cameras."""
    R1, R2, P1, P2, _ = rectification(rig)
    model = "equidistant" if rig.left.model == "fisheye" else "plumb_bob"
    return [
        Sent(f"/stereo/{side}/camera_info", EPOCH_NS, Info(c.image_size_px, model, c.distortion, c.matrix, R, P))
        for side, c, R, P in (("left", rig.left, R1, P1), ("right", rig.right, R2, P2))
    ]


def test_foxgloves_name_of_the_fisheye_model_is_read_and_written(tmp_path):
    rig = ordinary_rig("fisheye")
    sent = infos(rig)
    for each in sent:
        each.content.model = "kannala_brandt"
    found = open_rig(f"bag:{write_bag(tmp_path / 'a', 'foxglove', sent)}")
    assert [camera.model for camera in found.cameras] == ["fisheye", "fisheye"]
    np.testing.assert_allclose(found.T_left_right, rig.T_left_right, atol=1e-12)


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("model", ["brown5", "fisheye"])
def test_camera_info_of_a_stereo_pair_is_the_rig(tmp_path, container, model):
    rig = ordinary_rig(model)
    sent = infos(rig)
    found = open_rig(f"bag:{write_bag(tmp_path / 'a', container, sent)}")
    np.testing.assert_allclose(found.T_left_right, rig.T_left_right, atol=1e-12)
    for ours, theirs in zip(found.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(ours.parameters[: theirs.parameters.size], theirs.parameters, atol=1e-12)
    sent[1].content = infos(replace(rig, right=rig.left))[0].content
    with pytest.raises(InputError, match="no baseline"):
        bag_rig(Bag(write_bag(tmp_path / "b", container, sent)))


@pytest.mark.parametrize("container", ["ros1", "mcap"])
def test_camera_info_of_a_window_of_the_sensor_is_of_its_images(tmp_path, container):
    """Its matrices are of the whole sensor, images of its window (x, y, height, width), binned."""
    rig = ordinary_rig("brown5")
    sent = infos(rig)
    sent[0].content.binning, sent[0].content.roi = (2, 2), (100, 40, 400, 800)
    sent[1].content.binning = (4, 2)
    found = open_rig(f"bag:{write_bag(tmp_path / 'a', container, sent)}")
    width, height = rig.right.image_size_px
    assert [camera.image_size_px for camera in found.cameras] == [(400, 200), (width // 4, height // 2)]
    np.testing.assert_allclose(found.T_left_right, rig.T_left_right, atol=1e-12)
    points = np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.5], [0.0, -0.1, 0.8]])
    np.testing.assert_allclose(found.left.project(points), (rig.left.project(points) - [100, 40]) / 2, atol=1e-9)
    np.testing.assert_allclose(found.right.project(points), rig.right.project(points) / [4, 2], atol=1e-9)
    assert any("binned 2 x 2" in note for note in found.provenance["notes"])
    sent[0].content.roi = (100, 40, 4000, 800)
    with pytest.raises(InputError, match="no window of its"):
        open_rig(f"bag:{write_bag(tmp_path / 'b', container, sent)}")


def test_joints_and_transforms_are_streams(tmp_path):
    names = ["b", "a"]
    static = pose(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.0, 0.0, 0.5]))
    moving = [pose(exp_so3(np.array([0.0, 0.0, 0.1 * k])), np.array([0.1 * k, 0.0, 0.0])) for k in range(5)]
    before = pose(np.eye(3), np.array([0.0, 0.0, 0.1]))  # the last static one holds for all times
    sent = [
        Sent("/tf_static", EPOCH_NS + k, Transforms([("tool0", "flange", T)])) for k, T in ((0, before), (9, static))
    ]
    for k, T in enumerate(moving):
        t = EPOCH_NS + k * STEP_NS
        sent += [
            Sent("/joint_states", t, Joints(names, [0.1 * k, -0.1 * k])),
            Sent("/tf", t, Transforms([("base", "tool0", T)])),
        ]
    sent.append(Sent("/joint_states", EPOCH_NS + 9 * STEP_NS, Joints(["gripper"], [1.0])))
    for container in CONTAINERS:
        bag = Bag(write_bag(tmp_path / container, container, sent))
        joints = read_joints(bag, ("a", "b"))
        np.testing.assert_allclose(joints.q, np.outer(np.arange(5), [-0.1, 0.1]), atol=1e-15)
        assert "1 joint states do not hold all of a, b" in joints.notes[0]
        middle = joints.at(np.array([(joints.t_s[1] + joints.t_s[2]) / 2, 0.0]))
        np.testing.assert_allclose(middle[0], [-0.15, 0.15], atol=1e-5)
        assert np.isnan(middle[1]).all()
        track = read_track(bag, "base", "flange")
        np.testing.assert_allclose(track.Ts, np.array(moving) @ static, atol=1e-9)
        np.testing.assert_allclose(
            read_track(bag, "flange", "base").Ts @ track.Ts, np.tile(np.eye(4), (5, 1, 1)), atol=1e-9
        )
        with pytest.raises(InputError, match="no frame 'wrist' in its transforms; there are base, flange, tool0"):
            read_track(bag, "base", "wrist")


def test_joints_of_two_arms_are_not_mixed(tmp_path):
    sent = []
    for k in range(6):
        side = ("left", "right")[k % 2]
        names = [f"{side}_elbow_joint", f"{side}_wrist_joint"]
        sent.append(Sent("/joint_states", EPOCH_NS + k * STEP_NS, Joints(names, [0.1 * k, 0.2])))
    both = Bag(write_bag(tmp_path / "two", "mcap", sent))
    with pytest.raises(InputError, match="two arms have the joints elbow, wrist: left_elbow_joint"):
        read_joints(both, ("elbow", "wrist"))
    one = read_joints(Bag(write_bag(tmp_path / "one", "mcap", sent[::2])), ("elbow", "wrist"))
    np.testing.assert_allclose(one.q[:, 0], [0.0, 0.2, 0.4], atol=1e-12)


def test_recorded_tags_are_detections_in_our_order_of_corners(tmp_path):
    ours = np.array([[10.0, 10.0], [20.0, 11.0], [21.0, 22.0], [9.0, 20.0]])  # from the upper left, clockwise
    body = Body(
        "plate", tuple(f"{n}.{k}" for n in (3, 7) for k in range(4)), np.random.default_rng(0).normal(size=(8, 3))
    )
    sent = []
    for k in range(4):
        for topic, corners in (("/left/tags", ours[::-1] + 0.5), ("/right/tags", ours - [5.0, 0.0])):  # both orders
            found = [] if k == 2 else [(7, corners), (99, corners)]
            sent.append(Sent(topic, EPOCH_NS + k * STEP_NS, Tags(found)))
    for container in ("ros1", "sqlite3", "mcap"):
        found, notes = read_tags(f"bag:{write_bag(tmp_path / container, container, sent)}", body)
        assert [shot.t_s for shot in found] == [(EPOCH_NS + k * STEP_NS) / 1e9 for k in range(4)]
        np.testing.assert_array_equal(found[1].ids[0], [4, 5, 6, 7])
        np.testing.assert_array_equal(found[1].uv[0], ours)
        np.testing.assert_array_equal(found[1].uv[1], ours - [5.0, 0.0])
        assert found[2].problem == "no tag of the body was detected"
        assert any("99 (6 times)" in note for note in notes)
    with pytest.raises(InputError, match="carries no tags"):
        read_tags(f"bag:{tmp_path / 'mcap'}", Body("b", ("P1", "P2", "P3"), np.zeros((3, 3))))
    with pytest.raises(InputError, match="no tag of body other is in it; it has tag36h11 7"):
        read_tags(f"bag:{tmp_path / 'mcap'}", Body("other", tuple(f"1.{k}" for k in range(4)), np.zeros((4, 3))))


def test_recorded_tags_of_the_apriltag_library_are_in_our_pixels(tmp_path):
    # What pupil-apriltags 1.0.4 finds of a tag whose outline is the pixels 100 to 179 of both axes, blurred by 0.8 px.
    library = np.array([[179.857, 99.943], [100.127, 99.850], [99.798, 179.913], [179.913, 179.857]])
    tags = Tags([(5, library)])
    sent = [Sent(f"/{side}/tags", EPOCH_NS + k * STEP_NS, tags) for k in range(3) for side in ("left", "right")]
    body = Body("plate", tuple(f"5.{k}" for k in range(4)), np.eye(4, 3))
    found, _ = read_tags(f"bag:{write_bag(tmp_path / 'tags', 'mcap', sent)}", body)
    edges = np.array([[99.5, 179.5], [99.5, 99.5], [179.5, 99.5], [179.5, 179.5]])  # of pixels whose centres are whole
    for uv in (found[0].uv[0], found[2].uv[1]):
        off = (uv[:, None] - edges)[np.arange(4), np.linalg.norm(uv[:, None] - edges, axis=2).argmin(axis=1)]
        np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.15)  # a corner is 0.2 px off here; half a pixel is 0.5


def test_the_real_bags_of_tags_are_read(data_dir):
    folder = data_dir / "bags" / "tagslam_2"
    if not folder.is_dir():
        pytest.skip("no recorded tags")
    body = Body("tags", tuple(f"{n}.{k}" for n in (300, 303) for k in range(4)), np.zeros((8, 3)))
    found, notes = read_tags(f"bag:{folder / 'tag_detections.bag'}", body)
    assert len(found) == 1111
    assert sum(shot.problem is not None for shot in found) > 0
    assert any("have no partner" in " ".join(note.split()) for note in notes)
