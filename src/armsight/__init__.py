"""armsight: two USB cameras watch markers on a robot arm and say where its end-effector is, in mm, with an honest sigma.

    from armsight import calibrate, measure, measure_all, open_source, open_target
    rig = calibrate("chessboard:9x6:25mm", "pictures of a board").rig      # once: the pair of cameras
    target = open_target("plate.toml")                                     # what is on the arm
    for shot in open_source("recording"):
        print(measure(rig, target, shot))                                  # mm, degrees and sigma, or why there is none
    table = measure_all(rig, target, open_source("recording")).columns("mm")   # for pandas, polars

To open: ``open_source`` images or cameras, ``open_board`` a board, ``open_target`` and ``open_body`` what is measured,
``StereoRig.load`` a rig, ``open_arm`` an arm, ``open_corrected`` an identified one; ``read_poses`` joint angles with
what was measured there, ``read_pose_table`` poses alone, those of ``write_csv`` too.
To compute: ``calibrate``, ``calibrate_boards``, ``calibrate_bodies`` the pair of cameras; ``measure``, ``measure_all``,
``Follower`` the pose of a body; ``handeye`` where rig and body are on the arm; ``identify`` what the arm really is,
``validate`` how far off it is on other poses; ``time_between`` the clocks of two rigs; ``budget`` what a rig would measure.
To exchange: ``as_transform`` reads a transform of pinocchio, SciPy, spatialmath or ROS, ``ros_fields`` writes ROS' fields.
Records: ``Shot``, ``Body``, ``PoseEstimate`` or ``Missed``, ``Pair``, ``Camera``, ``StereoRig``, ``Arm``, ``Corrected``,
``Calibration``, ``HandEye`` and ``Identified``, which ``calibrate``, ``handeye`` and ``identify`` return;
``Measured`` joint angles with what was measured there, as ``identify`` takes them from arrays.
Wrong input raises ``ArmsightError``, with what was found, what was expected and what to do.

Names are imported when they are first used, so that the command line starts at once. The stages are plain functions of
frozen records in :mod:`armsight.data`:

    camera --Shot--> markers --Detections--> match --Correspondences--> triangulate --Points--> locate --PoseEstimate-->
"""

from __future__ import annotations

import functools
import importlib
import os
import re
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from armsight.data import Body, Missed, PoseEstimate, Shot
    from armsight.errors import ArmsightError
    from armsight.geometry.convert import as_transform, ros_fields
    from armsight.loop.delay import time_between
    from armsight.loop.handeye.handeye import HandEye
    from armsight.loop.handeye.handeye import calibrate_handeye as handeye
    from armsight.loop.identify.corrected import Corrected, open_corrected
    from armsight.loop.identify.identify import Identified
    from armsight.loop.identify.measured import Measured
    from armsight.loop.identify.read import read_poses
    from armsight.loop.identify.validate import identify_held_out as identify
    from armsight.loop.identify.validate import validate
    from armsight.robot.arm_file import open_arm
    from armsight.robot.kinematics.arm import Arm
    from armsight.sim.budget.result import budget
    from armsight.tables.poses import read_pose_table
    from armsight.vision.calibrate.boards import Pair, calibrate_boards
    from armsight.vision.calibrate.bodies import calibrate_bodies
    from armsight.vision.calibrate.images import calibrate
    from armsight.vision.calibrate.result import Calibration
    from armsight.vision.camera import Camera
    from armsight.vision.follow.follower import Follower
    from armsight.vision.markers.board import open_board
    from armsight.vision.markers.targets import open_body, open_target
    from armsight.vision.pose.measure import measure
    from armsight.vision.pose.measure_all import measure_all
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
    "Calibration",
    "Camera",
    "Corrected",
    "Follower",
    "HandEye",
    "Identified",
    "Measured",
    "Missed",
    "Pair",
    "PoseEstimate",
    "Shot",
    "StereoRig",
    "as_transform",
    "budget",
    "calibrate",
    "calibrate_boards",
    "calibrate_bodies",
    "handeye",
    "identify",
    "measure",
    "measure_all",
    "open_arm",
    "open_board",
    "open_body",
    "open_corrected",
    "open_source",
    "open_target",
    "read_pose_table",
    "read_poses",
    "ros_fields",
    "time_between",
    "validate",
]

_HOME = {
    **dict.fromkeys(("Body", "Missed", "PoseEstimate", "Shot"), "armsight.data"),
    "Arm": "armsight.robot.kinematics.arm",
    "ArmsightError": "armsight.errors",
    **dict.fromkeys(("as_transform", "ros_fields"), "armsight.geometry.convert"),
    "budget": "armsight.sim.budget.result",
    "calibrate": "armsight.vision.calibrate.images",
    **dict.fromkeys(("Pair", "calibrate_boards"), "armsight.vision.calibrate.boards"),
    "calibrate_bodies": "armsight.vision.calibrate.bodies",
    "Calibration": "armsight.vision.calibrate.result",
    "Camera": "armsight.vision.camera",
    "Follower": "armsight.vision.follow.follower",
    **dict.fromkeys(("HandEye", "handeye"), "armsight.loop.handeye.handeye"),
    **dict.fromkeys(("Corrected", "open_corrected"), "armsight.loop.identify.corrected"),
    "Identified": "armsight.loop.identify.identify",
    "Measured": "armsight.loop.identify.measured",
    "read_poses": "armsight.loop.identify.read",
    "read_pose_table": "armsight.tables.poses",
    "time_between": "armsight.loop.delay",
    **dict.fromkeys(("identify", "validate"), "armsight.loop.identify.validate"),
    "open_arm": "armsight.robot.arm_file",
    "open_board": "armsight.vision.markers.board",
    **dict.fromkeys(("open_body", "open_target"), "armsight.vision.markers.targets"),
    "measure": "armsight.vision.pose.measure",
    "measure_all": "armsight.vision.pose.measure_all",
    "StereoRig": "armsight.vision.rig",
    "open_source": "armsight.vision.sources",
}
#: Public name -> its name at home, where they differ.
_THERE = {"handeye": "calibrate_handeye", "identify": "identify_held_out"}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - a module's names are of any type
    """Import a public name on its first use (PEP 562)."""
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("armsight")
    if name not in _HOME:
        raise AttributeError(f"module 'armsight' has no attribute {name!r}; public are {', '.join(__all__)}")
    found = getattr(importlib.import_module(_HOME[name]), _THERE.get(name, name))
    if isinstance(found, types.FunctionType):
        found = globals()[name] = _in_python(found, name)
    return found


#: Option of the command line in a message -> the argument that a Python caller gives instead, where the names differ.
_ARGUMENTS = {"model": "arm"}
#: What --columns says in a message -> the same of a Python caller.
_SAID = {
    r"--columns (?:seen:)?(?=rotation=|units=)": "",
    r"(?:seen:)?units=detect": "detect_units=True",
    r"\bunits=": "unit=",
}


class _LeftOut:
    def __repr__(self) -> str:
        return "..."


_LEFT_OUT = _LeftOut()  # what help shows of a default that is a function


def _in_python(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Return a function by its public name, whose errors name arguments where the command line's name options."""

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:  # noqa: ANN401 - of any public function
        try:
            return function(*args, **options)
        except _root() as error:
            said = lambda m: f"{_ARGUMENTS.get(m[1], m[1].replace('-', '_'))}{'=' if m[2] else ''}"  # noqa: E731
            text = str(error)
            for option, argument in _SAID.items():
                text = re.sub(option, argument, text)
            error.args = (re.sub(r"(?<![\w-])--([a-z][a-z-]*)( (?=[A-Za-z]+[:=]))?", said, text),)
            raise

    call.__module__, call.__name__, call.__qualname__ = __name__, name, name  # where pickle finds it
    shown = importlib.import_module("inspect").signature(function)
    given = list(shown.parameters.values())
    plain = [
        each.replace(default=_LEFT_OUT) if isinstance(each.default, types.FunctionType) else each for each in given
    ]
    call.__signature__ = shown.replace(parameters=plain)  # type: ignore[attr-defined]  # help shows no lambda
    return call


def _root() -> type[Exception]:
    return importlib.import_module("armsight.errors").ArmsightError  # type: ignore[no-any-return]


def __dir__() -> list[str]:
    """Return the public names, for completion and ``help``."""
    return [*__all__, "__version__"]
