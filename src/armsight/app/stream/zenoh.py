"""ROS 2 messages over zenoh, as ROS 2 nodes with ``RMW_IMPLEMENTATION=rmw_zenoh_cpp`` receive them; ROS is not needed here.

``ros2:[HOST:]PORT`` connects to the zenoh router of a ROS 2 of Jazzy or later (``ros2 run rmw_zenoh_cpp rmw_zenohd``,
port 7447); ``ROS_DOMAIN_ID`` is the domain. Messages are those of ``ros.py``, and the data themselves as JSON in
std_msgs/String.

Keys, tokens and attachments as rmw_zenoh's design page defines them: a message is put to
``DOMAIN/TOPIC/TYPE/HASH`` as CDR, with its sequence number, time stamp and the publisher's identity; tokens
``@ros2_lv/...`` make node and topics visible to ``ros2 topic list``.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
from itertools import count
from typing import Any

from armsight.app.stream.cell_file import zenoh_config
from armsight.app.stream.datum import Published, json_text
from armsight.app.stream.foxglove import Messages, nanoseconds, require_foxglove
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


class _RosPublisher:
    """One topic: a zenoh publisher, its token, and what goes with each message."""

    def __init__(self, publisher: Any, token: Any, key: str) -> None:  # noqa: ANN401 - of the library
        self._publisher, self._token, self._numbers = publisher, token, count(1)
        self._identity = hashlib.blake2b(key.encode(), digest_size=16).digest()

    def put(self, data: bytes, stamp_ns: int) -> None:
        """Publish the CDR of a message."""
        attachment = _ATTACHMENT.pack(next(self._numbers), stamp_ns, len(self._identity), self._identity)
        self._publisher.put(data, attachment=attachment)


class Ros2Sink(Sink):
    """Publishes to a ROS 2 system."""

    def __init__(self, published: Published, host: str, port: int) -> None:
        try:
            import zenoh
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise InputError(
                f'--stream ros2 needs {error.name}, which is not installed: pip install "armsight[stream]"'
            ) from None
        require_foxglove("--stream ros2", "stream")
        super().__init__()
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not re.fullmatch(r"\d{1,3}", domain):
            raise InputError(f"ROS_DOMAIN_ID={domain}: expected a number, 0 to 232")
        self._published, self._messages = published, Messages(published)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._publishers: dict[str, _RosPublisher] = {}
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
            self._publishers[topic] = _RosPublisher(self._session.declare_publisher(key), token, key)
        self._publishers[topic].put(bytes(self._store.serialize_cdr(message, kind)), stamp_ns)

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
