"""The control loop with a rig that is followed, and with a sync LED: an arm that goes where it is sent."""

import gc
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodDescriptorType, ModuleType, SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "health"))

import faults
from arm_rig import ARM, MIDDLE

from armsight.app.replay.recorded import RecordedDatum, RecordedRun
from armsight.app.replay.run import Pace, replay_run
from armsight.app.run.experiment import PRIOR
from armsight.app.stream.datum import json_text
from armsight.data import JointStates, Shot
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose
from armsight.loop.estimators import Delay, KalmanEstimator, Mounting
from armsight.loop.health import base_motion, closure, fixed, monitor, residuals, rig, shape
from armsight.loop.health.follow import RigFollower
from armsight.loop.running import log
from armsight.loop.running.calibrate import find_delay
from armsight.loop.running.data import EventDatum, Fanout, NoteDatum, estimator_event
from armsight.loop.running.log import Log, RunSegment
from armsight.loop.running.loop import Loop
from armsight.loop.running.setup import Setup
from armsight.loop.sync_led import led_findings, light
from armsight.robot.boards.codes import BoardState
from armsight.robot.boards.contract import Abilities
from armsight.robot.trajectories import point_to_point
from views import both_pixels

RATE_HZ, DELAY_S, BIT_S = 20.0, 0.02, 0.003
T_BASE_RIG = ARM.forward(MIDDLE) @ inverse(pose(np.eye(3), np.array([0.1, 0.0, 0.9])))
MOUNTING = Mounting(T_BASE_RIG, np.eye(4), np.zeros((12, 12)))


class Obedient:
    """A board whose joints are where they are sent; readings are of some time before, s, and say the same."""

    def __init__(self, late_s=0.0):
        self.t_s, self.late, self.commands = 0.0, round(1e3 * late_s), [MIDDLE] * 100
        self.status = SimpleNamespace(state=BoardState.ENABLED, faults=(), t_s=0.0)
        self.abilities = Abilities(6, 1000.0, reading_age_s=(4e-4, 1e-4))
        self.ticks = [MIDDLE] * 100
        self.rng = np.random.default_rng(5)

    def receive(self, wait_s=0.0):
        count, (last, goal) = round(wait_s * 1000), self.commands[-2:]
        self.ticks += [last + (goal - last) * (k + 1) / count for k in range(count)]
        self.commands.append(goal)
        q = np.array(self.ticks[len(self.ticks) - count - self.late : len(self.ticks) - self.late])
        self.t_s += count * 1e-3
        return JointStates(
            self.t_s + 1e-3 * np.arange(1 - count, 1), q + self.rng.normal(size=q.shape) * PRIOR.reading_rad
        )

    def send(self, command):
        self.commands[-1:] = [self.ticks[-1], command.q_ref]

    def tool(self, t_s):
        """The pose of the tool at a time, s."""
        k = min(round(1e3 * (t_s - self.t_s)) - 1, -1)
        return ARM.forward(self.ticks[max(k, -len(self.ticks))])


class Projected:
    """A follower to which the body is projected, by the cameras as they are."""

    way = "followed"

    def __init__(self, board, rig, moved):
        self.board, self.rig, self.moved = board, rig, moved
        self.rng = np.random.default_rng(6)

    def recalibrate(self, rig):
        self.rig = rig

    def expose_apart(self, apart_s):
        pass

    def measure(self, shot, expected=None, twist=None):
        t_s = shot.t_s - DELAY_S
        rotated, motion = self.moved(t_s)
        rig = replace(faults.TRUE, T_left_right=faults.TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated)))
        T = inverse(T_BASE_RIG @ exp_se3(motion)) @ self.board.tool(t_s)
        uv = both_pixels(rig, faults.BODY.points @ T[:3, :3].T + T[:3, 3])
        return faults.measured(self.rig, faults.BODY, T, uv + faults.SIGMA_PX * self.rng.normal(size=uv.shape))


def opened(board, moved, *, rate_hz=RATE_HZ, image=lambda t_s: None, bit_s=None):
    """A loop, and everything it publishes."""
    newest, data = [0], []

    def poll():
        number = int((board.t_s - DELAY_S) * rate_hz)
        if number <= newest[0]:
            return None
        newest[0] = number
        t_s = number / rate_hz
        return Shot(str(number), *2 * [image(t_s)], t_s + DELAY_S)

    cov = np.diag(faults.SIGMAS**2)
    rig = replace(
        faults.TRUE.perturbed(faults.SIGMAS * np.random.default_rng(7).normal(size=24)), cov=cov, sigma_px=0.0
    )
    target = SimpleNamespace(body=faults.BODY)
    setup = Setup(ARM, board, poll, target, lambda q: np.zeros(6), rate_hz, faults.SYNC_S, sync_led_bit_s=bit_s)
    first = KalmanEstimator(ARM, prior=PRIOR, delay=Delay(DELAY_S, 1e-4))
    data.append(EventDatum(0.0, estimator_event(first, anew=False)))
    published = Fanout()
    published.put = data.append
    return Loop.open(setup, Projected(board, rig, moved), Log(), first, published), data


def moves(loop, seconds, seed=3):
    """Move the arm between poses about the middle, at least for so long, s."""
    rng, begin_s, at = np.random.default_rng(seed), loop.t_s, loop.board.ticks[-1]
    while loop.t_s - begin_s < seconds:
        to = MIDDLE + np.radians(15.0) * rng.uniform(-1, 1, 6)
        way, at = point_to_point(ARM, at, to), to
        loop.go(way, 0.3, RunSegment("open_loop"))


def test_a_camera_that_rotates_is_put_right_in_the_loop_and_replay_agrees():
    board, rotated = Obedient(), np.array([0.0, np.radians(0.05), 0.0])
    loop, data = opened(board, lambda t_s: (rotated * (t_s > 3.0), np.zeros(6)))
    loop.rig_follower = RigFollower(loop.follower.rig, faults.BODY)
    loop.mounting, loop.delay_s = MOUNTING, DELAY_S
    moves(loop, 0.1)
    loop.begin(KalmanEstimator(ARM, prior=PRIOR, delay=Delay(DELAY_S, 1e-4), learns_delay=False))
    moves(loop, 6.0)
    (correction,) = loop.log.corrections
    assert correction.what == "cameras"
    assert 3.0 < correction.at_s < 6.5
    true = faults.TRUE.T_left_right @ exp_se3(np.append(np.zeros(3), rotated))
    assert np.degrees(np.linalg.norm(log_se3(inverse(loop.follower.rig.T_left_right) @ true)[3:])) < 0.02
    found = loop.health.findings()
    assert ("rig", correction.at_s) in [(each.cause, each.corrected_s) for each in found]
    off = inverse(loop.estimator.estimate().T_base_tool) @ board.tool(board.t_s)
    assert np.linalg.norm(off[:3, 3]) < 5e-4
    notes = [each for each in data if isinstance(each, NoteDatum)]
    assert any(
        each.text.startswith("rig: ") for each in notes
    )  # published while the loop runs, and not in what is replayed
    data = [each for each in data if not isinstance(each, NoteDatum)]
    texts = [json_text(each.content if isinstance(each, EventDatum) else each.to_json(faults.BODY)) for each in data]
    recorded = tuple(RecordedDatum(type(each), json.loads(text)) for each, text in zip(data, texts, strict=True))
    run = RecordedRun(Path("run.mcap"), {}, recorded)
    again = replay_run(run, ARM, faults.BODY, estimator="kalman", pace=Pace(0.0), publisher=Fanout(), changed=False)
    assert again.differences == {"position_m": 0.0, "quaternion": 0.0, "covariance": 0.0}


def blinking(t_s):
    """An image with an LED."""
    rows, columns = np.indices((48, 64))
    noise = np.random.default_rng(round(1e6 * t_s)).normal(60.0, 2.0, (48, 64))
    spot = 120.0 * light(np.array([t_s]), 0.004, BIT_S) * np.exp(-((rows - 20.3) ** 2 + (columns - 30.6) ** 2) / 8)
    return np.clip(noise + spot, 0, 255).astype(np.uint8)


def test_the_sync_led_gives_the_delay_in_the_loop_and_a_sweep_that_differs_is_said():
    board = Obedient(late_s=0.004)  # joints that lag
    loop, _ = opened(board, lambda t_s: (np.zeros(3), np.zeros(6)), image=blinking, bit_s=BIT_S)
    loop.board.send(SimpleNamespace(q_ref=MIDDLE))
    loop.log.command = SimpleNamespace(q_ref=MIDDLE, gravity_duty=np.zeros(6))
    loop.find_led()
    loop.mounting = MOUNTING
    delay = find_delay(loop, MIDDLE, MIDDLE)
    assert abs(delay.delay_s - (DELAY_S - 4e-4)) < 4 * delay.sigma_s < 1e-3
    assert delay.sigma_s > 1e-4  # the age of a reading is known no better
    (found,) = led_findings(loop.led)
    assert found.cause == "time"
    assert abs(found.size - (0.4 - 4.0)) < 4 * found.sigma
    assert "a sweep of the arm finds the images 3." in found.what


def held(loop):
    """Bytes of all that lives as long as a loop: of its log, its watches, its estimator; devices are not its own."""
    seen = {id(each) for each in (loop.board, loop.setup, loop.follower, loop.publisher)}
    todo, total = [vars(loop)], 0
    while todo:
        each = todo.pop()
        code = ModuleType, FunctionType, BuiltinFunctionType, MethodDescriptorType, type
        if id(each) not in seen and not isinstance(each, code):
            seen.add(id(each))
            total += sys.getsizeof(each)
            todo += gc.get_referents(each)
            todo += [each.base] if isinstance(each, np.ndarray) else []
    return total


def test_what_a_loop_holds_does_not_grow_with_its_shots(monkeypatch):
    """With bounds so small that a third of the shots fill them."""
    small = {
        log: {"NEWEST_SHOTS": 20, "_MOST_SHOTS": 10, "_BLOCK": 512, "_NEWEST_LIVE": 20},
        closure: {"_MOST_KEPT": 14},
        fixed: {"MOST": 6, "_NEWEST": 4},
        residuals: {"KEPT": 4},
        rig: {"_IMAGES": 30, "POSES": 10},
        shape: {"_VIEWS": 20, "_ASKED": 8, "POSES": 10},
        monitor: {"_ALL_S": 2.0, "_RATIO": 2.0},
        base_motion: {"_KEPT": 20},
    }
    for module, bounds in small.items():
        for name, value in bounds.items():
            monkeypatch.setattr(module, name, value)
    board = Obedient()
    loop, data = opened(board, lambda t_s: (np.zeros(3), np.zeros(6)), rate_hz=10.0)
    loop.mounting, loop.delay_s = MOUNTING, DELAY_S
    moves(loop, 0.5)
    loop.begin(KalmanEstimator(ARM, prior=PRIOR, delay=Delay(DELAY_S, 1e-4), learns_delay=False))
    sizes = []
    for _ in range(3):
        del board.ticks[:-500], board.commands[:-5], data[:], loop.log.segments[:]
        moves(loop, 12.0)
        sizes.append(held(loop))
    assert loop.log.shots > 350
    assert sizes[2] < 1.1 * sizes[0], sizes  # what the estimator knew each second alone was a third more
