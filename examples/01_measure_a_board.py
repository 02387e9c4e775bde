"""
Measure a board
===============

Render five shots of a chessboard with truth, measure them, and print each pose beside its error.

.. code-block:: console

    $ python examples/01_measure_a_board.py

The rig is the one that rendered the shots, so sigma contains the noise of the corners only. A real rig comes from
``armsight calibrate`` (or example 02) and adds the share of the calibration.
"""

import tempfile
from pathlib import Path

import numpy as np

from armsight import Missed, measure, open_source, open_target
from armsight.sim.example_rig import BOARD, demo_recording
from armsight.vision.image import grey


def main(folder: Path) -> None:
    """Render a recording into ``folder``, measure the board in it, and print where it is."""
    truth, _ = demo_recording(folder, image_size_px=(640, 360), boards=5, shots=1)
    target = open_target(BOARD)
    for shot, T_true in zip(open_source(str(folder / "board")), truth.Ts_left_body, strict=True):
        estimate = measure(truth.rig, target, shot)
        if isinstance(estimate, Missed):
            print(f"{shot.name}: missed: {estimate.reason}")
            continue
        x, y, z = estimate.position_mm
        sigma = np.linalg.norm(estimate.sigma_mm)
        error = np.linalg.norm(estimate.position_mm - 1e3 * T_true[:3, 3])
        print(f"{shot.name}: x {x:.2f} y {y:.2f} z {z:.2f} mm, sigma {sigma:.3f} mm, error {error:.3f} mm")


# %%
# The first pair of images, with the corners that were found:


def plot(folder: Path) -> None:
    """Show the first pair with its corners; needs matplotlib."""
    import matplotlib.pyplot as plt

    shot, target = open_source(str(folder / "board")).read(), open_target(BOARD)
    _, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    for ax, image, side in zip(axes, (shot.left, shot.right), ("left", "right"), strict=True):
        uv = target.detect(grey(image)).uv
        ax.imshow(image, cmap="gray", vmin=0, vmax=255)
        ax.plot(uv[:, 0], uv[:, 1], "+", color="tab:orange")
        ax.set(title=side, xlabel="u, px", ylabel="v, px")
    plt.show()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        main(Path(name))
        plot(Path(name))
