"""
Render a recording
==================

Render a recording with truth and calibrate the pair of cameras on its board. The walkthrough of one shot and the first two
tutorials use such a recording.

.. code-block:: console

    $ python examples/05_render_a_recording.py recording           # 960x540: 20 pairs of a board, 40 of a plate
    $ python examples/05_render_a_recording.py recording --small   # 640x360: 14 and 10
"""

import argparse
import tempfile
from pathlib import Path

from armsight import Pair, calibrate_boards, open_board, open_source
from armsight.sim.example_rig import BOARD, demo_recording

#: Of `--small`.
SMALL = {"image_size_px": (640, 360), "boards": 14, "shots": 10}


def main(folder: Path, *, small: bool = False) -> None:
    """Render into a folder and calibrate there."""
    folder.mkdir(parents=True, exist_ok=True)
    truth, _ = demo_recording(folder, **(SMALL if small else {}))
    board, source, pairs = open_board(BOARD), open_source(f"folder:{folder / 'board'}"), []
    while (shot := source.read()) is not None:
        pairs.append(Pair(shot.name, board.detect(shot.left), board.detect(shot.right)))
    calibration = calibrate_boards(board, pairs, tuple(camera.image_size_px for camera in truth.rig.cameras))
    calibration.rig.save(folder / "rig.json")
    print(
        f"{folder}: board and arm rendered; baseline {1e3 * calibration.rig.baseline_m:.3f} mm, "
        f"truly {1e3 * truth.rig.baseline_m:.3f}; held-out epipolar RMS {calibration.held_out.epipolar_rms_px:.4f} px"
    )


# %%
# The first pair of the board, and the first of the plate:


def plot(folder: Path) -> None:
    """Show the first pair of each recording; needs matplotlib."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(2, 2, figsize=(10, 5.8), layout="constrained")
    for row, name in zip(axes, ("board", "arm"), strict=True):
        shot = open_source(str(folder / name)).read()
        for ax, image, side in zip(row, (shot.left, shot.right), ("left", "right"), strict=True):
            ax.imshow(image, cmap="gray", vmin=0, vmax=255)
            ax.set(title=f"{name}, {side}", xticks=(), yticks=())
    plt.show()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path, nargs="?", help="where to write; left out: a figure only")
    parser.add_argument("--small", action="store_true", help="fewer and smaller images")
    arguments = parser.parse_args()
    if arguments.folder is None:
        with tempfile.TemporaryDirectory() as name:
            main(Path(name), small=True)
            plot(Path(name))
    else:
        main(arguments.folder, small=arguments.small)
