"""
Dense stereo
============

Render a tilted plate in front of a wall, match the pair of images, and compute the depth of every pixel.

.. code-block:: console

    $ python examples/04_dense.py
"""

import numpy as np

from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.render.render import render_pair
from armsight.sim.render.scene import Pattern, PosedBody
from armsight.vision.dense import open_method
from armsight.vision.dense.depth import depth_of
from armsight.vision.dense.method import Search
from armsight.vision.dense.rectified import match_pair

PLATE = pose(exp_so3(np.array([0.5, 0.6, 0.2])), np.array([0.05, 0.0, 0.8]))
WALL = pose(exp_so3(np.array([0.1, 0.1, 0.0])), np.array([0.1, 0.0, 1.4]))


def printed(side_m: float, cell_m: float, T: np.ndarray, rng: np.random.Generator) -> PosedBody:
    """Return a square at T (4, 4) in the left camera, m, printed with cells of random greys: matching needs texture."""
    count = round(side_m / cell_m)
    edges = (np.arange(count + 1) - count / 2) * cell_m
    return PosedBody((Pattern(edges, edges, rng.integers(2, 18, (count, count)) / 20.0),), T)


def main() -> np.ndarray:
    """Render and match; return the depth (H, W) in m, NaN where it was not measured."""
    rng, rig = np.random.default_rng(1), example_rig((480, 360), focal_px=480.0, baseline_m=0.12, convergence_deg=6.0)
    bodies = [printed(3.0, 0.012, WALL, rng), printed(0.25, 0.006, PLATE, rng)]
    images = render_pair((rig.left, rig.right), rig.T_left_right, bodies, rng=rng)
    form = rig.rectify()
    search = Search(0, int(form.disparity_of(0.55)))
    result = match_pair(open_method("semiglobal"), *form.images(*images), search)
    depth = depth_of(form, result)
    chosen = result.measured & np.isfinite(depth.depth_m)
    print(f"measured {100 * result.measured.mean():.0f}% of the image, median sigma "
          f"{1e3 * np.median(depth.sigma_m[chosen]):.1f} mm at {np.median(depth.depth_m[chosen]):.2f} m")  # fmt: skip
    return np.where(chosen, depth.depth_m, np.nan)


# %%
# The measured depth. White pixels were not measured:


def plot(depth_m: np.ndarray) -> None:
    """Show the depth; needs matplotlib."""
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(7, 4.5), layout="constrained")
    figure.colorbar(ax.imshow(depth_m, cmap="viridis_r"), label="depth, m")
    ax.set(xlabel="u, px", ylabel="v, px")
    plt.show()


if __name__ == "__main__":
    plot(main())
