#!/bin/sh
# pyniryo 1.2.5: the same six numbers are two orientations, and a pose saved in a frame is loaded without it.
#
# Niryo's tool has two conventions of axes: poses of version 1 (x along the tool) and of version 2 (z along it, as
# DH has it). The robot converts by the version that a message names. get_pose() gives version 1, and so does
# `robot.pose = [...]`. A PoseObject that is made of numbers is version 2: whoever writes get_pose()'s numbers
# to a file and moves to PoseObject(*numbers) gets an orientation 180 deg away (the robot's software, ned_ros 5.4, converts
# version 1 by Rz(180) Ry(-90)). A move_pose() of a list and of a PoseObject are said to be the same.
# PoseMetadata.from_dict drops the frame of version 1: get_pose_saved() of a pose in frame "table" is one in the world's.
#
# Seen: `robot.pose = [numbers]` sends version 1, `robot.move(PoseObject(*robot.get_pose()))` version 2, of the same numbers;
# get_pose_saved() of version 1 in frame "table" has frame ''.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 pyniryo==1.2.5
"$folder/venv/bin/python" - <<'PYTHON'
import json
import socket
import struct
import threading

import pyniryo
from pyniryo.api.enums_communication import DEFAULT_PACKET_SIZE_INFOS

NUMBERS = [0.2, 0.1, 0.3, 0.0, 0.5, 0.0]
SAVED = {
    **dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), NUMBERS)),
    "metadata": {"version": 1, "frame": "table", "length_unit": "METERS"},
}
size = DEFAULT_PACKET_SIZE_INFOS
sent = []


def robot(listener):
    """Answer as the robot's server does; keep what it is asked to do."""
    line = listener.accept()[0]
    while head := line.recv(size["nbr_bytes"]):
        message = json.loads(line.recv(struct.unpack(size["type"], head)[0]))
        sent.append(message)
        answers = {"GET_POSE": NUMBERS, "GET_POSE_SAVED": [SAVED]}
        body = {
            "status": "OK",
            "command": message["command"],
            "list_ret_param": answers.get(message["command"], []),
            "payload_size": 0,
        }
        data = json.dumps(body).encode()
        line.sendall(struct.pack(size["type"], len(data)) + data)


listener = socket.create_server(("127.0.0.1", 40001))
threading.Thread(target=robot, args=(listener,), daemon=True).start()
arm = pyniryo.NiryoRobot("127.0.0.1")
arm.pose = NUMBERS
arm.move(pyniryo.PoseObject(*arm.get_pose()))
moves = [each["param_list"][0] for each in sent if each["command"] == "MOVE"]
for how, move in zip(("robot.pose = numbers:", "move(PoseObject(*get_pose())):"), moves):
    print(how, [move[key] for key in ("x", "y", "z", "roll", "pitch", "yaw")], "version", move["metadata"]["version"])
assert [move["metadata"]["version"] for move in moves] == [1, 2]
assert all([move[key] for key in ("x", "y", "z", "roll", "pitch", "yaw")] == NUMBERS for move in moves)
saved = arm.get_pose_saved("above")
print(f"saved in frame {SAVED['metadata']['frame']!r}, loaded in frame {saved.metadata.frame!r}")
assert saved.metadata.frame == ""
PYTHON
