#!/bin/sh
# rustypot 1.13.1: a position of an STS3215 below zero is read 8 revolutions away, and written so.
#
# Feetech's STS servos write negative numbers as sign and magnitude, bit 15 the sign: with a homing offset a joint that is
# moved a little past the zero of its counts answers 0x8064, -100. Sts3215PyController takes positions and goals for two's
# complement (-32668), although it takes speeds and the offset by sign and magnitude. One count further, the joint jumps by
# 50 rad; a goal of -3.295 rad, -100 counts, is sent as FF9C, which is -32668 to the servo. The maker's SDK
# has SCS_TOHOST(value, 15) for it.
#
# Seen: counts 100 0 -1 -100: -2.988 -3.142 -53.406 -53.254 rad, where they are -2.988 -3.142 -3.143 -3.295;
# the goal of -3.295 rad is sent as 0xFF9C, by sign and magnitude 0x8064; speed 0x8032 is -0.077 rad/s, as it is.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 rustypot==1.13.1 feetech-servo-sdk==1.0.0 pyserial==3.5
"$folder/venv/bin/python" - <<'PYTHON'
import math
import os
import pty
import threading
import tty

import rustypot
from scservo_sdk.scservo_def import SCS_TOHOST

GOAL, POSITION, SPEED = 42, 56, 58
registers = bytearray(100)
master, line = pty.openpty()
tty.setraw(master)
tty.setraw(line)


def servo():
    """Servo 1 on the line: answers reads, takes writes."""
    waiting = b""
    while True:
        waiting += os.read(master, 256)
        while len(waiting) >= 6 and len(waiting) >= 4 + waiting[3]:
            packet, waiting = waiting[: 4 + waiting[3]], waiting[4 + waiting[3] :]
            at, given = packet[5], packet[6:-1]
            if packet[4] == 2:
                data = bytes(registers[at : at + given[0]])
            else:
                registers[at : at + len(given)], data = given, b""
            body = bytes([1, len(data) + 2, 0]) + data
            os.write(master, b"\xff\xff" + body + bytes([~sum(body) & 0xFF]))


def set_to(register, value):
    registers[register : register + 2] = value.to_bytes(2, "little")


threading.Thread(target=servo, daemon=True).start()
controller = rustypot.Sts3215PyController(os.ttyname(line), 1000000, 0.5)
for counts, expected in ((100, -2.988), (0, -3.142), (-1, -53.406), (-100, -53.254)):
    word = abs(counts) | 0x8000 * (counts < 0)
    set_to(POSITION, word)
    (found,) = controller.read_present_position(1)
    true = (counts - 2048) * 2 * math.pi / 4096
    print(f"0x{word:04X}, {counts} counts: {found:.3f} rad, it is {true:.3f}")
    assert SCS_TOHOST(word, 15) == counts
    assert abs(found - expected) < 1e-3
    assert counts < 0 or abs(found - true) < 1e-3
controller.write_goal_position(1, -2148 * 2 * math.pi / 4096)
goal = int.from_bytes(registers[GOAL : GOAL + 2], "little")
print(f"a goal of -3.295 rad is sent as 0x{goal:04X}, {SCS_TOHOST(goal, 15)} counts to the servo")
assert goal == 0xFF9C
set_to(SPEED, 0x8032)
(speed,) = controller.read_present_speed(1)
print(f"speed 0x8032: {speed:.3f} rad/s")
assert abs(speed + 50 * 2 * math.pi / 4096) < 1e-4
PYTHON
