#!/bin/sh
# rosbags 0.11.9: a ROS 2 bag whose metadata.yaml and storage file name different QoS profiles has no messages.
#
# metadata.yaml and the storage (.db3 or .mcap) each keep offered_qos_profiles of a topic, which only say how to publish it
# again. Where they differ (none in metadata.yaml, as in bags before version 4 and where it was written anew), Reader opens the
# bag, gives the right message_count, and messages() yields nothing: no error, no warning, for sqlite3 and MCAP alike. Topics
# of metadata.yaml and of the file are matched by everything that describes them. Read each storage file by itself.
#
# Seen: sqlite3: 5 counted, 0 read, 5 read from the file alone; the same for mcap.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

store, kind = get_typestore(Stores.ROS2_HUMBLE), "std_msgs/msg/String"
unlimited = QosTime(0, 0)
qos = Qos(
    QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, unlimited, unlimited,
    QosLiveliness.AUTOMATIC, unlimited, False,
)
for plugin, suffix in ((StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")):
    bag = Path(sys.argv[1]) / suffix
    with Writer(bag, version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/a", kind, typestore=store, offered_qos_profiles=[qos])
        for k in range(5):
            writer.write(topic, k + 1, store.serialize_cdr(store.types[kind](str(k)), kind))
    yaml, file = YAML(typ="safe"), bag / "metadata.yaml"
    metadata = yaml.load(file.read_text())
    for each in metadata["rosbag2_bagfile_information"]["topics_with_message_count"]:
        each["topic_metadata"]["offered_qos_profiles"] = []
    with file.open("w") as stream:
        yaml.dump(metadata, stream)
    with Reader(bag) as reader:
        counted, read = reader.message_count, len(list(reader.messages()))
    with Reader(next(bag.glob(f"*.{suffix}"))) as reader:
        alone = len(list(reader.messages()))
    print(f"{suffix}: {counted} counted, {read} read, {alone} read from the file alone")
    assert (counted, read, alone) == (5, 0, 5)
PYTHON
