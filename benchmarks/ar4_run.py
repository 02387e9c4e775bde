"""An emulated AR4 before rendered cameras: ``armsight run`` with the Teensy's protocol, open loop and closed on vision.

    python benchmarks/ar4_run.py [SEED ...]

The arm's table is off as a used arm's, its homing by up to 1 degree a joint, its gearboxes have backlash. Rest errors are
of the true tool against its reference, in the frames of the run.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from armsight.app.run.calibrate import handeye_poses
from armsight.app.run.experiment import require_start, run_experiment
from armsight.app.run.motion_file import read_motions
from armsight.app.run.setup import Setup
from armsight.data import JointCommand
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm_file import open_arm
from armsight.robot.boards.ar4.board import Ar4Board
from armsight.robot.boards.opening import slowed
from armsight.sim.boards.ar4 import Ar4Mechanics, Ar4Teensy
from armsight.sim.boards.device import STEP_S, SteppedLink
from armsight.sim.render.optics import Sensor
from armsight.sim.workcell.arm import imperfections, sample_arm
from armsight.sim.workcell.body import body_patterns, body_target
from armsight.sim.workcell.cameras import WorkcellSource, open_cameras, open_rig
from armsight.sim.workcell.images import LENS, WorkcellCamera
from armsight.sim.workcell.motors import solids

CAMERAS, HOME_DEG, DISTANCE_M, POSES = "960x540@15", (0.0, -10.0, 20.0, 0.0, 45.0, 0.0), 0.7, 14
MOTION = """
start_deg = [0, -10, 20, 0, 45, 0]
[[motion]]
kind = "joints"
name = "there"
q_deg = [8, -4, 14, 5, 40, 8]
rest_s = 2.5
[[motion]]
kind = "joints"
name = "back"
q_deg = [-6, -14, 24, -5, 48, -8]
rest_s = 2.5
"""


class SeenArm:
    """The emulated AR4 as the cameras see it: its Teensy, and the path of its true joint angles."""

    def __init__(self, arm, teensy):
        self.arm, self.parts, self.teensy = arm, solids(arm), teensy
        self.stepped = lambda: None
        self._path, self._count = np.empty((1 << 18, 12)), 0
        self._note()
        self._note()

    @property
    def t_s(self):
        return (self._count - 1) * STEP_S

    @property
    def path(self):
        return self._path[: self._count]

    def write(self, data):
        self.teensy.write(data)

    def read(self):
        return self.teensy.read()

    def step(self):
        self.teensy.step()
        self._note()
        self.stepped()

    def advance(self, dt_s):
        for _ in range(round(dt_s / STEP_S)):
            self.step()

    def _note(self):
        self._path[self._count] = np.tile(np.radians(self.teensy.true_deg), 2)
        self._count += 1


def run(seed):
    """Return (motion, closed, rest error in mm) of each rest, and what the hand-eye calibration's held-out error is, mm."""
    model = replace(slowed(open_arm("ar4"), "ar4:"), home=np.radians(HOME_DEG))
    true = sample_arm(model, replace(imperfections("used"), zero_rad=0.0), seed).arm
    homing = tuple(np.random.default_rng(seed).uniform(-1.0, 1.0, 6))
    seen = SeenArm(true, Ar4Teensy(seed=seed, homing_s=0.1, mechanics=Ar4Mechanics(homing_deg=homing)))
    link = SteppedLink(seen)
    board = Ar4Board.connect(link, now=lambda: seen.t_s, name="the emulated AR4")
    board.home()
    board.enable()
    begin, rest = board.receive().q[-1], np.zeros(6)
    for share in np.linspace(0.0, 1.0, 8)[1:]:
        board.send(JointCommand(begin + share * (model.home - begin), rest, rest, 0.02))
        board.receive(0.7)
    timing, pipeline = open_cameras(CAMERAS)
    rig = open_rig("parallel", timing.image_size_px, 0.2)
    mount = pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.003, -0.004, 0.035]))
    T_left_body = pose(exp_so3(np.radians([15.0, -12.0, 10.0])), np.array([0.1, 0.0, DISTANCE_M]))
    T_base_rig = model.forward(model.home) @ mount @ inverse(T_left_body)
    stands = (T_base_rig, T_base_rig @ rig.T_left_right)
    cameras = tuple(
        WorkcellCamera(camera, T, seen.parts, seed, sensor=Sensor(read_noise=2.0), psf_sigma_px=LENS.psf_sigma_px)
        for camera, T in zip(rig.cameras, stands, strict=True)
    )
    clock = (lambda: seen.t_s, seen.advance)
    source = WorkcellSource(seen, cameras, timing, (body_patterns(), mount), clock, seed, pipeline)
    setup = Setup(model, board, source.poll, body_target(), np.zeros_like, timing.rate_hz, timing.sync_s)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "motion.toml"
        path.write_text(MOTION)
        plan = read_motions(model, path)
    ends = [plan.start, *(m.trajectory.at(m.trajectory.duration_s).q for m in plan.motions)]
    targets = handeye_poses(model, np.array(ends), POSES, 0)
    require_start(setup, plan, targets)
    found = run_experiment(setup, rig, plan, targets, progress=lambda line: print(line, file=sys.stderr))
    source.close()
    if found.ended_text is not None:
        raise SystemExit(f"seed {seed}: {found.ended_text}")
    mounting, rests = found.handeye.mounting, []
    T_run_base = mounting.T_base_rig @ inverse(T_base_rig)
    T_body_tool = mount @ inverse(mounting.T_tool_body)
    for segment in (each for each in found.log.segments if each.phase == "rest"):
        q = seen.path[round(segment.end_s / STEP_S) - 50, 6:]
        tool = T_run_base @ true.forward(q) @ T_body_tool
        reference = model.forward(segment.trajectory.at(segment.trajectory.duration_s).q)
        rests.append((segment.motion, segment.closed, 1e3 * np.linalg.norm(tool[:3, 3] - reference[:3, 3])))
    return rests, 1e3 * found.handeye.found.held_out.rms()[0]


if __name__ == "__main__":
    for seed in [int(each) for each in sys.argv[1:]] or [0]:
        rests, held_out = run(seed)
        print(f"seed {seed}: hand-eye held out {held_out:.2f} mm")
        for motion, closed, error_mm in rests:
            print(f"  {motion:6} {'loop closed' if closed else 'open loop':12} {error_mm:.3f} mm")
