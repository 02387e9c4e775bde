"""Metric 3 of the arm: straight lines of 300 mm in 1 s, and what planning and evaluating motions costs.

    python benchmarks/motions.py

Deviation is measured by forward kinematics at 10 kHz, ten times as dense as the limits are checked when a motion is made.
"""

from __future__ import annotations

import time

import numpy as np

from armsight.geometry.rotation import log_so3
from armsight.robot.kinematics.arm import Arm
from armsight.robot.models import MODELS
from armsight.robot.trajectories import Trajectory, line, point_to_point, resolved_rate
from armsight.robot.trajectories.line import LinePath

#: Joint angles to start from, deg, and the direction of 300 mm that the arm has room for.
LINES = {
    "six_r": ((-26, -68.9, 79.4, -10.5, -64, 90), (0, 1, 0)),
    "puma560": ((0, 60, -150, 20, 60, 10), (0, 0, -1)),
    "ur5": ((0, -90, 90, -80, -90, 20), (0, 1, 0)),
    "ur10": ((0, -90, 90, -80, -90, 20), (-2, 2, 1)),
    "irb120": ((0, 0, 0, 0, 60, 0), (0, 0, -1)),
}
LENGTH_M, RATE_HZ = 0.3, 10_000


def best_of(n: int, work) -> tuple[float, object]:
    times = []
    for _ in range(n):
        began = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - began)
    return min(times), result


def used(arm: Arm, motion: Trajectory) -> tuple[float, float, float, str]:
    """Largest share of the limits of speed, acceleration and jerk at 1 kHz, and whether the joint limits hold."""
    t = np.arange(0, motion.duration_s, 1e-3)
    q, qd, qdd = motion.at(t)
    jerk = np.diff(qdd, axis=0) / 1e-3
    shares = [float((np.abs(a) / b).max()) for a, b in ((qd, arm.qd_max), (qdd, arm.qdd_max), (jerk, arm.qddd_max))]
    return *shares, "inside" if arm.within_limits(q).all() else "OUT"


def deviation(arm: Arm, motion: Trajectory, T: np.ndarray, along: np.ndarray) -> tuple[float, float]:
    """Furthest distance from the line, m, and rotation from its orientation, rad."""
    Ts = arm.forward(motion.at(np.arange(0, motion.duration_s, 1 / RATE_HZ)).q)
    p = Ts[:, :3, 3] - T[:3, 3]
    rotation = np.linalg.norm(log_so3(T[:3, :3].T @ Ts[:, :3, :3]), axis=1)
    return float(np.linalg.norm(p - np.outer(p @ along, along), axis=1).max()), float(rotation.max())


def report(name: str, kind: str, arm: Arm, motion: Trajectory, T: np.ndarray, along: np.ndarray, made_s: float) -> None:
    off_m, off_rad = deviation(arm, motion, T, along)
    speed, acceleration, jerk, inside = used(arm, motion)
    at_s, _ = best_of(200, lambda: motion.at(0.5))
    many = np.linspace(0, motion.duration_s, 1000)
    many_s, _ = best_of(5, lambda: motion.at(many))
    print(
        f"{name:8} {kind:14} {motion.duration_s:6.3f} s  off {1e3 * off_m:8.1e} mm {off_rad:8.1e} rad  "
        f"of the limits: speed {speed:.2f} accel. {acceleration:.2f} jerk {jerk:.2f}, joints {inside}  "
        f"plan {1e3 * made_s:6.1f} ms  at {1e6 * at_s:4.0f} us, of 1000 {1e3 * many_s:5.2f} us each"
    )


def main() -> None:
    print(
        f"lines of {1e3 * LENGTH_M:.0f} mm, orientation kept; required: 1 s, off by at most 0.01 mm, inside all limits"
    )
    for name, (degrees, direction) in LINES.items():
        arm, q = MODELS[name], np.radians(degrees)
        along = np.array(direction) / np.linalg.norm(direction)
        T = arm.forward(q)
        goal = T.copy()
        goal[:3, 3] += LENGTH_M * along
        for kind, make in (
            ("line, 1 s", lambda: line(arm, q, goal, duration_s=1.0)),  # noqa: B023 - used within the round
            ("line, fastest", lambda: line(arm, q, goal)),  # noqa: B023
            ("resolved rate", lambda: resolved_rate(arm, q, LinePath.between(T, goal))),  # noqa: B023
        ):
            made_s, motion = best_of(2, make)
            report(name, kind, arm, motion, T, along, made_s)
    print("point to point, all joints by 0.5 rad:")
    for name, (degrees, _) in LINES.items():
        q = np.radians(degrees)
        made_s, motion = best_of(3, lambda: point_to_point(MODELS[name], q, q + 0.5))  # noqa: B023
        speed, acceleration, jerk, inside = used(MODELS[name], motion)
        at_s, _ = best_of(200, lambda: motion.at(0.1))  # noqa: B023
        print(
            f"{name:8} {motion.duration_s:6.3f} s  of the limits: speed {speed:.2f} accel. {acceleration:.2f} "
            f"jerk {jerk:.2f}, joints {inside}  plan {1e3 * made_s:.1f} ms  at {1e6 * at_s:.0f} us"
        )


if __name__ == "__main__":
    main()
