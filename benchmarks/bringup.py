"""`armsight board bringup` on arms that nobody knows: ten drawn plants, four of them wired wrongly.

    python benchmarks/bringup.py                 seeds 101 to 110
    python benchmarks/bringup.py 3 --seed 201    three other ones

Each arm is drawn (:func:`armsight.sim.boards.workshop.drawn_workshop`: constants off by 15 %, gravity up to 60 % of the
stall torque, inertia 0.5 to 6 times, 3 to 20 counts of noise, backlash, currents read 3 % wrong, potentiometers bent by up
to 100 counts, signs as they come) and brought up by a person who reads a protractor to 0.17 degrees. The second, fourth,
sixth and eighth have swapped motors, a dead motor, an open potentiometer, swapped potentiometers; once named, each
is mended.
Then the arm that was stored follows a sine of 0.5 rad at 0.4 Hz, takes a load step of 1 N m, and creeps at 0.02 rad/s, all
joints at once and without gravity feed-forward; errors are of the true joint against the command.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np  # noqa: E402

from armsight.app.board.bringup import Bringup  # noqa: E402
from armsight.data import JointCommand  # noqa: E402
from armsight.errors import ArmsightError  # noqa: E402
from armsight.robot.boards.board import Board  # noqa: E402
from armsight.robot.boards.emulated import EmulatedLink  # noqa: E402
from armsight.robot.boards.opening import open_emulator  # noqa: E402
from armsight.sim.boards.workshop import WorkshopPerson, drawn_workshop, swapped  # noqa: E402

PERIOD_S = 0.01


def miswired(kind, wiring, joint, other):
    """A wiring with a mistake, and what must be said of it."""
    a, b = joint + 1, other + 1
    if kind == "swapped motors":
        low = min(a, b)
        return replace(wiring, motors=swapped(joint, other)), (f"joint {low}:", "motors of joints", "are swapped")
    if kind == "dead motor":
        return replace(wiring, dead_motors=frozenset({joint})), (f"joint {a}: its motor is dead",)
    if kind == "open potentiometer":
        return replace(wiring, open_potentiometers=frozenset({joint})), (f"joint {a}: its potentiometer is open",)
    low = min(a, b)
    return replace(wiring, potentiometers=swapped(joint, other)), (
        f"joint {low}:",
        "potentiometers of joints",
        "swapped",
    )


KINDS = {1: "swapped motors", 3: "dead motor", 5: "open potentiometer", 7: "swapped potentiometers"}


def follow(board, plant, path, seconds):
    """Command a path of all joints and return the true errors (n, 6), rad; None where a fault ended it."""
    errors = []
    for k in range(round(seconds / PERIOD_S)):
        t = (k + 1) * PERIOD_S
        q, qd = path(t), (path(t + 1e-4) - path(t - 1e-4)) / 2e-4
        board.send(JointCommand(q, qd, np.zeros(6), PERIOD_S))
        board.receive(PERIOD_S)
        if board.status.faults:
            return None, str(board.status.faults[0])
        errors.append(plant.plant.link - q)
    return np.array(errors), ""


def figures(board, plant):
    """Sine RMS, creep RMS, mrad, and the time a load step takes back to 5 mrad, s; (6,) each."""
    board.enable(inward=True)
    start = board.joints.reference_rad.copy()
    grow = lambda t: np.clip(t / 2.5, 0, 1) ** 2 * (3 - 2 * np.clip(t / 2.5, 0, 1))  # noqa: E731
    sine, why = follow(board, plant, lambda t: start + 0.5 * grow(t) * np.sin(2 * np.pi * 0.4 * t) * np.ones(6), 7.5)
    if sine is None:
        return f"sine: {why}"
    # Angles of the board are those of the protractor: what is constant in the error is its, not the loop's.
    sine = sine[250:] - sine[250:].mean(axis=0)
    still, why = follow(board, plant, lambda t: start, 1.5)
    if still is None:
        return f"rest: {why}"
    zero = still[-50:].mean(axis=0)
    plant.load_n_m[:] = 1.0
    step, why = follow(board, plant, lambda t: start, 1.5)
    plant.load_n_m[:] = 0.0
    if step is None:
        return f"load step: {why}"
    far = np.abs(step - zero) > 0.005
    back = np.array([(np.flatnonzero(col)[-1] + 1) * PERIOD_S if col.any() else 0.0 for col in far.T])
    follow(board, plant, lambda t: start, 1.0)
    creep, why = follow(board, plant, lambda t: start + 0.02 * t * np.ones(6), 4.0)
    if creep is None:
        return f"creep: {why}"
    slow = creep[100:] - creep[100:].mean(axis=0)
    return 1e3 * np.sqrt((sine**2).mean(0)), 1e3 * np.sqrt((slow**2).mean(0)), back


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", type=int, nargs="?", default=10)
    parser.add_argument("--seed", type=int, default=101)
    given = parser.parse_args()
    all_r, all_k, sines, creeps, backs, named, wrong = [], [], [], [], [], 0, 0
    for n in range(given.arms):
        seed, kind = given.seed + n, KINDS.get(n % 10)
        plant, model = drawn_workshop(seed)
        joint, other = np.random.default_rng([seed, 24]).choice(6, 2, replace=False).tolist()
        words = ()
        if kind:
            plant.wiring, words = miswired(kind, plant.wiring, joint, other)
        person = WorkshopPerson(plant, seed=seed)
        board = Board.connect(EmulatedLink(open_emulator("host"), plant))
        with tempfile.TemporaryDirectory() as folder:
            bringup = Bringup(board, person, Path(folder))
            try:
                bringup.run()
            except ArmsightError as error:
                print(f"seed {seed}: {error}")
                wrong += 1
                continue
        found = bringup.found
        right = (
            bool(person.problems) and all(word in person.problems[0] for word in words) if kind else not person.problems
        )
        named += right
        r = np.array([each.resistance_ohm or np.nan for each in found.joints]) / model.resistance_ohm - 1
        k = np.array([each.constant_v_s or np.nan for each in found.joints]) / model.constant_v_s - 1
        signs = [each.motor_direction for each in found.joints]
        expected = [m * p for m, p in zip(plant.wiring.motor_signs, np.ones(6, int), strict=True)]
        all_r.append(r)
        all_k.append(k)
        print(
            f"seed {seed}, {kind or 'wired rightly'}: R {100 * np.abs(r).max():.1f} %, K {100 * np.abs(k).max():.1f} %,"
            f" signs {'right' if signs == expected else f'{signs} for {expected}'}, {found.arm_time_s:.0f} s of arm time,"
            f" drives on {plant.drives_s:.0f} s; {'as it must' if right else 'WRONG'}: {person.problems or 'no problem'}"
        )
        seen = figures(board, plant) if found.verified else "not verified"
        if isinstance(seen, str):
            print(f"    control figures: {seen}")
            continue
        sine, creep, back = seen
        sines.append(sine)
        creeps.append(creep)
        backs.append(back)
        with np.printoptions(precision=2, suppress=True, linewidth=150):
            print(f"    sine {sine} mrad RMS, creep {creep} mrad RMS, load step back in {back} s")
        sys.stdout.flush()
    print(f"problems named as they must, none where there is none: {named} of {given.arms}; ended by an error {wrong}")
    for name, values, most in (("R", all_r, 0.05), ("K", all_k, 0.05)):
        flat = np.abs(np.concatenate(values))
        print(
            f"{name}: {100 * np.nanmedian(flat):.1f} % median, {100 * np.nanmax(flat):.1f} % at most;"
            f" within 5 %: {(flat <= most).sum()} of {6 * given.arms} joints"
        )
    for name, values, most in (("sine mrad", sines, 1.6), ("creep mrad", creeps, 0.4), ("load step s", backs, 0.35)):
        flat = np.concatenate(values) if values else np.zeros(0)
        if len(flat):
            print(
                f"{name}: {np.median(flat):.2f} median, {flat.max():.2f} at most;"
                f" within {most}: {(flat <= most).sum()} of {len(flat)} joints"
            )


if __name__ == "__main__":
    main()
