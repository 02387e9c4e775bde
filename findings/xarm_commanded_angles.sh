#!/bin/sh
# xarm-python-sdk 1.18.4: get_servo_angle() is where the joints were sent; is_real=True, which its documentation lacks, is where they are.
#
# One request, number 42, has two answers: without data the controller's commanded angles, with the byte 01 those of the
# joints' encoders. get_servo_angle() sends it without: an arm that is pushed, sags or lags is logged where it should be
# (UFACTORY's answer in issue 73 of the SDK: is_real=True). The docstring names neither the parameter nor that the angles are
# commanded. With firmware 1.8.5 is_real=True is ignored without a word. An answer that does not come leaves the
# angles of the time before, with a code that is not 0.
#
# Seen, with a controller that answers 0.1 rad commanded and 0.107 measured: get_servo_angle() 0.1, is_real=True 0.107; with
# firmware 1.8.5 0.1; without an answer code 3 and 0.1.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet xarm-python-sdk==1.18.4
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import inspect
import socket
import struct
import threading

from xarm.core.config.x_config import XCONF
from xarm.wrapper import XArmAPI

COMMANDED, MEASURED = 0.1, 0.107
requests = []


def controller(listener, version, silent):
    """Answer as a control box does: request and answer begin with number, protocol, length and function."""
    line = listener.accept()[0]
    line.settimeout(None)  # the SDK sets one for all sockets
    while head := line.recv(6, socket.MSG_WAITALL):
        number, protocol, length = struct.unpack(">3H", head)
        function, *data = line.recv(length, socket.MSG_WAITALL)
        answer = bytes(40)
        if function == 1:
            answer = version.encode().ljust(40, b"\0")
        if function == 42:
            requests.append(bytes(data))
            answer = struct.pack("<7f", *[MEASURED if data else COMMANDED] * 7)
            if silent.is_set():
                continue
        line.sendall(struct.pack(">3H2B", number, protocol, len(answer) + 2, function, 0) + answer)


def arm(version):
    """Return an arm whose controller has a firmware, and what makes it silent."""
    listener, silent = socket.create_server(("127.0.0.1", 0)), threading.Event()
    listener.settimeout(None)
    XCONF.SocketConf.TCP_CONTROL_PORT = listener.getsockname()[1]  # 502 is root's
    threading.Thread(target=controller, args=(listener, version, silent), daemon=True).start()
    return XArmAPI("127.0.0.1", is_radian=True, enable_report=False, enable_heartbeat=False, check_robot_sn=False), silent


new, silent = arm("6,6,XI130006,AC130006,v2.6.107")
default, real = new.get_servo_angle(), new.get_servo_angle(is_real=True)
print(f"get_servo_angle() {default[1][0]}, is_real=True {real[1][0]}; data of the requests {requests}")
assert (default[0], real[0]) == (0, 0)
assert (default[1][0], real[1][0]) == (COMMANDED, MEASURED)
assert requests == [b"", b"\x01"]
assert "is_real" not in inspect.getdoc(XArmAPI.get_servo_angle)
old, _ = arm("6,6,XI130006,AC130006,v1.8.5")
code, angles = old.get_servo_angle(is_real=True)
print(f"firmware 1.8.5, is_real=True: code {code}, {angles[0]}")
assert (code, angles[0]) == (0, COMMANDED)
new.get_servo_angle()
silent.set()
code, angles = new.get_servo_angle()
print(f"without an answer: code {code}, {angles[0]}")
assert code == 3 and angles[0] == COMMANDED
PYTHON
