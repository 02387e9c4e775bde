"""
Hand-eye calibration for a paper
================================

Calibrate hand and eye from poses of a UR5e and of a target, and write what a paper needs: a figure as SVG and PDF, and a
LaTeX table.

.. code-block:: console

    $ python examples/06_handeye_for_a_paper.py

The poses are simulated here. For your own, make lists of 4x4 matrices: ``as_transform`` reads those of pinocchio, SciPy,
spatialmath and ROS.
"""

import tempfile
from pathlib import Path

import numpy as np

from armsight import as_transform, handeye, open_arm
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.geometry.rotation import euler_zyx, from_euler_zyx

#: Standard deviations of the target's pose: m along each axis, rad about each.
NOISE = np.repeat([2e-4, 5e-4], 3)


def recorded(count: int = 30) -> tuple[list, list, np.ndarray]:
    """Return poses of the flange, of the target in the camera, and the true pose of the camera in the base."""
    rng, arm = np.random.default_rng(4), open_arm("ur5e")
    T_base_rig = pose(from_euler_zyx(0.3, -0.2, 2.9), np.array([0.6, -0.3, 1.1]))
    T_flange_body = pose(from_euler_zyx(-0.4, 0.1, 0.2), np.array([0.02, 0.03, 0.08]))
    q = np.radians([0.0, -80.0, 100.0, -110.0, -90.0, 0.0]) + rng.uniform(-0.5, 0.5, (count, 6))
    flange = arm.forward(q)
    seen = inverse(T_base_rig) @ flange @ T_flange_body @ exp_se3(NOISE * rng.normal(size=(count, 6)))
    return [as_transform(T) for T in flange], [as_transform(T) for T in seen], T_base_rig


def main(folder: Path) -> None:
    """Calibrate, print the error on poses left out of the fit, write ``handeye.tex``."""
    flange, seen, truth = recorded()
    found = handeye(flange, seen, [np.diag(NOISE**2)] * len(seen))

    position_m, angle_rad = found.held_out.mean()
    print(f"left out of the fit: {1e3 * position_m:.3f} mm, {np.degrees(angle_rad):.4f} deg")
    error_mm = 1e3 * np.linalg.norm(found.T_base_still[:3, 3] - truth[:3, 3])
    sigma_mm = 1e3 * np.sqrt(np.trace(found.cov[:3, :3]))
    print(f"camera in the base: sigma {sigma_mm:.3f} mm, error {error_mm:.3f} mm")
    (folder / "handeye.tex").write_text(table(found))


# %%
# The table has each transform with its standard deviations, mm and degrees, as the text of a paper quotes them.


def table(found) -> str:
    """Return a LaTeX table of both transforms."""
    rows = []
    for name, T, cov in (
        ("base--camera", found.T_base_still, found.cov[:6, :6]),
        ("flange--target", found.T_flange_held, found.cov[6:, 6:]),
    ):
        sigma = np.sqrt(np.diag(cov))
        values = [f"{1e3 * v:.2f}" for v in T[:3, 3]] + [f"{np.degrees(v):.3f}" for v in euler_zyx(T[:3, :3])[0]]
        spread = (1e3 * np.linalg.norm(sigma[:3]), np.degrees(np.linalg.norm(sigma[3:])))
        rows.append(f"{name} & {' & '.join(values)} & {spread[0]:.2f} & {spread[1]:.3f} \\\\")
    head = "transform & $x$ & $y$ & $z$ & $r_z$ & $r_y$ & $r_x$ & $\\sigma_t$/mm & $\\sigma_r$/deg \\\\"
    return "\n".join(["\\begin{tabular}{lrrrrrrrr}", head, "\\hline", *rows, "\\end{tabular}", ""])


# %%
# The figure shows how far each pose is from the fit, in units of what is expected.


def plot(folder: Path) -> None:
    """Write ``handeye.svg`` and ``handeye.pdf``; needs matplotlib."""
    import matplotlib.pyplot as plt

    flange, seen, _ = recorded()
    found = handeye(flange, seen, [np.diag(NOISE**2)] * len(seen))
    _, ax = plt.subplots(figsize=(3.5, 2.2), layout="constrained")
    ax.bar(np.arange(len(found.distance)), found.distance, color=np.where(found.used, "tab:blue", "tab:red"))
    ax.axhline(1.0, color="black", linewidth=0.8)
    ax.set(xlabel="pose", ylabel="distance / expected")
    for kind in ("svg", "pdf"):
        plt.savefig(folder / f"handeye.{kind}")
    plt.show()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        main(Path(name))
        plot(Path(name))
