"""Measure a board: render five shots with truth, measure them, print each pose beside its error.

    python examples/01_measure_a_board.py

The rig here is the very one that rendered the shots, so the sigma holds the corners' noise alone. A real rig comes from
``armsight calibrate`` (or example 02) and brings the calibration's share with it.
"""

import tempfile
from pathlib import Path

import numpy as np

from armsight import Missed, measure, open_source, open_target
from armsight.sim.example_rig import BOARD, demo_recording


def main(folder: Path) -> None:
    """Render a recording into ``folder``, measure the board in it, and print where it is."""
    truth, _ = demo_recording(folder, image_size_px=(640, 360), boards=5, shots=1)
    target = open_target(BOARD)
    source = open_source(str(folder / "board"))
    for T_true in truth.Ts_left_body:
        shot = source.read()
        assert shot is not None
        estimate = measure(truth.rig, target, shot)
        if isinstance(estimate, Missed):
            print(f"{shot.name}: missed: {estimate.reason}")
            continue
        position = estimate.T_left_body[:3, 3]
        sigma = np.sqrt(np.trace(estimate.cov[:3, :3]))
        error = np.linalg.norm(position - T_true[:3, 3])
        x, y, z = 1e3 * position
        print(f"{shot.name}: x {x:.2f} y {y:.2f} z {z:.2f} mm, sigma {1e3 * sigma:.3f} mm, error {1e3 * error:.3f} mm")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        main(Path(name))
