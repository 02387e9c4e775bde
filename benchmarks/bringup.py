"""`armsight board bringup` on arms that nobody knows: ten drawn plants, four of them wired wrongly.

    python benchmarks/bringup.py                 seeds 101 to 110
    python benchmarks/bringup.py 3 --seed 201    three other ones

Each arm is drawn (:func:`armsight.sim.boards.workshop.drawn_workshop`: constants off by 15 %, gravity up to 60 % of the
stall torque, inertia 0.5 to 6 times, 3 to 20 counts of noise, backlash, currents read 3 % wrong, potentiometers bent by up
to 100 counts, signs as they come) and brought up by a person who reads a protractor to 0.17 degrees. The second, fourth,
sixth and eighth have swapped motors, a dead motor, an open potentiometer, swapped potentiometers; once named, each
is mended.
Then the arm that was stored follows a sine of 0.5 rad at 0.4 Hz, takes a load step of 1 N m, and creeps at 0.02 rad/s, all
joints at once and without gravity feed-forward. Errors are the loop's: what the table makes of the true, noiseless
position, less the reference of the same millisecond. How far the table itself is off, by the protractor and the bend
between its marks, is shown apart: no loop can mend it. Joints whose limits do not admit the sine (1.26 rad/s, 3.2 rad/s^2,
and 15 % to spare) are counted apart.
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
from armsight.robot.boards.emulators import open_emulator  # noqa: E402
from armsight.robot.boards.frames import ANSWER  # noqa: E402
from armsight.sim.boards.workshop import WorkshopPerson, drawn_workshop, swapped  # noqa: E402
from armsight.sim.joints import COUNTS_PER_RAD, ZERO_COUNTS  # noqa: E402

PERIOD_S, W, SPARE = 0.01, 2 * np.pi * 0.4, 1.15


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


class Watched:
    """A board at a workshop's arm, and the true angles of its joints as its tables have them, each millisecond."""

    def __init__(self, plant, person_seed):
        self.plant, self.person, self.found = plant, WorkshopPerson(plant, seed=person_seed), None
        self.errors = []
        self.link = EmulatedLink(open_emulator("host"), plant, watch=self._tick)
        self.board = Board.connect(self.link)

    def table_angles(self):
        """(6,) angles that the tables give for the true positions, rad."""
        wiring, true = self.plant.wiring, ZERO_COUNTS + COUNTS_PER_RAD * self.plant.plant.link
        counts = self.plant.bent(true)
        counts = np.where(np.array(wiring.potentiometer_signs) > 0, counts, 65535.0 - counts)
        return np.array([each.angles(counts[j : j + 1])[0] for j, each in enumerate(self.found.joints)])

    def _tick(self, reply):
        if self.found is not None:
            reference = np.frombuffer(reply, ANSWER)[0]["outputs"]["reference_rad"]
            self.errors.append(self.table_angles() - reference)

    def follow(self, path, seconds):
        """Command a path of all joints and return the errors (n, 6), rad, one a millisecond; a fault where it ended it."""
        self.errors = []
        for k in range(round(seconds / PERIOD_S)):
            t = (k + 1) * PERIOD_S
            self.board.send(JointCommand(path(t), (path(t + 1e-4) - path(t - 1e-4)) / 2e-4, np.zeros(6), PERIOD_S))
            self.board.receive(PERIOD_S)
            if self.board.status.faults:
                raise ArmsightError(str(self.board.status.faults[0]))
        return np.array(self.errors)


def figures(watched, found):
    """Sine RMS (NaN where limits forbid it) and creep RMS, mrad, and how long a load step takes back, s; (6,) each."""
    board, plant = watched.board, watched.plant
    board.enable(inward=True)
    watched.found = found
    start = board.joints.reference_rad.copy()
    limits = board.configuration()["joint"]
    able = (limits["speed_limit_rad_s"] > SPARE * 0.5 * W) & (limits["acceleration_rad_s2"] > SPARE * 0.5 * W * W)
    swing = np.where(able, 0.5, 0.05)
    grow = lambda t: np.clip(t / 2.5, 0, 1) ** 2 * (3 - 2 * np.clip(t / 2.5, 0, 1))  # noqa: E731
    sine = watched.follow(lambda t: start + swing * grow(t) * np.sin(W * t), 7.5)[2500:]
    watched.follow(lambda t: start, 1.5)
    plant.load_n_m[:] = 1.0
    far = np.abs(watched.follow(lambda t: start, 1.5)) > 0.005
    plant.load_n_m[:] = 0.0
    back = np.array([(np.flatnonzero(col)[-1] + 1) * 1e-3 if col.any() else 0.0 for col in far.T])
    watched.follow(lambda t: start, 1.0)
    creep = watched.follow(lambda t: start + 0.02 * t * np.ones(6), 4.0)[1000:]
    watched.found = None
    return np.where(able, 1e3 * np.sqrt((sine**2).mean(0)), np.nan), 1e3 * np.sqrt((creep**2).mean(0)), back


def table_error(watched, found):
    """(6,) RMS error of the tables over the swing about the middle of the range, mrad."""
    angles = np.linspace(-2.3, 2.3, 200)
    watched.found, plant, kept = found, watched.plant.plant, watched.plant.plant.link.copy()
    off = []
    for angle in angles:
        plant.link[:] = angle
        off.append(watched.table_angles() - angle)
    plant.link[:], watched.found = kept, None
    return 1e3 * np.sqrt((np.array(off) ** 2).mean(0))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arms", type=int, nargs="?", default=10)
    parser.add_argument("--seed", type=int, default=101)
    given = parser.parse_args()
    all_r, all_k, sines, creeps, backs, tables, named, wrong, stopped = [], [], [], [], [], [], 0, 0, 0
    for n in range(given.arms):
        seed, kind = given.seed + n, KINDS.get(n % 10)
        plant, model = drawn_workshop(seed)
        joint, other = np.random.default_rng([seed, 24]).choice(6, 2, replace=False).tolist()
        words = ()
        if kind:
            plant.wiring, words = miswired(kind, plant.wiring, joint, other)
        watched = Watched(plant, seed)
        board, person = watched.board, watched.person
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
        if not found.verified:
            print("    not verified")
            continue
        tables.append(table_error(watched, found))
        try:
            sine, creep, back = figures(watched, found)
        except ArmsightError as error:
            print(f"    control figures: {error}")
            stopped += 1
            continue
        sines.append(sine)
        creeps.append(creep)
        backs.append(back)
        with np.printoptions(precision=2, suppress=True, linewidth=150):
            print(
                f"    sine {sine} mrad RMS, creep {creep} mrad RMS, load step back in {back} s; tables {tables[-1]} mrad"
            )
        sys.stdout.flush()
    print(
        f"problems named as they must, none where there is none: {named} of {given.arms}; ended by an error {wrong},"
        f" stopped in the figures {stopped}"
    )
    for name, values, most in (("R", all_r, 0.05), ("K", all_k, 0.05)):
        flat = np.abs(np.concatenate(values))
        print(
            f"{name}: {100 * np.nanmedian(flat):.1f} % median, {100 * np.nanmax(flat):.1f} % at most;"
            f" within 5 %: {(flat <= most).sum()} of {6 * given.arms} joints"
        )
    for name, values, most in (("sine mrad", sines, 1.6), ("creep mrad", creeps, 0.4), ("load step s", backs, 0.35)):
        flat = np.concatenate(values) if values else np.zeros(0)
        able = flat[~np.isnan(flat)]
        if len(able):
            print(
                f"{name}: {np.median(able):.2f} median, {np.quantile(able, 0.9):.2f} at 90 %, {able.max():.2f} at most;"
                f" within {most}: {(able <= most).sum()} of {len(able)} joints; {len(flat) - len(able)} not admitted"
            )
    print(f"tables: {np.median(tables):.1f} mrad RMS median, {np.max(tables):.1f} at most")


if __name__ == "__main__":
    main()
