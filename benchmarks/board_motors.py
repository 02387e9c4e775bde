"""Motors, bridges and current sensors that are not what they were, on the arms of board_arms.py and the firmware's core.

    python benchmarks/board_motors.py 100              cases of each class, on seeds that nothing was set by
    python benchmarks/board_motors.py 50 --seed 1 --only stuck

Healthy: windings that warm or cool (R -20 to +40 % within 20 s or 200 s, loads to 0.6 of stall, swinging, resting, and
enabled again while warm), current sensors that are off by up to 1 A from the start. Broken in motion or at rest, under
load: a bridge that puts out 0.3 to 1 of the supply whatever its duty, with and without an emergency stop; a current's
offset, gain and sign; a weak motor; a shorted winding. ``sank``: how far the joint is from its reference 0.7 s after the
fault was noticed; ``asleep``: ms from the fault until the drives sleep; ``way``: rad from the emergency stop on.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from dataclasses import replace

import numpy as np

from board_arms import NAMED_TICKS, PERIOD_TICKS, SUPPLY_V, Arm, c, drawn_model, opened

BRAKE_N_M = 6.0
SPEED, ASLEEP_MS = 1.1, 60  # what a stuck bridge may do: of the limit, or until the drives sleep


class Table:
    """What came of the cases of each class."""

    def __init__(self):
        self.rows = defaultdict(lambda: defaultdict(list))
        self.codes = defaultdict(Counter)
        self.ran = Counter()  # beyond SPEED, and not asleep after ASLEEP_MS

    def add(self, kind, arm, **figures):
        fault = arm.first[0]
        self.codes[kind][fault.name if fault else "-"] += 1
        for name, value in figures.items():
            if value is not None:
                self.rows[kind][name].append(float(value))
        self.rows[kind]["speed"].append(arm.fastest)

    def show(self):
        names = ("late", "asleep", "fast", "sank", "way", "speed")
        print(f"{'class':34}{'cases':>6}" + "".join(f"{name + ' med 95% max':>24}" for name in names) + "  codes")
        for kind, codes in self.codes.items():
            line = f"{kind:34}{sum(codes.values()):6}"
            for name in names:
                got = self.rows[kind][name]
                line += (
                    f"{'':24}" if not got else "".join(f"{x:8.3g}" for x in (*np.percentile(got, (50, 95)), max(got)))
                )
            print(line + "  " + ", ".join(f"{name} {n}" for name, n in codes.most_common()), end="")
            print(f"; ran on {self.ran[kind]}" if self.ran[kind] else "")


def drawn_arm(library, seed, load=0.6, *, brake=0.0, warm=1.4):
    """An arm of which each joint can hold its load with 0.7 of the supply, at this multiple of its resistance."""
    model = drawn_model(seed, load=load)
    most_n_m = 0.7 * 14.0 * model.constant_v_s / (model.resistance_ohm * warm)
    model = replace(model, gravity_n_m=np.clip(model.gravity_n_m, -most_n_m, most_n_m), brake_n_m=np.full(6, brake))
    need_v = np.abs(model.gravity_n_m) / model.constant_v_s * model.resistance_ohm * warm
    supply_v = max(np.random.default_rng([seed, 11]).uniform(9.6, 14.0), float(need_v.max()) / 0.7)
    arm = Arm(library, seed, model=model, supply_v=supply_v)
    spare_v = supply_v - need_v - warm * model.dry_n_m / model.constant_v_s * model.resistance_ohm
    arm.speed_rad_s = np.clip(0.5 * spare_v / model.constant_v_s, 0.1, 1.5)
    return arm


def warming(library, seed, table, *, seconds, share, moving, load=0.6):
    """R of all joints becomes share of what it was, evenly within so many seconds."""
    arm = drawn_arm(library, seed, load)
    arm.enable()
    arm.rest(400)
    if moving:
        arm.swing(1200)
    cold, steps = arm.plant._model[0].copy(), round(seconds / 0.04)
    for k in range(1, round(1.2 * steps) + 1):
        arm.plant._model[0] = cold * (1 + (share - 1) * min(k / steps, 1))
        (arm.swing if moving else arm.rest)(40)
        if arm.first[0] is not None:
            break
    sank = None
    if arm.first[0] is not None:
        at = arm.plant.link.copy()
        arm.tick(500)
        sank = np.abs(arm.plant.link - at).max()
    table.add(f"R x{share} in {seconds} s{' moving' if moving else ''}", arm, sank=sank)


def enabled_warm(library, seed, table):
    """An arm that became warm, is disabled while something holds it, and enabled again."""
    arm = drawn_arm(library, seed, warm=1.4 * 14.0 / SUPPLY_V)  # of 14 V a board puts out the nominal ones
    share = arm.rng.choice([0.8, 1.4])
    arm.enable()
    arm.rest(400)
    cold = arm.plant._model[0].copy()
    for k in range(1, 501):
        arm.plant._model[0] = cold * (1 + (share - 1) * k / 500)
        arm.rest(40)
    for pause in (200, 5000):
        if arm.first[0] is not None:
            break
        arm.plant.blocked[:] = True
        arm.command(c.COMMAND_DISABLE)
        arm.tick(pause)
        arm.enable()
        arm.swing(1000)
    table.add("enabled again, warm or cold", arm)


def offset_from_start(library, seed, table):
    """A current's sensor that is off by up to 1 A since the board is on."""
    arm = drawn_arm(library, seed)
    arm.plant.offset_a[:] = arm.rng.uniform(-1, 1, 6)
    arm.tick(200)
    arm.enable()
    arm.rest(400)
    arm.swing(3000)
    arm.rest(1000)
    table.add("current off by 1 A from the start", arm)


def until_moving(arm, joint):
    arm.swing(int(arm.rng.integers(1000, 2000)))
    for _ in range(500):
        if abs(arm.plant.qd[joint]) > 0.4 * arm.speed_rad_s[joint] and abs(arm.plant.qd[joint]) > 0.2:
            break
        arm.swing(4)


def forget_motors(arm):
    """Let the board have no figures of the motors, so that the reading alone is left to watch them by."""
    for joint in arm.core.config.joint:
        joint.motor.resistance_ohm = 0.0
    arm.core.crc, arm.core.crc_at, arm.core.crc_known = 0xFFFFFFFF, 0, 0


def broken(library, seed, table, kind, hurt, *, moving, load=0.6, brake=0.0, stop_ms=None, unknown=False):
    """Break a joint's electrics and look at it tick by tick; stop_ms: the emergency stop comes so much later."""
    arm = drawn_arm(library, seed, load, brake=brake)
    if unknown:
        forget_motors(arm)
    arm.enable()
    joint = int(arm.rng.integers(6))
    arm.rest(400)
    until_moving(arm, joint)
    if not moving:
        arm.rest(600)
    options = {" moving": moving, " unloaded": load < 0.1, " brake": brake, " unknown": unknown}
    label = kind + "".join(name for name, holds in options.items() if holds)
    if arm.first[0] is not None:
        table.add("before the fault", arm)
        return
    hurt(arm, joint)
    limit = float(arm.core.config.joint[joint].speed_limit_rad_s)
    begun, late, asleep, fast, stopped_at = arm.ticks, None, None, 0.0, None
    way = None
    look_ms = 1200 if stop_ms is not None else 4000 if moving else 1500  # in motion both ways
    for _ in range(round(look_ms / PERIOD_TICKS)):
        ms = arm.ticks - begun
        if stop_ms is not None and stopped_at is None and ms >= stop_ms:
            arm.inputs.stop_pressed, stopped_at = 1, arm.plant.link[joint]
        arm.swing(PERIOD_TICKS, stop_at_fault=False) if moving else arm.rest_on(PERIOD_TICKS)
        ms, out = arm.ticks - begun, arm.out[0]
        if asleep is None:
            fast = max(fast, abs(arm.plant.qd[joint]) / limit)
            if not out["drives_on"] and not out["windings_shorted"]:
                asleep = ms
        if late is None and arm.first[0] is not None:
            late = ms
        if late is not None and ms > late + 700:
            break
    if stopped_at is not None:
        way = abs(arm.plant.link[joint] - stopped_at)
    sank = None if late is None else abs(arm.plant.link[joint] - float(arm.out[0]["reference_rad"][joint]))
    if stop_ms is None and late is not None:
        arm.tick(NAMED_TICKS)
    ran = hurt is stuck and fast > SPEED and (asleep is None or asleep > ASLEEP_MS)
    table.add(label, arm, late=late, asleep=asleep, fast=fast, sank=sank, way=way)
    table.ran[label] += ran


def stuck(arm, joint):
    arm.plant.stuck[joint] = arm.rng.choice([-1, 1]) * arm.rng.uniform(0.3, 1.0)


def offset(arm, joint):
    arm.plant.offset_a[joint] = arm.rng.choice([-1, 1]) * arm.rng.uniform(0.2, 1.0)


def gain(arm, joint):
    arm.plant._model[10, joint] *= arm.rng.choice([arm.rng.uniform(0.3, 0.6), arm.rng.uniform(1.6, 2.5)])


def sign(arm, joint):
    arm.plant._model[10, joint] *= -1.0


def weak(arm, joint):
    arm.plant._model[1, joint] *= arm.rng.uniform(0.5, 0.75)


def shorted(arm, joint):
    arm.plant._model[0, joint] *= arm.rng.uniform(0.4, 0.7)
    arm.plant._model[1, joint] *= arm.rng.uniform(0.7, 0.95)


def break_pot(arm, joint, *, kind, size):
    arm.plant.break_pot(joint, kind, size)


def sound(arm, joint):
    pass


def classes():
    """Name, function of (library, seed, table)."""
    for seconds in (20, 200):
        for share in (1.4, 0.8):
            for moving in (False, True):
                yield (
                    f"warm {seconds} {share} {moving}",
                    lambda *a, s=seconds, h=share, m=moving: warming(*a, seconds=s, share=h, moving=m),
                )
    yield "enabled", enabled_warm
    yield "start", offset_from_start
    for hurt in (stuck, offset, gain, sign, weak, shorted):
        for moving in (True, False):
            yield f"{hurt.__name__} {moving}", lambda *a, h=hurt, m=moving: broken(*a, h.__name__, h, moving=m)
    for moving in (True, False):
        yield f"unknown {moving}", lambda *a, m=moving: broken(*a, "stuck", stuck, moving=m, unknown=True)
    for ms in (0, 20):
        yield (
            f"unknown stop {ms}",
            lambda *a, t=ms: broken(
                *a, f"stuck stop after {t} ms", stuck, moving=True, brake=BRAKE_N_M, stop_ms=t, unknown=True
            ),
        )
    yield "stuck unloaded", lambda *a: broken(*a, "stuck", stuck, moving=True, load=0.02)
    for hurt in (stuck, sound):
        for brake in (BRAKE_N_M, 0.0):
            for ms in (0, 20):
                yield (
                    f"stop {hurt.__name__} {brake} {ms}",
                    lambda *a, h=hurt, b=brake, t=ms: broken(
                        *a, f"{h.__name__} stop after {t} ms", h, moving=True, brake=b, stop_ms=t
                    ),
                )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", type=int, nargs="?", default=100)
    parser.add_argument("--seed", type=int, default=3001)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    library, table = opened(), Table()
    for number, (name, run) in enumerate(classes()):
        if given.only in name:
            cases = max(given.cases // 10, 1) if name.startswith("warm 200") else given.cases
            for index in range(cases):
                run(library, given.seed * 1000003 + 97 * index + number, table)
    table.show()


if __name__ == "__main__":
    main()
