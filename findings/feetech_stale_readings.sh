#!/bin/sh
# feetech-servo-sdk 1.0.0: after a failed sync read, the positions of the time before are available as if they were new.
#
# GroupSyncRead.txRxPacket stops at the first servo that does not answer; what was read of those after it stays as it was,
# and isAvailable says True for it, for it does not ask whether the read succeeded (its line for that is commented out).
# The documented loop "if isAvailable(id): getData(id)" moves on with old positions of half an arm. dynamixel-sdk 4.1.0, of
# which it is a copy, says False for all of them.
#
# Three servos at 1000 2000 3000 answer, move to 1100 2100 3100, and the second does not answer the second read.
#
# Seen, available and position after it: feetech True 1100, False 0, True 3000; dynamixel False 0, False 0, False 0.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet feetech-servo-sdk==1.0.0 dynamixel-sdk==4.1.0 pyserial==3.5
"$folder/venv/bin/python" - <<'PYTHON'
import dynamixel_sdk
import scservo_sdk


class Port:
    """A line on which the servos of ``answers`` (id -> position) reply to a sync read."""

    def __init__(self, reply):
        self.is_using, self.reply, self.answers, self.waiting = False, reply, {}, b""

    def clearPort(self):
        self.waiting = b""

    def writePort(self, packet):
        self.waiting = b"".join(self.reply(k, position) for k, position in self.answers.items())
        return len(packet)

    def readPort(self, length):
        given, self.waiting = self.waiting[:length], self.waiting[length:]
        return list(given) if self.reply is feetech else given

    def setPacketTimeout(self, length):
        pass

    def isPacketTimeout(self):
        return not self.waiting


def feetech(k, position):
    body = bytes([k, 4, 0, *position.to_bytes(2, "little")])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def dynamixel(k, position):
    body = b"\xff\xff\xfd\x00" + bytes([k, 6, 0, 0x55, 0, *position.to_bytes(2, "little")])
    return body + dynamixel_sdk.PacketHandler(2.0).updateCRC(0, list(body), len(body)).to_bytes(2, "little")


def read(sdk, protocol, reply):
    port = Port(reply)
    group = sdk.GroupSyncRead(port, sdk.PacketHandler(protocol), 56, 2)
    for k in (1, 2, 3):
        group.addParam(k)
    port.answers = {1: 1000, 2: 2000, 3: 3000}
    assert group.txRxPacket() == sdk.COMM_SUCCESS
    assert [group.getData(k, 56, 2) for k in (1, 2, 3)] == [1000, 2000, 3000]
    port.answers = {1: 1100, 3: 3100}
    assert group.txRxPacket() != sdk.COMM_SUCCESS
    return [(group.isAvailable(k, 56, 2), group.getData(k, 56, 2)) for k in (1, 2, 3)]


found = read(scservo_sdk, 0, feetech)
peer = read(dynamixel_sdk, 2.0, dynamixel)
print("feetech  ", found)
print("dynamixel", peer)
assert found == [(True, 1100), (False, 0), (True, 3000)]
assert peer == [(False, 0)] * 3
PYTHON
