"""The control loop with a fake board and fake cameras: how a run ends when something fails."""

import gc
import os
import signal
import sys
import threading
import time
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from armsight.app.interrupts import uninterrupted
from armsight.app.run import experiment
from armsight.app.run.experiment import run_experiment
from armsight.app.run.motion_file import QUICK, read_motions
from armsight.data import JointStates, Missed, Shot
from armsight.errors import ArmsightError, CalibrationError, DeviceError, InputError
from armsight.geometry.pose import pose
from armsight.loop.estimators import Delay, KalmanEstimator
from armsight.loop.references.file import Entry
from armsight.loop.references.inertial import Inertial
from armsight.loop.running import log
from armsight.loop.running.beside import Fused
from armsight.loop.running.calibrate import find_delay
from armsight.loop.running.controllers import PERIOD_S, Planned
from armsight.loop.running.data import NoteDatum
from armsight.loop.running.log import Log, RunSegment
from armsight.loop.running.loop import SIMULATED_SEARCH_S, Loop, beside, steady
from armsight.loop.running.setup import Setup
from armsight.robot.arm_file import open_arm
from armsight.robot.boards.codes import BoardState
from armsight.robot.boards.contract import Abilities
from armsight.robot.trajectories import point_to_point

ARM = open_arm("six_r")
#: A rig of which nothing is known, so that nothing can be tested.
UNKNOWN = SimpleNamespace(cov=np.zeros((30, 30)), shutters=None, T_left_right=pose(np.eye(3), [0.2, 0.0, 0.0]))


class Standing:
    """A board whose arm stands at home, whatever it is commanded."""

    def __init__(self):
        self.t_s, self.sent, self.abilities = 0.0, [], Abilities(6, 1000.0)
        self.status = SimpleNamespace(state=BoardState.DISABLED, faults=(), t_s=0.0)
        self.joints = SimpleNamespace(reference_rad=ARM.home)

    def enable(self):
        self.status.state = BoardState.ENABLED

    def receive(self, wait_s=0.0):
        count = round(wait_s * 1000)
        t_s = self.t_s + np.arange(1, count + 1) * 1e-3
        self.t_s += count * 1e-3
        return JointStates(t_s, np.tile(ARM.home, (count, 1)))

    def send(self, command):
        self.sent.append(command)


class Blind:
    """A follower that never finds the body."""

    rig, way = UNKNOWN, "followed"

    def measure(self, shot, expected=None, twist=None):
        return Missed("nothing is seen")


def setup(board, last_shot_s=np.inf, clock=None):
    """Cameras at 60 Hz that send nothing more from a time on."""
    newest = [0]

    def poll():
        number = int(board.t_s * 60)
        if number == newest[0] or board.t_s > last_shot_s:
            return None
        newest[0] = number
        return Shot(str(number), None, None, board.t_s)

    target = SimpleNamespace(body=SimpleNamespace(name="the body"))
    return Setup(ARM, board, poll, target, lambda q: np.zeros(6), 60.0, 0.0, clock)


def test_a_loop_receives_nothing_before_it_is_opened():
    board = Standing()
    loop = Loop(setup(board), Blind(), Log(), KalmanEstimator(ARM, delay=Delay(0.02, 0.02)))
    assert board.t_s == 0.0
    assert loop.log.joints == []


def looped(board, follower=None, **given):
    estimator = KalmanEstimator(ARM, delay=Delay(0.02, 0.02))
    loop = Loop.open(setup(board, **given), follower or Blind(), Log(), estimator)
    board.enable()
    return loop


def stand(loop, seconds):
    still = point_to_point(ARM, ARM.home, ARM.home)
    loop.go(still, seconds - still.duration_s, RunSegment("open_loop"))


def test_what_is_published_waits_until_a_command_was_sent_also_if_that_fails():
    board, happened = Standing(), []
    loop = looped(board)
    loop.publisher = SimpleNamespace(
        put=lambda datum: None,
        pause=lambda: happened.append("pause"),
        resume=lambda: happened.append("resume"),
        close=lambda: None,
    )
    board.send = lambda command: happened.append("command")
    stand(loop, 0.02)
    assert happened == ["pause", "command", "resume"] * 5 + ["resume"]
    board.status.state = BoardState.FAULTED
    happened.clear()
    with pytest.raises(DeviceError):
        stand(loop, 0.02)
    assert happened == ["pause", "resume"]


def test_cameras_that_stall_end_a_run_and_a_body_that_is_hidden_does_not():
    board = Standing()
    loop = looped(board, last_shot_s=2.0)
    stand(loop, 1.9)
    with pytest.raises(DeviceError, match=r"no shot has come for 0\.5 s: the cameras have stalled"):
        stand(loop, 3.0)
    assert 2.5 < board.t_s < 2.6
    assert loop.log.segments[-1].end_s == pytest.approx(board.t_s)


@pytest.mark.parametrize(
    "error", [InputError("a camera"), KeyboardInterrupt(), ZeroDivisionError("a programming error")]
)
def test_the_arm_is_stopped_whatever_ends_the_run(monkeypatch, error):
    board = Standing()

    def fails(loop, *_):
        stand(loop, 0.1)
        raise error

    monkeypatch.setattr(experiment, "Follower", lambda rig, target, apart_s: Blind())
    monkeypatch.setattr(experiment, "_require_seen", fails)
    plan = read_motions(ARM)
    if isinstance(error, ArmsightError | KeyboardInterrupt):
        outcome = run_experiment(setup(board), None, plan, ARM.home[None], progress=lambda line: None)
        assert outcome.interrupted == isinstance(error, KeyboardInterrupt)
        assert outcome.ended_by is (error if isinstance(error, ArmsightError) else None)
    else:
        with pytest.raises(ZeroDivisionError):
            run_experiment(setup(board), None, plan, ARM.home[None], progress=lambda line: None)
    assert (board.sent[-1].qd_ref == 0).all()
    assert board.sent[-1].duration_s == pytest.approx(0.3)


def test_between_the_passes_the_arm_moves_back_to_the_start_on_a_planned_trajectory():
    board = Standing()
    loop = looped(board)
    plan = read_motions(ARM, QUICK)
    way = plan.motions[-1].trajectory
    end = way.at(way.duration_s).q
    assert np.abs(end - plan.start).max() > 0.5  # these motions do not end where they began
    experiment._to_start(loop, plan)
    q = np.array([end] + [command.q_ref for command in board.sent] + [plan.start])
    assert (np.abs(np.diff(q, axis=0)) <= ARM.qd_max * PERIOD_S + 1e-6).all()


def test_the_log_of_a_long_run_stays_small_and_holds_every_shot(monkeypatch):
    monkeypatch.setattr(log, "NEWEST_SHOTS", 20)
    monkeypatch.setattr(log, "_BLOCK", 512)
    loop = looped(Standing())
    stand(loop, 0.5)
    early = [name for name, _, _ in loop.log.poses]
    loop.log.settle()
    stand(loop, 1.5)
    assert len(loop.log.poses) <= 22
    assert len(loop.log.joints) <= 6  # those since the newest shot
    names = [name for name, _, _ in loop.log.every_shot()]
    assert names[: len(early)] == early
    assert len(names) == loop.log.shots == loop.log.missed["nothing is seen"] == loop.log.counts()["missed"]
    assert len(names) > 100
    rows = loop.log.readings.array(7)
    np.testing.assert_allclose(np.diff(rows[:, 0]), 1e-3, rtol=0, atol=1e-9)
    assert rows[-1, 0] == pytest.approx(loop.t_s)
    assert len(loop.log.lives.array(53)) == round(loop.t_s / PERIOD_S)


def test_rows_that_do_not_fit_on_the_disk_stay_in_memory(monkeypatch):
    def full(owner, buffering=-1):
        raise OSError

    monkeypatch.setattr(log, "_BLOCK", 8)
    monkeypatch.setattr(log, "_unnamed", full)
    rows = log.Rows()
    for k in range(10):
        rows.append(float(k), np.arange(3.0))
    np.testing.assert_array_equal(rows.array(4), np.column_stack([np.arange(10.0), np.tile(np.arange(3.0), (10, 1))]))


class Live:
    """A clock that is the board's: time passes by itself."""

    def heard(self, board_s):
        pass

    def on_board(self, shot):
        return shot


def test_the_loop_goes_on_while_something_is_computed():
    board = Standing()
    loop = looped(board, clock=Live())
    stand(loop, 0.1)
    before = len(board.sent)

    def work():
        while len(board.sent) < before + 50:  # takes until the board has heard so often of the loop
            time.sleep(0.001)
        return 42

    assert loop.compute(work) == 42
    assert all((command.qd_ref == 0).all() for command in board.sent[before:])
    assert all(np.allclose(command.q_ref, ARM.home) for command in board.sent[before:])
    with pytest.raises(ZeroDivisionError):
        loop.compute(lambda: 1 / 0)


def test_in_lock_step_no_time_passes_while_something_is_computed():
    board = Standing()
    loop = looped(board)
    stand(loop, 0.1)
    t_s, sent = board.t_s, len(board.sent)
    assert loop.compute(lambda: 42) == 42
    assert (board.t_s, len(board.sent)) == (t_s, sent)


def test_a_board_that_faults_while_something_is_computed_is_reported_at_once():
    board = Standing()
    loop = looped(board, clock=Live())
    stand(loop, 0.1)
    ended = threading.Event()

    def work():
        board.status.state = BoardState.HOLDING
        ended.wait(10.0)

    with pytest.raises(DeviceError, match="changed to HOLDING"):
        loop.compute(work)
    ended.set()


def test_an_image_that_takes_long_does_not_keep_the_loop_waiting():
    board = Standing()
    slow = SimpleNamespace(rig=UNKNOWN, way="followed")

    def measure(shot, expected=None, twist=None):
        sent = len(board.sent)
        while len(board.sent) < sent + 20:
            time.sleep(0.001)
        return Missed("searched in vain")

    slow.measure = measure
    loop = looped(board, slow, clock=Live())
    stand(loop, 1.0)
    assert len(board.sent) >= 250
    assert 1 <= len(loop.log.poses) <= len(board.sent) / 20
    names = [name for name, _, _ in loop.log.poses]
    planned = Planned(point_to_point(ARM, ARM.home, ARM.home), loop.t_s, lambda q: np.zeros(6))
    loop.run_until_seen(planned, 0.02, RunSegment())  # a shot begun before does not count
    (name,) = [name for name, _, _ in loop.log.poses[len(names) :]]
    assert int(name) >= 60
    assert board.t_s > 1.02


def test_a_search_takes_its_time_in_a_simulation_too_and_commands_continue():
    board = Standing()
    searching = SimpleNamespace(
        rig=UNKNOWN, way="lost", measure=lambda shot, expected=None, twist=None: Missed("searched in vain")
    )
    loop = looped(board, searching)
    stand(loop, 0.5)
    assert len(board.sent) == pytest.approx(0.5 / PERIOD_S, abs=2)
    taken = np.array([t_s for _, t_s, _ in loop.log.poses])
    assert np.diff(taken).min() >= SIMULATED_SEARCH_S  # the next shot is the newest after the search
    assert 5 <= len(taken) <= 8
    searching.way = "followed"
    before = len(taken)
    stand(loop, 0.5)
    assert len(loop.log.poses) - before == pytest.approx(30, abs=2)


def test_ctrl_c_again_while_the_arm_is_being_stopped_stops_it_no_less(monkeypatch):
    board = Standing()

    def fails(loop, *_):
        stand(loop, 0.1)
        raise KeyboardInterrupt

    send = board.send

    def sent(command):
        if command.duration_s > 0.1:
            os.kill(os.getpid(), signal.SIGINT)
        send(command)

    monkeypatch.setattr(board, "send", sent)
    monkeypatch.setattr(experiment, "Follower", lambda rig, target, apart_s: Blind())
    monkeypatch.setattr(experiment, "_require_seen", fails)
    outcome = run_experiment(setup(board), None, read_motions(ARM), ARM.home[None], progress=lambda line: None)
    assert outcome.interrupted
    assert board.sent[-1].duration_s == pytest.approx(0.3)
    assert board.t_s > 0.4


def test_where_time_passes_by_itself_the_stop_is_sent_repeatedly():
    board = Standing()
    loop = looped(board, clock=Live())
    stand(loop, 0.1)
    before = len(board.sent)
    loop.stop()
    durations = [command.duration_s for command in board.sent[before:]]
    assert durations == pytest.approx(np.arange(0.3, 0.0, -PERIOD_S))


def test_slow_cameras_are_given_a_longer_sweep(monkeypatch):
    board = Standing()
    loop = looped(board)
    loop.mounting = SimpleNamespace(T_base_rig=np.eye(4))
    slow = replace(loop.setup, rate_hz=4.0)
    monkeypatch.setattr(loop, "setup", slow)
    with pytest.raises(CalibrationError, match=r"seen 0 times in 6\.5 s of sweep, 20 times at least") as caught:
        find_delay(loop, ARM.home, ARM.home)
    assert "slower than 4 Hz" in str(caught.value)


def test_an_interrupt_does_not_wait_for_what_is_being_computed():
    ended, waited = threading.Event(), []

    def meanwhile(done):
        assert not done()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        beside(lambda: waited.append(ended.wait(10.0)), meanwhile)
    assert waited == []
    ended.set()


def test_the_interpreter_settings_of_a_loop_are_restored_afterwards():
    others = sys.getswitchinterval()
    sys.setswitchinterval(0.005)
    try:
        before = sys.getswitchinterval()
        for in_time in (True, False):
            with steady(in_time=in_time):
                assert (sys.getswitchinterval() < before) == in_time
                assert not gc.isenabled()
            assert sys.getswitchinterval() == before
            assert gc.isenabled()
    finally:
        sys.setswitchinterval(others)


def test_interrupts_are_held_back_and_reported():
    with uninterrupted() as held:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.001)  # here it would have been raised
    assert held == [signal.SIGINT]
    with pytest.raises(KeyboardInterrupt):
        assert os.kill(os.getpid(), signal.SIGINT) or time.sleep(10.0)


def test_what_is_lost_of_a_reference_is_published_once():
    loop, losses, said = looped(Standing()), Counter(), []
    entry = Entry(Inertial.of("imu"), "mpu-6050", None, None, None, False)
    loop.setup = replace(loop.setup, beside=Fused(entry, losses=losses))
    loop.publisher = SimpleNamespace(put=said.append)
    for kind in ("a line was no reading", "a line was no reading", "it was lost: gone"):
        losses[kind] += 1
        loop.pass_time(0.005)
    assert [each.text for each in said if isinstance(each, NoteDatum)] == [
        "imu: a line was no reading",
        "imu: it was lost: gone",
    ]
