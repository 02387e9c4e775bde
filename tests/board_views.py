"""Pairs of board detections without images: true cameras, true poses, OpenCV's projection, noise from a seed."""

from functools import cache

import numpy as np

from armsight.data import Detections
from armsight.geometry.pose import inverse, log_se3
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.scene import chessboard
from armsight.vision.calibrate.boards import Pair
from armsight.vision.markers.board import open_board
from views import both_pixels

SIZE = (640, 360)
SIZES = (SIZE, SIZE)


@cache
def rig_and_board(model="brown5", focal_px=450.0, count=20, spec="chessboard:9x6:25mm", seed=5):
    """Return the true rig, the board and poses (count, 4, 4) that both cameras see whole."""
    rig, board = example_rig(SIZE, focal_px=focal_px, model=model), open_board(spec)
    columns, rows = (int(n) for n in spec.split(":")[1].split("x"))
    return rig, board, board_poses(np.random.default_rng(seed), rig, chessboard(columns, rows, 0.025), count)


def detections(ids, uv):
    """Detections whose image gives no covariance."""
    return Detections(np.asarray(ids), np.asarray(uv), np.zeros((len(ids), 2, 2)))


def board_pairs(rig, points, Ts, *, sigma=0.1, seed=0):
    """Let both cameras see points (M, 3) at poses (N, 4, 4); pairs are called p00, p01, ..."""
    rng = np.random.default_rng(seed)
    pairs = []
    for n, T in enumerate(Ts):
        uv = both_pixels(rig, points @ T[:3, :3].T + T[:3, 3])
        uv = uv + sigma * rng.normal(size=uv.shape)
        ids = np.arange(len(points))
        pairs.append(Pair(f"p{n:02d}", detections(ids, uv[:, 0]), detections(ids, uv[:, 1])))
    return pairs


def rig_error(rig, true):
    """(P,) parameters of a rig less the true ones, in the order of its covariance."""
    return np.concatenate(
        [
            rig.left.parameters - true.left.parameters,
            rig.right.parameters - true.right.parameters,
            -log_se3(inverse(rig.T_left_right) @ true.T_left_right),
        ]
    )
