"""The pages' scripts that log another controller's joints, run with stand-ins for the makers' libraries.

What the stand-ins do is in findings/ur_rtde_frozen_joints.sh and findings/xarm_commanded_angles.sh; a Franka takes one
connection (frankarobotics/libfranka, issue 30), and panda-python reads an arm at rest since 1.0.
"""

import contextlib
import csv
import itertools
import re
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ARMS = Path(__file__).resolve().parents[2] / "docs" / "arms"
MEASURED, COMMANDED, ROWS = 0.107, 0.1, 5


class Stopped(Exception):
    """A person's Ctrl-C."""


class Ur:
    """Sends five times; then its last joints stay and it is not connected."""

    def __init__(self, host):
        self.asked, self.read = itertools.count(), itertools.count()

    def isConnected(self):
        return next(self.asked) < ROWS

    def getActualQ(self):
        if next(self.read) == 2 * ROWS:
            raise Stopped
        return [MEASURED] * 6


class Xarm:
    """Answers every other time; without an answer its last angles stay, of one joint more than it has."""

    def __init__(self, host):
        self.asked = itertools.count()

    def get_servo_angle(self, is_radian, is_real=False):
        asked = next(self.asked)
        if asked == 2 * ROWS:
            raise Stopped
        return (3, [0.0] * 7) if asked % 2 else (0, [MEASURED if is_real else COMMANDED] * 7)


class Franka:
    """Has one connection: it must be moved by the one that reads it."""

    def __init__(self, host):
        self.q, self.read = [0.0] * 7, itertools.count()

    def move_to_joint_position(self, pose):
        self.q = [MEASURED] * len(pose)

    def get_state(self):
        if next(self.read) == 100:
            raise Stopped
        return SimpleNamespace(q=self.q)


@pytest.mark.parametrize(
    ("page", "module", "name", "arm", "joints", "count"),
    [
        ("ur", "rtde_receive", "RTDEReceiveInterface", Ur, 6, ROWS),
        ("xarm", "xarm.wrapper", "XArmAPI", Xarm, 6, ROWS),
        ("franka", "panda_py", "Panda", Franka, 7, 40),
    ],
)
def test_a_page_s_script_logs_measured_joints_and_nothing_that_was_not_read(
    page, module, name, arm, joints, count, tmp_path, monkeypatch
):
    stand_in = ModuleType(module)
    setattr(stand_in, name, arm)
    monkeypatch.setitem(sys.modules, module.partition(".")[0], stand_in)
    monkeypatch.setitem(sys.modules, module, stand_in)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    monkeypatch.chdir(tmp_path)
    (script,) = re.findall(r"```python\n(.*?)```", (ARMS / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    with contextlib.suppress(Stopped):
        exec(compile(script, page, "exec"), {})
    with Path("joints.csv").open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert head == ["t_s", *(f"q{k}_rad" for k in range(1, joints + 1))]
    assert len(rows) == count
    assert {cell for _, *q in rows for cell in q} == {str(MEASURED)}
    assert {len(row) for row in rows} == {1 + joints}
