"""Faults of rig, body and mounting: how soon they are found, how well sized, and how often nothing is taken for a fault.

python health.py             light simulation (projected points, an arm with errors), 20 seeds a case: about half an hour
python health.py 5           five seeds
python health.py 5 arms      of the arm's cases alone
python health.py rendered    one rendered run of each fault in the workcell (worn arm): about eight minutes
"""

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "loop"), str(TESTS / "loop" / "health")]

import faults  # noqa: E402

import armsight.app.demo.demo as demo  # noqa: E402
from armsight.geometry.pose import exp_se3, inverse  # noqa: E402
from armsight.loop.estimators import Mounting  # noqa: E402

#: Case -> the fault of the cameras or the body; and the size that is to be found.
BODIES = {
    "nothing wrong": ({}, 0.0),
    "right camera rotated by 0.05 deg (x)": ({"rotated": np.radians([0.05, 0.0, 0.0])}, 0.05),
    "right camera rotated by 0.05 deg (y)": ({"rotated": np.radians([0.0, 0.05, 0.0])}, 0.05),
    "right camera rotated by 0.05 deg (z)": ({"rotated": np.radians([0.0, 0.0, 0.05])}, 0.05),
    "the same (y), after 5 s": ({"rotated": np.radians([0.0, 0.05, 0.0]), "at_s": 5.0}, 0.05),
    "body file 1 % too large": ({"scale": 1.01}, 100 * (1 / 1.01 - 1)),
}
DEG = float(np.radians(1.0))
#: When the rig is knocked in a rendered run, s: in the motions with potentiometers alone.
KNOCK_S = 26.0
#: Case -> motion (6,) of the rig, t seconds after its beginning, [m; rad].
MOTIONS = {
    "knocked by 10 mm and 0.8 deg": lambda t: np.array([0.01, 0.0, 0.0, 0.0, 0.8 * DEG, 0.0]),
    "bumped by 2 mm": lambda t: np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "bumped by 0.5 mm": lambda t: np.array([0.0005, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "drifts by 1 mm and 0.1 deg a minute": lambda t: np.array([0.001, 0.0, 0.0, 0.0, 0.1 * DEG, 0.0]) * t / 60,
    "drifts by 10 mm and 1 deg a minute": lambda t: np.array([0.01, 0.0, 0.0, 0.0, 1.0 * DEG, 0.0]) * t / 60,
}
#: Case -> options of the fault, the cause that is to be named and the size that is to be found, mm or deg.
ARMS = {
    "rig stands still": ({}, "", 0.0),
    "rig knocked by 10 mm and 0.8 deg": ({"motion": MOTIONS["knocked by 10 mm and 0.8 deg"]}, "fixed", 0.0),
    "rig bumped by 2 mm": ({"motion": MOTIONS["bumped by 2 mm"]}, "fixed", 2.0),
    "rig bumped by 0.5 mm": ({"motion": MOTIONS["bumped by 0.5 mm"]}, "fixed", 0.5),
    "rig drifts by 1 mm, 0.1 deg a minute": ({"motion": MOTIONS["drifts by 1 mm and 0.1 deg a minute"]}, "fixed", 0.0),
    "rig drifts by 10 mm, 1 deg a minute": ({"motion": MOTIONS["drifts by 10 mm and 1 deg a minute"]}, "fixed", 0.0),
    "body slips on the tool by 1 mm": ({"slip": np.array([0.001, 0, 0, 0, 0, 0.3 * DEG])}, "body", 1.0),
    "joint 3 slips by 0.5 deg": ({"joint": 2, "slip_rad": 0.5 * DEG}, "joint", 0.5),
    "joint 5 slips by 1 deg": ({"joint": 4, "slip_rad": DEG}, "joint", 1.0),
    "backlash of joint 2 grows by 0.5 deg": ({"joint": 1, "more_rad": 0.5 * DEG}, "joint", 0.5),
}
#: Duration of a light simulation of an arm, s.
ARM_S = 50.0
_ROW = "{:38s} {:>7s} {:>7s} {:>10s} {:>8s} {:>17s}"


def main(seeds: int, bodies: bool) -> None:
    """Run the light simulations, those of rig and body too or the arm's alone, and print."""
    print(_ROW.format("", "found", "cause", "median, s", "worst, s", "size, RMS sigmas"))
    for name, (fault, size) in BODIES.items() if bodies else ():
        rows = []
        for seed in range(1000, 1000 + seeds):
            late_s = np.nan
            for monitor, t_s, *_ in faults.watched_body(seed, seconds=20.0, **fault):
                if np.isnan(late_s) and monitor._rig.suspected is not None:
                    late_s = t_s - fault.get("at_s", 0.0)
            found = monitor.findings()
            off = (found[0].size - size) / found[0].sigma if found and size else np.nan
            rows.append((late_s, off, len(found), bool(found)))
        show(name, np.array(rows))
    faults.LEARNED_S, faults.AT_S = 10.0, 20.0
    for name, (fault, cause, size) in ARMS.items():
        rows = []
        for seed in range(2100, 2100 + seeds):
            moved = faults.watched_arm(seed, seconds=ARM_S, **fault)
            found = moved.monitor.findings()
            named = found and found[0].cause == cause
            off = (abs(found[0].size) - size) / found[0].sigma if size and named and found[0].sigma else np.nan
            late_s = np.nan if moved.found_s is None else moved.found_s - faults.AT_S
            rows.append((late_s, off, len(found), bool(named)))
        show(name, np.array(rows))


def show(name: str, rows: np.ndarray) -> None:
    """Print a line of a case: rows (N, 4) of delay, s, size error, sigmas, findings, whether the cause is right."""
    found = rows[:, 2] > 0
    late = rows[found, 0]
    size = rows[found, 1][np.isfinite(rows[found, 1])]
    texts = [f"{np.nanmedian(late):.1f}", f"{np.nanmax(late):.1f}"] if np.isfinite(late).any() else ["-", "-"]
    sigmas = f"{np.sqrt(np.mean(size**2)):.2f}" if len(size) else "-"
    causes = f"{rows[:, 3].sum():.0f}/{len(rows)}" if found.any() else "-"
    print(_ROW.format(name, f"{found.sum()}/{len(rows)}", causes, *texts, sigmas), flush=True)


def rendered(case: str) -> None:
    """Run the quick demo with a fault and print what it says."""
    run, carry = demo.run_experiment, Mounting.pose_measurement

    def faulty(setup, rig, plan, targets, **options):
        if case == "rig":
            rotated = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.05 * DEG, 0.0]))
            rig = replace(rig, T_left_right=rig.T_left_right @ rotated)
        if case == "body":
            target, discs = setup.target, setup.target.discs
            body = replace(discs.body, points=1.01 * discs.body.points)
            setup = replace(setup, target=type(target)(target.name, (), replace(discs, body=body)))
        return run(setup, rig, plan, targets, **options)

    def moved(mounting, pose, t_s):
        if case in ("knock", "bump") and t_s >= KNOCK_S:
            motion = MOTIONS["bumped by 2 mm" if case == "bump" else "knocked by 10 mm and 0.8 deg"](0.0)
            pose = replace(pose, T_left_body=inverse(exp_se3(motion)) @ pose.T_left_body)
        return carry(mounting, pose, t_s)

    demo.run_experiment, Mounting.pose_measurement = faulty, moved
    try:
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            summary = demo.run_demo(demo.Demo(Path(folder), quick=True))
    finally:
        demo.run_experiment, Mounting.pose_measurement = run, carry
    tracks = {name: summary.tracks[name] for name in ("vision", "fused") if name in summary.tracks}
    for name, track in tracks.items():
        claimed = np.nan if track.claimed is None else 1e3 * track.claimed.position_sigma_rms_m
        print(f"{case:6s} {name:7s} {1e3 * track.position_rms_m:.2f} mm RMS, claimed {claimed:.2f} mm")
    for found in summary.health:
        print(f"{case:6s} {found.line()} ({found.size:.3f} ± {found.sigma:.3f} {found.unit})")
    print(f"{case:6s} {len(summary.health)} findings; {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    if "rendered" in sys.argv:
        for each in sys.argv[2:] or ("none", "rig", "body", "knock", "bump"):
            rendered(each)
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 20, "arms" not in sys.argv)
