"""mrcal (Debian: ``apt install mrcal python3-mrcal``) on the same corners as OpenCV's calibration: another peer.

mrcal's own corner finder, mrgingham, is not packaged; it is given OpenCV's corners and ours. Lens models: those that a rig
of ours can hold. Outlier rejection, regularisation and the board's warp are mrcal's defaults.
"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from armsight.data import Correspondences
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig

COMMAND = "mrcal-calibrate-cameras"
MODELS = {"LENSMODEL_OPENCV4": "brown4", "LENSMODEL_OPENCV5": "brown5", "LENSMODEL_OPENCV8": "brown8"}
_COLUMNS, _ROWS = 9, 6


def available() -> bool:
    """Whether mrcal is installed."""
    return shutil.which(COMMAND) is not None


def mrcal_rig(shots: list[Correspondences], size: tuple[int, int], spacing_m: float, lens: str) -> StereoRig:
    """Calibrate with mrcal.

    Args:
        shots: corners of the board in both images, in the order of its rows.
        size: (width, height) of the images.
        spacing_m: of the corners, m.
        lens: one of MODELS.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        lines = ["# filename x y level"]
        for k, shot in enumerate(shots):
            for side, name in enumerate(("left", "right")):
                corners = np.full((_COLUMNS * _ROWS, 2), np.nan)
                rows = shot.seen[:, side]
                corners[shot.ids[rows]] = shot.uv[rows, side]
                lines += [
                    f"{name}{k:03d}.png " + ("- - -" if np.isnan(u) else f"{u:.6f} {v:.6f} 0") for u, v in corners
                ]
        (folder / "corners.vnl").write_text("\n".join(lines) + "\n", encoding="utf-8")
        board = ("--object-spacing", f"{spacing_m}", "--object-width-n", f"{_COLUMNS}", "--object-height-n", f"{_ROWS}")
        images = ("--imagersize", f"{size[0]}", f"{size[1]}", "--corners-cache", str(folder / "corners.vnl"))
        start = ("--lensmodel", lens, "--focal", f"{0.9 * size[0]:.0f}", "--outdir", temporary)
        subprocess.run(
            [COMMAND, *start, *board, *images, "left*.png", "right*.png"], check=True, capture_output=True, cwd=folder
        )
        left, right = (_model(folder / f"camera-{k}.cameramodel", lens) for k in (0, 1))
    parameters = left[0].parameters.size + right[0].parameters.size + 6
    return StereoRig(left[0], right[0], left[1] @ inverse(right[1]), np.zeros((parameters, parameters)), 0.1)


def _model(path: Path, lens: str) -> tuple[Camera, np.ndarray]:
    """Read a camera model: the camera, and T_camera_reference."""
    found = ast.literal_eval(re.search(r"^\{.*", path.read_text(encoding="utf-8"), re.M | re.S)[0])
    values = np.array(found["intrinsics"])
    size = (int(found["imagersize"][0]), int(found["imagersize"][1]))
    rt = np.array(found["extrinsics"])
    return Camera(size, MODELS[lens], values[:4], values[4:]), pose(exp_so3(rt[:3]), rt[3:])
