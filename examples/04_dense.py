"""
Dense stereo
============

Render a box in front of a wall, match the pair of images, and compute the depth of every pixel.

.. code-block:: console

    $ python examples/04_dense.py
"""

import numpy as np

from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.render.mesh import box, see, with_noise
from armsight.vision.dense import open_method
from armsight.vision.dense.depth import depth_of
from armsight.vision.dense.method import Search
from armsight.vision.dense.rectified import match_pair

BOX_M = np.array([0.20, 0.15, 0.12])
T_TRUE = pose(exp_so3(np.array([0.5, 0.6, 0.2])), np.array([0.05, 0.0, 0.8]))
WALL = pose(exp_so3(np.array([0.1, 0.1, 0.0])), np.array([0.1, 0.0, 1.4]))


def main() -> np.ndarray:
    """Render and match; return the depth (H, W) in m, NaN where it was not measured."""
    rng, rig = np.random.default_rng(1), example_rig((480, 360), focal_px=480.0, baseline_m=0.12, convergence_deg=6.0)
    thing = box(BOX_M, grain_m=0.02, seed=1)
    wall = box(np.array([3.0, 3.0, 0.02]), grain_m=0.05, seed=2)
    images = []
    for camera, T in ((rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right))):
        image, _, _ = see(camera, [(wall, T @ WALL), (thing, T @ T_TRUE)])
        images.append(with_noise(image, 1.5, rng))
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
