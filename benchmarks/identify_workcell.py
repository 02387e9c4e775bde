"""The workcell's worn arm, moved by its firmware, looked at where it rests: what identification finds, and what limits it.

    python benchmarks/identify_workcell.py [seeds]

Each pose is come to over its last 0.6 degrees in 1.5 s, from a random side for each joint, so that friction decides where a
joint that gravity does not load lies in its backlash. What is seen is the true pose with the noise that the workcell's
cameras have (0.03 mm, 0.004 degrees); the images themselves are not rendered here. Random poses are sampled uniformly
over a box about home; planned ones are from the same box, nothing being known but the nominal arm, and evaluated at the
same unseen poses.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from armsight.data import JointCommand
from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.identify.backlash import joint_backlashes
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.plan import plan_joints
from armsight.robot.arm_file import open_arm
from armsight.robot.board_registry import configured
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import open_emulator
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import point_to_point
from armsight.sim.workcell.arm import imperfections, sample_arm
from armsight.sim.workcell.motors import chosen, solids
from armsight.sim.workcell.plant import ArmPlant
from armsight.sim.workcell.workcell import configuration, gravity_duty

POSES, PLANNED, UNSEEN, REACH_RAD, HIGH_M = 60, 30, 200, 0.9, 0.1
BACK_RAD, CREEP_S, SETTLE_S, LOOK_S, PERIOD_S = np.radians(0.6), 1.5, 0.3, 0.1, 0.004
SIGMA = np.repeat([3e-5, 7e-5], 3)


def random_poses(model: Arm, seed: int) -> list:
    """Return goals and sides, evenly over the box where the links stay above the table."""
    rng, found = np.random.default_rng([seed, 5]), []
    while len(found) < POSES + UNSEEN:
        goal = np.clip(model.home + rng.uniform(-REACH_RAD, REACH_RAD, 6), model.q_min, model.q_max)
        if (model.links(goal)[3:, 2, 3] >= HIGH_M).all():
            found.append((goal, rng.choice([-1.0, 1.0], 6)))
    return found


def planned_poses(model: Arm) -> list:
    """Return goals and sides chosen in the same box."""
    low, high = model.home - REACH_RAD, model.home + REACH_RAD
    box = replace(model, q_min=np.maximum(model.q_min, low), q_max=np.minimum(model.q_max, high))
    plan = plan_joints(box, None, None, PLANNED, 0, noise=(SIGMA[0], SIGMA[-1]), floor_m=HIGH_M)
    return list(zip(plan.q, plan.approach, strict=True))


def visited(seed: int, goals: list) -> tuple:
    """Drive the arm to every pose; returns the truth, and joints as read, of the shafts, of the links, and sides."""
    model = open_arm("six_r")
    parts = solids(model)
    motors, true = chosen(model, parts), sample_arm(model, imperfections("worn"), seed)
    plant = ArmPlant(model, true, seed)
    board = configured(EmulatedLink(open_emulator("host"), plant), configuration(model, parts, motors))
    board.enable()
    rows, q = [], model.home

    def run(way, more_s: float) -> list:
        heard = []
        for k in range(round((way.duration_s + more_s) / PERIOD_S)):
            at = way.at((k + 1) * PERIOD_S)
            board.send(JointCommand(at.q, at.qd, gravity_duty(model, parts, motors, at.q), PERIOD_S))
            heard.append(board.receive(PERIOD_S).q)
        return heard

    for goal, side in goals:
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


def looked_at(true, q: np.ndarray, link: np.ndarray, side: np.ndarray, seed: int) -> tuple[np.ndarray, Measured]:
    """Return true poses, and what identification is given."""
    T, B = seen(true, link, seed)
    cov = np.tile(np.diag(SIGMA**2), (len(T), 1, 1))
    return T, Measured(q, B[:, None, :3, 3], B[:, :3, :3], cov, side)


def one(seed: int, goals: list, report) -> tuple[float, ...]:
    """Identify one arm, and the same without backlash in joint 1: what that costs is the ablation.

    Returns mean errors, mm: of planned poses, and of as many and of all random ones.
    """
    model, true, q, shaft, link, side = visited(seed, random_poses(open_arm("six_r"), seed))
    reached: list[float] = []
    still = link.copy()
    still[:, 0] = shaft[:, 0]
    for name, at in (("", link), (", joint 1 without backlash", still)):
        T, m = looked_at(true, q, at, side, seed)
        found = identify(model, m.rows(np.arange(POSES)))
        rest = slice(POSES, None)

        def error(found, x, T=T, rest=rest) -> float:
            T_hat = found.model.T_rig_base(x) @ found.model.tool_in_base(x, q[rest], side[rest])
            return float(np.linalg.norm((inverse(T[rest]) @ T_hat)[:, :3, 3], axis=1).mean())

        before, after = error(found, found.nominal), error(found, found.solution.x)
        report(f"workcell {seed}, {POSES} poses: mean on {UNSEEN} unseen{name}", 1e3 * after, 0.25)
        report("  one over the times that it falls", after / before, 1 / 8, "")
        if name:
            continue
        offset = true.arm.offset - true.pot_offset_rad
        off = [
            abs(found.value(f"{key}{i + 1}")[0] - v[i]) / found.value(f"{key}{i + 1}")[1]
            for key, v in (("a", true.arm.a), ("d", true.arm.d), ("alpha", true.arm.alpha), ("offset", offset))
            for i in range(6)
            if found.value(f"{key}{i + 1}")[1] > 0 and f"{key}{i + 1}" not in found.reasons
        ]
        report(f"  furthest of {len(off)} parameters", max(off), 3.0, "sigma")
        for backlash in joint_backlashes(found, m.rows(np.arange(POSES))):
            if np.isfinite(backlash.value_rad):
                wrong = abs(np.degrees(backlash.value_rad - true.backlash_rad[backlash.joint]))
                report(f"  backlash of joint {backlash.joint + 1}", wrong, 0.02, "deg", f" ({backlash.how})")
            else:
                print(f"     backlash of joint {backlash.joint + 1} {backlash.how}", flush=True)
        _, _, q_plan, _, link_plan, side_plan = visited(seed, goals)
        few = [looked_at(true, q_plan, link_plan, side_plan, 1000 + seed)[1], m.rows(np.arange(PLANNED))]
        reached = [1e3 * error(other, other.solution.x) for other in (identify(model, part) for part in few)]
        reached.append(1e3 * after)
    return tuple(reached)


if __name__ == "__main__":
    from identify import report

    chosen_goals = planned_poses(open_arm("six_r"))
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
    planned, as_many, all_random = np.mean([one(seed, chosen_goals, report) for seed in seeds], axis=0)
    report(
        f"{PLANNED} planned poses, error over that of {POSES} random",
        planned / all_random,
        1.0,
        "",
        f": {planned:.3f} and {all_random:.3f} mm, {as_many:.3f} with {PLANNED} random",
    )
