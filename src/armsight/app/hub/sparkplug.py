"""MQTT Sparkplug B (its specification 3.0) for plant systems: the hub is an edge node, its cells are devices.

In: the cells as the page shows them. Out: birth, data and death certificates at ``spBv1.0/SITE/.../hub/CELL``. It is read
only: of commands ``Node Control/Rebirth`` alone is done.
"""

from __future__ import annotations

import os
import re
import ssl
import struct
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from armsight.app.hub.cells import NUMBERS
from armsight.app.hub.keys import HUB
from armsight.app.show.http import HERE
from armsight.app.show.messages import require
from armsight.errors import InputError

_REBIRTH = "Node Control/Rebirth"
#: In a command: the metric, its short fields, and its value, true; every writer of protobuf has fields in their order.
_ASKED = re.compile(
    rb"Node Control/Rebirth(?:[\x10\x18\x20\x28\x30\x38][\x80-\xff]*[\x00-\x7f])*(?:[\x42\x4a].*)?\x70\x01", re.DOTALL
)
_ADDRESS = re.compile(r"(mqtts?)://(?:([^@/]+)@)?(\[[0-9a-fA-F:]+\]|[\w.-]+)(?::(\d{1,5}))?")
#: Where the password of the broker is: a command line is read by all of a computer.
_PASSWORD = "ARMSIGHT_MQTT_PASSWORD"
_TEXTS = ("why", "mode", "armsight", "host", "arm", "body", "rig_made_utc")
#: Type -> its number in the specification (Int64, Double, Boolean, String), and the field of a value.
_KINDS = {int: (4, 11), float: (10, 13), bool: (11, 14), str: (12, 15)}
Value = bool | int | float | str | None


def check_address(address: str) -> tuple[str, str | None, str, int]:
    """Return scheme, user, host and port of a broker's address; an InputError says why it cannot be used."""
    found = _ADDRESS.fullmatch(address)
    if found is None or int(found[4] or 1) > 65535:
        raise InputError(f"--mqtt is {address!r}: expected mqtt://[USER@]HOST[:PORT], mqtts:// for another computer")
    scheme, user, host = found[1], found[2], found[3].strip("[]")
    if scheme == "mqtt" and host not in HERE:
        raise InputError(
            f"--mqtt {address}: {host} is another computer, and mqtt is readable by all between: use mqtts://"
        )
    require("--mqtt", "mqtt", "paho")
    return scheme, user, host, int(found[4] or (8883 if scheme == "mqtts" else 1883))


def _varint(n: int) -> bytes:
    return bytes([n]) if n < 128 else bytes([n & 127 | 128]) + _varint(n >> 7)


def _field(number: int, value: bool | int | float | bytes) -> bytes:
    """Return a field of protobuf."""
    if isinstance(value, bytes):
        return _varint(number << 3 | 2) + _varint(len(value)) + value
    if isinstance(value, float):
        return _varint(number << 3 | 1) + struct.pack("<d", value)
    return _varint(number << 3) + _varint(int(value))


def payload(t_s: float, values: Mapping[str, tuple[type, Value]], seq: int | None) -> bytes:
    """Return a Payload of sparkplug_b.proto, numbered where it has a number; whole values are no less than 0."""
    t = round(1e3 * t_s)
    out = _field(1, t)
    for name, (kind, value) in values.items():
        datatype, field = _KINDS[kind]
        data = value.encode(errors="replace") if isinstance(value, str) else value
        last = _field(7, True) if data is None else _field(field, data if isinstance(data, bytes) else kind(data))
        out += _field(2, _field(1, name.encode()) + _field(3, t) + _field(4, datatype) + last)
    return out if seq is None else out + _field(3, seq)


def metrics(cell: Mapping[str, Any]) -> dict[str, tuple[type, Value]]:
    """Return the metrics of a cell as the page shows it."""
    found = {**cell["about"], **cell["state"], **cell}
    kinds = dict.fromkeys((*NUMBERS, "rig_heldout_mm", "limit_mm", "clock_s"), float) | dict.fromkeys(_TEXTS, str)
    return {"level": (int, cell["level"])} | {name: (kind, found.get(name)) for name, kind in kinds.items()}


class Node:
    """One site, a group, at a broker; it connects, again and again, in a thread of the library.

    ``say`` is given a line for what a person should know at once.
    """

    def __init__(self, site: str, address: str, say: Callable[[str], None]) -> None:
        scheme, user, host, port = check_address(address)
        import paho.mqtt.client as mqtt

        self._site, self._say, self._said, self._seq = site, say, "", 0
        self._bd = int(time.time()) % 256  # a killed hub's is another: the broker may send its death after this birth
        self._born: dict[str, dict[str, tuple[type, Value]]] = {}
        self._connected, self._birth = threading.Event(), threading.Event()
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, f"armsight-{site}-{HUB}")
        if user:
            self._client.username_pw_set(user, os.environ.get(_PASSWORD))
        if scheme == "mqtts":
            self._client.tls_set_context(ssl.create_default_context())
        heard = self._came, self._went, self._asked
        self._client.on_connect, self._client.on_disconnect, self._client.on_message = heard
        self._client.on_connect_fail = lambda *_: self._note(f"no MQTT broker answers at {address}")
        self._client.will_set(self._topic("NDEATH"), self._death_payload(), qos=1)
        self._client.connect_async(host, port)
        self._client.loop_start()

    def update(self, cells: Sequence[Mapping[str, Any]]) -> None:
        """Publish what changed since the last time."""
        if self._connected.is_set() and self._birth.is_set():
            self._birth.clear()
            self._born, self._seq = {}, 0
            self._publish("NBIRTH", "", {"bdSeq": (int, self._bd), _REBIRTH: (bool, False)})
        for cell in cells if self._connected.is_set() else ():
            name, now = cell["name"], metrics(cell)
            if not cell["up"]:
                if self._born.pop(name, None) is not None:
                    self._publish("DDEATH", name, {})
                continue
            before = self._born.get(name, {})
            if changed := {key: value for key, value in now.items() if before.get(key) != value}:
                self._publish("DDATA" if before else "DBIRTH", name, changed)
            self._born[name] = now

    def close(self) -> None:
        """Publish the death, and leave."""
        if self._connected.is_set():
            with suppress(RuntimeError, ValueError):  # of the library: the connection was lost, and it has not noticed
                self._client.publish(self._topic("NDEATH"), self._death_payload(), qos=1).wait_for_publish(1.0)
        self._client.disconnect()
        self._client.loop_stop()

    def _topic(self, kind: str, cell: str = "") -> str:
        return "/".join(["spBv1.0", self._site, kind, HUB, *([cell] if cell else [])])

    def _death_payload(self) -> bytes:
        return payload(time.time(), {"bdSeq": (int, self._bd)}, None)

    def _publish(self, kind: str, cell: str, values: Mapping[str, tuple[type, Value]]) -> None:
        self._client.publish(self._topic(kind, cell), payload(time.time(), values, self._seq))
        self._seq = (self._seq + 1) % 256

    def _note(self, text: str) -> None:
        if self._said != text:
            self._said = text
            self._say(f"{text}; it is tried again")

    def _came(self, client: Any, _: Any, __: Any, code: Any, *___: Any) -> None:  # noqa: ANN401 - of the library
        if code.is_failure:
            self._note(f"the MQTT broker does not accept this hub ({code}): the user, and {_PASSWORD}, may be wrong")
            return
        self._said = ""
        client.subscribe(self._topic("NCMD"), qos=1)
        self._birth.set()
        self._connected.set()

    def _asked(self, _: Any, __: Any, message: Any) -> None:  # noqa: ANN401 - of the library
        if _ASKED.search(message.payload):
            self._birth.set()

    def _went(self, client: Any, *_: Any) -> None:  # noqa: ANN401 - of the library
        if self._connected.is_set():
            self._connected.clear()
            self._bd = (self._bd + 1) % 256  # of the next connection, as its will
            client.will_set(self._topic("NDEATH"), self._death_payload(), qos=1)
