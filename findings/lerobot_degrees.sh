#!/bin/sh
# lerobot 0.4.4: a degree of a Feetech bus is 4095/4096 of one more, and goals are cut to counts, not rounded.
#
# MotorNormMode.DEGREES (use_degrees, the unit of datasets' observation.state and action then) takes a revolution of a servo
# of 4096 counts, STS3215, for 4095 counts: an angle of 90 degrees is recorded as 90.022, one of 170 as 170.042.
# It is a scale, which a fit of link lengths or offsets does not absorb: 0.25 mm at 0.35 m. Goals are cut by int(), so a
# joint stands 0.5 count below its goal on the mean: 0.044 degrees on one side, which no average of many goals removes.
# A joint that may rotate freely (wrist_roll, range 0 to 4095) has its zero at 2047.5, between two counts.
#
# Seen: counts 3072 of the range 1024 to 3072 (90 degrees): 90.022; goals of all hundredths of a degree from -90 to 90: mean of
# reached less wanted -0.50 counts, rounded 0.00. Counts 2047 and 2048 of the range 0 to 4095: -0.044 and 0.044.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 pyserial==3.5 deepdiff==8.6.1 tqdm==4.67.1 feetech-servo-sdk==1.0.0
"$folder/venv/bin/pip" install --quiet --no-deps lerobot==0.4.4
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import types

import numpy as np

utils = types.ModuleType("lerobot.utils.utils")  # imports torch for what a bus does not use
utils.enter_pressed = utils.move_cursor_up = None
sys.modules["lerobot.utils.utils"] = utils
from lerobot.motors import Motor, MotorCalibration, MotorNormMode  # noqa: E402
from lerobot.motors.feetech import FeetechMotorsBus  # noqa: E402

LOW, HIGH = 1024, 3072
MIDDLE, COUNTS = (LOW + HIGH) / 2, 4096
bus = FeetechMotorsBus(
    "/dev/null",
    {name: Motor(k, "sts3215", MotorNormMode.DEGREES) for k, name in enumerate(("elbow", "wrist_roll"), 1)},
    {"elbow": MotorCalibration(1, 0, 0, LOW, HIGH), "wrist_roll": MotorCalibration(2, 0, 0, 0, 4095)},
)
read = bus._normalize({1: HIGH})[1]  # what sync_read does with the counts of a servo
true = (HIGH - MIDDLE) * 360 / COUNTS
print(f"{HIGH - MIDDLE:.0f} of {COUNTS} counts are {true:.3f} degrees, read {read:.3f}")
assert true == 90.0
assert abs(read - 90.0 * 4096 / 4095) < 1e-9

goals = np.arange(-9000, 9001) / 100
wanted = goals * 4095 / 360 + MIDDLE  # by its own scale
reached = np.array([bus._unnormalize({1: goal})[1] for goal in goals.tolist()])  # what sync_write does with goals
cut, rounded = np.mean(reached - wanted), np.mean(np.round(wanted) - wanted)
print(f"goals: reached less wanted {cut:.2f} counts on the mean, rounded {abs(rounded):.2f}")
assert abs(cut + 0.5) < 0.01 and abs(rounded) < 0.005

around = [bus._normalize({2: count})[2] for count in (2047, 2048)]
print("counts 2047 and 2048 of the range 0 to 4095: {:.3f} and {:.3f} degrees".format(*around))
assert abs(around[0] + 0.5 * 360 / 4095) < 1e-9 and abs(around[0] + around[1]) < 1e-9
PYTHON
