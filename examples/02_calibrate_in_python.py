"""
Calibrate in Python
===================

Calibrate two cameras from pairs of images of a board, and save the rig.

.. code-block:: console

    $ python examples/02_calibrate_in_python.py

The images are rendered here. For your own images give their folder and your board to ``calibrate``, and leave ``models``
out: the held-out error then selects the lens model.
"""

import tempfile
from pathlib import Path

from armsight import calibrate, open_board, open_source
from armsight.sim.example_rig import BOARD, demo_recording
from armsight.vision.image import grey


def main(folder: Path) -> None:
    """Render a recording into ``folder``, calibrate on its board, print the held-out errors, save ``rig.json``."""
    truth, _ = demo_recording(folder, image_size_px=(640, 360), boards=12, shots=1)

    calibration = calibrate(BOARD, str(folder / "board"), models=("brown5",))
    calibration.rig.save(folder / "rig.json")

    heldout, rig = calibration.held_out, calibration.rig
    print(f"held-out: epipolar {heldout.epipolar_rms_px:.3f} px, board {1e3 * heldout.rigid_rms_m:.3f} mm RMS")
    print(f"baseline {1e3 * rig.baseline_m:.3f} mm, truth {1e3 * truth.rig.baseline_m:.3f} mm")
    for weakness in calibration.weaknesses:
        print(f"weak: {weakness}")


# %%
# Corners cover both images. Where there is no corner, the distortion is extrapolated:


def plot(folder: Path) -> None:
    """Show where the corners of all pairs are in both images; needs matplotlib."""
    import matplotlib.pyplot as plt

    board = open_board(BOARD)
    _, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    for shot in open_source(str(folder / "board")):
        for ax, image in zip(axes, (shot.left, shot.right), strict=True):
            uv = board.detect(grey(image)).uv
            ax.plot(uv[:, 0], uv[:, 1], ".", markersize=3)
    for ax, side in zip(axes, ("left", "right"), strict=True):
        ax.set(title=side, xlabel="u, px", ylabel="v, px", xlim=(0, 640), ylim=(360, 0), aspect="equal")
    plt.show()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        main(Path(name))
        plot(Path(name))
