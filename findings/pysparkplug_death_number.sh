#!/bin/sh
# pysparkplug 0.6.1: the death certificate of a clean disconnect has the number of the next session, not that of its birth.
#
# Sparkplug 3.0: the bdSeq of an NBIRTH is that of its session's will (payloads-nbirth-bdseq-repeat), and that of an NDEATH says
# which birth it ends, so that a late death is distinguished from one that counts. EdgeNode sets the will of the next connection
# as soon as it has connected, and with it the metric that disconnect() publishes: a host that compares the two ignores the
# death, and shows the node as alive. The death of a connection that is lost is right. armsight's hub makes its certificates
# itself, with paho-mqtt.
#
# Seen: will 0, birth 0, death 1.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pysparkplug==0.6.1
"$folder/venv/bin/python" - <<'PYTHON'
import socket
import struct
import threading
import time

from pysparkplug import EdgeNode
from pysparkplug import _protobuf as protobuf

published, wills = [], []
listening = socket.create_server(("127.0.0.1", 0))


def exactly(connection, count):
    data = b""
    while len(data) < count:
        more = connection.recv(count - len(data))
        if not more:
            raise EOFError
        data += more
    return data


def text(body, at):
    """Return the bytes of a length-prefixed text, and where it ends."""
    end = at + 2 + struct.unpack_from(">H", body, at)[0]
    return body[at + 2 : end], end


def broker():
    """MQTT 3.1.1 for one client: keep its will and what it publishes (quality of service 0)."""
    connection = listening.accept()[0]
    try:
        while True:
            kind, size, shift = exactly(connection, 1)[0] >> 4, 0, 0
            while True:
                byte = exactly(connection, 1)[0]
                size, shift = size | (byte & 127) << shift, shift + 7
                if byte < 128:
                    break
            body = exactly(connection, size)
            if kind == 1:
                _, at = text(body, 10)
                _, at = text(body, at)
                wills.append(text(body, at)[0])
                connection.sendall(b"\x20\x02\x00\x00")
            elif kind == 3:
                topic, at = text(body, 0)
                published.append((topic.decode().split("/")[2], body[at:]))
            elif kind == 8:
                connection.sendall(b"\x90\x03" + body[:2] + b"\x01")
    except EOFError:
        connection.close()


def number(data):
    return next(each.long_value for each in protobuf.Payload.FromString(data).metrics if each.name == "bdSeq")


thread = threading.Thread(target=broker)
thread.start()
node = EdgeNode(group_id="site", edge_node_id="hub", metrics=())
node.connect("127.0.0.1", port=listening.getsockname()[1])
while not published:
    time.sleep(0.05)
time.sleep(0.5)
node.disconnect()
thread.join()
found = {kind: number(data) for kind, data in published}
print(f"will {number(wills[0])}, birth {found['NBIRTH']}, death {found['NDEATH']}")
assert (number(wills[0]), found) == (0, {"NBIRTH": 0, "NDEATH": 1})
PYTHON
