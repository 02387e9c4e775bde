"""Figure 1: every class of board_arms.py and board_motors.py, named by the right part or not; one row a class.

    python benchmarks/board_campaign.py 100 --seed 9902      rounds of 62 cases each

``right``: the first code is the broken part's, and its alone; ``both``: it is latched beside another one that cannot be
distinguished from it; ``silent``: no fault. Healthy classes begin with H: there no fault is right.
"""

from __future__ import annotations

import argparse
import functools
from collections import Counter, defaultdict

import numpy as np

import board_arms
import board_motors
from board_arms import NAMED_TICKS, POT_NAMES, SIZES, Fault, PotFault

PARTS = {
    board_motors.offset: Fault.CURRENT_SENSOR,
    board_motors.gain: Fault.CURRENT_SENSOR,
    board_motors.sign: Fault.CURRENT_SENSOR,
    board_motors.weak: Fault.MOTOR,
    board_motors.shorted: Fault.MOTOR,
    board_motors.stuck: Fault.BRIDGE,
}
#: Of a potentiometer as the emergency stop comes: no bridge, for which all drivers would sleep.
STOPPED_POTS = (PotFault.FROZEN, PotFault.INVERTED, PotFault.LAG, PotFault.OPEN)
HEALTHY = (
    "healthy",
    "pushed",
    "loaded_suddenly",
    "soft_limit",
    "jumping_host",
    "slow",
    "elastic",
    "softest",
    "eccentric",
)


class Campaign:
    """Takes what the classes report, as their tables do, and counts by the part expected."""

    def __init__(self):
        self.rows, self.figures = defaultdict(Counter), defaultdict(lambda: defaultdict(list))
        self.ran, self.label, self.part = Counter(), "", None

    def add(self, kind, arm, *expected, **figures):
        """Count a case; board_arms passes what is expected, board_motors figures."""
        if expected and expected[0] and arm.first[0] is not None:
            arm.tick(NAMED_TICKS)
        fault, joint = arm.first
        names = int(arm.out[0]["joint_faults"][joint]) if joint is not None else 0
        if kind == "before the fault":
            result = f"before the fault {fault.name}"
        elif self.part is None:
            result = "right" if fault is None else fault.name
        elif fault == self.part and names.bit_count() == 1:
            result = "right"
        elif names >> self.part % 32 & 1:
            result = "both"
        else:
            result = "silent" if fault is None else fault.name
        self.rows[self.label][result] += 1
        for name in ("asleep", "sank", "way", "fast"):
            if figures.get(name) is not None:
                self.figures[self.label][name].append(float(figures[name]))

    def run(self, label, part, case, *args, **options):
        self.label, self.part = label, part
        case(*args, **options)

    def show(self):
        print(f"{sum(sum(row.values()) for row in self.rows.values())} cases")
        for label, row in sorted(self.rows.items()):
            line = f"{label:36}{sum(row.values()):6}  " + ", ".join(f"{name} {n}" for name, n in row.most_common())
            for name, values in self.figures[label].items():
                line += f"; {name} {np.median(values):.3g} / {np.percentile(values, 95):.3g} / {max(values):.3g}"
            print(line)
        print("ran on, beyond 1.1 of the limit and not asleep within 60 ms:", dict(+self.ran))


def stopped(table, name, part, library, seed, hurt, ms):
    """Count a sensor that fails so many ms before the emergency stop."""
    label = f"{name}, stop after {ms} ms"
    table.run(label, part, board_motors.broken, library, seed, table, label, hurt, moving=True, stop_ms=ms)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("rounds", type=int, nargs="?", default=100)
    parser.add_argument("--seed", type=int, default=3001)
    given = parser.parse_args()
    library, table = board_motors.opened(), Campaign()
    for index in range(given.rounds):
        seeds = iter(range(given.seed * 1000003 + 97 * index, given.seed * 1000003 + 97 * index + 97))
        for hurt, part in PARTS.items():
            for moving in (True, False):
                label = f"{hurt.__name__}{' moving' if moving else ''}"
                case = (library, next(seeds), table, label, hurt)
                table.run(label, part, board_motors.broken, *case, moving=moving)
        for moving in (True, False):
            label = f"stuck{' moving' if moving else ''}, no figures"
            case = (library, next(seeds), table, label, board_motors.stuck)
            table.run(label, Fault.BRIDGE, board_motors.broken, *case, moving=moving, unknown=True)
        for brake in (board_motors.BRAKE_N_M, 0.0):
            for ms in (0, 20):
                label = f"stuck, stop after {ms} ms{', brake' if brake else ''}"
                case = (library, next(seeds), table, label, board_motors.stuck)
                table.run(label, Fault.BRIDGE, board_motors.broken, *case, moving=True, brake=brake, stop_ms=ms)
        for kind, size in SIZES.items():
            drawn = float(size(np.random.default_rng([given.seed, index, int(kind)])))
            part = POT_NAMES[kind][0]
            table.run(f"pot {kind.name.lower()}", part, board_arms.broken, library, next(seeds), table, kind, drawn)
        for name in HEALTHY:
            table.run(f"H {name}", None, getattr(board_arms, name), library, next(seeds), table)
        for seconds in (20, 200)[: 2 if index % 12 == 0 else 1]:
            for share in (1.4, 0.8):
                for moving in (False, True):
                    options = {"seconds": seconds, "share": share, "moving": moving}
                    label = f"H R x{share} in {seconds} s{' moving' if moving else ''}"
                    table.run(label, None, board_motors.warming, library, next(seeds), table, **options)
        for case in (board_motors.enabled_warm, board_motors.offset_from_start):
            table.run(f"H {case.__name__}", None, case, library, next(seeds), table)
        for kind in STOPPED_POTS:
            for ms in (0, 20):
                seed = next(seeds)
                size = float(SIZES.get(kind, lambda rng: 0.0)(np.random.default_rng([seed, 12])))
                hurt = functools.partial(board_motors.break_pot, kind=kind, size=size)
                stopped(table, f"pot {kind.name.lower()}", POT_NAMES[kind][0], library, seed, hurt, ms)
        for hurt in (board_motors.offset, board_motors.gain, board_motors.sign):
            for ms in (0, 20):
                stopped(table, hurt.__name__, Fault.CURRENT_SENSOR, library, next(seeds), hurt, ms)
    table.show()


if __name__ == "__main__":
    main()
