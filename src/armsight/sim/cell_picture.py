"""The cell seen from aside, in colour: arm, body, table and the two cameras that watch. For people, not for measuring."""

from __future__ import annotations

import numpy as np

from armsight.data import Array, Image
from armsight.geometry.pose import inverse, pose
from armsight.sim.workcell.images import ArmSeen, CellCamera
from armsight.sim.workcell.raycast import PLAIN
from armsight.sim.cell_scene import block, furniture
from armsight.sim.cell_solids import row_frames
from armsight.sim.render.optics import Sensor
from armsight.sim.workcell.plant import ArmPlant
from armsight.sim.render.render import Shutter
from armsight.sim.render.scene import Pattern, Placed
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig

#: Where it is seen from and what is in the middle, m; focal length over the image's width.
_EYE, _MIDDLE, _FOCAL = np.array([2.05, -1.75, 1.25]), np.array([0.62, -0.08, 0.30]), 0.95
#: Tints, BGR, of what is grey otherwise: wood, wall and floor, the arm's links, its housings; things take turns.
_WOOD, _ROOM, _LINK, _HOUSING = (0.62, 0.85, 1.10), (1.06, 1.02, 0.98), (0.55, 0.85, 1.30), (1.05, 1.0, 1.0)
_THINGS = ((1.25, 0.95, 0.7), (0.75, 1.15, 0.85), (0.75, 0.85, 1.3), (1.1, 1.1, 0.7), (1.0, 0.8, 1.15))
_CAMERAS = (1.0, 1.0, 1.0)
_SAME = 3  # grey levels


def picture(
    size_px: tuple[int, int],
    plant: ArmPlant,
    body: tuple[tuple[Pattern, ...], Array],
    rig: tuple[Array, StereoRig],
    seed: int,
) -> Image:
    """Return the cell as it is now.

    Args:
        size_px: (width, height).
        plant: the arm.
        body: the patterns on the tool, and T_tool_body (4, 4), m.
        rig: T_base_rig (4, 4), m, and the cameras.
        seed: of the clutter.

    Returns:
        (H, W, 3) BGR, uint8.
    """
    width, height = size_px
    focal = _FOCAL * width
    camera = Camera(size_px, "none", np.array([focal, focal, (width - 1) / 2, (height - 1) / 2]), np.zeros(0))
    z = (_MIDDLE - _EYE) / np.linalg.norm(_MIDDLE - _EYE)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T_base_eye = pose(np.column_stack([x, np.cross(z, x), z]), _EYE)
    more = _rig_boxes(*rig)
    eye = CellCamera(camera, T_base_eye, plant.parts, seed, sensor=Sensor(read_noise=0.0), more=more)
    q = plant.path[-1, 6:]
    arm = ArmSeen(plant.parts, row_frames(plant.arm, q))
    placed = Placed(body[0], inverse(T_base_eye) @ plant.arm.forward(q) @ body[1])
    grey = eye.image(arm, [placed], Shutter(), np.zeros(width * height, np.float32), 0)
    bare = eye.image(arm, [], Shutter(), np.zeros(width * height, np.float32), 0)
    tints = _tints(len(furniture(seed)[0]), len(more))
    tint = tints[np.minimum(eye.still.ids, len(tints) - 1)]
    tint[eye.still.ids < 0] = _ROOM
    ids = eye.arm_ids(arm)
    housing = np.append(False, plant.parts.housing[plant.parts.link > 0][:-1])
    tint[ids > 0] = np.where(housing[ids[ids > 0]][:, None], _HOUSING, _LINK)
    tint[np.abs(grey.astype(int) - bare) > _SAME] = 1.0  # the body is black and white
    return np.asarray(np.clip(np.rint(tint * grey[..., None]), 0, 255).astype(np.uint8))


def _tints(count: int, more: int) -> Array:
    """Return the tints (N + 1, 3) of so many boxes of furniture, the cameras' boxes and, last, all that is round."""
    things = np.array([_THINGS[k % len(_THINGS)] for k in range(count)])
    things[0], things[1:3], things[3:7] = _WOOD, _ROOM, _CAMERAS
    things[7:9], things[9:12], things[12:14] = _CAMERAS, _WOOD, _CAMERAS
    return np.concatenate([things, np.tile(_CAMERAS, (more, 1)), [_THINGS[2]]])


def _rig_boxes(T_base_rig: Array, rig: StereoRig) -> Array:
    """Return boxes that look like two cameras on a bar on a post."""
    Ts = (T_base_rig, T_base_rig @ rig.T_left_right)
    boxes = []
    for T in Ts:
        turn = float(np.degrees(np.arctan2(T[1, 2], T[0, 2])))
        p, ahead = T[:3, 3], T[:3, 2]
        for back, size, albedo in ((0.035, (0.06, 0.062, 0.05), 0.10), (-0.005, (0.03, 0.04, 0.04), 0.22)):
            x, y, z = (p - back * ahead).tolist()
            boxes.append(block((x, y, z), size, turn, albedo, PLAIN))
    middle = 0.5 * (Ts[0][:3, 3] + Ts[1][:3, 3]) - 0.04 * T_base_rig[:3, 2]
    turn = float(np.degrees(np.arctan2(T_base_rig[1, 2], T_base_rig[0, 2])))
    x, y, z = middle.tolist()
    boxes.append(block((x, y, z - 0.04), (0.04, rig.baseline_m + 0.12, 0.02), turn, 0.4, PLAIN))
    boxes.append(block((x, y, (z - 0.05 - 0.74) / 2), (0.035, 0.035, z - 0.05 + 0.74), turn, 0.3, PLAIN))
    return np.array(boxes)
