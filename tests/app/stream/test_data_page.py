"""docs/reference/data.md has every name that is written, in every form, and no other."""

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap_protobuf")

from test_run_mcap import BODY, measured, write

from armsight.app.export.tables import tables_of
from armsight.app.replay.recorded import read_run
from armsight.app.replay.tables import LIVE_COLUMNS
from armsight.app.stream.mcap_file import METADATA
from armsight.app.stream.ros import TO_ROS
from armsight.app.stream.websocket import TOPICS
from armsight.data import JointStates, Missed, Shot
from armsight.loop.running.data import JointsDatum, ShotDatum
from armsight.vision.pose.shot_pose import CSV_COLUMNS, SHUTTER_COLUMNS
from armsight.vision.sources.bag import Bag

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "data.md").read_text(encoding="utf-8")
#: Keys of measure --json that only some options give.
SOMETIMES = {"way", "jump", "took_ms", "shutters"}
T, STATES = np.eye(4), JointStates(np.array([1.0, 1.001]), np.zeros((2, 6)))
DATA = [
    JointsDatum(STATES, T, np.eye(6) * 1e-6, 0.02),
    ShotDatum(
        Shot("a", None, None, 1.0, None, (b"\xff\xd8", b"\xff\xd8")), measured(), 1.02, 1e-4, "used", T, T, np.eye(6)
    ),
    ShotDatum(Shot("b", None, None, 1.1), Missed("too dark"), 1.12),
]


def rows(section):
    """The names in the first column of a section's table."""
    text = re.search(rf"^## {section}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)[1]
    return {name for row in re.findall(r"^\| (`.*?) \|", text, re.MULTILINE) for name in re.findall(r"`([^`]+)`", row)}


def test_the_json_of_shots_and_joints_has_the_names_of_the_page():
    shots = {key for datum in DATA[1:] for key in datum.to_json(BODY)}
    assert shots | SOMETIMES == rows("A shot")
    assert set(DATA[0].to_json(BODY)) == rows("Joints")


def test_the_columns_of_tables_are_on_the_page(tmp_path):
    write(tmp_path / "run.mcap", DATA)
    written = {name for header, _ in tables_of(read_run(tmp_path / "run.mcap")).values() for name in header}
    written |= {*CSV_COLUMNS, *SHUTTER_COLUMNS, *LIVE_COLUMNS}
    named = set(re.findall(r"`([\w/.]+)`", PAGE))
    lacking = []
    for name in written:
        general = re.sub(r"^q\d_rad$", "q1_rad", re.sub(r"_\d\d$", "_ij", name))
        general = re.sub(r"^(sigma(?:_\w+)?)_(?:[yz]_m|r[xy]_rad)$", r"\1_x_m", general)  # the page names both ends
        if general not in named:
            lacking.append(name)
    assert not lacking


def test_the_topics_are_those_of_the_page(tmp_path):
    write(tmp_path / "run.mcap", DATA)
    bag = Bag(tmp_path / "run.mcap")
    assert set(bag.topics) | set(TOPICS.values()) == rows("run.mcap")
    keys = set(bag.metadata[METADATA])
    assert all(f"`{key}`" in PAGE for key in keys)
    kinds = {
        topic.kind.removeprefix("foxglove.") for topic in bag.topics.values() if topic.kind.startswith("foxglove.")
    }
    assert all(f"foxglove.{kind}" in PAGE or f"`{kind}`" in PAGE for kind in kinds)
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for message in bag.messages([name for name, topic in bag.topics.items() if topic.kind in TO_ROS]):
        kind, _ = TO_ROS[message.kind](store.types, message.decode())
        assert kind.replace("/msg/", "/") in PAGE


def test_a_fisheye_has_ros_name_in_ros_messages():
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from rosbags.typesys import Stores, get_typestore

    sent = CameraCalibration(distortion_model="kannala_brandt", D=[0.1] * 4, K=[0.0] * 9, R=[0.0] * 9, P=[0.0] * 12)
    _, info = TO_ROS["foxglove.CameraCalibration"](get_typestore(Stores.ROS2_HUMBLE).types, sent)
    assert info.distortion_model == "equidistant"  # sensor_msgs/distortion_models.hpp; image_geometry knows no other
