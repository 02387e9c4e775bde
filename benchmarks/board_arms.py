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
import functools
import math
import os
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"
TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "firmware")]

import numpy as np  # noqa: E402
from firmware_arm import declare  # noqa: E402
from firmware_layout import c  # noqa: E402

from armsight import firmware  # noqa: E402
from armsight.app.board.found import Found, JointFound  # noqa: E402
from armsight.firmware import build  # noqa: E402
from armsight.robot.boards.codes import Fault, Reaction  # noqa: E402
from armsight.robot.boards.configuration import GAINS, lab_configuration  # noqa: E402
from armsight.robot.boards.frames import OUTPUTS  # noqa: E402
from armsight.robot.boards.tuning import MotorFigures, motion_limits, quiet_gains, tuned_gains  # noqa: E402
from armsight.sim.joints import (  # noqa: E402
    CONSTANT_V_S,
    COUNTS_PER_RAD,
    DRY_N_M,
    RESISTANCE_OHM,
    SUPPLY_V,
    VISCOUS_N_M_S,
    JointPlant,
    PotFault,
    drawn_model,
    plain_transmission,
    sprung,
)

STIFFNESS_N_M, PERIOD_TICKS = 32.0, 4
NAMED_TICKS = 200  # from a fault to its final name
#: Arrays of a plant: their names in board_arms.c and here.
PLANT_ARRAYS = {
    "q": "q",
    "qd": "qd",
    "link": "link",
    "linkd": "_linkd",
    "qdd": "_qdd",
    "model": "_model",
    "between": "_between",
    "hand": "hand_n_m",
    "current_a": "_current_a",
    "broken": "_broken",
    "stuck": "stuck",
    "offset_a": "offset_a",
    "fault": "_fault",
    "noise": "_noise",
    "counts": "_counts",
    "current_ma": "_current_ma",
    "blocked": "blocked",
}
POT_NAMES = {
    PotFault.OPEN: (Fault.POT_OPEN,),
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
    return float(np.clip(math.sqrt(STIFFNESS_N_M / inertia), 13.0, 40.0))


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


def brought_up_configuration(model, rng):
    """What a bring-up stores: R to 3 %, K to 1.5 %, backlash to a third, a current's gain with them; the rest by rules."""
    config = arm_configuration(model, rng)
    seen_ohm = model.resistance_ohm / model.current_gain * rng.uniform(0.97, 1.03, 6)
    seen_v_s = model.constant_v_s * rng.uniform(0.985, 1.015, 6)
    seen_rad = model.backlash_rad * rng.uniform(0.67, 1.33, 6)
    for i, joint in enumerate(config["joint"]):
        noise_rad = float(model.noise_counts[i]) / COUNTS_PER_RAD
        motor = MotorFigures(
            float(seen_ohm[i]),
            float(seen_v_s[i]),
            float(model.inertia_kg_m2[i] * model.current_gain[i]),
            float(model.viscous_n_m_s[i]),
            float(model.dry_n_m[i]),
        )
        gravity_n_m = abs(float(model.gravity_n_m[i]))
        joint["gains"] = np.array(tuple(quiet_gains(motor, SUPPLY_V, noise_rad, gravity_n_m)), GAINS)
        backlash_rad = 1.5 * float(seen_rad[i])
        apart_rad = max(0.03, 10 * noise_rad + backlash_rad)
        joint["motor"] = (motor.resistance_ohm, motor.constant_v_s, apart_rad, backlash_rad)
        speed, acceleration = motion_limits(motor, SUPPLY_V, gravity_n_m)
        joint["speed_limit_rad_s"], joint["jerk_rad_s3"] = speed, 100 * acceleration
        joint["acceleration_rad_s2"] = joint["deceleration_rad_s2"] = acceleration
    return config


def found_configuration(model, between, rng):
    """What a bring-up stores of an elastic or uneven arm, by app/board/found.py, from figures as far off as it finds them.

    R is off by up to 7 %, K 5 %, inertia 12 %, stiffness 25 %, the share of the joint's inertia 15 %; unevenness by 20 %.
    """
    ends = [[3277.0, -2.6], [62258.0, 2.6]]

    def off(most):
        return rng.uniform(1 - most, 1 + most, 6)

    rows = {
        "noise_counts": model.noise_counts,
        "resistance_ohm": model.resistance_ohm / model.current_gain * off(0.07),
        "constant_v_s": model.constant_v_s * off(0.05),
        "inertia_kg_m2": model.inertia_kg_m2 * model.current_gain * off(0.12),
        "viscous_n_m_s": model.viscous_n_m_s,
        "dry_n_m": model.dry_n_m,
        "backlash_rad": model.backlash_rad * off(0.33),
        "gravity_n_m": np.abs(model.gravity_n_m),
        "uneven": between.drum_rad * between.drum_per_rev * off(0.2),
        "stiffness_n_m": between.stiffness_n_m * off(0.25),
        "spring_damping_n_m_s": between.damping_n_m_s * off(0.5),
        "link_share": np.clip(between.link_share * off(0.15), 0.05, 0.95),
    }
    spring = ("stiffness_n_m", "spring_damping_n_m_s", "link_share")
    joints = [
        JointFound(
            marks=ends,
            range_counts=[3277.0, 62258.0],
            motor_direction=1,
            **{n: float(v[i]) for n, v in rows.items() if n not in spring or between.stiffness_n_m[i] > 0},
        )
        for i in range(6)
    ]
    return Found("pil", joints).configuration(3.0, Reaction.HOLD, gains=True)


class Loop(ctypes.Structure):
    """``arm_loop`` of board_arms.c."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in (*PLANT_ARRAYS, "core_tick", "core", "inputs", "outputs")),
        ("fastest", ctypes.c_double),
        ("apart_rad", ctypes.c_double),
        *((name, ctypes.c_uint32) for name in ("supply_mv", "ticks", "sequence", "unused")),
        ("way", ctypes.c_double * 48),
    ]


@functools.cache
def compiled():
    """board_arms.c as a library."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "board_arms.so"
        source = str(Path(__file__).with_suffix(".c").resolve())
        build.compile_c(build.open_compiler().host, made, [source], "-O2", "-shared", "-fPIC", "-Icore", "-lm")
        library = ctypes.CDLL(str(made))
    word, pointer = ctypes.c_uint32, ctypes.c_void_p
    library.arm_run.argtypes, library.arm_run.restype = [pointer, word], word
    library.arm_follow.argtypes, library.arm_follow.restype = [pointer, pointer, word, word, word, pointer], word
    return library


class Arm:
    """An arm, the core that drives it and a host that swings it."""

    def __init__(
        self, library, seed, *, load=0.6, model=None, config=None, supply_v=None, start=None, transmission=None
    ):
        self.rng = np.random.default_rng([seed, 7])
        self.library = library
        self.model = drawn_model(seed, load=load) if model is None else model
        self.plant = JointPlant(start, seed=seed + 1, model=self.model, transmission=transmission)
        need_v = np.abs(self.model.gravity_n_m) / self.model.constant_v_s * self.model.resistance_ohm
        if supply_v is None:
            supply_v = self.rng.uniform(9.6, 14.0)
            supply_v = min(max(supply_v, float(need_v.max()) / 0.8), 14.0)  # one that can hold the load at all
        self.plant.supply_mv = round(supply_v * 1e3)
        self.config = arm_configuration(self.model, self.rng) if config is None else config
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
        self.out = np.frombuffer(self.outputs, OUTPUTS)[0:1]
        arrays = (getattr(self.plant, name).ctypes.data for name in PLANT_ARRAYS.values())
        core_tick = ctypes.cast(library.core_tick, ctypes.c_void_p).value
        self.loop = Loop(*arrays, core_tick, *map(ctypes.addressof, (self.core, self.inputs, self.outputs)))
        self.t_s = 0.0
        self.gravity = np.zeros(6)

    @property
    def ticks(self):
        return int(self.loop.ticks)

    @property
    def fastest(self):
        """Of the limit, while it was enabled."""
        return self.loop.fastest

    @property
    def apart(self):
        """From the references, likewise."""
        return self.loop.apart_rad

    def tick(self, ticks=1):
        self.loop.supply_mv = self.plant.supply_mv
        compiled().arm_run(ctypes.byref(self.loop), ticks)
        return self.out[0]

    def command(self, kind):
        self.loop.sequence += 1
        self.inputs.command.kind, self.inputs.command.sequence = kind, self.loop.sequence
        return self.tick()

    def follow(self, positions, speeds, period=PERIOD_TICKS, *, stop_at_fault=True, traced=False):
        """Send points (n, 6), one each period; returns the ticks that passed, and where joints and references were."""
        points = np.zeros((len(positions), 3, 6))
        points[:, 0], points[:, 1], points[:, 2] = positions, speeds, self.gravity
        trace = np.zeros((len(points) * period, 2, 6)) if traced else None
        self.loop.supply_mv = self.plant.supply_mv
        passed = compiled().arm_follow(
            ctypes.byref(self.loop),
            points.ctypes.data,
            len(points),
            period,
            stop_at_fault,
            trace.ctypes.data if traced else None,
        )
        return (passed, trace[:passed]) if traced else passed

    def move(self, position_rad, speed_rad_s, ticks):
        """Send one set point and run the tick that takes it."""
        move = self.inputs.command.move
        move.position_rad[:], move.speed_rad_s[:] = list(position_rad), list(speed_rad_s)
        move.gravity_duty[:], move.duration_ticks = list(self.gravity), ticks
        self.command(c.COMMAND_MOVE)

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
        """A swing that begins smoothly from where the arm was enabled; t_s (n, 1)."""
        w = 2 * math.pi * self.hz
        grow = np.where(t_s > 1.0, 1.0, t_s * t_s * (3 - 2 * t_s))
        return self.start + grow * self.speed_rad_s / w * (np.sin(w * t_s + self.phase) - np.sin(self.phase))

    def swing(self, ticks, *, stop_at_fault=True):
        """Swing; returns the ticks that passed until a fault, or None."""
        if stop_at_fault and self.out[0]["faults"]:
            return 0
        at = self.t_s + 1e-3 * PERIOD_TICKS * np.arange(1, max(ticks // PERIOD_TICKS, 1) + 1)[:, None]
        self.t_s = float(at[-1, 0])
        here = self.target(at)
        passed = self.follow(here, (self.target(at + 1e-3) - here) * 1e3, stop_at_fault=stop_at_fault)
        return passed if self.out[0]["faults"] else None

    def rest(self, ticks):
        """Stay; returns likewise."""
        here = np.tile(np.array(self.out[0]["reference_rad"], dtype=float), (ticks // PERIOD_TICKS, 1))
        passed = self.follow(here, np.zeros_like(here))
        return passed if self.out[0]["faults"] else None

    def rest_on(self, ticks):
        """Stay, whatever fault there is."""
        here = np.tile(np.array(self.out[0]["reference_rad"], dtype=float), (ticks // PERIOD_TICKS, 1))
        self.follow(here, np.zeros_like(here), stop_at_fault=False)

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
        if joint is not None and arm.first[0] is not None:
            self.off[kind].append(abs(arm.plant.link[joint] - float(arm.out[0]["angle_rad"][joint])))
        if expected and arm.first[0] is not None:
            arm.tick(NAMED_TICKS)
        fault = arm.first[0]
        self.codes[kind][fault.name if fault else "-"] += 1
        if not expected:
            self.false[kind] += fault is not None
        elif fault is None:
            self.missed[kind] += 1
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


def slow(library, seed, table):
    """Joints with speed limits of 0.1 to 0.7 rad/s, which swing at 0.8 of them and rest."""
    rng = np.random.default_rng([seed, 10])
    model = drawn_model(seed)
    config = arm_configuration(model, rng)
    limits = config["joint"]["speed_limit_rad_s"] = rng.uniform(0.1, 0.7, 6)
    arm = Arm(library, seed, model=model, config=config)
    arm.speed_rad_s = 0.8 * np.minimum(arm.speed_rad_s, limits)
    arm.enable()
    arm.rest(200)
    arm.swing(4000)
    arm.rest(800)
    table.add("slow swing", arm, ())


def through_transmission(library, seed, table, label, rows):
    """Swings, rests, is relieved of 1 N m and loaded again, as a bring-up leaves an arm with such a transmission."""
    rng = np.random.default_rng([seed, 11])
    model = drawn_model(seed)
    between = plain_transmission(**rows(model, rng))
    config = found_configuration(model, between, rng)
    arm = Arm(library, seed, model=model, config=config, supply_v=SUPPLY_V, transmission=between)
    limits, w = config["joint"], 2 * math.pi * arm.hz
    most = np.minimum(limits["speed_limit_rad_s"] / 1.15, limits["acceleration_rad_s2"] / w / 1.15)
    arm.speed_rad_s = np.minimum(arm.speed_rad_s, most)
    arm.enable()
    arm.rest(200)
    arm.swing(4000)
    fastest = arm.fastest  # what is let go of swings back as fast as its spring has it
    for hand_n_m in (0.0, 1.0, 0.0):
        arm.plant.hand_n_m[:] = hand_n_m * np.sign(model.gravity_n_m)
        arm.rest(600)
    arm.loop.fastest = fastest
    table.add(label, arm, ())


def elastic(library, seed, table):
    """Resonances of 8 to 40 Hz with both masses free, damping 0.02 to 0.2, 25 to 75 % of the inertia behind the spring."""

    def rows(model, rng):
        hz = np.exp(rng.uniform(np.log(8.0), np.log(40.0), 6))
        return sprung(model, hz, rng.uniform(0.02, 0.2, 6), rng.uniform(0.25, 0.75, 6))

    through_transmission(library, seed, table, "elastic 8 to 40 Hz", rows)


def softest(library, seed, table):
    """The same at 8 Hz."""

    def rows(model, rng):
        return sprung(model, np.full(6, 8.0), rng.uniform(0.02, 0.2, 6), rng.uniform(0.25, 0.75, 6))

    through_transmission(library, seed, table, "elastic 8 Hz", rows)


def eccentric(library, seed, table):
    """Drums of 0.02 to 0.06 rad, once to twice a revolution of the joint."""

    def rows(model, rng):
        return {
            "drum_rad": rng.uniform(0.02, 0.06, 6),
            "drum_per_rev": rng.integers(1, 3, 6).astype(float),
            "drum_phase": rng.uniform(0, 1, 6),
        }

    through_transmission(library, seed, table, "eccentric drum", rows)


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


def loaded_suddenly(library, seed, table):
    """As a bring-up leaves an arm: it hangs, swings for five seconds and rests; then 1 N m pulls at every joint."""
    rng = np.random.default_rng([seed, 9])
    model = drawn_model(seed)
    hangs = -np.sign(model.gravity_n_m) * np.pi / 2
    config = brought_up_configuration(model, rng)
    arm = Arm(library, seed, model=model, config=config, supply_v=SUPPLY_V, start=hangs)
    limits = config["joint"]
    arm.hz, arm.phase = 0.4, np.zeros(6)
    w = 2 * math.pi * arm.hz
    arm.speed_rad_s = np.minimum(
        0.5 * w, np.minimum(limits["speed_limit_rad_s"], limits["acceleration_rad_s2"] / w) / 1.15
    )
    arm.enable()
    arm.rest(200)
    arm.swing(7500)
    arm.rest(1500)
    arm.plant.hand_n_m[:] = 1.0
    arm.rest(1500)
    arm.plant.hand_n_m[:] = 0.0
    arm.rest(1000)
    table.add("unloaded, then 1 N m", arm, ())


def soft_limit(library, seed, table):
    start = np.random.default_rng([seed, 8]).uniform(1.6, 2.2)
    arm = Arm(library, seed, load=0.4, start=np.full(6, start))
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


#: Fault of a potentiometer -> how large it is, drawn from a generator.
SIZES = {
    PotFault.STUCK: lambda r: 0.0,
    PotFault.FROZEN: lambda r: 0.0,
    PotFault.JUMP: lambda r: r.choice([-1, 1]) * r.uniform(0.08, 0.5),
    PotFault.SLIP: lambda r: r.uniform(0.1, 0.4),
    PotFault.DRIFT: lambda r: r.choice([-1, 1]) * r.uniform(0.3, 0.8),
    PotFault.SCALED: lambda r: r.choice([r.uniform(0.3, 0.6), r.uniform(1.6, 2.5)]),
    PotFault.LAG: lambda r: r.uniform(0.1, 0.3),
    PotFault.INVERTED: lambda r: 0.0,
}


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
        "loaded": loaded_suddenly,
        "soft": soft_limit,
        "jumping": jumping_host,
        "slow": slow,
        "elastic": elastic,
        "softest": softest,
        "eccentric": eccentric,
    }
    for index in range(given.cases):
        for number, (name, run) in enumerate(classes.items()):
            if given.only in name:
                run(library, given.seed * 1000003 + 97 * index + number, table)
        for number, (kind, size) in enumerate(SIZES.items()):
            if given.only in kind.name.lower():
                rng = np.random.default_rng([given.seed, index, number])
                seed = given.seed * 1000003 + 97 * index + 20 + number
                broken(library, seed, table, kind, float(size(rng)))
                if kind in (PotFault.STUCK, PotFault.DRIFT):
                    broken(library, seed + 40, table, kind, float(size(rng)), moving=False)
    table.show()


if __name__ == "__main__":
    main()
