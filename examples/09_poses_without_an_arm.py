"""
Poses without an arm
====================

Write what the page of an arm has before ``identify``, for a simulated arm whose zeros and lengths are off: ``joints.csv``
as its controller's log, ``poses.csv`` as ``armsight measure`` writes it.

.. code-block:: console

    $ python examples/09_poses_without_an_arm.py franka
    $ armsight identify --arm franka --data poses.csv --joints joints.csv -o corrected
"""

import csv
import dataclasses
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from armsight import open_arm

#: Poses, and s of motion and of rest for each; sigma of zeros, deg, and of lengths, mm; noise of a shot, mm and deg.
POSES, MOVE_S, REST_S = 40, 1.0, 2.0
ZEROS_DEG, LENGTHS_MM = 0.3, 0.5
NOISE_MM, NOISE_DEG = 0.05, 0.01


def main(name: str, folder: Path) -> None:
    """Write both files of a model's arm."""
    arm = open_arm(name)
    rng = np.random.default_rng(0)
    count = len(arm.a)
    true = dataclasses.replace(
        arm,
        offset=arm.offset + np.radians(rng.normal(0, ZEROS_DEG, count)),
        a=arm.a + 1e-3 * rng.normal(0, LENGTHS_MM, count),
    )
    T_rig_base = RigidTransform.from_components(
        [0.1, 0.3, 0.9], Rotation.from_euler("zyx", [10, 5, -100], degrees=True)
    )

    poses = rng.uniform(arm.home - 0.6, arm.home + 0.6, (POSES, count)).clip(arm.q_min, arm.q_max)
    t_s = np.arange(0.0, POSES * (MOVE_S + REST_S), 0.05)
    pose, into_s = np.divmod(t_s, MOVE_S + REST_S)
    now, before = poses[pose.astype(int)], poses[np.maximum(pose.astype(int) - 1, 0)]
    moved = np.minimum(into_s / MOVE_S, 1.0)[:, None]
    q = before + moved**2 * (3.0 - 2.0 * moved) * (now - before)

    with (folder / "joints.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t_s", *(f"q{i}_rad" for i in range(1, count + 1))])
        rows.writerows(np.column_stack([t_s, q]).round(6).tolist())

    with (folder / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t_s", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"])
        for t, T_base_body in zip(t_s[::2], true.forward(q[::2]), strict=True):
            noise = Rotation.from_rotvec(rng.normal(0, NOISE_DEG, 3), degrees=True)
            T_rig_body = T_rig_base * RigidTransform.from_matrix(T_base_body) * RigidTransform.from_rotation(noise)
            p_mm = 1e3 * T_rig_body.translation + rng.normal(0, NOISE_MM, 3)
            rows.writerow([t.round(6), *p_mm.round(4), *T_rig_body.rotation.as_quat(scalar_first=True).round(8)])

    print(f"{POSES} poses of a simulated {arm.name}: joints.csv, poses.csv")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "franka", Path())
