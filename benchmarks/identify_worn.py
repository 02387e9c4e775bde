"""Worn arms that are made up, seen by a made-up rig: what identification finds of a truth that is known."""

from __future__ import annotations

import numpy as np
from worn_arm import distance_m, poses, truth_of, worn

from armsight.loop.identify.identify import identify
from armsight.loop.identify.model import Model
from armsight.loop.identify.plan import free_of_collision, plan_joints

POSES, UNSEEN, FIRST = 60, 200, 15


def worn_arms(report, seeds: int) -> None:
    """Metric 3, on a stand-in for the workcell."""
    after, fall, off, backlash = [], [], [], []
    for seed in range(seeds):
        rng, w = np.random.default_rng(100 + seed), worn(seed)
        found = identify(w.nominal, w.seen(*poses(w.nominal, POSES, rng), rng))
        q, side = poses(w.nominal, UNSEEN, rng)
        truth = w.T_rig_body(q, side)
        d = [distance_m(found.model, x, truth, q, side).mean() for x in (found.nominal, found.solution.x)]
        after.append(1e3 * d[1])
        fall.append(d[0] / d[1])
        for name, true in truth_of(w).items():
            value, sigma = found.value(name)
            if sigma > 0 and name not in found.reasons:
                off.append(abs(value - true) / sigma)
            if name.startswith("backlash"):
                backlash.append(abs(np.degrees(value - true)))
    report(f"worn arm, {POSES} poses: mean on {UNSEEN} unseen, worst of {seeds}", max(after), 0.25)
    report("  one over the times that it falls, least", 1 / min(fall), 1 / 8, "")
    report(f"  furthest of {len(off)} parameters from the truth", max(off), 3.0, "sigma")
    report(
        f"  share of them over 3 sigma: {sum(o > 3 for o in off)} of {len(off)}", np.mean(np.array(off) > 3), 0.01, ""
    )
    report("  backlash, furthest", max(backlash), 0.02, "deg")
    planned(report, seeds)


def planned(report, seeds: int) -> None:
    """Poses that random choice needs for what planned ones reach, after a first few: sampled all over, and about home."""
    counts, more = np.array([15, 20, 25, 30, 40, 60]), 15
    reached, all_over, home = [], [], []
    for seed in range(seeds):
        rng, w = np.random.default_rng(200 + seed), worn(seed)
        first = w.seen(*poses(w.nominal, FIRST, rng), rng)
        model = Model.of(w.nominal, first, backlash=True)
        plan = plan_joints(w.nominal, first, None, more, seed)
        q = rng.uniform(np.maximum(w.nominal.q_min, -np.pi), np.minimum(w.nominal.q_max, np.pi), (4000, 6))
        q = q[free_of_collision(model, q)]
        side = rng.choice([-1.0, 1.0], q.shape)
        truth = w.T_rig_body(q[:UNSEEN], side[:UNSEEN])

        def error(more, sides, w=w, first=first, seed=seed, q=q, side=side, truth=truth) -> float:
            both = np.concatenate([first.q, more]), np.concatenate([first.approach, sides])
            found = identify(w.nominal, w.seen(*both, np.random.default_rng([seed, len(more)])))
            return float(distance_m(found.model, found.solution.x, truth, q[:UNSEEN], side[:UNSEEN]).mean())

        near, near_side = poses(w.nominal, max(counts), rng)
        reached.append(error(plan.q, plan.approach))
        all_over.append([error(q[300 : 300 + n], side[300 : 300 + n]) for n in counts])
        home.append([error(near[:n], near_side[:n]) for n in counts])
        print(
            f"     planned {more}: {1e3 * reached[-1]:.3f} mm; predicted as good as {plan.random_for(more)}", flush=True
        )
    for name, errors in (("all over", all_over), ("about home", home)):
        mean = np.mean(errors, axis=0)
        reached_mm = ", ".join(f"{n}: {1e3 * e:.3f}" for n, e in zip(counts, mean, strict=True))
        # Where the mean error of random ones falls to that of the planned; they are as many as were tried at most.
        needed = float(np.interp(-np.log(np.mean(reached)), -np.log(np.minimum.accumulate(mean)), counts))
        report(
            f"  planned poses, of the random ones {name}", more / needed, 0.5, "", f", {needed:.0f} ({reached_mm} mm)"
        )
