"""Arms with controllers of their own, emulated, before cameras: rests with their own sensors and with the loop closed.

    python benchmarks/controlled_arms.py so101 0 1 2      light: projected discs with noise instead of rendered images
    python benchmarks/controlled_arms.py ar4 0 1 2
    python benchmarks/controlled_arms.py rests ar4 0 1   the servo alone: seen with noise, frames and zeros known
    python benchmarks/controlled_arms.py lost 0 1 2       an AR4 whose joint slips by 1 degree while the loop is closed
    python benchmarks/controlled_arms.py report ar4 0     a recording of `arm plan`, and what `arm report` finds of
                                               the injected zeros and backlash

`armsight demo --model so101` is the same with rendered images. Rest errors are of the true tool against its reference, in
the frames of the run; RMS over the last fifth of a second; fused poses in motion likewise, against the claimed sigma.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "loop"), str(TESTS / "loop" / "health")]

from faults import SIGMA_PX, SIGMAS, measured  # noqa: E402

import armsight.app.run.experiment as experiment  # noqa: E402
from armsight.app.arm.evaluate import evaluate_arm, plan_report  # noqa: E402
from armsight.app.demo.demo import motion_text  # noqa: E402
from armsight.app.run.folder import finish, make_room  # noqa: E402
from armsight.app.run.motion_file import read_motions  # noqa: E402
from armsight.data import Shot  # noqa: E402
from armsight.geometry.pose import exp_se3, inverse, pose  # noqa: E402
from armsight.loop.identify.model import gravity_levers  # noqa: E402
from armsight.loop.running.calibrate import handeye_poses  # noqa: E402
from armsight.loop.running.setup import Setup  # noqa: E402
from armsight.loop.servo import JointLoops, LoopTiming, PoseServo  # noqa: E402
from armsight.robot.arm_file import open_arm  # noqa: E402
from armsight.robot.board_registry import slowed  # noqa: E402
from armsight.robot.trajectories import point_to_point  # noqa: E402
from armsight.sim.boards.device import STEP_S  # noqa: E402
from armsight.sim.workcell.arm import imperfections, sample_arm  # noqa: E402
from armsight.sim.workcell.body import body_target  # noqa: E402
from armsight.sim.workcell.cameras import open_cameras, open_rig, rig_pose, shot_times  # noqa: E402
from armsight.sim.workcell.controlled import CONTROLLED, standing  # noqa: E402
from armsight.sim.workcell.workcell import NEAR_M, workcell_poses  # noqa: E402
from views import both_pixels  # noqa: E402

CAMERAS, POSES, PRESET = "1280x720@30", 15, "worn"
#: Of three numbers' chi-square.
CHI2_95 = 7.815
#: Errors of the rig, of independent ones of a calibration with 30 pairs: vision is then off by about 0.1 mm, as in rendered
#: runs, where errors of centre and rotation make up for each other.
RIG_SHARE = 0.3
MOUNT = pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.003, -0.004, 0.035]))


class LightCell:
    """An emulated arm before cameras whose discs are projected, not rendered."""

    def __init__(self, name, seed):
        own = CONTROLLED[name]
        self.model, amounts = slowed(standing(open_arm(name)), own.board), imperfections(PRESET)
        self.seed, self.rng = seed, np.random.default_rng([seed, 50])
        true = sample_arm(self.model, replace(amounts, zero_rad=0.0), seed).arm
        self.arm, self.board = own.open(true, amounts, seed)
        self.timing, self.target = open_cameras(CAMERAS)[0], body_target()
        self.rig = open_rig("parallel", self.timing.image_size_px, 0.2)
        self.T_base_rig = rig_pose(self.model, self.rig, MOUNT, seed, NEAR_M)
        off = RIG_SHARE * SIGMAS
        self.given = replace(
            self.rig.perturbed(off * self.rng.normal(size=len(off))), cov=np.diag(off**2), sigma_px=0.0
        )
        self.points = self.target.body.points + 2e-5 * self.rng.normal(size=self.target.body.points.shape)
        self.next, self.way = int(self.arm.t_s * self.timing.rate_hz) + 1, "followed"
        self.setup = Setup(
            self.model, self.board, self.poll, self.target, np.zeros_like, self.timing.rate_hz, self.timing.sync_s
        )

    def poll(self):
        newest = None
        while shot_times(self.timing, self.seed, self.next).stamp_s <= self.arm.t_s:
            newest, self.next = self.next, self.next + 1
        if newest is None:
            return None
        return Shot(f"{newest:06d}", None, None, shot_times(self.timing, self.seed, newest).stamp_s)

    def follower(self, rig, target, sync_s):
        return SimpleNamespace(rig=rig, measure=self.measure, way="followed", expose_apart=lambda skew_s: None)

    def measure(self, shot, expected, twist):
        q = self.true_q(shot_times(self.timing, self.seed, int(shot.name)).left_s)
        T = inverse(self.T_base_rig) @ self.arm.arm.forward(q) @ MOUNT
        uv = both_pixels(self.rig, self.points @ T[:3, :3].T + T[:3, 3])
        return measured(self.given, self.target.body, T, uv + SIGMA_PX * self.rng.normal(size=uv.shape))

    def true_q(self, t_s):
        at = min(max(t_s / STEP_S, 0.0), len(self.arm.path) - 2.0)
        low = int(at)
        rows = self.arm.path[low : low + 2, self.model.joints :]
        return rows[0] + (at - low) * (rows[1] - rows[0])

    def plan(self, text):
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "motion.toml").write_text(text)
            return read_motions(self.model, Path(folder) / "motion.toml")

    def run(self, plan, **options):
        """Run the experiment with the light cameras."""
        around = np.vstack([self.model.home, workcell_poses(self.model, default=False)])
        targets = handeye_poses(self.model, around, POSES, self.seed)
        before, experiment.Follower = experiment.Follower, self.follower
        try:
            return experiment.run_experiment(
                self.setup, self.given, plan, targets, progress=lambda line: None, **options
            )
        finally:
            experiment.Follower = before

    def default_plan(self, *, quick=True):
        poses = workcell_poses(self.model, default=False)
        return self.plan(motion_text(self.model, poses, quick=quick, slow=True))

    def rests(self, found):
        """Return (motion, closed, error in mm) of each rest of a run."""
        mounting = found.handeye.mounting
        T_run_base = mounting.T_base_rig @ inverse(self.T_base_rig)
        T_body_tool = MOUNT @ inverse(mounting.T_tool_body)
        rests = []
        for segment in (each for each in found.log.segments if each.phase == "rest"):
            last = round(segment.end_s / STEP_S)
            tool = (
                T_run_base @ self.arm.arm.forward(self.arm.path[last - 200 : last, self.model.joints :]) @ T_body_tool
            )
            goal = self.model.forward(segment.trajectory.at(segment.trajectory.duration_s).q)
            off = np.linalg.norm(tool[:, :3, 3] - goal[:3, 3], axis=1)
            rests.append((segment.motion, segment.closed, 1e3 * float(np.sqrt((off**2).mean()))))
        return rests


def in_motion(cell, found):
    """Return RMS and sigma, mm, of the fused position in motion against the truth, and its share inside 95 %."""
    mounting = found.handeye.mounting
    T_run_base, T_body_tool = mounting.T_base_rig @ inverse(cell.T_base_rig), MOUNT @ inverse(mounting.T_tool_body)
    off, variance, inside = [], [], []
    motions = [each for each in found.log.segments if each.phase in ("open_loop", "closed_loop")]
    rows = found.log.fused.array(53)
    moves = np.any([(rows[:, 0] >= each.begin_s) & (rows[:, 0] < each.end_s) for each in motions], axis=0)
    for row in rows[moves]:
        t_s, T, own = row[0], row[1:17].reshape(4, 4), row[17:].reshape(6, 6)[:3, :3]
        true = T_run_base @ cell.arm.arm.forward(cell.true_q(t_s)) @ T_body_tool
        e = T[:3, :3].T @ (T[:3, 3] - true[:3, 3])
        off.append(e @ e)
        variance.append(np.trace(own))
        inside.append(e @ np.linalg.solve(own, e) < CHI2_95)
    return 1e3 * float(np.sqrt(np.mean(off))), 1e3 * float(np.sqrt(np.mean(variance))), float(np.mean(inside))


def closed_loop(name, seed):
    """Print the rest errors of one seed; return (RMS open, RMS closed, largest closed), mm."""
    cell = LightCell(name, seed)
    found = cell.run(cell.default_plan(quick=False))
    if found.ended_text is not None:
        print(f"{name} seed {seed}: {found.ended_text}")
        return None
    rests = cell.rests(found)
    sides = [np.array([mm for _, closed, mm in rests if closed is which]) for which in (False, True)]
    open_mm, closed_mm = (float(np.sqrt((side**2).mean())) for side in sides)
    each = ", ".join(f"{mm:.2f}" for mm in sides[1])
    fused_mm, sigma_mm, inside = in_motion(cell, found)
    print(
        f"{name} seed {seed}: in motion fused {fused_mm:.3f} mm, sigma {sigma_mm:.3f}, {100 * inside:.0f} % inside; "
        f"own sensors {open_mm:.2f} mm, loop closed {closed_mm:.3f} ({each}), "
        f"{open_mm / closed_mm:.1f} times smaller; health: {[f.what for f in found.health] or 'nothing'}",
        flush=True,
    )
    return open_mm, closed_mm, float(sides[1].max())


class KnownFrames:
    """What an estimator says that sees the tool 50 ms late, with noise, knows the zeros, and no backlash."""

    def __init__(self, arm, model, rng, q):
        self.arm, self.model, self.rng, self.q, self.qd, self.next_s = arm, model, rng, q, np.zeros(len(q)), 0.0
        self.zero, self.noise = arm.path[-1, model.joints :] - q, np.zeros(6)

    def estimate(self):
        true = self.model.forward(self.arm.path[max(len(self.arm.path) - 50, 0), self.model.joints :])
        if self.arm.t_s >= self.next_s:
            fresh = self.rng.normal(0.0, [3e-5] * 3 + [3e-4] * 3)
            self.next_s, self.noise = self.arm.t_s + 1 / 30, 0.6 * self.noise + 0.4 * fresh
        T = true @ exp_se3(self.noise)
        return SimpleNamespace(T_base_tool=T, q=self.q, qd=self.qd, vision_age_s=0.05, cov_own=1e-10 * np.eye(6))

    def tool(self, q, qd, *, pressed=False):
        return self.model.forward(q + self.zero)


def rests(name, seed, poses=3, rest_s=6.0, period_s=0.01):
    """Print the rest errors, mm, of the servo over an emulated arm whose frames and zeros are known."""
    own, rng = CONTROLLED[name], np.random.default_rng(seed)
    model = slowed(standing(open_arm(name)), own.board)
    arm, board = own.open(model, imperfections(PRESET), seed)
    abilities, q = board.abilities, model.home
    joints = JointLoops(abilities.steps_rad, abilities.rest_rad_s)
    servo = PoseServo(model, LoopTiming(period_s, 1 / 30, 0.035, abilities.response_s), joints)
    seen, found = KnownFrames(arm, model, rng, board.receive(0.0).q[-1]), []
    for _ in range(poses):
        goal = np.clip(q + np.radians(12) * rng.uniform(-1, 1, model.joints), model.q_min + 0.1, model.q_max - 0.1)
        motion, begin_s, off = point_to_point(model, q, goal), arm.t_s, []
        while arm.t_s < begin_s + motion.duration_s + rest_s:
            board.send(servo.step(servo.aim(motion, arm.t_s - begin_s), seen).command)
            for read in board.receive(period_s).q[-1:]:
                seen.q, seen.qd = read, 0.6 * seen.qd + 0.4 * (read - seen.q) / period_s
            off.append(model.forward(arm.path[-1, model.joints :])[:3, 3] - model.forward(goal)[:3, 3])
        found.append(1e3 * float(np.sqrt((np.array(off[-round(0.2 / period_s) :]) ** 2).sum(axis=1).mean())))
        q = goal
    each = ", ".join(f"{mm:.3f}" for mm in found)
    print(f"{name} seed {seed}: at rest {np.sqrt(np.mean(np.square(found))):.3f} mm ({each})", flush=True)


def lost_steps(seed):
    """Let one joint of an AR4 slip by a degree while the loop is closed; print when and how it is named."""
    rng = np.random.default_rng([seed, 60])
    joint, degrees = int(rng.integers(1, 5)), float(rng.choice([-1.0, 1.0]))
    cell, state = LightCell("ar4", seed), SimpleNamespace(loop=None, at_s=None, found_s=None)

    def begun(loop):
        state.loop = loop
        loop.on_period = period

    def period():
        loop = state.loop
        if (
            state.at_s is None
            and loop.segment is not None
            and loop.segment.phase == "closed_loop"
            and loop.segment.kind == "circle"
        ):
            state.at_s = loop.t_s
            cell.arm.device.lose(joint, degrees)
        if state.at_s is None or state.found_s is not None:
            return
        if any(f.cause == "joint" for f in loop.health.findings()):
            state.found_s = loop.t_s

    found = cell.run(cell.default_plan(), begun=begun)
    said = [f"{f.cause}: {f.what}" for f in found.health]
    late = "not found" if state.found_s is None else f"named after {state.found_s - state.at_s:.2f} s"
    print(f"seed {seed}: joint {joint + 1} by {degrees:+.0f} deg: {late}; at the end {said}", flush=True)


def report(name, seed, poses=20, cycles=4):
    """Record what `armsight arm plan` plans, report it, and set the found zeros and backlash against the true ones.

    The true zero of a joint is the mean over the rests of its true angle less its reading: a loaded AR4's joint leans to
    one side of its backlash, and its switches scatter.
    The run's folder stays in the system's temporary folder, for `armsight arm report`.
    """
    cell, folder = LightCell(name, seed), Path(tempfile.gettempdir()) / f"arm_report_{name}_{seed}"
    around = np.vstack([cell.model.home, workcell_poses(cell.model, default=False)])
    text, _ = plan_report(cell.model, around, lambda Ts: np.ones(len(Ts), bool), poses=poses, cycles=cycles)
    plan = cell.plan(text)
    found = cell.run(plan, close_loop=False)
    found.kept, found.picture = [], None  # there are no images
    make_room(folder)
    (folder / "motion.toml").write_text(text)
    found.properties = {"nominal_arm": name, "board": cell.board.welcome.board}
    finish(found, folder)
    result = evaluate_arm(folder, open_arm(name))
    device = cell.arm.device
    ar4 = name == "ar4"
    rows = found.log.readings.array(1 + cell.model.joints)
    times, read = rows[:, 0], rows[:, 1:]
    ends = [segment.end_s for segment in found.log.segments if segment.phase == "rest"]
    zeros = np.degrees(np.mean([cell.true_q(times[k]) - read[k] for k in np.searchsorted(times, ends) - 1], axis=0))
    backlash = np.array(device.mechanics.backlash_deg) if ar4 else np.full(5, np.nan)
    droop = np.zeros(cell.model.joints) if ar4 else injected_droop(cell, times, read, ends)
    print(
        f"{name} seed {seed}: {result.placed_mm:.2f} mm; parts:",
        {k: f"{100 * p.share:.0f} %" for k, p in result.parts.items()},
    )
    for k, joint in enumerate(result.joints):
        print(f"  {joint.name:14} zero {joint.zero_deg} true {zeros[k]:.3f}; backlash {joint.backlash_deg}", end=" ")
        print(f"true {backlash[k]:.3f}; droop {joint.droop_deg_per_m} true {droop[k]:.2f} deg/m", end="; ")
        print(f"sides {joint.hysteresis_deg}; {joint.latency_s} s")
    return result


def injected_droop(cell, times, read, ends):
    """Return the droop of an SO-101's joints, deg per metre of the report's lever: of the torques it really carried."""
    servos, rows = cell.arm.device.servos, np.searchsorted(times, ends) - 1
    loads = np.array([servos._load(np.append(cell.true_q(times[k]), 0.0))[:-1].copy() for k in rows])
    droops = -np.degrees(loads / servos.mechanics.stiffness_n_m_rad)
    levers = gravity_levers(cell.model, read[rows])
    slopes = [
        np.polyfit(lever, droop, 1)[0] if np.ptp(lever) > 1e-6 else 0.0
        for lever, droop in zip(levers.T, droops.T, strict=True)
    ]
    return np.array(slopes)


def main(what, *rest):
    """Run what is asked for."""
    if what == "lost":
        for seed in map(int, rest or ("0",)):
            lost_steps(seed)
    elif what == "rests":
        for seed in map(int, rest[1:] or ("0",)):
            rests(rest[0], seed)
    elif what == "report":
        for seed in map(int, rest[1:] or ("0",)):
            report(rest[0], seed)
    else:
        rows = [closed_loop(what, seed) for seed in map(int, rest or ("0",))]
        kept = np.array([row for row in rows if row is not None])
        times = kept[:, 0] / kept[:, 1]
        print(
            f"{what}: own sensors {np.median(kept[:, 0]):.2f} mm (median), closed {np.median(kept[:, 1]):.3f}, largest "
            f"{kept[:, 2].max():.3f}; times smaller {times.min():.1f} to {times.max():.1f}"
        )


if __name__ == "__main__":
    main(*(sys.argv[1:] or ("so101", "0")))
