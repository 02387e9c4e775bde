"""The board's control law on joints that are not as their data sheet says, beside a cascade on the same joints.

    python benchmarks/board_control.py             12 drawn arms a row, of seeds that nothing was set by
    python benchmarks/board_control.py 4 --seed 1  fewer, other seeds

Three metrics of the true angle against the reference, six joints an arm: RMS on a sine of 0.5 rad at 0.4 Hz (target 1.6
mrad); time until a joint is back within 5 mrad for good after 1 N m pulls at it (target 0.35 s); deviation while it creeps
at 0.02 rad/s (target 0.4 mrad), RMS and largest. Shown are the median and the worst joint. Both laws read the same
potentiometers at 1 kHz, follow the same reference, know the same motor, and are tuned by a rule from it to the same
bandwidth. The host sends no gravity duty.
"""

from __future__ import annotations

import argparse
import ctypes
import dataclasses

import numpy as np

from armsight.sim.joints import SUPPLY_V, drawn_model, plain_model
from board_arms import Arm, arm_configuration, compiled, opened

TARGETS = (1.6, 0.35, 0.4)
CASCADE_SHARE = 0.5  # of the bandwidth: the position loop around the speed loop


def models(name, seed):
    """The arm of a row: what differs from the data sheet grows from row to row."""
    plain, drawn = plain_model(), drawn_model(seed, load=0.6, inertia=3.0)
    clean = dataclasses.replace(plain, noise_counts=np.full(6, 4.0))
    loaded = dataclasses.replace(
        clean,
        gravity_n_m=drawn.gravity_n_m,
        inertia_kg_m2=drawn.inertia_kg_m2,
        dry_n_m=drawn.dry_n_m,
        viscous_n_m_s=drawn.viscous_n_m_s,
    )
    noisy = dataclasses.replace(loaded, noise_counts=drawn.noise_counts, current_noise_ma=drawn.current_noise_ma)
    backlash = dataclasses.replace(noisy, backlash_rad=drawn.backlash_rad, coupling=drawn.coupling)
    return {
        "data sheet": clean,
        "gravity, payload": loaded,
        "noise 3 to 20 counts": noisy,
        "backlash, coupling": backlash,
        "constants off 15 %": drawn,
    }[name]


ROWS = ("data sheet", "gravity, payload", "noise 3 to 20 counts", "backlash, coupling", "constants off 15 %")


def configured(model, seed, *, cascade):
    """By the data sheet, the inertia known to 15 %; nothing that stops an arm."""
    config = arm_configuration(model, np.random.default_rng([seed, 7]))
    joint = config["joint"]
    joint["motor"]["resistance_ohm"] = 0.0 if cascade else joint["motor"]["resistance_ohm"]
    return config


def arm_of(library, model, seed, law):
    arm = Arm(library, seed, model=model, config=configured(model, seed, cascade=law == "cascade"), supply_v=SUPPLY_V)
    if law == "cascade":
        compiled().cascade_around.argtypes = [ctypes.c_void_p, ctypes.c_double]
        compiled().cascade_around(ctypes.byref(arm.loop), CASCADE_SHARE)
    arm.enable()
    arm.rest(1000)
    return arm


def sine(arm):
    """RMS, mrad, of each joint over two periods, after one."""
    t = 4e-3 * np.arange(1, 1876)[:, None]
    w = 2 * np.pi * 0.4
    grow = np.where(t > 1.0, 1.0, t * t * (3 - 2 * t))
    ahead = arm.start + grow * 0.5 * np.sin(w * t) * np.ones(6)
    speed = np.gradient(ahead, 4e-3, axis=0)
    passed, trace = arm.follow(ahead, speed, traced=True, stop_at_fault=True)
    off = (trace[:-1, 0] - trace[1:, 1])[2500:]  # a row has where the tick moved the joint to: what the next one reads
    return 1e3 * np.sqrt((off**2).mean(axis=0)) if passed == 7500 else np.full(6, np.inf)


def load_step(arm):
    """Time, s, until each joint stays within 5 mrad of its reference."""
    here = np.tile(np.array(arm.out[0]["reference_rad"], dtype=float), (500, 1))
    arm.plant.hand_n_m[:] = np.where(
        arm.model.gravity_n_m > 0, 1.0, -1.0
    )  # it unloads: the motor's full torque is free
    passed, trace = arm.follow(here, np.zeros_like(here), traced=True)
    arm.plant.hand_n_m[:] = 0
    if passed < 2000:
        return np.full(6, np.inf)
    outside = np.abs(trace[:, 0] - trace[:, 1]) > 5e-3
    return np.where(outside.any(axis=0), 1e-3 * (len(outside) - np.argmax(outside[::-1], axis=0)), 0.0)


def creep(arm):
    """RMS and largest deviation, mrad, of each joint over 2 s, after 1 s."""
    t = 4e-3 * np.arange(1, 751)[:, None]
    here = np.array(arm.out[0]["reference_rad"], dtype=float) + 0.02 * t * np.ones(6)
    passed, trace = arm.follow(here, np.full_like(here, 0.02), traced=True)
    off = 1e3 * (trace[:, 0] - trace[:, 1])[1000:]
    return (np.sqrt((off**2).mean(axis=0)), np.abs(off).max(axis=0)) if passed == 3000 else (np.full(6, np.inf),) * 2


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("arms", type=int, nargs="?", default=12)
    parser.add_argument("--seed", type=int, default=4711)
    given = parser.parse_args()
    library = opened()
    print(f"{'':22}{'law':9}{'sine, mrad':>14}{'step, s':>15}{'creep RMS, mrad':>18}{'largest':>15}{'stopped':>9}")
    for row in ROWS:
        for law in ("board", "cascade"):
            found, stopped = [], 0
            for index in range(1 if row == "data sheet" else given.arms):
                seed = given.seed * 1000 + index
                model = models(row, seed)
                arm = arm_of(library, model, seed, law)
                back = load_step(arm)
                slow, most = creep(arm)
                found.append([sine(arm_of(library, model, seed, law)), back, slow, most])
                stopped += arm.first[0] is not None
            cells = (f"{np.median(values):8.2f}{values.max():7.2f}" for values in np.moveaxis(found, 1, 0))
            print(f"{row:22}{law:9}" + "".join(cells) + f"{stopped:9}")
    print("targets: sine {} mrad, step {} s, creep {} mrad; each pair: the median and the worst joint".format(*TARGETS))


if __name__ == "__main__":
    main()
