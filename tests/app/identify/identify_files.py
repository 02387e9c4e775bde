"""Files for the command line of identification: what a worn arm's joints and a tracker said."""

import csv
from dataclasses import replace

import numpy as np
from worn_arm import poses

from armsight.robot.arm_file import open_arm

SECOND, THIRD = np.eye(6)[1], np.eye(6)[2]


def arm_toml(path, arm):
    """Write an arm as a data sheet would have it."""
    lines = [f'name = "{arm.name}"', f'convention = "{arm.convention}"']
    for i in range(arm.joints):
        lines += ["[[joint]]", f"a_mm = {float(1e3 * arm.a[i])!r}"]
        lines += [f"d_m = {float(arm.d[i])!r}", f"alpha_deg = {float(np.degrees(arm.alpha[i]))!r}"]
        lines += [f"offset_rad = {float(arm.offset[i])!r}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def poses_csv(path, n=40, seed=0, gaps=()):
    """Joint angles of the six_r arm with a longer link and an offset zero, and where a tracker saw a point."""
    rng = np.random.default_rng(seed)
    nominal = open_arm("six_r")
    true = replace(nominal, a=nominal.a + 2e-3 * SECOND, offset=nominal.offset + 0.01 * THIRD)
    q = nominal.home + rng.uniform(-0.9, 0.9, (n, 6))
    T = true.forward(q)
    p = T @ [0.03, 0.02, 0.05, 1.0]
    p = p[:, :3] + rng.normal(0, 3e-5, (n, 3)) + [1.0, 2.0, 3.0]
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*(f"q{i}_rad" for i in range(1, 7)), *(f"p1_{axis}_mm" for axis in "xyz")])
        for k in range(n):
            row = [*(f"{v:.9f}" for v in q[k]), *(f"{1e3 * v:.5f}" for v in p[k])]
            if k in gaps:
                row[6] = "nan"
            writer.writerow(row)
    return path


def tracked_csv(path, worn, n, rng):
    """Write what a worn arm's joints read at n poses, and where a tracker saw a point of its tool."""
    q, approach = poses(worn.nominal, n, rng)
    p = (worn.T_rig_body(q, approach) @ [0.03, 0.02, 0.05, 1.0])[:, :3] + rng.normal(0, 3e-5, (n, 3))
    names = [*(f"q{i + 1}_rad" for i in range(q.shape[1])), *(f"p1_{axis}_m" for axis in "xyz")]
    np.savetxt(path, np.column_stack([q, p]), "%.9f", ",", header=",".join(names), comments="")
    return path
