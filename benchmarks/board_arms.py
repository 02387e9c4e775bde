"""Arms as they come out of a workshop, on the firmware's core: what must not be taken for a fault, and what must.

    python benchmarks/board_arms.py 200           cases of each class, on seeds that nothing was set by
    python benchmarks/board_arms.py 50 --seed 1   other seeds

Each case draws an arm (:func:`armsight.sim.joints.drawn_model`: gravity and payload up to 60 % of the stall torque,
inertia 0.5 to 6 times, noise of 3 to 20 counts, backlash, coupling, constants off by up to 15 %), a supply of 9.6 to 14 V
and a host that swings it. The firmware is configured by the data sheet; only the inertia is known to 15 %. The core is
called directly (the host library), as the wire takes no part in this.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import os
import sys
from collections import Counter, defaultdict
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "firmware"))

import numpy as np  # noqa: E402
from firmware_arm import declare  # noqa: E402
from firmware_layout import c  # noqa: E402

from armsight import firmware  # noqa: E402
from armsight.robot.boards.codes import BoardState, Fault  # noqa: E402
from armsight.robot.boards.configuration import GAINS, lab_configuration  # noqa: E402
from armsight.robot.boards.frames import OUTPUTS  # noqa: E402
from armsight.robot.boards.tuning import MotorFigures, tuned_gains  # noqa: E402
from armsight.sim.joints import (  # noqa: E402
    CONSTANT_V_S,
    DRY_N_M,
    RESISTANCE_OHM,
    SUPPLY_V,
    VISCOUS_N_M_S,
    JointPlant,
    PotFault,
    drawn_model,
)

STIFFNESS_N_M, PERIOD_TICKS = 50.0, 4
INPUTS = np.dtype(
    [(name, "<u4") for name in ("tick", "overrun", "stop_pressed", "taken_over", "supply_mv")]
    + [("counts", "<u4", 6), ("current_ma", "<i4", 6)]
)
POT_NAMES = {
    PotFault.STUCK: (Fault.POT_FROZEN,),
    PotFault.FROZEN: (Fault.POT_FROZEN,),
    PotFault.INVERTED: (Fault.POT_INVERTED,),
    PotFault.JUMP: (Fault.POT_JUMP,),
    PotFault.SLIP: (Fault.POT_SLIP,),
    PotFault.DRIFT: (Fault.POT_DRIFT,),
    PotFault.SCALED: (Fault.POT_SCALE,),
    PotFault.LAG: (Fault.POT_LAG,),
}


def bandwidth(inertia):
    """As stiff as the converter's noise allows, whatever the joint moves."""
    return float(np.clip(math.sqrt(STIFFNESS_N_M / inertia), 15.0, 60.0))


def arm_configuration(model, rng):
    """The data sheet's configuration; gains by the rule, with an inertia known to 15 %."""
    config = lab_configuration()
    known = model.inertia_kg_m2 * rng.uniform(0.85, 1.15, 6)
    for joint, inertia in zip(config["joint"], known, strict=True):
        motor = MotorFigures(RESISTANCE_OHM, CONSTANT_V_S, float(inertia), VISCOUS_N_M_S, DRY_N_M)
        joint["gains"] = np.array(tuple(tuned_gains(motor, SUPPLY_V, bandwidth(inertia))), GAINS)
    config["joint"]["duty_limit"], config["joint"]["current_limit_ma"] = 1.0, 3000
    config["joint"]["stall_duty"] = 0.9
    config["supply_min_mv"], config["supply_max_mv"] = 9000, 15000
    return config


class Arm:
    """An arm, the core that drives it and a host that swings it."""

    def __init__(self, library, seed, *, load=0.6):
        self.rng = np.random.default_rng([seed, 7])
        self.library = library
        self.model = drawn_model(seed, load=load)
        self.plant = JointPlant(seed=seed + 1, model=self.model)
        supply_v = self.rng.uniform(9.6, 14.0)
        need_v = np.abs(self.model.gravity_n_m) / self.model.constant_v_s * self.model.resistance_ohm
        supply_v = min(max(supply_v, float(need_v.max()) / 0.8), 14.0)  # a supply that can hold the load at all
        self.plant.supply_mv = round(supply_v * 1e3)
        self.config = arm_configuration(self.model, self.rng)
        # What is left of the supply moves the joints: half of it is asked for.
        spare = (supply_v - need_v - self.model.dry_n_m / self.model.constant_v_s * self.model.resistance_ohm) / (
            self.model.constant_v_s
        )
        self.speed_rad_s = np.clip(0.5 * spare, 0.1, 1.5)
        self.hz = self.rng.uniform(0.3, 0.5)
        self.phase = self.rng.uniform(0, 2 * math.pi, 6)
        self.core, self.inputs, self.outputs = c.core_state(), c.core_inputs(), c.core_outputs()
        raw = (ctypes.c_char * self.config.nbytes).from_buffer_copy(self.config.tobytes())
        library.core_init(ctypes.byref(self.core), raw, 0, 0)
        self._in = np.frombuffer(self.inputs, INPUTS, 1)[0:1]
        self.out = np.frombuffer(self.outputs, OUTPUTS)[0:1]
        self._args = tuple(map(ctypes.byref, (self.core, self.inputs, self.outputs)))
        self.sequence, self.ticks, self.t_s = 0, 0, 0.0
        self.gravity = np.zeros(6)
        self.fastest = 0.0  # of the limit, while no fault stands
        self.apart = 0.0  # of the references, likewise

    def tick(self, ticks=1):
        out, plant = self.out, self.plant
        for _ in range(ticks):
            sensed = plant.sense()
            self.ticks += 1
            self._in["tick"], self._in["supply_mv"] = self.ticks, sensed.supply_mv
            self._in["counts"], self._in["current_ma"] = sensed.counts, sensed.current_ma
            self.library.core_tick(*self._args)
            self.inputs.command.kind = 0
            o = out[0]
            plant.step(o["duty"], bool(o["drives_on"] or o["windings_shorted"]), not o["brakes_open"])
            if o["state"] == BoardState.ENABLED:
                self.fastest = max(self.fastest, float(np.abs(plant.qd).max()) / 2.0)
                self.apart = max(self.apart, float(np.abs(plant.link - o["reference_rad"]).max()))
        return out[0]

    def command(self, kind):
        self.sequence += 1
        self.inputs.command.kind, self.inputs.command.sequence = kind, self.sequence
        return self.tick()

    def move(self, position_rad, speed_rad_s, ticks):
        move = self.inputs.command.move
        move.position_rad[:], move.speed_rad_s[:] = list(position_rad), list(speed_rad_s)
        move.gravity_duty[:] = list(self.gravity)
        move.duration_ticks = ticks
        return self.command(c.COMMAND_MOVE)

    def enable(self):
        """Enable while something holds the arm, which lets it go within 0.3 s."""
        self.plant.blocked[:] = True
        self.tick(20)
        self.command(c.COMMAND_ENABLE)
        self.start = np.array(self.out[0]["reference_rad"], dtype=float)
        self.t_s = 0.0
        self.plant.blocked[:] = False
        held = self.model.gravity_n_m * np.cos(self.plant.link)
        for k in range(75):
            self.plant.hand_n_m[:] = held * (1 - k / 75)
            self.rest(PERIOD_TICKS)
        self.plant.hand_n_m[:] = 0

    def target(self, t_s):
        """A swing that begins smoothly from where the arm was enabled."""
        w = 2 * math.pi * self.hz
        grow = 1.0 if t_s > 1.0 else t_s * t_s * (3 - 2 * t_s)
        return self.start + grow * self.speed_rad_s / w * (np.sin(w * t_s + self.phase) - np.sin(self.phase))

    def swing(self, ticks, *, stop_at_fault=True):
        """Swing; returns the ticks that passed until a fault, or None."""
        for k in range(0, ticks, PERIOD_TICKS):
            self.t_s += PERIOD_TICKS * 1e-3
            here, later = self.target(self.t_s), self.target(self.t_s + 1e-3)
            self.move(here, (later - here) * 1e3, PERIOD_TICKS)
            for i in range(PERIOD_TICKS):
                if stop_at_fault and self.out[0]["faults"]:
                    return k + i
                if i + 1 < PERIOD_TICKS:
                    self.tick()
        return None

    def rest(self, ticks):
        """Stay; returns likewise."""
        here = np.array(self.out[0]["reference_rad"], dtype=float)
        for k in range(0, ticks, PERIOD_TICKS):
            self.move(here, np.zeros(6), PERIOD_TICKS)
            self.tick(PERIOD_TICKS - 1)
            if self.out[0]["faults"]:
                return k
        return None

    @property
    def first(self):
        o = self.out[0]
        joint = int(o["first_joint"])
        return (Fault(int(o["first_fault"])) if o["first_fault"] else None), (None if joint == 255 else joint)


def opened():
    return declare(ctypes.CDLL(str(firmware.host_library())))


class Table:
    """What came of the cases of each class."""

    def __init__(self):
        self.cases, self.false, self.missed = Counter(), Counter(), Counter()
        self.codes = defaultdict(Counter)
        self.off = defaultdict(list)
        self.late_ms, self.fast, self.apart = defaultdict(list), defaultdict(float), defaultdict(float)

    def add(self, kind, arm, expected, joint=None, late_ms=None):
        self.cases[kind] += 1
        fault = arm.first[0]
        self.codes[kind][fault.name if fault else "-"] += 1
        if not expected:
            self.false[kind] += fault is not None
        elif fault is None:
            self.missed[kind] += 1
        if joint is not None and fault is not None:
            self.off[kind].append(abs(arm.plant.link[joint] - float(arm.out[0]["angle_rad"][joint])))
        if late_ms is not None:
            self.late_ms[kind].append(late_ms)
        self.fast[kind] = max(self.fast[kind], arm.fastest)
        self.apart[kind] = max(self.apart[kind], arm.apart)

    def show(self):
        heads = ("cases", "false", "missed", "ms med", "95 %", "max", "off", "speed", "apart")
        print(f"{'class':20}" + "".join(f"{head:>7}" for head in heads) + "  codes")
        for kind, cases in self.cases.items():
            late = self.late_ms[kind] or [float("nan")]
            times = (float(np.median(late)), float(np.percentile(late, 95)), float(max(late)))
            off = max(self.off[kind], default=0.0)
            print(
                f"{kind:20}{cases:7}{self.false[kind]:7}{self.missed[kind]:7}"
                + "".join(f"{each:7.0f}" for each in times)
                + f"{off:7.3f}{self.fast[kind]:7.2f}{self.apart[kind]:7.3f}  "
                + ", ".join(f"{name} {n}" for name, n in self.codes[kind].most_common())
            )
        print("ms: from the fault to its code; off: true angle less reading then, rad, at most")
        print(
            "speed: fastest joint while no fault stood, of its limit; apart: farthest from its reference, rad, likewise"
        )


def healthy(library, seed, table):
    arm = Arm(library, seed)
    arm.enable()
    arm.rest(200)
    arm.swing(4000)
    table.add("swing", arm, ())


def pushed(library, seed, table):
    arm = Arm(library, seed)
    arm.enable()
    arm.rest(600)
    arm.swing(1000)
    arm.plant.hand_n_m[int(arm.rng.integers(6))] = arm.rng.choice([-2.0, 2.0])
    arm.swing(100)
    arm.plant.hand_n_m[:] = 0
    arm.swing(1000)
    table.add("push 2 N m 0.1 s", arm, ())


def soft_limit(library, seed, table):
    arm = Arm(library, seed, load=0.4)
    start = arm.rng.uniform(1.6, 2.2)
    arm.plant.q[:], arm.plant.link[:] = start, start
    arm.enable()
    arm.rest(600)
    for _ in range(150):
        arm.move(np.full(6, 3.0), np.zeros(6), 8)
        arm.tick(7)
    table.add("into a soft limit", arm, ())


def jumping_host(library, seed, table):
    arm = Arm(library, seed, load=0.3)
    arm.enable()
    arm.rest(600)
    for _ in range(60):
        arm.move(arm.rng.uniform(-1.5, 1.5, 6), arm.rng.uniform(-3, 3, 6), int(arm.rng.integers(1, 50)))
        arm.tick(int(arm.rng.integers(3, 60)))
    table.add("set points anywhere", arm, ())


def broken(library, seed, table, kind, size, *, moving=True):
    arm = Arm(library, seed)
    arm.enable()
    joint = int(arm.rng.integers(6))
    label = kind.name.lower() + ("" if moving else " at rest")
    if kind in (PotFault.SCALED, PotFault.INVERTED, PotFault.LAG):  # so from the beginning
        arm.command(c.COMMAND_DISABLE)
        arm.plant.break_pot(joint, kind, size)
        arm.plant.q[:], arm.plant.qd[:] = arm.plant.link, 0
        arm.enable()
        arm.rest(40)
        if arm.first[0] is None:
            arm.swing(3000)
        table.add(label, arm, True)
        return
    early = arm.rest(400 if moving else 1200)
    if moving and early is None:
        arm.swing(int(arm.rng.integers(1000, 2000)))
        for _ in range(500):  # a joint in motion
            if abs(arm.plant.qd[joint]) > 0.4 * arm.speed_rad_s[joint] and abs(arm.plant.qd[joint]) > 0.2:
                break
            arm.swing(4)
    if arm.first[0] is not None:  # a false alarm, before anything was broken
        table.add("before the fault", arm, ())
        return
    arm.plant.break_pot(joint, kind, size)
    begun = arm.ticks
    arm.swing(2000) if moving else arm.rest(3000)
    table.add(label, arm, True, joint, arm.ticks - begun if arm.first[0] else None)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", type=int, nargs="?", default=100)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    library, table = opened(), Table()
    classes = {
        "healthy": healthy,
        "pushed": pushed,
        "soft": soft_limit,
        "jumping": jumping_host,
    }
    sizes = {
        PotFault.STUCK: lambda r: 0.0,
        PotFault.FROZEN: lambda r: 0.0,
        PotFault.JUMP: lambda r: r.choice([-1, 1]) * r.uniform(0.08, 0.5),
        PotFault.SLIP: lambda r: r.uniform(0.1, 0.4),
        PotFault.DRIFT: lambda r: r.choice([-1, 1]) * r.uniform(0.3, 0.8),
        PotFault.SCALED: lambda r: r.choice([r.uniform(0.3, 0.6), r.uniform(1.6, 2.5)]),
        PotFault.LAG: lambda r: r.uniform(0.1, 0.3),
        PotFault.INVERTED: lambda r: 0.0,
    }
    for index in range(given.cases):
        for number, (name, run) in enumerate(classes.items()):
            if given.only in name:
                run(library, given.seed * 1000003 + 97 * index + number, table)
        for number, (kind, size) in enumerate(sizes.items()):
            if given.only in kind.name.lower():
                rng = np.random.default_rng([given.seed, index, number])
                seed = given.seed * 1000003 + 97 * index + 20 + number
                broken(library, seed, table, kind, float(size(rng)))
                if kind in (PotFault.STUCK, PotFault.DRIFT):
                    broken(library, seed + 40, table, kind, float(size(rng)), moving=False)
    table.show()


if __name__ == "__main__":
    main()
