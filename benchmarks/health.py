"""Faults of cameras, body, mounting, joints and clocks: how soon they are named, as what, how well sized, and what is given
out afterwards.

python health.py                         light simulation (projected points, an arm with errors), 20 seeds a case
python health.py --seeds 2100:2105       of these seeds alone
python health.py bump slip               of the cases alone whose names contain one of these words
python health.py --results rows.jsonl    each run is a line there; those that stand in it are not made again
python health.py rendered knock          one rendered run of a fault in the workcell (worn arm), about two minutes; with
                                         "fixed" two fixed bodies are in view (run --fixed) while the rig is bumped by 2 mm;
                                         with "rotation" the right camera rotates by 0.02 deg

python health.py follow                  a rig that is followed (run --follow-rig): when it is put right, what that leaves
python health.py cost                    computing time of the tests a shot, at 60 Hz, and of falling back, a command (set
                                         OPENBLAS_NUM_THREADS=1, as armsight does)

A run of a camera or a body takes about 1 s of computing, one of an arm 5 s. Delays count from when the fault displaces the
measured pose (of a joint: the pose that the potentiometers give) by twice the claimed sigma; "matters" counts the runs in
which it does. Delays below zero are of faults that were named before. NEES is that of what is given out: of cameras
and bodies from 2 s after the fault matters (or began, where it never does), named or not; of an arm once it was named.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from sys import path

import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"
path[:0] = [str(TESTS), str(TESTS / "loop"), str(TESTS / "loop" / "health")]

import faults  # noqa: E402

import armsight.app.demo.demo as demo  # noqa: E402
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose  # noqa: E402
from armsight.geometry.rotation import exp_so3  # noqa: E402
from armsight.loop.estimators import Mounting  # noqa: E402
from armsight.loop.health import HealthMonitor, Trust  # noqa: E402
from armsight.loop.health.follow import RigFollower  # noqa: E402
from armsight.sim.example_rig import PLATE_M, TAG_FAMILY, TAG_M, TAG_MIDDLES_M  # noqa: E402
from armsight.sim.render.scene import PosedBody, marker_bits, plate, tag  # noqa: E402
from armsight.sim.workcell.cameras import WorkcellSource, _OneCamera  # noqa: E402
from armsight.vision.markers.marker import Target  # noqa: E402
from armsight.vision.markers.targets import open_target  # noqa: E402

DEG = float(np.radians(1.0))
#: When the rig is knocked in a rendered run, s: in the motions with potentiometers alone.
KNOCK_S, BUMP = 26.0, np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
#: Duration of a light simulation of cameras and of an arm, s; when an arm is known and when its fault begins, s.
BODY_S, ARM_S = 20.0, 50.0
faults.LEARNED_S, faults.AT_S = 10.0, 20.0
#: After a fault was named (arm), or matters (cameras and body), s: the covariance is tested from then on.
SETTLED_S, SOON_S = 1.0, 2.0
#: The error of measured poses is averaged over so many shots, for when a fault of cameras or body matters.
AVERAGED = 15


@dataclass(frozen=True)
class Case:
    """A fault: options of the simulation, the cause that is to be named, its size in the unit of the finding."""

    name: str
    options: dict = field(default_factory=dict)
    cause: str = ""
    size: float = 0.0


def body_cases() -> Iterator[Case]:
    """Cases of cameras and body: as in the table, half and twice."""
    yield Case("nothing wrong (cameras)")
    for share in (0.5, 1.0, 2.0):
        for k, axis in enumerate("xyz"):
            rotated = {"rotated": share * 0.05 * DEG * np.eye(3)[k]}
            yield Case(f"right camera rotated by {0.05 * share:g} deg ({axis})", rotated, "rig", 0.05 * share)
        late = {"rotated": share * 0.05 * DEG * np.eye(3)[1], "at_s": 5.0}
        yield Case(f"right camera rotated by {0.05 * share:g} deg (y) after 5 s", late, "rig", 0.05 * share)
        scale = 1.0 + 0.01 * share
        yield Case(f"body file {share:g} % too large", {"scale": scale}, "body", 100 * (1 / scale - 1))
        yield Case(f"right camera {share:g} ms late", {"skew_s": 1e-3 * share}, "time", share)


def shape_cases() -> Iterator[Case]:
    """Discs that moved on the body, in other directions each, and a bent body; all of its discs are used for its poses."""
    count = len(faults.BODY.points)
    for mm in (0.3, 0.5, 1.0, 2.0):
        for disc, along in ((1, (1.0, 0.0, 0.0)), (4, (0.0, 0.6, 0.8))):
            shift = 1e-3 * mm * np.outer(np.arange(count) == disc, along)
            name = f"disc {faults.BODY.point_names[disc]} moved by {mm:g} mm after 5 s"
            yield Case(name, {"shift": shift, "at_s": 5.0}, "body", mm)
    bent = 5e-4 * np.outer(np.arange(count) % 2, [0.0, 0.0, 1.0])
    yield Case("body bent: each second disc by 0.5 mm after 5 s", {"shift": bent, "at_s": 5.0}, "body")


def print_cases() -> Iterator[Case]:
    """Bodies that are elongated, sheared or bent as prints are, and cameras that nod."""
    x, y = np.eye(3)[:2]
    for share in (0.2, 0.3, 0.5):
        for name, along, by in (
            ("elongated along x", x, x), ("elongated along y", y, y), ("sheared in x y", x, y),
            ("elongated along a diagonal", (x + y) / np.sqrt(2), (x + y) / np.sqrt(2)),
        ):  # fmt: skip
            shift = faults.strained(1e-2 * share * np.outer(along, by))
            yield Case(f"body {name} by {share:g} %", {"shift": shift}, "body")
    for radius_m in (5.0, 10.0):
        shift = faults.strained(np.zeros((3, 3)), 1.0 / radius_m)
        yield Case(f"body bent to a cylinder of {radius_m:g} m", {"shift": shift}, "body")
    for hz in (0.1, 0.3, 0.7, 1.5, 3.0, 7.0):
        for side, word in enumerate(("left", "right")):
            for axis, name in zip((x, y), "xy", strict=True):
                nod = {"nod": (side, 0.03 * DEG * axis, hz)}
                yield Case(f"{word} camera nods by 0.03 deg at {hz:g} Hz ({name})", nod, "rig")


def drift_cases() -> Iterator[Case]:
    """Cameras that go on changing, as those that warm up do: a focal length, a rotation."""
    for share in (5e-4, 1e-3, 2e-3):
        for side, word in enumerate(("left", "right")):
            by = share * np.eye(2)[side]
            drifts = {"focal": lambda t, by=by: by * t / 15.0, "at_s": 5.0}
            yield Case(f"{word} focal length drifts by {100 * share:g} % in 15 s", drifts, "lens")
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        drifts = {"nod": (1, 0.05 * DEG * axis, lambda t: t / 15.0), "at_s": 5.0}
        yield Case(f"right camera drifts by 0.05 deg in 15 s ({name})", drifts, "rig")


def lens_cases() -> Iterator[Case]:
    """Lenses and sensors that the model of the cameras cannot express, on two patches."""
    for px in (0.15, 0.3, 0.6):
        for waves, phase in (((1.2, 0.9), 0.4), ((2.1, -1.3), 2.0)):
            lens = faults.ripple(px, np.array(waves), phase)
            yield Case(f"lens rippled by {px:g} px, {waves[0]:g} waves across", {"lens": lens}, "lens")
    for deg in (2.0, 4.0):
        yield Case(f"sensors tilted by {deg:g} deg", {"lens": faults.tilt(deg)}, "lens")


def passing_cases() -> Iterator[Case]:
    """Exposures that are not when they are said to be, and focal lengths that oscillate."""
    frame_s, jitter = 1.0 / faults.RATE_HZ, np.random.default_rng(0).normal(size=10_000)

    def breathes(t: float) -> float:
        return 1.5e-3 * np.sin(2 * np.pi * t / 6.0)

    for name, skew_s in (
        ("at half rate", lambda k: -frame_s * (k % 2)),
        ("that drops each third image", lambda k: -frame_s * (k % 3 == 0)),
        ("late by a frame", frame_s),
        ("early by a frame", -frame_s),
        ("whose stamps scatter by 4 ms", lambda k: 4e-3 * jitter[k]),
    ):
        yield Case(f"right camera {name} after 5 s", {"skew_s": skew_s, "at_s": 5.0}, "time")
    yield Case("right camera with a rolling shutter after 5 s", {"row_s": 2e-5, "at_s": 5.0}, "time")
    yield Case("right lens breathes after 5 s", {"focal": lambda t: (0.0, breathes(t)), "at_s": 5.0}, "lens")
    yield Case("left lens breathes after 5 s", {"focal": lambda t: (breathes(t), 0.0), "at_s": 5.0}, "lens")


def stamp_cases() -> Iterator[Case]:
    """Clocks of the images that jump, restart and run fast."""
    for name, late in (
        ("back by 1 s", lambda t: -1.0),
        ("ahead by 1 s", lambda t: 1.0),
        ("back by 50 ms", lambda t: -0.05),
        ("to zero", lambda t: -faults.AT_S),
    ):
        yield Case(f"stamps jump {name}", {"late": late}, "time")
    yield Case("stamps run fast by 1 %", {"late": lambda t: 0.01 * t}, "time")


def arm_cases() -> Iterator[Case]:
    """Cases of an arm: as in the table, half and twice."""
    yield Case("nothing wrong (arm)")
    for share in (0.5, 1.0, 2.0):
        at = f", {share:g} x"

        def jump(shift_mm: float, rotation_deg: float, share: float = share) -> dict:
            motion = share * np.array([1e-3 * shift_mm, 0.0, 0.0, 0.0, rotation_deg * DEG, 0.0])
            return {"motion": lambda t: motion}

        def drift(shift_mm: float, rotation_deg: float, share: float = share) -> dict:
            speed = share * np.array([1e-3 * shift_mm, 0.0, 0.0, 0.0, rotation_deg * DEG, 0.0]) / 60.0
            return {"motion": lambda t: speed * t}

        def wanders(t: float, share: float = share) -> float:
            return 5e-3 * share * (1.0 - np.cos(2 * np.pi * t / 30.0))

        def runs(t: float, share: float = share) -> float:
            return 3e-4 * share * t

        slip = {"slip": share * np.array([0.001, 0, 0, 0, 0, 0.3 * DEG])}
        yield Case(f"rig knocked by 10 mm and 0.8 deg{at}", jump(10, 0.8), "fixed", 0.0)
        yield Case(f"rig bumped by 2 mm{at}", jump(2, 0), "fixed", 2.0 * share)
        yield Case(f"rig bumped by 0.5 mm{at}", jump(0.5, 0), "fixed", 0.5 * share)
        yield Case(f"rig drifts by 1 mm, 0.1 deg a minute{at}", drift(1, 0.1), "fixed", 0.0)
        yield Case(f"rig drifts by 10 mm, 1 deg a minute{at}", drift(10, 1), "fixed", 0.0)
        yield Case(f"body slips on the tool by 1 mm{at}", slip, "body", share)
        for joint, size in ((2, 0.5), (4, 1.0)):
            slipped = {"joint": joint, "slip_rad": share * size * DEG}
            yield Case(f"joint {joint + 1} slips by {size} deg{at}", slipped, "joint", share * size)
        wider = {"joint": 1, "more_rad": share * 0.5 * DEG}
        yield Case(f"backlash of joint 2 grows by 0.5 deg{at}", wider, "joint", 0.5 * share)
        yield Case(f"stamps drift by 300 ppm{at}", {"late": runs}, "time", 1e3 * runs(30.0))
        yield Case(f"delay wanders by 10 ms{at}", {"late": wanders}, "time", 0.0)


def shake_cases() -> Iterator[Case]:
    """A rig that shakes, and a bracket of the body that bends under gravity, from the beginning."""
    for hz, along in ((5.0, np.array([0.6, 0.48, 0.64])), (12.0, np.array([1.0, 0.0, 0.0]))):
        shift = 2e-4 * np.append(along, np.zeros(3))
        motion = {"motion": lambda t, shift=shift, hz=hz: shift * np.sin(2 * np.pi * hz * t)}
        yield Case(f"rig shakes by 0.2 mm at {hz:g} Hz", motion, "fixed")
    for deg in (0.05, 0.15):
        yield Case(f"bracket bends by {deg:g} deg under gravity", {"slip": faults.bending(deg * DEG)}, "body")
    for share in (5e-4, 1e-3, 2e-3):
        name = f"both focal lengths longer by {100 * share:g} %, with an arm"
        yield Case(name, {"zoom": lambda t, share=share: share}, "lens", 100 * share)


def bump_cases() -> Iterator[Case]:
    """Bumps of the rig of other sizes and directions, and rotations."""
    for mm in (0.5, 1.0, 2.0, 4.0, 10.0):
        for k, axis in enumerate("xyz"):
            shift = np.append(1e-3 * mm * np.eye(3)[k], np.zeros(3))
            yield Case(f"bump of {mm:g} mm along {axis}", {"motion": lambda t, m=shift: m}, "fixed", mm)
    for deg in (0.1, 0.3, 1.0):
        for k, axis in enumerate("xyz"):
            rotation = np.append(np.zeros(3), deg * DEG * np.eye(3)[k])
            yield Case(
                f"rotation by {deg:g} deg about {axis}",
                {"motion": lambda t, m=rotation: m},
                "fixed",
            )


def body_run(case: Case, seed: int) -> dict:
    """Run a case of cameras and body."""
    named_s, offs, errors = np.nan, [], []
    begin_s = case.options.get("at_s", 0.0)
    for monitor, t_s, T, measured, given in faults.watched_body(seed, seconds=BODY_S, **case.options):
        rig = monitor._rig
        found = rig.alarm or rig.lens is not None or rig._shape.found is not None or rig.passing.now
        found = found or rig._unrest.cov.any()
        if np.isnan(named_s) and found:
            named_s = t_s
        error, sigma = (inverse(T) @ measured.T_left_body)[:3, 3], np.sqrt(np.trace(measured.cov[:3, :3]))
        errors.append(np.append(error, sigma) if t_s >= begin_s else np.zeros(4))
        off = log_se3(inverse(given.T_left_body) @ T)
        offs.append((t_s, off @ np.linalg.solve(given.cov, off), 1e3 * np.linalg.norm(off[:3])))
    shifts = np.apply_along_axis(np.convolve, 0, errors, np.full(AVERAGED, 1.0 / AVERAGED), mode="valid")
    matters = np.flatnonzero(np.linalg.norm(shifts[:, :3], axis=1) > 2.0 * np.maximum(shifts[:, 3], 1e-9))
    matters_s = float(matters[0]) / faults.RATE_HZ if len(matters) else np.nan  # where these shots begin
    from_s = float(np.maximum(begin_s, matters_s))
    later = [each for each in offs if each[0] >= (begin_s if np.isnan(from_s) else from_s) + SOON_S]
    squares, mm = ([each[k] for each in later] for k in (1, 2))
    return row_of(case, seed, monitor.findings(), (named_s, from_s), squares, mm)


def arm_run(case: Case, seed: int) -> dict:
    """Run a case of an arm."""
    moved = faults.watched_arm(seed, seconds=ARM_S, **case.options)
    track, begin_s = moved.tracked, faults.AT_S
    named_s = np.nan if moved.found_s is None else moved.found_s
    sigma = np.sqrt(np.einsum("nii->n", track.covs[:, :3, :3]))
    usual = float(np.median(sigma[(track.t_s > begin_s - 2.0) & (track.t_s < begin_s)]))
    rows = np.flatnonzero(track.t_s > begin_s)[::50]
    matters = rows[shifts_m(case.options, moved, rows) > 2.0 * usual]
    matters_s = float(track.t_s[matters[0]]) if len(matters) else np.nan
    rows = np.arange(len(track))[::50]
    rows = rows[track.t_s[rows] > (begin_s if np.isnan(named_s) else named_s + SETTLED_S)]
    off = log_se3(inverse(track.Ts_base_tool[rows]) @ moved.Ts_true[rows])
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(track.covs[rows], off[..., None])[..., 0])
    mm = 1e3 * np.linalg.norm(off[:, :3], axis=1)
    row = row_of(case, seed, moved.monitor.findings(), (named_s, matters_s), squares, mm)
    row["strongest"] = moved.monitor._closure.strongest
    return row


def shifts_m(options: dict, moved: faults.Moved, rows: np.ndarray) -> np.ndarray:
    """Return (N,) by how much a fault displaces the pose of vision or potentiometers at rows of the track, m."""
    Ts, ages = moved.Ts_true[rows], moved.tracked.t_s[rows] - faults.AT_S
    if "joint" in options:
        beyond = options.get("slip_rad", 0.0) + options.get("more_rad", 0.0) / 2.0
        q = moved.tracked.q[rows]
        there, here = (faults.ARM.forward(each)[:, :3, 3] for each in (q + beyond * np.eye(6)[options["joint"]], q))
        return np.linalg.norm(there - here, axis=1)
    wrong = Ts
    if "motion" in options:
        frame = moved.T_base_rig
        wrong = np.array([frame @ inverse(exp_se3(options["motion"](age))) @ inverse(frame) for age in ages]) @ Ts
    if "late" in options:
        later = np.round([options["late"](age) / 1e-3 for age in ages]).astype(int)
        wrong = moved.Ts_true[np.clip(rows - later, 0, len(moved.Ts_true) - 1)]
    if "slip" in options:
        slip = options["slip"]
        wrong = Ts @ exp_se3(np.array([slip(T[:3, :3]) for T in Ts]) if callable(slip) else slip)
    return np.linalg.norm(wrong[:, :3, 3] - Ts[:, :3, 3], axis=1)


def row_of(case: Case, seed: int, found: tuple, when_s: tuple[float, float], squares: list, mm: list) -> dict:
    """Return the row of a run; ``when_s`` is when the fault was named and when it began to matter, NaN where never."""
    late_s = when_s[0] - when_s[1]
    right = [each for each in found if each.cause == case.cause]
    named = [each for each in found if case.cause in (each.cause, *each.alternatives)]
    sized = right and case.size and right[0].sigma
    return {
        "case": case.name,
        "seed": seed,
        "found": [
            f"{each.cause} {' or '.join(each.alternatives)} {each.size:.3f} +- {each.sigma:.3f} {each.unit}: {each.what}"
            for each in found
        ],
        "named": bool(named) and len(found) == 1 if case.cause else not found,
        "right": bool(right) and len(found) == 1 if case.cause else not found,
        "matters": bool(np.isfinite(when_s[1])),
        "late_s": None if np.isnan(late_s) else late_s,
        "size_sigmas": (abs(right[0].size) - abs(case.size)) / right[0].sigma if sized else None,
        "nees": float(np.mean(squares)) if len(squares) else None,
        "mm": float(np.sqrt(np.mean(np.square(mm)))) if len(mm) else None,
    }


_ROW = "{:48s} {:>7s} {:>7s} {:>7s} {:>7s} {:>9s} {:>8s} {:>7s} {:>7s} {:>7s} {:>7s}"


def main(words: list[str], seeds: range, results: Path | None) -> None:
    """Make the runs that are not in the results yet, and print a line of each case."""
    done = [json.loads(line) for line in results.read_text().splitlines()] if results and results.exists() else []
    print(
        _ROW.format(
            "", "matters", "found", "right", "named", "median, s", "worst, s", "sigmas", "worst", "NEES", "worst"
        )
    )
    for make, cases in (
        (body_run, body_cases()),
        (body_run, shape_cases()),
        (body_run, print_cases()),
        (body_run, drift_cases()),
        (body_run, lens_cases()),
        (body_run, passing_cases()),
        (arm_run, arm_cases()),
        (arm_run, bump_cases()),
        (arm_run, shake_cases()),
        (arm_run, stamp_cases()),
    ):
        for case in cases:
            if words and not any(word in case.name for word in words):
                continue
            for seed in seeds:
                if any(row["case"] == case.name and row["seed"] == seed for row in done):
                    continue
                done.append(make(case, seed))
                if results:
                    with results.open("a") as file:
                        file.write(json.dumps(done[-1]) + "\n")
            show(case, [row for row in done if row["case"] == case.name and row["seed"] in seeds])


def show(case: Case, rows: list[dict]) -> None:
    """Print a line of a case, and what was found in the runs in which it is wrong."""

    def both(key: str, mean: Callable) -> tuple[str, str]:
        values = [row[key] for row in rows if row[key] is not None]
        return (f"{mean(values):.1f}", f"{max(values, key=abs):.1f}") if values else ("-", "-")

    matters, found, right, named = (
        sum(bool(row[key]) for row in rows) for key in ("matters", "found", "right", "named")
    )
    sigmas = both("size_sigmas", lambda values: np.sqrt(np.mean(np.square(values))))
    counts = (f"{each}/{len(rows)}" for each in (matters, found, right, named))
    print(_ROW.format(case.name, *counts, *both("late_s", np.median), *sigmas, *both("nees", np.mean)), flush=True)
    for row in rows:
        if not row["right"] and (row["found"] or not case.cause):
            print(f"    seed {row['seed']}: {'; '.join(row['found'])}", flush=True)


def followed(seeds: range) -> None:
    """Print what is left once a rig was put right: cameras that rotate, and a closed loop whose rig moves."""
    print(
        "cameras, rotated after 5 s: seed; put right after, s; rotation left, deg, and sigma; sigma of the body's position"
    )
    print("with it and with the calibration, mm; NEES")
    for deg in (0.025, 0.05, 0.2):
        for k, axis in enumerate("xyz"):
            for seed in seeds:
                print(f"rotated by {deg:g} deg ({axis})", followed_cameras(seed, deg * DEG * np.eye(3)[k]), flush=True)
    print("closed loop: seed; put right after, s; largest distance at rest from 10 s on, mm; in motion; moved by, mm")
    faults.LEARNED_S, faults.AT_S = 5.0, 10.0
    for name, motion in (
        ("nothing wrong", lambda t: np.zeros(6)),
        ("bumped by 0.5 mm", lambda t: 0.25 * BUMP),
        ("bumped by 2 mm", lambda t: BUMP),
        ("knocked by 10 mm, 0.8 deg", lambda t: np.array([0.01, 0.0, 0.0, 0.0, 0.8 * DEG, 0.0])),
        ("drifts by 5 mm, 0.5 deg a minute", lambda t: np.array([0.005, 0.0, 0.0, 0.0, 0.5 * DEG, 0.0]) * t / 60.0),
    ):
        for seed in seeds:
            rows, made = faults.closed_loop(seed, motion, follows=True, seconds=40.0)
            late = [(mm, rests) for t_s, mm, rests, _ in rows if t_s > faults.AT_S + 10.0]
            times = ", ".join(f"{each.at_s - faults.AT_S:.1f}" for each in made) or "-"
            rest, moving = (max((mm for mm, rests in late if rests is kind), default=np.nan) for kind in (True, False))
            sizes = ", ".join(f"{1e3 * each.tool_m[0]:.2f} +- {1e3 * each.tool_m[1]:.2f}" for each in made)
            print(f"{name}: {seed}; {times}; {rest:.2f}; {moving:.2f}; {sizes}", flush=True)


def cost(seed: int) -> None:
    """Print the computing time (the thread's own) of the tests a shot, quiet and after faults."""
    disc = 1e-3 * np.outer(np.arange(len(faults.BODY.points)) == 4, (0.0, 0.6, 0.8))
    faults.RATE_HZ, faults.LEARNED_S, faults.AT_S = 60.0, 5.0, 15.0
    for name, options in (
        ("cameras, nothing wrong", {}),
        ("cameras, right one rotated by 0.05 deg", {"rotated": 0.05 * DEG * np.eye(3)[1], "at_s": 5.0}),
        ("cameras, disc moved by 1 mm", {"shift": disc, "at_s": 5.0}),
    ):
        took = timed(HealthMonitor, "measured", lambda options=options: list(faults.watched_body(seed, **options)))
        print(f"{name:44s} {spread(took)}", flush=True)
    arm = {
        "arm, nothing wrong": {},
        "arm, rig bumped by 2 mm": {"motion": lambda t: BUMP},
        "arm, joint 3 slipped by 0.5 deg": {"joint": 2, "slip_rad": 0.5 * DEG},
    }
    for name, options in arm.items():
        moved: list[faults.Moved] = []
        run = lambda options=options, into=moved: into.append(faults.watched_arm(seed, seconds=45.0, **options))  # noqa: E731
        took = timed(HealthMonitor, "work", run)
        shots = round(faults.RATE_HZ * (45.0 - faults.LEARNED_S))
        print(f"{name:44s} {np.sum(took) / shots:.3f} ms a shot", flush=True)
        if moved[0].monitor.trust is Trust.NONE:
            before = []
            for _ in range(200):
                began = time.thread_time_ns()
                moved[0].monitor.before.estimate()
                before.append(1e-6 * (time.thread_time_ns() - began))
            print(f"{'    the estimator before, a command':44s} {spread(before)}", flush=True)


def timed(thing: type, name: str, run: Callable) -> list[float]:
    """Return the time of each call of a method in a run, ms."""
    took, method = [], getattr(thing, name)

    def measured(*args: object, **options: object) -> object:
        began = time.thread_time_ns()
        found = method(*args, **options)
        took.append(1e-6 * (time.thread_time_ns() - began))
        return found

    setattr(thing, name, measured)
    try:
        run()
    finally:
        setattr(thing, name, method)
    return took


def spread(ms: list[float]) -> str:
    """Return mean and largest time as text."""
    return f"{np.mean(ms):.3f} ms, at most {np.max(ms):.1f} ms"


def followed_cameras(seed: int, rotated: np.ndarray) -> str:
    """Rotate the right camera in mid-run; return what putting it right leaves."""
    poses, follower, rig, squares, at_s = [], None, None, [], np.nan
    for monitor, t_s, T, estimate, _ in faults.watched_body(seed, rotated=rotated, at_s=5.0, seconds=BODY_S):
        given = monitor._rig.rig
        follower = follower or RigFollower(given, faults.BODY)
        poses.append((t_s, estimate))
        if rig is not None:
            uv = estimate.points.seen.uv
            off = log_se3(inverse((again := faults.measured(rig, faults.BODY, T, uv)).T_left_body) @ T)
            squares.append(off @ np.linalg.solve(again.cov, off))
        elif (watch := monitor.cameras_moved()) is not None and round(t_s * faults.RATE_HZ) % 8 == 0:
            since_s = watch.moved_since_s()
            found = None if since_s is None else follower.cameras(since_s, poses, t_s)
            if found is not None:
                rig, at_s = found.update.rig, t_s
                true = faults.TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated))
                left = np.degrees(np.linalg.norm(log_se3(inverse(rig.T_left_right) @ true)[3:]))
                sigma, (now, then) = np.degrees(found.update.sigma_rad), found.update.sigma_m
    if rig is None:
        return f"{seed}; not put right: {follower.rejected}"
    return f"{seed}; {at_s - 5.0:.1f}; {left:.4f} +- {sigma:.4f}; {1e3 * now:.2f}, {1e3 * then:.2f}; {np.mean(squares):.1f}"


def fixed_plate(name: str, first: int, at_m: list[float]) -> tuple[Target, PosedBody]:
    """Return a plate of four tags that does not move: as it is looked for, and as it is seen by the left camera."""
    patterns, tags = [plate(*PLATE_M, value=0.12)], []
    for k, middle in enumerate(TAG_MIDDLES_M):
        T = pose(np.eye(3), np.append(middle, 0.0))
        patterns.append(tag(marker_bits(TAG_FAMILY, first + k), TAG_M).on_body(T))
        tags += [
            f'[[markers]]\nname = "T{k}"\nposition_mm = [{1e3 * middle[0]}, {1e3 * middle[1]}, 0.0]',
            "euler_zyx_deg = [0.0, 0.0, 0.0]",
            f'tag = {{ family = "{TAG_FAMILY}", id = {first + k}, size_mm = {1e3 * TAG_M} }}',
        ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.toml"
        file.write_text("\n".join(["version = 2", f'name = "{name}"', *tags]) + "\n")
        target = open_target(str(file))
    return target, PosedBody(tuple(patterns), pose(exp_so3(np.array([0.0, 0.3, 0.0])), np.array(at_m)))


PLATES = (("post1", 10, [-0.28, -0.26, 0.95]), ("post2", 20, [0.46, -0.26, 0.95]))


def with_plates(case: str) -> tuple[Target, ...]:
    """Put fixed plates before the workcell's cameras, which move where a case says so; return them as targets."""
    plates = [fixed_plate(*each) for each in PLATES]
    image, begun = _OneCamera.__call__, WorkcellSource.__init__

    def seen(camera, exposed):
        if exposed.number >= 0:
            moved = inverse(exp_se3(BUMP)) if exposed.t_s >= KNOCK_S else np.eye(4)
            every = tuple(p.on_body(moved @ each.T_camera_body) for _, each in plates for p in each.patterns)
            exposed = exposed._replace(held=PosedBody(every, np.eye(4)))
        return image(camera, exposed)

    def here(source, *given, processes=False, **options):  # a process of its own would not know the plates
        begun(source, *given, processes=False, **options)

    _OneCamera.__call__, WorkcellSource.__init__ = seen, here
    return tuple(target for target, _ in plates)


def rotated_camera(rotation_deg: float) -> None:
    """Rotate the right camera of the workcell about its y axis in mid-run."""
    image, begun, after = _OneCamera.__call__, WorkcellSource.__init__, {}

    def seen(camera, exposed):
        if camera._side == 1 and exposed.number >= 0 and exposed.t_s >= KNOCK_S and "right" not in after:
            after["right"] = camera._camera = copy(camera._camera)
            xi = np.array([0.0, 0.0, 0.0, 0.0, rotation_deg * DEG, 0.0])
            camera._camera.T_base_camera, camera._camera._seen_room = camera._camera.T_base_camera @ exp_se3(xi), None
            camera._T_this_left = inverse(exp_se3(xi)) @ camera._T_this_left
        return image(camera, exposed)

    def here(source, *given, processes=False, **options):
        begun(source, *given, processes=False, **options)

    _OneCamera.__call__, WorkcellSource.__init__ = seen, here


def rendered(case: str) -> None:
    """Run the quick demo with a fault and print what it says."""
    run, carry = demo.run_in, Mounting.pose_measurement

    def faulty(folder, setup, rig, plan, targets, files, **options):
        if case == "rig":
            rotated = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.05 * DEG, 0.0]))
            rig = replace(rig, T_left_right=rig.T_left_right @ rotated)
        if case == "body":
            target, discs = setup.target, setup.target.discs
            body = replace(discs.body, points=1.01 * discs.body.points)
            setup = replace(setup, target=type(target)(target.name, (), replace(discs, body=body)))
        if case == "fixed":
            setup = replace(setup, fixed=with_plates(case))
        return run(folder, setup, rig, plan, targets, files, **options)

    def moved(mounting, measured, t_s):
        if case in ("knock", "bump", "fixed") and t_s >= KNOCK_S:
            motion = np.array([0.01, 0, 0, 0, 0.8 * DEG, 0]) if case == "knock" else BUMP
            measured = replace(measured, T_left_body=inverse(exp_se3(motion)) @ measured.T_left_body)
        return carry(mounting, measured, t_s)

    if case == "rotation":
        rotated_camera(0.02)
    demo.run_in, Mounting.pose_measurement = faulty, moved
    try:
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            report = demo.run_demo(demo.Demo(Path(folder), quick=True))
    finally:
        demo.run_in, Mounting.pose_measurement = run, carry
    for name, track in ((name, report.json().get(name)) for name in ("vision", "fused")):
        if track is not None:
            rms, claimed = (1e3 * track.get(key, np.nan) for key in ("position_rms_m", "position_sigma_rms_m"))
            print(f"{case:6s} {name:7s} {rms:.2f} mm RMS, claimed {claimed:.2f} mm")
    for note in report.notes:
        print(f"{case:6s} {note.text}")
    print(f"{case:6s} {len(report.json()['health'])} findings; {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--seeds", default="2100:2120")
    parser.add_argument("--results", type=Path)
    given = parser.parse_args()
    if given.words[:1] == ["cost"]:
        cost(range(*map(int, given.seeds.split(":")))[0])
    elif given.words[:1] == ["follow"]:
        followed(range(*map(int, given.seeds.split(":"))))
    elif given.words[:1] == ["rendered"]:
        for each in given.words[1:] or ("none", "rig", "body", "knock", "bump"):
            rendered(each)
    else:
        main(given.words, range(*map(int, given.seeds.split(":"))), given.results)
