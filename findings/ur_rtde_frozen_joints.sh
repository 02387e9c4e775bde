#!/bin/sh
# ur_rtde 1.6.5: after the arm is gone, getActualQ() gives its last joints for ever, and no exception.
#
# RTDEReceiveInterface keeps the last values that came. Where the controller is switched off, or the cable is pulled, a
# log goes on with fresh times of the computer and joints that stand; getTimestamp() stands, too. isConnected() turns false,
# but one to four seconds later: the rows in between are of an arm that may have moved on.
#
# Seen, with a controller that sends 125 times a second and after 100 packages falls silent, its line open: joint 1 1.00 rad
# and the same getTimestamp() for 8 s; isConnected() true at first, false about 2.5 s after the last package.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ur_rtde==1.6.5
cd "$folder"
cat >controller.py <<'PYTHON'
"""A controller of Universal Robots: Real-Time Data Exchange, version 2 (their guide to it has the packages)."""

import socket
import struct
import time

VECTORS = ("q", "qd", "qdd", "current", "moment", "joint_control_output", "TCP_pose", "TCP_speed", "TCP_force")
VECTORS += ("joint_temperatures", "joint_voltage", "ft_raw_wrench")
INTEGERS = ("robot_mode", "safety_mode")


def kind(name):
    """Return the type of an output and its form."""
    if name == "joint_mode":
        return "VECTOR6INT32", "6i"
    if name.endswith(VECTORS):
        return "VECTOR6D", "6d"
    if name in ("actual_tool_accelerometer", "payload_cog"):
        return "VECTOR3D", "3d"
    if name == "payload_inertia":
        return "VECTOR6D", "6d"
    if name.endswith("digital_input_bits") or name.endswith("digital_output_bits"):
        return "UINT64", "Q"
    if name in INTEGERS or "int_register" in name:
        return "INT32", "i"
    if name.endswith("status_bits") or name == "runtime_state":
        return "UINT32", "I"
    return "DOUBLE", "d"


listener = socket.create_server(("127.0.0.1", 30004))
print("ready", flush=True)
line = listener.accept()[0]
names = []


def send(code, payload):
    line.sendall(struct.pack(">HB", len(payload) + 3, code) + payload)


while head := line.recv(3, socket.MSG_WAITALL):
    size, code = struct.unpack(">HB", head)
    body = line.recv(size - 3, socket.MSG_WAITALL) if size > 3 else b""
    if code == ord("V"):
        send(code, b"\x01")
    elif code == ord("v"):
        send(code, struct.pack(">4I", 5, 11, 0, 0))
    elif code == ord("O"):
        names = body[8:].decode().split(",")
        send(code, b"\x01" + ",".join(kind(name)[0] for name in names).encode())
    elif code == ord("S"):
        send(code, b"\x01")
        for k in range(1, 101):
            package = b"\x01"
            for name in names:
                form = kind(name)[1]
                numbers = [k / 100 if name in ("actual_q", "timestamp") else 0] * int(form[:-1] or 1)
                package += struct.pack(">" + form, *numbers)
            send(ord("U"), package)
            time.sleep(0.008)
        print("silent", flush=True)
        time.sleep(60)
PYTHON
"$folder/venv/bin/python" - <<'PYTHON'
import subprocess
import sys
import time

from rtde_receive import RTDEReceiveInterface

robot = subprocess.Popen([sys.executable, "controller.py"], stdout=subprocess.PIPE, text=True)
try:
    robot.stdout.readline()
    arm = RTDEReceiveInterface("127.0.0.1")
    assert robot.stdout.readline() == "silent\n"
    silent = time.monotonic()
    time.sleep(0.2)
    first = arm.getActualQ()[0], arm.getTimestamp(), arm.isConnected()
    lost_s = None
    while (passed := time.monotonic() - silent) < 8.0:
        if lost_s is None and not arm.isConnected():
            lost_s = passed
        assert (arm.getActualQ()[0], arm.getTimestamp()) == first[:2]
        time.sleep(0.05)
    assert robot.poll() is None  # the line was open all the time
finally:
    robot.kill()
joint, stamp, connected = first
print(f"silent: joint 1 {joint:.2f} rad, timestamp {stamp:.2f} s, connected {connected}; false after {lost_s:.1f} s")
assert first == (1.0, 1.0, True)
assert lost_s is not None and 1.0 < lost_s < 4.0
PYTHON
