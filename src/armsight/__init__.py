"""armsight: two USB cameras watch markers on a robot arm and say where its end-effector is, in mm, with an honest sigma.

    camera --Shot--> markers --Detections--> match --Correspondences--> triangulate --Points--> locate --PoseEstimate

``measure`` runs the line for one shot; the stages are plain functions of frozen records in :mod:`armsight.data`.
"""

from armsight.data import Body, Missed, PoseEstimate, Shot
from armsight.errors import ArmsightError
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.bodies import calibrate_bodies
from armsight.vision.camera import Camera
from armsight.vision.markers.board import open_board
from armsight.vision.markers.targets import open_body, open_target
from armsight.vision.measure import measure
from armsight.vision.rig import StereoRig
from armsight.vision.sources import open_source

__all__ = [
    "ArmsightError",
    "Body",
    "Camera",
    "Missed",
    "Pair",
    "PoseEstimate",
    "Shot",
    "StereoRig",
    "calibrate_boards",
    "calibrate_bodies",
    "measure",
    "open_board",
    "open_body",
    "open_source",
    "open_target",
]
