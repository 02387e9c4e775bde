"""Render a recording with truth, and calibrate the pair on its board: what docs/walkthrough.md goes through.

python examples/05_render_a_recording.py demo_recording
"""

import sys
from pathlib import Path

from armsight import Pair, calibrate_boards, open_board, open_source
from armsight.sim.example_rig import BOARD, demo_recording


def main(folder: Path) -> None:
    """Render into a folder and calibrate there."""
    folder.mkdir(parents=True, exist_ok=True)
    truth, _ = demo_recording(folder)
    board, source, pairs = open_board(BOARD), open_source(f"folder:{folder / 'board'}"), []
    while (shot := source.read()) is not None:
        pairs.append(Pair(shot.name, board.detect(shot.left), board.detect(shot.right)))
    calibration = calibrate_boards(board, pairs, tuple(camera.image_size_px for camera in truth.rig.cameras))
    calibration.rig.save(folder / "rig.json")
    print(
        f"{folder}: board and arm rendered; baseline {1e3 * calibration.rig.baseline_m:.3f} mm, "
        f"truly {1e3 * truth.rig.baseline_m:.3f}; held-out epipolar RMS {calibration.heldout.epipolar_rms_px:.4f} px"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo_recording"))
