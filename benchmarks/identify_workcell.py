"""The workcell's worn arm, moved by its firmware, looked at where it rests: what identification finds, and what limits it.

    python benchmarks/identify_workcell.py [seeds]

Each pose is come to over its last 0.6 degrees in 1.5 s, from a side drawn for each joint, so that friction says where a
joint without weight lies in its play. What is seen is the true pose with the noise that the cell's cameras have (0.03 mm,
0.004 degrees); the images themselves are not drawn here.
"""

from __future__ import annotations

import sys

import numpy as np

from armsight.data import JointCommand
from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.play import plays
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.machines import open_machine
from armsight.robot.boards.opening import configured
from armsight.robot.models import open_arm
from armsight.robot.trajectories import point_to_point
from armsight.sim.cell_arm import drawn, imperfections
from armsight.sim.cell_board import configuration, gravity_duty
from armsight.sim.cell_motors import chosen
from armsight.sim.cell_solids import solids
from armsight.sim.plant import ArmPlant

POSES, UNSEEN, REACH_RAD, HIGH_M = 60, 200, 0.9, 0.1
BACK_RAD, CREEP_S, SETTLE_S, LOOK_S, PERIOD_S = np.radians(0.6), 1.5, 0.3, 0.1, 0.004
SIGMA = np.repeat([3e-5, 7e-5], 3)


def visited(seed: int) -> tuple:
    """Drive the arm to every pose; returns the truth, and joints as read, of the shafts, of the links, and sides."""
    model = open_arm("six_r")
    parts = solids(model)
    motors, true = chosen(model, parts), drawn(model, imperfections("worn"), seed)
    plant = ArmPlant(model, true, seed)
    board = configured(EmulatedLink(open_machine("host"), plant), configuration(model, parts, motors))
    board.enable()
    rng, rows, q = np.random.default_rng([seed, 5]), [], model.home

    def run(way, more_s: float) -> list:
        heard = []
        for k in range(round((way.duration_s + more_s) / PERIOD_S)):
            at = way.at((k + 1) * PERIOD_S)
            board.send(JointCommand(at.q, at.qd, gravity_duty(model, parts, motors, at.q), PERIOD_S))
            heard.append(board.receive(PERIOD_S).q)
        return heard

    while len(rows) < POSES + UNSEEN:
        goal = np.clip(model.home + rng.uniform(-REACH_RAD, REACH_RAD, 6), model.q_min, model.q_max)
        if (model.links(goal)[3:, 2, 3] < HIGH_M).any():
            continue
        side = rng.choice([-1.0, 1.0], 6)
        begin = np.clip(goal - side * BACK_RAD, model.q_min, model.q_max)
        run(point_to_point(model, q, begin), 0.0)
        heard = run(point_to_point(model, begin, goal, duration_s=CREEP_S), SETTLE_S + LOOK_S)
        at = plant.path[-round(1e3 * LOOK_S) :].mean(axis=0)
        rows.append((np.concatenate(heard[-round(LOOK_S / PERIOD_S) :]).mean(axis=0), at[:6], at[6:], side))
        q = goal
    return model, true, *(np.array(column) for column in zip(*rows, strict=True))


def seen(true, link: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return true poses in a rig, and what its cameras say of them."""
    T_rig_base, T_flange_body = exp_se3(np.array([0.1, 0.4, 0.9, 0.3, 1.0, -0.5])), exp_se3(np.full(6, 0.05))
    T = T_rig_base @ true.arm.forward(link) @ T_flange_body
    return T, T @ exp_se3(np.random.default_rng(seed).normal(size=(len(T), 6)) * SIGMA)


def one(seed: int, told) -> None:
    """Identify one arm, and the same without play in joint 1: what that costs is the ablation."""
    model, true, q, shaft, link, side = visited(seed)
    still = link.copy()
    still[:, 0] = shaft[:, 0]
    for name, at in (("", link), (", joint 1 without play", still)):
        T, B = seen(true, at, seed)
        cov = np.tile(np.diag(SIGMA**2), (len(T), 1, 1))
        m = Measured(q, B[:, None, :3, 3], B[:, :3, :3], cov, side)
        found = identify(model, m.rows(np.arange(POSES)))
        rest = slice(POSES, None)

        def error(x, found=found, T=T, rest=rest) -> float:
            T_hat = found.model.T_rig_base(x) @ found.model.tool_in_base(x, q[rest], side[rest])
            return float(np.linalg.norm((inverse(T[rest]) @ T_hat)[:, :3, 3], axis=1).mean())

        before, after = error(found.nominal), error(found.solution.x)
        told(f"workcell {seed}, {POSES} poses: mean on {UNSEEN} unseen{name}", 1e3 * after, 0.25)
        told("  one over the times that it falls", after / before, 1 / 8, "")
        if name:
            continue
        offset = true.arm.offset - true.pot_offset_rad
        off = [
            abs(found.value(f"{key}{i + 1}")[0] - v[i]) / found.value(f"{key}{i + 1}")[1]
            for key, v in (("a", true.arm.a), ("d", true.arm.d), ("alpha", true.arm.alpha), ("offset", offset))
            for i in range(6)
            if found.value(f"{key}{i + 1}")[1] > 0 and f"{key}{i + 1}" not in found.reasons
        ]
        told(f"  furthest of {len(off)} parameters", max(off), 3.0, "sigma")
        for play in plays(found, m.rows(np.arange(POSES))):
            if np.isfinite(play.value_rad):
                wrong = abs(np.degrees(play.value_rad - true.backlash_rad[play.joint]))
                told(f"  play of joint {play.joint + 1}", wrong, 0.02, "deg", f" ({play.how})")
            else:
                print(f"     play of joint {play.joint + 1} {play.how}", flush=True)


if __name__ == "__main__":
    from identify import told as tell

    for number in range(int(sys.argv[1]) if len(sys.argv) > 1 else 3):
        one(number, tell)
