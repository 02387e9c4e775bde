#!/bin/sh
# feetech-servo-sdk 1.0.0: the byte order of one bus is that of the PacketHandler made last, in the whole process.
#
# PacketHandler(0) is for STS and SMS servos, little-endian, PacketHandler(1) for SCS servos, big-endian. The argument is kept
# in the module, not in the handler: a program with an arm of STS servos and a gripper of SCS ones on two ports reads and
# writes both in the order of the handler that was made last, from then on, also through the handler made first.
#
# Seen: a servo's bytes D0 07 through the first handler, PacketHandler(0): 2000; once PacketHandler(1) was made: 53255.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet feetech-servo-sdk==1.0.0 pyserial==3.5
"$folder/venv/bin/python" - <<'PYTHON'
import scservo_sdk


class Port:
    """A line on which servo 1 answers each read of a position with the bytes D0 07."""

    is_using, waiting = False, b""

    def clearPort(self):
        pass

    def writePort(self, packet):
        body = bytes([1, 4, 0, 0xD0, 0x07])
        self.waiting = b"\xff\xff" + body + bytes([~sum(body) & 0xFF])
        return len(packet)

    def readPort(self, length):
        given, self.waiting = self.waiting[:length], self.waiting[length:]
        return list(given)

    def setPacketTimeout(self, length):
        pass

    def isPacketTimeout(self):
        return not self.waiting


port, arm = Port(), scservo_sdk.PacketHandler(0)
before = arm.read2ByteTxRx(port, 1, 56)
gripper = scservo_sdk.PacketHandler(1)
after = arm.read2ByteTxRx(port, 1, 56)
print("PacketHandler(0) reads", before, "and once PacketHandler(1) was made", after)
assert before == (2000, scservo_sdk.COMM_SUCCESS, 0)
assert after == (0xD007, scservo_sdk.COMM_SUCCESS, 0)
PYTHON
