"""A hub's certificates at a small broker, read by protobuf itself with the messages of sparkplug_b.proto."""

import socket
import sqlite3
import struct
import threading
import time
from contextlib import suppress

import pytest

from armsight.app.hub import service
from armsight.app.hub.cells import CellView
from armsight.app.hub.sparkplug import Node, payload
from armsight.errors import InputError

pytest.importorskip("paho")
pytest.importorskip("google.protobuf")


def message_class():
    """Return the Payload of sparkplug_b.proto, as far as a hub writes it."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    of = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b.proto", package="spb", syntax="proto2")
    metric = file.message_type.add(name="Metric")
    fields = {"name": (1, of.TYPE_STRING), "timestamp": (3, of.TYPE_UINT64), "datatype": (4, of.TYPE_UINT32)}
    fields |= {"is_null": (7, of.TYPE_BOOL), "long_value": (11, of.TYPE_UINT64), "double_value": (13, of.TYPE_DOUBLE)}
    fields |= {"boolean_value": (14, of.TYPE_BOOL), "string_value": (15, of.TYPE_STRING)}
    for name, (number, kind) in fields.items():
        metric.field.add(name=name, number=number, type=kind, label=of.LABEL_OPTIONAL)
    whole = file.message_type.add(name="Payload")
    whole.field.add(name="timestamp", number=1, type=of.TYPE_UINT64, label=of.LABEL_OPTIONAL)
    whole.field.add(name="metrics", number=2, type=of.TYPE_MESSAGE, type_name=".spb.Metric", label=of.LABEL_REPEATED)
    whole.field.add(name="seq", number=3, type=of.TYPE_UINT64, label=of.LABEL_OPTIONAL)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("spb.Payload"))


PAYLOAD = message_class()
VALUES = {4: "long_value", 10: "double_value", 11: "boolean_value", 12: "string_value"}


def read(data):
    """Return seq and the metrics by name."""
    found = PAYLOAD.FromString(data)
    values = {each.name: None if each.is_null else getattr(each, VALUES[each.datatype]) for each in found.metrics}
    return (found.seq if found.HasField("seq") else None), values


class Broker:
    """One client's broker of MQTT 3.1.1: keeps its will, what it publishes and subscribes to."""

    def __init__(self):
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port, self.said, self.wills, self.subscribed = self.listening.getsockname()[1], [], [], []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        with suppress(OSError):
            while True:
                self.client = self.listening.accept()[0]
                with suppress(OSError, EOFError), self.client:
                    while self._packet():
                        pass

    def _bytes(self, n):
        data = b""
        while len(data) < n:
            if not (more := self.client.recv(n - len(data))):
                raise EOFError
            data += more
        return data

    def _packet(self):
        kind, size, shift = self._bytes(1)[0], 0, 0
        while True:
            byte = self._bytes(1)[0]
            size, shift = size | (byte & 127) << shift, shift + 7
            if byte < 128:
                break
        body = self._bytes(size)
        texts = lambda at: body[at + 2 : at + 2 + struct.unpack_from(">H", body, at)[0]]  # noqa: E731
        if kind >> 4 == 1:
            flags, at = body[7], 10
            at += 2 + len(texts(at))
            topic = texts(at)
            self.wills.append((topic.decode(), texts(at + 2 + len(topic)), flags >> 3 & 3, flags >> 5 & 1))
            self.client.sendall(b"\x20\x02\x00\x00")
        elif kind >> 4 == 3:
            topic, qos = texts(0), kind >> 1 & 3
            at = 2 + len(topic)
            self.said.append((topic.decode(), body[at + 2 * (qos > 0) :], qos, kind & 1))
            if qos:
                self.client.sendall(b"\x40\x02" + body[at : at + 2])
        elif kind >> 4 == 8:
            self.subscribed.append((texts(2).decode(), body[-1]))
            self.client.sendall(b"\x90\x03" + body[:2] + b"\x01")
        elif kind >> 4 == 12:
            self.client.sendall(b"\xd0\x00")
        return kind >> 4 != 14

    def put(self, topic, data):
        body = struct.pack(">H", len(topic)) + topic.encode() + data
        self.client.sendall(bytes([0x30, len(body)]) + body)


def cell(name, error_mm=0.05):
    view = CellView("lab", name)
    view.about = {"arm": "so101", "limit_mm": 0.1}
    view.token("s", True, 100.0)
    view.take({"t": 100.0, "mode": "run", "error_mm": error_mm, "shots": 7}, 100.0)
    return view


def test_a_hub_is_born_sends_what_changes_and_dies(wait):
    broker, notes = Broker(), []
    node = Node("lab", f"mqtt://127.0.0.1:{broker.port}", notes.append)
    one, other = cell("table-1"), cell("table-2")
    shown = lambda: [each.to_json(101.0) for each in (one, other)]  # noqa: E731

    def said(count):
        """Return the topics, sequence numbers and metrics of so many messages."""
        wait(lambda: len(broker.said) >= count)
        return [(topic.removeprefix("spBv1.0/lab/"), *read(data)) for topic, data, _, _ in broker.said]

    wait(lambda: node._connected.is_set() and broker.subscribed)
    asked, on_message = [], node._client.on_message
    node._client.on_message = lambda *message: asked.append(on_message(*message))
    node.update(shown())
    born, first, second = said(3)
    assert broker.subscribed == [("spBv1.0/lab/NCMD/hub", 1)]
    assert born[:2] == ("NBIRTH/hub", 0)
    assert set(born[2]) == {"bdSeq", "Node Control/Rebirth"}
    topic, will, qos, retained = broker.wills[0]
    assert (topic, qos, retained) == ("spBv1.0/lab/NDEATH/hub", 1, 0)
    assert read(will) == (None, {"bdSeq": born[2]["bdSeq"]})
    assert [each[:2] for each in (first, second)] == [("DBIRTH/hub/table-1", 1), ("DBIRTH/hub/table-2", 2)]
    known = {"level": 0, "why": "", "mode": "run", "arm": "so101", "error_mm": 0.05, "shots": 7.0, "limit_mm": 0.1}
    assert known.items() <= first[2].items()
    assert first[2]["temperature_c"] is None
    one.take({"t": 101.0, "mode": "run", "error_mm": 0.25, "shots": 7}, 101.0)
    other.token("s", False, 101.0)
    node.update(shown())
    node.update(shown())  # nothing changed
    *_, data, death = said(5)
    assert data[:2] == ("DDATA/hub/table-1", 3)
    assert data[2] == {"level": 1, "why": "error 0.25 mm, more than its limit of 0.10", "error_mm": 0.25}
    assert death == ("DDEATH/hub/table-2", 4, {})
    broker.put("spBv1.0/lab/NCMD/hub", payload(1.0, {"Node Control/Reboot": (bool, True)}, None))
    broker.put("spBv1.0/lab/NCMD/hub", payload(1.0, {"Node Control/Rebirth": (bool, False)}, None))
    broker.put("spBv1.0/lab/NCMD/hub", payload(1.0, {"Node Control/Reboot": (bool, True)}, None) + b"\x18\x01")
    wait(lambda: len(asked) == 3)
    assert not node._birth.is_set()
    broker.put("spBv1.0/lab/NCMD/hub", payload(1.0, {"Node Control/Rebirth": (bool, True)}, None))
    wait(node._birth.is_set)
    node.update(shown())
    assert [each[:2] for each in said(7)[5:]] == [("NBIRTH/hub", 0), ("DBIRTH/hub/table-1", 1)]
    broker.client.shutdown(socket.SHUT_RDWR)  # the connection is lost: the next will and birth have another number
    wait(lambda: len(broker.wills) == 2 and node._connected.is_set())
    node.update(shown())
    again = said(9)[7]
    assert again[0] == "NBIRTH/hub"
    assert again[2]["bdSeq"] == (born[2]["bdSeq"] + 1) % 256 == read(broker.wills[1][1])[1]["bdSeq"]
    node.close()
    assert said(10)[9] == ("NDEATH/hub", None, {"bdSeq": again[2]["bdSeq"]})
    assert [qos for _, _, qos, _ in broker.said] == [0] * 9 + [1]
    assert not any(retained for *_, retained in broker.said)
    assert notes == []


def test_a_failure_is_said_and_ends_neither_thread_nor_store(port, wait, tmp_path, monkeypatch):
    monkeypatch.setattr(service, "STATE_S", 0.05)
    broker, said = Broker(), []
    address = f"mqtt://127.0.0.1:{broker.port}"
    hub = service.Hub(tmp_path, f"tcp/127.0.0.1:{port}", "127.0.0.1:0", None, said.append, address)
    fails = {"table-1"}

    def update(node, cells):
        if fails & {each["name"] for each in cells}:
            raise ValueError(cells[0]["name"])
        of_node(node, cells)

    of_node = Node.update
    monkeypatch.setattr(Node, "update", update)
    for name in ("table-1", "table-2"):
        hub._heard.put(("lab", name, "alive", time.time(), ("s", True)))
        hub._heard.put(("lab", name, "state", time.time(), {"t": time.time(), "health": ["\ud800"]}))
    births = lambda: [topic.split("/")[-1] for topic, *_ in broker.said if "/DBIRTH/" in topic]  # noqa: E731
    wait(births)
    assert births() == ["table-2"]
    assert said == ["MQTT is without lab/table-1: ValueError: table-1"]
    fails.clear()
    wait(lambda: births() == ["table-2", "table-1"])

    def lost(*_, **__):
        raise RuntimeError("Message publish failed: not connected")  # as of paho's wait_for_publish

    monkeypatch.setattr(hub._nodes["lab"]._client, "publish", lost)
    hub.close()
    with pytest.raises(sqlite3.ProgrammingError):
        hub._store.count()  # it is closed


def test_no_broker_is_said_once(port, wait):
    notes = []
    node = Node("lab", f"mqtt://127.0.0.1:{port}", notes.append)
    wait(lambda: notes)
    time.sleep(1.2)  # it is tried again after a second
    node.close()
    assert notes == [f"no MQTT broker answers at mqtt://127.0.0.1:{port}; it is tried again"]


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("localhost:1883", "expected mqtt://"),
        ("mqtt://127.0.0.1:70000", "expected mqtt://"),
        ("mqtt://plant.local", "plant.local is another computer, and mqtt is readable by all between: use mqtts://"),
    ],
)
def test_an_address_that_is_none_or_not_safe(address, message):
    from armsight.app.hub.sparkplug import check_address

    with pytest.raises(InputError, match=message):
        check_address(address)
    assert check_address("mqtts://me@plant.local") == ("mqtts", "me", "plant.local", 8883)
