"""Kinematics beside pinocchio, EAIK and roboticstoolbox in one run, one thread.

    python benchmarks/kinematics.py            all metrics, 1,000,000 poses
    python benchmarks/kinematics.py 100000     all metrics, fewer poses
    python benchmarks/kinematics.py others     metrics 3 and 4 alone

Metric 1, time: forward kinematics, Jacobian and all solutions of the inverse. "kernel" is the compiled function called
from compiled code, "call" is the public method called from Python, "batch" is the public method on 100,000 at once.
pinocchio's and EAIK's C++ is called from Python, as their users do: their metrics hold that call's share. Least of
several runs of the processor's own time, so that other work on the computer counts little.

Metric 2, exactness: over seeded random poses, as many near singularities as elsewhere, the errors of every solution
returned (measured anew through ``forward``), doubles, NaN, and what EAIK finds and armsight does not.

Metric 3: the models that their makers publish as URDF against pinocchio on that, forward kinematics and Jacobian.

Metric 4: the numeric inverse of arms of other than six joints over 100,000 seeded poses, joint angles drawn evenly in
the limits: how many are solved within the limits, and the wall-clock time of each compiled call.

Peers are optional: pip install pin EAIK roboticstoolbox-python.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"
# The peers' wrappers and the sampling near singularities are the tests' own.
sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / part) for part in ("robot", "robot/models")]

import arms  # noqa: E402
import makers_chains  # noqa: E402
import numpy as np  # noqa: E402
import peers  # noqa: E402

from armsight.robot.kinematics import chain, inverse, numeric  # noqa: E402
from armsight.robot.kinematics.inverse import MOST, WIDTH  # noqa: E402
from armsight.robot.kinematics.table import KIND  # noqa: E402
from armsight.robot.models import MODELS  # noqa: E402

#: The models whose inverse is a closed form.
CLOSED = [arm for arm in MODELS.values() if arm.joints == 6 and arm.table[KIND]]
POSES, BATCH, CHUNK = 1_000_000, 100_000, 20_000


def have(module):
    return importlib.util.find_spec(module) is not None


def least(work, times, runs=7):
    """Least processor time of one of ``times`` rounds of ``work``, us."""
    work()
    best = np.inf
    for _ in range(runs):
        start = time.process_time()
        for _ in range(times):
            work()
        best = min(best, time.process_time() - start)
    return best / times * 1e6


# One call of a kernel after another: the way from Python into compiled code is part of the time.
def forwards(table, q, T, rounds):
    for _ in range(rounds):
        for row in q:
            chain.forward(table, row, T)


def jacobians(table, q, J, rounds):
    for _ in range(rounds):
        for row in q:
            chain.jacobian(table, row, False, J)


def inverses(table, closed, limits, Ts, near, rows, scratch, n, rounds):
    for _ in range(rounds):
        for T in Ts:
            inverse.inverse(table, closed, limits, T, near, False, rows, scratch, n)


def metric_1(rng):
    print("metric 1: time, us; required: forward 0.4 kernel, 6 call, 0.08 batch; jacobian 0.6 kernel; inverse 3, 15, 2")
    print(f"{'':19}{'kernel':>8}{'call':>8}{'batch':>8}   peers, called from Python")
    for arm in CLOSED:
        q = rng.uniform(-np.pi, np.pi, (1000, 6))
        Ts = arm.forward(q)
        each, eachT = iter_forever(list(q)), iter_forever(list(Ts))
        ours, beside = our_times(arm, q, Ts, each, eachT, rng), peer_times(arm, each, eachT, Ts)
        for k, (name, times) in enumerate(ours.items()):
            print(
                f"{arm.name if k == 0 else '':9}{name:10}" + "".join(f"{t:8.3f}" for t in times) + f"   {beside[name]}"
            )


def our_times(arm, q, Ts, each, eachT, rng):
    many = rng.uniform(-np.pi, np.pi, (BATCH, 6))
    manyTs = arm.forward(many)
    near, rows, scratch = np.zeros(6), np.empty((MOST, WIDTH)), np.zeros(inverse.SCRATCH)
    T, J = np.empty((4, 4)), np.empty((6, 6))
    tables = arm.table, arm._closed, arm._limits
    return {
        "forward": (
            least(lambda: forwards(arm.table, q, T, 20), 1) / 20_000,
            least(lambda: arm.forward(next(each)), 5000),
            least(lambda: arm.forward(many), 1) / BATCH,
        ),
        "jacobian": (
            least(lambda: jacobians(arm.table, q, J, 20), 1) / 20_000,
            least(lambda: arm.jacobian(next(each)), 5000),
            least(lambda: arm.jacobian(many), 1) / BATCH,
        ),
        "inverse": (
            least(lambda: inverses(*tables, Ts, near, rows, scratch, chain.BATCH, 5), 1) / 5000,
            least(lambda: arm.inverse(next(eachT)), 3000),
            least(lambda: arm.inverse_batch(manyTs), 1, 4) / BATCH,
        ),
    }


def iter_forever(items):
    while True:
        yield from items


def peer_times(arm, each, eachT, Ts):
    out = {"forward": [], "jacobian": [], "inverse": []}
    if have("pinocchio"):
        peer = peers.Pinocchio(arm)
        out["forward"].append(f"pinocchio {least(lambda: peer.forward(next(each)), 5000):.2f}")
        out["jacobian"].append(f"pinocchio {least(lambda: peer.jacobian(next(each)), 5000):.2f}")
    if have("eaik"):
        robot = peers.Eaik(arm).robot
        out["inverse"].append(f"EAIK {least(lambda: robot.IK(next(eachT)), 3000):.2f}")
        listed = list(Ts)
        out["inverse"].append(f"batch {least(lambda: robot.IK_batched(listed, 1), 5) / len(listed):.2f}")
    if have("roboticstoolbox"):
        toolbox = peers.Toolbox(arm)
        out["forward"].append(f"roboticstoolbox {least(lambda: toolbox.forward(next(each)), 300):.2f}")
        out["jacobian"].append(f"roboticstoolbox {least(lambda: toolbox.jacobian(next(each)), 300):.2f}")
        out["inverse"].append(f"roboticstoolbox {least(lambda: toolbox.inverse(next(eachT)), 5, 3):.0f} (one solution)")
    return {name: ", ".join(names) or "none installed" for name, names in out.items()}


def metric_2(rng, poses):
    print(
        f"\nmetric 2: {poses} poses, half of them near singularities; required: below 1e-9 m and rad, 0 of the others"
    )
    print(
        f"{'':9}{'poses':>8}{'solutions':>11}{'worst m':>10}{'worst rad':>10}{'NaN':>5}{'twice':>6}"
        f"{'none':>6}{'EAIK finds':>12}{'of a family':>13}{'undetermined':>14}{'missed':>8}"
    )
    each = poses // len(CLOSED) // 2
    for arm in CLOSED:
        total = np.zeros(9, dtype=np.int64)  # as the columns, without the errors
        worst = np.zeros(2)
        for start in range(0, each, CHUNK // 2):
            n = min(CHUNK // 2, each - start)
            q = np.concatenate([rng.uniform(-np.pi, np.pi, (n, 6)), arms.near_singular(arm, n, rng)])
            counts, errors = one_chunk(arm, arm.forward(q))
            total += counts
            worst = np.maximum(worst, errors)
        print(
            f"{arm.name:9}{total[0]:8}{total[1]:11}{worst[0]:10.1e}{worst[1]:10.1e}{total[2]:5}{total[3]:6}{total[4]:6}"
            + (f"{total[5]:12}{total[6]:13}{total[7]:14}{total[8]:8}" if have("eaik") else "  EAIK is not installed")
        )


def one_chunk(arm, Ts):
    many = arm.inverse_batch(Ts)
    width = many.q.shape[1]
    there = np.arange(width) < many.count[:, None]
    far, rotated = arms.off(arm.forward(many.q[there]), np.repeat(Ts, many.count, axis=0))
    twice = sum(
        (arms.apart(many.q[:, i], many.q[:, j]) < 1e-7)[there[:, i] & there[:, j]].sum()
        for i in range(width)
        for j in range(i)
    )
    counts = [len(Ts), many.count.sum(), np.isnan(many.q).sum(), twice, (many.count == 0).sum(), 0, 0, 0, 0]
    if have("eaik"):
        counts[5:] = beside_eaik(arm, Ts, many, there)
    return np.array(counts), (far.max(), rotated.max())


def beside_eaik(arm, Ts, many, there):
    """How many exact solutions EAIK finds, and what of them is not among ours: see the columns.

    On a singularity joint angles are a family of which each of us returns a few. A member counts as one of a family if
    ours, asked for the one near it, is the same; as undetermined if its own error in the pose can move it by a radian
    (that error over the smallest singular value of the Jacobian).
    """
    theirs = peers.Eaik(arm).inverse_batch(Ts)
    pose = np.repeat(np.arange(len(Ts)), [len(found) for found in theirs])
    q = (np.concatenate(theirs) + np.pi) % (2 * np.pi) - np.pi
    error = np.max(arms.off(arm.forward(q), Ts[pose]), axis=0) + 1e-15
    exact = error < 1e-9
    pose, q, error = pose[exact], q[exact], error[exact]
    ours = np.where(there[..., None], many.q, np.inf)
    with np.errstate(invalid="ignore"):
        apart = np.nan_to_num(arms.apart(ours[pose], q[:, None]), nan=np.inf).min(axis=1)
    doubtful = np.flatnonzero(apart > 1e-7)
    smallest = np.linalg.svd(arm.jacobian(q[doubtful]), compute_uv=False)[:, -1] if len(doubtful) else np.zeros(0)
    # Near a singularity joint angles are known as well as the pose, divided by the Jacobian's smallest singular value.
    allowed = 1e-7 + 4 * error[doubtful] / np.maximum(smallest, 1e-300)
    family = undetermined = missed = 0
    for k, limit in zip(doubtful, allowed, strict=True):
        if apart[k] > min(limit, 1.0):
            near = arm.inverse(Ts[pose[k]], near=q[k])
            if len(near) and arms.apart(near.q, q[k]).min() < min(limit, 1.0):
                family += 1
            elif limit > 1.0:
                undetermined += 1
            else:
                missed += 1
    return len(q), family, undetermined, missed


def metric_3(rng):
    print("\nmetric 3: largest difference from pinocchio on the makers' URDF, 1000 poses; required: below 1e-12")
    if not have("pinocchio"):
        print("pinocchio is not installed")
        return
    from scipy.spatial.transform import Rotation
    from test_makers_chains import STANDS

    for name in makers_chains.CHAINS:
        arm, peer = MODELS[name], makers_chains.Peer(name)
        base, way, tool = STANDS.get(name, (Rotation.identity(), np.ones(arm.joints), Rotation.identity()))
        L, R = np.eye(4), np.eye(4)
        L[:3, :3], R[:3, :3] = base.as_matrix(), tool.as_matrix()
        worst = np.zeros(2)
        for q in rng.uniform(arm.q_min, arm.q_max, (1000, arm.joints)):
            far = np.abs(L @ arm.forward(q) @ R - peer.forward(way * q)).max()
            J = np.kron(np.eye(2), L[:3, :3]) @ arm.jacobian(q)
            worst = np.maximum(worst, (far, np.abs(J - peer.jacobian(way * q) * way).max()))
        print(f"{name:9} forward {worst[0]:.1e}  Jacobian {worst[1]:.1e}")


def metric_4(rng, poses=100_000):
    print(f"\nmetric 4: numeric inverse, {poses} reachable poses; required: 99.99 % solved, at most 100 us each")
    print(
        f"{'':9}{'joints':>7}{'solved %':>10}{'missed':>8}{'mean us':>9}{'median':>8}{'p99':>8}{'worst m':>10}{'rad':>10}"
    )
    for arm in (*arms.OTHERS, arms.FOUR):
        Ts = arm.forward(rng.uniform(arm.q_min, arm.q_max, (poses, arm.joints)))
        q, off, us = np.empty((poses, arm.joints)), np.empty((poses, 3)), np.empty(poses)
        goal, scratch = arm._limits.mean(axis=0), np.zeros(numeric.SCRATCH)
        for k in range(poses):
            begin = time.perf_counter_ns()
            numeric.inverse(arm.table, arm._limits, Ts[k], goal, q[k], off[k], scratch)
            us[k] = (time.perf_counter_ns() - begin) / 1e3
        far, rotated = arms.off(arm.forward(q), Ts)
        good = (far < 1e-9) & (rotated < 1e-9) & arm.within_limits(q)
        print(
            f"{arm.name:9}{arm.joints:7}{100 * good.mean():10.3f}{(~good).sum():8}{us.mean():9.1f}{np.median(us):8.1f}"
            f"{np.percentile(us, 99):8.1f}{far[good].max():10.1e}{rotated[good].max():10.1e}"
        )


def main() -> None:
    rng = np.random.default_rng(20)
    if sys.argv[1:] != ["others"]:
        metric_1(rng)
        metric_2(rng, int(sys.argv[1]) if len(sys.argv) > 1 else POSES)
    metric_3(np.random.default_rng(21))
    metric_4(np.random.default_rng(22))


if __name__ == "__main__":
    main()
