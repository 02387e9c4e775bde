"""The arms that come with armsight: one file of numbers each. A new one is a file and a line here."""

from __future__ import annotations

from armsight.robot.arm import Arm
from armsight.robot.models import (
    ar4,
    franka,
    iiwa,
    irb120,
    puma560,
    six_r,
    so101,
    ur3,
    ur3e,
    ur5,
    ur5e,
    ur10,
    ur10e,
    xarm6,
    xarm7,
)

#: Name -> arm.
MODELS: dict[str, Arm] = {
    module.ARM.name: module.ARM
    for module in (
        *(six_r, puma560, ur5, ur10, irb120),
        *(ur3, ur3e, ur5e, ur10e, ar4, so101, xarm6, xarm7, franka, iiwa),
    )
}
