"""armsight: two USB cameras watch markers on a robot arm and say where its end-effector is, in mm, with an honest sigma.

    camera --Shot--> markers --Detections--> match --Correspondences--> triangulate --Points--> locate --PoseEstimate

``measure`` runs the line for one shot; the stages are plain functions of frozen records in :mod:`armsight.data`. Names are
imported when they are first used, so that the command line starts at once.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from armsight.data import Body, Missed, PoseEstimate, Shot
    from armsight.errors import ArmsightError
    from armsight.loop.identify.corrected import Corrected, open_corrected
    from armsight.robot.arm_file import open_arm
    from armsight.robot.kinematics.arm import Arm
    from armsight.vision.calibrate.boards import Pair, calibrate_boards
    from armsight.vision.calibrate.bodies import calibrate_bodies
    from armsight.vision.camera import Camera
    from armsight.vision.follow.follower import Follower
    from armsight.vision.markers.board import open_board
    from armsight.vision.markers.targets import open_body, open_target
    from armsight.vision.pose.measure import measure
    from armsight.vision.rig import StereoRig
    from armsight.vision.sources import open_source

#: Largest image that is decoded, pixels: a small file can say any size. OpenCV takes the limit when it is first imported.
#: Half: images of 50 Mpx are rejected; double: one hostile image takes 400 MB.
MOST_PIXELS = 1 << 26
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))

__all__ = [
    "Arm",
    "ArmsightError",
    "Body",
    "Camera",
    "Corrected",
    "Follower",
    "Missed",
    "Pair",
    "PoseEstimate",
    "Shot",
    "StereoRig",
    "calibrate_boards",
    "calibrate_bodies",
    "measure",
    "open_arm",
    "open_board",
    "open_body",
    "open_corrected",
    "open_source",
    "open_target",
]

_HOME = {
    **dict.fromkeys(("Body", "Missed", "PoseEstimate", "Shot"), "armsight.data"),
    "Arm": "armsight.robot.kinematics.arm",
    "ArmsightError": "armsight.errors",
    **dict.fromkeys(("Pair", "calibrate_boards"), "armsight.vision.calibrate.boards"),
    "calibrate_bodies": "armsight.vision.calibrate.bodies",
    "Camera": "armsight.vision.camera",
    "Follower": "armsight.vision.follow.follower",
    **dict.fromkeys(("Corrected", "open_corrected"), "armsight.loop.identify.corrected"),
    "open_arm": "armsight.robot.arm_file",
    "open_board": "armsight.vision.markers.board",
    **dict.fromkeys(("open_body", "open_target"), "armsight.vision.markers.targets"),
    "measure": "armsight.vision.pose.measure",
    "StereoRig": "armsight.vision.rig",
    "open_source": "armsight.vision.sources",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - a module's names are of any type
    """Import a public name on its first use (PEP 562)."""
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("armsight")
    if name not in _HOME:
        raise AttributeError(f"module 'armsight' has no attribute {name!r}; public are {', '.join(__all__)}")
    return getattr(importlib.import_module(_HOME[name]), name)
