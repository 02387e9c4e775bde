"""Calibrate two cameras from pairs of board images, and save the rig.

    python examples/02_calibrate_in_python.py

The images are rendered here; with your own, give their folder to ``open_source``, your board to ``open_board``, the size
of your images to ``calibrate_boards``, and leave ``models`` out: the held-out error then chooses.
"""

import tempfile
from pathlib import Path

from armsight import Pair, calibrate_boards, open_board, open_source
from armsight.sim.example_rig import BOARD, demo_recording
from armsight.vision.image import grey


def main(folder: Path) -> None:
    """Render a recording into ``folder``, calibrate on its board, print the held-out errors, save ``rig.json``."""
    truth, _ = demo_recording(folder, image_size_px=(640, 360), boards=12, shots=1)

    board = open_board(BOARD)
    source = open_source(str(folder / "board"))
    pairs = []
    while (shot := source.read()) is not None:
        if shot.left is not None and shot.right is not None:
            pairs.append(Pair(shot.name, board.detect(grey(shot.left)), board.detect(grey(shot.right))))
    calibration = calibrate_boards(board, pairs, ((640, 360), (640, 360)), models=("brown5",))
    calibration.rig.save(folder / "rig.json")

    heldout, rig = calibration.heldout, calibration.rig
    print(f"held-out: epipolar {heldout.epipolar_rms_px:.3f} px, board {1e3 * heldout.rigid_rms_m:.3f} mm RMS")
    print(f"baseline {1e3 * rig.baseline_m:.3f} mm, truth {1e3 * truth.rig.baseline_m:.3f} mm")
    for weakness in calibration.weaknesses:
        print(f"weak: {weakness}")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        main(Path(name))
