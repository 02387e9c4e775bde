"""
A recording into pandas
=======================

Measure every shot of a recording, and go on with its table in pandas.

.. code-block:: console

    $ python examples/07_recording_into_pandas.py

The recording is rendered here. For your own give its folder, the rig and the body file.
"""

import tempfile
from pathlib import Path

from armsight import calibrate, measure_all
from armsight.sim.example_rig import BOARD, demo_recording


def main(folder: Path) -> None:
    """Render a recording, calibrate, measure all shots, print what pandas makes of them."""
    import pandas as pd

    demo_recording(folder, image_size_px=(640, 360), boards=12, shots=12)
    rig = calibrate(BOARD, str(folder / "board"), models=("brown5",)).rig

    table = measure_all(rig, str(folder / "plate.toml"), str(folder / "arm"))
    frame = pd.DataFrame(table.columns())
    good = frame[frame["status"] == "ok"]
    print(f"{len(good)} of {len(frame)} shots")
    print((1e3 * good[["x_m", "y_m", "z_m"]]).describe().loc[["mean", "std"]].round(3).to_string())
    frame.to_csv(folder / "poses.csv", index=False)


# %%
# The result draws itself: the position with a band of two sigmas.


def plot(folder: Path) -> None:
    """Draw the positions; needs matplotlib."""
    import matplotlib.pyplot as plt

    rig = calibrate(BOARD, str(folder / "board"), models=("brown5",)).rig
    measure_all(rig, str(folder / "plate.toml"), str(folder / "arm")).plot()
    plt.show()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        main(Path(name))
        plot(Path(name))
