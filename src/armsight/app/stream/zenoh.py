"""ROS 2 messages over zenoh, as ROS 2 nodes with ``RMW_IMPLEMENTATION=rmw_zenoh_cpp`` receive them; ROS is not needed here.

``ros2:[HOST:]PORT`` connects to the zenoh router of a ROS 2 of Jazzy or later (``ros2 run rmw_zenoh_cpp rmw_zenohd``,
port 7447); ``ROS_DOMAIN_ID`` is the domain. Messages are those of ``ros.py``, and the data as JSON in std_msgs/String.

As rmw_zenoh's design page has it, a message is put to ``DOMAIN/TOPIC/TYPE/HASH`` as CDR, with its number, time stamp and
the publisher's identity; tokens ``@ros2_lv/...`` make node and topics visible to ``ros2 topic list``.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
from itertools import count
from typing import Any

from armsight.app.show.messages import require
from armsight.app.stream.cell_file import zenoh_config
from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.foxglove import SCHEMAS, Messages, nanoseconds
from armsight.app.stream.mcap_file import TOPICS
from armsight.app.stream.ros import TO_ROS, ros_name
from armsight.app.stream.sink import Sink
from armsight.errors import InputError
from armsight.files import as_input_error
from armsight.loop.running.data import Datum, NoteDatum

_NODE = "armsight"
#: Reliable, volatile, keep last 10: what differs from the defaults of rmw_zenoh is written.
_QOS = "::,10:,:,:,,"
#: Sequence number, time stamp, ns, and the length and bytes of the publisher's identity.
_ATTACHMENT = struct.Struct("<qqB16s")


class Ros2Sink(Sink):
    """Publishes to a ROS 2 system."""

    def __init__(self, published: Published, host: str, port: int) -> None:
        require("--stream ros2", "stream", "zenoh", "rosbags.typesys", *SCHEMAS)
        import zenoh
        from rosbags.typesys import Stores, get_typestore

        super().__init__()
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not re.fullmatch(r"\d{1,3}", domain):
            raise InputError(f"ROS_DOMAIN_ID={domain}: expected a number, 0 to 232")
        self._published, self._messages = published, Messages(published)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        #: Of each topic: zenoh's publisher and its token, the numbers of its messages, its identity.
        self._publishers: dict[str, tuple[Any, Any, count[int], bytes]] = {}
        self._infos: dict[str, Any] = {}
        with as_input_error(
            f"--stream ros2:{host}:{port}: no zenoh router answers there; start it: ros2 run rmw_zenoh_cpp rmw_zenohd",
            zenoh.ZError,
        ):
            self._session: Any = zenoh.open(zenoh_config("client", f"tcp/{host}:{port}"))
        self._domain = domain
        self._token_of_node = self._token("0", "NN")

    def _token(self, number: str, kind: str, *about: str) -> Any:  # noqa: ANN401 - of the library
        """Declare an entity of the node; the namespace and the enclave are the root's."""
        names = [self._domain, str(self._session.zid()), "0", number, kind, "%", "%", _NODE]
        return self._session.liveliness().declare_token("/".join(["@ros2_lv", *names, *about]))

    def _put(self, topic: str, kind: str, message: Any, stamp_ns: int) -> None:  # noqa: ANN401 - a message of rosbags
        if topic not in self._publishers:
            package, _, name = kind.split("/")
            mangled, hashed = f"{package}::msg::dds_::{name}_", self._store.hash_rihs01(kind)
            key = "/".join([self._domain, topic.strip("/"), mangled, hashed])
            number = str(len(self._publishers) + 1)
            token = self._token(number, "MP", topic.replace("/", "%"), mangled, hashed, _QOS)
            identity = hashlib.blake2b(key.encode(), digest_size=16).digest()
            self._publishers[topic] = self._session.declare_publisher(key), token, count(1), identity
        publisher, _, numbers, identity = self._publishers[topic]
        attachment = _ATTACHMENT.pack(next(numbers), stamp_ns, len(identity), identity)
        publisher.put(bytes(self._store.serialize_cdr(message, kind)), attachment=attachment)

    def write(self, datum: Datum) -> None:
        """Publish the messages of a datum, and the datum itself as JSON."""
        stamp_ns = nanoseconds(datum.time_s)
        for topic, message in self._messages.of(datum):
            name = type(message).DESCRIPTOR.full_name
            if name not in TO_ROS:
                continue
            kind, made = TO_ROS[name](self._store.types, message)
            if name == "foxglove.CameraCalibration":  # sent with every image, as ROS's tools want it
                self._infos[topic] = made
                continue
            info = self._infos.get(topic.removesuffix("/image") + "/calibration")
            if info is not None:
                info.header.stamp = made.header.stamp
                self._put(ros_name(topic.removesuffix("/image") + "/calibration"), info.__msgtype__, info, stamp_ns)
            self._put(ros_name(topic), kind, made, stamp_ns)
        if not isinstance(datum, NoteDatum):
            text = self._store.types["std_msgs/msg/String"](json_text(datum.to_json(self._published.body)).decode())
            self._put(TOPICS[type(datum)], "std_msgs/msg/String", text, stamp_ns)

    def finish(self) -> None:
        """Leave the system."""
        self._session.close()
