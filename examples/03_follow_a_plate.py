"""
Follow a plate of discs
=======================

Render the motion of a plate with three discs, cover one disc for a while, and follow the plate from shot to shot.

.. code-block:: console

    $ python examples/03_follow_a_plate.py

The plate is ``examples/plate.toml``; ``armsight body draw`` prints it to scale.
"""

import sys
from pathlib import Path

import numpy as np

from armsight import Follower, Missed, Shot, open_target
from armsight.geometry.pose import exp_se3, pose
from armsight.sim.example_rig import example_rig
from armsight.sim.render.background import plain
from armsight.sim.render.render import PosedBody, render_pair
from armsight.sim.render.scene import plate

SHOTS, RATE_HZ = 12, 60.0
COVERED = range(5, 8)
#: Twist of the plate, in its own axes: m/s and rad/s.
TWIST = np.array([0.3, -0.1, 0.2, 0.4, -0.6, 0.8])
START = pose(np.eye(3), np.array([0.08, -0.04, 0.75]))


def main(folder: Path) -> list[tuple[float, float, float]]:
    """Render and follow; ``folder`` is where the body file is. Return time (s), sigma and error (mm) of each pose."""
    rig, target = example_rig(), open_target(str(folder / "plate.toml"))
    rng = np.random.default_rng(1)
    behind = tuple(plain(camera.image_size_px, rng) for camera in rig.cameras)
    discs = [(x, y - 0.04, 0.008, 0.85) for x, y, _ in target.body.points]
    whole, covered = (
        plate(0.16, 0.14, 0.08, some).on_body(pose(np.eye(3), np.array([0.0, 0.04, 0.0])))
        for some in (discs, discs[1:])
    )
    follower, found = Follower(rig, target), []
    for k in range(SHOTS):
        T_true = START @ exp_se3(TWIST * k / RATE_HZ)
        looks = covered if k in COVERED else whole
        images = render_pair(rig.cameras, rig.T_left_right, [PosedBody((looks,), T_true, TWIST)], behind, rng=rng)
        estimate = follower.measure(Shot(f"{k:02d}", *images, t_s=k / RATE_HZ))
        if isinstance(estimate, Missed):
            print(f"{k:02d}: {follower.way}: {estimate.reason}")
            continue
        x, y, z = 1e3 * estimate.T_left_body[:3, 3]
        sigma = 1e3 * np.sqrt(np.trace(estimate.cov[:3, :3]))
        error = 1e3 * np.linalg.norm(estimate.T_left_body[:3, 3] - T_true[:3, 3])
        print(f"{k:02d}: {follower.way}: x {x:.2f} y {y:.2f} z {z:.2f} mm, sigma {sigma:.3f} mm, error {error:.3f} mm")
        found.append((k / RATE_HZ, float(sigma), float(error)))
    return found


# %%
# The error of each pose beside its predicted sigma; while a disc is covered there is no pose:


def plot(found: list[tuple[float, float, float]]) -> None:
    """Show errors and sigmas over time; needs matplotlib."""
    import matplotlib.pyplot as plt

    t_s, sigma_mm, error_mm = np.array(found).T
    _, ax = plt.subplots(figsize=(8, 3), layout="constrained")
    ax.plot(1e3 * t_s, error_mm, "o", label="error")
    ax.plot(1e3 * t_s, sigma_mm, "_", markersize=14, label="predicted sigma")
    ax.axvspan(1e3 * (COVERED[0] - 0.5) / RATE_HZ, 1e3 * (COVERED[-1] + 0.5) / RATE_HZ, alpha=0.2, label="disc covered")
    ax.set(xlabel="time, ms", ylabel="mm", ylim=(0, None))
    ax.legend()
    plt.show()


if __name__ == "__main__":
    plot(main(Path(sys.argv[0]).resolve().parent))
