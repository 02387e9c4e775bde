"""The arms that come with armsight: one file of numbers each. A new one is a file and a line here."""

from __future__ import annotations

from armsight.robot.arm import Arm
from armsight.robot.models import irb120, puma560, six_r, ur5, ur10

#: Name -> arm.
MODELS: dict[str, Arm] = {module.ARM.name: module.ARM for module in (six_r, puma560, ur5, ur10, irb120)}
