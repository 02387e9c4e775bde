"""The split of an arm's whole error (``armsight arm report``) beside what was injected: light worlds, no images.

    python benchmarks/arm_report.py --seeds 10

Arms are SO-101 and AR4, with errors of base and tool, zeros, lengths and angles, backlash and droop of random size. The
truth of a part is what it alone moves the tool by at the rests, RMS. Printed are the truth, what is found, and the distance
in sigmas; then how many parts are further than three sigmas from the truth.
"""

import argparse
from dataclasses import replace

import numpy as np

from armsight.app.arm.evaluate import RestPoses, _split
from armsight.app.check.run_folder import Noise
from armsight.geometry.pose import exp_se3
from armsight.loop.identify.identify import identify
from armsight.loop.identify.model import gravity_levers
from armsight.robot.models import MODELS

SIGMA = np.repeat([3e-5, 2e-4], 3)  # m, rad; of a rest's mean by vision
DROOP_RAD_PER_M = 0.1


def world(name: str, seed: int, half_rad: float, poses: int = 40) -> tuple[dict[str, float], dict]:
    """Return the truth of each part, mm, and the parts found."""
    rng, arm = np.random.default_rng([seed, 77]), MODELS[name]
    n = arm.joints
    inner = np.array([0.0, *np.ones(n - 2), 0.0])  # the zeros of the first and the last joint are base and tool
    zeros = rng.normal(0, np.radians(0.6), n) * inner
    gap = rng.uniform(0.05, 0.3, n) * inner * np.pi / 180
    lengths = replace(
        arm,
        a=arm.a + rng.normal(0, 5e-4, n) * inner,
        alpha=arm.alpha + rng.normal(0, np.radians(0.15), n) * inner,
    )
    base, tool = (exp_se3(rng.normal(0, 1, 6) * np.repeat([1e-3, 3e-3], 3)) for _ in range(2))
    q_ref = np.repeat(arm.home + rng.uniform(-half_rad, half_rad, (poses, n)), 2, axis=0)
    q_ref = np.clip(q_ref, arm.q_min, arm.q_max)
    side = rng.choice([-1.0, 1.0], (poses, n)).repeat(2, axis=0) * np.tile([1.0, -1.0], poses)[:, None]
    q = q_ref + rng.uniform(0.3, 1.5) * DROOP_RAD_PER_M * gravity_levers(arm, q_ref)

    def tool_at(model, joints, T_base, T_tool):
        return T_base @ model.forward(joints) @ T_tool

    one = np.eye(4)
    T = tool_at(lengths, q + zeros - 0.5 * gap * side, base, tool) @ exp_se3(rng.normal(0, 1, (len(q), 6)) * SIGMA)
    at = tool_at(arm, q, one, one)
    alone = {
        "controller": (at, arm.forward(q_ref)),
        "base and tool": (tool_at(arm, q, base, tool), at),
        "zeros": (tool_at(arm, q + zeros, one, one), at),
        "lengths and angles": (tool_at(lengths, q, one, one), at),
        "backlash": (tool_at(arm, q - 0.5 * gap * side, one, one), at),
    }
    truth = {k: 1e3 * float(np.sqrt(((a - b)[:, :3, 3] ** 2).sum(axis=1).mean())) for k, (a, b) in alone.items()}
    cov = np.tile(np.diag(SIGMA**2), (len(q), 1, 1))
    noise = Noise(np.eye(3) * SIGMA[0] ** 2, np.zeros((3, 3)), np.full(3, SIGMA[0] ** 2))
    rests = RestPoses(np.arange(len(q)) * 3.0, T, arm.forward(q_ref), cov, q, q_ref, side, noise)
    found = identify(arm, rests.measured(), priors={"ripple": 0.0})
    return truth, _split(arm, rests.rows(found.solution.used), found)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--half-deg", type=float, default=46.0, help="how far the joints go from home")
    given = parser.parse_args()
    far = total = shown = 0
    for name in ("so101", "ar4"):
        for seed in range(given.first, given.first + given.seeds):
            truth, parts = world(name, seed, np.radians(given.half_deg))
            for part, size in truth.items():
                p = parts[part]
                off = abs(p.rms_mm - size) / max(p.sigma_mm, 0.01 * size, 1e-9)
                far, total, shown = far + (off > 3), total + 1, shown + p.determined
                print(
                    f"{name} {seed} {part:20s} {size:7.3f} {p.rms_mm:7.3f} +- {p.sigma_mm:6.3f} mm, {off:5.2f} sigma",
                    flush=True,
                )
            print(
                f"{name} {seed} rest {parts['rest'].rms_mm:.3f} mm, shares {sum(p.share for p in parts.values()):.6f}",
                flush=True,
            )
    print(f"{far} of {total} parts further than three sigmas off; {shown} determined")


if __name__ == "__main__":
    main()
